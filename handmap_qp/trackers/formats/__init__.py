"""File formats of recordings: find the format of a file, read, write and convert.

A format is an object of a subclass of `RecordingFormat`. Other packages add theirs by entry points
of the group `handmap_qp.formats`.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from handmap_core.errors import (
    InvalidInputError,
    RecordingError,
    expect,
)
from handmap_core.plugins import Plugins
from handmap_qp.hands import Names, Side
from handmap_qp.human import Recording, regular_time
from .archive import NpyFormat, NpzFormat
from .base import (
    SIDES,
    Entry,
    FileHints,
    RecordingFormat,
    entry_stem,
    first_of,
    reading,
)
from .csv_files import CsvFormat
from .hdf5 import EgoDexFormat, RobomimicFormat
from .lerobot import LeRobotFormat
from .long import LongRecording, in_memory, open_or_read, without_overview
from .mano import ManoFormat
from .mcap import McapFormat
from .objects import ArcticFormat, DexYcbFormat, GrabFormat, Hot3dFormat

_KINDS = (
    NpzFormat,
    CsvFormat,
    LeRobotFormat,
    RobomimicFormat,
    EgoDexFormat,
    McapFormat,
    DexYcbFormat,
    ArcticFormat,
    # Arrays of ARCTIC have a longer suffix.
    NpyFormat,
    Hot3dFormat,
    ManoFormat,
    GrabFormat,
)


FORMATS: Plugins[RecordingFormat] = Plugins(
    "handmap_qp.formats",
    lambda: {kind.name: kind() for kind in _KINDS},
    "handmap_qp.trackers.formats.base:RecordingFormat",
)
"""All formats by name; where a suffix has several, the first one that recognises a file reads it,
and the first one writes it."""
SEPARATOR = "::"
"""Between the path of a file and the name of one of its recordings."""
DEMO = "demo"
"""Name of the recording that comes with the package."""
DEMO_FILE = Path(__file__).parents[1] / "demo.npz"
_OURS = {file.stem: file for file in DEMO_FILE.parent.glob("*.npz")}
"""Recordings that come with the package: `DEMO`, and `held`, of a hand with an object."""


_REFUSED = {
    ".pkl": "is a pickle, as those of OakInk2, which may run code and is not read; save pose or "
    "joints, and object_pose, as an .npz of the form mano, or install packages/hamer, which reads "
    "arrays alone (docs/files.md)",
}
"""Why files with a suffix of no format are not read."""


class Source(NamedTuple):
    """A recording in a file.

    Attributes:
        path: The file or folder.
        format: Its format.
        entry: The recording in it.
    """

    path: Path
    format: RecordingFormat
    entry: Entry

    @property
    def name(self) -> str:
        """Name of the recording: that of its file, and of its entry if it has one."""
        return entry_stem(self.path, self.entry)

    def read(self) -> Recording:
        """Read the recording.

        Raises:
            RecordingError: If it is damaged, with the row or array at fault.
        """
        with reading(self.path):
            recording = self.format.read(self.path, self.entry)
            return recording.at_rate(self.format.hints.fps)

    def read_long(self) -> Recording | LongRecording:
        """Read the recording, or open it to be read by pieces if it is long.

        Raises:
            RecordingError: As `read`.
        """

        def opened() -> LongRecording | None:
            with reading(self.path):
                return self.format.open_long(self.path, self.entry)

        return open_or_read(self.entry.samples, opened, self.read)


def list_sources(
    path: Path | str, side: Side | None = None, *, fps: float | None = None
) -> tuple[Source, ...]:
    """List the recordings of a file or data set, without reading their samples.

    Args:
        path: The file or folder; `PATH::NAME` for one of its recordings, `demo` for the recording
            that comes with the package.
        side: Which hand it is of, where the file does not say.
        fps: Samples a second, in place of the time in the file; needed where it has none.

    Raises:
        InvalidInputError: If `path` is something else than a path, or `fps` is no rate.
        RecordingError: If it cannot be read, is of no known format, or has no such recording; or if
            it does not say which hand it is of, and `side` is omitted.
        MissingExtraError: If the format needs a package that is not installed.
    """
    expect(
        isinstance(path, str | Path),
        "path",
        "the path of a file",
        value=path,
    )
    file = Path(path)
    name = ""
    if not file.exists() and SEPARATOR in str(path):
        before, _, name = str(path).rpartition(SEPARATOR)
        file = Path(before)
    if not file.is_file():
        file = _OURS.get(str(file), file)
    if fps is not None:
        regular_time(0, fps)  # Reject a rate that is none before any file is read.
    with reading(file):
        form = format_of(file).with_hints(FileHints(side, fps))
        entries = form.entries(file)
    chosen = [entry for entry in entries if name in ("", entry.name)]
    if not chosen:
        missing = f"has no recording {name!r}; {_listing(entries)}"
        raise RecordingError(missing if name else "has no recordings", file=file)
    return tuple(Source(file, form, entry) for entry in chosen)


def read_hands(
    paths: Sequence[Path | str], *, fps: float | None = None
) -> dict[Side, Recording]:
    """Read a recording of the left and one of the right hand, from one file or from two.

    Args:
        paths: Files, as in `list_sources`, in any order; of two that do not say which hand they
            are of, the left hand's is the first one.
        fps: Samples a second, in place of the time in the files; needed where they have none.

    Returns:
        The two recordings by side.

    Raises:
        HandmapError: As `find_hands`, and if a recording is damaged.
    """
    sources = find_hands(paths, fps=fps)
    return {side: source.read() for side, source in sources.items()}


def read_long_hands(
    paths: Sequence[Path | str],
    *,
    fps: float | None = None,
    check: Callable[[Recording], object] = len,
) -> dict[Side, Recording | LongRecording]:
    """Read both hands as `read_hands`, or open those to be read by pieces that are long.

    Those have no overviews, which `all_long` gives them: two of an hour take 108 MB.

    Args:
        paths: As of `read_hands`.
        fps: As of `read_hands`.
        check: Called with each recording, or its overview if it is long; may reject it.

    Raises:
        HandmapError: As `read_hands` and `check`.
    """
    found: dict[Side, Recording | LongRecording] = {}
    for side, source in find_hands(paths, fps=fps).items():
        recording = source.read_long()
        check(in_memory(recording))
        found[side] = without_overview(recording)
        # Free its overview before that of the other hand is read.
        del recording
    return found


def find_hands(
    paths: Sequence[Path | str], *, fps: float | None = None
) -> dict[Side, Source]:
    """Find the recordings that `read_hands` reads, by side, without reading their samples.

    Raises:
        InvalidInputError: If the files have other recordings than one of each hand.
        HandmapError: As in `list_sources`.
    """
    hints = SIDES if len(paths) == len(SIDES) else [None] * len(paths)
    sources = [
        source
        for path, side in zip(paths, hints, strict=True)
        for source in list_sources(path, side, fps=fps)
    ]
    sides = [source.entry.side for source in sources]
    expect(
        sorted(sides) == ["left", "right"],
        "RECORDING",
        "one recording of the left and one of the right hand",
        got=first_of(sides, 4),
    )
    return {source.entry.side: source for source in sources}


def read_recording(
    path: Path | str, side: Side | None = None, *, fps: float | None = None
) -> Recording:
    """Read one recording from a file of any format.

        recording = read_recording("landmarks.npz", "right", fps=30)

    Args:
        path: The file or folder; `PATH::NAME` for one of several recordings in it, and `demo` for
            the recording that comes with the package.
        side: Which hand to take of a file with both, and which hand a file is of that does not say
            it.
        fps: Samples a second, in place of the time in the file; needed where it has none.

    Returns:
        The recording; samples with numbers that are not finite are marked as not valid. Where the
        file has one hand only, that one, whatever `side` says.

    Raises:
        InvalidInputError: If `path` is something else than a path, or `fps` is no rate.
        RecordingError: If the file cannot be read, something in it is missing or of another shape
            than expected, or it holds several recordings and none was named. Where the file has no
            side or no time, the message names the argument that gives it.
        MissingExtraError: If the format needs a package that is not installed.
    """
    return find_source(path, side, fps=fps).read()


def find_source(
    path: Path | str, side: Side | None = None, *, fps: float | None = None
) -> Source:
    """Find the one recording that `read_recording` reads, without reading its samples.

    Raises:
        HandmapError: As `read_recording`.
    """
    found = list_sources(path, side, fps=fps)
    sources = [source for source in found if source.entry.side == side] or found
    if len(sources) > 1:
        listing = _listing([source.entry for source in sources])
        problem = f"{listing}: name one of them after {SEPARATOR}"
        raise RecordingError(problem, file=sources[0].path)
    return sources[0]


def known_suffixes() -> Names:
    """Return the suffixes of all formats."""
    return tuple(
        dict.fromkeys(suffix for form in FORMATS.values() for suffix in form.suffixes)
    )


def format_of(path: Path) -> RecordingFormat:
    """Find the format of an existing file or folder.

    Raises:
        RecordingError: If there is no such file, or it is of no known format.
    """
    if not path.exists():
        raise RecordingError("cannot be read: No such file or directory", file=path)
    is_folder = path.is_dir()
    suffix = path.suffix.lower()
    name = path.name.lower()
    forms = [
        form
        for form in FORMATS.values()
        if is_folder or name.endswith((*form.suffixes, *form.named))
    ]
    # Others first: they may read more of what ours take for their own.
    for form in sorted(forms, key=lambda form: form.name in FORMATS.own):
        if form.recognises(path):
            return form
    problem = f"is not of the form {' or '.join(form.name for form in forms)}"
    if is_folder:
        problem = "cannot be read: is a folder of no known form"
    elif not forms:
        problem = _REFUSED.get(
            suffix,
            f"has the unknown suffix {suffix!r}; known are {', '.join(known_suffixes())}",
        )
    raise RecordingError(problem, file=path)


def format_to_write(path: Path, name: str | None = None) -> RecordingFormat:
    """Find the format of a file that is to be written.

    Args:
        path: The file; its suffix tells the format, and none means a LeRobot data set.
        name: Name of a format, which overrides the suffix.

    Raises:
        InvalidInputError: If there is no such format.
    """
    if name is not None:
        expect(
            name in FORMATS,
            "--format",
            f"one of {', '.join(FORMATS)}",
            value=name,
        )
        return FORMATS[name]
    # A name without a suffix is that of a folder.
    ending = path.name.lower() if path.suffix else "/"
    for form in FORMATS.values():
        if ending.endswith(form.suffixes or ("/",)):
            return form
    raise InvalidInputError(
        argument="OUT",
        expected=f"a file that ends in one of {', '.join(known_suffixes())}",
        value=str(path),
    )


def write_recordings(
    recordings: Sequence[Recording],
    path: Path | str,
    form: RecordingFormat | None = None,
) -> Names:
    """Write recordings to one file or data set.

    Args:
        recordings: The recordings.
        path: The file or folder to write.
        form: Its format; by its suffix if omitted.

    Returns:
        What the format could not hold, in words.

    Raises:
        InvalidInputError: If the format cannot hold them together, or the file cannot be written.
        MissingExtraError: If the format needs a package that is not installed.
    """
    file = Path(path)
    chosen = form or format_to_write(file)
    chosen.write(recordings, file)
    return chosen.losses(recordings)


def _listing(entries: Sequence[Entry]) -> str:
    names = [entry.name for entry in entries]
    return f"it has {len(names)} recordings ({first_of(names, 5)})"
