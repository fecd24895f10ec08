"""Options of clients: extreme values neither break a session nor delay the others."""

from __future__ import annotations

from typing import Any

import daqp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from service_tools import Sampler, change, human_q, make_session

from handmap_qp import IkOptions, MappingOptions
from handmap_qp.client.messages import Pose
from handmap_qp.errors import RefusedError
from handmap_qp.options import options_of

PERIOD = 1.0 / 60.0


def numbers_of(kind: type[Any]) -> st.SearchStrategy[dict[str, float]]:
    """Draw some of the numeric options, each with any value."""
    names = [option.name for option in options_of(kind) if option.plain is float]
    return st.dictionaries(st.sampled_from(names), st.floats(min_value=0.0), max_size=4)


# An overflow ends as `failed`, and the robot stays where it is.
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@given(
    mapping=numbers_of(MappingOptions),
    ik=numbers_of(IkOptions),
    reference=st.sampled_from(["first", "previous"]),
    seed=st.integers(0),
)
@example(mapping={"deformation_gain": 1e200}, ik={}, reference="first", seed=0)
@example(
    mapping={"deformation_gain": 10.0, "stretch_max": np.inf},
    ik={},
    reference="first",
    seed=0,
)
@example(
    mapping={"scale": 1e308}, ik={"point_weight": 1e6}, reference="previous", seed=0
)
def test_options_that_are_taken_can_be_followed(
    mapping: dict[str, float], ik: dict[str, float], reference: str, seed: int
) -> None:
    session, sample, random = make_session(), Sampler(), np.random.default_rng(seed)
    session.step(sample(), 0.0)
    try:
        session.configure(change(mapping=mapping | {"reference": reference}, ik=ik))
    except RefusedError:
        return
    for i in range(1, 6):
        before = session.posture[0].copy()
        wrist = Pose(tuple(random.normal(size=3).tolist()), (0.0, 0.0, 0.0, 1.0))
        try:
            session.step(
                sample(i * PERIOD, human_q(random.normal()), wrist), i * PERIOD
            )
        except RefusedError:
            # A tolerance of nothing refuses samples.
            continue
        moved = np.abs(session.posture[0] - before)
        assert (moved <= session.robot.velocity_limits * PERIOD * (1.0 + 1e-6)).all()
    # No effect of the options remains.
    session.configure(change(mapping=MappingOptions().values, ik=IkOptions().values))
    command = session.step(sample(6 * PERIOD, human_q()), 6 * PERIOD)
    assert command.status != "failed"


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"ik": {"solver": "proxqp"}}, "ik.solver"),
        ({"mapping": {"deformation_gain": 11.0}}, "options.deformation_gain"),
    ],
)
def test_what_cannot_be_carried_out_in_time_or_in_numbers_is_refused(
    changes: dict[str, Any], field: str
) -> None:
    for choose in (
        lambda: make_session(**changes),
        lambda: make_session().configure(change(**changes)),
    ):
        with pytest.raises(RefusedError) as raised:
            choose()
        assert raised.value.field == field


FIXED = {"mount": "fixed", "mapping": {"rigid_from": "none"}}


@pytest.mark.parametrize(
    ("choices", "changes", "field"),
    [
        (
            {"robot": "panda_gripper"},
            {"ik": {"avoids_self_collision": True}},
            "ik.avoids_self_collision",
        ),
        ({}, {"ik": {"rest_weight": 1e300}}, "ik.rest_weight"),
        (
            {},
            {"ik": {"max_acceleration": 0.0}, "mapping": {"ridge": 0.2}},
            "ik.max_acceleration",
        ),
        (FIXED, {"mapping": {"rigid_from": "points"}}, "options.rigid_from"),
    ],
    ids=str,
)
def test_the_options_at_fault_are_named(
    choices: dict[str, Any], changes: dict[str, Any], field: str
) -> None:
    session = make_session(**choices)
    for choose in (
        lambda: make_session(**choices | changes),
        lambda: session.configure(change(**changes)),
    ):
        with pytest.raises(RefusedError) as raised:
            choose()
        assert raised.value.field == field


@pytest.mark.parametrize("formulation", ["compiled", "direct"])
def test_the_solver_does_not_go_round_in_circles(
    formulation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    iterations = []

    def counting(*problem: Any, **settings: Any) -> Any:
        """Solve by DAQP, and record its number of iterations."""
        result = solve(*problem, **settings)
        iterations.append(result[3]["iterations"])
        return result

    solve = daqp.solve
    monkeypatch.setattr(daqp, "solve", counting)
    # Targets so far away that the cost cannot distinguish them.
    mapping = {"scale": 9e18, "reference": "previous"}
    ik = {
        "wrist_position_weight": 1e-9,
        "max_iterations": 14,
        "step_tolerance": 0.0,
        "formulation": formulation,
    }
    session, sample, random = (
        make_session(mapping=mapping, ik=ik),
        Sampler(),
        np.random.default_rng(0),
    )
    for i in range(20):
        wrist = Pose(tuple(random.normal(size=3).tolist()), (0.0, 0.0, 0.0, 1.0))
        assert (
            session.step(
                sample(i * PERIOD, human_q(random.normal()), wrist), i * PERIOD
            ).status
            != "failed"
        )
    # Only some versions of DAQP cycle here; none may go on.
    if formulation == "direct":
        assert 0 < max(iterations) < 1100


def test_options_change_on_the_way_and_the_robot_does_not_jump() -> None:
    session, sample = make_session(), Sampler()
    for i in range(20):
        session.step(sample(i * PERIOD, human_q(0.1 * i)), i * PERIOD)
    now, before = 20 * PERIOD, session.posture[0].copy()
    session.configure(
        change(
            mapping={"deformation_gain": 0.0}, ik={"rest_weight": 1.0}, has_detail=True
        )
    )
    np.testing.assert_array_equal(session.posture[0], before)
    command = session.step(sample(now, human_q(1.0)), now)
    assert (
        np.abs(np.array(command.q) - before)
        <= session.robot.velocity_limits * PERIOD * (1.0 + 1e-6)
    ).all()
    assert command.detail is not None
    np.testing.assert_allclose(command.detail.motion_deformation, np.eye(4), atol=0.5)
    about = session.state(1, "", 0, now).about
    assert about is not None
    assert (
        about.mapping["deformation_gain"],
        about.mapping["ridge"],
        about.ik["rest_weight"],
    ) == (
        0.0,
        0.1,
        1.0,
    )


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"mapping": {"ridges": 1.0}}, "options.ridges"),
        ({"mapping": {"ridge": -1.0}}, "options.ridge"),
        ({"mapping": {"ridge": "much"}}, "options.ridge"),
        ({"mapping": {"scale": 2.0}, "ik": {"damping": 0.0}}, "ik.damping"),
        ({"ik": {"solver": "abacus"}}, "ik.solver"),
        ({"ik": {"max_iterations": 1000}}, "ik.max_iterations"),
        ({"mapping": {"residual_gain": 1.0, "pivot": "point"}}, "options"),
    ],
)
def test_options_that_cannot_be_change_nothing(
    changes: dict[str, Any], field: str
) -> None:
    session, sample = make_session(), Sampler()
    session.step(sample(), 0.0)
    before = session.state(1, "", 0, 0.0).about
    with pytest.raises(RefusedError) as raised:
        session.configure(change(**changes))
    assert raised.value.field.startswith(field)
    assert session.state(1, "", 0, 0.0).about == before
