"""`RobotStep`: what a mapper of several hands makes of their samples."""

from __future__ import annotations

from operator import attrgetter

from msgspec import structs

from handmap_core.hands import Side
from .hand_request import AnyRequest
from .step import AnyStages, MapStep, SampleStep
from .targets import AnyPose


class RequestStep(SampleStep, frozen=True):
    """What one hand asks of the robot for a sample.

    Attributes:
        request: The request.
    """

    request: AnyRequest

    @property
    def pose(self) -> AnyPose:
        """The human hand that was mapped."""
        return self.request.pose


class RobotStep(MapStep, frozen=True, kw_only=True):
    """One step of a robot: that of one hand with the points of all, one after the other.

    `wrist` and its error are those of the first hand. It is held if all hands are, and has the rule
    of any that breaks one.

    Attributes:
        hands: The step of each hand by side, with its own points and wrist.
    """

    hands: dict[Side, MapStep]

    @property
    def arm_held_by(self) -> str:
        """What keeps the wrist of a hand off its target; see `MapStep.arm_held_by`."""
        causes = (step.arm_held_by for step in self.hands.values())
        return next(filter(None, causes), "")


def part_step(step: RequestStep, stages: AnyStages, duration: float) -> MapStep:
    """Return the step of a hand whose request the robot was moved for."""
    return MapStep(
        stages,
        out_of_range=step.out_of_range,
        duration=duration,
        verdict=step.verdict,
        confidence=step.confidence,
        is_gliding=step.is_gliding,
    )


def whole_step(
    hands: dict[Side, MapStep], stages: AnyStages, duration: float
) -> RobotStep:
    """Return the step of all hands."""
    steps = hands.values()
    verdicts = [step.verdict for step in steps if step.verdict]
    # That of a hand with a rule comes first.
    first = max(verdicts, key=attrgetter("rule"), default=None)
    is_held = all(step.is_held for step in steps)
    return RobotStep(
        stages,
        out_of_range=tuple(name for step in steps for name in step.out_of_range),
        duration=duration,
        verdict=first and structs.replace(first, is_held=is_held),
        confidence=min(step.confidence for step in steps),
        is_gliding=any(step.is_gliding for step in steps),
        hands=hands,
    )
