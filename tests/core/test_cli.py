"""The command line: what it writes and prints, and one line for every mistake."""

import ast
import importlib.metadata
import io
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from limit_judge import judge, landmarks_at

from handmap_qp import cli, load_hand
from handmap_qp.apps import doctor, tables
from handmap_qp.hands.robot import load_robot

ROOT = Path(__file__).parents[2]

KEYS = {
    "samples",
    "held",
    "step_cpu_us_median",
    "step_cpu_us_p99",
    "point_error_mm_mean",
    "point_error_mm_p95",
    "point_error_mm_max",
    "samples_at_limit",
    "speed_limited_share",
    "speed_limited_joints",
    "limit_violation_max",
    "speed_over_limit_max",
    "acceleration_max",
    "steps_ms",
}
COLUMNS = {
    "time",
    "joint_names",
    "q",
    "wrist",
    "targets",
    "points",
    "point_error",
    "valid",
    "versions",
}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A small recording of a hand closing, with one gap."""
    hand = load_hand("human", points="landmarks")
    shares = np.linspace(0.0, 0.6, 30)
    landmarks = np.array(
        [
            hand.points(hand.rest + share * (hand.upper_limits - hand.rest) * 0.5)
            for share in shares
        ]
    )
    valid = np.ones(30, dtype=bool)
    valid[10:13] = False
    path = tmp_path / "closing.npz"
    np.savez(
        path,
        time=np.arange(30) / 60.0,
        landmarks=landmarks,
        valid=valid,
        handedness="right",
    )
    return path


@pytest.mark.parametrize("robot", ["three_finger", "allegro_right", "romeo_right"])
def test_map_writes_the_trajectory_and_prints_its_summary(
    recording: Path, tmp_path: Path, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.npz"
    command = ["map", str(recording), "--robot", robot, "--preset", "paper"]
    assert cli.main([*command, "--out", str(out), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary.keys() >= KEYS
    assert (summary["samples"], summary["held"]) == (30, 3)
    assert summary["limit_violation_max"] <= 1e-9
    with np.load(out, allow_pickle=False) as columns:
        assert set(columns) >= COLUMNS
        assert columns["q"].shape == (30, len(columns["joint_names"]))
        assert columns["wrist"].shape == (30, 4, 4)
        error = np.linalg.norm(columns["targets"] - columns["points"], axis=2)
        np.testing.assert_allclose(columns["point_error"], error, atol=1e-12)
        np.testing.assert_array_equal(columns["q"][10:13], columns["q"][[9, 9, 9]])
        assert columns["all_q"].shape == (30, len(columns["all_joint_names"]))
        is_active = columns["all_joint_roles"] == "active"
        np.testing.assert_array_equal(columns["all_q"][:, is_active], columns["q"])
        hand = load_hand(robot)
        replayed = [
            hand.points(q, wrist)
            for q, wrist in zip(columns["q"], columns["wrist"], strict=True)
        ]
        np.testing.assert_allclose(replayed, columns["points"], atol=1e-9)


@pytest.mark.slow
def test_what_map_writes_keeps_the_limits_by_its_own_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = []
    for side, rate in (("left", 60.0), ("right", 30.0)):
        time = np.arange(0.0, 2.0, 1.0 / rate)
        landmarks = np.array([landmarks_at(side, each) for each in time])
        # One hand is lost for .2 s, with its samples.
        is_kept = (side == "left") | (time < 1.0) | (time >= 1.2)
        valid = np.ones(is_kept.sum(), dtype=bool)
        files.append(str(tmp_path / f"{side}.npz"))
        np.savez(
            files[-1],
            time=time[is_kept],
            landmarks=landmarks[is_kept],
            valid=valid,
            handedness=side,
        )
    out = tmp_path / "out.npz"
    command = ["map", *files, "--robot", "g1", "--out", str(out)]
    assert cli.main([*command, "--ik.max-acceleration", "30", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    with np.load(out, allow_pickle=False) as columns:
        worst = judge(load_robot("g1"), columns["time"], columns["q"])
    assert 0.9 < worst.speed <= 1.0 + 1e-6
    assert worst.acceleration <= 30.0 * (1.0 + 1e-6)
    assert summary["speed_over_limit_max"] == pytest.approx(worst.speed, rel=1e-6)
    assert summary["acceleration_max"] == pytest.approx(worst.acceleration, rel=1e-3)
    np.testing.assert_allclose(summary["steps_ms"], 1e3 / 60.0, rtol=1e-9)
    assert cli.main(command) == 0
    # A cell of the table may have several lines.
    printed = capsys.readouterr().out
    cells = " ".join(
        row.split("│")[2].strip() for row in printed.splitlines() if "│" in row
    )
    assert "60 samples a second, steps of 16.67 to 16.67 ms" in cells
    assert "of its limit" in printed


@pytest.mark.slow
def test_map_moves_a_robot_with_two_hands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.npz"
    command = ["map", "demo", "--robot", "g1", "--out", str(out)]
    assert cli.main(command) == 0
    printed = capsys.readouterr().out
    assert "demo_left and demo_right to g1" in printed
    assert "alignment" in printed
    with np.load(out, allow_pickle=False) as columns:
        assert columns.keys() >= COLUMNS | {"wrist_left", "wrist_right"}
        np.testing.assert_allclose(columns["wrist_left"], columns["wrist"], atol=1e-9)
        assert columns["wrist_right"].shape == columns["wrist"].shape
    assert cli.main([*command, "--mirror"]) == 2
    assert "--mirror: has no effect on both hands" in capsys.readouterr().err


def test_map_prints_a_table_and_names_the_file(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert (
        cli.main(
            [
                "map",
                str(recording),
                "--robot",
                "three_finger",
                "--rigid-from",
                "wrist",
                "--ik.max-iterations",
                "1",
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert "point error" in printed
    assert "closing_three_finger.npz" in printed
    assert (tmp_path / "closing_three_finger.npz").is_file()


def test_a_calibrated_person_takes_the_place_of_measuring(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    person = tmp_path / "bob.yaml"
    assert cli.main(["calibrate", str(recording), "--out", str(person), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["samples"] == 27
    command = ["map", str(recording), "--robot", "three_finger", "--out"]
    large = tmp_path / "large.yaml"
    text = person.read_text()
    start = text.index("  middle: ")
    line = text[start : text.index("\n", start)]
    large.write_text(text.replace(line, line.replace("bones: [0.0", "bones: [0.06")))
    paths = {"measured": None, "calibrated": person, "another": large}
    q = {}
    for name, file in paths.items():
        out = tmp_path / f"{name}.npz"
        words = [] if file is None else ["--person", str(file)]
        assert cli.main([*command, str(out), *words]) == 0
        with np.load(out) as columns:
            q[name] = columns["q"]
    # Lengths are rounded to 0.01 mm.
    np.testing.assert_allclose(q["calibrated"], q["measured"], atol=5e-3)
    assert np.abs(q["another"] - q["measured"]).max() > 0.05


def test_hands_lists_and_describes(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["hands", "list", "--json"]) == 0
    assert {row["name"] for row in json.loads(capsys.readouterr().out)} >= {
        "human",
        "three_finger",
        "allegro_right",
    }
    assert cli.main(["hands", "show", "three_finger", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["joints"]) == 8
    assert cli.main(["hands", "list"]) == 0
    assert cli.main(["hands", "show", "human"]) == 0
    assert "thumb_TM_abduction" in capsys.readouterr().out


MISTAKES = {
    "no command": [],
    "unknown command": ["dance"],
    "unknown option": ["map", "{recording}", "--robot", "three_finger", "--speed", "3"],
    "no recording": ["map", "absent.npz", "--robot", "three_finger"],
    "no robot": ["map", "{recording}"],
    "unknown robot": ["map", "{recording}", "--robot", "tentacle"],
    "not a number": [
        "map",
        "{recording}",
        "--robot",
        "three_finger",
        "--ridge",
        "much",
    ],
    "number out of range": [
        "map",
        "{recording}",
        "--robot",
        "three_finger",
        "--ridge",
        "-1",
    ],
    "contradiction": [
        "map",
        "{recording}",
        "--robot",
        "three_finger",
        "--pivot",
        "point",
    ],
    "unknown point set": [
        "map",
        "{recording}",
        "--robot",
        "three_finger",
        "--human-points",
        "toes",
    ],
    "unknown solver": [
        "map",
        "{recording}",
        "--robot",
        "three_finger",
        "--ik.solver",
        "abacus",
    ],
    "no folder": [
        "map",
        "{recording}",
        "--robot",
        "three_finger",
        "--out",
        "nowhere/out.npz",
    ],
    "not an npz": ["map", "{recording}", "--robot", "three_finger", "--out", "out.csv"],
    "no recording at all": ["map", "{folder}/hand.txt", "--robot", "three_finger"],
    "unknown hand": ["hands", "show", "tentacle"],
    "robot as a hand": ["hands", "check", "g1"],
    "robot to compare": ["compare", "{recording}", "--robot", "g1"],
    "hand as a command": ["hands", "three_finger"],
    "unknown shell": ["--completion", "powershell"],
    "no shell": ["--completion"],
    "no such person": [
        "map",
        "{recording}",
        "--robot",
        "three_finger",
        "--person",
        "bob.yaml",
    ],
    "person of a service": ["view", "--live", "127.0.0.1", "--person", "bob.yaml"],
    "person as a recording": ["calibrate", "{recording}", "--out", "bob.npz"],
    "person over a file": ["calibrate", "{recording}", "--out", "{folder}/bob.yaml"],
    "match of the human": ["hands", "match", "human"],
    "match for two people": [
        *("hands", "match", "romeo_right"),
        *("--recording", "{recording}", "--human-length", "0.19"),
    ],
    "match for a giant": ["hands", "match", "romeo_right", "--human-length", "-1"],
    "match drawn as text": ["hands", "match", "romeo_right", "--picture", "match.txt"],
    "demo onto a file": ["demo", "--out", "{recording}"],
}


BOXED = ("unknown option", "not a number")


@pytest.mark.parametrize(("name", "words"), MISTAKES.items(), ids=MISTAKES.keys())
def test_a_mistake_is_one_line_or_a_box_and_leaves_no_file(
    name: str,
    words: list[str],
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = recording.parent
    (folder / "hand.txt").write_text("thumb up")
    (folder / "bob.yaml").write_text("thumb: up")
    before = sorted(folder.rglob("*"))
    monkeypatch.chdir(folder)
    assert (
        cli.main([word.format(recording=recording, folder=folder) for word in words])
        == 2
    )
    printed = capsys.readouterr()
    if name in BOXED:
        assert "handmap map --help" in printed.err
    else:
        assert printed.err.startswith("handmap: ")
        assert printed.err.count("\n") == 1
    assert "Traceback" not in printed.err
    assert printed.out == ""
    assert sorted(folder.rglob("*")) == before


COMMANDS = (
    *("", "demo", "retarget", "calibrate", "compare", "study", "view"),
    *(
        "hands list",
        "hands show",
        "hands init",
        "hands check",
        "hands match",
        "hands pack",
        "hands edit",
    ),
    "doctor",
    *("robots list", "robots show", "robots check"),
)


@pytest.mark.parametrize("command", [*COMMANDS, "hands", "robots", "serve", "keys"])
def test_help_has_examples_and_fits_the_terminal(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as end:
        cli.main([*command.split(), "--help"])
    assert end.value.code == 0
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 80
    if command in COMMANDS:
        assert f"\n    handmap {command}".rstrip() in printed.partition("Examples:")[2]
        assert "{None" not in printed, "a type in place of a placeholder"


def test_commands_are_listed_by_the_first_line_of_their_help() -> None:
    for name, place in cli.COMMANDS.items():
        assert place.about == (place.load().__doc__ or "").partition("\n")[0], name


def test_a_former_name_is_the_same_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.parse(["map", "demo"]) == cli.parse(["retarget", "demo"])
    pages = {}
    for name in ("map", "retarget"):
        with pytest.raises(SystemExit):
            cli.main([name, "--help"])
        usage, _, pages[name] = capsys.readouterr().out.partition("\n")
        assert usage.startswith(f"usage: handmap {name} ")
        assert "handmap retarget demo" in pages[name]
        assert "`handmap map` is the same command" in " ".join(pages[name].split())
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    listed = capsys.readouterr().out
    assert re.search(r"^  map +Former name of `retarget`\.$", listed, re.MULTILINE)
    assert re.search(r"^  retarget +Map a recording", listed, re.MULTILINE)


def test_a_command_of_another_package_has_both_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    point = importlib.metadata.EntryPoint("tune", "a:B", "handmap_qp.commands")
    monkeypatch.setattr(cli, "entry_points", lambda *, group: [point])
    cli.all_commands.cache_clear()
    try:
        commands = cli.all_commands()
        assert commands["calibrate-actuators"] is commands["tune"]
        assert commands["tune"].point is point
    finally:
        cli.all_commands.cache_clear()


def test_other_packages_are_looked_up_only_when_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(cli, "entry_points", lambda *, group: asked.append(group) or [])
    cli.all_commands.cache_clear()
    for words in (["--version"], ["map", "--help"], ["hands", "show", "--help"]):
        with pytest.raises(SystemExit):
            cli.main(words)
    assert not asked
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    assert asked == ["handmap_qp.commands"]
    cli.all_commands.cache_clear()


@pytest.mark.parametrize("file", ["loud.py", "loud/__init__.py"])
def test_commands_of_other_packages_are_listed_without_an_import(
    file: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / file).parent.mkdir(exist_ok=True)
    other = 'class Louder:\n    """Another."""\n'
    own = 'class Loud(\n    Louder\n):\n    """Be loud.\n\n    Very.\n    """\n'
    (tmp_path / file).write_text(f"{other}\n\n{own}\nraise ValueError")
    point = importlib.metadata.EntryPoint("loud", "loud:Loud", "handmap_qp.commands")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(cli, "entry_points", lambda *, group: [point])
    cli.all_commands.cache_clear()
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    cli.all_commands.cache_clear()
    assert re.search(r"^  loud +Be loud\.$", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["mpa", "x.npz"], "did you mean map?"),
        (["hands", "int", "x.urdf"], "did you mean init?"),
        (["hands", "three_finger"], "handmap hands show three_finger"),
        (["robots", "g1"], "handmap robots show g1"),
        (["hands", "show", "alegro_right"], "did you mean allegro_right?"),
        (["hands", "show", "LEAP_right"], "did you mean leap_right?"),
        (
            ["map", "x.npz", "--preset", "teleop"],
            "got 'teleop': did you mean teleoperation?",
        ),
        (
            ["map", "x.npz", "--ik.damping", "-1"],
            "--ik.damping: expected a number in (0, 1e+06], ",
        ),
        (
            ["map", "x.npz", "--ridge", "-1"],
            "--ridge: expected a finite number >= 0, got -1.0",
        ),
        (["--versoin"], "did you mean --version?"),
        (
            ["hands", "check", "absent.yaml"],
            "absent.yaml: cannot be read: No such file",
        ),
    ],
)
def test_a_mistyped_word_is_answered_with_the_nearest_one(
    words: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    printed = capsys.readouterr()
    assert hint in printed.err
    assert printed.err.count("\n") == 1
    assert not printed.out


def commands_of_packages() -> dict[str, str]:
    """Return the folder of each command that a package of the tree has, by its entry points."""
    found = {}
    for file in (ROOT / "packages").glob("*/pyproject.toml"):
        project = tomllib.loads(file.read_text(encoding="utf-8")).get("project", {})
        points = project.get("entry-points", {}).get("handmap_qp.commands", {})
        found |= dict.fromkeys(points, file.parent.relative_to(ROOT).as_posix())
    # The build tool of ROS 2 reads setup.py.
    return found | {"ros2": "packages/ros2[dds]"}


@pytest.mark.parametrize(("name", "folder"), commands_of_packages().items())
def test_a_command_of_another_package_says_what_installs_it(
    name: str,
    folder: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(cli, "entry_points", lambda *, group: [])
    cli.all_commands.cache_clear()
    assert cli.main([*name.split(), "--help"]) == 2
    cli.all_commands.cache_clear()
    assert f"pip install '{folder}'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["map", "x.npz", "--robto", "y"], "--robot HAND"),
        (["map", "x.npz", "--robot", "y", "--ik.dampin", "1"], "--ik.damping FLOAT"),
        (["map", "x.npz", "--side=up"], "invalid choice 'up' for argument '--side'"),
        (["map", "x.npz", "--avoids-contact", "maybe"], "invalid choice 'maybe'"),
        (["map", "x.npz", "--out"], "Missing value for argument"),
        (["view", "--port", "5o7o"], "Error parsing --port"),
        (["view", "--keys", "a"], "--keys"),
        (["batch"], "--out DIR"),
        (["keys", "a", "b"], "Unrecognized options: b"),
    ],
)
def test_tyros_box_names_the_option_and_the_help(
    words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    printed = capsys.readouterr()
    assert text in printed.err
    assert f"handmap {words[0]} --help" in printed.err
    assert not printed.out


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--version"])
    assert end.value.code == 0
    assert (
        capsys.readouterr().out
        == f"handmap {importlib.metadata.version('handmap-qp')}\n"
    )


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completions_name_every_command(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--completion", shell])
    assert end.value.code == 0
    script = capsys.readouterr().out
    for name in cli.COMMANDS:
        assert name.split()[-1] in script
    assert "--robot" in script
    (spec,) = re.findall(r"^COMPLETION_SPEC = (.*)", script, re.MULTILINE)
    options = ast.literal_eval(spec)["subcommands"]["retarget"]["options"]
    assert not [option for option in options if "\n" in option["description"]]
    (rigid,) = (option for option in options if option["flags"] == ["--rigid-from"])
    assert sorted(rigid["choices"]) == ["none", "points", "wrist"]


def test_rows_are_whole_in_a_pipe_and_brackets_are_text(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    long = "pip install 'handmap-qp[robots]' " * 5
    tables.print_rows("Hands", [{"name": "allegro_right", "available [mm]": long}])
    shown = capsys.readouterr().out
    assert long in shown
    assert "available [mm]" in shown


def test_what_a_terminal_cannot_show_is_replaced(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", terminal)
    assert cli.main(["doctor", "--json"]) == 0
    tables.print_rows("grün", [{"name": "µs"}])
    terminal.seek(0)
    assert "gr?n" in terminal.read()


def test_the_doctor_reports_the_installation(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["versions"]["pin"] == importlib.metadata.version("pin")
    assert report["extras"]["robots"] == "installed"
    assert "daqp" in report["solvers"]["available"]


def test_the_doctor_says_how_to_install_an_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def version(name: str) -> str:
        if name == "viser":
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert (
        doctor.extras()["view"] == "viser not installed: pip install 'handmap-qp[view]'"
    )
    assert doctor.extras()["plot"] == "installed"


def test_a_package_that_asks_for_another_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def asks(_: object) -> None:
        raise ImportError("shtab is required: pip install shtab")

    monkeypatch.setattr(cli.EntryPoint, "load", asks)
    assert cli.main(["doctor"]) == 2
    assert capsys.readouterr().err == "handmap: shtab is required: pip install shtab\n"

    # A module that is not there is a fault of the installation: all of it is shown.
    def lacks(_: object) -> None:
        raise ModuleNotFoundError("No module named 'gone'", name="gone")

    monkeypatch.setattr(cli.EntryPoint, "load", lacks)
    with pytest.raises(ModuleNotFoundError):
        cli.main(["doctor"])


@pytest.mark.parametrize(
    ("library", "advice"),
    [("libgomp.so.1", ": apt-get install libgomp1"), ("libodd.so.2", "")],
)
def test_a_missing_system_library_is_one_line(
    library: str,
    advice: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(_: object) -> None:
        raise ImportError(
            f"{library}: cannot open shared object file: No such file or directory"
        )

    monkeypatch.setattr(cli.EntryPoint, "load", fails)
    assert cli.main(["doctor"]) == 2
    assert (
        capsys.readouterr().err
        == f"handmap: the system library {library} is missing{advice}\n"
    )
