"""Experts: policies that move the Adroit hand, whose commanded posture is the human hand.

Weights of `hand_dapg` as plain arrays lie in a folder: HANDMAP_OPERATORS, else
`../shared/operators` beside the checkout. A policy takes the scene's observation `o`:

    x = (o - in_shift) / (in_scale + 1e-8)
    x = tanh(weight_i x + bias_i) for all layers but the last, which has no tanh
    action = clip(out_scale x + out_shift, -1, 1), a share of each actuator's range about its middle

Unfiltered, the policy commands at 100 Hz what no person could. A low pass of first order and a
delay bring it nearer to one. Both act on the whole action, arm and fingers alike.
"""

import math
import os
from collections import deque
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

import handmap_qp
from handmap_qp.errors import InvalidInputError, expect
from handmap_qp.human import Recording
from handmap_qp.se3 import Array
from .adroit import actuated_joints, scene_file
from .operator import HumanHand, Joints
from .task import Scene

FOLDER = "HANDMAP_OPERATORS"
"""Variable of the environment that names the folder of the weights."""
_TIME_STEP = 0.01  # s
_CUTOFF = 5.0  # Hz
_DELAY = 0.15  # s
_POSTURES = 12
_SAMPLES = 33  # of each posture's way to the next, 0.33 s


class Style(NamedTuple):
    """How an expert's commands are changed.

    Attributes:
        cutoff: Cut-off frequency of the low pass [Hz]; infinite for none.
        delay: Delay [s].
    """

    cutoff: float = math.inf
    delay: float = 0.0


STYLES = {
    "expert": Style(),
    "expert-5hz": Style(_CUTOFF),
    "expert-5hz-150ms": Style(_CUTOFF, _DELAY),
}
"""Experts by name."""
SOUND = ("expert", "expert-5hz")
"""Experts that succeed unmapped. The delayed one does not: its policy expects no delay."""


def weights_folder() -> Path:
    """Return the folder of the weights, which may not exist."""
    beside = Path(handmap_qp.__file__).parents[2] / "shared" / "operators"
    return Path(os.environ.get(FOLDER) or beside)


class Policy:
    """A policy from a file of weights.

    Raises:
        InvalidInputError: If the file does not exist, or an array is missing.
    """

    def __init__(self, file: Path) -> None:
        if not file.is_file():
            advice = f"set {FOLDER} to the folder of the operators' weights"
            raise InvalidInputError(
                f"there is no file {file}", argument="operators", advice=advice
            )
        with np.load(file) as archive:
            arrays = {name: archive[name].astype(float) for name in archive.files}
        try:
            self._in_shift = arrays["in_shift"]
            self._in_scale = arrays["in_scale"]
            self._out_shift = arrays["out_shift"]
            self._out_scale = arrays["out_scale"]
            count = sum(name.startswith("weight_") for name in arrays)
            self._layers = [
                (arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(count)
            ]
        except KeyError as error:
            raise InvalidInputError(
                f"{file} has no array {error}", argument="operators"
            ) from error

    def act(self, observation: Array) -> Array:
        """Return the action for an observation, each number from -1 to 1."""
        x = (observation - self._in_shift) / (self._in_scale + 1e-8)
        for weight, bias in self._layers[:-1]:
            x = np.tanh(weight @ x + bias)
        weight, bias = self._layers[-1]
        x = weight @ x + bias
        return np.clip(self._out_scale * x + self._out_shift, -1.0, 1.0)


class Filter:
    """A delay, then a low pass of first order; both begin at the first value."""

    def __init__(self, style: Style) -> None:
        self._lag = round(style.delay / _TIME_STEP)
        is_filtered = math.isfinite(style.cutoff)
        decay = math.exp(-2.0 * math.pi * style.cutoff * _TIME_STEP)
        self._gain = 1.0 - decay if is_filtered else 1.0
        self.reset()

    def reset(self) -> None:
        """Forget all values."""
        self._waiting: deque[Array] = deque(maxlen=self._lag + 1)
        self._state: Array | None = None

    def __call__(self, value: Array) -> Array:
        """Return the filtered value, one time step after the value before."""
        self._waiting.append(value)
        delayed = self._waiting[0]
        if self._state is None:
            self._state = delayed
        else:
            self._state = self._state + self._gain * (delayed - self._state)
        return self._state


class AdroitKinematics:
    """The Adroit hand's landmarks at a posture.

    Landmarks are the hand's own: the palm's origin, the origins of the last three links of each
    finger, and the ends of their capsules.

    Args:
        kind: The task whose arm carries the hand.
    """

    def __init__(self, kind: str) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(scene_file(kind)))
        self._data = mujoco.MjData(self.model)
        bodies, offsets = ["palm"], [(0.0, 0.0, 0.0)]
        for finger, length in _TIPS.items():
            first = "base" if finger == "th" else "proximal"
            bodies += [f"{finger}{link}" for link in (first, "middle", "distal")]
            bodies.append(f"{finger}distal")
            offsets += [(0.0, 0.0, 0.0)] * 3 + [length]
        self._bodies = [self.model.body(name).id for name in bodies]
        self._offsets = np.array(offsets)
        joints = [self.model.joint(i) for i in range(self.model.njnt)]
        self.joint_names = [joint.name for joint in joints]
        self._address = {joint.name: int(joint.qposadr[0]) for joint in joints}
        self.ranges = {joint.name: joint.range.copy() for joint in joints}

    def landmarks(self, joints: Joints) -> tuple[Array, Array]:
        """Return the landmarks, shape (21, 3), and the palm's pose, (4, 4), in the world.

        Joints beyond their range are at the end of it; joints that are missing are at 0.
        """
        data = self._data
        data.qpos[:] = 0.0
        for name, value in joints.items():
            data.qpos[self._address[name]] = np.clip(value, *self.ranges[name])
        mujoco.mj_kinematics(self.model, data)
        rotations = data.xmat[self._bodies].reshape(-1, 3, 3)
        turned = np.einsum("bij,bj->bi", rotations, self._offsets)
        palm = np.eye(4)
        palm[:3, :3] = rotations[0]
        palm[:3, 3] = data.xpos[self._bodies[0]]
        return data.xpos[self._bodies] + turned, palm


