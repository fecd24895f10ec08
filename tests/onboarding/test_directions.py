"""`handmap hands check` moves a hand on an arm in six directions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handmap_qp import cli, load_hand
from handmap_qp.apps.onboarding.findings import HandReport, Rows
from handmap_qp.apps.onboarding.measure import check_directions
from handmap_qp.apps.onboarding.picture import hand_scene
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.robot import robot_files

BARE = load_hand("allegro_right")


def measure_directions(hand: Hand, *upright: str) -> Rows:
    """Return the rows of the table; none without one."""
    report = HandReport(hand.name)
    report.add(check_directions(hand, *upright))
    return report.measured.get("Directions", [])


@pytest.mark.parametrize("name", ["ur5_allegro", "g1_arm_left"])
@pytest.mark.parametrize(
    "upright", ["+y up, -z forward", "+z up, +y forward", "-x up, +y forward"]
)
def test_a_hand_on_an_arm_goes_where_the_persons_goes(name: str, upright: str) -> None:
    rows = measure_directions(load_hand(name), upright)
    ways = ("forward", "left", "up", "back", "right", "down")
    for way, row in zip(ways, rows, strict=True):
        assert row["direction"] == f"hand {way} -> robot {way}"
        assert row["degrees off"] < 5.0
        assert np.linalg.norm(row["robot moved, mm"]) > 40.0


def test_a_bare_hand_has_no_directions_to_check() -> None:
    assert measure_directions(BARE) == []


def test_the_picture_has_them() -> None:
    hand = load_hand("ur5_allegro")
    rows = measure_directions(hand)
    scene = hand_scene(hand, rows)
    labels = [label for _, _, label, _ in scene.arrows]
    assert labels[3:] == [row["direction"] for row in rows]
    ends = np.array([end for _, end, *_ in scene.arrows[3:]])
    # Forward is against back, left against right, up against down.
    np.testing.assert_allclose(
        ends[:3], -ends[3:], atol=0.02 * np.ptp(scene.points, axis=0).max()
    )


@pytest.mark.slow
def test_they_are_printed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Fingers are moved by other tests. The picture has a quarter of its size.
    monkeypatch.setattr(
        "handmap_qp.apps.onboarding.check._MOTIONS", (check_directions,)
    )
    monkeypatch.setattr("handmap_qp.apps.onboarding.picture.PANEL", (190, 205))
    monkeypatch.setattr("handmap_qp.apps.drawing.scene.PANEL", (190, 205))
    picture = tmp_path / "ur5.png"
    words = ["hands", "check", "ur5_allegro", "--picture", str(picture)]
    assert cli.main(words) == 0
    assert "hand up -> robot up" in capsys.readouterr().out
    assert picture.is_file()


def test_a_waist_says_how_far_it_goes() -> None:
    left = robot_files()["g1"].parent / "left.yaml"
    rows = measure_directions(load_hand(left))
    assert all(len(row["waist moved"]) == 3 for row in rows)
    # The arm can do 5 cm by itself.
    assert np.abs([row["waist moved"] for row in rows]).max() < 5
    assert "waist moved" not in measure_directions(load_hand("ur5_allegro"))[0]
