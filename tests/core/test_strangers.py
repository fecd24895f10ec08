"""`bench_strangers` finds what is wrong in a description, and nothing else; its list is sound."""

from __future__ import annotations

import subprocess
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from made_loops import FINGERS as FINGERS_OF_LOOPS
from made_loops import tendons

from handmap_qp.apps.onboarding.findings import HandReport
from handmap_qp.apps.onboarding.init import DescribedHand, init_hands
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.errors import HandmapError

MADE = Path(__file__).parents[1] / "data" / "strangers" / "strangers.yaml"
Y = (0.0, 1.0, 0.0)


class Made(NamedTuple):
    """The made files, their entries by name, and what `init` makes of those with a hand."""

    truths: dict[str, Any]
    files: dict[str, Path]
    hands: dict[str, DescribedHand]
    robots: dict[str, Robot]


@pytest.fixture(scope="module")
def listing(benchmark: Callable[[str], Any]) -> Any:
    return benchmark("stranger_list")


@pytest.fixture(scope="module")
def verdicts(benchmark: Callable[[str], Any]) -> Any:
    return benchmark("stranger_verdicts")


@pytest.fixture(scope="module")
def made(listing: Any, tmp_path_factory: pytest.TempPathFactory) -> Made:
    truths = {one.name: one for one in listing.read_list(MADE).descriptions}
    files = {name: listing.path_of(one, MADE, MADE) for name, one in truths.items()}
    hands = {
        name: init_hands(
            files[name], out=tmp_path_factory.mktemp("made") / "hand.yaml"
        ).hands[0]
        for name, one in truths.items()
        if one.hands
    }
    return Made(truths, files, hands, {name: Robot(files[name]) for name in hands})


def wrong_keys(verdicts: Any, made: Made, name: str, **changes: Any) -> list[str]:
    """Compare a description with a truth that is not true."""
    (truth,) = made.truths[name].hands
    changed = msgspec.structs.replace(truth, **changes)
    found = verdicts.compare(made.hands[name], changed, made.robots[name])
    return [one.key for one in found]


FINGERS = {"thumb": "z_j2", "index": "a_j3", "middle": "b_j3", "ring": "c_j3"}
SWAPPED = {**FINGERS, "index": "c_j3", "ring": "a_j3"}


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("palm", {"palm": "a_l1", "frame": "palm"}),
        ("distal", {"distal": Y}),
        ("dorsal", {"dorsal": (0.0, 0.0, -1.0)}),
        ("side", {"side": "left"}),
        ("fingers", {"fingers": SWAPPED}),
        ("thumb", {"fingers": {**FINGERS, "thumb": "a_j3", "index": "z_j2"}}),
        ("chains", {"fingers": {**FINGERS, "little": "c_j3"}}),
        ("chains", {"fingers": {**FINGERS, "ring": "a_j3"}}),
        ("rest", {"closes": {"a_j1": "-"}}),
        ("rest", {"closes": {"a_j1": "+"}, "straight": {"a_j1": 1.5}}),
    ],
)
def test_each_wrong_key_is_found_alone(
    verdicts: Any, made: Made, key: str, changes: dict[str, Any]
) -> None:
    assert wrong_keys(verdicts, made, "chained mimics") == []
    assert wrong_keys(verdicts, made, "chained mimics", **changes) == [key]


def test_axes_are_compared_in_any_frame_and_within_an_angle(
    verdicts: Any, made: Made
) -> None:
    near, far = (
        tuple(np.cos(angle) * np.eye(3)[0] + np.sin(angle) * np.eye(3)[1])
        for angle in np.radians(verdicts.LARGEST_ANGLE + np.array([-5.0, 10.0]))
    )
    assert wrong_keys(verdicts, made, "chained mimics", distal=near) == []
    assert wrong_keys(verdicts, made, "chained mimics", distal=far) == ["distal"]
    name = "chained mimics"
    turn = made.robots[name].pose_in("palm", "z_l1")[:3, :3]
    (truth,) = made.truths[name].hands
    own = {key: tuple(turn @ getattr(truth, key)) for key in ("distal", "dorsal")}
    assert wrong_keys(verdicts, made, name, frame="z_l1", **own) == []


