"""Weights and settings of the QP as the core has them; see `handmap/ik.hpp`."""

from __future__ import annotations

from .encoding import Model, Vector


class IkModel(Model, frozen=True, kw_only=True):
    """What moves a hand to its targets; `ik.options.IkOptions` says what each field does.

    Attributes:
        point_costs: Cost of each reference point's error [cost]/[m], shape (m,).
        wrist_position_cost: Cost of the wrist's position [cost]/[m].
        wrist_orientation_cost: Cost of its orientation [cost]/[rad].
        damping: As of `IkOptions`.
        error_damping: Likewise.
        rest_weight: Likewise.
        speed_weight: Likewise.
        acceleration_weight: Likewise.
        max_iterations: Likewise.
        step_tolerance: Likewise.
        point_tolerance: Likewise.
        points_follow_wrist: Likewise.
        takes_detours: Likewise.
    """

    point_costs: Vector
    wrist_position_cost: float
    wrist_orientation_cost: float
    damping: float
    error_damping: float
    rest_weight: float
    speed_weight: float
    acceleration_weight: float
    max_iterations: int
    step_tolerance: float
    point_tolerance: float
    points_follow_wrist: bool
    takes_detours: bool
