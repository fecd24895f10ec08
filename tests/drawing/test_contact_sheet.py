"""The contact sheet: rows, columns, views, colours and scale of every pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sheet_cells import cell_of

from handmap_core.human.recording import Recording
from handmap_qp.apps.drawing.contact_sheet import (
    CELL,
    FINGER_COLOURS,
    VIEWS,
    SheetRow,
    contact_sheet,
    save_contact_sheet,
    sheet_rows,
)
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.se3 import affine, rotation_from_quat_wxyz, transform_points

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

POSE = affine(
    rotation_from_quat_wxyz([0.9, 0.2, -0.3, 0.1]), np.array([0.3, -0.2, 0.5])
)


@pytest.fixture(scope="module")
def robot() -> Hand:
    return load_hand("three_finger")


def human_points(curl: float, name: str = "human") -> np.ndarray:
    """Landmarks in the palm frame with all fingers flexed by an angle [rad] a joint."""
    human = load_hand(name, points="landmarks")
    q = np.array([0.0 if "abduction" in joint else curl for joint in human.joint_names])
    return human.points(np.clip(q, human.lower_limits, human.upper_limits))


def postures(robot: Hand) -> tuple[np.ndarray, np.ndarray]:
    return np.clip(
        0.0, robot.lower_limits, robot.upper_limits
    ), robot.upper_limits - 0.05


def pixels(figure: Any) -> np.ndarray:
    """Return the picture as red, green and blue in 0..1, shape (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255.0


def cell(picture: np.ndarray, column: int, row: int, view: int) -> np.ndarray:
    """Return a view without the lines at its edges."""
    x, y = cell_of(column, row, view)
    return picture[y + 1 : y + CELL[1] - 2, x + 2 : x + CELL[0]]


def inked(part: np.ndarray) -> np.ndarray:
    """Return the pixels that differ from the view's corner, which is background."""
    return np.abs(part - part[0, 0]).max(axis=2) > 0.03


def of_colour(part: np.ndarray, finger: str) -> np.ndarray:
    """Return the pixels of a finger's hue at any brightness; hues differ by at least 0.08."""
    from matplotlib.colors import rgb_to_hsv

    hue, saturation, _ = np.moveaxis(rgb_to_hsv(part), 2, 0)
    away = np.abs(hue - rgb_to_hsv(FINGER_COLOURS[finger])[0])
    return (np.minimum(away, 1.0 - away) < 0.035) & (saturation > 0.4)


@pytest.fixture(scope="module")
def sheet(robot: Hand) -> np.ndarray:
    """Make a sheet of an open and a closed hand; the hand of the second column does not move."""
    straight, bent = postures(robot)
    rows = [
        SheetRow("open", "1 s", human_points(0.0), (straight, straight)),
        SheetRow("fist", "2 s", human_points(1.2), (bent, straight)),
    ]
    return pixels(contact_sheet([("ours", robot), ("theirs", robot)], rows))


@pytest.mark.slow
def test_every_view_has_a_hand_inside_its_edges(sheet: np.ndarray) -> None:
    assert sheet.shape[0] > 2 * CELL[1]
    for column in range(3):
        for row in range(2):
            for view in range(len(VIEWS)):
                ink = inked(cell(sheet, column, row, view))
                assert 0.04 < ink.mean() < 0.6
                border = np.concatenate([ink[0], ink[-1], ink[:, 0], ink[:, -1]])
                assert not border.any()


@pytest.mark.slow
def test_rows_show_their_own_posture(sheet: np.ndarray) -> None:
    for view in range(len(VIEWS)):
        opened, closed = (inked(cell(sheet, 1, row, view)) for row in range(2))
        assert (opened != closed).mean() > 0.03
        # The same posture gives the same picture: columns of a robot share their scale.
        np.testing.assert_array_equal(cell(sheet, 1, 0, view), cell(sheet, 2, 0, view))
        np.testing.assert_array_equal(cell(sheet, 2, 0, view), cell(sheet, 2, 1, view))
    # Fingers point up: a fist is lower than an open hand.
    heights = [np.argmax(inked(cell(sheet, 0, row, 0)).any(axis=1)) for row in range(2)]
    assert heights[1] > heights[0] + 30


@pytest.mark.slow
def test_right_palm_has_its_thumb_on_the_right(sheet: np.ndarray) -> None:
    palm = cell(sheet, 0, 0, 0)
    places = {
        finger: float(np.nonzero(of_colour(palm, finger))[1].mean())
        for finger in FINGER_COLOURS
    }
    assert (
        places["thumb"]
        > places["index"]
        > places["middle"]
        > places["ring"]
        > places["little"]
    )


def test_robot_stands_upright_in_its_own_palm_frame() -> None:
    # The axes of Allegro's palm link are not those of its palm frame.
    allegro = load_hand("allegro_right")
    q = np.clip(0.1, allegro.lower_limits, allegro.upper_limits)
    figure = contact_sheet(
        [("", allegro)], [SheetRow("open", "", human_points(0.0), (q,))]
    )
    palm = cell(pixels(figure), 1, 0, 0)
    rows, columns = {}, {}
    for finger in ("thumb", "index", "middle", "ring"):
        rows[finger], columns[finger] = (
            float(where.mean()) for where in np.nonzero(of_colour(palm, finger))
        )
    assert columns["thumb"] > columns["index"] > columns["middle"] > columns["ring"]
    lowest = np.nonzero(inked(palm))[0].max()
    assert max(rows["index"], rows["middle"], rows["ring"]) < rows["thumb"] < lowest
    assert not of_colour(palm, "little").any()


def test_left_hand_is_the_mirror_image(robot: Hand) -> None:
    rows = {
        name: [SheetRow("curl", "", human_points(0.7, name), ())]
        for name in ("human", "human_left")
    }
    right = pixels(contact_sheet([], rows["human"]))
    left = pixels(contact_sheet([], rows["human_left"], side="left"))
    for view in range(len(VIEWS)):
        x, y = cell_of(0, 0, view)
        one, other = (
            np.abs(picture[y : y + CELL[1] - 1, x + 2 : x + CELL[0] - 1] - 0.965).max(
                axis=2
            )
            > 0.03
            for picture in (right, left)
        )
        assert (one != other[:, ::-1]).mean() < 0.02
        assert (one != other).mean() > 0.05


def recording_of(*landmarks: np.ndarray, side: Any = "right") -> Recording:
    samples = np.array([transform_points(POSE, sample) for sample in landmarks])
    time = 3.0 + 0.5 * np.arange(len(samples))
    return Recording("made", time, samples, np.ones(len(samples), dtype=bool), side)


def test_rows_are_the_samples_in_the_palm_frame() -> None:
    shown = [human_points(0.0), human_points(1.2), human_points(0.5)]
    q = np.arange(6.0).reshape(3, 2)
    rows = sheet_rows(
        recording_of(*shown), {"fist": 1, "pinch": None, "claw": 2}, [q, -q]
    )
    assert [(row.label, row.note) for row in rows] == [
        ("fist", "0.50 s"),
        ("claw", "1.00 s"),
    ]
    np.testing.assert_allclose(rows[0].landmarks, shown[1], atol=1e-6)
    np.testing.assert_array_equal(rows[1].q, [q[2], -q[2]])
    left = recording_of(
        *(human_points(c, "human_left") for c in (0.0, 1.2)), side="left"
    )
    (row,) = sheet_rows(left, {"fist": 1}, [])
    np.testing.assert_allclose(
        row.landmarks, human_points(1.2, "human_left"), atol=1e-6
    )


@pytest.mark.slow
def test_png_says_what_it_shows(robot: Hand, tmp_path: Path) -> None:
    straight, bent = postures(robot)
    recording = recording_of(human_points(0.0), human_points(1.2))
    poses = {"open": 0, "fist": 1, "ring pinch": None}
    methods = [("ours", robot, np.array([straight, bent]))]
    file = save_contact_sheet(tmp_path / "sheet.png", recording, poses, methods)
    from matplotlib.image import imread

    picture = imread(file)
    rows = sheet_rows(recording, poses, [q for _, _, q in methods])
    figure = contact_sheet(
        [("ours", robot)], rows, title="made", footnote="Not shown: x."
    )
    words = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert {"human", "ours", "open", "fist", "made", "Not shown: x."} <= words
    # A pixel of the file is a pixel of the picture, so that nothing is blurred.
    drawn = pixels(figure)
    assert picture.shape[:2] == drawn.shape[:2]
    for column in range(2):
        for row in range(2):
            saved = cell(picture[..., :3], column, row, 1)
            np.testing.assert_allclose(saved, cell(drawn, column, row, 1), atol=0.01)


def test_what_does_not_fit_is_named(robot: Hand) -> None:
    recording = recording_of(human_points(0.0), human_points(1.0))
    q = np.array([robot.rest, robot.rest])
    with pytest.raises(InvalidInputError) as error:
        sheet_rows(recording, {"open": 0}, [q, q[:1]])
    assert error.value.argument == "motions[1]"
    for index in (2, -1):
        with pytest.raises(InvalidInputError) as error:
            sheet_rows(recording, {"open": index}, [q])
        assert error.value.argument == "poses['open']"
    with pytest.raises(InvalidInputError) as error:
        contact_sheet([("ours", robot)], [])
    assert error.value.argument == "rows"
