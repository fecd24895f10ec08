"""The person who picks: sees late, moves as people do, learns, and decides by what is seen."""

from __future__ import annotations

import math

import numpy as np
import pytest
from handmap_score.tasks import person as model
from handmap_score.tasks.person import (
    Closing,
    Eyes,
    Look,
    Observer,
    PadModel,
    PadPlace,
    PalmMotion,
    Person,
    Phase,
    home,
    levelled,
    movement_time,
)
from handmap_score.tasks.task import Scene, Signals
from hypothesis import given
from hypothesis import strategies as st
from marks import full
from scipy.spatial.transform import Rotation

from handmap_qp.hands import Hand, load_hand
from handmap_qp.se3 import Array, affine, unit

DT = 1.0 / 60.0
NOTHING = Signals(
    is_reached=False, touching=frozenset(), is_gripped=False, force=0.0, moved=0.0
)


@pytest.fixture(scope="module")
def robot() -> Hand:
    """A robot hand whose wrist is not its palm."""
    return load_hand("allegro_right")


def seen(time: float, wrist: Array, pads: Array, faces: Array) -> Scene:
    """Return a scene with an object, its target 0.2 m beside, and the robot's pads."""
    middle = faces.mean(axis=0)
    return Scene(
        time=time,
        observation=np.zeros(0),
        poses={
            "object": affine(np.eye(3), middle),
            "wrist": wrist,
            "target": affine(np.eye(3), (0.2, 0.0, 0.0)),
        },
        points={
            "pads": pads,
            "faces": faces,
            "bottom": middle[None] - (0.0, 0.0, 0.05),
        },
        signals=NOTHING,
    )


class World:
    """A robot without physics: its pads follow the person's hand, the object is taken or not.

    Args:
        robot: The robot hand.
        shift: Where the robot's pads are beside the person's fingertips, in the palm's frame [m].
        is_sticky: Whether the object goes with the pads once they have closed around it.
    """

    def __init__(self, robot: Hand, shift: Array, *, is_sticky: bool) -> None:
        self._to_palm = robot.wrist_to_palm
        self._shift = shift
        self._is_sticky = is_sticky
        self._is_taken = False
        self.object = np.array([0.01, -0.02, 0.05])
        self.wrist = affine(home(), (0.03, -0.17, 0.35)) @ np.linalg.inv(self._to_palm)
        self.pads = np.zeros((2, 3))
        self.time = 0.0

    def scene(self) -> Scene:
        """Return what is now."""
        half = np.array([0.0, 0.015, 0.0])
        faces = np.array([self.object - half, self.object + half])
        return seen(self.time, self.wrist, self.pads, faces)

    def follow(self, landmarks: Array, wrist: Array) -> None:
        """Move the robot as the person does, with the object if it is held."""
        self.time += DT
        self.wrist = wrist
        palm = wrist @ self._to_palm
        thumb, finger = landmarks[[4, 8]] + palm[:3, :3] @ self._shift
        before = self.pads.mean(axis=0)
        inside = model._FINGERTIP * unit(finger - thumb)
        self.pads = np.array([thumb + inside, finger - inside])
        middle = self.pads.mean(axis=0)
        gap = float(np.linalg.norm(finger - thumb)) - 2.0 * model._FINGERTIP
        is_around = float(np.linalg.norm(middle - self.object)) < 0.015
        if self._is_taken and self._is_sticky and gap < 0.035:
            self.object = self.object + middle - before
        self._is_taken = gap < 0.03 and (self._is_taken or is_around)

    def play(self, person: Person, duration: float) -> list[Phase]:
        """Let a person act, and return the phases in order."""
        phases = []
        while self.time < duration:
            hand = person.see(self.scene())
            if not phases or phases[-1] is not person.phase:
                phases.append(person.phase)
            self.follow(hand.landmarks, hand.wrist)
        return phases


