"""Describe the hand or the hands of a URDF or MJCF file in files: `init_hands`."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace

from handmap_core.errors import HandError, expect
from handmap_qp.hands import Hand, Names, Side, load_hand, load_robot
from .detect import Detection, detect_hands
from .edit import described
from .single_joints import FingerKind
from .speeds import with_speed
from .structure import Clue
from .write import RobotSource, check_free, open_source, write_hand, write_robot

_HAND_FILE = "hand.yaml"
_ROBOT_FILE = "robot.yaml"


@dataclass(frozen=True, eq=False)
class DescribedHand:
    """A hand that was found, and the `hand.yaml` that describes it.

    Attributes:
        file: The `hand.yaml`.
        hand: The hand, loaded from it.
        clues: How each part was found, and how certain it is.
        notes: Assumptions and omissions, in sentences.
    """

    file: Path
    hand: Hand
    clues: tuple[Clue, ...]
    notes: Names


@dataclass(frozen=True, eq=False)
class InitResult:
    """What `init_hands` found and wrote.

    Attributes:
        name: Name of the hand or of the robot.
        file: The `hand.yaml`, or the `robot.yaml` of two hands: what `load_hand` or `load_robot`
            takes.
        hands: The hand, or the left and the right one.
        converted: The URDF that was written in place of an MJCF file; None if there was none.
    """

    name: str
    file: Path
    hands: tuple[DescribedHand, ...]
    converted: Path | None

    @property
    def is_robot(self) -> bool:
        """Whether two hands were found."""
        return len(self.hands) > 1


def init_hands(
    robot: Path | str,
    *,
    out: Path | str | None = None,
    root: str | None = None,
    base: str | None = None,
    side: Side | None = None,
    thumb: str | None = None,
    kind: FingerKind | None = None,
    speed: float | None = None,
    name: str | None = None,
    overwrite: bool = False,
) -> InitResult:
    """Find a hand, or both hands of a robot, and write their descriptions.

    Palm, fingers, thumb, fingertips, side and a rest posture are found from the kinematics. Check
    the result by `check_hand` or `check_robot`. `handmap hands init` does the same.

    Args:
        robot: URDF or MJCF file of a hand or of a robot, `package://PACKAGE/path`, or
            `robot_descriptions:MODULE`. An MJCF file is converted: a URDF and its meshes are
            written beside the description.
        out: The `hand.yaml` to write, in the current folder if omitted. Two hands are written to
            `left.yaml` and `right.yaml` in its folder, with a `robot.yaml` that names them.
        root: Link at which the hand begins, for one hand of a whole robot; the root if omitted.
        base: Fixed link of the arm; the joints between it and the hand then move the wrist. The
            wrist of one hand floats if it is omitted; for two hands it is the robot's root.
        side: Side of the hand; found if omitted.
        thumb: Name of a link or joint of the thumb; found if omitted.
        kind: What fingers with one joint each are: `fingers` are straight at zero, `jaws` are open
            at one end of their ranges; found if omitted.
        speed: Speed limit of all joints of the hand [rad/s or m/s], where those of the URDF are
            placeholders; that of the URDF if omitted.
        name: Name of the hand or robot; that of the URDF if omitted.
        overwrite: Whether files that exist are replaced.

    Returns:
        The hands, with the evidence for each part, and the files.

    Raises:
        HandError: If the file cannot be used, or has no hand.
        InvalidInputError: If a file exists or cannot be written, or `speed` is not positive.
        MissingExtraError: If `robot_descriptions` or a package of an extra is not installed.
        MissingPackageError: If another package is not installed.
    """
    chosen = Path(_HAND_FILE if out is None else out)
    # Two hands are not written to the file of the default.
    check_free(chosen, overwrite=overwrite or out is None)
    if speed is not None:
        expect(speed > 0.0, "speed", "a speed > 0", value=speed)
    with _named(Path(robot), chosen.parent):
        source = open_source(Path(robot), chosen.parent, overwrite=overwrite)
        found = detect_hands(
            source.urdf,
            root=root,
            base=base,
            side=side,
            thumb=thumb,
            kind=kind,
            name=name,
        )
        is_robot = len(found) > 1
        if is_robot:
            name = name or found[0].spec.name.removesuffix("_left")
            found = [_renamed(one, f"{name}_{one.spec.side}") for one in found]
            file = chosen.with_name(_ROBOT_FILE)
            files = [chosen.with_name(f"{one.spec.side}.yaml") for one in found]
        else:
            name = found[0].spec.name
            file = chosen
            files = [chosen]
        for one in {file, *files}:
            check_free(one, overwrite=overwrite)
        # Both are complete before one is written.
        complete = [_completed(one, source, speed) for one in found]
        for detection, each in zip(complete, files, strict=True):
            write_hand(detection, each)
        if is_robot:
            write_robot(name, file)
            load_robot(file)
    hands = tuple(
        DescribedHand(each, load_hand(each), detection.clues, detection.notes)
        for detection, each in zip(complete, files, strict=True)
    )
    # What lies beside the description is a file, and not that which was given.
    is_converted = source.reference == str(source.urdf) != str(robot)
    return InitResult(name, file, hands, source.urdf if is_converted else None)


@contextmanager
def _named(robot: Path, folder: Path) -> Iterator[None]:
    """Name the file that was given in an error of what was found in it.

    Args:
        robot: The file.
        folder: Where an MJCF file is converted to.
    """
    try:
        yield
    except HandError as error:
        if error.file in (None, folder / f"{robot.stem}.urdf"):
            error.file = robot
        raise


def _renamed(found: Detection, name: str) -> Detection:
    return found._replace(spec=replace(found.spec, name=name))


def _completed(found: Detection, source: RobotSource, speed: float | None) -> Detection:
    """Give a hand its speed limits, and what `described` adds."""
    if speed is not None:
        spec = replace(with_speed(found.spec, speed), speeds="given")
        found = found._replace(spec=spec)
    return described(found, source)
