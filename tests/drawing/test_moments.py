"""Sheets of moments: what is in every panel, the directions of the person, and unseen hands."""

from __future__ import annotations

from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from coarse_drawing import draw_coarsely
from meeting_hands import meeting_hands

from handmap_qp.apps.drawing import moments
from handmap_qp.apps.drawing.contact_sheet import (
    CELL,
    HUMAN_BACKGROUND,
    landmarks_in_palm,
)
from handmap_qp.apps.drawing.hands import HandShape, load_shape
from handmap_qp.apps.drawing.moments import (
    HAND_WIDTH,
    PERSON_WIDTH,
    ROBOT_WIDTH,
    ROW_HEIGHT,
    ShownHand,
    ShownMotion,
    moments_sheet,
)
from handmap_qp.apps.drawing.raster import Triangles, render
from handmap_qp.apps.drawing.sheet import LEFT, TOP, SheetColumn, draw_sheet
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.robot import load_robot

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

TIMES = (1.0, 5.0)


@cache
def read_thinned(hand: Hand) -> HandShape:
    """Return every tenth triangle of the shapes of a hand, which take a tenth of the time."""
    thinned = {
        link: Triangles(*(each[::10] for each in solid))
        for link, solid in load_shape(hand).links.items()
    }
    return HandShape(hand, thinned)


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw a sample a pixel, and few triangles."""
    draw_coarsely(monkeypatch)
    monkeypatch.setattr(moments, "load_shape", read_thinned)
    monkeypatch.setattr(moments, "render", partial(render, supersampling=1))


@pytest.fixture(scope="module")
def robot() -> Hand:
    return load_robot("ur5_pair")


def shown(robot: Hand, **changes: Any) -> ShownMotion:
    """Return two moments of hands that meet, and a robot whose joints move between them."""
    recordings = meeting_hands()
    hands = []
    for hand in robot.hands:
        recording = recordings[hand.side]
        samples = np.searchsorted(recording.time, TIMES)
        hands.append(
            ShownHand(
                hand,
                hand.side,
                recording.landmarks[samples],
                landmarks_in_palm(recording, samples.tolist()),
                np.ones(len(samples), dtype=bool),
            )
        )
    q = np.array([robot.rest, robot.rest + 0.3 * (robot.upper_limits - robot.rest)])
    return ShownMotion(robot, q, hands, np.eye(3))._replace(**changes)


def pixels(figure: Any) -> np.ndarray:
    """Return the picture as red, green and blue in 0..1, shape (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255.0


def panels(figure: Any, widths: list[int], height: int) -> np.ndarray:
    """Return the panels of a sheet by row and column, as arrays without the lines between them."""
    picture = pixels(figure)
    edges = LEFT + np.cumsum([0, *widths])
    assert picture.shape[1] == edges[-1]
    assert (picture.shape[0] - TOP) // height == len(TIMES)
    found = np.empty((len(TIMES), len(widths)), dtype=object)
    for row in range(len(TIMES)):
        for column, (left, right) in enumerate(pairwise(edges)):
            top = TOP + row * height
            found[row, column] = picture[top + 1 : top + height - 2, left + 2 : right]
    return found


def ink(panel: np.ndarray) -> np.ndarray:
    """Return the pixels that differ from the corner of a panel, which is background."""
    return np.abs(panel - panel[0, 0]).max(axis=2) > 0.03


def words(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.axes[0].texts]


TWO_HANDS = [PERSON_WIDTH, ROBOT_WIDTH, *4 * [HAND_WIDTH]]


def test_a_robot_has_the_person_itself_and_each_hand_in_every_row(robot: Hand) -> None:
    figure = moments_sheet([shown(robot)], TIMES, "made to ur5_pair")
    found = panels(figure, TWO_HANDS, ROW_HEIGHT)
    shares = np.vectorize(lambda panel: ink(panel).mean())(found)
    # The person's hands are small beside the way that they go.
    assert (shares[:, 0] > 0.005).all()
    assert (shares[:, 1:] > 0.04).all()
    assert (shares < 0.7).all()
    # Nothing is cut off, and rows differ.
    for panel in found.ravel():
        marked = ink(panel)
        border = marked[0], marked[-1], marked[:, 0], marked[:, -1]
        assert not np.concatenate(border).any()
    for first, second in found.T:
        assert (ink(first) != ink(second)).mean() > 0.001
    assert {"1.00 s", "5.00 s", "person", "ur5_pair", "left hand"} <= {*words(figure)}
    assert "made to ur5_pair" in words(figure)


def test_a_bare_hand_is_drawn_beside_the_persons_hand() -> None:
    hand = load_hand("three_finger")
    figure = moments_sheet([shown(hand)], TIMES)
    found = panels(figure, 2 * [2 * CELL[0]], CELL[1])
    for panel in found.ravel():
        for view in np.array_split(panel, 2, axis=1):
            assert 0.04 < ink(view).mean() < 0.6
    assert {"person, right", "three_finger"} <= {*words(figure)}


def test_several_robots_stand_side_by_side(robot: Hand) -> None:
    hand = load_hand("three_finger")
    figure = moments_sheet([shown(robot), shown(hand)], TIMES)
    found = panels(figure, [*TWO_HANDS, *2 * [2 * CELL[0]]], ROW_HEIGHT)
    assert all(ink(panel).any() for panel in found.ravel())


def test_the_person_is_seen_in_the_robots_directions(
    robot: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tracker in other axes, and the rotation that takes them back, give the same picture."""
    monkeypatch.setattr(moments, "_close_up", lambda *_: [])
    usual = shown(robot)
    # From +y up and -z forward.
    turn = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    hands = [
        hand._replace(landmarks=hand.landmarks @ turn, in_palm=hand.in_palm)
        for hand in usual.hands
    ]
    turned = usual._replace(hands=hands, turn=turn)
    askew = usual._replace(hands=hands)
    person, same, other = (
        panels(moments_sheet([each], TIMES), TWO_HANDS[:2], ROW_HEIGHT)[0, 0]
        for each in (usual, turned, askew)
    )
    np.testing.assert_allclose(person, same, atol=0.02)
    assert (ink(person) != ink(other)).mean() > 0.005


def test_a_hand_that_is_not_seen_is_left_out_and_named(robot: Hand) -> None:
    usual = shown(robot)
    left, right = usual.hands
    lost = np.array([True, False])
    landmarks = np.where(lost[:, None, None], left.landmarks, np.nan)
    gone = left._replace(is_seen=lost, landmarks=landmarks, in_palm=landmarks)
    figure = moments_sheet([usual._replace(hands=[gone, right])], TIMES)
    found = panels(figure, TWO_HANDS, ROW_HEIGHT)
    np.testing.assert_allclose(found[1, 2], HUMAN_BACKGROUND, atol=0.01)
    assert ink(found[0, 2]).any()
    # The other hand, and the robot's own, are still there.
    assert all(ink(found[1, column]).any() for column in (0, 1, 3, 4, 5))
    assert words(figure).count("left not seen") == 1


def test_a_sheet_without_rows_is_refused() -> None:
    column = SheetColumn("", "", np.ones((0, 2, 2, 3)))
    with pytest.raises(InvalidInputError) as error:
        draw_sheet([column], [])
    assert error.value.argument == "rows"
