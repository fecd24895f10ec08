"""Loads of fingers by the torques of motors."""

import numpy as np
import pytest
from handmap_drive.loads import FingerLoads

FINGERS = {"a": "index", "b": "index", "c": "thumb"}


def test_a_finger_has_the_largest_load_of_its_motors_in_any_direction() -> None:
    loads = FingerLoads(("b", "wrist", "c", "a"), FINGERS)
    torque = np.array([0.1, 0.9, 0.3, -0.4])
    assert loads.of(torque) == pytest.approx({"index": 0.4, "thumb": 0.3})
    assert loads.of(-torque) == loads.of(torque)


def test_loads_are_shares_whatever_motors_tell() -> None:
    loads = FingerLoads(("a", "c"), FINGERS)
    assert loads.of(np.array([np.nan, 7.0])) == {"index": 0.0, "thumb": 1.0}
