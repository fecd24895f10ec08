"""Compare converted MJCF files with MuJoCo: largest difference of any link's pose.

    python benchmarks/mjcf_kinematics.py FOLDER_OR_FILE [...]

Folders are searched for MJCF files. Files that MuJoCo refuses, or in which nothing moves, are
counted and named with the reason.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin

from handmap_qp.apps.tables import print_rows
from handmap_qp.errors import HandError
from handmap_qp.hands.mjcf import ConvertedMjcf, convert_mjcf
from handmap_qp.hands.sources import is_mjcf


def models(paths: list[str]) -> Iterator[Path]:
    """Yield all MJCF files among files and below folders."""
    for path in map(Path, paths):
        yield from filter(
            is_mjcf, sorted(path.rglob("*.xml")) if path.is_dir() else [path]
        )


def main(paths: list[str]) -> None:
    """Convert, compare and print a table."""
    rows, refused = [], []
    for file in models(paths):
        start = time.perf_counter()
        try:
            converted = convert_mjcf(file)
        except HandError as error:
            refused.append({"file": file.name, "reason": error.problem[:120]})
            continue
        rows.append(
            {
                "file": str(file)[-60:],
                "links": len(converted.links),
                "joints": len(converted.joints),
                "meshes": len(converted.meshes),
                "difference": f"{kinematics_difference(converted):.1e}",
                "seconds": round(time.perf_counter() - start, 2),
                "notes": len(converted.notes),
            }
        )
    print_rows(f"{len(rows)} files converted", rows)
    print_rows(f"{len(refused)} files refused", refused)


def kinematics_difference(
    converted: ConvertedMjcf, postures: int = 20, seed: int = 0
) -> float:
    """Return the largest difference of an entry of any link's pose from MuJoCo's; [m] of positions.

    Hinges and slides are at random positions, independent of couplings; balls are at rest.
    """
    model, random = converted.model, np.random.default_rng(seed)
    # MuJoCo has no speed limits, without which Pinocchio does not read a joint.
    text = converted.text.replace("<limit ", '<limit velocity="0" ')
    data, robot = mujoco.MjData(model), pin.buildModelFromXML(text)
    robot_data = robot.createData()
    worst = 0.0
    for _ in range(postures):
        data.qpos[:], turns = model.qpos0, np.zeros(robot.nv)
        for joint, name in converted.joints.items():
            position = random.uniform(-1.0, 1.0)
            data.qpos[model.jnt_qposadr[joint]] = position
            turns[robot.joints[robot.getJointId(name)].idx_v] = position
        mujoco.mj_kinematics(model, data)
        q = pin.integrate(robot, pin.neutral(robot), turns)
        pin.framesForwardKinematics(robot, robot_data, q)
        for body, link in converted.links.items():
            pose = robot_data.oMf[robot.getFrameId(link, pin.FrameType.BODY)]
            turned = pose.rotation - data.xmat[body].reshape(3, 3)
            moved = pose.translation - data.xpos[body]
            worst = max(worst, np.abs(turned).max(), np.abs(moved).max())
    return float(worst)


if __name__ == "__main__":
    main(sys.argv[1:])
