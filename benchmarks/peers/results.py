"""Results of the peers in the terms of this package: `run_peer`.

The runner is a subprocess in the peer's environment. Its result is kept in `.peers/cache`, under a
hash of everything that it depends on.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from handmap_core.human.recording import Recording, mirrored
from handmap_core.human.sample import PALM
from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.human.measure import measure_hand
from handmap_qp.se3 import inverse_pose, rigid_fit, transform_points
from handmap_qp.trackers.formats.base import SIDES
from peers import build, runner

ROBOTS = tuple(
    f"{hand}_{side}"
    for side in SIDES
    for hand in (
        "allegro_hand",
        "leap_hand",
        "schunk_svh_hand",
        "shadow_hand",
        "ability_hand",
        "inspire_hand",
    )
)
"""Robots that the peers are run with, by the names of their configuration files."""
_OWN_NAMES = {
    f"{hand}_{side}": f"{hand}_hand_{side}"
    for hand in ("allegro", "leap", "shadow")
    for side in SIDES
}
# The same axes, senses and zeros, by other names: those of MuJoCo's models of the two hands.
_LEAP_JOINTS = {
    "if": {"mcp": "1", "rot": "0", "pip": "2", "dip": "3"},
    "mf": {"mcp": "5", "rot": "4", "pip": "6", "dip": "7"},
    "rf": {"mcp": "9", "rot": "8", "pip": "10", "dip": "11"},
    "th": {"cmc": "12", "axl": "13", "mcp": "14", "ipl": "15"},
}
# Descriptions of the left Allegro hand count its fingers from opposite sides.
_ALLEGRO_LEFT = (8, 4, 0, 12)
# Of the peers' Shadow alone.
_WRIST_JOINTS = ("WRJ2", "WRJ1")


@dataclass(frozen=True, slots=True)
class PeerMethod:
    """One way to run a peer.

    Attributes:
        name: Short name, as options and tables take it.
        title: Name for people.
        peer: The peer's distribution.
        method: What `runner.py` calls it: `vector`, `dexpilot` or `position`.
        is_filtered: Whether the low-pass filter of the peer's configuration is on. The filter of
            the position configurations is off (factor 1), so they have no second form.
    """

    name: str
    title: str
    peer: str
    method: str
    is_filtered: bool = True


METHODS = {
    method.name: method
    for method in (
        PeerMethod("dex-vector", "dex vector", "dex-retargeting", "vector"),
        PeerMethod(
            "dex-vector-unfiltered",
            "dex vector, no filter",
            "dex-retargeting",
            "vector",
            False,
        ),
        PeerMethod("dex-dexpilot", "DexPilot", "dex-retargeting", "dexpilot"),
        PeerMethod(
            "dex-dexpilot-unfiltered",
            "DexPilot, no filter",
            "dex-retargeting",
            "dexpilot",
            False,
        ),
        PeerMethod("dex-position", "dex position", "dex-retargeting", "position"),
        PeerMethod("dexi-vector", "dexi vector", "dexi-rs", "vector"),
        PeerMethod(
            "dexi-vector-unfiltered",
            "dexi vector, no filter",
            "dexi-rs",
            "vector",
            False,
        ),
        PeerMethod("dexi-dexpilot", "dexi DexPilot", "dexi-rs", "dexpilot"),
        PeerMethod(
            "dexi-dexpilot-unfiltered",
            "dexi DexPilot, no filter",
            "dexi-rs",
            "dexpilot",
            False,
        ),
        PeerMethod("dexi-position", "dexi position", "dexi-rs", "position"),
    )
}
"""All ways to run the peers, by their names."""


class PeerError(HandmapError):
    """A peer is not built, or its run failed; the message is one line."""


@dataclass(frozen=True)
class PeerMotion:
    """What a peer made of a recording.

    Attributes:
        method: How the peer was run.
        robot: Our robot hand.
        recording: The recording that the peer got: mirrored, if the other hand was recorded.
        q: Joint positions in the order of `robot.joint_names` [rad], shape (T, n). They may lie
            outside the robot's limits: they are the peer's, unchanged.
        cpu_time: CPU time of each retargeted sample [s], NaN where a sample was held, shape (T,).
        base_pose: Pose of the peer's root link in the world, shape (T, 4, 4), of the peer's
            position method; None of the others, which do not move it.
        root: Pose of our root link in the peer's, shape (T, 4, 4). It moves where the peer's robot
            has a wrist that ours has not (Shadow's).
        straight: The same with that wrist straight, shape (4, 4); None if there is none.
        facts: Peer, version, configuration, low-pass factor and number of failures.
    """

    method: PeerMethod
    robot: Hand
    recording: Recording
    q: np.ndarray
    cpu_time: np.ndarray
    base_pose: np.ndarray | None
    root: np.ndarray
    straight: np.ndarray | None
    facts: dict[str, Any]

    @cached_property
    def palm(self) -> np.ndarray:
        """Palm of robot and human in the world, shape (T, 4, 4): the peers pass the wrist on."""
        return measured_palms(self.recording)

    @cached_property
    def wrist(self) -> np.ndarray:
        """Wrist of the robot in the world, (T, 4, 4): its palm on the human's measured palm.

        Turned as the peer's own wrist turns it.
        """
        wrist = self.palm @ inverse_pose(self.robot.wrist_to_palm)
        if self.straight is None:
            return wrist
        turn = inverse_pose(self.straight) @ self.root
        turn[:, :3, 3] = 0.0
        return wrist @ self._own_root @ turn @ inverse_pose(self._own_root)

    @cached_property
    def own_wrist(self) -> np.ndarray | None:
        """Wrist of the robot in the world where the peer itself put it, shape (T, 4, 4).

        None of methods that do not move it.
        """
        if self.base_pose is not None:
            return self.base_pose @ self.root @ inverse_pose(self._own_root)
        return None if self.straight is None else self.wrist

    @cached_property
    def _own_root(self) -> np.ndarray:
        """Pose of our root link, shape (4, 4), with the wrist at the identity."""
        return _root_pose(self.robot)


def run_peer(method: PeerMethod | str, recording: Recording, robot: Hand) -> PeerMotion:
    """Run a peer over a recording, or return the result of the same run before.

    Args:
        method: One of `METHODS`, or its name.
        recording: Landmarks of a hand; those of the other one than the robot's are mirrored.
        robot: A robot hand that the peers have a configuration for (`peer_robot`).

    Returns:
        The peer's motion.

    Raises:
        InvalidInputError: If there is no such method, or the peers do not know the robot.
        PeerError: If the peers are not built, or the run failed.
    """
    chosen = method_of(method)
    name = peer_robot(robot)
    missing = build.missing_peers()
    if chosen.peer in missing:
        raise PeerError(build.why_missing(missing))
    own = recording if recording.side == robot.side else mirrored(recording)
    file = build.peers_folder() / "cache" / f"{_key(chosen, name, own)}.npz"
    if not file.is_file():
        _run(chosen, name, own, file)
    return read_result(file, chosen, own, robot)


def read_result(
    file: Path, method: PeerMethod, recording: Recording, robot: Hand
) -> PeerMotion:
    """Read what `runner.py` wrote, the joints in the order of our hand.

    Args:
        file: The runner's output.
        method: How the peer was run.
        recording: The recording that the peer got.
        robot: Our robot hand; all its joints must be among the peer's.

    Returns:
        The peer's motion.

    Raises:
        PeerError: If joints are missing, or the number of samples is another.
    """
    with np.load(file, allow_pickle=False) as arrays:
        values = dict(arrays)
    names = [str(name) for name in values["joint_names"]]
    wanted = {name: peer_joint(robot, name) for name in robot.joint_names}
    missing = sorted(name for name, peers in wanted.items() if peers not in names)
    if missing:
        raise PeerError(
            f"{robot.name}: {method.name} gives no joint {', '.join(missing)}"
        )
    if len(values["q"]) != len(recording):
        raise PeerError(
            f"{file}: expected {len(recording)} samples of {recording.name}, got {len(values['q'])}"
        )
    q = values["q"][:, [names.index(name) for name in wanted.values()]]
    wrist = [name for name in names if name in _WRIST_JOINTS]
    turns = values["q"][:, [names.index(name) for name in wrist]]
    base_pose = values.get("base_pose")
    straight = np.eye(4)
    if wrist or base_pose is not None:
        straight = _roots_in_peers(robot, q[:1], wrist, 0.0 * turns[:1])[0]
    roots = np.tile(straight, (len(q), 1, 1))
    if wrist:
        roots = _roots_in_peers(robot, q, wrist, turns)
    return PeerMotion(
        method=method,
        robot=robot,
        recording=recording,
        q=q,
        cpu_time=values["cpu_time"],
        base_pose=base_pose,
        root=roots,
        straight=straight if wrist else None,
        facts=json.loads(str(values["facts"])),
    )


def peer_robot(robot: Hand) -> str:
    """The peers' name of a robot hand: of ours by its name, of any other by its joints' names.

    Args:
        robot: The robot hand.

    Returns:
        One of `ROBOTS`.

    Raises:
        InvalidInputError: If the peers have no configuration for it.
    """
    if _OWN_NAMES.get(robot.name, "").endswith(robot.side):
        return _OWN_NAMES[robot.name]
    for name in ROBOTS:
        is_sure = name.endswith(robot.side) and name != "allegro_hand_left"
        if is_sure and {*robot.joint_names} <= _peer_joints(name):
            return name
    raise InvalidInputError(
        argument="robot",
        expected=f"a hand with the joints of one of {', '.join(ROBOTS)}",
        value=robot.name,
        got=f"{robot.name} ({robot.side})",
        advice="the peers have no configuration for it",
    )


def peer_joint(robot: Hand, name: str) -> str:
    """Return the peers' name of a joint of a robot hand of ours."""
    # Descriptions of others have the peers' names already.
    if robot.name in ("leap_left", "leap_right") and "_" in name:
        finger, _, joint = name.partition("_")
        return _LEAP_JOINTS[finger][joint]
    if robot.name == "allegro_left":
        finger, link = divmod(int(name.removeprefix("joint_").removesuffix(".0")), 4)
        return f"joint_{_ALLEGRO_LEFT[finger] + link}.0"
    is_shadow = robot.name in ("shadow_left", "shadow_right")
    return name.removeprefix("rh_").removeprefix("lh_") if is_shadow else name


def _root_pose(robot: Hand) -> np.ndarray:
    """Return the pose of a hand's root link, shape (4, 4), with its wrist at the identity."""
    return robot.link_poses([_root_link(robot.urdf_text)], robot.rest)[0]


def _roots_in_peers(
    robot: Hand, q: np.ndarray, wrist: list[str], turns: np.ndarray
) -> np.ndarray:
    """Return poses of our root link in that of the peers' robot, by a fit of all joints' places.

    Args:
        robot: Our robot hand.
        q: Its joint angles [rad], shape (k, n).
        wrist: Joints that only the peers' robot has.
        turns: Their angles [rad], shape (k, joints).

    Returns:
        Poses, shape (k, 4, 4); the identity where the peers' description is not there.
    """
    if not build.data_folder().is_dir():
        return np.tile(np.eye(4), (len(q), 1, 1))
    model = pin.buildModelFromUrdf(str(_urdf(peer_robot(robot))))
    data = model.createData()
    ours = [model.getJointId(peer_joint(robot, name)) for name in robot.joint_names]
    joints = [*ours, *map(model.getJointId, wrist)]
    columns = [model.joints[joint].idx_q for joint in joints]
    root = inverse_pose(_root_pose(robot))
    poses = []
    for angles, turned in zip(q, turns, strict=True):
        posture = pin.neutral(model)
        posture[columns] = [*angles, *turned]
        pin.forwardKinematics(model, data, posture)
        here = [robot.frame_pose(name, angles)[:3, 3] for name in robot.joint_names]
        there = np.array([data.oMi[joint].translation for joint in ours])
        poses.append(rigid_fit(transform_points(root, np.array(here)), there))
    return np.array(poses)


def measured_palms(
    recording: Recording, lengths: HumanLengths | None = None
) -> np.ndarray:
    """Pose of the human's palm frame, by a rigid fit of the five palm landmarks.

    Args:
        recording: Landmarks of a hand.
        lengths: The person's segment lengths; measured over the recording if omitted.

    Returns:
        Poses of the palm frame (y distal, z dorsal, origin at the wrist) in the world, shape
        (T, 4, 4). A sample that is not valid holds the pose before it; before the first valid one,
        the first.
    """
    name = "human" if recording.side == "right" else "human_left"
    human = load_hand(
        name, points="landmarks", lengths=lengths or measure_hand(recording)
    )
    points = human.points(np.clip(0.0, human.lower_limits, human.upper_limits))[PALM]
    poses = np.empty((len(recording), 4, 4))
    first = int(np.argmax(recording.valid))
    for i in range(first, len(recording)):
        if recording.valid[i]:
            wrist = rigid_fit(points, recording.landmarks[i, PALM])
            poses[i] = wrist @ human.wrist_to_palm
        else:
            poses[i] = poses[i - 1]
    poses[:first] = poses[first]
    return poses


def method_of(method: PeerMethod | str) -> PeerMethod:
    """Return a way to run a peer by its name.

    Raises:
        InvalidInputError: If there is none.
    """
    if isinstance(method, PeerMethod):
        return method
    if method not in METHODS:
        raise InvalidInputError(
            argument="method", expected=f"one of {', '.join(METHODS)}", value=method
        )
    return METHODS[method]


def _urdf(name: str) -> Path:
    """The robot description that a configuration names."""
    config = runner.load_config(build.data_folder(), "vector", name, is_filtered=True)
    return Path(config["urdf_path"])


def _peer_joints(name: str) -> set[str]:
    """Movable joints of a peer's robot; none where the peers are not built."""
    if not build.data_folder().is_dir():
        return set()
    root = ElementTree.parse(_urdf(name)).getroot()
    return {
        joint.attrib["name"]
        for joint in root.iter("joint")
        if joint.get("type") != "fixed"
    }


def _root_link(urdf_text: str) -> str:
    """The link of a URDF that is no joint's child."""
    root = ElementTree.fromstring(urdf_text)
    children = {child.attrib["link"] for child in root.iter("child")}
    return next(
        link.attrib["name"]
        for link in root.findall("link")
        if link.attrib["name"] not in children
    )


def _key(method: PeerMethod, robot: str, recording: Recording) -> str:
    """Hash of all that a run depends on: method, robot, landmarks, runner and versions."""
    digest = hashlib.sha256(
        f"{method.peer} {method.method} {method.is_filtered} {robot}".encode()
    )
    digest.update(build.version_of(method.peer).encode())
    for file in (Path(runner.__file__), _urdf(robot)):
        digest.update(file.read_bytes())
    for array in (recording.landmarks, recording.valid):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]