def test_sees_what_was(robot: Hand) -> None:
    """What is seen is `DELAY` old, never younger, and noisy by 2 mm an axis."""
    eyes = Eyes(robot.wrist_to_palm, np.random.default_rng(1))
    pads = np.array([[0.0, -0.02, 0.0], [0.0, 0.02, 0.0]])
    errors = []
    for i in range(600):
        now = i * DT
        faces = np.array([[now, -0.01, 0.0], [now, 0.01, 0.0]])
        eyes.remember(seen(now, np.eye(4), pads, faces), now - DT)
        look = eyes.look()
        assert look.time <= max(now - model.DELAY, 0.0) + 1e-9
        assert look.time > now - model.DELAY - DT - 1e-9
        assert look.followed == pytest.approx(look.time - DT)
        errors.append(look.middle - (look.time, 0.0, 0.0))
    spread = np.std(errors, axis=0)
    assert np.allclose(spread, model.VISUAL_NOISE, rtol=0.15)


def test_a_robot_one_sample_late_does_not_lower_the_aim(robot: Hand) -> None:
    """Where the hand closes, the palm is as high as the object asks for, on average."""
    heights = []
    for seed in range(16):
        world = World(robot, np.zeros(3), is_sticky=False)
        person = Person(robot)
        person.reset(seed)
        palm = world.wrist
        while person.phase is not Phase.CLOSE:
            hand = person.see(world.scene())
            world.follow(hand.landmarks, hand.wrist)
            palm = hand.wrist @ robot.wrist_to_palm
        assert person._model is not None
        aim = palm[:3, 3] + palm[:3, :3] @ person._model.entry(0.03)
        heights.append(aim[2] - world.object[2])
    assert abs(np.mean(heights)) < 1e-3


@given(st.floats(1e-3, 0.5), st.floats(0.0, 2.0))
def test_farther_takes_longer(distance: float, angle: float) -> None:
    """Time grows with displacement and turn, and never beats the refractory period."""
    time = movement_time(distance, angle)
    assert time >= model.REFRACTORY
    assert movement_time(2.0 * distance, angle) >= time
    assert movement_time(distance, 2.0 * angle) >= time


def test_fitts_law_is_that_of_the_experiment() -> None:
    """The constants are the line through the table of Fitts (1954), light stylus."""
    bits = [1, 2, 2, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 6, 6, 7]
    milliseconds = [180, 212, 203, 281, 260, 279, 392, 372, 357, 388, 484, 469, 481]
    milliseconds += [580, 595, 731]
    slope, intercept = np.polyfit(bits, np.array(milliseconds) / 1e3, 1)
    assert slope == pytest.approx(model.FITTS_SLOPE, abs=5e-4)
    assert intercept == pytest.approx(model.FITTS_INTERCEPT, abs=5e-4)


def test_submovements_are_smooth_and_add_up() -> None:
    """Two overlapping movements end at their sum; speed and acceleration begin and end at 0."""
    motion = PalmMotion(affine(home(), np.zeros(3)), np.random.default_rng(2))
    first, second = np.array([0.2, 0.0, 0.0]), np.array([0.0, 0.05, 0.0])
    turn = np.array([0.0, 0.0, 0.3])
    motion.begin(0.0, first, turn)
    motion.begin(0.25, second, -0.5 * turn)
    time = np.arange(-0.1, 2.0, 1e-3)
    places = np.array([motion.pose(each)[:3, 3] for each in time])
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / 1e-3
    assert np.allclose(motion.believed_end, first + second)
    assert np.linalg.norm(places[-1] - first - second) < 4.0 * model.MOTOR_NOISE * 0.25
    assert speed[:90].max() < 1e-9
    assert speed[-10:].max() < 1e-9
    assert np.abs(np.diff(speed)).max() < 0.02
    rotation = motion.pose(2.0)[:3, :3] @ home().T
    assert math.atan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(0.15)
    assert np.allclose(motion.turn_to(rotation @ home()), 0.0, atol=1e-12)


