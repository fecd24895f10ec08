"""Robot hands whose URDFs lie outside the repository: LEAP and SCHUNK SVH, by name.

Their descriptions are in `benchmarks/hands/`. Commands take them by path, with the environment
variable `HANDMAP_HANDS` set to the folder of the URDFs. `shared_hand_spec` also looks for that
folder at `shared/hands` beside the repository.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.spec import HandSpec, read_hand_spec

ROOT = Path(__file__).resolve().parents[2]
DESCRIPTIONS = ROOT / "benchmarks" / "hands"
NAMES = ("leap_right", "svh_right")
"""Names of the hands."""


def shared_hands_folder() -> Path | None:
    """The folder with the hands' URDFs; None if there is none."""
    candidates = [
        os.environ.get("HANDMAP_HANDS"),
        ROOT.parent / "shared" / "hands",
        ROOT.parents[1] / "shared" / "hands",
    ]
    for candidate in candidates:
        if candidate and Path(candidate).is_dir():
            return Path(candidate)
    return None


def shared_hand_spec(name: str) -> HandSpec:
    """Read the description of a hand whose URDF lies outside the repository.

    Args:
        name: One of `NAMES`.

    Returns:
        The description, for `load_hand`.

    Raises:
        FileNotFoundError: If the URDFs are not there.
    """
    folder = shared_hands_folder()
    if folder is None:
        raise FileNotFoundError("no folder with shared hands: set HANDMAP_HANDS")
    spec = read_hand_spec(DESCRIPTIONS / f"{name}.yaml")
    urdf = spec.urdf.replace("${HANDMAP_HANDS}", str(folder))
    return msgspec.structs.replace(spec, urdf=urdf)


def load(name: str) -> Hand:
    """Load a hand by name, one of `NAMES` or one of the package."""
    return load_hand(shared_hand_spec(name) if name in NAMES else name)
