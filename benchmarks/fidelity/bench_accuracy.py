"""Measure how the options of the mapping affect the robot's motion.

One factor at a time is varied around `MappingOptions()` and `IkOptions()` (some together with a
second one), over all recordings and two robots. Two kinds of numbers are measured. How well the
robot reaches the targets of the mapping: point error, joint limits, speed, jerk. How well it
reproduces the human motion: displacement of the palm, and correlation and range of each finger's
extension.
"""

from __future__ import annotations

import multiprocessing
from argparse import Namespace
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import common
import numpy as np
from joint_motion import map_motion
from motion_quality import (
    FingerMatch,
    MotionQuality,
    assess_quality,
    mean_correlation,
    total_range_ratio,
)
from scenes import ROBOTS, Scene, load_scenes, robot_for

from handmap_qp import HandMapper, IkOptions, MappingOptions, MapStep, load_hand

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FINGERS = ("thumb", "index", "middle", "ring")
"""Fingers that at least one robot has."""
FOLLOW_POINTS = {"rigid_from": "points", "pivot": "centroid"}
FOLLOW_WRIST = {"rigid_from": "wrist", "pivot": "palm"}
PAPER = {
    "human_points": "fingertips",
    "ridge": 0.0,
    **FOLLOW_POINTS,
    "residual_gain": 0.0,
    "deformation_gain": 1.0,
}
"""The paper's estimation, in coordinates about the centroid."""


@dataclass(frozen=True, slots=True)
class Case:
    """A complete set of options."""

    human_points: str = load_hand("human").spec.reference
    robot_points: str = load_hand("three_finger").spec.reference
    mapping: MappingOptions = field(default_factory=MappingOptions)
    ik: IkOptions = field(default_factory=IkOptions)

    def changed(self, changes: dict[str, Any]) -> Case:
        """Return the case with some options changed, of the mapping, of the IK or of the points."""
        mapping = {
            name: changes[name] for name in changes.keys() & self.mapping.values.keys()
        }
        ik = {name: changes[name] for name in changes.keys() & self.ik.values.keys()}
        points = {
            name: value
            for name, value in changes.items()
            if name not in (*mapping, *ik)
        }
        return replace(
            self,
            mapping=self.mapping.replaced(**mapping),
            ik=self.ik.replaced(**ik),
            **points,
        )


@dataclass(frozen=True, slots=True)
class Factor:
    """An option, its values, and variants of other options to combine them with."""

    name: str
    values: tuple[Any, ...]
    variants: tuple[dict[str, Any], ...] = ({},)

    def cases(self) -> Iterator[tuple[dict[str, Any], Any, Case]]:
        """Yield variant, value and case."""
        for variant in self.variants:
            for value in self.values:
                yield variant, value, Case().changed({**variant, self.name: value})


FACTORS = (
    Factor(
        "human_points",
        ("fingertips", "fingertips_middle", "joints", "landmarks"),
        (FOLLOW_POINTS, FOLLOW_WRIST),
    ),
    Factor(
        "ridge",
        (0.0, 0.03, 0.1, 0.3, 1.0),
        ({"human_points": "joints"}, {"human_points": "fingertips"}),
    ),
    Factor(
        "pivot",
        ("centroid", "palm", "world"),
        tuple({"rigid_from": name} for name in ("points", "wrist", "none")),
    ),
    Factor("residual_gain", (0.0, 0.25, 0.5, 0.75, 1.0), (FOLLOW_POINTS, FOLLOW_WRIST)),
    Factor(
        "deformation_gain",
        (0.0, 0.5, 1.0),
        tuple({"residual_gain": gain} for gain in (0.0, 0.5, 1.0)),
    ),
    Factor("max_iterations", (1, 2, 3, 6)),
    Factor("error_damping", (0.0, 0.1, 0.3, 0.7, 1.0, 3.0)),
    Factor("rest_weight", (0.0, 0.1, 0.2, 0.5, 1.0)),
    # The factors from here on are in the table only.
    Factor(
        "human_points",
        ("fingertips", "fingertips_middle", "joints"),
        tuple(
            {**follow, "residual_gain": gain}
            for gain in (0.5, 1.0)
            for follow in (FOLLOW_POINTS, FOLLOW_WRIST)
        ),
    ),
    Factor(
        "deformation_gain",
        (0.0, 0.5, 1.0),
        ({"human_points": "joints", **FOLLOW_WRIST, "residual_gain": 1.0},),
    ),
    Factor("robot_points", ("fingertips", "fingertips_middle")),
    Factor("reference", (MappingOptions().reference, "previous"), ({}, PAPER)),
)
QUICK_FACTORS = (
    Factor("ridge", (0.1, 1.0)),
    Factor("residual_gain", (0.0, 1.0), (FOLLOW_POINTS, FOLLOW_WRIST)),
)
DRAWN = 8
"""Number of factors in the picture, from the first on."""


