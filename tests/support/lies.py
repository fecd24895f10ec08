"""Mistakes that users make with recordings, put into samples on purpose, and motions to try."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from handmap_core.human.sample import human_name
from handmap_core.trackers.wrist_axes import CONVENTIONS, palm_axes
from handmap_qp import load_hand
from handmap_qp.hands import OTHER_SIDE, Side
from handmap_qp.hands.human import HumanLengths
from handmap_qp.se3 import affine
from handmap_qp.trackers.layouts.angles import AngleLayout
from handmap_qp.trackers.layouts.tables import load_layout
from handmap_qp.trackers.plausibility import known_orders

_RATE = 60.0
_HANDS: tuple[tuple[Side, float | None], ...] = (
    ("right", None),
    ("left", None),
    ("right", 0.17),
    ("left", 0.21),
)


class Take(NamedTuple):
    """Samples of one hand, all of them seen, as a user says that they are.

    Attributes:
        name: Name of the recording or motion.
        time: Instants [s], shape (T,).
        landmarks: Landmarks [m], shape (T, 21, 3).
        wrist: Wrist poses, shape (T, 4, 4).
        side: Which hand.
    """

    name: str
    time: np.ndarray
    landmarks: np.ndarray
    wrist: np.ndarray
    side: Side

    def part(self, start: float, duration: float) -> Take:
        """Return the samples of some time [s]."""
        inside = (self.time >= start) & (self.time < start + duration)
        return self._replace(
            time=self.time[inside],
            landmarks=self.landmarks[inside],
            wrist=self.wrist[inside],
        )


class Lie(NamedTuple):
    """A mistake.

    Attributes:
        name: What it is, in words.
        kind: What `Finding.kind` has to say.
        tell: Puts it into a take.
    """

    name: str
    kind: str
    tell: Callable[[Take], Take]


def all_lies() -> list[Lie]:
    """Return every mistake of the table."""
    rotate = _with_quaternions
    return [
        Lie("the other hand", "side", _other_side),
        Lie("mirrored world", "side", _mirrored),
        Lie("millimetres", "unit", lambda take: _scaled(take, 1e3)),
        Lie("centimetres", "unit", lambda take: _scaled(take, 1e2)),
        Lie("pixels", "unit", _pixels),
        Lie("image coordinates", "unit", _normalised),
        Lie("time in ms", "time", lambda take: take._replace(time=take.time * 1e3)),
        Lie("time in us", "time", lambda take: take._replace(time=take.time * 1e6)),
        Lie("time in ns", "time", lambda take: take._replace(time=take.time * 1e9)),
        Lie(
            "frame numbers",
            "time",
            lambda take: take._replace(time=np.arange(len(take.time)) * 1.0),
        ),
        Lie("fingers backwards", "flexion", _bent_back),
        Lie("xyzw read as wxyz", "wrist", lambda take: rotate(take, -1)),
        Lie("wxyz read as xyzw", "wrist", lambda take: rotate(take, 1)),
        Lie("inverse wrist pose", "wrist", _inverse),
        *(
            Lie(f"order of {name.split()[-1]}", "order", _ordered(order))
            for name, order in zip(
                known_orders().names, known_orders().indices, strict=True
            )
            if name.startswith("that of the layout ")
        ),
        Lie("thumb last", "order", _ordered(_finger_order(1, 2, 3, 4, 0))),
        Lie("little finger first", "order", _ordered(_finger_order(4, 3, 2, 1, 0))),
        Lie("fingers reversed", "order", _ordered(_finger_order(0, 4, 3, 2, 1))),
        Lie("index and middle", "order", _ordered(_finger_order(0, 2, 1, 3, 4))),
        Lie("ring and little", "order", _ordered(_finger_order(0, 1, 2, 4, 3))),
        Lie(
            "random order", "order", _ordered(np.random.default_rng(3).permutation(21))
        ),
    ]


def live_lies() -> list[Lie]:
    """Return mistakes that show only in the course of a live stream."""
    return [
        Lie("inverse wrist", "wrist", _inverse),
        Lie("identity wrist", "wrist", _identity),
        *(
            Lie(f"rotated world {k}", "wrist", partial(_rotated_world, seed=k))
            for k in range(4)
        ),
        Lie("size x 0.5", "unit", lambda take: _scaled(take, 0.5)),
        Lie("size to x 1.5", "size", _growing),
        *(
            Lie(f"time x {rate:g}", "time", partial(_at_rate, rate=rate))
            for rate in (10.0, 2.0, 0.5)
        ),
        Lie("frozen index", "frozen", partial(_frozen, base=5)),
        Lie("frozen little finger", "frozen", partial(_frozen, base=17)),
    ]


def file_lies() -> list[Lie]:
    """Return mistakes that show, if at all, only in a whole file, which has no time of arrival."""
    return [
        *(
            Lie(f"time x {rate:.2g}", "time", partial(_at_rate, rate=rate))
            for rate in (10.0, 5.0, 4.0, 3.0, 2.0, 1 / 2, 1 / 3, 1 / 4, 1 / 5, 1 / 10)
        ),
        Lie("identity wrist", "wrist", _identity),
        Lie("wrist that stays", "wrist", _staying),
        *(
            Lie(f"size to x {end:g}", "size", partial(_creeping, end=end))
            for end in (1.5, 1.3, 1.2, 1.1, 0.67)
        ),
    ]


def _staying(take: Take) -> Take:
    """Let the wrist's pose stay where it is at first."""
    return take._replace(wrist=np.tile(take.wrist[0], (len(take.time), 1, 1)))


