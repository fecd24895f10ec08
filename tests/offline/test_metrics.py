"""Metrics of a comparison: values, missing values, and the best method of each."""

from __future__ import annotations

import numpy as np
import pytest

from handmap_qp.apps.offline.fidelity import assess_fidelity
from handmap_qp.apps.offline.hand_trace import trace_human
from handmap_qp.apps.offline.metrics import GROUPS, METRICS, Better, Metric, mean_values
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.se3 import transform_points

NAN = float("nan")


def metric(better: Better, digits: int = 2) -> Metric:
    return Metric("key", "title", "", better, "about", digits)


def test_every_metric_is_one_of_fidelity() -> None:
    human = load_hand("human", points="landmarks")
    amounts = np.linspace(0.0, 0.8, 100)
    landmarks = np.array(
        [
            human.points(np.clip(a, human.lower_limits, human.upper_limits))
            for a in amounts
        ]
    )
    landmarks = np.array([transform_points(np.eye(4), points) for points in landmarks])
    trace = trace_human(landmarks, HumanLengths.from_hand_length(0.19))
    time = np.arange(100) / 100.0
    values = assess_fidelity(trace, trace, time, time >= 0.0).values
    assert list(values) == [m.key for m in METRICS]
    # These metrics need surfaces, an object, joints, workspace or times; all others have a value.
    unknown = {key for key, value in values.items() if np.isnan(value)}
    motion = {"jerk_ratio", "speed_ratio", "outside_limits", "self_penetration"}
    pinches = {
        m.key for group in ("Pinches", "Object in the hand") for m in GROUPS[group]
    }
    assert unknown == motion | pinches | {"colliding", "workspace", "step_time_ms"}
    assert values["thumb_extension_correlation"] == pytest.approx(1.0)
    assert values["key_cosine"] == pytest.approx(1.0)
    assert values["key_scale"] == pytest.approx(1.0, abs=1e-6)


def test_keys_and_labels_are_different() -> None:
    assert len({m.key for m in METRICS}) == len(METRICS)
    assert len({m.label for m in METRICS}) == len(METRICS)


@pytest.mark.parametrize(
    ("better", "values", "best"),
    [
        ("high", [0.2, 0.9, NAN, 0.5], {1}),
        ("low", [0.2, 0.9, NAN, 0.5], {0}),
        ("low", [-3.0, 2.0, 0.0, -0.5], {0, 2, 3}),
        ("zero", [-8.0, 3.0, 9.0], {1}),
        ("one", [0.8, 1.1, 2.0], {1}),
        # Values that are printed alike count as equal.
        ("high", [0.994, 0.9901, 0.98], {0, 1}),
        ("high", [0.5, NAN], set()),
    ],
)
def test_best_values(better: Better, values: list[float], best: set[int]) -> None:
    assert metric(better).best(values) == best


def test_values_that_are_good_enough_are_alike() -> None:
    (speed,) = (m for m in METRICS if m.key == "speed_ratio")
    assert speed.best([0.4, 1.0, 1.2]) == {0, 1}
    assert speed.best([1.5, 1.2]) == {1}
    (gap,) = (m for m in METRICS if m.key == "pinch_gap_mm")
    # Fingers that overlap by 12 mm do not close a pinch better than fingers that touch.
    assert gap.best([-12.0, 0.4, 30.0]) == {1}


def test_text_of_values() -> None:
    assert metric("low", 1).text(12.345) == "12.3"
    assert metric("low", 0).text(12.345) == "12"
    assert metric("low").text(NAN) == "-"


def test_means_leave_out_what_is_unknown() -> None:
    rows = [dict.fromkeys((m.key for m in METRICS), NAN) for _ in range(3)]
    rows[0]["pinch_closed"], rows[2]["pinch_closed"] = 0.5, 1.0
    means = mean_values(rows)
    assert means["pinch_closed"] == 0.75
    assert np.isnan(means["pinch_order"])
    assert all(np.isnan(value) for value in mean_values([]).values())