def test_motor_noise_grows_with_the_amplitude() -> None:
    """Where movements end spreads by a share of their length along each axis."""
    for distance in (0.05, 0.3):
        ends = []
        for seed in range(400):
            motion = PalmMotion(np.eye(4), np.random.default_rng(seed))
            motion.begin(0.0, np.array([distance, 0.0, 0.0]), np.zeros(3))
            ends.append(motion.pose(9.0)[:3, 3])
        spread = np.std(ends, axis=0)
        assert np.allclose(spread, model.MOTOR_NOISE * distance, rtol=0.15)


@given(st.floats(-math.pi, math.pi), st.floats(-1.2, 1.2), st.floats(-0.3, 0.3))
def test_levels_the_line_of_the_pads(turn: float, tilt: float, yaw: float) -> None:
    """The line of the pads comes to lie along the object's, unless that turns the wrist too far."""
    line = np.array(
        [
            math.cos(turn) * math.cos(tilt),
            math.sin(turn) * math.cos(tilt),
            math.sin(tilt),
        ]
    )
    wanted = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    rotation = levelled(line, wanted)
    left = math.acos(min(abs(float(rotation @ line @ wanted)), 1.0))
    before = math.acos(min(abs(float(home() @ line @ wanted)), 1.0))
    assert left == pytest.approx(max(before - model.LARGEST_TURN, 0.0), abs=1e-6)


def test_an_object_goes_in_clear_of_both_open_pads() -> None:
    """It goes where the pads will meet, but not nearer to an open pad than the clearance."""
    y = np.array([0.0, 1.0, 0.0])
    opened = PadPlace(np.array([0.0, 0.1, -0.08]), y, 0.09)
    met = PadPlace(np.array([0.0, 0.07, -0.09]), y, 0.02)
    pads = PadModel(opened, met)
    for width in (0.01, 0.03, 0.066, 0.085):
        entry = pads.entry(width)
        clear = 0.045 - width / 2.0 - abs(float(entry[1] - opened.middle[1]))
        room = max(0.045 - width / 2.0, 0.0)
        assert clear >= min(model.CLEARANCE, room) - 1e-12
        assert entry[2] == met.middle[2]
    nearer = PadModel(opened, met._replace(middle=np.array([0.0, 0.09, -0.09])))
    assert np.allclose(nearer.entry(0.02), nearer.met.middle)


def test_learns_a_fixed_share_of_an_error() -> None:
    """After n closings, `(1 - LEARNING)^n` of the error is left."""
    y = np.array([0.0, 1.0, 0.0])
    believed = PadPlace(np.zeros(3), y, 0.08)
    real = PadPlace(np.array([0.0, 0.04, -0.02]), unit(np.array([0.3, 1.0, 0.0])), 0.1)
    pads = PadModel(believed, believed)
    for count in range(1, 5):
        pads = pads.learned(real, real)
        left = np.linalg.norm(pads.met.middle - real.middle)
        share = (1.0 - model.LEARNING) ** count
        assert left == pytest.approx(share * np.linalg.norm(real.middle))
        assert np.linalg.norm(pads.met.line) == pytest.approx(1.0)


def test_closing_is_a_closing(robot: Hand) -> None:
    """The hand closes from wide open to a pinch, in the palm's frame, and joints fit landmarks."""
    closing = Person(robot).closing
    thumb, finger = np.moveaxis(closing.landmarks[:, [4, 8]], 1, 0)
    gaps = np.linalg.norm(finger - thumb, axis=1)
    assert gaps[0] == pytest.approx(closing.gap)
    assert gaps[0] > 0.08
    assert gaps[-1] < 0.022
    assert gaps[-1] == gaps.min()
    assert 0.2 < closing.duration < 1.0
    # Wrist at the origin, knuckles distal.
    assert np.abs(closing.landmarks[:, 0]).max() < 0.01
    assert (closing.landmarks[:, 9, 1] > 0.06).all()
    _check_joints(closing)