class WatchedMapper(HandMapper):
    """A mapper that records the stretches of each step."""

    def map_step(self, *arguments: Any, **words: Any) -> MapStep:
        """Map one sample and record its stretches."""
        step = super().map_step(*arguments, **words)
        self.watched = [
            *getattr(self, "watched", ()),
            (step.stretches.min(), step.stretches.max(), step.is_clamped),
        ]
        return step


def measure(case: Case, family: str, scenes: list[Scene]) -> dict[str, Any]:
    """Map all scenes to a robot and summarise.

    Args:
        case: The options.
        family: The robot, one of `ROBOTS`.
        scenes: The recordings.

    Returns:
        Numbers by name, with units in the names.
    """
    qualities: list[MotionQuality] = []
    watched: list[tuple[float, float, bool]] = []
    for scene in scenes:
        human = scene.motion.human.with_points(case.human_points)
        mapper = WatchedMapper(
            human,
            robot_for(family, scene.side, case.robot_points),
            case.mapping,
            ik=case.ik,
        )
        trajectory = map_motion(mapper, scene.motion)
        qualities.append(assess_quality(scene.motion, trajectory))
        watched += mapper.watched
    smallest, largest, clamped = np.array(watched).T
    matches = [match for quality in qualities for match in quality.fingers]

    def mean(name: str) -> float:
        return float(np.mean([getattr(quality, name) for quality in qualities]))

    return {
        "point_error_mm_mean": 1e3 * mean("point_error_mean"),
        "point_error_mm_p95": 1e3 * mean("point_error_p95"),
        "stretch_min": float(smallest.min()),
        "stretch_max": float(largest.max()),
        "share_clamped": float(clamped.mean()),
        "palm_off_mm_rms": 1e3 * mean("wrist_distance"),
        "palm_off_deg_rms": float(np.degrees(mean("wrist_angle"))),
        "share_at_limit": mean("share_at_limit"),
        "speed_rad_s_rms": mean("speed"),
        "jerk_rad_s3_rms": mean("jerk"),
        # Geometric mean: recordings differ tenfold in rate and noise.
        "jerk_over_human": float(
            np.exp(
                np.mean(
                    [np.log(quality.jerk / quality.human_jerk) for quality in qualities]
                )
            )
        ),
        "jerk_over_human_max": max(
            quality.jerk / quality.human_jerk for quality in qualities
        ),
        **_follow(matches),
        "fingers": {
            finger: _follow([match for match in matches if match.finger == finger])
            for finger in _fingers(matches)
        },
        "recordings": {
            scene.name: asdict(quality)
            for scene, quality in zip(scenes, qualities, strict=True)
        },
    }


def _fingers(matches: list[FingerMatch]) -> list[str]:
    return [
        finger for finger in FINGERS if any(match.finger == finger for match in matches)
    ]


def _follow(matches: list[FingerMatch]) -> dict[str, float]:
    return {
        "correlation": mean_correlation(matches),
        "range_ratio": total_range_ratio(matches),
    }


_scenes: list[Scene] = []


def _start_worker(files: list[Path], every: int, samples: int | None) -> None:
    _scenes[:] = load_scenes(files, every, samples)


def _work(job: tuple[Case, str]) -> dict[str, Any]:
    return measure(*job, _scenes)


