"""Arms of the package, and hands on them, for tests."""

from __future__ import annotations

from typing import Any

import msgspec
import yaml

from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.spec import ArmSpec, HandSpec


def arm_of(name: str) -> ArmSpec:
    """Return the description of an arm in `urdf/arms`."""
    file = urdf_directory() / "arms" / f"{name}.yaml"
    spec = msgspec.convert(yaml.safe_load(file.read_text(encoding="utf-8")), ArmSpec)
    return msgspec.structs.replace(spec, directory=file.parent)


def mounted(hand: HandSpec, arm: ArmSpec, **pose: Any) -> HandSpec:
    """Describe a hand on an arm; `xyz` and `rpy` place its root link in the frame of the tip."""
    placed = msgspec.structs.replace(arm, **pose)
    return msgspec.structs.replace(hand, name=f"{arm.name}_{hand.name}", arm=placed)
