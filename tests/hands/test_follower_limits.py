"""Rules of followers whose own limits are narrower than what their leaders ask for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from handmap_core.se3 import Array
from handmap_qp import load_hand
from handmap_qp.apps.onboarding.init import init_hands
from handmap_qp.hands import Hand, Interval, MimicSpec, clipped_rule
from handmap_qp.hands.follower_limits import (
    LEAST_SHARE,
    MOST_SHARE,
    error_within,
    leaves,
    range_left,
    rule_within,
)

_numbers = st.floats(-3.0, 3.0)
_rules = st.builds(
    MimicSpec,
    st.just("leader"),
    st.floats(0.1, 4.0) | st.floats(-4.0, -0.1),
    _numbers,
)
_intervals = st.builds(
    lambda low, width: Interval(low, low + width), _numbers, st.floats(0.05, 3.0)
)


def _at(rule: MimicSpec, positions: Array) -> Array:
    return rule.multiplier * positions + rule.offset


@given(_rules, _intervals, _intervals)
def test_a_line_within_limits_keeps_them_and_is_exact_at_both_ends(
    rule: MimicSpec, own: Interval, leader: Interval
) -> None:
    line = rule_within(rule, own, leader)
    positions = np.linspace(*leader, 201)
    followed = _at(line, positions)
    assert (followed >= own.low - 1e-9).all()
    assert (followed <= own.high + 1e-9).all()
    clipped = np.clip(_at(rule, positions), *own)
    np.testing.assert_allclose(followed[[0, -1]], clipped[[0, -1]], atol=1e-9)


@given(_rules, _intervals, _intervals)
def test_the_error_of_a_line_is_that_of_its_worst_place(
    rule: MimicSpec, own: Interval, leader: Interval
) -> None:
    assume(range_left(rule, own, leader).width > 0.0)
    positions = np.linspace(*leader, 2001)
    line = rule_within(rule, own, leader)
    clipped = np.clip(_at(rule, positions), *own)
    worst = np.abs(clipped - _at(line, positions)).max()
    step = leader.width / 2000
    error = error_within(rule, own, leader)
    assert worst - 1e-9 <= error <= worst + abs(rule.multiplier) * step + 1e-9


@given(_rules, _intervals, _intervals)
def test_a_rule_is_clipped_between_the_two_shares(
    rule: MimicSpec, own: Interval, leader: Interval
) -> None:
    left = range_left(rule, own, leader)
    is_between = leaves(LEAST_SHARE, left, leader)
    is_between &= not leaves(MOST_SHARE, left, leader)
    assert (clipped_rule(rule, own, leader) is not None) == is_between


def test_limits_that_are_no_numbers_clip_nothing() -> None:
    nan = Interval(np.nan, np.nan)
    some = Interval(0.0, 1.0)
    rule = MimicSpec("leader", 2.0)
    assert clipped_rule(rule, nan, some) is None
    assert clipped_rule(rule, some, nan) is None
    assert clipped_rule(MimicSpec("leader", 0.0), some, some) is None


def _urdf(high: float, factor: float = 1.0) -> str:
    """Return a hand of three fingers whose last joints follow the first ones up to `high`."""
    parts = ""
    for name, x, y, sign in (
        ("thumb", 0.03, 0.0, -1),
        ("index", -0.03, 0.02, 1),
        ("middle", -0.03, -0.02, 1),
    ):
        for part, parent, place, end, mimic in (
            ("proximal", "palm", f"{x} {y} 0", 1.5, ""),
            ("distal", f"{name}_proximal", "0 0 .04", high, f"{name}_proximal_joint"),
        ):
            rule = mimic and f'<mimic joint="{mimic}" multiplier="{factor}"/>'
            parts += (
                f'<link name="{name}_{part}"><visual><origin xyz="0 0 .02"/><geometry>'
                '<box size=".01 .01 .04"/></geometry></visual></link>'
                f'<joint name="{name}_{part}_joint" type="revolute"><parent link="{parent}"/>'
                f'<child link="{name}_{part}"/><origin xyz="{place}"/>'
                f'<axis xyz="0 {sign} 0"/>{rule}'
                f'<limit lower="0" upper="{end}" effort="1" velocity="3"/></joint>'
            )
    return f'<robot name="stops"><link name="palm"/>{parts}</robot>'


def _described(folder: Path, text: str) -> tuple[Hand, tuple[str, ...]]:
    file = folder / "stops.urdf"
    file.write_text(text, encoding="utf-8")
    (found,) = init_hands(file, out=folder / "hand.yaml", overwrite=True).hands
    return load_hand(folder / "hand.yaml"), tuple(found.notes)


@pytest.mark.parametrize(
    ("high", "end", "reach", "is_noted"),
    [
        # The follower stops in most of the range: the leader keeps it.
        (0.3, 1.5, 0.3, True),
        # Its limits leave most of the range, and bound the leader.
        (1.2, 1.2, 1.2, False),
        (1.5, 1.5, 1.5, False),
    ],
)
def test_a_described_urdf_says_where_followers_stop(
    tmp_path: Path, high: float, end: float, reach: float, is_noted: bool
) -> None:
    hand, notes = _described(tmp_path, _urdf(high))
    np.testing.assert_allclose(hand.upper_limits, end, atol=1e-9)
    every = dict(
        zip(hand.all_joint_names, hand.all_joints(hand.upper_limits), strict=True)
    )
    assert every["index_distal_joint"] == pytest.approx(reach)
    assert hand.spec.mimic.keys() == (
        {f"{name}_distal_joint" for name in ("thumb", "index", "middle")}
        if is_noted
        else set()
    )
    assert is_noted == any("is at a limit of its own" in note for note in notes)


def test_limits_of_the_wrong_sign_are_ignored(tmp_path: Path) -> None:
    """Nothing says which of the two is wrong: the rule is kept, as other programs keep it."""
    with pytest.warns(UserWarning, match="are ignored"):
        hand, notes = _described(tmp_path, _urdf(0.9, factor=-1.0))
    np.testing.assert_allclose(hand.upper_limits, 1.5)
    assert not hand.spec.mimic
    assert any("are ignored" in note for note in notes)
