"""The numbers of one instant, and HTML that changes over time."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from handmap_qp import load_hand
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.viewer.controls import on_white
from handmap_qp.apps.viewer.gauges import InstantGauges
from handmap_qp.apps.viewer.sample import HumanView, ViewSample

ROBOT = load_hand("three_finger")
GAUGES = InstantGauges(
    ROBOT,
    load_hand("human").with_contact_gap(0.012),
)


def sample_of(q: np.ndarray, **values: Any) -> ViewSample:
    return ViewSample(
        time=0.0,
        robot_q=q,
        robot_wrist=np.eye(4),
        robot_points=ROBOT.points(q, np.eye(4)),
        **values,
    )


def test_readings_are_the_errors_that_were_made_and_the_gaps_of_the_surfaces() -> None:
    q = ROBOT.rest + 0.4 * (ROBOT.upper_limits - ROBOT.rest)
    points = ROBOT.points(q, np.eye(4))
    shifts = np.zeros_like(points)
    shifts[0, 2] = 0.03
    sample = sample_of(q, targets=points + shifts, wrist_error=(0.005, 0.2))
    expected = (0.03 / len(points), 0.03, 0.005, 0.2)
    assert GAUGES.errors(sample) == pytest.approx(expected)
    gaps = GapMeter(ROBOT).pinches(q[None])
    pinches = GAUGES.pinches(sample)
    assert pinches == pytest.approx({name: gap[0] for name, gap in gaps.items()})
    text = re.sub("<[^>]*>", " ", GAUGES.table([sample], ["paper"]))
    assert "30.0 mm" in text
    assert "5.0 mm" in text
    assert "11.5°" in text
    finger, gap = next(iter(pinches.items()))
    assert re.search(rf"{finger}\s+\S+\s+{1e3 * gap:.0f}\b", text)
    assert np.isnan(GAUGES.errors(sample_of(q))).all()


def test_a_touch_of_the_human_reads_zero() -> None:
    landmarks = np.zeros((21, 3))
    landmarks[[8, 12, 16, 20], 0] = 0.010, 0.012, 0.052, 0.072
    gaps = GAUGES.human_pinches(HumanView(landmarks=landmarks))
    assert gaps == pytest.approx(
        {"index": 0.0, "middle": 0.0, "ring": 0.04, "little": 0.06}
    )
    assert GAUGES.human_pinches(HumanView()) == {}


def test_a_picture_is_put_on_white() -> None:
    import imageio.v3 as imageio

    image = np.zeros((1, 3, 4), dtype=np.uint8)
    image[0, 0], image[0, 1], image[0, 2] = (
        (10, 20, 30, 255),
        (0, 0, 0, 0),
        (0, 0, 0, 51),
    )
    read = imageio.imread(on_white(image))
    assert read[0].tolist() == [[10, 20, 30], [255, 255, 255], [204, 204, 204]]
