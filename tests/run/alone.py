"""What `handmap_run` does alone: it follows the samples of each case in a folder.

    python alone.py FOLDER        # CASE.hand and CASE.npz become CASE.out.npz

Nothing that a robot's computer lacks can be imported. Prints one JSON object: versions, CPU times
and the modules that were imported. Runs with numpy 1.26 as well.
"""

import json
import sys
import time
from pathlib import Path

ABSENT = (
    *(
        "daqp",
        "coal",
        "handmap_qp",
        "lazy_loader",
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


def columns_of(follower, samples, kind):
    """Return what a follower commands for the samples of a case, as columns by name."""
    import numpy as np

    rows, every_margin = [], []
    for time_, landmarks, wrist, valid, confidence in zip(
        *(
            samples[name]
            for name in ("time", "landmarks", "wrist", "valid", "confidence")
        ),
        strict=True,
    ):
        sample = kind(
            float(time_),
            str(samples["side"]),
            landmarks,
            wrist if "wrist" in samples["has"] else None,
            bool(valid),
            float(confidence),
        )
        step = follower.map_sample(sample)
        problem = step.finding.problem if step.finding else ""
        # A sample that is held asks for nothing.
        margins = () if step.asked.margins is None else step.asked.margins
        about = str(step.is_held), str(step.is_gliding), str(len(margins))
        said = step.status, step.rule, problem, *about
        rows.append((step.command.q, step.command.wrist, step.targets, said))
        every_margin.extend(margins)
    columns = map(np.array, zip(*rows, strict=True))
    found = dict(zip(("q", "wrist", "targets", "said"), columns, strict=True))
    return found | {"margins": np.array(every_margin)}


def main(folder):
    """Follow every case."""
    sys.meta_path.insert(0, Alone())
    import handmap_run
    import numpy as np

    found = {
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "load_s": [],
        "sample_us": [],
    }
    for file in sorted(folder.glob("*.hand")):
        started = time.process_time()
        follower = handmap_run.load(file)
        found["load_s"].append(time.process_time() - started)
        with np.load(file.with_suffix(".npz")) as archive:
            samples = {name: archive[name] for name in archive.files}
        started = time.process_time()
        columns = columns_of(follower, samples, handmap_run.HumanSample)
        each = (time.process_time() - started) / len(columns["q"])
        found["sample_us"].append(1e6 * each)
        np.savez(file.with_suffix(".out.npz"), **columns)
    import handmap_run.client

    found["modules"] = sorted({name.partition(".")[0] for name in sys.modules})
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
