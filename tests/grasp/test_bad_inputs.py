"""Invalid arguments of grasp functions raise an `InvalidInputError` that names the argument."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from grasp_closing import (
    HandCloser,
    Preshape,
    default_preshape,
    palm_centre,
)
from grasp_measures import cone_wrenches, ferrari_canny, grasp_quality
from grasp_planning import plan_grasps
from section_four.contacts import Contact, Grasp
from section_four.cube import reference_grasp
from section_four.statics import grasp_matrix, quasistatic

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.library import load_hand
from handmap_qp.mapping.objects import Box, Cylinder, Sphere

HAND = load_hand("three_finger")
FIXED = load_hand("three_finger", mount="fixed")
REFERENCE = reference_grasp("three_finger").grasp
CONTACT = Contact("palm", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
BALL = Sphere(0.03)
START, DIRECTION = default_preshape(HAND).start, default_preshape(HAND).direction


def grasp(**changes: Any) -> Grasp:
    arguments: dict[str, Any] = {
        "hand": HAND,
        "q": HAND.rest,
        "object_pose": np.eye(4),
        "contacts": (CONTACT,),
    }
    return Grasp(**{**arguments, **changes})


def respond(**changes: Any) -> Any:
    arguments: dict[str, Any] = {
        "jacobian": REFERENCE.jacobian,
        "grasp_matrix": REFERENCE.matrix,
        "synergies": np.eye(8)[:, :2],
        "contact_stiffness": 800.0,
        "joint_stiffness": 1.5,
        "synergy_stiffness": 4.0,
    }
    return quasistatic(**{**arguments, **changes})


def closer(**changes: Any) -> HandCloser:
    arguments: dict[str, Any] = {"hand": HAND, "shape": BALL}
    return HandCloser(**{**arguments, **changes})


def preshaped(start: Any = START, direction: Any = DIRECTION) -> HandCloser:
    return closer(preshape=Preshape(start, direction, 0.02))


# A call, and the argument at fault.
BAD_CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "box of words": (lambda: Box("big"), "size"),  # ty: ignore[invalid-argument-type]
    "box of two sides": (lambda: Box((1.0, 2.0)), "size"),  # ty: ignore[invalid-argument-type]
    "box without height": (lambda: Box((1.0, 2.0, 0.0)), "size"),
    "box of NaN": (lambda: Box((1.0, 2.0, np.nan)), "size"),
    "sphere of words": (lambda: Sphere("r"), "radius"),  # ty: ignore[invalid-argument-type]
    "negative sphere": (lambda: Sphere(-1.0), "radius"),
    "sphere of None": (lambda: Sphere(None), "radius"),  # ty: ignore[invalid-argument-type]
    "cylinder without length": (lambda: Cylinder(1.0, 0.0), "length"),
    "infinite cylinder": (lambda: Cylinder(np.inf, 1.0), "radius"),
    "contact of words": (lambda: Contact("palm", "abc", (0, 0, 1)), "xyz"),  # ty: ignore[invalid-argument-type]
    "contact of two numbers": (lambda: Contact("palm", (0, 0), (0, 0, 1)), "xyz"),  # ty: ignore[invalid-argument-type]
    "normal of words": (lambda: Contact("palm", (0, 0, 0), "up"), "normal"),  # ty: ignore[invalid-argument-type]
    "zero normal": (lambda: Contact("palm", (0, 0, 0), (0, 0, 0)), "normal"),
    "infinite normal": (lambda: Contact("palm", (0, 0, 0), (0, 0, np.inf)), "normal"),
    "grasp with q of words": (lambda: grasp(q=["a"] * 8), "q"),
    "grasp with q too short": (lambda: grasp(q=np.zeros(5)), "q"),
    "grasp with NaN": (lambda: grasp(q=np.full(8, np.nan)), "q"),
    "object pose of words": (lambda: grasp(object_pose="here"), "object_pose"),
    "object pose that mirrors": (
        lambda: grasp(object_pose=np.diag([1.0, 1.0, -1.0, 1.0])),
        "object_pose",
    ),
    "wrist pose of words": (lambda: grasp(wrist_pose="here"), "wrist_pose"),
    "contacts of numbers": (lambda: grasp(contacts=[1.0]), "contacts"),
    "contacts None": (lambda: grasp(contacts=None), "contacts"),
    "no contact": (lambda: grasp(contacts=()).jacobian, "contacts"),
    "points of words": (lambda: grasp_matrix([["a", "b", "c"]], np.zeros(3)), "points"),
    "points of two columns": (
        lambda: grasp_matrix(np.zeros((4, 2)), np.zeros(3)),
        "points",
    ),
    "centre of words": (lambda: grasp_matrix(np.zeros((4, 3)), "abc"), "centre"),
    "ragged Jacobian": (lambda: respond(jacobian=[[1.0], [1.0, 2.0]]), "jacobian"),
    "Jacobian of NaN": (lambda: respond(jacobian=np.full((9, 8), np.nan)), "jacobian"),
    "grasp matrix of words": (lambda: respond(grasp_matrix="G"), "grasp_matrix"),
    "synergies of other joints": (lambda: respond(synergies=np.eye(5)), "synergies"),
    "no synergy": (lambda: respond(synergies=np.zeros((8, 0))), "synergies"),
    "stiffness of words": (
        lambda: respond(contact_stiffness="hard"),
        "contact_stiffness",
    ),
    "stiffness None": (lambda: respond(joint_stiffness=None), "joint_stiffness"),
    "negative stiffness": (lambda: respond(joint_stiffness=-1.0), "joint_stiffness"),
    "shape of words": (lambda: closer(shape="ball"), "shape"),
    "step of words": (lambda: closer(step="fine"), "step"),
    "no step": (lambda: closer(step=0.0), "step"),
    "margin of NaN": (lambda: closer(margin=np.nan), "margin"),
    "closer's pose of words": (lambda: closer(object_pose="there"), "object_pose"),
    "start of words": (lambda: preshaped(start=["a"] * 8), "preshape.start"),
    "start outside limits": (lambda: preshaped(start=START + 99.0), "preshape.start"),
    "direction of words": (lambda: preshaped(direction="close"), "preshape.direction"),
    "nothing closes": (lambda: preshaped(direction=np.zeros(8)), "preshape.direction"),
    "no palm centre": (
        lambda: palm_centre(HAND, Preshape(START, np.zeros(8), 0.0)),
        "preshape.direction",
    ),
    "closing with a wrist of words": (lambda: closer().close("w"), "wrist_pose"),  # ty: ignore[invalid-argument-type]
    "closing inside the object": (
        lambda: closer(shape=Sphere(1.0)).close(),
        "wrist_pose",
    ),
    "planning with a fixed wrist": (lambda: plan_grasps(FIXED, BALL), "hand"),
    "samples of words": (lambda: plan_grasps(HAND, BALL, samples="many"), "samples"),  # ty: ignore[invalid-argument-type]
    "samples of a half": (lambda: plan_grasps(HAND, BALL, samples=0.5), "samples"),  # ty: ignore[invalid-argument-type]
    "no samples": (lambda: plan_grasps(HAND, BALL, samples=0), "samples"),
    "negative seed": (lambda: plan_grasps(HAND, BALL, seed=-1), "seed"),
    "seed of words": (lambda: plan_grasps(HAND, BALL, seed="s"), "seed"),  # ty: ignore[invalid-argument-type]
    "unknown quality": (lambda: plan_grasps(HAND, BALL, quality="best"), "quality"),
    "friction of words": (lambda: plan_grasps(HAND, BALL, friction="dry"), "friction"),  # ty: ignore[invalid-argument-type]
    "shape of a plan": (lambda: plan_grasps(HAND, 0.05), "shape"),  # ty: ignore[invalid-argument-type]
    "unknown measure": (lambda: grasp_quality(REFERENCE, "best"), "measure"),
    "measure that is a list": (lambda: grasp_quality(REFERENCE, ["gii"]), "measure"),  # ty: ignore[invalid-argument-type]
    "negative friction": (lambda: grasp_quality(REFERENCE, friction=-0.1), "friction"),
    "length of words": (lambda: grasp_quality(REFERENCE, length="mm"), "length"),  # ty: ignore[invalid-argument-type]
    "no length": (lambda: grasp_quality(REFERENCE, length=0.0), "length"),
    "wrench points of two columns": (
        lambda: cone_wrenches(np.zeros((3, 2)), np.zeros((3, 3)), 0.5),
        "points",
    ),
    "too few normals": (
        lambda: ferrari_canny(np.eye(3), np.eye(3)[:2], 0.5),
        "normals",
    ),
    "edges of words": (
        lambda: cone_wrenches(np.eye(3), np.eye(3), 0.5, edges="8"),  # ty: ignore[invalid-argument-type]
        "edges",
    ),
    "too few edges": (
        lambda: cone_wrenches(np.eye(3), np.eye(3), 0.5, edges=2),
        "edges",
    ),
    "hand without a reference grasp": (
        lambda: reference_grasp("allegro_right"),
        "hand",
    ),
    "reference grasp of a list": (lambda: reference_grasp(["human"]), "hand"),  # ty: ignore[invalid-argument-type]
}


@pytest.mark.parametrize(("call", "argument"), BAD_CALLS.values(), ids=BAD_CALLS.keys())
def test_a_bad_argument_is_named(call: Callable[[], Any], argument: str) -> None:
    with pytest.raises((InvalidInputError, InvalidOptionsError)) as caught:
        call()
    assert str(caught.value).startswith(f"{argument}: ")
    # The sizes of a shape are its options.
    named = getattr(caught.value, "argument", None) or caught.value.option
    assert named == argument


def test_whole_numbers_of_numpy_are_taken() -> None:
    whole: Any = {"samples": np.int64(1), "seed": np.int32(3)}
    planned = plan_grasps(HAND, Box((0.05, 0.05, 0.05)), **whole)
    assert len(planned) == 1
