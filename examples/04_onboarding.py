"""Bring a robot hand into the package: from its URDF to a description that maps.

`handmap hands init` and `handmap hands check` do the same on the command line.

    python examples/04_onboarding.py [ROBOT.urdf]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from handmap_qp import HandMapper, check_hand, init_hands, load_hand
from handmap_qp.hands.sources import urdf_directory


def main(urdf: Path) -> None:
    """Write a description, check it, and close the hand with it."""
    with tempfile.TemporaryDirectory() as folder:
        result = init_hands(urdf, out=Path(folder) / "hand.yaml")
        for clue in result.hands[0].clues:
            print(f"{clue.what:14} {clue.certainty}: {clue.how}")
        report = check_hand(result.file)
        for finding in report.findings:
            print(f"{finding.level:8} {finding.key}: {finding.text}")
        assert report.is_usable

    human, robot = load_hand("human"), result.hands[0].hand
    mapper = HandMapper(human, robot, dt=1 / 60)
    shares = np.linspace(0.0, 0.8, 60)[:, None]
    postures = human.rest + shares * (human.upper_limits - human.rest)
    step = [mapper.map_step(q, np.eye(4)) for q in postures][-1]
    for name, angle in zip(robot.joint_names, step.command.q, strict=True):
        print(f"{name:20} {angle:6.2f} rad")


if __name__ == "__main__":
    given = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    main(given or urdf_directory() / "three_finger" / "hand.urdf")
