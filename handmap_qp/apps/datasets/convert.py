"""Convert recordings between file formats."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from handmap_qp.errors import expect
from handmap_qp.output_files import check_output, make_folder
from handmap_qp.trackers.formats import Source, format_to_write, list_sources
from handmap_qp.trackers.formats.mano import ManoFormat


class Conversion(NamedTuple):
    """What was converted.

    Attributes:
        recordings: Number of recordings.
        samples: Number of samples in all.
        files: Files or folders written.
        not_read: What the files held besides recordings of hands.
        lost: What the new format cannot hold.
    """

    recordings: int
    samples: int
    files: tuple[Path, ...]
    not_read: tuple[str, ...]
    lost: tuple[str, ...]


def convert(
    inputs: Sequence[Path | str],
    out: Path,
    form: str | None = None,
    mano: Path | None = None,
) -> Conversion:
    """Read recordings from files of any format, and write them in another one.

    Args:
        inputs: Files or data sets, as of `list_sources`.
        out: File or folder to write. A folder, that is a path without suffix, together with the
            name of a format that has one file for each recording, gets such files.
        form: Name of the new format; by the suffix of `out` if omitted.
        mano: File of the licensed MANO model, or its folder, for MANO parameters.

    Raises:
        HandmapError: If a file cannot be read, or `out` cannot be written or cannot hold them.
    """
    target = format_to_write(out, form)
    is_folder = bool(target.suffixes) and not out.suffix
    if target.suffixes and not is_folder:
        check_output("OUT", out, target.suffixes)
    sources = [
        source._replace(format=ManoFormat(mano))
        if isinstance(source.format, ManoFormat)
        else source
        for source in chain.from_iterable(map(list_sources, inputs))
    ]
    unread = {source.path: source.format.unread(source.path) for source in sources}
    recordings = list(map(Source.read, sources))
    contents = {out: recordings}
    if is_folder:
        contents = {}
        for source, recording in zip(sources, recordings, strict=True):
            file = out / f"{source.name}{target.suffixes[0]}"
            expect(
                file not in contents,
                "IN",
                "recordings of different names",
                got=f"{file.stem} twice",
            )
            contents[file] = [recording]
        make_folder(out, "OUT")
    for file, content in contents.items():
        target.write(content, file)
    return Conversion(
        recordings=len(recordings),
        samples=sum(map(len, recordings)),
        files=tuple(contents),
        not_read=tuple(dict.fromkeys(chain.from_iterable(unread.values()))),
        lost=target.losses(recordings),
    )
