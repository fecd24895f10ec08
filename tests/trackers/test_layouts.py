"""Every layout gives back the human model's own posture; what is not of a layout is rejected."""

from __future__ import annotations

import runpy
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from layout_cases import wrist_beside
from scipy.spatial.transform import Rotation

from handmap_core.trackers.wrist_axes import palm_axes
from handmap_qp import InvalidInputError, RecordingError, read_recording
from handmap_qp.hands import Side
from handmap_qp.hands.human import HUMAN_JOINTS
from handmap_qp.se3 import affine, transform_points
from handmap_qp.trackers.layouts import LAYOUTS
from handmap_qp.trackers.layouts.base import Layout, sized_human
from handmap_qp.trackers.layouts.files import read_with_layout
from handmap_qp.trackers.layouts.points import PointLayout
from handmap_qp.trackers.layouts.tables import load_layout, table_text
from handmap_qp.trackers.plausibility import examine_recording

SIDES: tuple[Side, ...] = ("right", "left")
TABLES = Path(__file__).resolve().parents[2] / "handmap_qp" / "trackers" / "layouts"


def posture(
    side: Side, seed: int = 0, bend: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """A posture near rest and a wrist pose."""
    human, rng = sized_human(side), np.random.default_rng(seed)
    q = np.clip(
        bend * human.rest + rng.normal(0, 0.12, 20),
        human.lower_limits,
        human.upper_limits,
    )
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    return q, affine(turn, np.array([0.3, 1.1, -0.2]))


@cache
def bending() -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """A second of a bending hand at 60 Hz."""
    shares = np.linspace(0.0, 1.0, 60)
    return tuple(posture("right", seed=5, bend=0.6 + 0.8 * share) for share in shares)


def truth(side: Side, q: np.ndarray, wrist: np.ndarray) -> np.ndarray:
    return transform_points(wrist, sized_human(side).points(q))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=lambda layout: layout.name)
def test_a_posture_of_the_model_comes_back(layout: Layout, side: Side) -> None:
    q, wrist = posture(side)
    values = layout.write_posture(sized_human(side), q, wrist)
    assert values.shape == layout.shapes[0]
    beside = wrist_beside(layout, wrist, side)
    sample = layout.read(values, time=2.0, side=side, wrist=beside)
    assert (sample.time, sample.side, sample.valid) == (2.0, side, True)
    expected = wrist
    if layout.wrist is None and not layout.has_wrist:
        assert sample.wrist is None
    else:
        assert sample.wrist is not None
        np.testing.assert_allclose(sample.wrist, expected, atol=1e-4)
    # Markers are fitted iteratively; all others are exact.
    tolerance = 1e-5 if layout.name.startswith("markers") else 1e-12
    np.testing.assert_allclose(sample.landmarks, truth(side, q, wrist), atol=tolerance)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=lambda layout: layout.name)
def test_a_sample_comes_back_and_flat_rows_are_read(layout: Layout) -> None:
    q, wrist = posture("right", seed=1)
    sample = load_layout("mediapipe21").read(
        truth("right", q, wrist), time=0.0, side="right"
    )
    values = layout.write(sample)
    again = layout.read(
        values.ravel(),
        time=0.0,
        side="right",
        wrist=wrist_beside(layout, wrist, "right"),
    )
    # Angles and markers go through a fit of a hand of other lengths, and their wrist through a palm
    # fit: compare shapes, which are distances.
    is_exact = isinstance(layout, PointLayout)
    gaps = [
        np.linalg.norm(points[[4, 8, 12, 16, 20]] - points[0], axis=1)
        for points in (again.landmarks, sample.landmarks)
    ]
    np.testing.assert_allclose(*gaps, atol=1e-9 if is_exact else 0.04)


@pytest.mark.parametrize("name", ["openxr26", "unity26", "visionpro27", "webxr25"])
def test_all_forms_of_a_joint_mean_the_same(name: str) -> None:
    layout = load_layout(name)
    assert isinstance(layout, PointLayout)
    q, wrist = posture("left", seed=2)
    human = sized_human("left")
    for size in layout.poses:
        other = msgspec.structs.replace(layout, poses=(size,))
        values = other.write_posture(human, q, wrist)
        sample = layout.read(values, time=0.0, side="left")
        np.testing.assert_allclose(
            sample.landmarks, truth("left", q, wrist), atol=1e-12
        )
        assert (sample.wrist is None) == (size == 3)
        if sample.wrist is not None:
            np.testing.assert_allclose(sample.wrist, wrist, atol=1e-12)


