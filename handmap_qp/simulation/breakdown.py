"""Which objects are held: success rates over width, mass, friction, place and shape (`splits`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_qp.drawing.hands import require_matplotlib
from handmap_qp.simulation.pinch import PinchTrial
from handmap_qp.simulation.trials import success_rate

_QUANTITIES: dict[str, Callable[[PinchTrial], float]] = {
    "width [mm]": lambda trial: 1e3 * trial.size,
    "mass [g]": lambda trial: 1e3 * trial.mass,
    "friction": lambda trial: trial.friction,
    "displaced by [mm]": lambda trial: 1e3 * math.hypot(*trial.offset),
    "turned by [deg]": lambda trial: math.degrees(abs(trial.yaw)),
}
# Panels of the picture side by side.
_COLUMNS = 3


class Split(NamedTuple):
    """Some of the trials, alike in one quantity.

    Attributes:
        quantity: Its name, with the unit.
        values: Its range, or the name of the shape.
        members: Which trials, shape (n,).
    """

    quantity: str
    values: str
    members: np.ndarray


def splits(trials: Sequence[PinchTrial], parts: int = 3) -> list[Split]:
    """Split trials by each quantity into parts of equal numbers, and by shape.

    Quantities that all trials share are left out.

    Args:
        trials: The trials.
        parts: Number of parts; at most as many as there are different values.
    """
    found = []
    for name, quantity in _QUANTITIES.items():
        values = np.array([quantity(trial) for trial in trials])
        order = np.argsort(values, kind="stable")
        if not len(values) or np.ptp(values) < 1e-9:
            continue
        for indices in np.array_split(order, min(parts, len(np.unique(values)))):
            members = np.zeros(len(values), dtype=bool)
            members[indices] = True
            ends = f"{values[indices[0]]:.3g} - {values[indices[-1]]:.3g}"
            found.append(Split(name, ends, members))
    shapes = np.array([trial.kind for trial in trials])
    names = np.unique(shapes)
    if len(names) > 1:
        found += [Split("shape", str(name), shapes == name) for name in names]
    return found


def split_rows(
    trials: Sequence[PinchTrial], held: Mapping[str, Sequence[bool]]
) -> list[dict[str, Any]]:
    """Return the success of each mapping in each split as rows of a table.

    Args:
        trials: The trials.
        held: Which of them each mapping held, by its name.
    """
    rows = []
    for split in splits(trials):
        row: dict[str, Any] = {"of the object": f"{split.quantity} {split.values}"}
        row["trials"] = int(split.members.sum())
        for name, outcomes in held.items():
            row[f"{name}, held %"] = round(
                100.0 * float(np.mean(np.array(outcomes)[split.members]))
            )
        rows.append(row)
    return rows


def draw_splits(
    path: Path, title: str, trials: Sequence[PinchTrial], held: Mapping[str, Sequence[bool]]
) -> None:
    """Draw the success of each mapping over each quantity, with 95 % intervals.

    Args:
        path: The picture, .png.
        title: Its title.
        trials: The trials.
        held: Which of them each mapping held, by its name.

    Raises:
        MissingExtraError: If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    found = splits(trials)
    quantities = list(dict.fromkeys(split.quantity for split in found))
    rows = math.ceil(max(1, len(quantities)) / _COLUMNS)
    figure = Figure(figsize=(10.0, 0.8 + 2.6 * rows), dpi=120, layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(rows, _COLUMNS, sharey=True, squeeze=False).ravel()
    for empty in axes[len(quantities) :]:
        empty.set_axis_off()
    for panel, quantity in zip(axes, quantities, strict=False):
        members = [split for split in found if split.quantity == quantity]
        for k, (name, outcomes) in enumerate(held.items()):
            won = [np.array(outcomes)[split.members] for split in members]
            rates = np.array([success_rate(int(part.sum()), len(part)) for part in won])
            places = np.arange(len(members)) + 0.5 * (k + 0.5) / len(held) - 0.25
            errors = 100.0 * np.abs(rates[:, 1:] - rates[:, :1]).T
            panel.errorbar(places, 100.0 * rates[:, 0], errors, fmt="o", ms=4, lw=1.2, label=name)
        panel.set_xticks(range(len(members)), [split.values for split in members], fontsize=8)
        panel.set(xlabel=quantity, ylim=(0.0, 103.0))
        panel.grid(axis="y", alpha=0.3)
    for panel in axes[::_COLUMNS]:
        panel.set_ylabel("held [%]")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, fontsize=8)
    figure.savefig(path)