def _creeping(take: Take, end: float) -> Take:
    """Let the hand grow steadily over the whole take, to `end` times its size."""
    sizes = np.linspace(1.0, end, len(take.time))[:, None, None]
    wrist = take.landmarks[:, :1]
    return take._replace(landmarks=wrist + (take.landmarks - wrist) * sizes)


def _identity(take: Take) -> Take:
    wrist = take.wrist.copy()
    wrist[:, :3, :3] = np.eye(3)
    return take._replace(wrist=wrist)


def _rotated_world(take: Take, seed: int) -> Take:
    """Rotate the wrist's world about the wrist, at random."""
    wrist = take.wrist.copy()
    wrist[:, :3, :3] = Rotation.random(random_state=seed).as_matrix() @ wrist[:, :3, :3]
    return take._replace(wrist=wrist)


def _growing(take: Take) -> Take:
    """Let the hand grow to 1.5 times its size, from 2 s to 8 s after the start."""
    sizes = np.interp(take.time - take.time[0], [2.0, 8.0], [1.0, 1.5])[:, None, None]
    wrist = take.landmarks[:, :1]
    return take._replace(landmarks=wrist + (take.landmarks - wrist) * sizes)


def _at_rate(take: Take, rate: float) -> Take:
    return take._replace(time=take.time[0] + rate * (take.time - take.time[0]))


def _frozen(take: Take, base: int) -> Take:
    """Let the palm carry a finger as it is after 1 s."""
    landmarks = take.landmarks.copy()
    palms = palm_axes(landmarks, 1.0 if take.side == "right" else -1.0)
    first = int(np.searchsorted(take.time, take.time[0] + 1.0))
    finger = (landmarks[first, base + 1 : base + 4] - landmarks[first, base]) @ palms[
        first
    ]
    moved = finger @ palms[first:].transpose(0, 2, 1)
    landmarks[first:, base + 1 : base + 4] = landmarks[first:, base : base + 1] + moved
    return take._replace(landmarks=landmarks)


def with_our_axes(take: Take) -> Take:
    """Turn the wrist's axes of a known tracker to ours, as a live client has to."""
    palms = palm_axes(take.landmarks, 1.0 if take.side == "right" else -1.0)
    rotations = take.wrist[:, :3, :3]
    mean = np.einsum("tji,tjk->ik", palms, rotations)
    convention = CONVENTIONS[np.einsum("gik,ik->g", CONVENTIONS, mean).argmax()]
    wrist = take.wrist.copy()
    wrist[:, :3, :3] = rotations @ convention.T
    return take._replace(wrist=wrist)


def pose_take(file: Path, side: Side, names: Sequence[str] = ()) -> Take:
    """Move a hand from each pose of a file to the next in half a second, and hold it as long.

    Args:
        file: Poses, with arrays `landmarks` and `names`.
        side: Which hand.
        names: Beginnings of the names of the poses to take; all if omitted.
    """
    arrays = np.load(file)
    is_taken = [str(name).startswith(tuple(names) or "") for name in arrays["names"]]
    poses = arrays["landmarks"][is_taken].astype(float)
    time = np.arange(0.0, len(poses) - 1.0, 1.0 / _RATE)
    share = np.clip(2.0 * (time % 1.0) - 0.5, 0.0, 1.0)
    blend = (share**3 * (10.0 + share * (6.0 * share - 15.0)))[:, None, None]
    first = time.astype(int)
    landmarks = poses[first] + blend * (poses[first + 1] - poses[first])
    landmarks += np.random.default_rng(0).normal(0.0, 3e-4, landmarks.shape)
    wrist = np.tile(np.eye(4), (len(time), 1, 1))
    wrist[:, :3, :3] = palm_axes(landmarks, 1.0 if side == "right" else -1.0)
    wrist[:, :3, 3] = landmarks[:, 0]
    return Take(f"{file.stem} {side}", time, landmarks, wrist, side)


