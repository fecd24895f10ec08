"""What `handmap_core.run` does alone: it follows the samples of each case in a folder.

    python alone.py FOLDER        # CASE.hand and CASE.SIDE.npz become CASE.out.npz

CASE.measured.npy has the joints that are measured before each sample, for a case that grips.

Nothing that a robot's computer lacks can be imported. Prints one JSON object: versions, CPU times
and the modules that were imported. Runs with numpy 1.26 as well.
"""

import json
import sys
import time
from itertools import repeat
from pathlib import Path

ABSENT = (
    *(
        "daqp",
        "coal",
        "handmap_qp",
        "mink",
        "mujoco",
        "osqp",
        "pinocchio",
    ),
    *("proxsuite", "qpsolvers", "rich", "scipy", "tyro", "yaml", "yourdfpy"),
)


class Alone:
    """Finds nothing of what is absent on a robot's computer."""

    def find_spec(self, name, *_):
        if name.partition(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"{name} is absent here", name=name)


SIDES = ("left", "right")


def samples_of(file, kind):
    """Yield the samples of a case: what a hand's follower takes, or a robot's, by side."""
    import numpy as np

    hands = {}
    for side in SIDES:
        columns = file.with_suffix(f".{side}.npz")
        if columns.exists():
            with np.load(columns) as archive:
                hands[side] = dict(archive)
    for i in range(max(len(columns["time"]) for columns in hands.values())):
        samples = {
            side: kind(
                float(columns["time"][i]),
                side,
                columns["landmarks"][i],
                columns["wrist"][i] if columns["has_wrist"] else None,
                bool(columns["valid"][i]),
                float(columns["confidence"][i]),
            )
            for side, columns in hands.items()
            if i < len(columns["time"])
        }
        yield samples if len(hands) > 1 else next(iter(samples.values()))


def measured_of(file):
    """Return what a follower is told of the robot before each sample, by name."""
    import numpy as np

    measured = file.with_suffix(".measured.npy")
    if not measured.exists():
        return repeat({})
    return [{"measured_q": q} for q in np.load(measured)]


def columns_of(follow, samples, measured):
    """Return what a follower commands for the samples of a case, as columns by name."""
    import numpy as np

    rows, every_margin, every_effort = [], [], []
    # Measurements repeat without end where there are none.
    for sample, told in zip(samples, measured):  # noqa: B905
        step = follow(sample, **told)
        said = []
        for part in (step, *getattr(step, "hands", {}).values()):
            problem = part.finding.problem if part.finding else ""
            # A sample that is held asks for nothing.
            margins = () if part.asked.margins is None else part.asked.margins
            about = str(part.is_held), str(part.is_gliding), str(len(margins))
            said += [part.status, part.rule, problem, *about]
            every_margin.extend(margins)
        command = step.command
        effort = np.zeros(0) if command.effort is None else command.effort
        said.append(str(len(effort)))
        every_effort.extend(effort)
        rows.append((command.q, command.wrist, step.targets, said))
    columns = map(np.array, zip(*rows, strict=True))
    found = dict(zip(("q", "wrist", "targets", "said"), columns, strict=True))
    found["effort"] = np.array(every_effort)
    return found | {"margins": np.array(every_margin)}


def main(folder):
    """Follow every case."""
    sys.meta_path.insert(0, Alone())
    import numpy as np

    from handmap_core.run import HumanSample, load, load_robot

    # Seconds to load, and microseconds a sample, of each case.
    times = {"hand": [], "robot": []}
    for file in sorted(folder.glob("*.hand")):
        is_robot = all(file.with_suffix(f".{side}.npz").exists() for side in SIDES)
        started = time.process_time()
        follow = load_robot(file).map_samples if is_robot else load(file).map_sample
        loaded = time.process_time()
        samples = [*samples_of(file, HumanSample)]
        began = time.process_time()
        columns = columns_of(follow, samples, measured_of(file))
        each = 1e6 * (time.process_time() - began) / len(samples)
        times["robot" if is_robot else "hand"].append((loaded - started, each))
        np.savez(file.with_suffix(".out.npz"), **columns)
    import handmap_core.client  # noqa: F401

    found = {
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "times": times,
        "modules": sorted({name.partition(".")[0] for name in sys.modules}),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
