"""The commands `handmap hands init` and `handmap hands check`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from handmap_qp.hands.spec import Side
from handmap_qp.tables import print_rows


@dataclass(frozen=True)
class HandsInit:
    """Find a hand in a URDF and write its hand.yaml.

    Palm, fingers, thumb, fingertips, side and a rest posture are found from the kinematics; each
    comes with how it was found and how sure that is. Look at the result with `handmap hands check`.

    Examples: `handmap hands init my_hand.urdf`, or
    `handmap hands init humanoid.urdf --root left_wrist_link --side left --out left_hand/hand.yaml`.

    Attributes:
        urdf: The URDF.
        root: Link at which the hand, or the arm that ends in it, begins, in the URDF of a whole
            robot.
        base: Link that stands still: the joints between it and the hand then move the wrist. The
            hand floats if omitted.
        side: Side of the hand, where it shall not be found.
        thumb: A link or joint of the thumb, where it shall not be found.
        name: Name of the hand; that of the robot if omitted.
        out: File to write.
        overwrite: Replace the file if it exists.
        json: Print one JSON object instead of a table.
    """

    urdf: tyro.conf.Positional[Path]
    root: str | None = None
    base: str | None = None
    side: Side | None = None
    thumb: str | None = None
    name: str | None = None
    out: Path = Path("hand.yaml")
    overwrite: bool = False
    json: bool = False

    def run(self) -> None:
        """Find, write, load what was written, and say how each part was found."""
        from handmap_qp.hands.library import load_hand
        from handmap_qp.onboarding.detect import detect
        from handmap_qp.onboarding.write import write_hand

        found = detect(
            self.urdf,
            root=self.root,
            base=self.base,
            side=self.side,
            thumb=self.thumb,
            name=self.name,
        )
        write_hand(found, self.out, overwrite=self.overwrite)
        hand = load_hand(self.out)
        rows = [
            {"what": c.what, "found": c.answer, "sure": c.sureness, "how": c.how}
            for c in found.clues
        ]
        if self.json:
            document: dict[str, Any] = {
                "name": hand.name,
                "out": str(self.out),
                "found": rows,
                "notes": list(found.notes),
            }
            print(json.dumps(document))
            return
        followers = hand.all_joint_roles.count("follower")
        print_rows(f"{hand.name}: {len(hand.joint_names)} joints, {followers} followers", rows)
        for note in found.notes:
            print(f"note: {note}")
        print(f"wrote {self.out}; look at it with: handmap hands check {self.out}")


@dataclass(frozen=True)
class HandsCheck:
    """Check a hand.yaml against its URDF and draw the hand with its labels.

    Frames, limits, mimic rules, reference points and weights; how far each finger reaches and how
    well it moves; the hand's size beside a person's; self-collisions at rest; and which human
    motions will be out of reach. Findings say what to change.

    Attributes:
        hand: Path of a hand.yaml, or name of a hand of the package.
        picture: Picture to draw; beside the hand.yaml if omitted, none for a hand of the package.
        motion: Try a standard motion of the human hand on it (a second or two).
        json: Print one JSON object instead of tables.
    """

    hand: tyro.conf.Positional[str]
    picture: Path | None = None
    motion: bool = True
    json: bool = False

    def run(self) -> None:
        """Check, draw and print."""
        from handmap_qp.onboarding.check import check_hand
        from handmap_qp.onboarding.picture import draw_hand, picture_path

        report = check_hand(self.hand, has_motion=self.motion)
        picture = self.picture or picture_path(self.hand)
        if picture is not None and report.hand is not None:
            draw_hand(report.hand, picture)
        if self.json:
            print(json.dumps(report.document(picture), allow_nan=False))
        else:
            for title, rows in report.tables().items():
                print_rows(title, rows)
            if picture is not None and report.hand is not None:
                print(f"wrote {picture}")
        report.raise_if_unusable()
