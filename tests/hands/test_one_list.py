"""The one list of hands: each installed one opens everywhere, each other is refused in a line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from marks import rotated
from service_tools import CACHE, client_of, connected, human_q, opening, serving

from handmap_qp import Hand, HandError, HandSpec, hand_names, load_hand
from handmap_qp.apps.onboarding.describe import list_hands
from handmap_qp.apps.service.opening import HandCache, prepare_hands
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.viewer.figure import link_meshes
from handmap_qp.cli import COMMANDS, main, parse
from handmap_qp.errors import RefusedError
from handmap_qp.hands import library
from handmap_qp.hands.library import HUMAN_HANDS, hand_files, missing_hands
from handmap_qp.hands.sources import urdf_path
from handmap_qp.hands.spec import read_hand_spec

# Installed packages and descriptions: no path of the mapping.

INSTALLED = hand_names()
ROBOTS = [name for name in INSTALLED if name not in HUMAN_HANDS]
# One hand of each URDF.
OF_URDFS = sorted(
    {urdf_path(read_hand_spec(hand_files()[name])): name for name in INSTALLED}.values()
)
# One hand of a package for each way to install it: all others are refused alike.
FOR_EACH_REASON = sorted(
    {reason: name for name, reason in missing_hands().items()}.values()
)[:2]
# How a hand is given to each command that takes one.
LINES = {
    "demo": "demo --robot {}",
    "retarget": "retarget demo --robot {}",
    "batch": "batch demo --robot {} --out mapped",
    "compare": "compare demo --robot {}",
    "view": "view demo --robot {}",
    "simulate": "simulate demo::right --robot {}",
    "hands show": "hands show {}",
    "hands check": "hands check {}",
    "hands match": "hands match {}",
    "hands pack": "hands pack {} --out packed",
    "hands edit": "hands edit {}",
    "hands save": "hands save {}",
    "track replay": "track replay demo --to 127.0.0.1 --robot {}",
    "track mediapipe": "track mediapipe --camera 0 --to 127.0.0.1 --robot {}",
}

LOCAL = [command for command in LINES if not command.startswith("track")]
"""Those that load the hand themselves; the others name it to the service."""


def test_it_is_the_installed_hands_and_the_missing_ones() -> None:
    files, missing = hand_files(), missing_hands()
    assert set(INSTALLED) | set(missing) == set(files)
    assert not set(INSTALLED) & set(missing)
    assert {"human", "three_finger"} <= set(INSTALLED)
    assert len(files) == 32
    # Hands beside a robot.yaml are those of that robot only.
    assert not {file.name for file in files.values()} & {"left.yaml", "right.yaml"}
    rows = {row["name"]: row["available"] for row in list_hands()}
    assert rows == {
        name: f"no: {missing[name]}" if name in missing else "yes" for name in files
    }
    cache = HandCache()
    assert (set(cache.robots), cache.missing) == (set(ROBOTS), missing)


@pytest.mark.slow
@pytest.mark.parametrize("name", rotated(OF_URDFS, 3, 1))
def test_a_hand_of_every_urdf_loads_and_can_be_drawn(name: str) -> None:
    hand = load_hand(name)
    assert hand.name == name
    assert link_meshes(hand)


def test_every_command_that_takes_a_hand_is_here() -> None:
    taking = {
        name
        for name, place in COMMANDS.items()
        if {"hand", "robot", "target"} & {item.name for item in fields(place.load())}
    }
    # The hands of `serve` are paths of further ones; `robots` takes robots with two hands;
    # `map` is `retarget`; `live` starts a service, to which the page names the robot.
    others = {"serve", "live", "robots show", "robots check", "map"}
    assert taking - others == set(LINES)


@pytest.mark.slow
@pytest.mark.parametrize("command", LOCAL)
def test_every_command_loads_the_hand_that_it_names(
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = ROBOTS[0]

    def load(spec: HandSpec, **choices: Any) -> Hand:
        if spec.name == name:
            raise HandError("the command asks for the hand")
        return Hand(spec, **choices)

    monkeypatch.setattr(library, "Hand", load)
    # Hands that this process has loaded already are not built again.
    monkeypatch.setattr(library, "_named", library._named.__wrapped__)
    monkeypatch.chdir(tmp_path)
    assert main(LINES[command].format(name).split()) == 2
    assert capsys.readouterr().err.endswith(" the command asks for the hand\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "name"),
    [
        *((command, name) for command in LOCAL for name in FOR_EACH_REASON[:1]),
        *(("retarget", name) for name in FOR_EACH_REASON[1:]),
    ],
)
def test_every_command_says_what_installs_a_missing_hand(
    command: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(LINES[command].format(name).split()) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert printed.endswith(f" is not installed: {missing_hands()[name]}\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", sorted(set(LINES) - set(LOCAL)))
@pytest.mark.parametrize("name", ROBOTS[:2])
def test_trackers_pass_the_name_on(command: str, name: str) -> None:
    parsed: Any = parse(LINES[command].format(name).split())
    assert parsed.target.robot == name


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as server:
        yield server


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS[::3])
def test_installed_hands_open_over_the_wire(server: Server, name: str) -> None:
    with connected(server, name, preset=None) as client:
        command = client.step(q=human_q(), wrist=np.eye(4))
        assert command.joint_names == load_hand(name).joint_names
    with client_of(server) as client:
        state = client.status()
    assert (set(state.robots), state.missing) == (set(ROBOTS), missing_hands())


@pytest.mark.parametrize("name", FOR_EACH_REASON)
def test_the_wire_says_what_installs_a_missing_hand(name: str) -> None:
    assert name not in CACHE.robots
    with pytest.raises(RefusedError) as caught:
        prepare_hands(opening(name), CACHE)
    assert caught.value.field == "robot"
    assert str(caught.value).endswith(f" is not installed: {missing_hands()[name]}")


def test_a_file_of_ones_own_may_have_the_name_of_a_missing_hand(tmp_path: Path) -> None:
    file = tmp_path / "hand.yaml"
    text = hand_files()["three_finger"].read_text(encoding="utf-8")
    (tmp_path / "hand.urdf").write_text(
        load_hand("three_finger").urdf_text, encoding="utf-8"
    )
    for name in ("three_finger", *sorted(missing_hands())[:1]):
        file.write_text(
            re.sub(r"(?m)^name:.*$", f"name: {name}", text), encoding="utf-8"
        )
        if name == "three_finger":
            with pytest.raises(
                HandError, match="there is already a hand 'three_finger'"
            ):
                HandCache([file])
        else:
            cache = HandCache([file])
            assert name in cache.robots
            assert name not in cache.missing
            assert cache.robot(name, None, None).name == name
