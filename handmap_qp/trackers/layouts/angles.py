"""Layouts of joint angles: gloves, and angles of the human model by name.

Angles become landmarks through the human model, as long as the person where lengths are given.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import did_you_mean, expect
from handmap_core.se3 import Array, transform_points
from handmap_qp.hands import HUMAN_JOINTS, Document, Hand, HumanLengths, Names, Side
from .base import Hands, Layout, Rows, sized_human

_UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
"""Size of a unit of angle [rad]."""

# No joint of a hand turns farther, so larger numbers are in degrees; and no hand is so straight
# that all its angles are smaller, so smaller ones are in radians.
_LARGEST_ANGLE = 3.2  # rad
_STRAIGHTEST = 3.2  # deg
_BACKWARDS = 20.0  # deg, mean of the four middle joints; people reach about 10


class AngleEntry(Document, frozen=True):
    """One angle.

    Attributes:
        name: Its name at the tracker.
        joint: Joint of the human model that it turns.
        scale: Sign and factor from it to the joint's angle.
        offset: The joint's angle where it is zero, in the unit of the table.
        aliases: Further names that it has.
        default: Its value where a file lacks it; None if it is needed.
    """

    name: str
    joint: str
    scale: float = 1.0
    offset: float = 0.0
    aliases: Names = ()
    default: float | None = None


class AngleLayout(Layout, tag="angles", kw_only=True):
    """A layout of joint angles.

    Attributes:
        angles: The angles, in their order.

    Raises:
        InvalidInputError: If the table names no joint, or one twice.
    """

    angles: tuple[AngleEntry, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        joints = [entry.joint for entry in self.angles]
        for entry in self.angles:
            expect(
                entry.joint in HUMAN_JOINTS and joints.count(entry.joint) == 1,
                "angles",
                "joints of the human hand, each once",
                value=entry.joint,
                advice=did_you_mean(entry.joint, HUMAN_JOINTS),
            )
            expect(entry.scale != 0.0, f"{entry.joint}.scale", "not 0", value=0.0)
            self.aliases[entry.name] = entry.aliases
            if entry.default is not None:
                self.defaults[entry.name] = entry.default
        expect(self.unit in _UNITS, "unit", "deg or rad", value=self.unit)
        self._joints = [*map(HUMAN_JOINTS.index, joints)]
        factors = np.array([(entry.scale, entry.offset) for entry in self.angles])
        self._scales, self._offsets = _UNITS[self.unit] * factors.T  # to radians
        self.shapes = ((len(joints),),)
        self.columns = tuple(entry.name for entry in self.angles)

    def rows(self) -> Rows:
        """Describe every angle."""
        return [
            {
                "index": i,
                "angle": entry.name,
                "joint of the human model": entry.joint,
                f"joint [{self.unit}]": f"{entry.scale:+g} x angle"
                + (f" {entry.offset:+g}" if entry.offset else ""),
            }
            for i, entry in enumerate(self.angles)
        ]

    def hands(
        self,
        values: Array,
        side: Side,
        wrists: Array | None,
        lengths: HumanLengths | None,
    ) -> Hands:
        """Turn angles into landmarks by the human model; see `Layout.hands`.

        Joints that the tracker does not have are at 0.
        """
        human = sized_human(side, lengths)
        postures = np.clip(self._postures(values), *human.limits)
        landmarks = np.array([human.points(q) for q in postures])
        if wrists is not None:
            landmarks = transform_points(wrists, landmarks)
        return landmarks, wrists

    def write_posture(self, human: Hand, q: ArrayLike, wrist: Array) -> Array:
        """Return the angles of a posture; see `Layout.write_posture`."""
        own = np.asarray(q, dtype=float)[self._joints]
        return (own - self._offsets) / self._scales

    def _postures(self, values: Array) -> Array:
        """Return angles (T, n) as postures of the human model [rad], shape (T, 20)."""
        postures = np.zeros((len(values), len(HUMAN_JOINTS)))
        postures[:, self._joints] = self._scales * values + self._offsets
        return postures

    def check(self, parts: Iterable[Array]) -> None:
        """Reject angles of the other unit, and those of a wrong sign; see `Layout.check`."""
        is_middle = [name.endswith("PIP_flexion") for name in HUMAN_JOINTS]
        largest = 0.0
        farthest = -np.inf
        sample = count = 0
        for values in parts:
            largest = max(largest, float(np.abs(values).max()))
            back = -np.degrees(self._postures(values)[:, is_middle].mean(axis=1))
            if back.max() > farthest:
                farthest = float(back.max())
                sample = count + int(np.argmax(back))
            count += len(values)
        self._check_unit(largest, count)
        expect(
            farthest <= _BACKWARDS,
            "values",
            "flexion with a positive sign",
            got=f"middle joints bent backwards by {farthest:.0f} deg in sample {sample}",
            advice="turn the sign of the flexion angles",
        )

    def _check_unit(self, largest: float, count: int) -> None:
        """Reject angles of the other unit, by the largest one of so many samples."""
        unit = self.unit
        other = "degrees"
        is_other = largest > 2.0 * _LARGEST_ANGLE
        if unit == "deg":
            other = "radians"
            is_other = count > 1 and 0.0 < largest < _STRAIGHTEST
        convert = f"convert them, or set `unit: {other[:3]}` in a table of your own"
        expect(
            not is_other,
            "values",
            f"angles in {unit}",
            got=f"some of up to {largest:.4g}",
            advice=f"these are {other}: {convert}",
        )
