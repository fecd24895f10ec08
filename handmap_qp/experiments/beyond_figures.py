"""Figures beyond the paper, on its open questions.

They are about joint limits, errors of points and object, the choice of reference points, the start
configuration, another hand, and the world's origin. `beyond_runs` computes their numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from handmap_qp.drawing.hands import ROBOT_COLOUR, draw_hands, spheres
from handmap_qp.drawing.raster import Camera
from handmap_qp.experiments import beyond_runs
from handmap_qp.experiments.figure_record import FigureRecord, Row
from handmap_qp.experiments.paper_drawings import grasp_triangles, heading
from handmap_qp.experiments.paper_figures import GAMMAS, listed
from handmap_qp.experiments.section_four import Scene
from handmap_qp.experiments.style import COLOURS, INK, PALE, styled, words

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FINGERS = {
    "pseudoinverse": ("eq. (8), no limits", PALE, (0, (4, 2))),
    "clipped": ("eq. (8), clipped", COLOURS[3], "-"),
    "damped": ("cost of the QP, clipped", COLOURS[1], "-"),
    "qp": ("QP", COLOURS[0], "-"),
    "frozen": ("fingers frozen", INK, (0, (1, 1.5))),
}
_OBJECT, _POINTS = "object_error_mm", "point_rms_mm"
_LABELS = {_OBJECT: "object centres apart [mm]", _POINTS: "points to T s, RMS [mm]"}


def limits_figure() -> FigureRecord:
    """Compare the QP with the pseudoinverse within tight joint limits."""
    rows, own = beyond_runs.limit_rows(), beyond_runs.own_limit_rows()
    ways = ("pseudoinverse", "clipped", "damped", "qp")
    at = {
        f: [_mean(rows, _POINTS, fingers=f, margin_deg=m) for m in beyond_runs.MARGINS]
        for f in ways
    }
    excess = _most(rows, "limit_excess_deg", fingers="pseudoinverse", margin_deg=0.0)
    box = {f: _mean(own, _POINTS, fingers=f, limits="toolbox") for f in at}
    gap = int(np.argmax(np.subtract(at["clipped"], at["qp"])))
    text = (
        "Eq. (8) ignores limits: joints that must not move at all violate their limits by up to "
        f"{excess:.1f} degrees. "
        f"Means over the three synergies: with limits {beyond_runs.MARGINS[gap]:g} degrees from "
        "the start, the robot's points end "
        f"{at['clipped'][gap]:.2f} mm (RMS) from `T s` if steps of eq. (8) are clipped, "
        f"{at['damped'][gap]:.2f} mm if the "
        f"QP's cost is minimised without limits and then clipped, and {at['qp'][gap]:.2f} mm with "
        "the QP, in which wrist "
        "and free joints compensate for joints at their limits. Within the toolbox's limits (0 to "
        "90 degrees, with the "
        f"spread joints starting at the lower one) it is {box['clipped']:.2f}, {box['damped']:.2f} "
        f"and {box['qp']:.2f} mm. With "
        f"wide limits both minimisers of the QP's cost agree: {at['qp'][-1]:.2f} mm, against "
        f"{at['pseudoinverse'][-1]:.2f} mm of eq. (8), whose wrist moves by T_rb alone."
    )
    table = [{"limits": "start +- margin_deg", **row} for row in rows]
    table += [
        {
            "limits": f"{row['limits']}'s",
            "synergy": row["synergy"],
            "margin_deg": np.nan,
            **_without(row, "limits", "synergy"),
        }
        for row in own
    ]
    return FigureRecord(
        "beyond_1_limits", "The QP within joint limits", _draw_limits(rows), table, text
    )


def points_figure() -> FigureRecord:
    """Compare the error of the robot's points with that of the object's centre."""
    rows = beyond_runs.point_rows(GAMMAS)
    last = {
        f: {
            m: [_mean(rows, m, fingers=f, gamma=1.0, synergy=s) for s in beyond_runs.SYNERGIES]
            for m in _LABELS
        }
        for f in ("pseudoinverse", "qp", "frozen")
    }
    text = (
        "The error of the object's centre hardly depends on the fingers. At gamma = 1, with eq. "
        "(8), the two centres end "
        f"{listed(last['pseudoinverse'][_OBJECT], 2)} mm apart for synergies 1 to 3, with the QP "
        f"{listed(last['qp'][_OBJECT], 2)} mm, and with frozen fingers on a wrist that follows the "
        "rigid motion of the human's "
        f"contacts only {listed(last['frozen'][_OBJECT], 2)} mm: by this measure it is best not to "
        "map the fingers at all. The "
        "RMS distance of the robot's points from `T s` does depend on them: "
        f"{listed(last['pseudoinverse'][_POINTS], 2)} mm by eq. "
        f"(8), {listed(last['qp'][_POINTS], 2)} mm by the QP, {listed(last['frozen'][_POINTS], 2)} "
        "mm frozen."
    )
    return FigureRecord(
        "beyond_2_points",
        "The robot's points next to the object's centre",
        _draw_points(rows),
        rows,
        text,
    )


def reference_points_figure() -> FigureRecord:
    """Vary number and placement of the reference points of both hands."""
    subsets, places = beyond_runs.subset_rows(), beyond_runs.placement_rows()
    spread = {
        (n, r): _pick(subsets, _OBJECT, points=n, ridge=r)
        for n in beyond_runs.COUNTS
        for r in (0.0, beyond_runs.RIDGE)
    }
    objects = {
        (h, r): _mean(places, _OBJECT, human_set=h, robot_set=r)
        for h in beyond_runs.HUMAN_SETS
        for r in beyond_runs.ROBOT_SETS
    }
    best, worst = (
        min(objects, key=lambda one: objects[one]),
        max(objects, key=lambda one: objects[one]),
    )
    text = (
        "All choices of three to seven of the human's contacts, three synergies each. By the "
        "paper's least squares (ridge 0) "
        f"four contacts put the objects {np.median(spread[4, 0.0]):.1f} mm apart in the median and "
        f"{max(spread[4, 0.0]):.0f} mm "
        f"at worst, six {np.median(spread[6, 0.0]):.1f} and {max(spread[6, 0.0]):.0f} mm; three do "
        "not determine T. With a "
        f"ridge of {beyond_runs.RIDGE:g} towards the best rotation three already do "
        f"({np.median(spread[3, beyond_runs.RIDGE]):.1f} mm, at "
        f"worst {max(spread[3, beyond_runs.RIDGE]):.0f}), and the worst of four is "
        f"{max(spread[4, beyond_runs.RIDGE]):.0f} mm. As to "
        f"placement (ridge {beyond_runs.RIDGE:g}), the object's mean error over the synergies is "
        f"smallest, {objects[best]:.1f} mm, "
        f"with {words(best[0])} on the human and {words(best[1])} on the robot, and largest, "
        f"{objects[worst]:.1f} mm, with "
        f"{words(worst[0])} and {words(worst[1])}. The points' error measures how well the robot "
        "reaches `T s`. T differs from "
        "set to set, and six points are harder to reach with eight joints than three."
    )
    blank = {"human_set": "", "robot_set": "", "robot_points": 3}
    table: list[Row] = [
        {
            "human_points": row["points"],
            "contacts": row["contacts"],
            "ridge": row["ridge"],
            **blank,
            **_measured(row),
        }
        for row in subsets
    ]
    sets = ("human_set", "robot_set", "robot_points")
    table += [
        {
            "human_points": row["human_points"],
            "contacts": "",
            "ridge": beyond_runs.RIDGE,
            **{s: row[s] for s in sets},
            **_measured(row),
        }
        for row in places
    ]
    figure = _draw_reference_points(subsets, places)
    return FigureRecord(
        "beyond_3_reference_points", "Number and placement of reference points", figure, table, text
    )


def start_figure(plans: beyond_runs.Plans) -> FigureRecord:
    """Run the experiment from other start configurations, planned with a fixed seed."""
    rows = beyond_runs.start_rows(plans)
    count = len({row["human_trial"] for row in rows})
    medians = {
        (f, m): float(np.median(_pick(rows, m, fingers=f)))
        for f in ("pseudoinverse", "qp")
        for m in _LABELS
    }
    worst = {f: max(_pick(rows, _OBJECT, fingers=f)) for f in ("pseudoinverse", "qp")}
    at_reference = beyond_runs.point_rows((1.0,))
    reference = [
        _mean(at_reference, _OBJECT, fingers="pseudoinverse", synergy=s)
        for s in beyond_runs.SYNERGIES
    ]
    better = 100.0 * float(
        np.mean(
            [
                row[_OBJECT] > reference[row["synergy"] - 1]
                for row in rows
                if row["fingers"] == "pseudoinverse"
            ]
        )
    )
    text = (
        f"{count} pairs of force-closed grasps, planned with seed {beyond_runs.SEED} and paired at "
        "random, three synergies each "
        f"(ridge {beyond_runs.RIDGE:g}, since some have contacts near a plane). The object's error "
        "is "
        f"{medians['pseudoinverse', _OBJECT]:.1f} mm in the median by eq. (8) and "
        f"{worst['pseudoinverse']:.0f} mm at worst; by "
        f"the QP {medians['qp', _OBJECT]:.1f} and {worst['qp']:.0f} mm. The robot's points are "
        f"{medians['pseudoinverse', _POINTS]:.1f} and {medians['qp', _POINTS]:.1f} mm off in the "
        "median. The reference pair, "
        f"with {listed(reference)} mm, does better than {better:.0f} % of these runs."
    )
    return FigureRecord("beyond_4_start", "Starting configuration", _draw_start(rows), rows, text)


def allegro_figure(plans: beyond_runs.Plans) -> FigureRecord:
    """Compare the Allegro hand with the three-fingered one."""
    rows, scene = beyond_runs.allegro_rows(plans, GAMMAS), beyond_runs.allegro_scene(plans)
    barrett, allegro = (
        {
            (f, m): [
                _mean(rows, m, robot=robot, fingers=f, gamma=1.0, synergy=s)
                for s in beyond_runs.SYNERGIES
            ]
            for f in ("pseudoinverse", "qp", "frozen")
            for m in _LABELS
        }
        for robot in ("three_finger", "allegro_right")
    )
    fingers = sorted({contact.finger or "palm" for contact in scene.robot.contacts})
    text = (
        "The Allegro hand, 16 joints, its thumb opposed, holds the cube with "
        f"{len(scene.robot.contacts)} contacts "
        f"({', '.join(fingers)}) in the best of {beyond_runs.PLANS} planned grasps. At gamma = 1 "
        "the centres end "
        f"{listed(allegro['pseudoinverse', _OBJECT])} mm apart by eq. (8) and "
        f"{listed(allegro['qp', _OBJECT])} mm by the QP, "
        f"with the three-fingered hand {listed(barrett['pseudoinverse', _OBJECT])} mm and "
        f"{listed(barrett['qp', _OBJECT])} mm. "
        f"The points end {listed(allegro['pseudoinverse', _POINTS])} mm from `T s` by eq. (8), "
        f"{listed(allegro['qp', _POINTS])} "
        f"mm by the QP and {listed(allegro['frozen', _POINTS])} mm with frozen fingers; with the "
        "three-fingered hand "
        f"{listed(barrett['pseudoinverse', _POINTS])} mm, {listed(barrett['qp', _POINTS])} mm and "
        f"{listed(barrett['frozen', _POINTS])} mm. The two hands hold the cube at different "
        "places, so this compares grasps as "
        "much as hands."
    )
    return FigureRecord(
        "beyond_5_allegro", "The Allegro hand", _draw_allegro(rows, scene), rows, text
    )


def origin_figure() -> FigureRecord:
    """Move the scene away from the world's origin."""
    rows, nudged = beyond_runs.origin_rows(), beyond_runs.nudged_rows()
    far = max(beyond_runs.DISTANCES)
    at_origin = {
        s: _pick(rows, _OBJECT, pivot="origin", distance_m=far, synergy=s)
        for s in beyond_runs.SYNERGIES
    }
    calm = {
        pivot: [_mean(rows, _OBJECT, pivot=pivot, synergy=s) for s in beyond_runs.SYNERGIES]
        for pivot in ("centroid", "palm")
    }
    spread = max(
        float(np.ptp(_pick(rows, _OBJECT, pivot=p, synergy=s)))
        for p in calm
        for s in beyond_runs.SYNERGIES
    )
    text = (
        f"Eq. (2) read literally lets T_def act about the world's origin. With the scene {far:g} m "
        "away from it, in 14 "
        "directions, the object's error is "
        f"{listed([np.median(at_origin[s]) for s in beyond_runs.SYNERGIES], 0)} mm in the median "
        "for synergies 1 to 3 and up to "
        f"{listed([max(at_origin[s]) for s in beyond_runs.SYNERGIES], 0)} mm: there a stretch of 1 "
        "% "
        "moves a target by a centimetre. The error is also ill-conditioned: 1 m along x it is "
        f"{listed(_pick(nudged, _OBJECT, nudge_m=0.0))} mm, and 0.1 mm farther "
        f"{listed(_pick(nudged, _OBJECT, nudge_m=1e-4))} mm. "
        f"About the human points' centroid it is {listed(calm['centroid'], 2)} mm, about the human "
        "palm "
        f"{listed(calm['palm'], 2)} mm, wherever the scene is (within {1e6 * spread:.1g} nm)."
    )
    return FigureRecord("beyond_6_origin", "The world's origin", _draw_origin(rows), rows, text)


