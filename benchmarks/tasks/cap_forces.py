"""How a hand turns the cap of `handmap score --tasks cap`: turns, forces and friction.

    python benchmarks cap_forces --methods teleoperation dexi-dexpilot --seed 8800 --attempts 10

Each row is the mean over all grips of a mapping while the person turns the wrist: by how much the
line of the pads and the cap turn, and of thumb and fingers the normal force, the moment about the
cap's axis (positive in the sense of the turn), the vertical part of the friction, and the share of
the friction that the normal force allows which is used. The cap rubs with 50 N mm.

Heights are those of the middle between the pads' surfaces, over that of the cap's middle; its edges
are at 10 mm. With `--raise 12` the person takes a place 12 mm higher for the cap's middle.
"""

from __future__ import annotations

# isort: split
import argparse
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from handmap_score.tasks.fixtures import moved
from handmap_score.tasks.mapping import Mapping, make_mapping
from handmap_score.tasks.person import Phase
from handmap_score.tasks.task import Scene
from handmap_score.tasks.touch import fingers_of_links
from handmap_score.tasks.turning import CAP, CapTask, Turner

from handmap_qp.apps.simulation.model import OBJECT
from handmap_qp.apps.tables import Row, print_result
from handmap_qp.hands import THUMB, load_hand
from handmap_qp.se3 import Array


class Press(NamedTuple):
    """What thumb or fingers do to the cap at one instant.

    Attributes:
        normal: Normal force [N].
        moment: Moment about the cap's axis [N mm].
        vertical: Vertical part of the friction on the cap [N].
        friction: Size of the friction [N].
    """

    normal: float = 0.0
    moment: float = 0.0
    vertical: float = 0.0
    friction: float = 0.0

    def plus(self, other: Press) -> Press:
        """Return the sum of two contacts of one side."""
        return Press(*np.add(self, other).tolist())


class Sample(NamedTuple):
    """One instant of a turning.

    Attributes:
        direction: Direction of the line of the pads about the vertical [rad].
        cap: Angle of the cap [rad].
        thumb: Press of the thumb.
        fingers: Press of all other links.
        height: Height of the middle between the pads over the cap's [m].
    """

    direction: float
    cap: float
    thumb: Press
    fingers: Press
    height: float


class RaisedCap(CapTask):
    """A cap whose middle the person sees higher than it is."""

    by = 0.0
    """How much higher [m]."""

    def _faces(self, pose: Array) -> Array:
        return super()._faces(pose) + np.array([0.0, 0.0, self.by])


def contacts_of(task: CapTask) -> Iterator[tuple[str, Press]]:
    """Yield the link and the press of each contact of the hand with the cap."""
    model, data = task.model, task.data
    cap = model.geom(OBJECT).id
    wrench = np.zeros(6)
    for row, contact in enumerate(data.contact):
        if cap not in contact.geom or contact.efc_address < 0:
            continue
        mujoco.mj_contactForce(model, data, row, wrench)
        # Axes of the contact are rows; the first one points from the first shape to the second.
        sign = 1.0 if contact.geom[1] == cap else -1.0
        axes = contact.frame.reshape(3, 3)
        friction = sign * (wrench[1:3] @ axes[1:])
        force = friction + sign * wrench[0] * axes[0]
        moment = np.cross(contact.pos - data.geom_xpos[cap], force)[2]
        (other,) = contact.geom[contact.geom != cap]
        link = model.body(model.geom_bodyid[other]).name
        size = float(np.linalg.norm(friction))
        yield (
            link,
            Press(float(wrench[0]), 1e3 * float(moment), float(friction[2]), size),
        )


