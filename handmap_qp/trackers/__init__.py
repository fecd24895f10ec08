"""From files and devices to samples of a human hand, and checks that they are what they say."""

from handmap_core.trackers.hand_geometry import BONES, NEIGHBOURS
from .file_evidence import (
    STILL_TRAVEL,
    STILL_TURN,
    RecordingFacts,
    hints,
    recording_facts,
)
from .formats import (
    DEMO,
    FORMATS,
    SEPARATOR,
    Source,
    find_hands,
    find_source,
    format_to_write,
    list_sources,
    read_hands,
    read_long_hands,
    read_recording,
    write_recordings,
)
from .formats.archive import (
    NpzFormat,
    array_shapes,
    read_archive,
    read_rows,
    save_npz,
)
from .formats.base import SIDES, first_of, reading
from .formats.disk_columns import DiskColumn, write_npz
from .formats.long import (
    OVERVIEW,
    PIECE,
    LongRecording,
    all_long,
    blocks_of,
    in_memory,
    in_pieces,
    pieces_of,
    without_overview,
)
from .layouts import LAYOUTS
from .layouts.angles import AngleLayout
from .layouts.base import Layout, sized_human
from .layouts.files import layout_hint, read_with_layout
from .layouts.long_files import read_long_with_layout, side_with_layout
from .layouts.markers import MarkerLayout
from .layouts.points import PointLayout
from .layouts.tables import load_layout, table_text
from .plausibility import InputCheck, check_recording, known_orders

__all__ = [
    "BONES",
    "DEMO",
    "FORMATS",
    "LAYOUTS",
    "NEIGHBOURS",
    "OVERVIEW",
    "PIECE",
    "SEPARATOR",
    "SIDES",
    "STILL_TRAVEL",
    "STILL_TURN",
    "AngleLayout",
    "DiskColumn",
    "InputCheck",
    "Layout",
    "LongRecording",
    "MarkerLayout",
    "NpzFormat",
    "PointLayout",
    "RecordingFacts",
    "Source",
    "all_long",
    "array_shapes",
    "blocks_of",
    "check_recording",
    "find_hands",
    "find_source",
    "first_of",
    "format_to_write",
    "hints",
    "in_memory",
    "in_pieces",
    "known_orders",
    "layout_hint",
    "list_sources",
    "load_layout",
    "pieces_of",
    "read_archive",
    "read_hands",
    "read_long_hands",
    "read_long_with_layout",
    "read_recording",
    "read_rows",
    "read_with_layout",
    "reading",
    "recording_facts",
    "save_npz",
    "side_with_layout",
    "sized_human",
    "table_text",
    "without_overview",
    "write_npz",
    "write_recordings",
]
