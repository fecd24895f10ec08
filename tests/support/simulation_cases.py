"""Grasps and hands that the tests of the simulation share."""

from __future__ import annotations

from functools import cache

from grasp_planning import plan_grasps
from section_four.contacts import Grasp

from handmap_qp import load_hand
from handmap_qp.mapping.objects import Box

CUBE = Box((0.05, 0.05, 0.05))


@cache
def cube_grasp() -> Grasp:
    """The best of a few planned grasps of the paper's cube."""
    return plan_grasps(load_hand("three_finger"), CUBE, samples=20)[0].grasp
