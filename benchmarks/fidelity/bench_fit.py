"""The fit of joint angles to landmarks: its time, its optimum, and a tracker's own angles.

Time is CPU time per sample, also in calls of one Jacobian: placing the hand with
`place` and reading `point_jacobian` of the 21 landmarks.

A fit has converged if a further one turns no joint by more than 1 degree. It is the best if none
of the four starts of a first sample ends at a cost of a finger that is lower by 2 %.

The tracker's own angles come from the orientations of its bones (recordings with `joints_pose`:
headsets). Its zeros and ours differ by a constant per joint, which is taken out: `offset` is the
mean difference, `RMS` what is left. Abduction is compared where the finger is bent by less than 60
degrees at its MCP joint: near 90 degrees it is not defined. The thumb of the paper's hand has its
IP axis across the MCP axis, which no thumb has, so no fit brings its angles nearer.

    python benchmarks bench_fit --json fit.json --picture fit.png
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import common
import numpy as np
from scipy.spatial.transform import Rotation

from handmap_core.human.sample import PALM, TIPS
from handmap_qp import load_hand, read_recording
from handmap_qp.human.fit import LandmarkFitter
from handmap_qp.human.measure import measure_hand
from handmap_qp.se3 import rigid_fit

_FINGERS = {"index": "index", "middle": "middle", "ring": "ring", "little": "pinky"}
_BENT = np.radians(60.0)


def own_angles(file: Path, side: str) -> dict[str, np.ndarray]:
    """Return a tracker's own joint angles [rad] by our names, from the orientations of its bones.

    The axes are WebXR's: -z along the bone, +y dorsal, +x to the right of the hand's back. Flexion
    is positive towards the palm, abduction towards the thumb.

    Args:
        file: A recording with `joints_pose` (quaternions wxyz) and `joint_names`.
        side: `right` or `left`.
    """
    with np.load(file, allow_pickle=False) as arrays:
        poses, names = arrays["joints_pose"], list(arrays["joint_names"])

    def turned(name: str) -> Rotation:
        quaternions = poses[:, names.index(name), 3:][:, [1, 2, 3, 0]].copy()
        # Samples without a hand are not compared.
        quaternions[~(np.linalg.norm(quaternions, axis=1) > 0.5)] = 0.0, 0.0, 0.0, 1.0
        return Rotation.from_quat(quaternions)

    def flexion(before: str, after: str) -> np.ndarray:
        axis = (turned(before).inv() * turned(after)).apply([0.0, 0.0, -1.0])
        return np.arctan2(-axis[:, 1], -axis[:, 2])

    towards_thumb = 1.0 if side == "right" else -1.0
    angles = {}
    for ours, theirs in _FINGERS.items():
        bones = [
            f"{theirs}-finger-phalanx-{b}"
            for b in ("proximal", "intermediate", "distal")
        ]
        knuckle = (turned("wrist").inv() * turned(bones[0])).as_euler("YXZ")
        angles[f"{ours}_MCP_abduction"] = towards_thumb * knuckle[:, 0]
        angles[f"{ours}_MCP_flexion"] = -knuckle[:, 1]
        angles[f"{ours}_PIP_flexion"] = flexion(bones[0], bones[1])
        angles[f"{ours}_DIP_flexion"] = flexion(bones[1], bones[2])
    # On the model's thumb, positive angles extend.
    angles["thumb_MCP_flexion"] = -flexion("thumb-metacarpal", "thumb-phalanx-proximal")
    angles["thumb_IP_flexion"] = -flexion(
        "thumb-phalanx-proximal", "thumb-phalanx-distal"
    )
    return angles


def jacobian_time(fitter: LandmarkFitter) -> float:
    """Return the CPU time of one Jacobian of the 21 landmarks [s]."""
    human = fitter.human
    configuration = human.configuration()
    vector = human.configuration_vector(human.rest, np.eye(4))

    def call() -> None:
        configuration.place(vector)
        configuration.point_jacobian()

    common.mean_cpu_time(call, 200)
    return common.mean_cpu_time(call, 2000)


def optimum_of(
    fitter: LandmarkFitter, q: np.ndarray, landmarks: np.ndarray
) -> tuple[float, bool]:
    """Return how far further steps turn a joint [deg], and whether no other start ends better."""
    local = local_landmarks(fitter, landmarks)
    start = q.reshape(5, 4)
    best, cost = fitter._nearest(start, local)
    fitter._q, last = None, fitter._q
    other_cost = np.min([found for _, found in fitter._fits(local)], axis=0)
    fitter._q = last
    is_best = not (other_cost < 0.98 * cost - 1e-3).any()
    return float(np.degrees(np.abs(best - start).max())), is_best


def local_landmarks(fitter: LandmarkFitter, landmarks: np.ndarray) -> np.ndarray:
    """Return a sample as the fitter sees it, in wrist axes [m], shape (21, 3)."""
    wrist = rigid_fit(fitter.palm.points, landmarks[PALM])
    return (landmarks - wrist[:3, 3]) @ wrist[:3, :3]


def measure_time(file: Path, count: int | None) -> dict[str, Any]:
    """Fit a recording; measure times, errors and distances from the optimum."""
    recording = read_recording(file)
    fitter = LandmarkFitter(recording.side, measure_hand(recording))
    one = jacobian_time(fitter)
    seen = np.flatnonzero(recording.valid)[:count]
    excess = []
    fits: list[Any] = []
    times = common.cpu_times(
        lambda i: fits.append(fitter.fit(recording.landmarks[seen[i]])), len(seen)
    )
    measured = recording.landmarks[seen]
    fitted = np.array([fitter.human.points(*fit) for fit in fits])
    errors = np.linalg.norm(fitted - measured, axis=2)
    for i in range(0, len(seen), 10):
        excess.append(optimum_of(fitter, fits[i][0], recording.landmarks[seen[i]]))
    ratio = times / one
    return {
        "recording": recording.name,
        "Jacobian [us]": 1e6 * one,
        "fit [us]": 1e6 * float(np.median(times)),
        "in Jacobians, median": float(np.median(ratio)),
        "mean": float(ratio.mean()),
        "p99": float(np.percentile(ratio, 99)),
        "error [mm]": 1e3 * float(errors.mean()),
        "tips [mm]": 1e3 * float(errors[:, TIPS].mean()),
        "converged [%]": 100.0 * float(np.mean([angle < 1.0 for angle, _ in excess])),
        "best [%]": 100.0 * float(np.mean([is_best for _, is_best in excess])),
    }


def compare_angles(file: Path) -> list[dict[str, Any]]:
    """Compare fitted angles with the tracker's own; empty if the file has no orientations."""
    with np.load(file, allow_pickle=False) as arrays:
        if "joints_pose" not in arrays:
            return []
    recording = read_recording(file)
    fitter = LandmarkFitter(recording.side, measure_hand(recording))
    seen = np.flatnonzero(recording.valid)
    fitted = np.array([fitter.fit(recording.landmarks[i])[0] for i in seen])
    rows = []
    angles = {name: own[seen] for name, own in own_angles(file, recording.side).items()}
    for name, own in angles.items():
        column = fitter.human.joint_names.index(name)
        is_defined = np.ones(len(seen), dtype=bool)
        if "abduction" in name:
            is_defined = angles[name.replace("abduction", "flexion")] < _BENT
        own = own[is_defined]
        wrapped = np.angle(np.exp(1j * (fitted[is_defined, column] - own)))
        difference = np.degrees(wrapped)
        rows.append(
            {
                "recording": recording.name,
                "joint": name,
                "range [deg]": float(np.degrees(np.ptp(own))),
                "offset [deg]": float(difference.mean()),
                "RMS [deg]": float(difference.std()),
            }
        )
    return rows