@styled
def _draw_limits(rows: list[Row]) -> Figure:
    figure, grid = _grid(2, 3, (10.0, 5.4))
    for synergy, column in zip(beyond_runs.SYNERGIES, grid.T, strict=True):
        for axes, measure in zip(column, (_POINTS, _OBJECT), strict=True):
            for fingers in ("pseudoinverse", "clipped", "damped", "qp"):
                values = _pick(rows, measure, synergy=synergy, fingers=fingers)
                _line(axes, beyond_runs.MARGINS, values, fingers)
        column[0].set_title(f"Synergy {synergy}")
        column[1].set_xlabel("room of every joint, either way [deg]")
    _finish(grid, (_POINTS, _OBJECT))
    return figure


@styled
def _draw_points(rows: list[Row]) -> Figure:
    figure, grid = _grid(2, 3, (10.0, 5.4))
    for synergy, column in zip(beyond_runs.SYNERGIES, grid.T, strict=True):
        for axes, measure in zip(column, (_POINTS, _OBJECT), strict=True):
            for fingers in ("pseudoinverse", "qp", "frozen"):
                _line(axes, GAMMAS, _pick(rows, measure, synergy=synergy, fingers=fingers), fingers)
        column[0].set_title(f"Synergy {synergy}")
        column[1].set_xlabel("gamma")
    _finish(grid, (_POINTS, _OBJECT))
    return figure


