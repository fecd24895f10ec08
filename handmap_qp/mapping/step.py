"""Results of a mapper: one robot command, and one step with all its stages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import msgspec
import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.human.verdict import Finding, Rule, Verdict
from handmap_qp.ik.qp import IkResult, Status
from handmap_qp.mapping.method import Targets

StepStatus = Status | Literal["held", "gliding"]
"""Outcome of a step: that of the inverse kinematics, or that of the tracker's samples."""


class RobotCommand(msgspec.Struct, frozen=True, eq=False):
    """Command for a robot driver.

    Attributes:
        joint_names: Names of the joints, in the order of `q`.
        q: Joint angles [rad], shape (n,), inside their limits.
        wrist: Pose of the wrist frame in the robot's world, shape (4, 4).
    """

    joint_names: tuple[str, ...]
    q: np.ndarray
    wrist: np.ndarray


class MapStep(msgspec.Struct, frozen=True, eq=False):
    """One step of the mapping, stage by stage.

    Derived values are computed on access. Those of T raise InvalidOptionsError if the method has no
    T; `diagnostics` has the results of every method, by name.

    Attributes:
        command: The robot's next joint angles and wrist pose.
        human_points: Human reference points in the human's world (eq. 4) [m], shape (n_h, 3).
        human_wrist: Pose of the human's wrist there, given or fitted to landmarks, shape (4, 4);
            None if it is not known.
        asked: The method's targets and diagnostics.
        ik: Result of the inverse kinematics (in place of eq. 8).
        out_of_range: Names of human joints that were outside their limits, within the tolerance,
            and were used.
        duration: Wall time of the step [s].
        verdict: What the guard said about the sample; None for steps of joint angles or points,
            which no guard sees.
        confidence: The tracker's own confidence, from 0 to 1.
        is_gliding: Whether the robot is still on its way back to the human after a hold.
    """

    command: RobotCommand
    human_points: np.ndarray
    human_wrist: np.ndarray | None
    asked: Targets
    ik: IkResult
    out_of_range: tuple[str, ...]
    duration: float
    verdict: Verdict | None = None
    confidence: float = 1.0
    is_gliding: bool = False

    @property
    def is_held(self) -> bool:
        """Whether the sample was not followed, and the robot held its posture."""
        return self.verdict is not None and self.verdict.is_held

    @property
    def rule(self) -> Rule:
        """Name of what is wrong with the sample (`human.verdict.RULES`); empty if nothing."""
        return "" if self.verdict is None else self.verdict.rule

    @property
    def finding(self) -> Finding | None:
        """What the input is instead of what it says, with advice; None if it is plausible."""
        return None if self.verdict is None else self.verdict.finding

    @property
    def consistency(self) -> float:
        """RMS difference of bones and palm from the person's [m]; NaN if it was not measured."""
        return math.nan if self.verdict is None else self.verdict.consistency

    @property
    def diagnostics(self) -> Mapping[str, np.ndarray]:
        """Intermediate results of the method, by name; see `Diagnostics`."""
        return self.asked.diagnostics

    @property
    def motion(self) -> np.ndarray:
        """T from the reference configuration to now (eqs. 5-6), shape (4, 4)."""
        return self._named("motion")

    @property
    def motion_rigid(self) -> np.ndarray:
        """T_rb (eq. 2), shape (4, 4)."""
        return self._named("motion_rigid")

    @property
    def motion_deformation(self) -> np.ndarray:
        """T_def (eq. 2), after clamping and gain, shape (4, 4).

        With neither, `motion_deformation @ motion_rigid == motion`.
        """
        return self._named("motion_deformation")

    @property
    def residual_norms(self) -> np.ndarray:
        """Distance of each human point from where T takes it [m], shape (n_h,)."""
        return self._named("residual_norms")

    @property
    def stretches(self) -> np.ndarray:
        """Eigenvalues of the stretch U before clamping, shape (3,)."""
        return self._named("stretches")

    @property
    def is_clamped(self) -> bool:
        """True if a stretch was outside its allowed range; False for methods without T."""
        return "stretch_clamped" in self.asked.flags

    @property
    def targets(self) -> np.ndarray:
        """Targets of the robot's reference points (eq. 7) [m], shape (n_r, 3)."""
        return self.asked.points

    @property
    def wrist_target(self) -> np.ndarray:
        """Target pose of the robot's wrist, shape (4, 4)."""
        return self.asked.wrist

    @property
    def points(self) -> np.ndarray:
        """The robot's reference points after the step [m], shape (n_r, 3)."""
        return self.ik.points

    @property
    def point_error(self) -> np.ndarray:
        """Distance between targets and points [m], shape (n_r,)."""
        return np.linalg.norm(self.asked.points - self.ik.points, axis=1)

    @property
    def at_bound(self) -> np.ndarray:
        """True for joints at a position or speed limit, in the order of `command.q`, shape (n,)."""
        return self.ik.active[self.ik.joint_columns] != 0

    @property
    def status(self) -> StepStatus:
        """Outcome of the step.

        `held`: the sample made no sense (see `rule`), and the robot held its posture; `gliding`:
        the robot is on its way back to the human after a hold. Otherwise the outcome of the inverse
        kinematics (`IkResult.status`), so `converged` means that the sample made sense too.
        """
        if self.ik.status == "released":
            return "held" if self.is_held else "released"
        return "gliding" if self.is_gliding else self.ik.status

    @property
    def iterations(self) -> int:
        """QPs solved."""
        return self.ik.iterations

    def _named(self, name: str) -> np.ndarray:
        if name not in self.asked.diagnostics:
            raise InvalidOptionsError(
                option="method",
                problem=f"its diagnostics have no {name}",
                advice=f"there are {', '.join(self.asked.diagnostics) or 'none'}",
            )
        return self.asked.diagnostics[name]