def pooled(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Pool joints: all, flexion of the fingers, abduction of the fingers, thumb."""
    kinds: dict[str, Callable[[str], bool]] = {
        "fingers": lambda joint: "thumb" not in joint,
        "flexion of the fingers": lambda joint: (
            "flexion" in joint and "thumb" not in joint
        ),
        "abduction of the fingers": lambda joint: "abduction" in joint,
        "thumb MCP and IP (see above)": lambda joint: "thumb" in joint,
    }
    return [
        {
            "joints": kind,
            "RMS [deg]": float(
                np.sqrt(
                    np.mean(
                        [row["RMS [deg]"] ** 2 for row in rows if belongs(row["joint"])]
                    )
                )
            ),
        }
        for kind, belongs in kinds.items()
    ]


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw the RMS difference of every joint."""
    import matplotlib.pyplot as plt

    joints = [
        name
        for name in load_hand("human").joint_names
        if name in {r["joint"] for r in rows}
    ]
    figure, axis = plt.subplots(figsize=(8, 4))
    for k, recording in enumerate(dict.fromkeys(row["recording"] for row in rows)):
        values = {
            row["joint"]: row["RMS [deg]"]
            for row in rows
            if row["recording"] == recording
        }
        places = np.arange(len(joints)) + 0.4 * (k - 0.5)
        axis.bar(places, [values[j] for j in joints], 0.38, label=recording)
    axis.axhline(5.0, color="#222831", linewidth=0.8)
    axis.set_xticks(np.arange(len(joints)), joints, rotation=60, ha="right")
    axis.set_title("Fitted angles against the tracker's own, RMS [deg]")
    axis.legend()
    figure.tight_layout()
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "Time and accuracy of the fit of joint angles to landmarks."
    )
    arguments = common.parse_arguments(parser)
    files = common.find_recordings(arguments.recordings)
    count = 60 if arguments.quick else None
    to_stderr = arguments.json == "-"
    times, angles = [], []
    with common.progress("fitting", 2 * len(files)) as advance:
        for file in files:
            times.append(measure_time(file, count))
            advance()
            angles += compare_angles(file)
            advance()
    common.print_table("Fit of one sample, CPU time", times, to_stderr=to_stderr)
    summary = pooled(angles) if angles else []
    if angles:
        common.print_table(
            "Fitted angles against the tracker's own", angles, to_stderr=to_stderr
        )
        common.print_table("Pooled", summary, to_stderr=to_stderr)
    results = {"times": times, "angles": angles, "pooled": summary}
    common.write_json(arguments.json, "fit", results)
    common.save_picture(arguments.picture, lambda: draw(angles))


if __name__ == "__main__":
    main()