@styled
def _draw_reference_points(subsets: list[Row], places: list[Row]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
    spread = np.random.default_rng(0)
    series = (
        (0.0, -0.17, COLOURS[0], "ridge 0 (the paper)"),
        (beyond_runs.RIDGE, 0.17, COLOURS[2], f"ridge {beyond_runs.RIDGE:g}"),
    )
    for ridge, shift, colour, label in series:
        for count in beyond_runs.COUNTS:
            values = _pick(subsets, _OBJECT, points=count, ridge=ridge)
            if not values:
                left.text(
                    count + shift,
                    2.0,
                    "T unknown",
                    rotation=90,
                    ha="center",
                    color=colour,
                    fontsize=8,
                )
                continue
            left.scatter(
                count + shift + spread.uniform(-0.1, 0.1, len(values)),
                values,
                s=9,
                color=colour,
                alpha=0.45,
                linewidth=0,
            )
            left.plot(
                [count + shift - 0.13, count + shift + 0.13],
                [np.median(values)] * 2,
                color=INK,
                linewidth=1.6,
            )
        left.scatter([], [], s=14, color=colour, label=label)
    left.plot([], [], color=INK, linewidth=1.6, label="median")
    left.set_yscale("log")
    left.set_xlim(2.55, 7.45)
    left.set_xlabel("human contacts used")
    left.set_ylabel(_LABELS[_OBJECT])
    left.set_title("Number: all choices of the seven contacts")
    left.legend(loc="upper right")
    for axes, measure, title in (
        (middle, _OBJECT, "Placement: object [mm]"),
        (right, _POINTS, "Placement: points [mm]"),
    ):
        means = np.array(
            [
                [_mean(places, measure, human_set=h, robot_set=r) for r in beyond_runs.ROBOT_SETS]
                for h in beyond_runs.HUMAN_SETS
            ]
        )
        axes.imshow(means, cmap="Oranges", vmin=0.0, vmax=1.5 * means.max(), aspect="auto")
        for (i, j), value in np.ndenumerate(means):
            axes.text(j, i, f"{value:.1f}", ha="center", va="center")
        axes.set_xticks(
            range(len(beyond_runs.ROBOT_SETS)),
            labels=[_set_name(name) for name in beyond_runs.ROBOT_SETS],
        )
        axes.set_yticks(
            range(len(beyond_runs.HUMAN_SETS)),
            labels=[_set_name(name) for name in beyond_runs.HUMAN_SETS],
        )
        axes.set_xlabel("on the robot")
        axes.set_title(title)
        axes.grid(visible=False)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0.0)
    middle.set_ylabel("on the human")
    right.set_yticklabels([])
    return figure


