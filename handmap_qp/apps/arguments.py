"""Arguments that several commands share.

A field added to `MappingArguments` becomes an option of every command that maps.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, make_dataclass, replace
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import FlagConversionOff, Positional, arg

from handmap_core.errors import InvalidInputError, RecordingError, expect
from handmap_qp.hands import (
    FINGERS,
    OTHER_SIDE,
    Hand,
    HumanLengths,
    Names,
    Side,
    Values,
    hand_sides,
    load_hand,
    load_whole,
    sided_name,
)
from handmap_qp.human import Person, Recording, mirrored, read_person
from handmap_qp.mapping import (
    PRESETS,
    Choice,
    find_alignment,
    get_preset,
    known_options,
    preset_choice,
    preset_with,
    read_options,
)
from handmap_qp.stream import SMOOTH_IK, measure_person
from handmap_qp.trackers import (
    SIDES,
    Layout,
    LongRecording,
    Source,
    check_recording,
    find_source,
    in_memory,
    layout_hint,
    load_layout,
    read_hands,
    read_long_hands,
    read_long_with_layout,
    read_with_layout,
    side_with_layout,
    without_overview,
)


def check_names(
    argument: str, names: Sequence[str], expected: str = "different names", **more: str
) -> None:
    """Reject an empty list and a name that occurs twice."""
    expect(names, argument, "at least one", got="none")
    ((name, count),) = Counter(names).most_common(1)
    expect(count == 1, argument, expected, got=f"{name} twice", **more)


def hinted(metavar: str, hint: str = "(default: none)") -> Any:
    """Return how the help shows an option: what its value is, and what is used without it."""
    return arg(metavar=metavar, help_behavior_hint=hint)


HandName = Annotated[str, arg(metavar="HAND")]
"""Name of a hand or of a family of hands (`allegro`) of the package, or path of a hand.yaml."""
FileSide = Annotated[
    Side | None, hinted("{left,right}", "(default: what the file says)")
]
"""Which hand recordings are of, where their files do not say."""
PersonFile = Annotated[
    Path | None, hinted("PERSON.yaml", "(default: measured in the recording)")
]
"""File of a person's hand, of `handmap calibrate`."""
OpenSession = Annotated[str | None, hinted("NAME", "(default: the only open session)")]
"""Name of a session of the service that another client has opened."""
KeyFiles = Annotated[
    tuple[Path, Path] | None, hinted("SECRET SERVER", "(default: not encrypted)")
]
"""A client's secret key and the server's key, of `handmap keys`."""
_HANDED = 3
"""Fingers with human names; a robot with fewer is neither a left nor a right hand."""
Recordings = Positional[
    Annotated[tuple[Path, ...], hinted("RECORDING...", "(required)")]
]
"""Recordings of human hands."""
PointSet = Annotated[str | None, hinted("SET", "(default: the hand's own)")]
"""Name of a set of reference points."""


