"""Arguments that several commands share.

A field added to `MappingArguments` becomes an option of every command that maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS, HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.spec import Side
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.options_file import read_options
from handmap_qp.mapping.presets import Choice, PresetName, default_preset, preset_choice
from handmap_qp.mapping.smoothing import SMOOTH_IK, Smoothing
from handmap_qp.trackers.recording import Recording, mirrored, read_recording

HandName = Annotated[str, tyro.conf.arg(metavar="HAND")]
"""Name of a hand of the package, or path of a hand.yaml."""
PersonFile = Annotated[
    Path | None,
    tyro.conf.arg(metavar="PERSON.yaml", help_behavior_hint="(default: measured in the recording)"),
]
"""File of a person's hand, of `handmap calibrate`."""
OpenSession = Annotated[
    str | None,
    tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: the only open session)"),
]
"""Name of a session of the service that another client has opened."""
KeyFiles = Annotated[
    tuple[Path, Path] | None,
    tyro.conf.arg(metavar="SECRET SERVER", help_behavior_hint="(default: not encrypted)"),
]
"""A client's secret key and the server's key, of `handmap keys`."""
_HANDED = 3  # fingers with human names; a robot with fewer is neither a left nor a right hand
PointSet = Annotated[
    str | None, tyro.conf.arg(metavar="SET", help_behavior_hint="(default: the hand's own)")
]
"""Name of a set of reference points."""


@dataclass(frozen=True)
class InputArguments:
    """How a recording is to be read.

    Attributes:
        layout: Layout of the file's values where they are not 21 landmarks: a name of
            `handmap layouts`, or the path of a table of your own. Reads .npz and .csv.
        side: Which hand the recording is of, where the file does not say.
    """

    layout: Annotated[
        str | None, tyro.conf.arg(metavar="LAYOUT", help_behavior_hint="(default: the file's own)")
    ] = None
    side: Annotated[
        Side | None, tyro.conf.arg(help_behavior_hint="(default: what the file says)")
    ] = None

    def read(self, path: Path, wanted: Side | None = None, person: Path | None = None) -> Recording:
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
        from handmap_qp.trackers.layout import load_layout
        from handmap_qp.trackers.layout_files import layout_hint, read_with_layout
        from handmap_qp.trackers.plausibility import check_recording

        if self.layout is not None:
            return read_with_layout(path, load_layout(self.layout), self.side, _lengths_of(person))
        if self.side is not None and self.side != wanted:
            wanted = self.side
        try:
            recording = read_recording(path, wanted)
        except RecordingError as error:
            hint = layout_hint(path)
            if not hint:
                raise
            problem = f"{error.problem}; {hint}"
            raise RecordingError(problem, file=error.file, array=error.array) from error
        if self.side is not None and recording.side != self.side:
            raise InvalidInputError(
                argument="--side",
                problem=f"{path} says that it is of a {recording.side} hand",
                advice="leave --side out, or correct the file",
            )
        check_recording(recording, name=str(path))
        return recording

    def read_both(self, paths: Sequence[Path], person: Path | None = None) -> dict[Side, Recording]:
        """Read a recording of the left and one of the right hand, from one file or from two.

        Args:
            paths: One file with both hands, or two files; with a layout the left hand's first.
            person: As of `read`.

        Raises:
            HandmapError: As of `read`.
        """
        from handmap_qp.trackers.formats import read_hands
        from handmap_qp.trackers.layout import load_layout
        from handmap_qp.trackers.layout_files import read_with_layout
        from handmap_qp.trackers.plausibility import check_recording

        if self.side is not None:
            raise InvalidInputError(argument="--side", problem="has no effect on both hands")
        sides: tuple[Side, Side] = ("left", "right")
        if self.layout is None:
            hands = read_hands(paths)
            for recording in hands.values():
                check_recording(recording)
            return hands
        if len(paths) not in (1, 2):
            raise InvalidInputError(
                argument="RECORDING", expected="one file or two", got=f"{len(paths)}"
            )
        layout, lengths = load_layout(self.layout), _lengths_of(person)
        return {
            side: read_with_layout(path, layout, side, lengths)
            for side, path in zip(sides, (paths[0], paths[-1]), strict=True)
        }