def _check_joints(closing: Closing) -> None:
    """Check that the own hand's fingertips are where the landmarks are, in the palm's frame."""
    hand = closing.hand
    to_palm = np.linalg.inv(hand.wrist_to_palm)
    for elapsed in (0.0, closing.duration):
        q = np.array([*closing.joints_at(elapsed).values()])
        points = hand.with_points("landmarks").points(q, to_palm)
        off = points - closing.landmarks_at(elapsed)
        assert np.linalg.norm(off, axis=1).max() < 0.012


def test_picks_what_the_pads_take(robot: Hand) -> None:
    """The phases follow each other, and the object ends at its target."""
    world = World(robot, np.zeros(3), is_sticky=True)
    person = Person(robot)
    person.reset(5)
    phases = world.play(person, 26.0)
    assert phases[:2] == [Phase.PRACTISE, Phase.APPROACH]
    assert phases[-6:] == [
        Phase.CLOSE,
        Phase.LIFT,
        Phase.CARRY,
        Phase.LOWER,
        Phase.RELEASE,
        Phase.DONE,
    ]
    assert np.linalg.norm(world.object - (0.2, 0.0, 0.05)) < 0.02
    assert person.tries >= 1


def test_finds_pads_that_are_elsewhere(robot: Hand) -> None:
    """Pads 40 mm beside the person's own are found by practice and failed tries."""
    world = World(robot, np.array([0.0, 0.04, 0.0]), is_sticky=True)
    person = Person(robot)
    person.reset(6)
    phases = world.play(person, 26.0)
    assert phases[-1] is Phase.DONE
    assert np.linalg.norm(world.object - (0.2, 0.0, 0.05)) < 0.02


def test_gives_up_what_never_comes(robot: Hand) -> None:
    """Without a grip the person lifts, sees it stay, tries again, and ends after 12 s of tries."""
    world = World(robot, np.zeros(3), is_sticky=False)
    person = Person(robot)
    person.reset(7)
    phases = world.play(person, 26.0)
    assert phases[-1] is Phase.DONE
    assert person.tries >= 2
    assert Phase.RELEASE not in phases
    assert person.drops == 0


def test_decides_no_more_often_than_people(robot: Hand) -> None:
    """Between the beginnings of sub-movements lies the refractory period."""
    world = World(robot, np.zeros(3), is_sticky=True)
    person = Person(robot)
    person.reset(8)
    world.play(person, 26.0)
    assert person._motion is not None
    starts = sorted({one.start for one in person._motion._submovements})
    assert len(starts) > 5
    assert np.diff(starts).min() >= model.REFRACTORY - DT


def test_two_people_of_one_seed_do_the_same(robot: Hand) -> None:
    """All that is random comes from the seed of `reset`."""
    hands = []
    for _ in range(2):
        world = World(robot, np.zeros(3), is_sticky=True)
        person = Person(robot)
        person.reset(9)
        shown = []
        while world.time < 8.0:
            hand = person.see(world.scene())
            shown.append(hand.landmarks)
            world.follow(hand.landmarks, hand.wrist)
        hands.append(np.array(shown))
    assert np.array_equal(hands[0], hands[1])


def test_noise_alone_moves_no_palm_that_is_right() -> None:
    """The dead zones are larger than what noise makes of the aim after some looks."""
    line = np.array([0.0, 1.0, 0.0])
    random = np.random.default_rng(11)
    moves = []
    for _ in range(300):
        observer = Observer()
        looks = [
            observer.update(noisy_look(random, line), np.zeros(3)) for _ in range(7)
        ]
        aimed, later = looks[2], looks[3:]
        for look in later:
            off = (look.middle - look.palm) - (aimed.middle - aimed.palm)
            turn = math.acos(min(float(look.line @ aimed.line), 1.0))
            is_off = float(np.linalg.norm(off)) > model.DEAD_ZONE
            moves.append(is_off or turn > model.TURN_DEAD_ZONE)
    assert np.mean(moves) < 0.05