@dataclass(frozen=True)
class InputArguments:
    """How a recording is to be read.

    Attributes:
        layout: Layout of the file's values where they are not 21 landmarks: a name of
            `handmap layouts`, or the path of a table of your own. Reads .npz and .csv.
        side: Which hand the recording is of, where the file does not say.
        fps: Samples a second, in place of the time in the file; needed where it has none.
    """

    layout: Annotated[str | None, hinted("LAYOUT", "(default: the file's own)")] = None
    side: FileSide = None
    fps: float | None = None

    def read(
        self, path: Path, wanted: Side | None = None, person: Path | None = None
    ) -> Recording:
        """Read a recording, and reject it if it cannot be what it says.

        Args:
            path: The file.
            wanted: Which hand to take of a file with both.
            person: File of the person's hand, whose lengths turn joint angles and markers into
                landmarks; typical lengths if omitted.

        Raises:
            RecordingError: If it cannot be read.
            InvalidInputError: If it is in another order, of the other hand, in other units or the
                like (`handmap_qp.trackers.plausibility`).
        """
        if self.layout is not None:
            return read_with_layout(path, *self._layout_options(self.layout, person))
        with _hinting_layout(path):
            recording = self._source(path, wanted).read()
        return self._checked(recording, path)

    def read_long(
        self, path: Path, wanted: Side | None = None, person: Path | None = None
    ) -> Recording | LongRecording:
        """Read a recording as `read`, or open it to be read by pieces if it is long.

        Raises:
            HandmapError: As `read`.
        """
        if self.layout is not None:
            options = self._layout_options(self.layout, person)
            return read_long_with_layout(path, *options)
        with _hinting_layout(path):
            found = self._source(path, wanted).read_long()
        self._checked(in_memory(found), path)
        return found

    def _layout_options(
        self, name: str, person: Path | None
    ) -> tuple[Layout, Side | None, HumanLengths | None, float | None]:
        """Return how a recording is read whose values have another layout."""
        lengths = read_person(person).lengths if person else None
        return load_layout(name), self.side, lengths, self.fps

    def _source(self, path: Path, wanted: Side | None) -> Source:
        """Find a recording in its file."""
        return find_source(path, self.side or wanted, fps=self.fps)

    def _checked(self, recording: Recording, path: Path) -> Recording:
        """Reject a recording of another side, or that cannot be what it says."""
        if self.side and recording.side != self.side:
            raise InvalidInputError(
                f"{path} says that it is of a {recording.side} hand",
                argument="--side",
                advice="leave --side out, or correct the file",
            )
        check_recording(recording, name=str(path))
        return recording

    def side_of(self, path: Path) -> Side:
        """Return which hand a recording is of; of a file with both, the right one is taken."""
        if self.layout is not None:
            layout = load_layout(self.layout)
            return side_with_layout(path, layout, self.side, self.fps)
        with _hinting_layout(path):
            return self._source(path, "right").entry.side

    def read_both(
        self, paths: Sequence[Path], person: Path | None = None, *, mirror: bool = False
    ) -> dict[Side, Recording]:
        """Read a recording of the left and one of the right hand, from one file or from two.

        Args:
            paths: One file with both hands, or two files; with a layout the left hand's first.
            person: See `read`.
            mirror: Whether the user asked for mirror images, which is refused.

        Raises:
            HandmapError: See `read`.
        """
        self._expect_both(mirror=mirror)
        if self.layout is None:
            hands = read_hands(paths, fps=self.fps)
            for recording in hands.values():
                check_recording(recording)
            return hands
        return {
            side: replace(self, side=side).read(path, person=person)
            for side, path in _one_of_each(paths)
        }

    def read_both_long(
        self, paths: Sequence[Path], person: Path | None = None, *, mirror: bool = False
    ) -> dict[Side, Recording | LongRecording]:
        """Read both hands as `read_both`, or open those to be read by pieces that are long.

        Those have no overviews: see `all_long`.

        Raises:
            HandmapError: As `read_both`.
        """
        self._expect_both(mirror=mirror)
        if self.layout is not None:
            return {
                side: without_overview(
                    replace(self, side=side).read_long(path, person=person)
                )
                for side, path in _one_of_each(paths)
            }
        return read_long_hands(paths, fps=self.fps, check=check_recording)

    def _expect_both(self, *, mirror: bool) -> None:
        """Reject options that both hands cannot have."""
        for option, given in (("--side", self.side), ("--mirror", mirror)):
            if given:
                raise InvalidInputError("has no effect on both hands", argument=option)


def _one_of_each(paths: Sequence[Path]) -> list[tuple[Side, Path]]:
    """Return the file of each hand, the left one's first; both may be in one."""
    expect(len(paths) in (1, 2), "RECORDING", "one file or two", got=f"{len(paths)}")
    return [*zip(SIDES, (paths[0], paths[-1]), strict=True)]


@contextmanager
def _hinting_layout(path: Path) -> Iterator[None]:
    """Add to an error of a file which layout it may have."""
    try:
        yield
    except RecordingError as error:
        if hint := layout_hint(path):
            error.problem += f"; {hint}"
        raise


def person_of(recordings: Sequence[Recording], file: Path | None) -> Person:
    """Return the person of recordings: from a file, or measured if none is given."""
    return read_person(file) if file else measure_person(*recordings)


