"""`handmap score`: mappings and peers on public gestures, as one page."""

import json
import shlex
import sys
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

from tyro.conf import Positional, arg

from handmap_qp.apps.arguments import check_names, hinted
from handmap_qp.apps.offline.compare import (
    Compare,
    file_name,
    is_user_file,
    methods_of,
    read_user_mapping,
    takes_of,
    with_urdf,
)
from handmap_qp.apps.offline.comparison import (
    ComparedMethod,
    OutsideError,
    base_name,
    own_methods,
)
from handmap_qp.apps.offline.trajectory import package_versions
from handmap_qp.apps.tables import print_result, progress
from handmap_qp.errors import HandmapError, expect, warn
from handmap_qp.hands import (
    Hand,
    Names,
    Values,
    find_fingers,
    load_hand,
    sided_name,
)
from handmap_qp.human import human_name
from handmap_qp.mapping import fist_time, slow_note
from handmap_qp.output_files import make_folder, replaced_file
from handmap_qp.trackers import NpzFormat
from .gestures import SOURCES, perform
from .pages import results_of, score_page, votes_page
from .scoring import FORMULA, score_hand

HANDS = (
    "allegro_right",
    "leap_right",
    "shadow_right",
    "orca_right",
    "ability_right",
    "svh_right",
)
"""Hands with thumbs of different kinds."""
_ONE_SEED = (
    "one seed does not show which differences are chance, so that all methods share the "
    "first place: give three by --seeds 0 1 2"
)


class Amount(NamedTuple):
    """How much is measured, unless options say otherwise.

    Attributes:
        hands: How many of `HANDS`.
        seeds: Seeds of the performances.
        rate: Samples per second of the performances.
        every: Every so many-th gesture has pictures.
        pairs: Pairs of pictures to vote on, of each hand.
    """

    hands: int = 3
    seeds: tuple[int, ...] = (0, 1, 2)
    rate: float = 30.0
    every: int = 3
    pairs: int = 6


FULL = Amount(6, (0, 1, 2, 3, 4), 60.0, 1, 24)