def _lengths_of(person: Path | None) -> HumanLengths | None:
    from handmap_qp.trackers.person import read_person

    return None if person is None else read_person(person).lengths


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
    side, own = recording.side, robot.spec.side
    fingers = {point.finger for point in robot.spec.points} & set(FINGERS)
    if mirror and side == own:
        raise InvalidInputError(
            argument="--mirror",
            problem=f"{recording.name} is of a {side} hand, as {robot.name} is",
            advice="leave it out",
        )
    if mirror:
        return mirrored(recording)
    if side != own and len(fingers) >= _HANDED:
        raise InvalidInputError(
            argument=recording.name,
            problem=f"is of a {side} hand, and {robot.name} is a {own} one",
            advice=f"give --mirror to map its mirror image, or name a {side} robot",
        )
    return recording


@dataclass(frozen=True)
class MappingArguments:
    """What a command needs to know to map a human hand to a robot hand.

    Attributes:
        preset: What the mapping is for. `teleoperation`: gestures and pinches, finger by finger.
            `object`: in-hand motion, without partners. `paper`: eqs. (5)-(8) as published. If
            omitted, teleoperation where fingers correspond, else object; paper where one of its
            options is given.
        human_points: Set of reference points on the human hand; see `handmap hands show human`.
        robot_points: Set of reference points on the robot hand; see `handmap hands show HAND`.
            Teleoperation takes fingertips and middle joints by itself.
        mapping: How T is estimated and imposed; for the presets paper and object.
        teleoperation: How fingers follow fingers; for the preset teleoperation.
        ik: Weights and settings of the QP, per 10 mm, per 0.1 rad of the wrist, per rad of a joint.
            Those not given are the preset's.
        options: YAML file with a preset and options, as the view saves it. Options given on the
            command line count more.
        smooth: Smooth the samples with a one-euro filter, and the robot's motion with costs of
            speed and acceleration: half the jerk, for about 8 ms more lag.
    """

    preset: PresetName | None = None
    human_points: PointSet = None
    robot_points: PointSet = None
    mapping: Annotated[MappingOptions, tyro.conf.arg(name="")] = field(
        default_factory=MappingOptions
    )
    teleoperation: Annotated[Teleoperation, tyro.conf.arg(name="teleoperation")] = field(
        default_factory=Teleoperation
    )
    ik: Annotated[IkOptions, tyro.conf.arg(name="ik")] = field(default_factory=IkOptions)
    options: Annotated[
        Path | None, tyro.conf.arg(metavar="OPTIONS.yaml", help_behavior_hint="(default: none)")
    ] = None
    smooth: bool = False

    @property
    def smoothing(self) -> Smoothing | None:
        """How samples are smoothed."""
        return Smoothing() if self.smooth else None

    def preset_for(self, human: Hand, robot: Hand, contact_gap: float | None = None) -> Choice:
        """Return the chosen preset, method and QP weights for two hands.

        Args:
            human: The hand that leads.
            robot: The hand that follows.
            contact_gap: The measured contact gap [m], used unless one is given.

        Raises:
            InvalidInputError: If an option is given that the preset does not have.
        """
        mapping = _given(self.mapping, MappingOptions())
        fingers = _given(self.teleoperation, Teleoperation())
        saved = {} if self.options is None else read_options(self.options)
        saved_preset = saved.pop("preset", None)
        name = self.preset or saved_preset
        name = name or ("paper" if mapping else default_preset(human, robot))
        chosen = preset_choice(name, contact_gap)
        own, foreign = (fingers, mapping) if chosen.is_teleoperation else (mapping, fingers)
        if foreign:
            prefix = "--teleoperation." if foreign is fingers else "--"
            raise InvalidInputError(
                argument=prefix + min(foreign).replace("_", "-"),
                problem=f"the preset {name} has no such option",
                advice="choose another --preset, or leave it out",
            )
        calm = SMOOTH_IK if self.smooth else {}
        return chosen.with_changes(saved | own | calm | _given(self.ik, IkOptions()))

    def load_robot(self, name: str) -> Hand:
        """Load a robot hand with the chosen reference points.

        Raises:
            HandError: If there is no such hand or set.
        """
        return load_hand(name, points=self.robot_points)

    def changed(self) -> list[str]:
        """Return the options that differ from their defaults, as `--ridge` or `--ik.damping`."""
        usual, names = MappingArguments(), []
        for item in fields(self):
            value, default = getattr(self, item.name), getattr(usual, item.name)
            if is_dataclass(value):
                prefix = "--" if item.name == "mapping" else f"--{item.name}."
                names += [prefix + name.replace("_", "-") for name in _given(value, default)]
            elif value != default:
                names.append("--" + item.name.replace("_", "-"))
        return names


def _given(options: Any, default: Any) -> dict[str, Any]:
    """Return the fields of options that differ from their defaults, by name."""
    values = {item.name: getattr(options, item.name) for item in fields(options)}
    return {name: value for name, value in values.items() if value != getattr(default, name)}