def angles_in_degrees() -> AngleLayout:
    """Return the layout of the human model's joints, in degrees."""
    layout = load_layout("angles20")
    assert isinstance(layout, AngleLayout)
    return msgspec.structs.replace(layout, name="own in degrees", unit="deg")


def is_visible(lie: Lie, take: Take) -> bool:
    """Tell whether a mistake changes these samples enough to mislead anyone.

    A wrist that is turned by half a turn is its own inverse, and straight fingers do not bend
    backwards: below 20 degrees, or 15 mm at the fingertips, such a mistake is not counted. Nor are
    fingers whose PIP joints bend by less than 15 degrees: people can bend them backwards so far.
    """
    told = lie.tell(take)
    if lie.kind == "wrist":
        turns = told.wrist[:, :3, :3] @ take.wrist[:, :3, :3].transpose(0, 2, 1)
        return bool(
            np.median(Rotation.from_matrix(turns).magnitude()) > np.radians(20.0)
        )
    if lie.kind == "flexion":
        moved = np.linalg.norm(told.landmarks - take.landmarks, axis=2)[:, 8::4].mean(
            axis=1
        )
        bones = np.diff(take.landmarks[:, 5:].reshape(-1, 4, 4, 3), axis=2)
        bones /= np.linalg.norm(bones, axis=3, keepdims=True)
        cosines = np.einsum("tfi,tfi->tf", bones[:, :, 0], bones[:, :, 1])
        bends = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).mean(axis=1)
        return bool(np.median(moved) > 0.015 and np.median(bends) > 15.0)
    return True


def synthetic_takes() -> list[Take]:
    """Return motions of the human model through gestures, of both hands and several sizes."""
    return [
        model_take(side, length, seed) for seed, (side, length) in enumerate(_HANDS)
    ]


def model_take(
    side: Side,
    hand_length: float | None,
    seed: int,
    *,
    duration: float = 20.0,
    noise: float = 5e-4,
    hyperextension: float = 0.0,
) -> Take:
    """Move the human model through random gestures, held and blended, while its wrist travels.

    Args:
        side: Which hand.
        hand_length: Proportions of Buchholz et al. for this length [m]; the model's own if None.
        seed: Seed of the gestures, the wrist and the noise.
        duration: Length of the motion [s].
        noise: Standard deviation of every coordinate [m].
        hyperextension: Bend of the MCP joints to the back, of fingers that are not bent [rad].
    """
    lengths = (
        None if hand_length is None else HumanLengths.from_hand_length(hand_length)
    )
    hand = load_hand(human_name(side), points="landmarks", lengths=lengths)
    rng = np.random.default_rng(seed)
    names = hand.joint_names
    keys = [
        _gesture(rng, hand.rest, names, hyperextension)
        for _ in range(int(duration) + 2)
    ]
    time = np.arange(int(duration * _RATE)) / _RATE
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.8, (int(duration) + 2, 3)))
    start = Rotation.from_quat(rng.normal(size=4))
    landmarks, wrists = [], []
    for t in time:
        k, share = int(t), t % 1.0
        blend = np.clip(2.0 * share - 0.5, 0.0, 1.0)  # half of the time at rest
        blend = blend**2 * (3.0 - 2.0 * blend)
        q = np.clip(
            (1.0 - blend) * keys[k] + blend * keys[k + 1],
            hand.lower_limits,
            hand.upper_limits,
        )
        turn = Rotation.from_rotvec(
            (1.0 - share) * turns[k].as_rotvec() + share * turns[k + 1].as_rotvec()
        )
        pose = affine(
            (turn * start).as_matrix(),
            np.array([0.2 * np.sin(t), 1.0 + 0.1 * np.cos(1.3 * t), -0.3]),
        )
        points = hand.points(q) @ pose[:3, :3].T + pose[:3, 3]
        landmarks.append(points + rng.normal(0.0, noise, points.shape))
        wrists.append(pose)
    name = f"model {side} " + (
        "own" if hand_length is None else f"{1e3 * hand_length:.0f} mm"
    )
    if hyperextension:
        name += f", MCPs {-np.degrees(hyperextension):.0f} deg"
    return Take(name, time, np.array(landmarks), np.array(wrists), side)