def test_a_quest_has_the_layout_of_its_browser() -> None:
    assert load_layout("quest") is load_layout("webxr25") is LAYOUTS["quest"]
    assert table_text("quest") == table_text("webxr25")
    assert "quest" not in [*LAYOUTS]


@pytest.mark.parametrize("side", SIDES)
def test_a_real_headset_is_read_by_its_table(side: Side, recordings: Path) -> None:
    file = recordings / f"quest3_webxr_{side}.npz"
    content, recording = np.load(file), read_recording(file)
    poses = content["joints_pose"][recording.valid][
        :, :, [0, 1, 2, 4, 5, 6, 3]
    ]  # to xyzw
    landmarks, wrists = load_layout("webxr25").hands(poses, side, None, None)
    np.testing.assert_allclose(
        landmarks, recording.landmarks[recording.valid], atol=1e-9
    )
    assert wrists is not None
    sign = 1.0 if side == "right" else -1.0
    palms = palm_axes(landmarks, sign)
    turns = Rotation.from_matrix(
        palms.transpose(0, 2, 1) @ wrists[:, :3, :3]
    ).magnitude()
    # The wrist's axes are ours, but for what trackers mean by distal.
    assert np.degrees(turns).max() < 15.0


@pytest.mark.parametrize("name", ["leap26", "mano21"])
def test_a_wrist_beside_the_values_may_be_seven_numbers(name: str) -> None:
    layout = load_layout(name)
    q, wrist = posture("left", seed=7)
    values = layout.write_posture(sized_human("left"), q, wrist)
    beside = wrist_beside(layout, wrist, "left")
    assert beside is not None
    assert layout.wrist is not None
    xyzw = Rotation.from_matrix(beside[:3, :3]).as_quat()
    quat = np.roll(xyzw, 1) if layout.wrist.quaternion == "wxyz" else xyzw
    seven = np.concatenate([beside[:3, 3], quat])
    sample = layout.read(values, time=0.0, side="left", wrist=seven)
    assert sample.wrist is not None
    np.testing.assert_allclose(sample.wrist, wrist, atol=1e-12)


def test_a_ragged_wrist_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="wrist: expected numbers"):
        load_layout("visionpro25").read(
            np.ones((25, 3)), time=0.0, side="right", wrist=[[0.0, []]]
        )


