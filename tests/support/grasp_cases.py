"""A hand for the tests of grasps."""

from __future__ import annotations

import msgspec

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.spec import MimicSpec


def coupled_hand() -> Hand:
    """Return the three-fingered hand with distal joints that mimic their proximal ones."""
    spec = load_hand("three_finger").spec
    copies = {f"f{i}_distal": MimicSpec(f"f{i}_proximal", 0.7, 0.1) for i in (1, 2, 3)}
    kept = tuple(joint for joint in spec.joints if joint not in copies)
    rest = {joint: spec.rest[joint] for joint in kept}
    return Hand(
        msgspec.structs.replace(
            spec, name="coupled", joints=kept, rest=rest, mimic=copies
        )
    )
