"""`handmap compare`: tables, JSON and pictures, and one line for every mistake."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from coarse_drawing import draw_coarsely
from comparison_cases import write_closing
from PIL import Image
from sheet_cells import cell_of

from handmap_qp import cli
from handmap_qp.apps.drawing.contact_sheet import CELL, FINGER_COLOURS
from handmap_qp.apps.offline.metrics import METRICS

ROOT = Path(__file__).resolve().parents[2]

PROGRAM = """
import json, sys
import numpy as np
if sys.argv[1] == "list":
    print(json.dumps([{"name": "theirs", "about": "theirs 1.0"}, {"name": "failing"}]))
elif sys.argv[2] == "failing":
    sys.exit("failing: the solver found nothing")
else:
    with np.load(sys.argv[4]) as arrays:
        count = len(arrays["time"])
    np.savez(sys.argv[5], q=np.full((count, 16), 0.3), step_time=np.full(count, 1e-3))
"""


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    """A right and a left recording."""
    return [
        str(write_closing(tmp_path, "one", seconds=2.4)),
        str(write_closing(tmp_path, "two", side="left")),
    ]


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_coarsely(monkeypatch)


def picture(file: Path) -> np.ndarray:
    """Return red, green and blue in 0..1, shape (height, width, 3)."""
    return np.asarray(Image.open(file).convert("RGB")) / 255.0


def has_colour(cell: np.ndarray, colour: tuple[float, float, float]) -> bool:
    """Return whether a cell has shaded pixels of a hue."""
    bright = cell.max(axis=2, keepdims=True)
    hue = cell / np.maximum(bright, 1e-6)
    wanted = np.array(colour) / max(colour)
    near = (np.abs(hue - wanted).max(axis=2) < 0.15) & (bright[..., 0] > 0.2)
    return bool(near.sum() > 30)


@pytest.mark.slow
@pytest.mark.usefixtures("coarse")
def test_writes_tables_json_and_pictures(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "compare.py").write_text(PROGRAM, encoding="utf-8")
    out = tmp_path / "new" / "folder"
    words = [
        "compare",
        *files,
        "--robot",
        "allegro_right",
        "--methods",
        "teleoperation",
        "paper",
    ]
    words += ["--peers", "--peers-from", str(tmp_path), "--out", str(out)]
    assert cli.main(words) == 0
    printed = capsys.readouterr()
    assert (
        printed.err == "handmap: mirrored, because allegro_right is a right hand: two\n"
    )
    assert "failing: the solver found nothing" in printed.out
    names = ["table.md", "results.json", "metrics.png", "poses.png"]
    assert sorted(path.name for path in out.iterdir()) == sorted(names)
    assert [line.split("/")[-1] for line in printed.out.splitlines()[-4:]] == names

    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    methods = ["teleoperation", "paper", "theirs", "theirs+limits"]
    methods += ["failing", "failing+limits"]
    assert list(results["overall"]) == methods
    assert results["methods"]["theirs"] == {"about": "theirs 1.0"}
    limited = results["methods"]["theirs+limits"]["about"]
    assert limited == "theirs 1.0, clipped by the joints' limits"
    assert [metric["key"] for metric in results["metrics"]] == [m.key for m in METRICS]
    assert [(r["name"], r["is_mirrored"]) for r in results["recordings"]] == [
        ("one", False),
        ("two", True),
    ]
    # The hand closes with its thumb aside, so no pinch occurs, and a line says so.
    counts = {r["name"]: r["pinch_samples"] for r in results["recordings"]}
    note = next(n for n in results["notes"] if n.startswith("samples of pinches"))
    for name, count in counts.items():
        assert (f"{count} in {name}" in note) == (count > 0)
    assert note.endswith("none") == (not any(counts.values()))
    for name in ("one", "two"):
        runs = results["runs"][name]
        assert list(runs) == methods
        assert runs["failing"]["problem"] == "failing: the solver found nothing"
        assert set(runs["failing"]["values"].values()) == {None}
        assert runs["theirs"]["values"]["palm_deg"] is None
        assert list(runs["paper"]["fingers"]) == ["thumb", "index", "middle", "ring"]
    for key in ("extension_correlation", "object_rotation_deg", "step_time_ms"):
        both = [
            results["runs"][name]["paper"]["values"][key] for name in ("one", "two")
        ]
        assert results["overall"]["paper"][key] == pytest.approx(np.mean(both))

    table = (out / "table.md").read_text(encoding="utf-8")
    for method in methods:
        # Overall and two recordings in every group of metrics, and the short table.
        assert table.count(f"\n| {method} |") == 3 * 5 + 1
    assert "failing: the solver found nothing." in table
    assert "| theirs | 0.00 |" in table  # It does not move.
    check_pictures(out)


def check_pictures(out: Path) -> None:
    """Check the pixels: one column for the human and each method that did not fail."""
    sheet = picture(out / "poses.png")
    assert sheet.shape[1] == cell_of(5, 0, 0)[0]
    rows = (sheet.shape[0] - cell_of(0, 0, 0)[1]) // CELL[1]
    assert rows >= 2  # Rows: open hand and fist.
    for column in range(5):
        x, y = cell_of(column, 0, 0)
        cell = sheet[y + 2 : y + CELL[1] - 2, x + 2 : x + CELL[0] - 2]
        assert has_colour(cell, FINGER_COLOURS["thumb"]), column
        assert has_colour(cell, FINGER_COLOURS["ring"]), column
        # Allegro has no little finger.
        assert has_colour(cell, FINGER_COLOURS["little"]) == (column == 0), column
    metrics = picture(out / "metrics.png")
    # The metrics of an object in the hand do not arise, so there are four rows of panels, not five.
    assert metrics.shape[0] / metrics.shape[1] < 0.46
    ours, theirs = (200, 69, 47), (63, 111, 181)
    for colour in (ours, theirs):
        near = np.abs(255.0 * metrics - np.array(colour)).max(axis=2) < 3.0
        assert near.sum() > 200


@pytest.mark.slow
def test_prints_json_and_writes_nothing(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(tmp_path.iterdir())
    words = [
        "compare",
        files[0],
        "--robot",
        "three_finger",
        "--methods",
        "paper",
        "--json",
    ]
    assert cli.main(words) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    results = json.loads(printed.out)
    assert results["robot"] == "three_finger"
    assert list(results["runs"]["one"]) == ["paper"]
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_peers_that_are_named_are_the_only_ones(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "compare.py").write_text(PROGRAM, encoding="utf-8")
    words = [
        "compare",
        files[0],
        "--robot",
        "allegro_right",
        "--methods",
        "theirs",
        "paper",
    ]
    words += ["--peers", "--peers-from", str(tmp_path), "--json"]
    assert cli.main(words) == 0
    assert list(json.loads(capsys.readouterr().out)["overall"]) == ["theirs", "paper"]


@pytest.mark.slow
def test_recording_without_a_pose_has_no_contact_sheet(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Another test looks at the picture of the metrics, which takes most of the time.
    monkeypatch.setattr(
        "handmap_qp.apps.offline.compare.draw_metrics", lambda file, _: file.touch()
    )
    # Half closed at its end: neither open nor a fist after the first half second.
    file = write_closing(tmp_path, "half")
    with np.load(file) as arrays:
        columns = {name: arrays[name].copy() for name in arrays}
    columns["landmarks"][:] = columns["landmarks"][30]
    columns["valid"][:] = True
    del columns["wrist_pose"]
    np.savez(file, **columns)
    out = tmp_path / "out"
    words = ["compare", str(file), "--robot", "three_finger", "--methods", "paper"]
    assert cli.main([*words, "--out", str(out)]) == 0
    assert (
        "no contact sheet; not shown: open, spread, pointing, fist"
        in capsys.readouterr().err
    )
    assert not (out / "poses.png").exists()
    assert (out / "metrics.png").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("coarse")
def test_sheet_of_many_methods_has_bands(
    files: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Another test looks at the picture of the metrics, which takes half of the time.
    monkeypatch.setattr("handmap_qp.apps.offline.compare.draw_metrics", lambda *_: None)
    out = tmp_path / "out"
    words = ["compare", files[0], "--robot", "three_finger", "--out", str(out)]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    methods = [
        line.split()[0] for line in printed.splitlines() if line.startswith(" tele")
    ]
    assert methods[:2] == ["teleoperation", "teleoperation+smooth"]
    sheet = picture(out / "poses.png")
    # Six methods beside the human, and the rest below, beside the human again.
    assert sheet.shape[1] == cell_of(7, 0, 0)[0]
    half = sheet.shape[0] // 2
    x, y = cell_of(0, 0, 0)
    for top in (0, half):
        cell = sheet[top + y + 2 : top + y + CELL[1] - 2, x + 2 : x + CELL[0] - 2]
        assert has_colour(cell, FINGER_COLOURS["little"])
    assert (sheet[half + y :, cell_of(6, 0, 0)[0] + 5 :] == 1.0).all()


BAD = {
    "no recording": ([], "RECORDING: expected at least one file"),
    "absent": (["absent.npz"], "absent.npz: cannot be read"),
    "twice": (
        ["{one}", "{one}"],
        "RECORDING: expected files of different names, got one twice",
    ),
    "method": (
        ["{one}", "--methods", "magic"],
        "--methods: expected some of teleoperation",
    ),
    "no peers": (
        ["{one}", "--methods", "dex-vector"],
        "nor installed here: pip install 'handmap-qp[peers]'",
    ),
    "method twice": (
        ["{one}", "--methods", "paper", "paper"],
        "methods: expected different names",
    ),
    "peers elsewhere": (
        ["{one}", "--peers", "--peers-from", "{folder}"],
        "no compare.py in",
    ),
    "out is a file": (["{one}", "--out", "{one}"], "--out: "),
}


@pytest.mark.parametrize("case", BAD)
def test_mistakes_are_one_line(
    case: str, files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if case == "no peers" and (ROOT / ".peers").exists():
        pytest.skip("`make peers` has installed them in this checkout")
    words, expected = BAD[case]
    given = [word.format(one=files[0], folder=tmp_path) for word in words]
    assert cli.main(["compare", "--robot", "three_finger", *given]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("handmap: ")
    assert expected in printed.err
    assert printed.err.count("\n") == 1