def _gesture(
    rng: np.random.Generator,
    rest: np.ndarray,
    names: tuple[str, ...],
    hyperextension: float,
) -> np.ndarray:
    """Return a posture: each finger straight, half bent or curled; the thumb near its rest."""
    q = rest.copy()
    bends = rng.choice([0.0, 0.15, 0.5, 1.0], size=4)
    if rng.random() < 0.4:
        bends[:] = bends[0]  # open hand, fist
    for i, name in enumerate(names):
        if name.startswith("thumb"):
            q[i] += rng.normal(0.0, 0.15)
        elif name.endswith("abduction"):
            q[i] = 0.5 * q[i]
        else:
            finger = ("index", "middle", "ring", "little").index(name.partition("_")[0])
            full = {"MCP": 1.4, "PIP": 1.6, "DIP": 1.0}[name.split("_")[1]]
            q[i] = full * bends[finger]
            if name.endswith("MCP_flexion") and bends[finger] < 0.3:
                q[i] -= hyperextension
    return q


def _other_side(take: Take) -> Take:
    return take._replace(side=OTHER_SIDE[take.side])


def _mirrored(take: Take) -> Take:
    return take._replace(landmarks=take.landmarks * (-1.0, 1.0, 1.0))


def _scaled(take: Take, factor: float) -> Take:
    wrist = take.wrist.copy()
    wrist[:, :3, 3] *= factor
    return take._replace(landmarks=take.landmarks * factor, wrist=wrist)


def _pixels(take: Take) -> Take:
    """Landmarks in an image of 1280 x 720 pixels, as of a camera 0.6 m in front of the hand."""
    landmarks = take.landmarks - take.landmarks[:, :1]
    depth = 0.6 + landmarks[..., 2:]
    image = 900.0 * landmarks[..., :2] / depth + (640.0, 360.0)
    image += 900.0 * (take.landmarks[:, :1, :2] - take.landmarks[0, 0, :2])
    z = 900.0 * landmarks[..., 2:] / 0.6
    return take._replace(landmarks=np.concatenate([image, z], axis=2))


def _normalised(take: Take) -> Take:
    """The same as shares of the image's width and height, as MediaPipe gives them."""
    pixels = _pixels(take)
    return take._replace(landmarks=pixels.landmarks / (1280.0, 720.0, 1280.0))


def _bent_back(take: Take) -> Take:
    """Mirror every finger at the palm's plane, so that it bends to the back of the hand."""
    landmarks = take.landmarks.copy()
    offsets = landmarks - landmarks[:, :1]
    normal = np.cross(offsets[:, 5], offsets[:, 17])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for base in (5, 9, 13, 17):
        bones = landmarks[:, base + 1 : base + 4] - landmarks[:, base : base + 1]
        heights = np.einsum("tki,ti->tk", bones, normal)
        landmarks[:, base + 1 : base + 4] -= 2.0 * heights[..., None] * normal[:, None]
    return take._replace(landmarks=landmarks)


def _with_quaternions(take: Take, roll: int) -> Take:
    xyzw = Rotation.from_matrix(take.wrist[:, :3, :3]).as_quat()
    wrist = take.wrist.copy()
    wrist[:, :3, :3] = Rotation.from_quat(np.roll(xyzw, roll, axis=1)).as_matrix()
    return take._replace(wrist=wrist)


def _inverse(take: Take) -> Take:
    wrist = take.wrist.copy()
    wrist[:, :3, :3] = wrist[:, :3, :3].transpose(0, 2, 1)
    return take._replace(wrist=wrist)


def _finger_order(*fingers: int) -> np.ndarray:
    """Return where our landmarks are found if fingers are stored in this order."""
    order = np.zeros(21, dtype=int)
    for place, finger in enumerate(fingers):
        order[1 + 4 * finger : 5 + 4 * finger] = np.arange(1 + 4 * place, 5 + 4 * place)
    return order


def _ordered(order: np.ndarray) -> Callable[[Take], Take]:
    """Store landmarks so that ours are found at the indices of `order`."""
    source = np.argsort(order)
    return lambda take: take._replace(landmarks=take.landmarks[:, source])
