"""Run one peer over one recording, inside the peer's own environment.

`python runner.py --method vector --robot allegro_hand_right --data .peers/data IN.npz OUT.npz`

The peers are run as in their own examples. Vectors between landmarks are given in the frame that
dex-retargeting estimates from the wrist and the knuckles of index and middle finger
(`example/vector_retargeting/single_hand_detector.py`, `OPERATOR2MANO_RIGHT` and `_LEFT`). Its
position method gets the landmarks in the tracker's world and moves a free root, which starts at the
wrist (`example/position_retargeting/hand_robot_viewer.py`). Configuration files are the peers' own
(`configs/teleop`, `configs/offline`), and so are robot descriptions (dex-urdf).

IN holds `landmarks` (T, 21, 3) [m] of a hand of the robot's side in MediaPipe's order, `valid` (T,)
and `handedness`. OUT gets

- `joint_names`: all joints of the robot, followers (mimic) among them, n of them;
- `q`: (T, n) [rad], the last command where a sample is not valid, the first one before it;
- `is_solved`: (T,), samples that were retargeted;
- `cpu_time`: (T,) of the peer's `retarget` [s], NaN where not solved;
- `base_pose`: (T, 4, 4) of the robot's root link in the world, of the position method alone;
- `facts`: JSON: peer, version, configuration, low-pass factor and the number of samples that the
  peer's solver gave up on.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.metadata
import io
import json
import logging
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

METHODS = ("vector", "dexpilot", "position")
ROOT_JOINTS = tuple(
    f"dummy_{axis}_{kind}_joint"
    for kind in ("translation", "rotation")
    for axis in "xyz"
)
"""Joints of the free root, in the order of their chain (dex-retargeting's `DUMMY_JOINT_NAMES`)."""
_WRIST, _INDEX_KNUCKLE, _MIDDLE_KNUCKLE = 0, 5, 9
# In the peers' documentation: 1 means no filter.
_NO_FILTER = 1.0
_REPORTS = 4


def operator_frame(landmarks: np.ndarray, sign: float = 1.0) -> np.ndarray:
    """Axes of a hand in which the peers' robots are described: z distal, x out of the palm.

    The same as `estimate_frame_from_hand_points(...) @ OPERATOR2MANO_RIGHT`, or `_LEFT`, of
    dex-retargeting's examples: z runs from the wrist to the middle finger's knuckle, and the index
    finger's knuckle lies in the y-z plane, at positive y of the middle finger's on a right hand.

    Args:
        landmarks: Landmarks [m], shape (21, 3).
        sign: 1 of a right hand, -1 of a left one.

    Returns:
        The axes as columns, shape (3, 3).
    """
    distal = landmarks[_MIDDLE_KNUCKLE] - landmarks[_WRIST]
    distal = distal / np.linalg.norm(distal)
    across = landmarks[_INDEX_KNUCKLE] - landmarks[_MIDDLE_KNUCKLE]
    across = across - (across @ distal) * distal
    across = across / np.linalg.norm(across)
    across = sign * across
    return np.column_stack([np.cross(across, distal), across, distal])


def human_indices(config: dict[str, Any]) -> np.ndarray:
    """Landmarks that a configuration uses.

    Args:
        config: The content of a configuration file below `retargeting`.

    Returns:
        Of positions their landmarks, shape (k,); of vectors their origins and ends, shape (2, k).
    """
    named = config.get("target_link_human_indices")
    if named is not None:
        return np.array(named)
    # DexPilot, where the file names none: from every finger to those before it, then from the wrist
    # to every finger. Landmark 4 i is the tip of finger i, counted from the thumb as 1.
    count = len(config["finger_tip_link_names"])
    pairs = [(j, i) for i in range(1, count) for j in range(i + 1, count + 1)]
    pairs += [(0, i) for i in range(1, count + 1)]
    return 4 * np.array(pairs).T


def reference_value(
    landmarks: np.ndarray, indices: np.ndarray, sign: float = 1.0
) -> np.ndarray:
    """What a peer's `retarget` takes for one sample.

    Args:
        landmarks: Landmarks [m], shape (21, 3).
        indices: Of `human_indices`.
        sign: As of `operator_frame`.

    Returns:
        Positions in the landmarks' own frame, or vectors in the operator's frame [m], shape (k, 3).
    """
    if indices.ndim == 1:
        return landmarks[indices]
    vectors = landmarks[indices[1]] - landmarks[indices[0]]
    return vectors @ operator_frame(landmarks, sign)


def root_angles(rotation: np.ndarray) -> np.ndarray:
    """Angles of the free root's three joints [rad], shape (3,), with `rotation = Rx Ry Rz`."""
    return np.array(
        [
            np.arctan2(-rotation[1, 2], rotation[2, 2]),
            np.arcsin(np.clip(rotation[0, 2], -1.0, 1.0)),
            np.arctan2(-rotation[0, 1], rotation[0, 0]),
        ]
    )


def root_pose(coordinates: np.ndarray) -> np.ndarray:
    """Pose of the robot's root link, shape (4, 4), for the free root's six joints, shape (6,)."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(coordinates[3:]), np.sin(coordinates[3:])
    pose = np.eye(4)
    pose[:3, :3] = (
        np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    )
    pose[:3, 3] = coordinates[:3]
    return pose


class Solver:
    """A peer, ready to retarget sample by sample.

    Args:
        config: The content of a configuration file below `retargeting`, `urdf_path` absolute.

    Attributes:
        joint_names: All joints of the peer's robot, those of a free root among them.
        version: Version of the peer.
        failures: Samples that the peer's solver gave up on and said so.
        sign: As of `operator_frame`.
    """

    peer = ""
    sign = 1.0

    def __init__(self, config: dict[str, Any]) -> None:
        self.version = importlib.metadata.version(self.peer)
        self.failures = 0
        self.joint_names: list[str] = []

    def start(self, landmarks: np.ndarray) -> None:
        """Put the free root at the wrist of the first sample, landmarks (21, 3)."""
        raise NotImplementedError

    def retarget(self, reference: np.ndarray) -> np.ndarray:
        """Joint positions in the order of `joint_names`, shape (n,)."""
        raise NotImplementedError


class DexRetargeting(Solver):
    """dex-retargeting: Pinocchio, NLopt's SLSQP, and torch for the loss."""

    peer = "dex-retargeting"

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__(config)
        indices = human_indices(config)
        importlib.import_module("torch").set_num_threads(1)
        module = importlib.import_module("dex_retargeting.retargeting_config")
        # It warns of every mesh that is not there, and reads none.
        logging.getLogger("dex_retargeting.yourdfpy").setLevel(logging.ERROR)
        self._solver = module.RetargetingConfig.from_dict(dict(config)).build()
        own = self._solver.optimizer.target_link_human_indices
        if not np.array_equal(np.squeeze(own), indices):
            raise SystemExit(
                f"{self.peer}: uses the landmarks {own}, expected {indices}"
            )
        self.joint_names = list(self._solver.joint_names)

    def start(self, landmarks: np.ndarray) -> None:
        """Warm start by the peer's own method."""
        rotations = importlib.import_module("pytransform3d.rotations")
        frame = operator_frame(landmarks, self.sign)
        wrist_quat_wxyz = rotations.quaternion_from_matrix(frame)
        self._solver.warm_start(landmarks[_WRIST], wrist_quat_wxyz)

    def retarget(self, reference: np.ndarray) -> np.ndarray:
        """Count the samples in which NLopt failed."""
        said = io.StringIO()
        # Where NLopt fails, dex-retargeting prints the reason and keeps the sample before.
        with contextlib.redirect_stdout(said):
            q = self._solver.retarget(reference)
        self.failures += bool(said.getvalue())
        return q


class DexiRs(Solver):
    """dexi-rs: the same methods in Rust."""

    peer = "dexi-rs"

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__(config)
        module = importlib.import_module("dexi_rs")
        self._solver = module.RetargetingConfig(**config).build()
        self.joint_names = list(self._solver.joint_names)

    def start(self, landmarks: np.ndarray) -> None:
        """Set the joints of the free root: dexi-rs has no warm start of its own."""
        q = np.array(self._solver.get_qpos())
        frame = operator_frame(landmarks, self.sign)
        pose = np.concatenate([landmarks[_WRIST], root_angles(frame)])
        q[[self.joint_names.index(name) for name in ROOT_JOINTS]] = pose
        self._solver.set_qpos(q.tolist())

    def retarget(self, reference: np.ndarray) -> np.ndarray:
        """Pass flat lists, which is what the Rust code takes."""
        return np.array(self._solver.retarget(reference.ravel().tolist()))


SOLVERS: dict[str, type[Solver]] = {
    kind.peer: kind for kind in (DexRetargeting, DexiRs)
}


def retarget_all(
    solver: Solver,
    landmarks: np.ndarray,
    valid: np.ndarray,
    indices: np.ndarray,
    report: Callable[[int], None],
) -> tuple[np.ndarray, np.ndarray]:
    """Retarget the valid samples of a recording in turn; the others hold the last command.

    Args:
        solver: The peer.
        landmarks: Landmarks of a hand of the robot's side [m], shape (T, 21, 3).
        valid: Samples to retarget, shape (T,).
        indices: Of `human_indices`.
        report: Called with the number of samples done after each one.

    Returns:
        Joint positions, shape (T, n), and CPU time of each call [s], NaN where held, shape (T,).
    """
    q = np.zeros((len(valid), len(solver.joint_names)))
    cpu_time = np.full(len(valid), np.nan)
    first = int(np.argmax(valid))
    if indices.ndim == 1:
        solver.start(landmarks[first])
    for i in range(first, len(valid)):
        if valid[i]:
            reference = reference_value(landmarks[i], indices, solver.sign)
            started = time.process_time_ns()
            q[i] = solver.retarget(reference)
            cpu_time[i] = 1e-9 * (time.process_time_ns() - started)
        else:
            q[i] = q[i - 1]
        report(i + 1)
    q[:first] = q[first]
    return q, cpu_time


def load_config(
    data: Path, method: str, robot: str, *, is_filtered: bool
) -> dict[str, Any]:
    """Read a peer's configuration file.

    Args:
        data: Folder with `configs` and `hands`, as `build.py` leaves it.
        method: One of `METHODS`.
        robot: Name of a robot in the file names of the configurations.
        is_filtered: Whether to keep the file's low-pass filter.

    Returns:
        Its content below `retargeting`, with the path of the robot's URDF absolute.
    """
    folder, suffix = ("offline", "") if method == "position" else ("teleop", "")
    if method == "dexpilot":
        suffix = "_dexpilot"
    file = data / "configs" / folder / f"{robot}{suffix}.yml"
    if not file.is_file():
        raise SystemExit(f"runner.py: the peers have no configuration {file}")
    yaml = importlib.import_module("yaml")
    config = yaml.safe_load(file.read_text(encoding="utf-8"))["retargeting"]
    config["urdf_path"] = str((data / "hands" / config["urdf_path"]).resolve())
    if not is_filtered:
        config["low_pass_alpha"] = _NO_FILTER
    return config


def main() -> None:
    """Parse the command line, run the peer, write the result."""
    parser = argparse.ArgumentParser(description="Run a peer over a recording.")
    parser.add_argument("--peer", choices=sorted(SOLVERS), required=True)
    parser.add_argument("--method", choices=METHODS, required=True)
    parser.add_argument("--robot", required=True, help="such as allegro_hand_right")
    parser.add_argument(
        "--no-filter", action="store_true", help="without the low-pass filter"
    )
    parser.add_argument(
        "--data", type=Path, required=True, help="folder that build.py filled"
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    with np.load(arguments.recording, allow_pickle=False) as arrays:
        landmarks = arrays["landmarks"].astype(float)
        valid = arrays["valid"].astype(bool) & np.isfinite(landmarks).all(axis=(1, 2))
        side = str(arrays["handedness"])
    if not arguments.robot.endswith(side):
        raise SystemExit(
            f"runner.py: handedness: {arguments.robot} does not follow a {side} hand: "
            "mirror it first"
        )
    if not valid.any():
        raise SystemExit("runner.py: no sample is valid")
    config = load_config(
        arguments.data,
        arguments.method,
        arguments.robot,
        is_filtered=not arguments.no_filter,
    )
    solver = SOLVERS[arguments.peer](config)
    solver.sign = 1.0 if side == "right" else -1.0
    name = f"{arguments.peer} {arguments.method} {arguments.robot}"
    steps = {len(valid) * part // _REPORTS for part in range(1, _REPORTS + 1)}

    def report(done: int) -> None:
        if done in steps:
            print(f"{name}: {done}/{len(valid)} samples", file=sys.stderr, flush=True)

    q, cpu_time = retarget_all(solver, landmarks, valid, human_indices(config), report)
    is_root = np.array([joint in ROOT_JOINTS for joint in solver.joint_names])
    result = {
        "joint_names": np.array(solver.joint_names)[~is_root],
        "q": q[:, ~is_root],
        "is_solved": valid,
        "cpu_time": cpu_time,
    }
    if is_root.any():
        order = [solver.joint_names.index(joint) for joint in ROOT_JOINTS]
        result["base_pose"] = np.array([root_pose(row) for row in q[:, order]])
    facts = {
        "peer": arguments.peer,
        "version": solver.version,
        "method": arguments.method,
        "robot": arguments.robot,
        "low_pass_alpha": config["low_pass_alpha"],
        "failures": solver.failures,
    }
    np.savez_compressed(arguments.output, facts=np.array(json.dumps(facts)), **result)  # ty: ignore[invalid-argument-type]


if __name__ == "__main__":
    # dex-retargeting keeps links in a set: with hashes that change, sums change in the last digit.
    if os.environ.get("PYTHONHASHSEED") != "0":
        os.environ["PYTHONHASHSEED"] = "0"
        os.execv(sys.executable, [sys.executable, *sys.argv])
    main()
