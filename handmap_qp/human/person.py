"""`Person`: lengths and contact gap of one person's hand, measured once and kept in a YAML file."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from msgspec.structs import astuple, force_setattr, replace

from handmap_core.errors import HandError, InvalidInputError, expect
from handmap_core.human.sample import expect_hand_length
from handmap_core.se3 import Array, ArrayStruct
from handmap_qp.hands import FINGERS, Document, HumanLengths, Vector, read_yaml, typed
from handmap_qp.output_files import replaced_file

LARGEST_GAP = 0.04
"""Largest contact gap that a file may give [m]."""
# Lengths are written with five decimals: 0.01 mm.
_DECIMALS = 5


class Person(ArrayStruct, frozen=True):
    """What is measured of one person.

    Attributes:
        name: Name of the person or of the recording.
        lengths: Lengths and rolls of the hand, as a right hand, with the contact gap.
        contact_gap: Distance between thumb and finger landmarks where the skin touches [m], from 0
            to 0.04. It depends on the tracker too.

    Raises:
        InvalidInputError: If the hand's length is outside `landmarks.HAND_LENGTHS`, or the gap is
            out of its range.
    """

    name: str
    lengths: HumanLengths
    contact_gap: float

    def __post_init__(self) -> None:
        expect_hand_length(self.hand_length, "fingers")
        expect(
            0.0 <= self.contact_gap <= LARGEST_GAP,
            "contact_gap",
            f"a distance in [0, {LARGEST_GAP}] m",
            value=self.contact_gap,
        )
        lengths = replace(self.lengths, contact_gap=self.contact_gap)
        force_setattr(self, "lengths", lengths)

    @property
    def hand_length(self) -> float:
        """Distance from wrist to middle fingertip along the bones [m]."""
        return self.lengths.hand_length

    def session_fields(self) -> dict[str, Any]:
        """Return the arguments of `Client.open` that describe the person to the service."""
        lengths = {name: getattr(self.lengths, name).tolist() for name in _KEYS}
        return {"lengths": lengths, "contact_gap": self.contact_gap}


def write_person(person: Person, file: Path) -> None:
    """Write a person's file, or replace it at once.

    Args:
        person: The person.
        file: The file; its folder must exist.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with replaced_file(file, "file") as stream:
        stream.write(person_text(person).encode())


def person_text(person: Person) -> str:
    """Return the text of a person's file; lengths are rounded to 0.01 mm, rolls to 1e-5 rad."""
    lines = [
        "# Measured by `handmap calibrate`. Lengths in metres, in the palm frame of a right hand:",
        "# origin at the wrist, x away from the thumb, y distal, z dorsal.",
        yaml.safe_dump({"name": person.name}, allow_unicode=True).rstrip("\n"),
        "# Distance between thumb and finger landmarks where the skin touches.",
        f"contact_gap: {person.contact_gap:.{_DECIMALS}f}",
        "# First joint of each finger, its bones from there to the tip, and the turn of its joint",
        "# axes about y [rad].",
        "fingers:",
    ]
    lengths = person.lengths
    columns = lengths.bases, lengths.segments, lengths.rolls, lengths.palm_weights
    for name, base, bones, roll, weight in zip(FINGERS, *columns, strict=True):
        fields = f"base: {_row(base)}, bones: {_row(bones)}, roll: {roll:.{_DECIMALS}f}"
        if weight < 1.0:
            fields += f", palm_weight: {weight:.{_DECIMALS}f}"
        lines.append(f"  {name}: {{{fields}}}")
    return "\n".join(lines) + "\n"


def read_person(path: Path | str) -> Person:
    """Read a person's file.

    Args:
        path: The file, of `handmap calibrate`.

    Raises:
        InvalidInputError: If the file cannot be read, a key is unknown, missing or of another type,
            or a number cannot be a hand's. `argument` is the key.
    """
    expect(
        isinstance(path, str | os.PathLike), "path", "the path of a file", value=path
    )
    file = Path(path)
    try:
        found = typed(read_yaml(file), _PersonFile, file)
        columns = zip(*map(astuple, astuple(found.fingers)), strict=True)
        named = dict(zip(_KEYS, map(np.array, columns), strict=True))
        lengths = HumanLengths(**named)
        return Person(found.name, lengths, found.contact_gap)
    except HandError as error:
        raise _refused(file, error.key or "person", error.problem) from error
    except InvalidInputError as error:
        key = _KEYS.get(error.argument, error.argument)
        raise _refused(file, key, error.what) from error


_KEYS = {
    "bases": "fingers.*.base",
    "segments": "fingers.*.bones",
    "rolls": "fingers.*.roll",
    "palm_weights": "fingers.*.palm_weight",
}
"""Keys of a person's file by the fields of `HumanLengths`."""


class _FingerFile(Document, frozen=True):
    """One finger of a person's file: its first joint and its bones [m], and its roll [rad].

    A finger whose first joint moves on the palm has less weight there.
    """

    base: Vector
    bones: Vector
    roll: float = 0.0
    palm_weight: float = 1.0


class _FingersFile(Document, frozen=True):
    """The fingers of a person's file, in the order of `FINGERS`."""

    thumb: _FingerFile
    index: _FingerFile
    middle: _FingerFile
    ring: _FingerFile
    little: _FingerFile


class _PersonFile(Document, frozen=True):
    """The keys of a person's file."""

    name: str
    contact_gap: float
    fingers: _FingersFile


def _row(values: Array) -> str:
    return "[" + ", ".join(f"{value:.{_DECIMALS}f}" for value in values) + "]"


def _refused(file: Path, key: str, problem: str) -> InvalidInputError:
    return InvalidInputError(f"{file}: {problem}", argument=key, value=str(file))