def fit_side(recording: Recording, robot: Hand, *, mirror: bool) -> Recording:
    """Return a recording for the side of a robot.

    Robots without the fingers of a hand take either hand.

    Args:
        recording: The recording.
        robot: The robot hand.
        mirror: Whether the user asked for the mirror image.

    Raises:
        InvalidInputError: If the sides differ and no mirror image is asked for, or the other way
            round.
    """
    side = recording.side
    own = robot.side
    fingers = {point.finger for point in robot.spec.points} & set(FINGERS)
    if mirror and side == own:
        raise InvalidInputError(
            f"{recording.name} is of a {side} hand, as {robot.name} is",
            argument="--mirror",
            advice="leave it out",
        )
    if mirror:
        return mirrored(recording)
    if side != own and len(fingers) >= _HANDED:
        raise InvalidInputError(
            f"is of a {side} hand, and {robot.name} is a {own} one",
            argument=recording.name,
            advice=f"give --mirror to map its mirror image, or name a {side} robot",
        )
    return recording


def _flags(name: str, about: str, *, are_of_qp: bool) -> type:
    """Return a class with a command-line option for each of a kind, None where not given."""
    items: list[Any] = []
    for option, places in known_options().items():
        # Presets of one method share what they say.
        presets = {
            item.about: (preset, item)
            for preset, item in reversed(places)
            if (preset == "ik") == are_of_qp
        }
        if not presets:
            continue
        texts = [
            f"{item.about} {_default(item)}"
            if len(presets) == 1
            else f"{preset}: {item.about}"
            for preset, item in reversed(presets.values())
        ]
        kind = reduce(or_, [item.plain for _, item in presets.values()]) | None
        # tyro would show a list's type in braces.
        metavar = "NAME ..." if kind == Names | None else None
        settings = arg(help=" ".join(texts), help_behavior_hint="", metavar=metavar)
        flag = FlagConversionOff[Annotated[kind, settings]]
        items.append((option, flag, field(default=None)))
    # The module lets copies of it be pickled.
    own = {"__doc__": about, "__module__": __name__}
    return make_dataclass(name, items, frozen=True, namespace=own)


def _default(option: Any) -> str:
    return "" if option.default is None else f"(default: {option.default})"


MethodFlags = _flags(
    "MethodFlags", "Options of the method; each preset has its own.", are_of_qp=False
)
QpFlags = _flags(
    "QpFlags",
    "Weights and settings of the QP, per 10 mm, per 0.1 rad of the wrist, per rad of a joint.",
    are_of_qp=True,
)


InputFlags = Annotated[InputArguments, arg(name="")]
"""How the recordings of a command are to be read."""


@dataclass(frozen=True)
class MappingArguments:
    """What a command needs to know to map a human hand to a robot hand.

    Attributes:
        preset: What the mapping is for. `teleoperation`: gestures and pinches, finger by finger.
            `picking`: objects between thumb and finger. `object`: in-hand motion, without partners.
            `paper`: eqs. (5)-(8) as published. If omitted, teleoperation where fingers correspond,
            else object; another one where an option is given that this one does not have.
        human_points: Set of reference points on the human hand; see `handmap hands show human`.
        robot_points: Set of reference points on the robot hand; see `handmap hands show HAND`.
            Teleoperation takes fingertips and middle joints by itself.
        method: Options of the method.
        ik: Options of the QP. Those not given are the preset's.
        options: YAML file with a preset and options, as the view saves it. Options given on the
            command line count more.
        smooth: Smooth the robot's motion by costs of speed and acceleration, for 4 ms more lag.
    """

    preset: Annotated[str | None, hinted("PRESET", f"({', '.join(PRESETS)})")] = None
    human_points: PointSet = None
    robot_points: PointSet = None
    method: Annotated[MethodFlags, arg(name="")] = field(  # ty: ignore[invalid-type-form]
        default_factory=MethodFlags
    )
    ik: Annotated[QpFlags, arg(name="ik")] = field(  # ty: ignore[invalid-type-form]
        default_factory=QpFlags
    )
    options: Annotated[Path | None, hinted("OPTIONS.yaml")] = None
    smooth: bool = False

    def __post_init__(self) -> None:
        """Reject values that no preset takes, before any work."""
        if self.preset is not None:
            get_preset(self.preset)
        known = known_options()
        for name, value in (_given(self.method) | _given(self.ik)).items():
            *others, (_, last) = known[name]
            if not any(option.takes(value) for _, option in others):
                last.read(value)

    def preset_for(self, human: Hand, robot: Hand, upright: str = "") -> Choice:
        """Return the chosen preset, method and QP weights for two hands.

        Args:
            human: The hand that leads.
            robot: The hand that follows.
            upright: That of the recording, for the alignment with an arm where none is given.

        Raises:
            InvalidOptionsError: If an option is given that the preset does not have.
        """
        saved = read_options(self.options) if self.options else {}
        own = _given(self.method)
        calm = SMOOTH_IK if self.smooth else {}
        name = saved.pop("preset", preset_with(own, human, robot))
        chosen = preset_choice(self.preset or name, human)
        saved = find_alignment(chosen.method, robot, upright) | saved
        return chosen.with_changes(saved | own | calm | _given(self.ik))

    def load_robot(self, name: str, side: Side | None = None) -> Hand:
        """Load a robot hand with the chosen reference points.

        Args:
            name: Name or path of a hand, or the name of a family of hands.
            side: Which hand of a family; none is found if omitted.

        Raises:
            HandError: If there is no such hand or set.
        """
        return load_hand(sided_name(name, side), points=self.robot_points)

    def changed(self) -> list[str]:
        """Return the options that were given, as `--ridge` or `--ik.damping`."""
        names = [*_given(self.method), *(f"ik.{name}" for name in _given(self.ik))]
        others = "preset", "human_points", "robot_points", "options", "smooth"
        names += filter(vars(self).get, others)
        return [f"--{name.replace('_', '-')}" for name in names]


