"""Closed loops of MJCF as mimic rules: how well they fit, what bounds what leads, what is held."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from made_loops import FINGERS, four_bars, pushed_fingers, tendons, welded_jaws
from scipy.optimize import least_squares

from handmap_core.se3 import Array
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.init import DescribedHand, init_hands
from handmap_qp.hands.closed_loops import ClosedLoop, best_line
from handmap_qp.hands.mjcf import ConvertedMjcf
from handmap_qp.hands.urdf import joints_by_name, mimics_of, parse_urdf

pytestmark = pytest.mark.slow


def _described(folder: Path, text: str) -> DescribedHand:
    file = folder / "loops.xml"
    file.write_text(text, encoding="utf-8")
    (hand,) = init_hands(file, out=folder / "hand.yaml", overwrite=True).hands
    return hand


def _converted(folder: Path, text: str) -> ConvertedMjcf:
    file = folder / "loops.xml"
    file.write_text(text, encoding="utf-8")
    return ConvertedMjcf(file)


def _tips(hand: DescribedHand) -> dict[str, str]:
    points = hand.hand.spec.points
    return {
        point.finger or "": point.link
        for point in points
        if point.name.endswith("_tip")
    }


def _limits(converted: ConvertedMjcf, name: str) -> tuple[float, float]:
    joint = joints_by_name(parse_urdf(converted.text))[name]
    limit = joint.find("limit")
    assert limit is not None
    return float(limit.get("lower", "nan")), float(limit.get("upper", "nan"))


def _closed(
    model: mujoco.MjModel, at: dict[str, float]
) -> tuple[dict[str, float], float]:
    """Close all loops within the limits, some joints held, by a solver that is none of ours.

    Returns:
        Positions of all joints, and the largest residual that is left [m or rad].
    """
    data = mujoco.MjData(model)
    names = [model.joint(i).name for i in range(model.njnt)]
    free = [i for i, name in enumerate(names) if name not in at]
    fixed = [i for i, name in enumerate(names) if name in at]
    equality = int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)

    def residual(q: Array) -> Array:
        data.qpos[free] = q
        data.qpos[fixed] = [at[names[i]] for i in fixed]
        mujoco.mj_forward(model, data)
        return data.efc_pos[data.efc_type == equality] * 1e2

    low, high = model.jnt_range[free].T
    start = np.clip(np.zeros(len(free)), low + 1e-9, high - 1e-9)
    found = least_squares(residual, start, bounds=(low, high), xtol=1e-12, ftol=1e-12)
    positions = dict(zip([names[i] for i in free], found.x.tolist(), strict=True)) | at
    return positions, float(np.abs(found.fun).max()) / 1e2


def _said_errors(notes: tuple[str, ...]) -> dict[str, float]:
    """Return the errors that a note says [rad], by follower."""
    found = re.findall(r"(\w+) follows \w+ within ([\d.e-]+) deg", " ".join(notes))
    return {name: np.radians(float(degrees)) for name, degrees in found}


def test_a_bar_to_the_last_phalanx_couples_it(tmp_path: Path) -> None:
    hand = _described(tmp_path, four_bars())
    assert {*hand.hand.joint_names} == {f"{finger}_proximal" for finger in FINGERS}
    assert {*_tips(hand).values()} == {f"{finger}_distal" for finger in FINGERS}
    assert any("index_bar: a bar that closes a loop" in note for note in hand.notes)


def test_the_fit_is_as_good_as_is_said(tmp_path: Path) -> None:
    """MuJoCo's constraints, closed by another solver, are off the lines by what the note says."""
    converted = _converted(tmp_path, four_bars())
    said = _said_errors(converted.notes)
    rules = mimics_of(parse_urdf(converted.text))
    low, high = _limits(converted, "index_proximal")
    worst = dict.fromkeys(("index_distal", "index_bar"), 0.0)
    for position in np.linspace(low, high, 9):
        at = {f"{finger}_proximal": float(position) for finger in FINGERS}
        posture, gap = _closed(converted.model, at)
        assert gap < 1e-5
        for name in worst:
            rule = rules[name]
            assert rule.joint == "index_proximal"
            off = posture[name] - rule.multiplier * position - rule.offset
            worst[name] = max(worst[name], abs(off))
    for name, error in worst.items():
        # Two digits are said.
        assert 0.8 * said[name] < error < 1.06 * said[name]


@pytest.mark.parametrize("high", [1.5, 0.5])
def test_a_leader_goes_as_far_as_its_loop_closes(tmp_path: Path, high: float) -> None:
    """The bars of the second hand stop it earlier."""
    converted = _converted(tmp_path, four_bars(high=high))
    low, end = _limits(converted, "index_proximal")
    assert low == 0.0
    assert 0.3 < end < 1.0
    # A loop that opens is nearly singular just before: that step is left out.
    step = 0.01 if high < 1.0 else 1.2 / 40
    for position, closes in ((end - 0.01, True), (end + step, False)):
        at = {f"{finger}_proximal": position for finger in FINGERS}
        posture, gap = _closed(converted.model, at)
        assert (gap < 1e-5) == closes
        if closes:
            assert posture["index_bar"] < high + 1e-3
    assert any("index_proximal [0, " in note for note in converted.notes)