@styled
def _draw_start(rows: list[Row]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    reference = beyond_runs.point_rows((1.0,))
    for axes, fingers in zip(panels, ("pseudoinverse", "qp"), strict=True):
        for synergy, colour in zip(beyond_runs.SYNERGIES, COLOURS, strict=False):
            points, objects = (
                _pick(rows, measure, fingers=fingers, synergy=synergy)
                for measure in (_POINTS, _OBJECT)
            )
            axes.scatter(
                points,
                objects,
                s=16,
                color=colour,
                alpha=0.7,
                linewidth=0,
                label=f"synergy {synergy}",
            )
            star = [
                _mean(reference, measure, fingers=fingers, synergy=synergy)
                for measure in (_POINTS, _OBJECT)
            ]
            axes.scatter(
                *star, s=120, color=colour, marker="*", edgecolor=INK, linewidth=0.8, zorder=3
            )
        axes.scatter(
            [],
            [],
            s=90,
            color="white",
            marker="*",
            edgecolor=INK,
            linewidth=0.8,
            label="reference pair",
        )
        axes.set_title(_FINGERS[fingers][0])
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(_LABELS[_POINTS])
    panels[0].set_ylabel(_LABELS[_OBJECT])
    # Leave room for the legend below all points.
    panels[0].set_ylim(bottom=0.25 * min(_pick(rows, _OBJECT)))
    panels[0].legend(loc="lower left", ncols=2)
    return figure


@styled
def _draw_allegro(rows: list[Row], scene: Scene) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.4))
    axes = figure.add_axes((0.0, 0.0, 0.36, 0.88))
    solid = grasp_triangles(scene.robot, scene.robot.q)
    camera = Camera.framing(
        solid.vertices.reshape(-1, 3), (576, 619), azimuth=-150.0, elevation=-20.0, margin=0.05
    )
    draw_hands(
        axes,
        solid,
        camera,
        marks=spheres(scene.robot.points, 0.0035, ROBOT_COLOUR),
        supersampling=3,
    )
    heading(
        axes,
        camera,
        "Allegro hand",
        f"{len(scene.robot.hand.joint_names)} joints, {len(scene.robot.contacts)} contacts",
    )
    for column, (measure, title) in enumerate(((_POINTS, "Points"), (_OBJECT, "Object"))):
        axes = figure.add_axes((0.43 + 0.30 * column, 0.12, 0.245, 0.76))
        for robot, style in (("three_finger", (0, (3, 2))), ("allegro_right", "-")):
            for synergy, colour in zip(beyond_runs.SYNERGIES, COLOURS, strict=False):
                values = _pick(rows, measure, robot=robot, fingers="qp", synergy=synergy)
                label = f"synergy {synergy}" if style == "-" else None
                axes.plot(
                    GAMMAS,
                    values,
                    color=colour,
                    linestyle=style,
                    linewidth=1.8 if style == "-" else 1.2,
                    label=label,
                )
        axes.plot([], [], color=PALE, linestyle="-", label="Allegro")
        axes.plot([], [], color=PALE, linestyle=(0, (3, 2)), label="three-fingered")
        axes.set_title(f"{title}, by the QP")
        axes.set_xlabel("gamma")
        axes.set_ylabel(_LABELS[measure])
        axes.set_ylim(bottom=0.0)
        if column == 0:
            axes.legend(loc="upper left")
    return figure


