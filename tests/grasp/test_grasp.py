"""Statics of grasps against the toolbox's numbers and the equations, and contacts on hands."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from experiment_variants import moved_grasp
from grasp_cases import coupled_hand
from hypothesis import given
from hypothesis import strategies as st
from section_four.contacts import Contact, Grasp
from section_four.cube import REFERENCE_HANDS, reference_grasp
from section_four.statics import QuasiStatic, grasp_matrix, quasistatic
from strategies import generators, poses

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.se3 import transform_points

STIFFNESS = {
    "contact_stiffness": 800.0,
    "joint_stiffness": 1.5,
    "synergy_stiffness": 4.0,
}
CASES = range(3)


@pytest.fixture(scope="module")
def figures(load_data: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    return load_data("quasistatic")


def respond(grasp: Grasp, synergies: np.ndarray, **stiffness: Any) -> QuasiStatic:
    return quasistatic(grasp.jacobian, grasp.matrix, synergies, **stiffness)


@dataclasses.dataclass
class Problem:
    """Draw a grasp: J, G, S and the three stiffnesses as matrices."""

    J: np.ndarray
    G: np.ndarray
    S: np.ndarray
    K_c: np.ndarray
    K_q: np.ndarray
    K_z: np.ndarray

    def solve(self) -> Any:
        return quasistatic(
            self.J,
            self.G,
            self.S,
            contact_stiffness=self.K_c,
            joint_stiffness=self.K_q,
            synergy_stiffness=self.K_z,
        )


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    generator = draw(generators)
    contacts, joints = draw(st.integers(3, 8)), draw(st.integers(1, 20))
    synergies = draw(st.integers(1, min(joints, 5)))

    def stiffness(size: int) -> np.ndarray:
        root = generator.normal(size=(size, size))
        return root @ root.T + size * np.eye(size)

    return Problem(
        J=generator.normal(size=(3 * contacts, joints)),
        G=grasp_matrix(generator.normal(size=(contacts, 3)), generator.normal(size=3)),
        S=generator.normal(size=(joints, synergies)),
        K_c=stiffness(3 * contacts),
        K_q=stiffness(joints),
        K_z=stiffness(synergies),
    )


def close_to(expected: Any, relative: float) -> Any:
    """Approximate relative to the largest entry, because single entries may be rounding errors."""
    expected = np.asarray(expected)
    return pytest.approx(
        expected, rel=0.0, abs=relative * max(np.abs(expected).max(), 1e-300)
    )


# Statics against the toolbox


@pytest.mark.parametrize("case", CASES)
def test_quasistatic_is_the_toolbox_one(figures: dict[str, Any], case: int) -> None:
    expected = figures["cases"][case]
    stiffness = {
        "contact_stiffness": expected["Kc"],
        "joint_stiffness": expected["Kq"],
        "synergy_stiffness": expected["Kz"],
    }
    answer = quasistatic(figures["J"], figures["G"], figures["S"], **stiffness)
    for response in expected["responses"]:
        column = response["synergy"] - 1
        assert answer.object_motion[:, column] == close_to(response["delta_u"], 1e-11)
        assert answer.contact_forces[:, column] == close_to(
            np.ravel(response["delta_lambda"]), 1e-11
        )
        assert answer.joint_motion[:, column] == close_to(response["delta_q"], 1e-11)
        assert answer.joint_torques[:, column] == close_to(response["delta_tau"], 1e-11)
        assert answer.synergy_motion[:, column] == close_to(response["delta_z"], 1e-11)


@pytest.mark.parametrize("case", CASES)
def test_our_own_hand_in_metres_answers_as_the_toolbox_hand_in_millimetres(
    figures: dict[str, Any], case: int
) -> None:
    expected = figures["cases"][case]
    # A force in N and lengths in m: N/mm is 1000 N/m, and N mm/rad is 1/1000 N m/rad.
    answer = respond(
        reference_grasp("human").grasp,
        load_synergies().matrix[:, :3],
        contact_stiffness=1e3 * expected["Kc"],
        joint_stiffness=1e-3 * expected["Kq"],
        synergy_stiffness=1e-3 * expected["Kz"],
    )
    for response in expected["responses"]:
        column = response["synergy"] - 1
        in_millimetres = answer.object_motion[:, column] * [
            1e3,
            1e3,
            1e3,
            1.0,
            1.0,
            1.0,
        ]
        assert in_millimetres == close_to(response["delta_u"], 1e-9)
        assert answer.contact_forces[:, column] == close_to(
            np.ravel(response["delta_lambda"]), 1e-9
        )
        assert answer.joint_motion[:, column] == close_to(response["delta_q"], 1e-9)


def test_jacobian_and_grasp_matrix_are_the_toolbox_ones(
    figures: dict[str, Any],
) -> None:
    grasp = reference_grasp("human").grasp
    assert 1e3 * grasp.jacobian == close_to(figures["J"], 1e-12)
    scale = np.array([[1.0], [1.0], [1.0], [1e3], [1e3], [1e3]])
    assert scale * grasp.matrix == close_to(figures["G"], 1e-12)


# Statics against their equations


@given(problems())
def test_solution_satisfies_every_equation_of_balance(problem: Problem) -> None:
    answer, k = problem.solve(), problem
    dl, dtau, dq, dz, du = (
        answer.contact_forces,
        answer.joint_torques,
        answer.joint_motion,
        answer.synergy_motion,
        answer.object_motion,
    )
    size = 1e-9 * max(1.0, np.abs(dl).max()) * np.linalg.cond(problem.G)
    np.testing.assert_allclose(k.G @ dl, 0.0, atol=size)
    np.testing.assert_allclose(k.J.T @ dl, dtau, atol=size)
    np.testing.assert_allclose(k.K_c @ (k.J @ dq - k.G.T @ du), dl, atol=size)
    np.testing.assert_allclose(k.K_q @ (k.S @ dz - dq), dtau, atol=size)
    np.testing.assert_allclose(
        k.K_z @ (np.eye(k.S.shape[1]) - dz), k.S.T @ dtau, atol=size
    )


@given(problems())
def test_solution_is_that_of_all_equations_stacked(problem: Problem) -> None:
    k, answer = problem, problem.solve()
    n_l, n_q = k.J.shape
    n_z = k.S.shape[1]
    # Unknowns du, dl, dq, dz; dtau = J^T dl.
    stacked = np.block(
        [
            [np.zeros((6, 6)), k.G, np.zeros((6, n_q)), np.zeros((6, n_z))],
            [k.K_c @ k.G.T, np.eye(n_l), -k.K_c @ k.J, np.zeros((n_l, n_z))],
            [np.zeros((n_q, 6)), k.J.T, k.K_q, -k.K_q @ k.S],
            [np.zeros((n_z, 6)), k.S.T @ k.J.T, np.zeros((n_z, n_q)), k.K_z],
        ]
    )
    known = np.vstack([np.zeros((6 + n_l + n_q, n_z)), k.K_z])
    expected = np.linalg.solve(stacked, known)
    found = np.vstack(
        [
            answer.object_motion,
            answer.contact_forces,
            answer.joint_motion,
            answer.synergy_motion,
        ]
    )
    np.testing.assert_allclose(
        found,
        expected,
        atol=1e-8 * np.abs(expected).max() * max(1.0, np.linalg.cond(k.G) / 100.0),
    )


@given(problems())
def test_rigid_joints_and_synergies_move_as_told(problem: Problem) -> None:
    answer = quasistatic(
        problem.J,
        problem.G,
        problem.S,
        contact_stiffness=problem.K_c,
        joint_stiffness=np.inf,
        synergy_stiffness=np.inf,
    )
    np.testing.assert_array_equal(answer.joint_motion, problem.S)
    np.testing.assert_array_equal(answer.synergy_motion, np.eye(problem.S.shape[1]))


def test_stiff_springs_approach_rigid_ones() -> None:
    grasp, S = reference_grasp("human").grasp, load_synergies().matrix[:, :3]
    rigid = respond(
        grasp,
        S,
        contact_stiffness=800.0,
        joint_stiffness=np.inf,
        synergy_stiffness=np.inf,
    )
    stiff = respond(
        grasp, S, contact_stiffness=800.0, joint_stiffness=1e9, synergy_stiffness=1e9
    )
    assert stiff.object_motion == close_to(rigid.object_motion, 1e-6)
    assert stiff.contact_forces == close_to(rigid.contact_forces, 1e-6)


def test_stiff_contacts_stick_to_the_object() -> None:
    grasp = reference_grasp("three_finger").grasp
    answer = respond(
        grasp,
        np.eye(8)[:, :3],
        contact_stiffness=1e12,
        joint_stiffness=1.0,
        synergy_stiffness=np.inf,
    )
    hand, cube = (
        grasp.jacobian @ answer.joint_motion,
        grasp.matrix.T @ answer.object_motion,
    )
    # The distance is force over stiffness: forces are below 1 N m over 50 mm here.
    np.testing.assert_allclose(hand, cube, atol=1e-10)
    assert np.abs(cube).max() > 1e-3


@given(generators)
def test_a_synergy_that_carries_the_object_along_changes_no_force(
    generator: np.random.Generator,
) -> None:
    G = grasp_matrix(generator.normal(size=(4, 3)), np.zeros(3))
    J = generator.normal(size=(12, 15))
    twist = generator.normal(size=6)
    S = np.linalg.lstsq(J, G.T @ twist, rcond=None)[0][:, None]
    answer = quasistatic(J, G, S, **STIFFNESS)
    # A random J or G may be nearly singular, which loses digits.
    rounding = 1e-12 * np.linalg.cond(J) * np.linalg.cond(G) ** 2
    np.testing.assert_allclose(
        answer.object_motion[:, 0], twist, atol=rounding * np.abs(S).max()
    )
    np.testing.assert_allclose(
        answer.contact_forces, 0.0, atol=800.0 * rounding * np.abs(S).max()
    )


@pytest.mark.slow
@given(poses)
def test_moving_hand_and_object_together_turns_the_answer_and_nothing_else(
    pose: np.ndarray,
) -> None:
    grasp, S = reference_grasp("human").grasp, load_synergies().matrix[:, :2]
    here, there = (
        respond(grasp, S, **STIFFNESS),
        respond(moved_grasp(grasp, pose), S, **STIFFNESS),
    )
    R = pose[:3, :3]
    assert there.object_motion == close_to(
        np.kron(np.eye(2), R) @ here.object_motion, 1e-9
    )
    assert there.contact_forces == close_to(
        np.kron(np.eye(7), R) @ here.contact_forces, 1e-9
    )
    assert there.joint_motion == close_to(here.joint_motion, 1e-9)


@pytest.mark.parametrize(
    "name", ["contact_stiffness", "joint_stiffness", "synergy_stiffness"]
)
def test_a_number_is_that_number_times_the_identity(name: str) -> None:
    grasp, S = reference_grasp("human").grasp, load_synergies().matrix[:, :3]
    size = {"contact_stiffness": 21, "joint_stiffness": 20, "synergy_stiffness": 3}[
        name
    ]
    as_matrix = respond(grasp, S, **{**STIFFNESS, name: STIFFNESS[name] * np.eye(size)})
    assert as_matrix.object_motion == close_to(
        respond(grasp, S, **STIFFNESS).object_motion, 1e-12
    )


# Inputs that the statics reject


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"contact_stiffness": 0.0}, "contact_stiffness"),
        ({"joint_stiffness": -1.0}, "joint_stiffness"),
        ({"synergy_stiffness": np.nan}, "synergy_stiffness"),
        ({"joint_stiffness": np.eye(3)}, "joint_stiffness"),
        ({"joint_stiffness": np.eye(20) + np.eye(20, k=1)}, "symmetric"),
        ({"joint_stiffness": -np.eye(20)}, "positive definite"),
        ({"synergies": np.ones((19, 2))}, "synergies"),
        ({"jacobian": np.ones((20, 20))}, "grasp_matrix"),
        ({"grasp_matrix": "G"}, "grasp_matrix"),
        (
            {
                "contact_stiffness": np.inf,
                "joint_stiffness": np.inf,
                "synergy_stiffness": np.inf,
            },
            "rigid",
        ),
        # 21 contact forces on 20 joints: one combination loads no joint and is undetermined.
        ({"contact_stiffness": np.inf}, "rigid"),
    ],
)
def test_quasistatic_refuses(
    figures: dict[str, Any], change: dict[str, Any], what: str
) -> None:
    arguments = {
        "jacobian": figures["J"],
        "grasp_matrix": figures["G"],
        "synergies": figures["S"],
        **STIFFNESS,
        **change,
    }
    with pytest.raises(InvalidInputError, match=what):
        quasistatic(**arguments)


@pytest.mark.parametrize(
    "points",
    [
        [[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]],
        [[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [5.0, 5.0, 5.0]],
    ],
)
def test_contacts_on_one_line_do_not_hold_an_object(points: list[list[float]]) -> None:
    G = grasp_matrix(points, np.array([0.3, 0.0, 0.0]))
    with pytest.raises(InvalidInputError, match="not on one line"):
        quasistatic(np.ones((G.shape[1], 4)), G, np.eye(4), **STIFFNESS)


# Contacts on hands


@given(generators, st.integers(1, 9))
def test_grasp_matrix_adds_up_forces_and_their_torques(
    generator: np.random.Generator, count: int
) -> None:
    points, forces, centre = (
        generator.normal(size=(count, 3)),
        generator.normal(size=(count, 3)),
        generator.normal(size=3),
    )
    wrench = grasp_matrix(points, centre) @ forces.ravel()
    np.testing.assert_allclose(wrench[:3], forces.sum(axis=0), atol=1e-13)
    np.testing.assert_allclose(
        wrench[3:], np.cross(points - centre, forces).sum(axis=0), atol=1e-12
    )


@pytest.mark.parametrize("name", [*REFERENCE_HANDS, "coupled"])
def test_contact_jacobian_is_the_derivative_of_the_contacts(name: str) -> None:
    grasp = reference_grasp("human" if name == "human" else "three_finger").grasp
    if name == "coupled":
        hand = coupled_hand()
        grasp = dataclasses.replace(grasp, hand=hand, q=hand.rest)
    step, q = 1e-6, grasp.q
    assert grasp.jacobian.shape == (3 * len(grasp.contacts), len(q))
    for joint, column in enumerate(grasp.jacobian.T):
        dq = step * np.eye(len(q))[joint]
        ahead, behind = (
            dataclasses.replace(grasp, q=q + s * dq).points for s in (1.0, -1.0)
        )
        # Central differences are good to step^2 and to rounding over step: 1e-9 here.
        np.testing.assert_allclose(
            column, (ahead - behind).ravel() / (2.0 * step), atol=1e-9
        )
    assert [point.finger for point in grasp.contact_hand.reference_points] == [
        contact.finger for contact in grasp.contacts
    ]


def test_a_contact_normal_is_made_a_unit_vector() -> None:
    assert Contact("palm", (0.0, 0.0, 0.0), (0.0, 3.0, 4.0)).normal == (0.0, 0.6, 0.8)
    with pytest.raises(InvalidInputError, match="normal"):
        Contact("palm", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_a_grasp_refuses_links_and_joints_that_the_hand_does_not_have() -> None:
    hand = load_hand("three_finger")
    with pytest.raises(InvalidInputError, match="no link 'tail'"):
        Grasp(
            hand,
            hand.rest,
            np.eye(4),
            (Contact("tail", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),),
        )
    with pytest.raises(
        InvalidInputError, match=r"q: .* shape \(8,\), got shape \(5,\)"
    ):
        Grasp(hand, np.zeros(5), np.eye(4), ())


def test_the_contacts_of_a_fixed_hand_are_on_its_links() -> None:
    hand = load_hand("three_finger", mount="fixed")
    grasp = Grasp(
        hand,
        hand.rest,
        np.eye(4),
        (Contact("finger1_distal", (0.05, 0.0, 0.0), (0.0, 1.0, 0.0)),),
    )
    np.testing.assert_allclose(
        grasp.points,
        transform_points(
            hand.link_poses(["finger1_distal"], hand.rest)[0], np.array([[0.05, 0, 0]])
        ),
    )