@dataclass(frozen=True)
class Score:
    """Score mappings on public gestures of people's hands, and write one page.

    Every mapping follows 71 labelled poses on every hand, in an order, with durations and noise of
    each seed. Columns are those of `handmap compare`; in addition, a reader who has seen people
    only names the robot's gestures. --out gets score.html, score.json and votes.html, which asks
    people which of two robots shows a gesture better. Hands that are not installed are left out.

    Mappings share a place unless their scores differ by more than chance over the seeds.

    Quick by default: 3 hands, 3 seeds, 30 samples a second, and pictures of every third gesture.
    --full takes 6 hands, 5 seeds, 60 samples a second, and pictures of all.

    FILE.py scores a mapping of your own beside `teleoperation`: a method (a
    handmap_qp.CustomMethod), or a function from landmarks (21, 3) [m] to joint angles [rad].
    FILE.py:NAME picks one of several. A program that is not in Python takes two steps: --gestures
    writes what people show as recordings, and --trajectory reads a folder with the joints of each
    (an npz of the recording's name with its `time`, `q` (T, n) [rad] and `joint_names`).

    --tasks lets operators do tasks in closed loop in place of gestures, and writes tasks.html and
    tasks.json. Methods are presets, peers such as dexi-dexpilot (+limits clips them by the robot's
    limits), FILE.py:NAME or a trajectory FILE.npz; the controls always run. PRESET+grip holds what
    thumb and finger meet, by the robot's measured joints; with PRESET+grip+place the mapping knows
    the object's place too, and with PRESET+grip+place5 with an error of 5 mm (standard deviation
    along each axis). Each of --seeds begins a block: a calibration of the person, and --attempts
    scenes.

    Examples:
        handmap score
        handmap score mine.py --hands allegro_right --seeds 0
        handmap score --gestures shown --hands allegro_right --seeds 0
        handmap score --trajectory joints --hands allegro_right --seeds 0
        handmap score --full --peers --out score
        handmap score --hands my_hand.yaml --methods teleoperation finger-vectors --seeds 7 8
        handmap score --tasks door relocate --methods teleoperation
        handmap score --tasks pick --hands leap_right --objects can pen --resume
        handmap score --tasks pick --methods teleoperation teleoperation+grip+place5

    Attributes:
        files: Mappings of your own, FILE.py or FILE.py:NAME.
        out: Folder to write to; created if it does not exist.
        hands: Hands by name, or paths of their hand.yaml.
        methods: Mappings by name, as of `handmap compare`.
        trajectory: Folders with joints of any program, for each of the recordings of --gestures.
        gestures: Write the recordings that mappings follow to this folder, and end.
        seeds: Seeds of the performances.
        recordings: Further recordings for all columns but reading.
        peers: Run the peers too.
        shapes: URDF of the hand, joints and links by the same names, whose collision shapes
            measure pinches and penetration; its own if omitted.
        full: Take all hands, five seeds, twice as many samples a second, and all pictures.
        json: Print JSON instead of a table.
        tasks: Tasks in closed loop; all if none is named.
        operators: Operators of the tasks.
        attempts: Attempts of each block of the tasks.
        processes: Processes that run attempts of tasks.
        films: Draw films of the tasks.
        objects: Objects of the tasks, such as `can` and `pen` of `pick`.
        resume: Go on with the attempts that --out has of a run that was stopped.
    """

    files: Positional[Annotated[Names, hinted("[FILE.py...]")]] = ()
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("score")
    hands: Annotated[Names, hinted("HAND...", "(default: three, or six)")] = ()
    methods: Annotated[Names, arg(aliases=("--presets",), metavar="METHOD...")] = ()
    trajectory: Annotated[tuple[Path, ...], hinted("FOLDER...")] = ()
    gestures: Annotated[Path | None, hinted("FOLDER")] = None
    seeds: Annotated[tuple[int, ...], hinted("SEED...", "(default: 0 1 2)")] = ()
    recordings: Annotated[tuple[Path, ...], hinted("FILE...")] = ()
    peers: bool = False
    shapes: Annotated[Path | None, arg(metavar="URDF")] = None
    full: bool = False
    json: bool = False
    tasks: Annotated[Names | None, hinted("TASK...", "(default: gestures)")] = None
    operators: Annotated[
        Names, hinted("OPERATOR...", "(default: as the task says)")
    ] = ()
    attempts: Annotated[int | None, hinted("N", "(default: 4, or 40)")] = None
    processes: Annotated[int | None, hinted("N", "(default: processors)")] = None
    films: bool = True
    objects: Annotated[Names, hinted("OBJECT...", "(default: all)")] = ()
    resume: bool = False

    def run(self) -> None:
        """Check everything, measure, print and write.

        Raises:
            HandmapError: If a hand, mapping, seed, recording or folder cannot be used.
        """
        if self.tasks is not None:
            self._score_tasks(self.tasks)
            return
        self._reject_options_of_tasks()
        amount = FULL if self.full else Amount()
        seeds = self.seeds or amount.seeds
        is_right = min(seeds) >= 0 and len({*seeds}) == len(seeds)
        expect(is_right, "--seeds", "different numbers from 0", value=seeds)
        names = self._methods()
        if self.gestures:
            self._write_gestures(self.gestures, seeds, amount.rate)
            return
        about = {
            "command": shlex.join(["handmap", *sys.argv[1:]]),
            "seeds": seeds,
            "samples a second": amount.rate,
            "score": FORMULA,
            "versions": package_versions(),
        }
        for source in SOURCES:
            about[f"poses: {source.name}"] = f"{source.licence}, {source.credit}"
        if not self.peers:
            about["peers"] = "not run; `pip install 'handmap-qp[peers]'`, then --peers"
        wanted = self._wanted(HANDS[: amount.hands], names, about)
        shapes = None
        if self.shapes:
            names = [robot.name for _, robot, _ in wanted]
            expect(len(names) == 1, "--shapes", "one hand in --hands", got=names)
            shapes = with_urdf(wanted[0][1], self.shapes)
        make_folder(self.out, "--out")
        scores = []
        for request, robot, methods in wanted:
            with progress(f"{robot.name}:") as say:
                takes = takes_of(request, robot, say)
                score = score_hand(
                    robot, methods, takes, seeds, amount.rate, say, shapes
                )
            scores.append(score)
            about[f"surfaces: {robot.name}"] = score.surfaces
            if note := _slow_note(robot):
                about[f"speed: {robot.name}"] = note
                warn(f"{robot.name}: {note}")
            about |= {f"recording: {t.name}": t.recording.source for t in takes}
        results = results_of(scores, about)
        with progress("drawing, which takes a minute"):
            pages = {
                "score.json": json.dumps(results, indent=1),
                "score.html": score_page(scores, results, amount.every),
                "votes.html": votes_page(scores, amount.pairs),
            }
        for name, page in pages.items():
            with replaced_file(self.out / name, "--out") as file:
                file.write(page.encode())
        surfaces = "; ".join(score.surfaces for score in scores)
        title = f"Score, mean over the seeds; surfaces: {surfaces}"
        tables = {title: results["overview"]}
        written = map(self.out.joinpath, pages)
        print_result(results, tables, written, as_json=self.json)
        if len(seeds) == 1:
            warn(_ONE_SEED)

    def _score_tasks(self, tasks: Names) -> None:
        """Run tasks in place of gestures.

        Raises:
            HandmapError: If something cannot be used.
        """
        # MuJoCo and all that tasks need are not needed for gestures.
        from .tasks.benches import Blocks
        from .tasks.cli import (
            ATTEMPTS,
            BLOCKS,
            FULL_ATTEMPTS,
            TasksRequest,
            score_tasks,
        )

        expect(not self.recordings, "--recordings", "none with --tasks", got="files")
        expect(not self.shapes, "--shapes", "none with --tasks", got="a file")
        expect(not self.gestures, "--gestures", "none with --tasks", got="a folder")
        advice = "name Q.npz among --methods, which plays it whatever the person does"
        got = "a folder"
        expect(
            not self.trajectory,
            "--trajectory",
            "none with --tasks",
            got=got,
            advice=advice,
        )
        usual = FULL_ATTEMPTS if self.full else ATTEMPTS
        attempts = usual if self.attempts is None else self.attempts
        processes = 0 if self.processes is None else self.processes
        is_right = self.processes is None or processes > 0
        expect(is_right, "--processes", "at least 1", value=self.processes)
        request = TasksRequest(
            tasks=tasks,
            out=self.out,
            hands=self.hands,
            objects=self.objects,
            operators=self.operators,
            methods=(*self.methods, *self.files),
            peers=self.peers,
            blocks=Blocks(self.seeds or BLOCKS, attempts),
            processes=processes,
            films=self.films,
            resume=self.resume,
            as_json=self.json,
        )
        score_tasks(request)

    def _reject_options_of_tasks(self) -> None:
        """Reject options that have no effect on gestures.

        Raises:
            InvalidInputError: If one is given.
        """
        given = {
            "--operators": bool(self.operators),
            "--attempts": self.attempts is not None,
            "--processes": self.processes is not None,
            "--no-films": not self.films,
            "--objects": bool(self.objects),
            "--resume": self.resume,
        }
        for option, is_given in given.items():
            expect(not is_given, option, "--tasks too", got="gestures")

    def _methods(self) -> Names:
        """Return the names of the mappings, those of the user's files last; empty for all presets.

        Raises:
            HandmapError: If a file cannot be used, or is for one hand and --hands names none.
        """
        for name in filter(is_user_file, (*self.files, *self.methods)):
            user = read_user_mapping(
                name, "FILE.py" * (name in self.files) or "--methods"
            )
            is_known = bool(self.hands) or not user.is_for_one_hand
            self._expect_hands(name, is_known=is_known)
        for name in self.files:
            expect(is_user_file(name), "FILE.py", "a file of Python", got=name)
        for folder in self.trajectory:
            expect(folder.is_dir(), "--trajectory", "a folder", got=str(folder))
            self._expect_hands(str(folder), is_known=bool(self.hands))
        usual = own_methods()[:1] if self.files or self.trajectory else ()
        return (*(self.methods or usual), *self.files)

    def _expect_hands(self, name: str, *, is_known: bool) -> None:
        """Ask for the hand whose joints a mapping returns."""
        advice = "name it, as --hands allegro_right"
        expect(
            is_known,
            "--hands",
            f"the hand whose joints {name} has",
            got="none",
            advice=advice,
        )

    def _write_gestures(
        self, folder: Path, seeds: tuple[int, ...], rate: float
    ) -> None:
        """Write what mappings of a hand follow, for a program that maps it to joints."""
        hands = self.hands or HANDS[:1]
        expect(len(hands) == 1, "--hands", "one hand with --gestures", value=hands)
        name = sided_name(hands[0], "right")
        robot = load_hand(name)
        make_folder(folder, "--gestures")
        with progress("writing gestures") as say:
            takes = takes_of(Compare(self._files, name), robot, say)
            takes += [
                perform(source, seed, rate, robot.side).take
                for seed in seeds
                for source in SOURCES
            ]
            for take in takes:
                file = folder / file_name(take.name)
                NpzFormat().write([take.recording], file)
                print(f"wrote {file}")
        print(
            "Map each file, and write joints of the same file name to another folder:\n"
            "    np.savez(FILE, time=recording['time'], q=q, joint_names=names)\n"
            f"    handmap score --trajectory FOLDER {self._given_again(name, seeds)}"
        )

    @property
    def _files(self) -> tuple[Path, ...]:
        """Recordings that mappings follow beside the gestures: the package's own first."""
        return Path("demo"), *self.recordings

    def _given_again(self, hand: str, seeds: tuple[int, ...]) -> str:
        """Return the options that decide which gestures are shown."""
        words = ["--hands", hand, "--seeds", *map(str, seeds), *["--full"] * self.full]
        if self.recordings:
            words += ["--recordings", *map(str, self.recordings)]
        return shlex.join(words)

    def _wanted(
        self,
        usual: Names,
        names: Names,
        about: Values,
    ) -> list[tuple[Compare, Hand, list[ComparedMethod]]]:
        """Return what to ask of each hand, the hand, and its mappings.

        Args:
            usual: Hands without --hands; those that are not installed are left out.
            names: Names of the mappings; all presets if empty.
            about: Gets a line for all that is left out.
        """
        wanted = []
        for given in self.hands or usual:
            name = sided_name(given, "right")  # the package's recording has both hands
            try:
                robot = load_hand(name)
            except ImportError as error:
                if self.hands:
                    raise
                about[f"hand: {name}"] = f"left out: {error}"
                warn(f"without {name}: {error}")
                continue
            expected = "a hand with fingers of people's names"
            expect(find_fingers(robot), "--hands", expected, got=name)
            request = Compare(
                self._files, name, names, peers=self.peers, trajectory=self.trajectory
            )
            wanted.append((request, robot, mappings_of(request, about)))
        check_names("--hands", [robot.name for _, robot, _ in wanted])
        return wanted


def _slow_note(robot: Hand) -> str:
    """Return a line if the robot's joints are slower than a person; empty if not, or not known."""
    with suppress(HandmapError):
        return slow_note(fist_time(load_hand(human_name(robot.side)), robot))
    return ""


def mappings_of(request: Compare, about: Values) -> list[ComparedMethod]:
    """Return the mappings of a hand, and write down why peers are left out."""
    try:
        return methods_of(request)
    except OutsideError as error:
        own = [
            name
            for name in request.methods
            if base_name(name) in own_methods() or is_user_file(name)
        ]
        if request.methods and not own:
            raise
        about[f"peers on {request.robot}"] = f"left out: {error}"
        return methods_of(replace(request, methods=tuple(own), peers=False))