def sample_of(task: CapTask, scene: Scene) -> Sample:
    """Return how the cap is turned now."""
    owners = fingers_of_links(task.robot)
    thumb = fingers = Press()
    for link, press in contacts_of(task):
        if owners.get(link) == THUMB:
            thumb = thumb.plus(press)
        else:
            fingers = fingers.plus(press)
    pad, other = scene.points["pads"]
    x, y, _ = other - pad
    middle = task.data.geom_xpos[task.model.geom(OBJECT).id]
    height = float((pad + other)[2] / 2.0 - middle[2])
    return Sample(math.atan2(y, x), moved(task.data), thumb, fingers, height)


def turnings(
    task: CapTask, person: Turner, mapping: Mapping, seed: int
) -> Iterator[list[Sample]]:
    """Yield the samples of each grip of an attempt in which the person turns the wrist."""
    scene = task.reset(seed)
    person.reset(seed)
    mapping.reset()
    turning: list[Sample] = []
    held = 0
    for _ in range(round(task.time_limit / task.time_step)):
        hand = person.see(scene)
        scene = task.step(hand, mapping.map(hand, task.time_step))
        held = held + 1 if scene.signals.is_reached else 0
        if person.phase is Phase.USE:
            turning.append(sample_of(task, scene))
        elif turning:
            yield turning
            turning = []
        if held == task.hold or person.has_finished:
            break
    if turning:
        yield turning


def turns_of(samples: Sequence[Sample]) -> tuple[float, float]:
    """Return by how much the line of the pads and the cap turn in one grip [deg]."""
    first, *_, last = samples
    pads = np.unwrap([one.direction for one in samples])
    return math.degrees(pads[-1] - pads[0]), math.degrees(last.cap - first.cap)


def columns_of(side: str, presses: Sequence[Press], friction: float) -> Row:
    """Return the columns of thumb or fingers.

    Args:
        side: Whose they are.
        presses: At all instants.
        friction: Coefficient of friction.
    """
    sums: Array = np.mean(presses, axis=0)
    normal, moment, vertical, size = sums.tolist()
    return {
        f"{side} [N]": round(normal, 1),
        f"{side} [N mm]": round(moment),
        f"{side}, vertical [N]": round(vertical, 1),
        f"{side}, friction used": round(size / max(friction * normal, 1e-9), 2),
    }


def row_of(
    method: str, hand: str, first: int, attempts: int, raised: float = 0.0
) -> Row:
    """Return the row of a mapping.

    Args:
        method: Its name, as of `handmap score --tasks`.
        hand: The robot hand.
        first: Seed of the calibration and of the first attempt.
        attempts: Number of attempts.
        raised: How much higher than it is the person sees the cap [m].
    """
    robot = load_hand(hand)
    task = RaisedCap(robot)
    task.by = raised
    person = Turner(robot)
    mapping = make_mapping(method, person, robot, first)
    seeds = range(first, first + attempts)
    grips = [grip for seed in seeds for grip in turnings(task, person, mapping, seed)]
    pads, cap = np.mean([turns_of(grip) for grip in grips], axis=0).tolist()
    samples = [one for grip in grips for one in grip]
    friction = task.things[CAP].friction
    return {
        "mapping": method,
        "grips": len(grips),
        "pads turn [deg]": round(pads),
        "cap turns [deg]": round(cap),
        "height [mm]": round(1e3 * float(np.mean([one.height for one in samples])), 1),
        **columns_of("thumb", [one.thumb for one in samples], friction),
        **columns_of("fingers", [one.fingers for one in samples], friction),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hand", default="leap_right")
    parser.add_argument("--methods", nargs="+", default=["teleoperation", "picking"])
    parser.add_argument("--seed", type=int, default=8800)
    parser.add_argument("--attempts", type=int, default=10)
    parser.add_argument("--raise", type=float, default=0.0, dest="raised", help="[mm]")
    given = parser.parse_args()
    rows = [
        row_of(method, given.hand, given.seed, given.attempts, 1e-3 * given.raised)
        for method in given.methods
    ]
    print_result({}, {"Turning a cap": rows}, [], as_json=False)


if __name__ == "__main__":
    main()