def read_robot(
    name: str, files: Sequence[Path], command: Any
) -> tuple[Hand, list[Recording]]:
    """Read a robot hand, or a robot with both as one, and a recording of each in its order.

    Args:
        name: Name or path of the robot. A family of hands, such as `allegro`, stands for that of
            the recording's side, with `mirror` of the other one.
        files: Recordings: one, or one of each hand.
        command: Its `inputs`, `arguments`, `person` and `mirror` say how.

    Raises:
        HandmapError: If one cannot be read, or they do not fit.
    """
    robot = _load_robot(name, files, command)
    if _takes_both(robot, files):
        both = command.inputs.read_both(files, command.person, mirror=command.mirror)
        return robot, [both[side] for side in robot.by_side]
    recording = command.inputs.read(files[0], robot.side, command.person)
    return robot, [fit_side(recording, robot, mirror=command.mirror)]


def read_long_robot(
    name: str, files: Sequence[Path], command: Any
) -> tuple[Hand, Sequence[Recording | LongRecording]]:
    """Read a robot as `read_robot`, and open long recordings to read them by pieces.

    Those of both hands have no overviews: see `all_long`.

    Raises:
        HandmapError: As `read_robot`.
    """
    robot = _load_robot(name, files, command)
    if _takes_both(robot, files):
        both = command.inputs.read_both_long(
            files, command.person, mirror=command.mirror
        )
        return robot, [both[side] for side in robot.by_side]
    found = command.inputs.read_long(files[0], robot.side, command.person)

    def fit(recording: Recording) -> Recording:
        return fit_side(recording, robot, mirror=command.mirror)

    if isinstance(found, LongRecording):
        return robot, [found.changed(fit)]
    return robot, [fit(found)]


def _load_robot(name: str, files: Sequence[Path], command: Any) -> Hand:
    """Load the robot of `read_robot`, and check the number of recordings."""
    side = None
    if hand_sides(name) and files:
        side = command.inputs.side_of(files[0])
        side = OTHER_SIDE[side] if command.mirror else side
    robot = load_whole(name, command.arguments.robot_points, side=side)
    expect(
        len(files) == 1 or _takes_both(robot, files),
        "RECORDING",
        "one recording with --robot",
        value=len(files),
        advice="give a robot with both hands, or --robots LEFT RIGHT of `handmap retarget`",
    )
    return robot


def _takes_both(robot: Hand, files: Sequence[Path]) -> bool:
    """Tell whether a robot takes both hands: one with one hand takes that of its side of two."""
    return len(robot.parts) > 1 or bool(robot.parts and len(files) > 1)


MappingFlags = Annotated[MappingArguments, arg(name="")]
"""Reference points and options of a command."""


def _given(flags: Any) -> Values:
    """Return the options that were given, by name."""
    return {name: value for name, value in vars(flags).items() if value is not None}
