"""Hours of landmarks: from arrays to a LeRobot data set, which is read back.

The arrays are made of the recording that comes with the package, played to and fro. How long 100
hours take on this machine is computed from the rate of a few minutes.
"""

from __future__ import annotations

import json
import time

from paths.fresh import Fresh, stop

ROBOT = "leap_right"
FILES, MINUTES, FPS = 8, 1, 30
HOURS = 100
_MAKE = """
import sys
import numpy as np
from handmap_qp import read_recording

files, frames, fps = map(int, sys.argv[1:])
hand = read_recording("demo", "right")
landmarks = hand.landmarks[hand.valid]
there_and_back = np.concatenate([landmarks, landmarks[::-1]])
for i in range(files):
    # Everybody's hand is another size.
    taken = (0.9 + 0.02 * i) * np.resize(there_and_back, (frames, 21, 3))
    np.save(f"take{i:02}.npy", taken)
    time = np.arange(frames) / fps
    np.savez(f"takes/take{i:02}.npz", time=time, landmarks=taken, handedness="right")
"""
_READ = """
import json
import sys
from pathlib import Path
import numpy as np
from pyarrow import parquet
from handmap_qp import load_hand

root, robot = Path(sys.argv[1]), load_hand(sys.argv[2])
info = json.loads((root / "meta" / "info.json").read_text())
table = parquet.read_table(root / "data")
state = np.array(table["observation.state"].to_pylist())
names = info["features"]["observation.state"]["names"]
q = state[:, [names.index(name) for name in robot.joint_names]]
outside = np.maximum(robot.lower_limits - q, q - robot.upper_limits).max()
print(json.dumps({
    "version": info["codebase_version"], "episodes": info["total_episodes"],
    "frames": len(state), "fps": info["fps"], "numbers": state.shape[1],
    "is_finite": bool(np.isfinite(state).all()), "outside": max(0.0, float(outside)),
    "moved": float(np.ptp(q, axis=0).max()),
}))
"""


def main() -> None:
    """Go the path."""
    frames = MINUTES * 60 * FPS
    with Fresh("Hours of landmarks", "plot", "files") as path:
        (path.work / "takes").mkdir()
        with path.step(f"{FILES} recordings of {MINUTES} min at {FPS} Hz"):
            path.python(_MAKE, str(FILES), str(frames), str(FPS))
        if refused := path.refusal("convert", "take00.npy", "plain.npz"):
            path.leave_out(
                "plain .npy arrays", f"{refused}; the same as .npz with time below"
            )
        path.handmap("convert", "takes/take00.npz", "human")
        words = (
            "batch",
            "takes",
            "--robot",
            ROBOT,
            "--out",
            "mapped",
            "--format",
            "lerobot",
        )
        started = time.monotonic()
        path.handmap(*words)
        rate = FILES * frames / (time.monotonic() - started)
        path.note(
            f"{rate:.0f} frames a second: {HOURS} hours at {FPS} Hz take "
            f"{HOURS * FPS / rate:.1f} h on this machine as busy as it is"
        )
        path.handmap(*words)
        with path.step("the data set is read back by pyarrow"):
            found = json.loads(path.python(_READ, "mapped/lerobot", ROBOT))
        path.note(", ".join(f"{name} {value}" for name, value in found.items()))
        expected = (FILES, FILES * frames, True)
        if (found["episodes"], found["frames"], found["is_finite"]) != expected:
            stop(f"the data set is another one: expected {expected}")
        if found["outside"] > 1e-6 or found["moved"] < 0.5:
            stop("the robot leaves its limits, or does not move")
        path.leave_out(
            "LeRobot itself", "it needs torch; tests/datasets/test_lerobot.py opens it"
        )


if __name__ == "__main__":
    main()
