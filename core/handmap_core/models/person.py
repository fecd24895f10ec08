"""What is known of a person's hand to those who read and judge its samples."""

from __future__ import annotations

from typing import Literal

from .encoding import Indices, Model, Points, Vector


class GuardModel(Model, frozen=True, kw_only=True):
    """The hand whose samples a guard judges; see `StreamGuard`.

    Attributes:
        side: The side of the body that it is of.
        landmarks: Its landmarks at rest, in the frame of its wrist [m], shape (21, 3).
    """

    side: Literal["right", "left"]
    landmarks: Points


class LandmarkReaderModel(Model, frozen=True, kw_only=True):
    """What turns landmarks into the reference points of a hand; see `LandmarkReader`.

    Attributes:
        used: Landmark of each reference point, shape (n_h,).
        palm: Landmarks of the palm in the frame of the wrist [m], shape (5, 3).
        weights: Weight of each of them where the palm is fitted, shape (5,).
    """

    used: Indices
    palm: Points
    weights: Vector