def measure_all(
    jobs: list[tuple[Case, str]], files: list[Path], arguments: Namespace
) -> list[dict[str, Any]]:
    """Measure every case, in `arguments.jobs` processes."""
    samples = 60 if arguments.quick else None
    prepare = partial(_start_worker, files, arguments.every, samples)
    with common.progress("settings", len(jobs)) as advance:
        if arguments.jobs == 1:
            prepare()
            return [_advanced(advance, _work(job)) for job in jobs]
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(
            arguments.jobs, mp_context=context, initializer=prepare
        ) as pool:
            return [_advanced(advance, result) for result in pool.map(_work, jobs)]


def _advanced(advance: Any, result: dict[str, Any]) -> dict[str, Any]:
    advance()
    return result


def table_rows(
    factors: tuple[Factor, ...], results: dict[tuple[Case, str], dict[str, Any]]
) -> list[dict[str, Any]]:
    """Format the results as a table, one row per case and robot."""
    rows: list[dict[str, Any]] = []
    for factor in factors:
        for variant, value, case in factor.cases():
            for family in ROBOTS:
                row = {
                    "setting": f"{factor.name} {value}"
                    + (" *" if case == Case() else ""),
                    "with": ", ".join(
                        f"{name} {word}" for name, word in variant.items()
                    )
                    if variant is not PAPER
                    else "the paper",
                    "robot": family,
                }
                rows.append(row | _cells(results[case, family]))
        rows.append({})
    return rows[:-1]


def _cells(result: dict[str, Any]) -> dict[str, str]:
    pairs = {finger: result["fingers"].get(finger) for finger in FINGERS}
    return {
        "point error mm": (
            f"{result['point_error_mm_mean']:.1f} / {result['point_error_mm_p95']:.0f}"
        ),
        "stretch": f"{result['stretch_min']:.2f} .. {result['stretch_max']:.2f}",
        "palm off": f"{result['palm_off_mm_rms']:.0f} mm {result['palm_off_deg_rms']:3.0f} deg",
        "at limit": f"{result['share_at_limit']:.0%}",
        "speed": f"{result['speed_rad_s_rms']:.2f}",
        "jerk": f"{result['jerk_rad_s3_rms']:.0f}",
        "x human": f"{result['jerk_over_human']:.2f}",
        **{
            finger: "" if pair is None else _pair(pair)
            for finger, pair in pairs.items()
        },
        "fingers": _pair(result),
    }


def _pair(follow: dict[str, float]) -> str:
    return f"{follow['correlation']:+.2f} x{follow['range_ratio']:.2f}"


METRICS = (
    ("correlation", "finger extension,\ncorrelation", (-0.2, 1.0)),
    ("range_ratio", "finger extension,\nratio of ranges", (0.0, 1.4)),
    ("palm_off_deg_rms", "palm off the\nhuman's [deg]", (0.0, 80.0)),
    ("palm_off_mm_rms", "palm off the\nhuman's [mm]", (0.0, 150.0)),
    ("point_error_mm_mean", "point error\n[mm]", (0.0, 40.0)),
    ("jerk_over_human", "joint jerk over\nthe human's", (0.0, 1.6)),
)
"""Rows of the picture: result, label and range of the axis.

Values outside the range are drawn as triangles at its edge.
"""