def noisy_look(
    random: np.random.Generator,
    line: Array,
    middle: Array | None = None,
    palm: Array | None = None,
) -> Look:
    """Return a look with the noise of seeing, of an object and a palm at the origin by default."""
    noise = model.VISUAL_NOISE * random.normal(size=(2, 3))
    angle = model.ANGLE_NOISE * random.normal()
    turned = Rotation.from_rotvec([0.0, 0.0, angle]).apply(line)
    origin = np.zeros(3)
    return Look(
        time=0.0,
        followed=0.0,
        middle=noise[0] + (origin if middle is None else middle),
        line=turned,
        width=0.03,
        bottom=origin,
        target=origin,
        palm=noise[1] + (origin if palm is None else palm),
        rotation=np.eye(3),
        pads=PadPlace(origin, line, 0.08),
    )


def test_looks_at_a_still_object_add_up() -> None:
    """The mean of n looks is as good as statistics allow."""
    random = np.random.default_rng(12)
    line = np.array([1.0, 0.0, 0.0])
    ends = []
    for _ in range(200):
        observer = Observer()
        looks = [
            observer.update(noisy_look(random, line), np.zeros(3)) for _ in range(8)
        ]
        ends.append(looks[-1].middle)
    spread = np.std(ends, axis=0)
    assert np.allclose(spread, model.VISUAL_NOISE / math.sqrt(8.0), rtol=0.15)


def test_an_object_that_was_pushed_is_seen_where_it_is() -> None:
    """A jump of 30 mm is taken as it is seen, whatever was seen before."""
    random = np.random.default_rng(13)
    line = np.array([0.0, 1.0, 0.0])
    observer = Observer()
    for _ in range(10):
        observer.update(noisy_look(random, line), np.zeros(3))
    pushed = np.array([0.03, 0.0, 0.0])
    look = observer.update(noisy_look(random, line, pushed), np.zeros(3))
    assert np.linalg.norm(look.middle - pushed) < 4.0 * model.VISUAL_NOISE


def test_the_palms_error_grows_with_its_movements() -> None:
    """After a long movement the palm is taken as it is seen; without one, looks are averaged."""
    line = np.array([0.0, 1.0, 0.0])
    error = np.array([0.004, 0.0, 0.0])
    shares = []
    for distance in (0.0, 0.3):
        ends = []
        for seed in range(200):
            random = np.random.default_rng(seed)
            observer = Observer()
            for _ in range(8):
                observer.update(noisy_look(random, line), np.zeros(3))
            believed = np.array([distance, 0.0, 0.0])
            seen = noisy_look(random, line, palm=believed + error)
            ends.append(observer.update(seen, believed).palm - believed)
        shares.append(float(np.mean(ends, axis=0)[0] / error[0]))
    assert shares[0] < 0.3
    assert shares[1] > 0.9


@pytest.mark.parametrize("count", [6, full(12)])
def test_the_hand_closes_where_the_object_lies_between_the_pads(
    robot: Hand, count: int
) -> None:
    """When the hand closes, the palm is off its aim by less than the dead zone in most tries."""
    off = []
    person = Person(robot)
    for seed in range(20, 20 + count):
        world = World(robot, np.zeros(3), is_sticky=False)
        person.reset(seed)
        while person.phase is not Phase.CLOSE and world.time < 12.0:
            hand = person.see(world.scene())
            world.follow(hand.landmarks, hand.wrist)
        palm = world.wrist @ robot.wrist_to_palm
        assert person._model is not None
        lies = palm[:3, :3].T @ (world.object - palm[:3, 3])
        off.append(np.linalg.norm(lies - person._model.entry(0.03)))
    assert np.median(off) < model.DEAD_ZONE
    assert np.max(off) < 2.0 * model.DEAD_ZONE
