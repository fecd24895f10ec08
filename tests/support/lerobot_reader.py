"""Open a data set with LeRobot itself, and print what it sees as a line of JSON.

    python tests/support/lerobot_reader.py FOLDER

It runs in an environment that has `lerobot`, which need not have this package.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from typing import Any

# This package does not depend on either.
torch: Any = import_module("torch")
LeRobotDataset: Any = import_module("lerobot.datasets.lerobot_dataset").LeRobotDataset


def main(root: str) -> None:
    """Read everything that training reads."""
    data = LeRobotDataset(repo_id="local/mapped", root=root)
    step = 1.0 / data.fps
    ahead = LeRobotDataset(
        repo_id="local/mapped",
        root=root,
        delta_timestamps={"observation.state": [-step, 0.0]},
    )
    last = LeRobotDataset(
        repo_id="local/mapped", root=root, episodes=[data.num_episodes - 1]
    )
    loader = torch.utils.data.DataLoader(ahead, batch_size=4)
    states = torch.cat([batch["observation.state"] for batch in loader])
    rows = [data[i] for i in range(len(data))]
    found = {
        "fps": data.fps,
        "episodes": data.num_episodes,
        "features": {
            name: [feature["dtype"], list(feature["shape"]), feature["names"]]
            for name, feature in data.features.items()
        },
        "state": [row["observation.state"].tolist() for row in rows],
        "action": [row["action"].tolist() for row in rows],
        "valid": [row["observation.valid"].tolist() for row in rows],
        "time": [float(row["timestamp"]) for row in rows],
        "episode": [int(row["episode_index"]) for row in rows],
        "task": [row["task"] for row in rows],
        "pairs": states.tolist(),
        "last": [int(row["index"]) for row in (last[i] for i in range(len(last)))],
        "stats": {
            name: {key: value.tolist() for key, value in stats.items()}
            for name, stats in data.meta.stats.items()
        },
        "lengths": [int(episode["length"]) for episode in data.meta.episodes],
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
