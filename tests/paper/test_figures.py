"""The paper's figures: every one with its numbers and its paragraph, all of them or none."""

import csv
import importlib
import re
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from section_four import drawings, figures
from section_four.drawings import box_triangles
from section_four.experiment import (
    Setting,
    object_error,
    paper_scene,
    run_experiment,
)
from section_four.figures import (
    FIGURES,
    FigureRecord,
    FiguresResult,
    run_figures,
)

from handmap_qp.apps.tables import markdown_table
from handmap_qp.errors import InvalidInputError

pytest.importorskip("matplotlib")
pytest.importorskip("trimesh")

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
NAMES = tuple(FIGURES)
TABLES = ("claims.csv", "final_errors.csv", "report.md")


@pytest.fixture(scope="module")
def quick() -> Iterator[None]:
    """Make fewer runs and coarser pictures by the same code."""
    draw = drawings.draw_hands

    def draw_coarsely(*arguments: Any, **named: Any) -> None:
        named["supersampling"] = 1
        draw(*arguments, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "GAMMAS", (0.1, 0.5, 1.0))
        patch.setattr(figures, "STEPS", (5, 20))
        patch.setattr(figures, "TABLE_STEPS", (5, 20))
        patch.setattr(drawings, "draw_hands", draw_coarsely)
        patch.setattr(drawings, "load_shape", cache(drawings.load_shape))
        yield


@pytest.fixture(scope="module")
def result(quick: None, tmp_path_factory: pytest.TempPathFactory) -> FiguresResult:
    done = []
    folder = tmp_path_factory.mktemp("figures") / "new" / "folder"
    made = run_figures(folder, progress=lambda: done.append(1))
    assert len(done) == len(NAMES)
    return made


@pytest.fixture(scope="module")
def folder(result: FiguresResult) -> Path:
    return result.files[0].parent


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as lines:
        return list(csv.DictReader(lines))


def test_every_figure_comes_as_png_svg_and_numbers(
    result: FiguresResult, folder: Path
) -> None:
    expected = sorted(
        [
            *(f"{name}.{kind}" for name in NAMES for kind in ("csv", "png", "svg")),
            *TABLES,
        ]
    )
    assert [file.name for file in result.files] == expected
    assert sorted(file.name for file in folder.iterdir()) == expected


@pytest.mark.parametrize("name", NAMES)
def test_pictures_show_something(folder: Path, name: str) -> None:
    from matplotlib.image import imread

    image = imread(folder / f"{name}.png")
    assert min(image.shape[:2]) > 500
    assert 0.01 < (image[..., :3].min(axis=2) < 0.9).mean() < 0.6
    assert ET.parse(folder / f"{name}.svg").getroot().tag.endswith("svg")
    assert len(rows_of(folder / f"{name}.csv")) >= 4


def test_contacts_are_blue_and_red(folder: Path) -> None:
    from matplotlib.image import imread

    image = imread(folder / "figure_4_grasps.png")[..., :3]
    human, robot, cube = np.split(image[:, : 3 * (image.shape[1] // 3)], 3, axis=1)
    assert (human[..., 2] - human[..., 0] > 0.2).sum() > 300
    # The fingertips are orange; the marks inside them are red.
    assert ((robot[..., 0] - robot[..., 1] > 0.3) & (robot[..., 1] < 0.3)).sum() > 100
    for channel, other in ((0, 2), (2, 0)):
        assert (cube[..., channel] - cube[..., other] > 0.4).sum() > 300


def test_the_report_has_every_figure_with_a_paragraph(folder: Path) -> None:
    text = (folder / "report.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\((\w+)\.png\)", text) == list(NAMES)
    for paragraph in re.findall(r"\.png\)\n\n(.*?)\n(?:\n|$)", text):
        assert re.search(r"\d", paragraph), paragraph
        assert "nan" not in paragraph.split()
    assert text.count("| yes |") + text.count("| no |") + text.count("| assumed |") == 9


def test_the_claims_hold(result: FiguresResult) -> None:
    verdicts = [row["holds"] for row in result.claims]
    assert verdicts == ["assumed", "assumed", *["yes"] * 7]


def test_the_table_of_numbers_is_the_experiments(result: FiguresResult) -> None:
    assert len(result.numbers) == 12
    row = next(
        row
        for row in result.numbers
        if (row["robot hand"], row["object motion"], row["synergy"])
        == ("ours", "rigid", 2)
    )
    for column, setting in (
        ("gamma 0.5", Setting(2, 0.5, 20)),
        ("5 steps", Setting(2, steps=5)),
    ):
        assert row[column] == pytest.approx(
            1e3 * object_error(run_experiment(paper_scene("ours"), setting))
        )


@pytest.fixture
def light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make empty pictures, for tests of files."""
    from matplotlib.figure import Figure

    def made(name: str) -> FigureRecord:
        claim = {"the paper claims": "this", "we find": 1.0, "holds": "yes"}
        return FigureRecord(name, name, Figure(), [{"x": 1.0}], "Text.", [claim])

    monkeypatch.setattr(
        figures, "FIGURES", {name: partial(made, name) for name in NAMES}
    )
    monkeypatch.setattr(figures, "number_rows", lambda _: [{"gamma 1": 1.0}])


@pytest.mark.usefixtures("light")
def test_a_failure_keeps_earlier_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "figures"
    folder.mkdir()
    (folder / "report.md").write_text("old")

    def fail(*_: object) -> None:
        raise RuntimeError("no table")

    monkeypatch.setattr(figures, "number_rows", fail)
    with pytest.raises(RuntimeError, match="no table"):
        run_figures(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["figures"]
    assert [path.name for path in folder.iterdir()] == ["report.md"]
    assert (folder / "report.md").read_text() == "old"


@pytest.mark.usefixtures("light")
def test_a_file_in_the_way_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "figures").write_text("a file")
    with pytest.raises(InvalidInputError, match="expected a folder"):
        run_figures(tmp_path / "figures")


@pytest.mark.usefixtures("light")
def test_the_same_numbers_give_the_same_files(tmp_path: Path) -> None:
    for name in ("one", "other"):
        run_figures(tmp_path / name)
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "other" / file.name).read_bytes(), (
            file.name
        )


@pytest.mark.usefixtures("light")
def test_the_command_prints_the_claims(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "paper")
    importlib.import_module("paper_figures").main(["--out", str(tmp_path / "new")])
    out = capsys.readouterr().out
    assert "the paper claims" in out
    assert "report.md" in out


def test_a_markdown_table_is_one() -> None:
    text = markdown_table([{"what": "a|b", "mm": 1.23456}, {"what": "c", "mm": 2}])
    assert text == "| what | mm |\n| --- | ---: |\n| a\\|b | 1.235 |\n| c | 2 |"


def test_a_box_is_closed_and_looks_outwards() -> None:
    triangles = box_triangles(np.eye(4), np.array([1.0, 2.0, 3.0]))
    corners = triangles.vertices
    volume = (
        np.einsum(
            "ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])
        ).sum()
        / 6.0
    )
    assert volume == pytest.approx(6.0)
    assert (np.einsum("nci,nci->nc", triangles.normals, corners) > 0.0).all()