_TIPS = {
    "th": (0.0003, 0.0, 0.0349),
    "ff": (0.0, 0.0, 0.0305),
    "mf": (0.0, 0.0, 0.0295),
    "rf": (0.0, 0.0, 0.0305),
    "lf": (0.0, 0.0, 0.0305),
}
"""Ends of the fingers in their last links [m], thumb first."""
_FINGER_JOINTS = ("TH", "FF", "MF", "RF", "LF")


class Expert:
    """A policy on its own hand.

    Args:
        kind: The task, `door` or `relocate`.
        name: A name in `STYLES`.

    Raises:
        InvalidInputError: If the weights are missing or of another task.
    """

    def __init__(self, kind: str, name: str) -> None:
        self.name = name
        self._policy = Policy(weights_folder() / f"{kind}.npz")
        self._filter = Filter(STYLES[name])
        self._hand = AdroitKinematics(kind)
        model = self._hand.model
        low, high = model.actuator_ctrlrange.T
        self._middle = 0.5 * (low + high)
        self._half = 0.5 * (high - low)
        self._joints = actuated_joints(model)

    @property
    def has_finished(self) -> bool:
        """Whether it will do nothing more: a policy always goes on."""
        return False

    def calibrate(self, seed: int) -> Recording:
        """Return a recording of random postures of the hand, of 4 s at 100 Hz."""
        return calibration_recording(self._hand, seed)

    def reset(self, seed: int) -> None:
        """Forget delayed and filtered commands; nothing in an expert is random."""
        self._filter.reset()

    def see(self, scene: Scene) -> HumanHand:
        """Return the hand at the posture that the policy commands."""
        action = self._filter(self._policy.act(scene.observation))
        control = self._middle + self._half * action
        joints = dict(zip(self._joints, control.tolist(), strict=True))
        landmarks, palm = self._hand.landmarks(joints)
        return HumanHand(landmarks, palm, joints)


def calibration_recording(hand: AdroitKinematics, seed: int) -> Recording:
    """Return a recording in which a hand moves from one random posture to the next.

    Each finger closes by a random share, with 0.15 rad of difference between its joints and 0.12
    rad of abduction; the thumb is anywhere in its range.
    """
    random = np.random.default_rng(seed)
    joints = [name for name in hand.joint_names if name[:2] in _FINGER_JOINTS]
    start = {name: 0.1 * float(hand.ranges[name][1]) for name in joints}
    postures = [start]
    postures += [_random_posture(hand, random) for _ in range(_POSTURES - 1)]
    samples = []
    for before, after in zip([start, *postures], postures, strict=False):
        for share in np.linspace(0.0, 1.0, _SAMPLES, endpoint=False):
            smooth = share * share * (3.0 - 2.0 * share)
            posture = {
                name: (1.0 - smooth) * before[name] + smooth * after[name]
                for name in joints
            }
            samples.append(hand.landmarks(posture)[0])
    expect(len(samples) == _POSTURES * _SAMPLES, "samples", "all", value=len(samples))
    time = _TIME_STEP * np.arange(len(samples))
    valid = np.ones(len(samples), dtype=bool)
    return Recording(f"calibration_{seed}", time, np.array(samples), valid, "right")


def _random_posture(
    hand: AdroitKinematics, random: np.random.Generator
) -> dict[str, float]:
    """Return joints of a hand that closes by a random share."""
    joints: dict[str, float] = {}
    for finger in _FINGER_JOINTS[1:]:
        closing = random.uniform()
        for link, share in (("J2", 1.0), ("J1", 1.0), ("J0", 0.7)):
            bend = 1.5 * closing * share + 0.15 * random.normal()
            joints[finger + link] = bend
        joints[finger + "J3"] = 0.12 * random.normal()
    joints["LFJ4"] = 0.5 * random.uniform()
    for name in hand.joint_names:
        if name.startswith("TH"):
            joints[name] = random.uniform(*hand.ranges[name])
    return {
        name: float(np.clip(value, *hand.ranges[name]))
        for name, value in joints.items()
    }
