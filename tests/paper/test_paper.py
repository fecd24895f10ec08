"""The paper's experiment (Sec. IV): an earlier reproduction's numbers, and general properties."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from experiment_variants import (
    IK,
    FingerMode,
    Pivot,
    Variant,
    limit_excess,
    limited_hand,
    moved_scene,
)
from section_four.cube import reference_grasp
from section_four.experiment import (
    UNIT,
    Run,
    Scene,
    Setting,
    Stiffnesses,
    human_motion,
    in_hand_step,
    object_error,
    object_poses,
    paper_scene,
    rms,
    wrist_arc,
)
from section_four.figures import GAMMAS

from handmap_qp import HandMapper

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

SYNERGIES = (1, 2, 3)
MODELS = {"rigid": None, "quasi-static": UNIT}
METRE = np.array([1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Return the scene of the reference numbers."""
    return paper_scene("toolbox")


@pytest.fixture(scope="module")
def table(load_data: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    return load_data("section_four")


def agrees(found: float, expected: float) -> bool:
    """Assert equality within 2 % or 0.05 mm; `found` is in metres."""
    return abs(1e3 * found - expected) <= max(0.02 * expected, 0.05)


@cache
def run(
    scene: Scene, synergy: int, variant: Variant | None = None, **choices: Any
) -> Run:
    """Run the experiment, once for all tests that ask for it; they must not change it."""
    return (variant or Variant()).run(scene, Setting(synergy=synergy, **choices))


# -- the reference numbers


@pytest.mark.parametrize("synergy", SYNERGIES)
@pytest.mark.parametrize("model", MODELS)
def test_error_against_gamma(
    scene: Scene, table: dict[str, Any], model: str, synergy: int
) -> None:
    expected = table["object_error"][model]["gamma"][synergy - 1]
    runs = [
        run(scene, synergy, gamma=gamma, steps=table["gamma_steps"])
        for gamma in table["gammas"]
    ]
    found = [object_error(one, MODELS[model]) for one in runs]
    assert all(map(agrees, found, expected)), (found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("synergy", SYNERGIES)
@pytest.mark.parametrize("model", MODELS)
def test_error_against_the_number_of_steps(
    scene: Scene, table: dict[str, Any], model: str, synergy: int
) -> None:
    expected = table["object_error"][model]["steps"][synergy - 1]
    found = [
        object_error(run(scene, synergy, steps=steps), MODELS[model])
        for steps in table["steps"]
    ]
    assert all(map(agrees, found, expected)), (found, expected)


@pytest.mark.parametrize("synergy", SYNERGIES)
def test_frozen_fingers(scene: Scene, table: dict[str, Any], synergy: int) -> None:
    frozen, expected = run(scene, synergy, Variant("frozen")), table["at_50_steps"]
    for model, stiffnesses in MODELS.items():
        assert agrees(
            object_error(frozen, stiffnesses), expected[f"frozen_{model}"][synergy - 1]
        ), model
    assert agrees(frozen.point_rms, expected["point_rms_frozen"][synergy - 1])
    assert (frozen.robot.q == frozen.robot.q[0]).all()


@pytest.mark.parametrize("synergy", SYNERGIES)
def test_distance_of_the_points_from_their_targets(
    scene: Scene, table: dict[str, Any], synergy: int
) -> None:
    # The table rounds to 0.1 mm, which is 0.052 mm here.
    assert run(scene, synergy).point_rms * 1e3 == pytest.approx(
        table["at_50_steps"]["point_rms_mapped"][synergy - 1], abs=0.06
    )


@pytest.mark.parametrize("synergy", SYNERGIES)
def test_T_from_the_first_configuration(
    scene: Scene, table: dict[str, Any], synergy: int
) -> None:
    found = object_error(run(scene, synergy, start="first"))
    assert agrees(found, table["at_50_steps"]["closed_loop"][synergy - 1])


@pytest.mark.parametrize("synergy", SYNERGIES)
@pytest.mark.parametrize("pivot", ["centroid", "palm"])
def test_one_metre_from_the_origin(
    scene: Scene, table: dict[str, Any], pivot: Pivot, synergy: int
) -> None:
    far = object_error(run(moved_scene(scene, METRE), synergy, Variant(pivot=pivot)))
    assert agrees(far, table["at_50_steps"][f"one_metre_off_{pivot}"][synergy - 1])
    assert far == pytest.approx(
        object_error(run(scene, synergy, Variant(pivot=pivot))), abs=1e-9
    )


@pytest.mark.parametrize("synergy", SYNERGIES)
def test_about_the_origin_the_deformation_is_lost(
    scene: Scene, table: dict[str, Any], synergy: int
) -> None:
    # The table does not give the direction of its 1 m offset, and the result is ill-conditioned in
    # it (see below). Along x, 42 and 10.5 mm are reproduced within 15 %, 7.3 mm is not. All of them
    # are several times the error about the centroid.
    far = object_error(run(moved_scene(scene, METRE), synergy, Variant(pivot="origin")))
    assert far > 4.0 * object_error(run(moved_scene(scene, METRE), synergy))
    if synergy != 2:
        assert 1e3 * far == pytest.approx(
            table["at_50_steps"]["one_metre_off_origin"][synergy - 1], rel=0.15
        )


def test_about_the_origin_a_tenth_of_a_millimetre_decides(scene: Scene) -> None:
    found = [
        object_error(
            run(moved_scene(scene, (1.0 + nudge) * METRE), 2, Variant(pivot="origin"))
        )
        for nudge in (0.0, 1e-4, 1e-3, 1e-2)
    ]
    assert np.ptp(found) > 0.01


def test_our_hand_differs_by_its_joints_only(scene: Scene) -> None:
    ours = paper_scene("ours")
    for synergy in SYNERGIES:
        one, other = run(scene, synergy), run(ours, synergy)
        assert object_error(other) == pytest.approx(object_error(one), abs=1e-5)
        # Its Jacobian differs, so the compliance of its joints has another effect.
        assert object_error(other, UNIT) == pytest.approx(
            object_error(one, UNIT), rel=0.06
        )


# -- the scene


def test_the_toolbox_hand_reaches_its_contacts_at_its_angles(scene: Scene) -> None:
    published = reference_grasp("three_finger")
    np.testing.assert_allclose(scene.robot.q, published.published_q)
    np.testing.assert_allclose(
        scene.robot.points, published.published_points, atol=1e-9
    )
    np.testing.assert_allclose(scene.robot.normals, published.grasp.normals, atol=1e-9)


def test_the_arc_has_the_papers_length_and_height() -> None:
    x, y, z = wrist_arc(100).T
    assert (x[0], x[-1]) == (0.0, pytest.approx(0.470))
    assert z.max() == pytest.approx(0.150)
    assert abs(z[[0, -1]]).max() < 1e-12
    assert not y.any()


def test_without_a_synergy_everything_goes_with_the_wrist(scene: Scene) -> None:
    still = run(scene, 1, gamma=0.0)
    np.testing.assert_allclose(
        still.robot.q, np.tile(scene.robot.q, (51, 1)), atol=1e-9
    )
    for poses in object_poses(still):
        np.testing.assert_allclose(
            poses[:, :3, 3] - scene.human.centre, wrist_arc(50), atol=1e-9
        )
    assert still.point_rms < 1e-9


# -- methods that follow the object


@pytest.mark.parametrize("synergy", SYNERGIES)
def test_without_limits_in_reach_the_qp_is_the_pseudoinverse_of_its_cost(
    scene: Scene, synergy: int
) -> None:
    qp, free = (run(scene, synergy, Variant(way)) for way in ("qp", "damped"))
    assert limit_excess(qp) == 0.0
    np.testing.assert_allclose(qp.robot.q, free.robot.q, atol=1e-6)
    np.testing.assert_allclose(qp.robot.wrist, free.robot.wrist, atol=1e-6)


@pytest.fixture(scope="module")
def tight() -> Scene:
    """Return the scene with joint limits four degrees from the initial posture."""
    base, room = paper_scene("ours"), np.radians(4.0)
    return replace(
        base,
        robot_points=limited_hand(
            base.robot_points, base.robot.q, base.robot.q - room, base.robot.q + room
        ),
    )


@pytest.mark.parametrize("synergy", SYNERGIES)
def test_within_limits_that_bite_the_qp_does_best(tight: Scene, synergy: int) -> None:
    ways: tuple[FingerMode, ...] = ("pseudoinverse", "clipped", "qp")
    done = {way: run(tight, synergy, Variant(way), steps=20) for way in ways}
    assert limit_excess(done["pseudoinverse"]) > np.radians(2.0)
    assert max(limit_excess(done["clipped"]), limit_excess(done["qp"])) <= 1e-9
    assert done["qp"].point_rms < done["clipped"].point_rms


def test_the_experiment_equals_the_mapper(scene: Scene) -> None:
    own = run(scene, 1, Variant("qp", "own", ridge=0.1), steps=20)
    mapper = HandMapper(
        scene.human_points,
        scene.robot_points,
        ik=IK,
        dt=1.0,
        reference="previous",
        joint_tolerance=np.inf,
    )
    human = own.human
    mapper.reset(
        human.q[0],
        human.wrist[0],
        robot_q=scene.robot.q,
        robot_wrist=scene.robot.wrist_pose,
    )
    for k in range(1, 21):
        step = mapper.map_step(human.q[k], human.wrist[k])
        np.testing.assert_allclose(step.command.q, own.robot.q[k], atol=1e-9)
        np.testing.assert_allclose(step.command.wrist, own.robot.wrist[k], atol=1e-9)


# -- the first step


@pytest.mark.parametrize("synergy", SYNERGIES)
def test_force_changes_are_in_balance(scene: Scene, synergy: int) -> None:
    step = in_hand_step(scene, Setting(synergy=synergy))
    for forces in (step.human_forces, step.robot_forces):
        assert np.abs(forces).max() > 1e-6
        np.testing.assert_allclose(
            forces.sum(axis=0), 0.0, atol=1e-9 * np.abs(forces).max()
        )


def test_the_unit_of_force_cancels_in_motions(scene: Scene) -> None:
    one, ten = (
        in_hand_step(scene, Setting()),
        in_hand_step(scene, Setting(), Stiffnesses(1e4, 1e-2, 1e-2)),
    )
    np.testing.assert_allclose(ten.human_motion, one.human_motion, rtol=1e-9)
    np.testing.assert_allclose(ten.robot_motion, one.robot_motion, rtol=1e-9)
    np.testing.assert_allclose(ten.human_forces, 10.0 * one.human_forces, rtol=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_objects_move_in_comparable_directions(model: str) -> None:
    steps = [
        in_hand_step(paper_scene("ours"), Setting(synergy=synergy), MODELS[model])
        for synergy in SYNERGIES
    ]
    assert max(step.angle for step in steps) < np.radians(45.0)
    one, other = steps[0].robot_motion, steps[0].human_motion
    cosine = one @ other / np.linalg.norm(one) / np.linalg.norm(other)
    assert np.cos(steps[0].angle) == pytest.approx(cosine)


# -- the trends of Fig. 7


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_gamma_matters_more_than_the_step(scene: Scene, model: str) -> None:
    for synergy in SYNERGIES:
        by_gamma = [
            object_error(run(scene, synergy, gamma=g, steps=20), MODELS[model])
            for g in GAMMAS[::3]
        ]
        assert (np.diff(by_gamma) > 0.0).all()
        by_steps = [
            object_error(run(scene, synergy, steps=n), MODELS[model])
            for n in (10, 20, 50, 100)
        ]
        assert max(by_steps) / min(by_steps) < 1.3 < 5.0 < by_gamma[-1] / by_gamma[0]


def test_points_tell_fingers_that_follow_from_frozen_ones_and_the_object_does_not(
    scene: Scene,
) -> None:
    for synergy in SYNERGIES:
        mapped, frozen = run(scene, synergy), run(scene, synergy, Variant("frozen"))
        assert mapped.point_rms < frozen.point_rms
        assert object_error(mapped) > object_error(frozen)


def test_the_seven_contacts_miss_a_linear_motion_by_millimetres() -> None:
    # Eq. (5) is an assumption: over the whole path the residuals are a few millimetres, for
    # contacts 50 mm apart.
    done = run(paper_scene("ours"), 3)
    before, after = (
        done.human.points[0],
        human_motion(paper_scene("ours"), done.setting).points[-1],
    )
    fitted = np.linalg.lstsq(np.column_stack([before, np.ones(7)]), after, rcond=None)[
        0
    ]
    assert 1e-3 < rms(after - np.column_stack([before, np.ones(7)]) @ fitted) < 20e-3