def test_the_axes_of_a_wrist_are_those_that_the_table_names() -> None:
    # Ultraleap: millimetres, fingers along -z, back of the hand along +y.
    layout, pose = load_layout("leap26"), np.eye(4)
    pose[:3, 3] = 100.0, 200.0, 300.0
    sample = layout.read(np.ones((26, 3)), time=0.0, side="right", wrist=pose)
    assert sample.wrist is not None
    expected = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    np.testing.assert_allclose(sample.wrist[:3, :3], expected, atol=1e-15)
    np.testing.assert_allclose(sample.wrist[:3, 3], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(sample.landmarks, 0.001)


def test_markers_of_a_left_hand_are_the_mirror_image() -> None:
    layout, (q, _) = load_layout("markers13"), posture("right")
    right = layout.write_posture(sized_human("right"), q, np.eye(4))
    left = layout.write_posture(sized_human("left"), q, np.eye(4))
    np.testing.assert_allclose(left, right * (-1.0, 1.0, 1.0), atol=1e-12)


def test_shape_errors_name_the_layouts_of_that_shape() -> None:
    with pytest.raises(InvalidInputError) as caught:
        load_layout("webxr25").read(np.zeros((26, 3)), time=0.0, side="right")
    assert caught.value.argument == "values"
    assert "leap26, openxr26, unity26" in str(caught.value)
    with pytest.raises(InvalidInputError, match="shape"):
        load_layout("manus").read(np.zeros((19,)), time=0.0, side="right")
    for values in ("points", None, 3.0, [[1.0, "x"]]):
        with pytest.raises(InvalidInputError):
            load_layout("mediapipe21").read(values, time=0.0, side="right")  # ty: ignore[invalid-argument-type]


def test_degrees_radians_and_signs_of_angles_are_found() -> None:
    q, wrist = posture("right")
    rows = np.array([q, posture("right", seed=3)[0]])
    angles, manus = load_layout("angles20"), load_layout("manus")
    time = [0.0, 0.02]
    degrees = np.degrees(rows) * (1.0 + np.arange(2)[:, None])
    with pytest.raises(InvalidInputError, match="these are degrees"):
        angles.record("a", time, degrees, "right")
    glove = np.array(
        [manus.write_posture(sized_human("right"), row, wrist) for row in rows]
    )
    manus.record("a", time, glove, "right")
    with pytest.raises(InvalidInputError, match="these are radians"):
        manus.record("a", time, np.radians(glove), "right")
    with pytest.raises(InvalidInputError, match="turn the sign"):
        manus.record("a", time, -1.5 * glove, "right")


def test_angles_are_found_by_name_with_aliases_prefixes_and_defaults() -> None:
    manus = load_layout("manus")
    q, wrist = posture("left", seed=4)
    q[HUMAN_JOINTS.index("index_MCP_abduction")] = 0.0
    values = manus.write_posture(sized_human("left"), q, wrist)
    named: dict[str, Any] = dict(zip(manus.columns, values.tolist(), strict=True))
    plain = manus.read(named, time=0.0, side="left")
    del named["IndexMCPSpread"]  # as of a ROS 2 node that leaves it out
    prefixed = {f"LeftFinger{name}": value for name, value in named.items()}
    prefixed |= {f"RightFinger{name}": 0.0 for name in named}
    aliased = {
        name: value for name, value in named.items() if name != "MiddleMCPSpread"
    }
    aliased["Middle_MCP_Spread"] = named["MiddleMCPSpread"]
    for values in (prefixed, aliased):
        sample = manus.read(values, time=0.0, side="left")
        np.testing.assert_allclose(sample.landmarks, plain.landmarks, atol=1e-12)
    del named["RingPIPStretch"]
    with pytest.raises(InvalidInputError, match="a column RingPIPStretch"):
        manus.read(named, time=0.0, side="left")


def test_a_table_of_ones_own_is_one_file(tmp_path: Path) -> None:
    text = (TABLES / "angles20.yaml").read_text(encoding="utf-8")
    own = tmp_path / "mine.yaml"
    own.write_text(
        text.replace("unit: rad", "unit: deg").replace("name: angles20", "name: mine")
    )
    q, _ = posture("right")
    sample = load_layout(own).read(np.degrees(q), time=0.0, side="right")
    np.testing.assert_allclose(
        sample.landmarks, truth("right", q, np.eye(4)), atol=1e-12
    )
    for old, new, word in (
        ("unit: rad", "unit: furlong", "unit"),
        ("kind: angles", "kind: guess", "kind"),
        (
            "joint: thumb_TM_flexion",
            "joint: thumb_TM_flection",
            "did you mean thumb_TM_flexion",
        ),
        ("values:", "value:", "value"),
        ("name: angles20", "name: [", str(own)),
    ):
        own.write_text(text.replace(old, new, 1))
        with pytest.raises(InvalidInputError) as caught:
            load_layout(own)
        assert word in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(InvalidInputError, match="did you mean openxr26"):
        load_layout("openxr")
    with pytest.raises(InvalidInputError, match="cannot be read"):
        load_layout(tmp_path / "none.yaml")


def test_every_table_has_sources_and_says_what_it_lacks() -> None:
    assert len(LAYOUTS) >= 15
    for layout in LAYOUTS.values():
        assert layout.name in LAYOUTS
        assert layout.sources
        assert layout.axes
        assert layout.values
        assert len(layout.rows()) >= 13
        if not layout.has_wrist:
            assert any("wrist" in item or "place" in item for item in layout.missing)


def file_of(folder: Path, layout: Layout, **changes: Any) -> Path:
    """A bending hand in a layout's own form."""
    human = sized_human("right")
    values = np.array([layout.write_posture(human, q, wrist) for q, wrist in bending()])
    content = {
        "time": np.arange(60) / 60.0,
        layout.arrays[0]: values,
        "handedness": np.array("right"),
        **changes,
    }
    path = folder / "hand.npz"
    arrays: Any = {name: array for name, array in content.items() if array is not None}
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=lambda layout: layout.name)
def test_files_in_a_layout_are_read_and_plausible(
    layout: Layout, tmp_path: Path
) -> None:
    if layout.name.startswith("markers"):
        pytest.skip("sixty fits; test_a_posture_of_the_model_comes_back has them")
    recording = read_with_layout(file_of(tmp_path, layout), layout)
    q, wrist = posture("right", seed=5, bend=0.6)
    expected = truth("right", q, wrist)
    if not layout.has_wrist and layout.unit in ("deg", "rad"):
        expected = truth("right", q, np.eye(4))
    if layout.name != "visionpro25":
        np.testing.assert_allclose(recording.landmarks[0], expected, atol=1e-9)
    assert examine_recording(recording) is None