def test_shorter_limits_of_bars_leave_a_shorter_range(tmp_path: Path) -> None:
    ends = [
        _limits(_converted(tmp_path, four_bars(high=high)), "index_proximal")[1]
        for high in (0.3, 0.5, 0.7)
    ]
    assert ends[0] < ends[1] < ends[2]


def test_cranks_and_rods_are_no_fingers(tmp_path: Path) -> None:
    """Two motors push each finger; its own joints lead, because a rule has one leader only."""
    hand = _described(tmp_path, pushed_fingers())
    leaders = {
        f"{finger}_{part}" for finger in FINGERS for part in ("spread", "proximal")
    }
    assert {*hand.hand.joint_names} == leaders
    assert {*_tips(hand).values()} == {f"{finger}_distal" for finger in FINGERS}
    (note,) = (note for note in hand.notes if "no line describes" in note)
    _, _, motors = note.partition("motors turn ")
    for finger in FINGERS:
        for number in (0, 1):
            assert f"{finger}_crank{number}" in motors
            assert f"{finger}_crank{number}" in hand.hand.spec.locked
    assert _said_errors(hand.notes)["index_distal"] < np.radians(10.0)


def test_halves_that_a_weld_joins_are_one_finger(tmp_path: Path) -> None:
    hand = _described(tmp_path, welded_jaws())
    assert hand.hand.joint_names == ("left_driver",)
    assert len(_tips(hand)) == 2
    sides = {link.partition("_")[0] for link in _tips(hand).values()}
    assert sides == {"left", "right"}


def test_limits_of_a_follower_bound_its_leader(tmp_path: Path) -> None:
    """Distal joints turn twice as far, to 1.6 rad: proximal ones stop at 0.8."""
    hand = _described(tmp_path, tendons(factor=2.0))
    np.testing.assert_allclose(hand.hand.upper_limits, 0.8, atol=1e-3)
    np.testing.assert_allclose(hand.hand.lower_limits, 0.0, atol=1e-9)


def test_a_follower_whose_limits_contradict_is_held(tmp_path: Path) -> None:
    """It would have to turn backwards, which its limits forbid: the leader keeps its range."""
    hand = _described(tmp_path, tendons(0.0, factor=-1.0))
    for finger in FINGERS:
        assert hand.hand.spec.locked[f"{finger}_distal"] == 0.0
        assert any(f"{finger}_distal is held at 0: -1 *" in note for note in hand.notes)
    np.testing.assert_allclose(hand.hand.upper_limits, 1.2, atol=1e-9)


def test_an_offset_beyond_the_limits_holds_at_the_nearer_one(tmp_path: Path) -> None:
    hand = _described(tmp_path, tendons(offset=-2.0))
    assert hand.hand.spec.locked["index_distal"] == pytest.approx(-0.3)


def test_a_follower_that_stops_early_leaves_its_leader_its_range(
    tmp_path: Path,
) -> None:
    """Distal joints turn four times as far, to 1.6 rad, where proximal ones are at 0.4 of 1.2.

    MuJoCo moves the proximal joints of this file on. Distal joints are exact at both ends, and off
    by what the note says where they would stop.
    """
    text = tendons(factor=4.0)
    hand = _described(tmp_path, text).hand
    np.testing.assert_allclose(hand.upper_limits, 1.2, atol=1e-9)
    posture = hand.all_joints(hand.upper_limits)
    ends = dict(zip(hand.all_joint_names, posture, strict=True))
    stop = 0.4
    knee = dict(
        zip(hand.all_joint_names, hand.all_joints(np.full(3, stop)), strict=True)
    )
    reached = _pulled(mujoco.MjModel.from_xml_string(text))
    notes = " ".join(_converted(tmp_path, text).notes)
    for finger in FINGERS:
        assert ends[f"{finger}_distal"] == pytest.approx(1.6)
        assert reached[f"{finger}_proximal"] > 0.9 * 1.2
        assert reached[f"{finger}_distal"] > 1.6
        said = re.search(rf"{finger}_distal stops .*? within ([\d.]+) deg", notes)
        assert said
        error = np.degrees(1.6 - knee[f"{finger}_distal"])
        assert error == pytest.approx(float(said[1]), rel=0.05)


