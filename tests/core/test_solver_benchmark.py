"""The pieces of `bench_solvers`: problems with contact rows, times in parts, exact counts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from handmap_qp import read_recording
from handmap_qp.human.fit import fit_recording
from handmap_qp.reference.problem import direct_cost

Modules = dict[str, Any]
COUNT = 12
# How near to the optimum each solver's settings bring it on these problems [rad or m]; active-set
# methods are exact.
TOLERANCE = {"osqp": 2e-2, "proxqp": 1e-5, "clarabel": 1e-5, "piqp": 1e-5}
EXACT = 1e-9


@pytest.fixture(scope="module")
def modules(benchmark: Callable[[str], Any]) -> Modules:
    names = ("qp_problems", "qp_proof", "qp_ways", "bench_solvers")
    return {name: benchmark(name) for name in names}


@pytest.fixture(scope="module")
def contacts(modules: Modules) -> list[Any]:
    """Problems whose answer is pressed against a row: the LEAP hand follows the demo."""
    motion = fit_recording(read_recording("demo", "right"))
    return modules["qp_problems"].mapped_problems(
        [motion],
        ["leap_right"],
        "paper",
        COUNT,
        keeps_links_apart=True,
        keep=modules["qp_problems"].has_active_row,
    )


@pytest.fixture(scope="module")
def measured(modules: Modules, contacts: list[Any]) -> list[Any]:
    with modules["qp_ways"].installed_ways() as ways:
        return modules["qp_ways"].measure(ways, contacts, 1)


@pytest.fixture(scope="module")
def optima(modules: Modules, contacts: list[Any]) -> list[np.ndarray]:
    return [modules["qp_proof"].reference_answer(posed.problem).x for posed in contacts]


def test_contact_problems_are_pressed_against_a_row(
    contacts: list[Any], optima: list[np.ndarray]
) -> None:
    assert len(contacts) == COUNT
    for posed, x in zip(contacts, optima, strict=True):
        G, h = posed.problem.rows
        assert (h - G @ x).min() < EXACT


def test_a_problem_is_posed_again_to_the_last_bit(contacts: list[Any]) -> None:
    # In another order, so that nothing is left of the problem before.
    for posed in contacts[::-1]:
        posed.restore()
        H, c = direct_cost(posed.ik.gate, posed.ik.configuration, posed.goal)
        assert (H == posed.problem.H).all()
        assert (c == posed.problem.c).all()


def test_mink_poses_the_same_problem(modules: Modules, contacts: list[Any]) -> None:
    ways = modules["qp_ways"]
    for posed in contacts:
        posed.restore()
        problem = ways.Way("", "", "", ways.pose_by_mink, None).pose(posed)
        H, c, lower, upper, (G, h) = posed.problem
        np.testing.assert_allclose(problem.P, H, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(problem.q, c, rtol=1e-12, atol=1e-9)
        n = len(c)
        assert (np.vstack([np.eye(n), -np.eye(n), G]) == problem.G).all()
        assert (problem.h == np.concatenate([upper, -lower, h])).all()


def test_every_solver_finds_the_certified_optimum(
    measured: list[Any], optima: list[np.ndarray]
) -> None:
    in_qp = [each for each in measured if each.way.limits != "clipped"]
    assert {"core", "daqp", "osqp", "proxqp"} <= {each.way.solver for each in in_qp}
    assert {each.way.posed_by for each in in_qp} == {"direct", "mink"}
    for each in in_qp:
        for x, optimum in zip(each.answers, optima, strict=True):
            if x is None:  # proxqp calls one in a hundred infeasible
                assert each.way.solver == "proxqp", each.way.name
                continue
            np.testing.assert_allclose(
                x,
                optimum,
                atol=TOLERANCE.get(each.way.solver, EXACT),
                err_msg=each.way.name,
            )


def test_clipping_breaks_rows_that_the_qp_holds(
    modules: Modules, contacts: list[Any], measured: list[Any]
) -> None:
    broken = modules["qp_proof"].row_violation
    for each in measured:
        worst = max(
            broken(posed.problem, x)
            for posed, x in zip(contacts, each.answers, strict=True)
            if x is not None
        )
        if each.way.limits == "clipped":
            assert worst > 1e-4, each.way.name
        elif each.way.solver != "osqp":
            assert worst < 1e-6, each.way.name


def test_solver_and_wrapper_are_the_whole(
    modules: Modules, contacts: list[Any]
) -> None:
    ways = modules["qp_ways"]
    with pytest.MonkeyPatch.context() as patch, ways.installed_ways() as installed:
        # A clock that goes on by 1 s with every look at it: times are counts of looks.
        looks = iter(range(10**9))
        patch.setattr("time.perf_counter", lambda: float(next(looks)))
        for way in installed:
            before = next(looks)
            timing, _ = ways.run(way, contacts[0])
            after = next(looks)
            # From the first look of the run to its last one, with nothing left out.
            assert timing.pose + timing.whole == after - before - 2, way.name
            assert timing.solver >= 1.0, way.name
            assert timing.wrapper >= 1.0, way.name


def test_counts_are_exact(modules: Modules) -> None:
    """Of four problems, one is not answered, one breaks a limit, one a row, and one is right."""
    problem = modules["qp_problems"].Problem(
        np.eye(2),
        np.array([-0.5, 0.0]),
        np.full(2, -1.0),
        np.full(2, 1.0),
        (np.array([[0.0, 2.0]]), np.array([1.0])),
    )
    optimum = np.array([0.5, 0.0])
    answers = [None, np.array([1.5, 0.0]), np.array([0.5, 0.75]), optimum]
    ways = modules["qp_ways"]
    timing = [ways.Timing(5e-6, 2e-6, 4e-6)] * 4
    base = [ways.Timing(9e-6, 1e-6, 1e-6)] * 4
    way = ways.Way("made", "box", "direct", None, None)
    row = ways.row_of(
        ways.Measured(way, timing, answers),
        ways.Measured(way, base, answers),
        [problem] * 4,
        [optimum] * 4,
    )
    assert row["no answer"] == 1
    assert row["limit broken"] == 1
    assert row["contact broken"] == 1
    assert row["wrong"] == 2
    assert row["off_max"] == 1.0
    assert row["of core"] == pytest.approx(3.0)
    times = [row["pose_us"], row["wrapper_us"], row["solver_us"]]
    assert times == pytest.approx([5.0, 2.0, 4.0])


def test_a_table_says_what_fails(
    modules: Modules, contacts: list[Any], measured: list[Any], optima: list[np.ndarray]
) -> None:
    bench = modules["bench_solvers"]
    problems = [posed.problem for posed in contacts]
    rows = [
        modules["qp_ways"].row_of(each, measured[0], problems, optima)
        for each in measured
    ]
    verdicts = {row["solver"]: bench.verdict(row) for row in rows}
    assert verdicts["core"] == "exact"
    assert f"{COUNT} break a contact" in verdicts["linear solve"]
    table = bench.markdown({"contacts": rows}).splitlines()
    assert len(table) == 2 + len(rows)
    assert len({line.count("|") for line in table}) == 1
    text = bench.conclusion("contacts", rows, COUNT)
    assert text.startswith(f"contacts: exact on all {COUNT}")
    assert "core 1," in text
    assert "linear solve, clipped" in text


def test_a_reference_must_be_certified(
    modules: Modules, contacts: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    proof = modules["qp_proof"]
    best = proof.reference_answer(contacts[0].problem)
    assert best.radius < 1e-6
    monkeypatch.setattr(proof, "solve_by_core", lambda *problem: 0.9 * best.x)
    monkeypatch.setattr(proof, "solve_by_daqp", lambda *problem: None)
    with pytest.raises(RuntimeError, match="certified"):
        proof.reference_answer(contacts[0].problem)