@pytest.mark.parametrize("kind", [np.uint16, np.uint32, np.uint64, np.int32, np.int64])
def test_counters_of_a_clock_may_wrap_around_and_not_go_back(
    kind: type[np.unsignedinteger | np.signedinteger], tmp_path: Path
) -> None:
    layout = LAYOUTS["mediapipe21"]
    path = file_of(tmp_path, layout)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file if name != "time"}
    count = len(bending())
    # Half a second before the counter of milliseconds starts again.
    ticks = (np.iinfo(kind).max - 500) + 16 * np.arange(count).astype(object)
    width = 8 * np.dtype(kind).itemsize
    wrapped = np.array([tick % 2**width for tick in ticks], f"u{width // 8}")
    np.savez(path, allow_pickle=False, **arrays, time_ms=wrapped.view(kind))
    read = read_with_layout(path, layout)
    np.testing.assert_allclose(read.time, 0.016 * np.arange(count), atol=1e-9)
    # A clock that was set after the first sample: as unsigned numbers, all others are after it.
    back = np.array([30000, *range(3, 2 + count)], kind)
    np.savez(path, allow_pickle=False, **arrays, time_ms=back)
    with pytest.raises(RecordingError, match="strictly increasing"):
        read_with_layout(path, layout)


@pytest.mark.parametrize(
    ("written", "read", "named"),
    [
        ("leap26", "openxr26", "unit"),
        ("unity26", "openxr26", "unity26"),
        ("mano21", "mediapipe21", "mano21"),
        ("interhand21", "bighand21", "interhand21"),
        ("mediapipe21", "rhd21", "mediapipe21"),
    ],
)
def test_a_file_in_another_layout_is_refused_and_named(
    written: str, read: str, named: str, tmp_path: Path
) -> None:
    layout = load_layout(written)
    path = file_of(tmp_path, layout)
    if written == "leap26":  # the same shape only as positions
        named = "leap26"
    if written == "unity26":  # palm and wrist exchanged, and left-handed
        content = dict(np.load(path))
        np.savez(path, **(content | {"joints": content["joints"][:, :, :3]}))
    with pytest.raises(RecordingError) as caught:
        read_with_layout(path, load_layout(read))
    assert f"--layout {named}" in str(caught.value) or f" or {named}" in str(
        caught.value
    )


def test_of_several_arrays_that_fit_the_usual_name_or_the_side_is_taken(
    tmp_path: Path,
) -> None:
    layout = load_layout("openxr26")
    path = file_of(tmp_path, layout)
    content: dict[str, Any] = dict(np.load(path))
    values = content.pop("joints")
    whole = read_with_layout(path, layout)
    for names in (("other", "joints"), ("left_values", "right_values")):
        arrays = {names[0]: values + 9.0, names[1]: values}
        np.savez(path, **content, **arrays)
        found = read_with_layout(path, layout, "right")
        np.testing.assert_array_equal(found.landmarks, whole.landmarks)
    np.savez(path, **content, one=values, two=values)
    with pytest.raises(RecordingError, match="has more than one array of shape"):
        read_with_layout(path, layout)


