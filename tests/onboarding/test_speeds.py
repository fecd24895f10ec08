"""Speeds of joints that a file does not know: placeholders, estimates and assumptions."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from handmap_qp.apps.onboarding.check import check_speeds
from handmap_qp.apps.onboarding.findings import HandFinding
from handmap_qp.apps.onboarding.init import InitResult, init_hands
from handmap_qp.hands import FASTEST_SPEEDS, USUAL_SPEEDS, Hand, load_hand
from handmap_qp.hands.library import urdf_directory
from handmap_qp.hands.spec import HandSpec, LimitSpec

THREE_FINGER = urdf_directory() / "three_finger" / "hand.urdf"
CLAW = """<mujoco model="claw"><compiler angle="radian"/><worldbody><body name="palm">
<geom type="box" size=".03 .04 .01"/>{bodies}</body></worldbody>
<actuator>{actuators}</actuator></mujoco>"""
FINGER = """<body name="base_{0}" pos="{1} {2} 0" euler="0 0 {3}">
<joint name="flex_{0}" axis="-1 0 0" range="0 1.5" damping=".1"/>
<geom type="capsule" size=".008" fromto="0 0 0 0 .04 0"/>
<body name="end_{0}" pos="0 .04 0">
<joint name="curl_{0}" axis="-1 0 0" range="0 1.5" damping=".1"/>
<geom type="capsule" size=".007" fromto="0 0 0 0 .03 0"/></body></body>"""
PLACES = {
    "index": (-0.03, 0.04, 0.0),
    "middle": (0.0, 0.04, 0.0),
    "ring": (0.03, 0.04, 0.0),
    "thumb": (-0.03, -0.03, 1.2),
}
JOINTS = [f"{joint}_{finger}" for finger in PLACES for joint in ("flex", "curl")]


def described(folder: Path, gains: dict[str, float], **options: float) -> InitResult:
    """Describe a claw whose joints have position actuators with these gains."""
    folder.mkdir()
    bodies = "".join(FINGER.format(name, *place) for name, place in PLACES.items())
    actuators = "".join(
        f'<position joint="{joint}" kp="{gain}"/>' for joint, gain in gains.items()
    )
    model = folder / "claw.xml"
    model.write_text(CLAW.format(bodies=bodies, actuators=actuators))
    return init_hands(
        model, out=folder / "hand.yaml", side="right", speed=options.get("speed")
    )


def notes_of(result: InitResult) -> str:
    return "\n".join(result.hands[0].notes)


def speeds_of(hand: Hand) -> dict[str, float]:
    return dict(zip(hand.joint_names, hand.velocity_limits.tolist(), strict=True))


def found_by(spec: HandSpec) -> list[HandFinding]:
    return [*check_speeds(load_hand(spec))]


def with_speeds(*speeds: float, origin: str | None = None) -> HandSpec:
    """Return the three-fingered hand with these speeds in turn."""
    spec = load_hand("three_finger").spec
    limits = {
        joint: LimitSpec(velocity=speeds[i % len(speeds)])
        for i, joint in enumerate(spec.joints)
    }
    return msgspec.structs.replace(spec, limits=limits, speeds=origin)


@pytest.mark.parametrize("speed", [48.97, 100.0, 1e3, 5e4])
def test_fast_placeholders_are_said_once(speed: float) -> None:
    spec = with_speeds(speed, 3.1)
    (found,) = found_by(spec)
    count = sum(limit.velocity == speed for limit in spec.limits.values())
    assert 1 < count < len(spec.joints)
    assert found.level == "advice"
    assert f"{count} joints have speeds of up to {speed:,.5g} per second" in found.text
    assert "--speed" in found.change
    # An owner who says so is believed.
    for origin in ("maker", "given"):
        assert found_by(msgspec.structs.replace(spec, speeds=origin)) == []
    assert found_by(with_speeds(FASTEST_SPEEDS["revolute"], 3.1)) == []


def test_init_says_that_speeds_are_placeholders(tmp_path: Path) -> None:
    text = re.sub('velocity="[^"]*"', 'velocity="1000"', THREE_FINGER.read_text())
    (tmp_path / "hand.urdf").write_text(text)
    result = init_hands(tmp_path / "hand.urdf", out=tmp_path / "hand.yaml")
    assert notes_of(result).count("1,000 per second, which hardly any motor") == 1


def test_slow_and_fast_joints_are_two_findings() -> None:
    found = found_by(with_speeds(0.5, 500.0))
    assert len(found) == 2
    assert "too slow" in found[0].text
    assert "placeholder" in found[1].text


def test_actuators_of_mjcf_tell_speeds(tmp_path: Path) -> None:
    """Without inertia to speak of, a servo begins at k s / damping: here 15 k per second."""
    gains = {joint: 0.2 + 0.05 * i for i, joint in enumerate(JOINTS)}
    result = described(tmp_path / "claw", gains)
    hand = result.hands[0].hand
    assert hand.spec.speeds == "estimated"
    assert hand.spec.assumed_speeds == ()
    for joint, speed in speeds_of(hand).items():
        assert speed == pytest.approx(15.0 * gains[joint], rel=0.1)
    assert "estimated from the actuators of the MJCF file" in notes_of(result)
    assert "assumed" not in notes_of(result)
    assert load_hand(result.file).spec.speeds == "estimated"
    # A joint without an actuator gets the median of the others.
    del gains["curl_ring"]
    partly = described(tmp_path / "partly", gains).hands[0].hand
    known = speeds_of(partly)
    alone = known.pop("curl_ring")
    assert min(known.values()) < alone < max(known.values())


def test_without_actuators_a_speed_is_assumed_and_said(tmp_path: Path) -> None:
    result = described(tmp_path / "claw", {})
    hand = result.hands[0].hand
    assert hand.spec.speeds == "assumed"
    assert {*speeds_of(hand).values()} == {USUAL_SPEEDS["revolute"]}
    assert {*hand.spec.assumed_speeds} == {*JOINTS}
    assert "the speeds of 8 joints are assumed, 5 per second" in notes_of(result)
    (found,) = check_speeds(load_hand(result.file))
    assert "a fist takes 0.3 s or more" in found.text
    assert "--speed" in found.change


def test_a_given_speed_is_in_the_place_of_all(tmp_path: Path) -> None:
    result = described(tmp_path / "claw", dict.fromkeys(JOINTS, 0.3), speed=8.0)
    hand = result.hands[0].hand
    assert hand.spec.speeds == "given"
    assert hand.spec.assumed_speeds == ()
    assert {*speeds_of(hand).values()} == {8.0}
    assert [*check_speeds(hand)] == []


def test_only_speeds_that_the_file_lacks_are_assumed(tmp_path: Path) -> None:
    speeds = iter(["0", *["2.5"] * 99])
    text = re.sub(
        'velocity="[^"]*"',
        lambda _: f'velocity="{next(speeds)}"',
        THREE_FINGER.read_text(),
    )
    (tmp_path / "hand.urdf").write_text(text)
    hand = init_hands(tmp_path / "hand.urdf", out=tmp_path / "hand.yaml").hands[0].hand
    assert hand.spec.speeds == "assumed"
    assert len(hand.spec.assumed_speeds) == 1
    # Of a hand without speeds of its own in `limits` all are.
    bare = msgspec.structs.replace(hand.spec, limits={})
    assert bare.assumed_speeds == hand.spec.joints
