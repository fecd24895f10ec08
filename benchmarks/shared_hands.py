"""Robot hands whose URDFs lie outside the repository: LEAP and SCHUNK SVH, by name.

Their descriptions are in `benchmarks/hands/`; the URDFs are looked for in the folder that the
environment variable `HANDMAP_HANDS` names, else in `shared/hands` beside the repository.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from handmap_qp.hands.spec import HandSpec, read_hand_spec

DESCRIPTIONS = Path(__file__).resolve().parent / "hands"
FOLDERS = {"leap_right": "leap_hand", "svh_right": "schunk_hand"}
"""Names of the hands, and the folder of each one's URDF."""


def shared_hands_folder() -> Path | None:
    """The folder with the hands' URDFs; None if there is none."""
    repository = DESCRIPTIONS.parents[1]
    candidates = [
        os.environ.get("HANDMAP_HANDS"),
        repository.parent / "shared" / "hands",
        repository.parents[1] / "shared" / "hands",
    ]
    for candidate in candidates:
        if candidate and Path(candidate).is_dir():
            return Path(candidate)
    return None


def shared_hand_spec(name: str) -> HandSpec:
    """Read the description of a hand whose URDF lies outside the repository.

    Args:
        name: One of `FOLDERS`.

    Returns:
        The description, for `load_hand`.

    Raises:
        FileNotFoundError: If the URDFs are not there.
    """
    folder = shared_hands_folder()
    if folder is None:
        raise FileNotFoundError("no folder with shared hands: set HANDMAP_HANDS")
    spec = read_hand_spec(DESCRIPTIONS / f"{name}.yaml")
    return msgspec.structs.replace(spec, directory=folder / FOLDERS[name])