def test_csv_columns_of_a_glove(tmp_path: Path) -> None:
    manus = load_layout("manus")
    rows = []
    for i, share in enumerate(np.linspace(0.0, 1.0, 40)):
        q, wrist = posture("right", seed=6, bend=0.5 + share)
        values = manus.write_posture(sized_human("right"), q, wrist)
        rows.append(
            f"{i},{1000.0 * i / 60:.6f}," + ",".join(f"{v:.9f}" for v in values)
        )
    # The glove was silent: cells are empty, or the row ends early.
    rows[7] = "7,116.666667" + "," * 20
    rows[9] = "9,150.000000"
    header = "Frame,Elapsed_Time_In_Milliseconds," + ",".join(manus.columns)
    path = tmp_path / "glove.csv"
    path.write_text("\n".join([header, *rows]), encoding="utf-8")
    recording = read_with_layout(path, manus, "right")
    assert np.flatnonzero(~recording.valid).tolist() == [7, 9]
    np.testing.assert_allclose(recording.steps, 1.0 / 60.0, atol=1e-6)
    q, _ = posture("right", seed=6, bend=0.5)
    np.testing.assert_allclose(
        recording.landmarks[0], truth("right", q, np.eye(4)), atol=1e-8
    )
    with pytest.raises(RecordingError, match="give --side"):
        read_with_layout(path, manus)
    path.write_text("\n".join([header, *rows[:3], rows[3].replace(",", ",x", 3)]))
    with pytest.raises(RecordingError, match=r"line 5: .*expected a number"):
        read_with_layout(path, manus, "right")


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"time": None}, "has no time"),
        ({"joints": np.zeros((60, 25, 3))}, "webxr25"),
        ({"handedness": None}, "--side"),
        ({"handedness": np.array("both")}, "handedness"),
        ({"time": np.arange(60) * 16.7}, "milliseconds"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_bad_files_are_one_clear_line(
    changes: dict[str, Any], word: str, tmp_path: Path
) -> None:
    layout = load_layout("openxr26")
    path = file_of(tmp_path, layout, **changes)
    with pytest.raises(RecordingError) as caught:
        read_with_layout(path, layout)
    assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_pages_of_trackers_are_those_of_the_tables() -> None:
    folder = TABLES.parents[2] / "docs"
    pages = runpy.run_path(str(folder / "layouts.py"), run_name="layouts")["pages"]()
    assert {f"{layout.name}.md" for layout in LAYOUTS.values()} == {
        file.name for file in (folder / "trackers").iterdir()
    }
    for file, text in pages.items():
        assert file.read_text(encoding="utf-8") == text, "run python docs/layouts.py"


@given(st.data())
def test_anything_else_is_refused_in_one_line(data: st.DataObject) -> None:
    layout, side = (
        data.draw(st.sampled_from([*LAYOUTS.values()])),
        data.draw(st.sampled_from(SIDES)),
    )
    shape = st.sampled_from(layout.shapes) | array_shapes(
        min_dims=0, max_dims=3, max_side=30
    )
    numbers = st.floats(-1e6, 1e6) | st.floats()
    values = data.draw(arrays(float, data.draw(shape), elements=numbers))
    problem, sample = None, None
    try:
        sample = layout.read(values, time=0.0, side=side)
    except InvalidInputError as error:
        problem = str(error)
    assert problem is None or "\n" not in problem
    if sample is not None and sample.valid:
        assert np.isfinite(sample.landmarks).all()


@given(data=st.data())
def test_changed_tables_are_read_or_refused(
    data: st.DataObject, tmp_path_factory: Any
) -> None:
    name = data.draw(st.sampled_from(tuple(LAYOUTS)))
    lines = (TABLES / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
    place = data.draw(st.integers(0, len(lines) - 1))
    lines[place] = data.draw(
        st.sampled_from(
            ["", "count: 3", "poses: []", "unit: 7", "- x", lines[place][::-1], "]"]
        )
    )
    file = tmp_path_factory.mktemp("table") / "own.yaml"
    file.write_text("\n".join(lines), encoding="utf-8")
    problem, layout = None, None
    try:
        layout = load_layout(file)
    except InvalidInputError as error:
        problem = str(error)
    if layout is None:
        assert str(file) in str(problem)
        assert "\n" not in str(problem)
    else:
        assert layout.rows()