def _pulled(model: mujoco.MjModel, rotor: float = 0.0) -> dict[str, float]:
    """Return where all joints come to rest with all motors at the end of their joints' ranges.

    Args:
        model: The model, which is changed.
        rotor: Inertia of the rotors [kg m^2].
    """
    data = mujoco.MjData(model)
    model.dof_armature[:] = rotor
    mujoco.mj_setConst(model, data)
    model.opt.gravity[:] = 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.dof_damping[:] = 20.0 * model.dof_M0
    data.ctrl[:] = model.jnt_range[model.actuator_trnid[:, 0], 1]
    mujoco.mj_step(model, data, nstep=3000)
    names = [model.joint(i).name for i in range(model.njnt)]
    return dict(zip(names, data.qpos.tolist(), strict=True))


def test_a_stiff_bar_stops_what_leads(tmp_path: Path) -> None:
    """Limits of a bar leave a third of the range: no body can move on."""
    text = four_bars(high=0.5)
    _, end = _limits(_converted(tmp_path, text), "index_proximal")
    assert end < 0.5 * 1.2
    reached = _pulled(mujoco.MjModel.from_xml_string(text), rotor=1e-3)
    assert reached["index_proximal"] == pytest.approx(end, abs=0.15)


def test_a_rough_rule_of_a_bar_makes_no_finger() -> None:
    """A bar beside a finger, which the same joint drives, ends on it in the middle of its range.

    Its rule is a line for a curve, so that it comes off elsewhere.
    """
    box = '<visual><origin xyz="0 0 {0}"/><geometry><box size=".01 .01 {1}"/></geometry></visual>'
    limit = '<limit lower="0" upper="1.4" effort="1" velocity="3"/>'
    parts = ""
    for finger, x in (("one", 0.03), ("two", -0.03)):
        sign = -1 if x > 0.0 else 1
        for name, parent, place, length, rule in (
            ("first", "palm", f"{x} 0 0", 0.05, ""),
            ("second", f"{finger}_first", "0 0 .05", 0.04, 0.4),
            ("bar", "palm", f"{0.7 * x} 0 0", 0.055, 0.3),
        ):
            mimic = (
                f'<mimic joint="{finger}_first" multiplier="{rule}"/>' if rule else ""
            )
            parts += (
                f'<link name="{finger}_{name}">{box.format(length / 2, length)}</link>'
                f'<joint name="{finger}_{name}" type="revolute"><parent link="{parent}"/>'
                f'<child link="{finger}_{name}"/><origin xyz="{place}"/>'
                f'<axis xyz="0 {sign} 0"/>{limit}{mimic}</joint>'
            )
    text = f'<robot name="bars"><link name="palm"/>{parts}</robot>'
    found = detect(Path("bars.urdf"), text)
    tips = {point.link for point in found.spec.points if point.name.endswith("_tip")}
    assert tips == {"one_second", "two_second"}


def _circle(q: Array) -> tuple[Array, Array]:
    """Return the residual of two joints on a unit circle, with its derivatives."""
    return np.array([q @ q - 1.0]), 2.0 * q[None]


def test_a_loop_is_closed_all_along() -> None:
    limits = np.array([[-2.0, -0.5], [2.0, 2.0]])
    loop = ClosedLoop(_circle, np.array([0.1, 0.9]), limits)
    assert loop.is_closed
    assert loop.freedom == 1
    assert loop.leaders([0, 1]) == [0]
    postures = loop.postures([0], limits[:, :1])
    np.testing.assert_allclose((postures**2).sum(axis=1), 1.0, atol=1e-9)
    # It ends near to where the circle does, and keeps to one half of it.
    assert 0.9 < postures[:, 0].max() <= 1.0
    assert (postures[:, 1] > 0.0).all()


def test_limits_of_the_others_end_a_way() -> None:
    limits = np.array([[-2.0, 0.8], [2.0, 2.0]])
    loop = ClosedLoop(_circle, np.array([0.0, 1.0]), limits)
    postures = loop.postures([0], limits[:, :1])
    assert postures[:, 0].max() == pytest.approx(0.6, abs=1e-3)
    free = loop.postures([0], limits[:, :1], is_bounded=False)
    assert free[:, 0].max() > 0.9


def test_an_open_loop_is_no_loop() -> None:
    limits = np.array([[-2.0, -2.0], [2.0, 2.0]])

    def never(q: Array) -> tuple[Array, Array]:
        return np.array([q @ q + 1.0]), 2.0 * q[None]

    assert not ClosedLoop(never, np.array([0.1, 0.9]), limits).is_closed


def test_a_line_is_recovered_from_the_leader_that_it_follows() -> None:
    random = np.random.default_rng(0)
    leading = random.normal(size=(30, 3))
    line = best_line(leading, -0.7 * leading[:, 1] + 0.2)
    assert line.leader == 1
    assert line[1:3] == pytest.approx((-0.7, 0.2), abs=1e-12)
    assert line.error < 1e-12
