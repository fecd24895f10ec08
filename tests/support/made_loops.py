"""Hands whose fingers are linkages, as MJCF: loops that constraints close.

Each has a palm, and fingers that point along z and flex about y. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Callable

HEAD = '<compiler angle="radian" autolimits="true"/>'
# Where fingers start on the palm, and the sense in which they flex.
FINGERS = {
    "thumb": ("0.03 0 0", -1),
    "index": ("-0.03 0.02 0", 1),
    "middle": ("-0.03 -0.02 0", 1),
}
PROXIMAL = 0.045


def _joint(name: str, axis: str, low: float, high: float) -> str:
    return f'<joint name="{name}" axis="{axis}" range="{low} {high}"/>'


def _bone(length: float) -> str:
    return f'<geom type="capsule" size=".004" fromto="0 0 0 0 0 {length}"/>'


def _model(fingers: list[str], equality: str, actuator: str, tendon: str = "") -> str:
    return (
        f'<mujoco model="loops">{HEAD}<worldbody><body name="palm">'
        f'<geom type="box" size=".035 .03 .03" pos="0 0 -.035"/>{"".join(fingers)}</body>'
        f"</worldbody><tendon>{tendon}</tendon><equality>{equality}</equality>"
        f"<actuator>{actuator}</actuator></mujoco>"
    )


def _phalanges(name: str, sign: int, inside: str = "") -> str:
    """Return a proximal and a distal body, the first without its frame's element."""
    return (
        _joint(f"{name}_proximal", f"0 {sign} 0", 0.0, 1.2)
        + _bone(PROXIMAL)
        + f'<body name="{name}_distal" pos="0 0 {PROXIMAL}">'
        + _joint(f"{name}_distal", f"0 {sign} 0", -0.3, 1.6)
        + _bone(0.03)
        + f"</body>{inside}"
    )


def four_bars(low: float = -1.0, high: float = 1.5) -> str:
    """A crossed bar from the palm to the distal phalanx of each finger: one motor a finger.

    Args:
        low: Lower limit of the bars [rad].
        high: Upper limit of the bars [rad].
    """
    fingers, equality, motors = [], "", ""
    for name, (place, sign) in FINGERS.items():
        x, y, z = map(float, place.split())
        # From the palmar side of the knuckle to the dorsal side of the next joint.
        start, end = 0.006 * sign, -0.006 * sign
        fingers.append(
            f'<body name="{name}_proximal" pos="{place}">{_phalanges(name, sign)}</body>'
            f'<body name="{name}_bar" pos="{x + start} {y} {z}">'
            + _joint(f"{name}_bar", f"0 {sign} 0", low, high)
            + f'<geom type="capsule" size=".002" fromto="0 0 0 {end - start} 0 {PROXIMAL}"/></body>'
        )
        equality += (
            f'<connect body1="{name}_bar" body2="{name}_distal" '
            f'anchor="{end - start} 0 {PROXIMAL}"/>'
        )
        motors += f'<position joint="{name}_proximal"/>'
    return _model(fingers, equality, motors)


def pushed_fingers() -> str:
    """Two cranks with rods bend and spread each finger, and a bar couples its distal phalanx.

    Each finger has two motors and ten joints, of which three move its tip.
    """
    fingers, equality, motors = [], "", ""
    for name, (place, sign) in FINGERS.items():
        x, y, z = map(float, place.split())
        start, end = 0.006 * sign, -0.006 * sign
        fingers.append(
            f'<body name="{name}_spread" pos="{place}">'
            + _joint(f"{name}_spread", "1 0 0", -0.4, 0.4)
            + f'<geom size=".003"/><body name="{name}_proximal">{_phalanges(name, sign)}</body>'
            + f'<body name="{name}_bar" pos="{start} 0 0">'
            + _joint(f"{name}_bar", f"0 {sign} 0", -1.0, 1.5)
            + f'<geom type="capsule" size=".002" fromto="0 0 0 {end - start} 0 {PROXIMAL}"/></body>'
            "</body>"
        )
        equality += (
            f'<connect body1="{name}_bar" body2="{name}_distal" '
            f'anchor="{end - start} 0 {PROXIMAL}"/>'
        )
        for number, across in enumerate((0.007, -0.007)):
            crank = f"{name}_crank{number}"
            # Behind the finger, a rod goes from the crank's end up to an ear of the phalanx.
            behind = -0.012 * sign
            fingers.append(
                f'<body name="{crank}" pos="{x} {y + across} {z - 0.03}">'
                + _joint(crank, f"0 {sign} 0", -1.2, 1.2)
                + f'<geom type="capsule" size=".002" fromto="0 0 0 {behind} 0 0"/>'
                f'<body name="{name}_rod{number}" pos="{behind} 0 0">'
                + _joint(f"{name}_rod{number}_x", "1 0 0", -1.0, 1.0)
                + _joint(f"{name}_rod{number}_y", "0 1 0", -1.5, 1.5)
                + '<geom type="capsule" size=".002" fromto="0 0 0 0 0 .04"/></body></body>'
            )
            equality += (
                f'<connect body1="{name}_rod{number}" body2="{name}_proximal" '
                'anchor="0 0 .04"/>'
            )
            motors += f'<position joint="{crank}"/>'
    return _model(fingers, equality, motors)


def welded_jaws() -> str:
    """Two parallelograms, each of whose pads is in two halves that a weld joins."""
    fingers, equality = [], ""
    for name, sign in (("left", 1), ("right", -1)):
        for part, x in (("driver", 0.03), ("link", 0.012)):
            half = 0.005 if part == "driver" else -0.005
            pad = (
                f'<body name="{name}_{part}_pad" pos="0 0 .05">'
                + _joint(f"{name}_{part}_pad", f"0 {sign} 0", -0.1, 0.9)
                + f'<geom type="box" size=".003 .01 .02" pos="{-half * sign} 0 .02"/></body>'
            )
            fingers.append(
                f'<body name="{name}_{part}" pos="{x * sign} 0 0">'
                + _joint(f"{name}_{part}", f"0 {-sign} 0", 0.0, 0.8)
                + f"{_bone(0.05)}{pad}</body>"
            )
        equality += f'<weld body1="{name}_driver_pad" body2="{name}_link_pad"/>'
    equality += '<joint joint1="right_driver" joint2="left_driver"/>'
    return _model(fingers, equality, '<position joint="left_driver"/>')


def tendons(low: float = -0.3, *, offset: float = 0.0, factor: float = 1.0) -> str:
    """A tendon of fixed length makes each distal joint follow its proximal one.

    Args:
        low: Lower limit of the distal joints [rad].
        offset: Position of the distal joint at zero of the proximal one [rad].
        factor: Turns of the distal joint per turn of the proximal one.
    """
    fingers, equality, motors, cords = [], "", "", ""
    for name, (place, sign) in FINGERS.items():
        phalanges = _phalanges(name, sign).replace('range="-0.3', f'range="{low}')
        fingers.append(f'<body name="{name}" pos="{place}">{phalanges}</body>')
        cords += (
            f'<fixed name="{name}_cord"><joint joint="{name}_distal" coef="1"/>'
            f'<joint joint="{name}_proximal" coef="{-factor}"/></fixed>'
        )
        equality += f'<tendon tendon1="{name}_cord" polycoef="{offset} 0 0 0 0"/>'
        motors += f'<position joint="{name}_proximal"/>'
    return _model(fingers, equality, motors, cords)


LOOPS: dict[str, Callable[[], str]] = {
    "four bars": four_bars,
    "pushed fingers": pushed_fingers,
    "welded jaws": welded_jaws,
    "tendons": tendons,
}