def _run(method: PeerMethod, robot: str, recording: Recording, file: Path) -> None:
    """Run a peer and put its result in place once it is whole."""
    with _workspace(file.parent) as folder:
        given, made = folder / "recording.npz", folder / "result.npz"
        np.savez(
            given,
            time=recording.time,
            landmarks=recording.landmarks,
            valid=recording.valid,
            handedness=np.array(recording.side),
        )
        words = [build.python_of(method.peer), str(Path(runner.__file__))]
        words += ["--peer", method.peer, "--method", method.method, "--robot", robot]
        words += [] if method.is_filtered else ["--no-filter"]
        words += ["--data", str(build.data_folder()), str(given), str(made)]
        # dex-retargeting leaves a folder of its own in TMPDIR; a PYTHONPATH of ours is not its.
        is_apart = build.python_of(method.peer) != sys.executable
        environment = {
            key: value
            for key, value in os.environ.items()
            if not (is_apart and key == "PYTHONPATH")
        }
        environment |= {
            "TMPDIR": str(folder),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        last = ""
        with subprocess.Popen(
            words,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            env=environment,
        ) as process:
            for line in process.stderr or ():
                print(line, end="", file=sys.stderr, flush=True)
                last = line.strip() or last
        if process.returncode:
            raise PeerError(f"{method.name} failed on {recording.name}: {last}")
        made.replace(file)


@contextmanager
def _workspace(cache: Path) -> Iterator[Path]:
    """A folder beside the results, so that a finished one can be moved into place."""
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache, prefix="run-") as folder:
        yield Path(folder)
