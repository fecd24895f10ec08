"""Common postures of the human hand, as joint angles: `standard_postures`."""

import numpy as np

from handmap_core.se3 import Array, Arrays
from handmap_qp.hands import Hand

# Last joints flex by this share of the others' angle, the thumb's to the other side.
_SHARES = np.array([(1.0, 1.0, -0.6), *4 * [(1.0, 1.0, 0.8)]])


def standard_postures(human: Hand) -> Arrays:
    """Return common postures of the human hand, inside its limits [rad], shape (20,) each."""

    def posture(*flexions: float, spread: float = 1.0) -> Array:
        """Flex fingers from the thumb onwards; the others rest."""
        # Each finger has four joints, of which the first abducts it.
        q = human.rest.reshape(-1, 4).copy()
        q[1:, 0] *= spread
        for i, flexion in enumerate(flexions):
            q[i, 1:] = flexion * _SHARES[i]
        return np.clip(q.ravel(), *human.limits)

    return {
        "flat hand": posture(0.1, 0.05, 0.05, 0.05, 0.05),
        "spread": posture(0.0, 0.05, 0.05, 0.05, 0.05, spread=3.0),
        "fist": posture(0.7, 1.4, 1.4, 1.4, 1.4),
        "pointing": posture(0.7, 0.05, 1.4, 1.4, 1.4),
        "pinch": posture(0.6, 0.9),
    }