def draw(
    factors: tuple[Factor, ...], results: dict[tuple[Case, str], dict[str, Any]]
) -> Figure:
    """Draw a grid: a column per factor, a row per metric, with the default marked."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(2.15 * len(factors) + 0.8, 12.5), layout="constrained")
    grid = figure.subplots(len(METRICS), len(factors), sharey="row", squeeze=False)
    for factor, column in zip(factors, grid.T, strict=True):
        column[0].set_title(factor.name)
        for axes, (metric, label, limits) in zip(column, METRICS, strict=True):
            _draw_panel(axes, factor, metric, limits, results)
            if factor is factors[0]:
                axes.set_ylabel(label)
        column[-1].set_xticks(
            range(len(factor.values)),
            [_short(value) for value in factor.values],
            rotation=30,
            ha="right",
        )
        styles = zip(factor.variants, _LINES, strict=False)
        names = [
            Line2D([], [], color="#222831", linestyle=line, label=_words(variant))
            for variant, line in styles
            if variant
        ]
        column[-1].legend(
            handles=names,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.42),
            fontsize=7.5,
            handlelength=2.6,
        )
    robots = [
        Line2D(
            [],
            [],
            color=common.COLOURS[family],
            marker="o",
            label=family.replace("_", "-"),
        )
        for family in ROBOTS
    ]
    mark = Line2D(
        [],
        [],
        color="#222831",
        marker="o",
        markersize=9,
        fillstyle="none",
        linestyle="",
        label="default",
    )
    figure.legend(
        handles=[*robots, mark], loc="outside upper left", ncols=3, fontsize=10
    )
    return figure


_LINES = ("-", (0, (4, 1.5)), (0, (1, 1.2)))


def _draw_panel(
    axes: Any,
    factor: Factor,
    metric: str,
    limits: tuple[float, float],
    results: dict[tuple[Case, str], dict[str, Any]],
) -> None:
    for family in ROBOTS:
        for variant, line in zip(factor.variants, _LINES, strict=False):
            cases = [case for other, _, case in factor.cases() if other is variant]
            heights = np.array([results[case, family][metric] for case in cases])
            shown, colour = np.clip(heights, *limits), common.COLOURS[family]
            axes.plot(range(len(cases)), shown, color=colour, linestyle=line)
            for i, (height, mark) in enumerate(zip(heights, shown, strict=True)):
                axes.plot(
                    i,
                    mark,
                    marker="o" if height == mark else "^",
                    markersize=3.5,
                    color=colour,
                    clip_on=False,
                )
            if Case() in cases:
                place = cases.index(Case())
                axes.plot(
                    place,
                    shown[place],
                    marker="o",
                    markersize=9,
                    fillstyle="none",
                    color=colour,
                    clip_on=False,
                )
    axes.set(xlim=(-0.3, len(factor.values) - 0.7), ylim=limits)
    axes.set_xticks(range(len(factor.values)), [])


def _short(value: Any) -> str:
    return (
        str(value)
        .replace("fingertips_middle", "tips, middle")
        .replace("fingertips", "tips")
    )


def _words(variant: dict[str, Any]) -> str:
    return "\n".join(f"{name} {value}" for name, value in variant.items())


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser(" ".join(str(__doc__).split("\n\n")[0].split()))
    parser.add_argument(
        "--every",
        type=int,
        default=1,
        metavar="N",
        help="map every N-th sample only (default: all)",
    )
    parser.add_argument(
        "--jobs", type=int, default=2, metavar="N", help="processes (default: 2)"
    )
    arguments = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)[
        : 2 if arguments.quick else None
    ]
    arguments.jobs = 1 if arguments.quick else max(1, arguments.jobs)
    factors = QUICK_FACTORS if arguments.quick else FACTORS
    # Measure each case once, also if it belongs to several factors.
    jobs = list(
        dict.fromkeys(
            (case, family)
            for factor in factors
            for *_, case in factor.cases()
            for family in ROBOTS
        )
    )
    results = dict(zip(jobs, measure_all(jobs, files, arguments), strict=True))
    common.print_table(
        f"Effect of the options: mean over {len(files)} recordings",
        table_rows(factors, results),
        to_stderr=arguments.json == "-",
        caption="* the default. point error: mean / 95th percentile. palm off: RMS difference of "
        "the palms' displacements. speed [rad/s] and jerk [rad/s^3]: RMS. x human: geometric mean "
        "of the ratios to the human's. Fingers: correlation of the distance from tip to palm with "
        "the human's, and x the ratio of its range to the human's.",
    )
    document = {
        "default": asdict(Case()),
        "recordings": [file.stem for file in files],
        "rows": [
            {
                "factor": factor.name,
                "value": value,
                "with": variant,
                "robot": family,
                "default": case == Case(),
            }
            | results[case, family]
            for factor in factors
            for variant, value, case in factor.cases()
            for family in ROBOTS
        ],
    }
    common.write_json(arguments.json, "accuracy", document)
    common.save_picture(arguments.picture, lambda: draw(factors[:DRAWN], results))


if __name__ == "__main__":
    main()
