"""`Layout`: how a tracker lays out one sample of a hand.

There are three kinds of them: points or poses of joints (`points`), joint angles (`angles`) and
optical markers (`markers`). Each kind reads tables: the order of the joints, their unit and axes,
how the wrist's pose is obtained, and what the tracker does not give.
"""

import abc
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any, ClassVar, Literal

import numpy as np
from msgspec import Struct, StructMeta
from numpy.typing import ArrayLike

from handmap_core.errors import InvalidInputError, did_you_mean, expect
from handmap_core.se3 import (
    Array,
    QuatOrder,
    affine,
    as_floats,
    check_poses,
    pose_from_xyz_quat,
)
from handmap_core.trackers.wrist_axes import axes_convention
from handmap_qp.hands import (
    OTHER_SIDE,
    Document,
    Hand,
    HumanLengths,
    Names,
    Points,
    Side,
    Upright,
    Values,
    load_hand,
)
from handmap_qp.human import (
    HumanSample,
    LandmarkFitter,
    Recording,
    as_flags,
    axis_direction,
    check_side,
    finite_samples,
    human_name,
)
from . import LAYOUTS

Unit = Literal["m", "cm", "mm", "deg", "rad"]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
_LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Size of a unit of length [m]."""
TYPICAL_LENGTH = 0.19
"""Length of the hand that angles and markers are read with where no person was measured [m]."""


class AxesTable(Document, frozen=True):
    """The anatomical directions in a wrist's own axes.

    Attributes:
        distal: To the fingertips.
        dorsal: Out of the back of the hand.
    """

    distal: Axis
    dorsal: Axis


class WristTable(Document, frozen=True):
    """How a wrist pose is obtained.

    Attributes:
        right: Axes of a right wrist.
        left: Axes of a left wrist; those of the right one if omitted.
        joint: Joint whose pose it is; None if it comes beside the values (`wrist=`).
        quaternion: Order of a quaternion that stands for its orientation.
    """

    right: AxesTable
    left: AxesTable | None = None
    joint: str | None = None
    quaternion: QuatOrder = "xyzw"


Hands = tuple[Array, Array | None]
"""Landmarks in our order [m], (T, 21, 3), and wrist poses with our axes, (T, 4, 4), if any."""
HandsOf = Callable[[Array, Array | None], Hands]
"""Turns values and wrist poses of consecutive samples into hands, as `Layout.hands`."""
Samples = tuple[Any, Any, Any]
"""Values, wrist poses beside them and which are valid, of consecutive samples: see `record`."""
Converted = tuple[Array, Array | None, Array]
"""Landmarks, wrist poses and which samples are seen: see `Layout.convert`."""
Rows = list[Values]
"""A table: values by column, row by row."""


class _Kind(StructMeta, abc.ABCMeta):
    """Makes kinds of tables with abstract methods."""


class Layout(
    Struct,
    forbid_unknown_fields=True,
    dict=True,
    eq=False,
    tag_field="kind",
    metaclass=_Kind,
):
    """A tracker's form of samples: its table, and how samples are read and written.

    Other packages add theirs by entry points of the group `handmap_qp.layouts`, each of which names
    a layout.

    Attributes:
        name: Short name, by which `--layout` chooses it.
        title: Device or data set, and its programming interface.
        sources: Public documents that the facts were taken from.
        unit: Unit of lengths or angles.
        axes: Directions of the world's axes, in words.
        values: What one sample is, in words.
        missing: What the tracker does not give.
        upright: Axes of our world, after `mirror`, that are up and forward; empty where they are
            not known.
        mirror: Axis to negate, where the coordinates are left-handed; None where they are not.
        arrays: Names that a file's array of these values usually has.
        time: Names that a table's column of time usually has, with the length of its unit [s].
        wrist: How a wrist pose is obtained, or its axes where it comes from another tracker; None
            if it cannot be.
        shapes: Shapes that one sample may have, the usual one first.
        columns: Names of the numbers of one sample in a table of columns.
        aliases: Further names of columns.
        defaults: What stands for columns that may be missing.
        has_wrist: Whether the values hold a wrist pose.
        is_costly: Whether finding the landmarks takes longer than reading the file. Those of a long
            recording are then found once, and kept on the disk.
        world: Takes points of the tracker's world to ours [m], shape (4, 4).
    """

    name: str
    title: str
    sources: Names
    unit: Unit
    axes: str
    values: str
    missing: Names = ()
    upright: Upright = ""
    mirror: Literal["x", "y", "z"] | None = None
    arrays: Names = ()
    time: dict[str, float] = {}
    wrist: WristTable | None = None
    has_wrist = False
    is_costly: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self.shapes: tuple[tuple[int, ...], ...] = ()
        self.columns: Names = ()
        self.aliases: dict[str, Names] = {}
        self.defaults: dict[str, float] = {}
        # Angles come without lengths.
        length = _LENGTHS.get(self.unit, 1.0)
        scales = [-length if axis == self.mirror else length for axis in "xyz"]
        self.world = np.diag([*scales, 1.0])

    def wrist_axes(self, side: Side) -> Array:
        """Return what takes points in our wrist's frame [m] to the tracker's own, shape (4, 4).

        A wrist pose of the tracker is ours as `world @ pose @ wrist_axes`.
        """
        turn = np.eye(3)
        table = self.wrist
        if table is not None:
            axes = table.left if side == "left" and table.left else table.right
            reflection = np.sign(self.world[:3, :3])
            distal = reflection @ axis_direction(axes.distal)
            dorsal = reflection @ axis_direction(axes.dorsal)
            turn = axes_convention(distal, dorsal)
        return np.linalg.inv(self.world) @ affine(turn.T)

    def order(self, side: Side) -> Array | None:
        """Return the index of each of our landmarks among joints; None if there are no joints."""
        return None

    @abc.abstractmethod
    def rows(self) -> Rows:
        """Describe every entry: index, name and meaning."""

    @abc.abstractmethod
    def hands(
        self,
        values: Array,
        side: Side,
        wrists: Array | None,
        lengths: HumanLengths | None,
    ) -> Hands:
        """Turn values into landmarks and wrist poses.

        Args:
            values: In one of `shapes`, for T samples, finite, shape (T, ...).
            side: Which hand.
            wrists: Wrist poses beside the values, with our axes, shape (T, 4, 4); None for none.
            lengths: The person's lengths, for angles and markers; None for typical ones.

        Raises:
            InvalidInputError: If the numbers cannot be of this layout.
        """

    def follow(self, side: Side, lengths: HumanLengths | None) -> HandsOf:
        """Return what turns the samples of one recording into hands, some consecutive ones at once.

        The hands are those of `hands` of all samples, to the last bit.

        Args:
            side: As of `hands`.
            lengths: As of `hands`.
        """
        return lambda values, wrists: self.hands(values, side, wrists, lengths)

    def check(self, parts: Iterable[Array]) -> None:
        """Reject numbers that cannot be of this layout, such as angles in another unit.

        Args:
            parts: Values of consecutive samples in which the hand was seen, in one of `shapes`.

        Raises:
            InvalidInputError: If they cannot be of this layout.
        """

    @abc.abstractmethod
    def write_posture(self, human: Hand, q: ArrayLike, wrist: Array) -> Array:
        """Return values of the human hand in a posture.

        Args:
            human: The human hand; `load_hand("human")`, with any lengths.
            q: Joint angles in the order of `HUMAN_JOINTS` [rad], shape (20,).
            wrist: Pose of its wrist, shape (4, 4).

        Returns:
            Values in the usual one of `shapes`.
        """

    def write(self, sample: HumanSample) -> Array:
        """Return the values of a sample; angles and markers are of the fitted human model.

        Raises:
            InvalidInputError: If the sample is not valid, or no hand.
        """
        expect(sample.valid, "sample", "a valid sample", got="another")
        fitter = LandmarkFitter(sample.side)
        q, wrist = fitter.fit(sample.landmarks)
        return self.write_posture(fitter.human, q, wrist)

    def read(
        self,
        values: ArrayLike | Mapping[str, float],
        *,
        time: float,
        side: Side,
        wrist: ArrayLike | None = None,
        valid: bool = True,
        confidence: float = 1.0,
        lengths: HumanLengths | None = None,
    ) -> HumanSample:
        """Turn one sample into the form that everything behind takes.

        Args:
            values: In one of `shapes`; with names, a dictionary from `columns` to numbers.
            time: Instant [s].
            side: Which hand.
            wrist: Wrist pose that comes beside the values, in the tracker's own axes: a pose of
                shape (4, 4), or position and quaternion of shape (7,).
            valid: Whether the tracker saw the hand.
            confidence: The tracker's own confidence, from 0 to 1.
            lengths: The person's lengths, for angles and markers; typical ones if omitted.

        Raises:
            InvalidInputError: If the values are not of this layout; the message names the layouts
                that have their shape.
        """
        if isinstance(values, Mapping):
            values = self.from_columns(values, side)
        landmarks, wrists, seen = self.convert(
            [values], side, None if wrist is None else [wrist], [valid], lengths
        )
        pose = wrists[0] if wrists is not None else None
        return HumanSample(time, side, landmarks[0], pose, bool(seen[0]), confidence)

    def record(
        self,
        name: str,
        time: ArrayLike,
        values: ArrayLike,
        side: Side,
        *,
        wrists: ArrayLike | None = None,
        valid: Any = None,
        lengths: HumanLengths | None = None,
    ) -> Recording:
        """Turn the samples of a file into a recording.

        Args:
            name: Name of the recording.
            time: Instants [s], shape (T,).
            values: In one of `shapes`, for every sample; not finite where the hand was not seen.
            side: Which hand.
            wrists: Wrist poses beside the values, as in `read`, shape (T, 4, 4) or (T, 7).
            valid: Samples in which the hand was seen, shape (T,); the finite ones if omitted.
            lengths: The person's lengths, for angles and markers.

        Raises:
            InvalidInputError: As in `read` and of `Recording`.
        """
        landmarks, poses, seen = self.convert(values, side, wrists, valid, lengths)
        return Recording(
            name,
            np.asarray(time),
            landmarks,
            seen,
            side,
            f"layout {self.name}",
            poses,
            upright=self.upright,
        )

    def convert(
        self,
        values: Any,
        side: Side,
        wrists: Any,
        valid: Any,
        lengths: HumanLengths | None,
    ) -> Converted:
        """Turn samples into landmarks, wrist poses if there are any, and which samples are seen.

        Arguments and errors are those of `record`.

        Returns:
            Landmarks [m], shape (T, 21, 3), NaN where the hand was not seen; wrist poses, shape
            (T, 4, 4), unit matrices where it was not seen, or None; and whether it was seen, shape
            (T,).
        """
        check_side(side)
        samples = values, wrists, valid
        self.check_parts([samples])
        (found,) = self.convert_parts([samples], side, lengths)
        return found

    def check_parts(self, parts: Iterable[Samples]) -> None:
        """Reject samples as `check`, of which only those count in which the hand was seen."""

        def values_seen() -> Iterator[Array]:
            for values, _, valid in parts:
                array, seen = self._seen(values, valid)
                if seen.any():
                    yield array[seen]

        self.check(values_seen())

    def convert_parts(
        self, parts: Iterable[Samples], side: Side, lengths: HumanLengths | None
    ) -> Iterator[Converted]:
        """Turn the samples of one recording into landmarks as `convert`, part by part.

        Wrist poses are None in a part in which the hand is never seen.

        Args:
            parts: Consecutive samples, for which `check_parts` has been called.
            side: As of `record`.
            lengths: As of `record`.
        """
        hands = self.follow(side, lengths)
        for values, wrists, valid in parts:
            array, seen = self._seen(values, valid)
            beside = None
            if wrists is not None:
                beside = self._wrists_beside(as_floats(wrists, "wrist"), side, seen)
            landmarks = np.full((len(array), 21, 3), np.nan)
            poses = None
            if seen.any():
                landmarks[seen], found = hands(array[seen], beside)
                if found is not None:
                    poses = np.tile(np.eye(4), (len(array), 1, 1))
                    poses[seen] = found
            yield landmarks, poses, seen

    def seen(self, values: Any, valid: Any) -> Array:
        """Tell in which samples the hand was seen, shape (T,); arguments as of `record`."""
        return self._seen(values, valid)[1]

    def _seen(self, values: Any, valid: Any) -> tuple[Array, Array]:
        """Return samples in one of `shapes`, and whether the hand was seen, shape (T,)."""
        array = self._checked(values)
        seen = finite_samples(array)
        if valid is not None:
            seen &= as_flags(valid, len(array))
        return array, seen

    def find_columns(self, names: Collection[str], side: Side) -> dict[str, str]:
        """Find the numbers of one sample among named ones.

        A name may have more before it, such as `RightFinger`, where it names no other side.

        Args:
            names: The names at hand.
            side: Which hand.

        Returns:
            Name at hand of each of `columns`; those for which a default stands are left out.

        Raises:
            InvalidInputError: If one is missing.
        """
        other = OTHER_SIDE[side]
        own = [name for name in names if other not in name.lower()]
        found = {}
        for column in self.columns:
            longer = [n for n in own if n.lower().endswith(column.lower())]
            likely = (column, *self.aliases.get(column, ()), *longer)
            fitting = [name for name in likely if name in names]
            if fitting:
                found[column] = fitting[0]
            elif column not in self.defaults:
                raise InvalidInputError(
                    argument="values",
                    expected=f"a column {column}",
                    got=f"none; {did_you_mean(column, own)}".rstrip("; "),
                )
        return found

    def from_columns(self, given: Mapping[str, ArrayLike], side: Side) -> Array:
        """Put named numbers into the order of `columns`.

        Args:
            given: Numbers or columns of equal length by name, as in `find_columns`.
            side: Which hand.

        Returns:
            Values of one sample, shape (n,), or of T samples, shape (T, n).

        Raises:
            InvalidInputError: If one is missing.
        """
        found = self.find_columns(given, side)
        by_column = self.defaults | {c: given[name] for c, name in found.items()}
        ordered = [by_column[column] for column in self.columns]
        return np.stack(np.broadcast_arrays(*ordered), axis=-1)

    def sample_shape(self, shape: tuple[int, ...]) -> tuple[int, ...] | None:
        """Return which of `shapes` a sample has that may be flat; None if it has another one."""
        for own in self.shapes:
            if shape in (own, (np.prod(own),)):
                return own
        return None

    def _checked(self, values: ArrayLike) -> Array:
        """Return samples as floats in one of the shapes of this layout."""
        array = as_floats(values, "values")
        shape = array.shape[1:]
        own = self.sample_shape(shape)
        if own is not None:
            return array.reshape(-1, *own)
        others = layouts_of_shape(shape)
        raise InvalidInputError(
            argument="values",
            expected=f"a sample of {self.name}, {' or '.join(map(str, self.shapes))}",
            got=f"shape {shape}",
            advice=f"that is the shape of {', '.join(others)}" if others else "",
        )

    def _wrists_beside(self, values: Array, side: Side, seen: Array) -> Array:
        """Return poses that came beside the values, with our axes, of the samples seen."""
        table = self.wrist
        if table is None:
            expected = f"none: {self.name} says nothing about its axes"
            raise InvalidInputError(argument="wrist", expected=expected)
        if values.shape[1:] == (7,):
            poses = pose_from_xyz_quat(values, table.quaternion, "wrist")
        else:
            poses = check_poses(values, "wrist", seen)
        return self.world @ poses[seen] @ self.wrist_axes(side)


def layouts_of_shape(shape: tuple[int, ...]) -> list[str]:
    """Return the names of the layouts whose samples may have a shape."""
    return [name for name, layout in LAYOUTS.items() if shape in layout.shapes]


@lru_cache(maxsize=8)  # lengths hash by identity
def sized_human(
    side: Side, lengths: HumanLengths | None = None, points: Points = "landmarks"
) -> Hand:
    """Return the human hand of a person, or a typical one, its points the landmarks."""
    size = TYPICAL_LENGTH if lengths is None else None
    return load_hand(human_name(side), points=points, lengths=lengths, hand_length=size)
