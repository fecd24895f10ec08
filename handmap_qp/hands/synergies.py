"""Postural synergies of the human hand: few coordinates for its twenty joints."""

import json
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import expect
from handmap_core.se3 import Array, as_floats, frozen
from .sources import urdf_directory


class Synergies(NamedTuple):
    """Postural synergies: `q = mean + matrix @ z`.

    Attributes:
        matrix: S, joint angles per unit of each synergy [rad], shape (20, 15); rows in the order of
            `HUMAN_JOINTS`. Its columns are not orthonormal, because DIP angles follow PIP angles in
            it.
        mean: Mean posture q_m [rad], shape (20,).
    """

    matrix: Array
    mean: Array

    def posture(self, z: ArrayLike) -> Array:
        """Compute joint angles [rad], shape (20,), not clipped to limits.

        Args:
            z: Coordinates of the first synergies; those left out are 0. Shape (k,), k <= 15.

        Raises:
            InvalidInputError: On a wrong shape or a number that is not finite.
        """
        coordinates = as_floats(z, "z", shape=("k",), is_finite=True)
        expect(
            len(coordinates) <= 15,
            "z",
            "at most 15 numbers",
            value=z,
            got=str(len(coordinates)),
        )
        return self.mean + self.matrix[:, : len(coordinates)] @ coordinates

    def coordinates(self, q: ArrayLike) -> Array:
        """Compute the coordinates, shape (15,), nearest to joint angles [rad], shape (20,).

        The sum of squared differences of the angles is least.

        Raises:
            InvalidInputError: On a wrong shape or a number that is not finite.
        """
        angles = as_floats(q, "q", shape=(20,), is_finite=True)
        return np.linalg.lstsq(self.matrix, angles - self.mean, rcond=None)[0]


@cache
def load_synergies() -> Synergies:
    """Load the synergies of the 20-joint human hand; the same object at every call.

    `urdf/human/synergies.json` names their source.
    """
    file = urdf_directory() / "human" / "synergies.json"
    document = json.loads(file.read_bytes())
    return Synergies(*(frozen(np.array(document[key])) for key in ("S", "q_m")))
