"""`handmap compare`: from the words of the command line to tables, JSON and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from tyro.conf import arg

from handmap_core.errors import HandError, InvalidInputError, expect, reason_of, warn
from handmap_qp.apps.arguments import (
    HandName,
    InputArguments,
    InputFlags,
    PersonFile,
    Recordings,
    check_names,
    hinted,
)
from handmap_qp.apps.drawing import require_matplotlib
from handmap_qp.apps.drawing.contact_sheet import contact_sheet, sheet_rows
from handmap_qp.apps.tables import progress
from handmap_qp.hands import Hand, Names, Values, hand_sides, load_hand, sided_name
from handmap_qp.human import read_person
from handmap_qp.output_files import make_folder, writing
from .comparison import (
    LIMITS,
    SMOOTH,
    ComparedMethod,
    Comparison,
    Progress,
    Take,
    base_name,
    compare_methods,
    in_world_of,
    is_peer,
    outside_methods,
    own_method,
    own_methods,
    peers_program,
    prepare_take,
    with_limited,
)
from .metrics import METRICS, Metric, arising
from .poses import POSES, rank_poses
from .trajectory import package_versions
from .user_file import (
    UserCodeError as UserCodeError,
)
from .user_file import (
    UserMapping as UserMapping,
)
from .user_file import (
    is_user_file as is_user_file,
)
from .user_file import (
    read_user_mapping as read_user_mapping,
)
from .user_mapping import user_method
from .user_trajectory import file_name as file_name
from .user_trajectory import trajectory_method

FILES = ("table.md", "results.json", "metrics.png", "poses.png")
"""Files that are written."""
_COLUMNS = 8
_OWN = "#c8452f"
_OUTSIDE = "#3f6fb5"
_SAMPLE = "#b8bec6"
_STYLE = Path(__file__).with_suffix(".mplstyle")
_BAND = 6  # Methods side by side on the contact sheet; more are drawn below.
_WIDEST = 6.0  # Values beyond this multiple of the median value are drawn at the edge.
_SHOWN = ("key", "title", "unit", "better", "about")
_LEGEND = (
    "Mean over the recordings in which a question arises; `-` where it arises in none or the "
    "method has no answer. The best values are bold."
)


@dataclass(frozen=True)
class Compare:
    """Compare mapping methods on recordings of a human hand, by what the robot's hand shows.

    Maps every recording by every method, and measures fingers, object, palm, pinches and smoothness
    against the raw landmarks. Prints the means over the recordings. A left recording is mirrored
    for a right robot, and the other way round.

    --out writes table.md (overall and each recording), results.json, metrics.png (a panel for each
    metric) and poses.png (human and methods side by side in open, pointing, fist, pinches, spread).

    --peers adds retargeting libraries by others, dex-retargeting and dexi-rs: those that are
    installed, as by `pip install 'handmap-qp[peers]'` (dexi-rs; with torch and six dex-retargeting
    too), or in environments of their own, which `make peers` builds in a checkout. Hands outside
    the package are given by path; benchmarks/hands/leap_right.yaml and svh_right.yaml need
    HANDMAP_HANDS, the folder of their URDFs.

    --methods also takes one of your own, FILE.py:NAME: a method (a handmap_qp.CustomMethod), or a
    function from landmarks (21, 3) [m] to joint angles [rad]. --trajectory takes the joints of any
    program, an npz with `time` (the recording's own), `q` (T, n) [rad] and `joint_names`.

    Examples:
        handmap compare recording.npz --robot allegro_right
        handmap compare *.npz --robot allegro_right --peers --out comparison
        handmap compare a.npz b.npz --robot my_hand.yaml --methods object paper
        handmap compare demo --robot allegro_right --methods mine.py:my_joints
        handmap compare demo --robot allegro_right --trajectory q.npz

    Attributes:
        recordings: Recordings of a human hand, as in `handmap retarget`. The tracker's wrist poses
            are used where a file has them: wrist_pose, shape (T, 7), position [m] and quaternion
            wxyz.
        robot: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml; `allegro`
            is the Allegro of the first recording's side.
        methods: Methods to run: presets and other mappings by name, with +smooth for smoother
            motion, with +look-ahead for smoothing with the future too; FILE.py:NAME, or FILE.py
            if it defines one mapping. Peers may be named too, such as dexi-dexpilot; then --peers
            runs those only. With +limits, joints of peers and of a function of yours are clipped by
            the robot's limits of position and speed.
        trajectory: Joints of any program: a file for one recording, or a folder with a file for
            each, by the recording's name. See above for the arrays; a trajectory of `handmap
            retarget --out` has them.
        peers: Run the peers too, as they are and with +limits.
        peers_from: Folder of the program that runs the peers, compare.py.
        shapes: URDF of the same robot, joints and links by the same names, whose collision shapes
            measure pinches and penetration; the robot's own if omitted.
        out: Folder to write to; created if it does not exist.
        person: File of the person's hand, of `handmap calibrate`, if all recordings are of one.
        json: Print JSON instead of tables.
        inputs: How the recordings are to be read.
    """

    recordings: Recordings
    robot: HandName
    methods: Annotated[
        Names,
        hinted("METHOD...", "(default: every preset, and the first one +smooth)"),
    ] = ()
    trajectory: Annotated[tuple[Path, ...], hinted("Q.npz...")] = ()
    peers: bool = False
    peers_from: Annotated[
        Path | None,
        hinted("FOLDER", "(default: that of the package)"),
    ] = None
    shapes: Annotated[Path | None, arg(metavar="URDF")] = None
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None
    person: PersonFile = None
    json: bool = False
    inputs: InputFlags = InputArguments()

    def run(self) -> None:
        """Check everything, measure, print and write.

        Raises:
            HandmapError: If a recording, hand, method or folder cannot be used; before any mapping.
        """
        expect(self.recordings, "RECORDING", "at least one file", got="none")
        name = self.robot
        if hand_sides(name):
            name = sided_name(name, self.inputs.side_of(self.recordings[0]))
        robot = load_hand(name)
        methods = methods_of(replace(self, robot=name))
        shapes = with_urdf(robot, self.shapes) if self.shapes else None
        if self.out:
            require_matplotlib()
            make_folder(self.out, "--out")
        with progress("comparing") as say:
            takes = takes_of(self, robot, say)
            comparison = compare_methods(takes, robot, methods, say, shapes)
            written = _write(self.out, comparison, say) if self.out else []
        if self.json:
            print(msgspec.json.encode(results_of(comparison)).decode())
            return
        _print_tables(comparison)
        for note in notes_of(comparison):
            print(f"- {note}")
        for file in written:
            print(f"wrote {file}")


def markdown(comparison: Comparison) -> str:
    """Return all tables as Markdown: overall, then every recording."""
    overall = comparison.overall
    short = [metric for metric in METRICS if metric.in_short]
    parts = [
        f"# Methods on {comparison.robot.name}",
        _LEGEND,
        "## In short",
        _table("method", short, overall),
        "## Overall",
        f"{len(comparison.takes)} recordings.",
        *_tables(overall),
        "## What the columns say",
        "\n".join(f"- **{m.label}**: {m.about}; {m.hint}." for m in METRICS),
    ]
    if notes := notes_of(comparison):
        parts += ["## Notes", "\n".join(f"- {note}." for note in notes)]
    for take in comparison.takes:
        values = {run.method: run.values for run in comparison.runs if run.take is take}
        about = [
            f"{len(take.recording)} samples",
            _palm(take),
            f"contact gap {1e3 * take.human.contact_gap:.0f} mm",
            *["mirrored"] * take.is_mirrored,
        ]
        parts += [f"## {take.name}", f"{', '.join(about)}.", *_tables(values)]
    return "\n\n".join(parts) + "\n"


def notes_of(comparison: Comparison) -> list[str]:
    """Return footnotes: what methods did not do, and what was done to recordings."""
    notes = comparison.notes()
    notes.append(f"surfaces of pinches and penetration: {comparison.whose_shapes}")
    if turned := [take.name for take in comparison.takes if take.is_mirrored]:
        notes.append(f"{_mirrored(comparison.robot)}: {', '.join(turned)}")
    if fitted := [take.name for take in comparison.takes if not take.has_wrist]:
        text = "palm fitted to its landmarks, without a tracker's wrist"
        notes.append(f"{text}: {', '.join(fitted)}")
    if pinches := _pinch_samples(comparison):
        what = "samples of pinches (tips nearer than 15 mm) of fingers that"
        found = [f"{count} in {name}" for name, count in pinches.items() if count]
        shown = ", ".join(found) or "none"
        notes.append(f"{what} {comparison.robot.name} has: {shown}")
    return notes


def results_of(comparison: Comparison) -> Values:
    """Return everything that was measured as plain values; JSON has null for NaN.

    Returns:
        `robot`, `versions`, `metrics`, `recordings`, `methods` (each with `about`), `overall`
        (by method and metric), `runs` (by recording and method: `values`, `fingers`, `problem`) and
        `notes`.
    """
    pinches = _pinch_samples(comparison)
    methods = {method: {"about": ""} for method in comparison.methods}
    runs = {take.name: {} for take in comparison.takes}
    for run in comparison.runs:
        if run.motion:
            methods[run.method] = {"about": run.motion.about}
        runs[run.take.name][run.method] = {
            "values": run.values,
            "fingers": run.fingers,
            "problem": run.problem,
        }
    found = {
        "robot": comparison.robot.name,
        "versions": dict(map(str.split, package_versions())),
        "metrics": [{key: getattr(m, key) for key in _SHOWN} for m in METRICS],
        "recordings": [
            {
                "name": take.name,
                "samples": len(take.recording),
                "valid": take.recording.valid.sum(),
                "is_mirrored": take.is_mirrored,
                "palm": _palm(take),
                "contact_gap_mm": 1e3 * take.human.contact_gap,
                "pinch_samples": pinches.get(take.name, 0),
            }
            for take in comparison.takes
        ],
        "methods": methods,
        "overall": comparison.overall,
        "runs": runs,
        "notes": notes_of(comparison),
    }
    return msgspec.to_builtins(found, enc_hook=np.generic.item)


def methods_of(request: Compare) -> list[ComparedMethod]:
    """Return the methods by their names, peers in both forms last unless they are named."""
    outside = {}
    if request.peers or any(map(is_peer, request.methods)):
        folder = request.peers_from or peers_program()
        outside = with_limited(outside_methods(folder, request.robot))
    first, *others = own_methods()
    names = request.methods or (first, first + SMOOTH, *others)
    if request.peers and outside.keys().isdisjoint(names):
        names = (*names, *outside)
    methods = [
        user_method(name)
        if is_user_file(base_name(name).removesuffix(LIMITS))
        else outside.get(name) or own_method(name, tuple(outside))
        for name in names
    ]
    return [*methods, *map(trajectory_method, request.trajectory)]


def takes_of(request: Compare, robot: Hand, say: Progress) -> list[Take]:
    """Read all recordings before any is prepared."""
    person = read_person(request.person) if request.person else None
    side = robot.side
    # All methods, of others too, are given the robot's world, and are measured there.
    recordings = [
        in_world_of(robot, request.inputs.read(file, side))
        for file in request.recordings
    ]
    check_names(
        "RECORDING", [one.name for one in recordings], "files of different names"
    )
    if turned := [one.name for one in recordings if one.side != side]:
        warn(f"{_mirrored(robot)}: {', '.join(turned)}")
    takes = []
    for i, recording in enumerate(recordings):
        say(i, f"measuring the hand of {recording.name} ({i} of {len(recordings)})")
        takes.append(prepare_take(recording, side, person=person))
    return takes


def with_urdf(hand: Hand, urdf: Path) -> Hand:
    """Return the same hand by another URDF, for its shapes.

    Args:
        hand: The hand, whose hand.yaml names points on links.
        urdf: A URDF with the same movable joints by name, and the same links.

    Returns:
        The hand, with joints in the same order.

    Raises:
        InvalidInputError: If the file cannot be read, or has other joints, or lacks a link that
            hand.yaml names.
    """
    spec = msgspec.structs.replace(hand.spec, urdf=str(urdf.absolute()))
    try:
        return Hand(spec, mount=hand.mount)
    except HandError as error:
        raise InvalidInputError(
            argument="--shapes",
            expected=f"a URDF with the joints and links of {hand.name}",
            got=f"{urdf}: {reason_of(error)}",
        ) from error


def _print_tables(comparison: Comparison) -> None:
    """Print a table of methods for each group."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    overall = comparison.overall
    for group, metrics in arising(overall.values()):
        table = Table(box=None, header_style="bold")
        # In a narrow terminal a long name of a user's file breaks, and numbers stay whole.
        table.add_column("method", overflow="fold")
        for metric in metrics:
            heading = f"{metric.title} {metric.unit}".split()
            table.add_column("\n".join(heading), justify="right", no_wrap=True)
        for method, row in overall.items():
            table.add_row(method, *(m.text(row[m.key]) for m in metrics))
        console.print(f"{group}, {comparison.robot.name}", style="bold")
        console.print(table)
        console.print()


def _write(
    out: Path,
    comparison: Comparison,
    say: Progress,
) -> list[Path]:
    """Write all files, and return those that were written."""
    files = [out / name for name in FILES]
    table, results, metrics, poses = files
    with writing(out, "--out"):
        table.write_text(markdown(comparison), encoding="utf-8")
        text = msgspec.json.encode(results_of(comparison))
        results.write_bytes(msgspec.json.format(text, indent=1) + b"\n")
        say(0, "drawing metrics (0 of 2)")
        draw_metrics(metrics, comparison)
        say(1, "drawing poses (1 of 2)")
        poses.unlink(missing_ok=True)
        missing = draw_poses(poses, comparison)
    if not poses.exists():
        warn(f"no contact sheet; not shown: {', '.join(missing)}")
        files.remove(poses)
    return files


def _pinch_samples(comparison: Comparison) -> dict[str, int]:
    """Return how many samples the pinch metrics rest on, by recording; empty if nothing ran."""
    return {run.take.name: run.pinch_samples for run in comparison.runs if run.motion}


def _tables(values: dict[str, Values]) -> list[str]:
    """Return a table for every group that arises, with a row for every method."""
    return [_table(*group, values) for group in arising(values.values())]


def _table(
    title: str,
    metrics: Sequence[Metric],
    values: dict[str, Values],
) -> str:
    """Return a table with a row for every method."""
    columns = [(title, *values)]
    for metric in metrics:
        numbers = [row[metric.key] for row in values.values()]
        texts = [metric.text(number) for number in numbers]
        for i in metric.best(numbers):
            texts[i] = f"**{texts[i]}**"
        columns.append((metric.label, *texts))
    rows = [f"| {' | '.join(line)} |" for line in zip(*columns, strict=True)]
    rows.insert(1, "|---|" + "---:|" * len(metrics))
    return "\n".join(rows)


def _mirrored(robot: Hand) -> str:
    return f"mirrored, because {robot.name} is a {robot.side} hand"


def _palm(take: Take) -> str:
    return "palm of the tracker" if take.has_wrist else "palm fitted to its landmarks"


def draw_metrics(file: Path, comparison: Comparison) -> None:
    """Draw a PNG file: a panel for every metric, with large dots for methods, small for recordings.

    Raises:
        MissingExtraError: If matplotlib is not installed.
    """
    with require_matplotlib().rc_context(fname=_STYLE):
        from matplotlib.figure import Figure

        groups = dict(arising(comparison.overall.values()))
        metrics = sum(groups.values(), ())
        rows = ceil(len(metrics) / _COLUMNS)
        height = 0.75 + 0.165 * len(comparison.methods)
        figure = Figure(figsize=(18.5, rows * height + 0.8))
        for i, metric in enumerate(metrics):
            panel = figure.add_subplot(rows, _COLUMNS, i + 1)
            _draw_panel(panel, metric, comparison, has_names=i % _COLUMNS == 0)
        figure.suptitle(
            f"{comparison.robot.name}: large dots for the mean over recordings "
            f"({len(comparison.takes)}), small for each; filled: best. Arrows: beyond the panel.",
        )
        figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.985))
        figure.savefig(file)


def draw_poses(file: Path, comparison: Comparison) -> list[str]:
    """Draw the contact sheet: each pose as the recording that shows it most clearly has it.

    Six methods are side by side; further ones are below, beside the human again.

    Methods that failed on one of those recordings are left out. No file is written if no recording
    shows a pose or no method could be drawn.

    Returns:
        Names of the poses and methods that are not on it.

    Raises:
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    shown = _clearest(comparison)
    q = {(run.method, run.take): run.motion.q for run in comparison.runs if run.motion}
    drawn = [
        method
        for method in comparison.methods
        if all((method, take) in q for take, _ in shown.values())
    ]
    names = (*POSES, *comparison.methods)
    missing = [name for name in names if name not in {*shown, *drawn}]
    if not shown or not drawn:
        return missing
    matplotlib = require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    footnote = f"Not shown: {', '.join(missing)}." if missing else ""
    bands = []
    for first in range(0, len(drawn), _BAND):
        methods = drawn[first : first + _BAND]
        rows = []
        for pose, (take, index) in shown.items():
            recording = take.recording
            motions = [q[method, take] for method in methods]
            (row,) = sheet_rows(recording, {pose: index}, motions)
            name = recording.name.replace("_", " ").removesuffix(f" {recording.side}")
            rows.append(row._replace(note=f"{name}\n{row.note}"))
        figure = contact_sheet(
            [(method, comparison.robot) for method in methods],
            rows,
            side=comparison.robot.side,
            title=comparison.robot.name,
            footnote=footnote,
        )
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        bands.append(np.asarray(canvas.buffer_rgba())[..., :3])
    # One below the other, on white.
    width = bands[0].shape[1]
    padded = [
        np.pad(band, ((0, 0), (0, width - band.shape[1]), (0, 0)), constant_values=255)
        for band in bands
    ]
    matplotlib.image.imsave(file, np.concatenate(padded))
    return missing


def _clearest(comparison: Comparison) -> dict[str, tuple[Take, int]]:
    """Return the take and the sample that show each pose most clearly, of the poses shown."""
    ranked = [(take, rank_poses(take.recording)) for take in comparison.takes]
    places = {}
    for pose in POSES:
        shown = [(*found, take) for take, poses in ranked if (found := poses[pose])]
        if shown:
            index, _, take = max(shown, key=itemgetter(1))
            places[pose] = take, index
    return places


def _draw_panel(
    panel: Any,
    metric: Metric,
    comparison: Comparison,
    *,
    has_names: bool,
) -> None:
    """Draw one metric: methods from top to bottom."""
    methods = comparison.methods
    means = [row[metric.key] for row in comparison.overall.values()]
    best = metric.best(means)
    low, high = _range(metric, means)
    for y, method in enumerate(methods):
        colour = _OWN if base_name(method) in own_methods() else _OUTSIDE
        values = [run.values[metric.key] for run in comparison.of_method(method)]
        panel.plot(
            np.clip(values, low, high),
            [y] * len(values),
            ".",
            ms=3,
            color=_SAMPLE,
            zorder=1,
        )
        if np.isnan(means[y]):
            panel.text(low, y, " -", va="center", color=colour)
            continue
        is_beyond = not low <= means[y] <= high
        panel.plot(
            np.clip(means[y], low, high),
            y,
            ">" if is_beyond else "o",
            ms=5.5,
            color=colour,
            mfc=colour if y in best or is_beyond else "white",
            mew=1.3,
            zorder=3,
            clip_on=False,
        )
    panel.set_xlim(low, high + 0.02 * (high - low))
    panel.set_ylim(len(methods) - 0.4, -0.6)
    panel.set_yticks(range(len(methods)), methods if has_names else [""] * len(methods))
    panel.set_title(metric.label)
    panel.text(
        0.0,
        1.005,
        metric.hint,
        transform=panel.transAxes,
        fontsize=6.3,
        color="#6b7280",
    )


def _range(metric: Metric, means: list[float]) -> tuple[float, float]:
    """Return the limits of a panel that shows most methods, without being stretched by one."""
    finite = np.array(means)[np.isfinite(means)]
    if not len(finite):
        return 0.0, 1.0
    low = min(0.0, finite.min())
    high = finite.max()
    middle = np.median(np.abs(finite))
    if metric.better == "high":
        high = max(high, 1.0) if high > 0.5 else high
    elif middle > 0.0:
        high = min(high, _WIDEST * middle)
    return low, high * 1.03 if high > low else low + 1.0