def test_either_jaw_may_be_the_thumb(verdicts: Any, made: Made) -> None:
    turned = {"jaws": ("minus", "plus"), "dorsal": (-1.0, 0.0, 0.0)}
    assert wrong_keys(verdicts, made, "two jaws") == []
    assert wrong_keys(verdicts, made, "two jaws", **turned) == []
    assert wrong_keys(verdicts, made, "two jaws", dorsal=(-1.0, 0.0, 0.0)) == ["dorsal"]
    assert wrong_keys(verdicts, made, "two jaws", jaws=("plus", "")) == []
    assert wrong_keys(verdicts, made, "two jaws", jaws=("plus", "plus")) == ["chains"]


def test_fingers_without_a_side_have_two_orders_and_alike_ones_all(
    verdicts: Any, made: Made
) -> None:
    name = "chained mimics"
    assert wrong_keys(verdicts, made, name, side="", fingers=SWAPPED) == []
    shuffled = {**FINGERS, "index": "b_j3", "middle": "a_j3"}
    assert wrong_keys(verdicts, made, name, side="", fingers=shuffled) == ["fingers"]
    alike = ("b_j3", "z_j2", "c_j3", "a_j3")
    assert wrong_keys(verdicts, made, name, fingers={}, alike=alike) == []
    assert wrong_keys(verdicts, made, name, fingers={}, alike=alike[:3]) == ["chains"]


def test_outcomes_of_files_with_and_without_hands(
    verdicts: Any, made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    def judged(name: str, **changes: Any) -> Any:
        changed = msgspec.structs.replace(made.truths[name], **changes)
        return verdicts.judge(changed, made.files[name])

    hands = made.truths["chained mimics"].hands
    refused = judged("no joints")
    assert refused.outcome == "refused rightly"
    assert refused.is_good
    assert "no joint" in refused.message
    assert judged("no joints", hands=hands, why="").outcome == "refused wrongly"
    vain = judged("two jaws", hands=(), why="none")
    assert vain.outcome == "found in vain"
    assert vain.is_misleading
    jaw = made.truths["two jaws"].hands[0]
    (count,) = judged("two jaws", hands=(jaw, jaw)).wrong
    assert count.key == "hands"
    turned = msgspec.structs.replace(jaw, distal=Y)
    (wrong,) = judged("two jaws", hands=(turned,)).wrong
    clue = next(one for one in made.hands["two jaws"].clues if one.what == "distal")
    assert (wrong.key, wrong.certainty) == ("distal", clue.certainty)
    assert not wrong.is_contradicted
    with pytest.raises(HandmapError, match="the file has no elbow"):
        judged("two jaws", hands=(msgspec.structs.replace(jaw, palm="elbow"),))

    def fail(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr(verdicts, "init_hands", fail)
    failed = judged("no joints")
    assert (failed.outcome, failed.is_good) == ("traceback", False)
    assert failed.message == "ZeroDivisionError: by nothing"


def test_the_list_is_sound(benchmark: Callable[[str], Any], listing: Any) -> None:
    listed = listing.read_list(benchmark("bench_strangers").LIST)
    for one in listed.descriptions:
        assert len(one.sha256) == 64
        assert one.package in listed.packages
        for hand in one.hands:
            assert np.linalg.norm(hand.distal) == pytest.approx(1.0, abs=0.02)
            assert bool(hand.fingers) + bool(hand.jaws) + bool(hand.alike) == 1
            if hand.dorsal:
                assert abs(np.dot(hand.distal, hand.dorsal)) < 0.05
                assert np.linalg.norm(hand.dorsal) == pytest.approx(1.0, abs=0.02)
        if len(one.hands) == 2:
            assert {hand.side for hand in one.hands} == {"left", "right"}
    for group in ("tuned", "held back"):
        makers = {one.maker for one in listed.descriptions if one.group == group}
        assert len(makers) >= 10


def test_the_group_follows_from_the_makers_name_alone(listing: Any) -> None:
    one = listing.Stranger("a hand", "kit", "hand.urdf", why="none")
    assert one.group == "tuned"
    held = msgspec.structs.replace(one, maker="fourier")
    assert held.group == "held back"
    assert msgspec.structs.replace(held, name="another").group == "held back"
    assert msgspec.structs.replace(held, known=True).group == "known"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("- {name: a, maker: m, file: f, why: w}\n" * 2, "twice in the list: a"),
        ("- {name: a, maker: m, file: f}\n", "a: give either"),
        ("- {name: a, maker: m, file: f, why: w, package: p}\n", "the package 'p'"),
    ],
)
def test_a_wrong_list_is_refused(
    listing: Any, tmp_path: Path, text: str, problem: str
) -> None:
    file = tmp_path / "list.yaml"
    file.write_text(f"packages: {{}}\ndescriptions:\n{text}")
    with pytest.raises(HandmapError, match=problem):
        listing.read_list(file)


