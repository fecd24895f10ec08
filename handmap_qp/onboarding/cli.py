"""The commands `handmap hands init` and `handmap hands check`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from handmap_qp.arguments import HandName
from handmap_qp.hands.spec import Side
from handmap_qp.tables import print_rows


def _optional(metavar: str, default: str) -> Any:
    """Describe an optional argument by a placeholder and its effect if omitted."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


@dataclass(frozen=True)
class HandsInit:
    """Find a hand in a URDF and write its description, hand.yaml.

    Finds palm, fingers, thumb, fingertips, side and a rest posture from the kinematics, and prints
    how each was found and how certain it is. Check the result with `handmap hands check`.

    Examples:
        handmap hands init my_hand.urdf
        handmap hands init humanoid.urdf --root left_wrist_link --out left/hand.yaml
        handmap hands init humanoid.urdf --root left_wrist_link --base torso_link

    Attributes:
        urdf: URDF of the hand or of a robot with a hand.
        root: Link at which the hand begins, in the URDF of a whole robot.
        base: Fixed link of the arm; the joints between it and the hand then move the wrist.
        side: Side of the hand.
        thumb: Name of a link or joint of the thumb.
        name: Name of the hand.
        out: File to write.
        overwrite: Replace the file if it exists.
        json: Print one JSON object instead of a table.
    """

    urdf: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="ROBOT.urdf")]]
    root: Annotated[str | None, _optional("LINK", "the root of the URDF")] = None
    base: Annotated[str | None, _optional("LINK", "the wrist floats")] = None
    side: Annotated[Side | None, _optional("{right,left}", "found")] = None
    thumb: Annotated[str | None, _optional("LINK", "found")] = None
    name: Annotated[str | None, _optional("NAME", "the robot's name")] = None
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.yaml")] = Path("hand.yaml")
    overwrite: bool = False
    json: bool = False

    def run(self) -> None:
        """Find the hand, write its description, load it, and print how each part was found."""
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
            {"what": c.what, "found": c.answer, "certainty": c.certainty, "how": c.how}
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
        print(f"wrote {self.out}; check it with: handmap hands check {self.out}")


@dataclass(frozen=True)
class HandsCheck:
    """Check a hand.yaml against its URDF, and draw the hand with its labels.

    Checks frames, limits, mimic rules, reference points and weights. Measures how far each finger
    reaches, the hand's size relative to a person's, self-collisions at rest, and which human
    postures are out of reach. Every finding says what to change.

    Examples:
        handmap hands check my_hand.yaml
        handmap hands check allegro_right --picture allegro.png

    Attributes:
        hand: Path of a hand.yaml, or name of a hand of the package.
        picture: Picture to draw, PNG, SVG or PDF.
        motion: Map a standard motion of a human hand to it (takes a second or two).
        json: Print one JSON object instead of tables.
    """

    hand: tyro.conf.Positional[HandName]
    picture: Annotated[
        Path | None, _optional("FILE", "beside the hand.yaml; none for a hand of the package")
    ] = None
    motion: bool = True
    json: bool = False

    def run(self) -> None:
        """Check the hand, draw it, and print the findings."""
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
