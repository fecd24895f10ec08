"""Which objects are held: success of pinches over width, mass, friction, place and shape.

    handmap simulate pinch.npz --robot allegro_right --trials 200 --json > held.json
    python benchmarks held_objects held.json --picture held.png

Trials are split by each quantity into three parts of equal numbers, and by shape. Quantities that
all trials share are left out.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from handmap_qp.apps.simulation.pinch_rows import success_rate
from handmap_qp.apps.tables import print_rows

QUANTITIES: dict[str, Callable[[dict[str, Any]], float]] = {
    "width [mm]": lambda trial: 1e3 * trial["width"],
    "mass [g]": lambda trial: 1e3 * trial["mass"],
    "friction": lambda trial: trial["friction"],
    "displaced by [mm]": lambda trial: 1e3 * math.hypot(*trial["offset"]),
    "turned by [deg]": lambda trial: math.degrees(abs(trial["yaw"])),
}
_PARTS, _COLUMNS = 3, 3


def splits(trials: Sequence[dict[str, Any]]) -> list[tuple[str, str, np.ndarray]]:
    """Return parts of the trials: quantity, range or shape, and the indices of the trials."""
    found = []
    for name, quantity in QUANTITIES.items():
        values = np.array([quantity(trial) for trial in trials])
        if np.ptp(values) < 1e-9:
            continue
        order = np.argsort(values, kind="stable")
        for part in np.array_split(order, min(_PARTS, len(np.unique(values)))):
            found.append(
                (name, f"{values[part[0]]:.3g} - {values[part[-1]]:.3g}", part)
            )
    shapes = np.array([trial["shape"] for trial in trials])
    names = np.unique(shapes)
    if len(names) > 1:
        found += [
            ("shape", str(name), np.flatnonzero(shapes == name)) for name in names
        ]
    return found


def draw(
    path: Path, title: str, parts: list, names: list[str], held: np.ndarray
) -> None:
    """Draw the success of each mapping over each quantity, with 95 % intervals."""
    quantities = list(dict.fromkeys(quantity for quantity, _, _ in parts))
    rows = math.ceil(max(1, len(quantities)) / _COLUMNS)
    figure = Figure(figsize=(10.0, 0.8 + 2.6 * rows), dpi=120, layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(rows, _COLUMNS, sharey=True, squeeze=False).ravel()
    for empty in axes[len(quantities) :]:
        empty.set_axis_off()
    for panel, quantity in zip(axes, quantities, strict=False):
        own = [(values, part) for name, values, part in parts if name == quantity]
        for k, name in enumerate(names):
            won = [held[part, k] for _, part in own]
            rates = 100.0 * np.array([success_rate(int(w.sum()), len(w)) for w in won])
            places = np.arange(len(own)) + 0.5 * (k + 0.5) / len(names) - 0.25
            errors = np.abs(rates[:, 1:] - rates[:, :1]).T
            panel.errorbar(
                places, rates[:, 0], errors, fmt="o", ms=4, lw=1.2, label=name
            )
        panel.set_xticks(range(len(own)), [values for values, _ in own], fontsize=8)
        panel.set(xlabel=quantity, ylim=(0.0, 103.0))
        panel.grid(axis="y", alpha=0.3)
    for panel in axes[::_COLUMNS]:
        panel.set_ylabel("held [%]")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4
    )
    figure.savefig(path)


def main() -> None:
    """Read the trials, print the table, and draw it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "trials", type=Path, help="output of handmap simulate --trials --json"
    )
    parser.add_argument("--picture", type=Path, help="picture to write, .png")
    given = parser.parse_args()
    found = json.loads(given.trials.read_text(encoding="utf-8"))
    trials, names = found["trials"], [row["mapping"] for row in found["rows"]]
    held = np.array([[name in trial["held"] for name in names] for trial in trials])
    parts, rows = splits(trials), []
    for quantity, values, part in parts:
        row: dict[str, Any] = {
            "of the object": f"{quantity} {values}",
            "trials": len(part),
        }
        for k, name in enumerate(names):
            row[f"{name}, held %"] = round(100.0 * float(held[part, k].mean()))
        rows.append(row)
    print_rows("Which objects are held", rows)
    if given.picture is not None:
        title = f"{found['robot']}: {len(trials)} pinches, seed {found['seed']}"
        draw(given.picture, title, parts, names, held)


if __name__ == "__main__":
    main()