@styled
def _draw_origin(rows: list[Row]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 3.6), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for synergy, axes in zip(beyond_runs.SYNERGIES, panels, strict=True):
        ranges = np.array(
            [
                np.percentile(
                    _pick(rows, _OBJECT, pivot="origin", synergy=synergy, distance_m=d),
                    (0, 50, 100),
                )
                for d in beyond_runs.DISTANCES
            ]
        )
        axes.fill_between(
            beyond_runs.DISTANCES,
            ranges[:, 0],
            ranges[:, 2],
            color=COLOURS[0],
            alpha=0.18,
            linewidth=0,
        )
        axes.plot(
            beyond_runs.DISTANCES,
            ranges[:, 1],
            color=COLOURS[0],
            marker="o",
            markersize=3.5,
            label="about the origin: median, range",
        )
        for pivot, colour in (("palm", COLOURS[3]), ("centroid", COLOURS[2])):
            values = [
                _mean(rows, _OBJECT, pivot=pivot, synergy=synergy, distance_m=d)
                for d in beyond_runs.DISTANCES
            ]
            axes.plot(
                beyond_runs.DISTANCES,
                values,
                color=colour,
                marker="o",
                markersize=3.5,
                label=f"about the human's {pivot}",
            )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(beyond_runs.DISTANCES, labels=[f"{d:g}" for d in beyond_runs.DISTANCES])
        axes.minorticks_off()
        axes.set_title(f"Synergy {synergy}")
        axes.set_xlabel("scene from the world's origin [m]")
    panels[0].set_ylabel(_LABELS[_OBJECT])
    panels[0].legend(loc="upper left")
    return figure