def test_held_joints_of_a_finger_mislead_only_if_check_is_silent(
    listing: Any, verdicts: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    file = tmp_path / "held.xml"
    file.write_text(tendons(offset=2.5), encoding="utf-8")
    joints = {finger: f"{finger}_distal" for finger in FINGERS_OF_LOOPS}
    truth = listing.TrueHand("palm", (0.0, 0.0, 1.0), fingers=joints)
    one = listing.Stranger("held", "m", "held.xml", hands=(truth,))
    verdict = verdicts.judge(one, file)
    (wrong,) = verdict.wrong
    assert wrong.what.startswith("held: ")
    assert wrong.is_contradicted
    assert not verdict.is_misleading
    report = HandReport("")
    monkeypatch.setattr(verdicts, "check_hand", lambda *_, **__: report)
    assert verdicts.judge(one, file).is_misleading


def test_without_files_one_line_says_how_to_get_them(
    benchmark: Callable[[str], Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as stopped:
        benchmark("bench_strangers").main(["--folder", str(tmp_path)])
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "bench_strangers --download" in line


def test_a_changed_file_is_told_apart(listing: Any, made: Made) -> None:
    one, file = made.truths["two jaws"], made.files["two jaws"]
    assert listing.is_unchanged(one, file)
    other = msgspec.structs.replace(one, sha256="0" * 64)
    assert not listing.is_unchanged(other, file)


def test_packages_are_unpacked_so_that_paths_start_alike(
    listing: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = tmp_path / "hand.urdf"
    made.write_text("<robot/>")

    def fetched(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        folder = Path(command[command.index("--dest") + 1])
        if "wheel==1" in command:
            with zipfile.ZipFile(folder / "wheel-1-py3-none-any.whl", "w") as wheel:
                wheel.write(made, "models/hand.urdf")
        elif "source==1" in command:
            with tarfile.open(folder / "source-1.tar.gz", "w:gz") as source:
                source.add(made, "source-1/models/hand.urdf")
        else:
            return subprocess.CompletedProcess(command, 1, "", "ERROR: no such\n")
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(listing.subprocess, "run", fetched)
    for package in ("wheel", "source"):
        listing.fetch(package, "1", tmp_path)
        one = listing.Stranger("a", "m", "models/hand.urdf", package=package, why="w")
        assert listing.path_of(one, tmp_path, MADE).read_text() == "<robot/>"
    with pytest.raises(HandmapError, match=r"cannot fetch absent 1: ERROR: no such"):
        listing.fetch("absent", "1", tmp_path)