def _grid(rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, sharex=True, sharey="row", squeeze=False)


def _line(axes: Axes, x: Iterable[float], values: list[float], fingers: str) -> None:
    label, colour, style = _FINGERS[fingers]
    axes.plot(list(x), values, color=colour, linestyle=style, label=label)


def _finish(grid: Any, measures: Iterable[str]) -> None:
    for row, measure in zip(grid, measures, strict=True):
        row[0].set_ylabel(_LABELS[measure])
        row[0].set_ylim(bottom=0.0)
    grid[0, 0].legend(loc="best")


def _set_name(name: str) -> str:
    return {
        "fingertips_middle": "tips and\nmiddle",
        "fingertips": "tips",
        "joints": "all\njoints",
    }.get(name, name)


def _matching(rows: list[Row], **wanted: Any) -> list[Row]:
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def _pick(rows: list[Row], measure: str, **wanted: Any) -> list[float]:
    return [row[measure] for row in _matching(rows, **wanted)]


def _mean(rows: list[Row], measure: str, **wanted: Any) -> float:
    return float(np.mean(_pick(rows, measure, **wanted)))


def _most(rows: list[Row], measure: str, **wanted: Any) -> float:
    return max(_pick(rows, measure, **wanted))


def _without(row: Row, *keys: str) -> Row:
    return {key: value for key, value in row.items() if key not in keys}


def _measured(row: Row) -> Row:
    return {
        key: row[key]
        for key in ("synergy", _OBJECT, _POINTS, "limit_excess_deg", "largest_stretch")
    }
