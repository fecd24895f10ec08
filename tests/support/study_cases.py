"""Made results of user studies."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from handmap_qp.apps.study.result_file import StudyFile

SEED = 17105
SCALES = ("mental", "physical", "temporal", "performance", "effort", "frustration")


def plain_result(participant: str = "p1") -> dict[str, Any]:
    """Return a valid result of one person with two trials for each mapping, as plain values."""
    return {
        "format": "handmap study",
        "version": 1,
        "participant": participant,
        "started": "2026-12-01T10:00:00Z",
        "consent": True,
        "library": "0.2.0",
        "hand": "allegro_right",
        "input": "drag",
        "mappings": {
            "A": {"name": "teleoperation"},
            "B": {"name": "finger-vectors", "kind": "recorded"},
        },
        "order": ["B", "A"],
        "trials": [
            {
                "mapping": label,
                "task": "pick a cube",
                "number": number,
                "limit": 60.0,
                "seconds": seconds,
                "is_success": True,
                "drops": 1,
            }
            for label, number, seconds in (
                ("B", 0, 12.5),
                ("B", 1, 10.0),
                ("A", 0, 14.0),
                ("A", 1, 9.0),
            )
        ],
        "workload": [
            {"mapping": label} | {name: 10.0 * i for i, name in enumerate(SCALES)}
            for label in ("B", "A")
        ],
        "preference": "A",
    }


def made_people(
    count: int,
    seed: Sequence[int],
    *,
    trials: int = 5,
    success: tuple[float, float] = (0.7, 0.7),
    slower: float = 0.0,
    practice: float = 0.0,
    spread: float = 0.15,
) -> list[dict[str, Any]]:
    """Return results of made people, of whom half begin with each mapping.

    Args:
        count: Number of people.
        seed: Seed of the random numbers.
        trials: Trials of each person with each mapping.
        success: Mean probabilities of success with A and B.
        slower: By how much B takes longer [s].
        practice: By how much the second mapping is quicker, whichever it is [s].
        spread: Standard deviation of people's probabilities of success, before they are cut.
    """
    generator = np.random.default_rng(seed)
    first = generator.permutation(np.arange(count) % 2)
    people = []
    for i in range(count):
        result = plain_result(f"p{i:04}")
        order = ["A", "B"] if first[i] else ["B", "A"]
        skill, base = generator.normal(0.0, spread), generator.normal(15.0, 3.0)
        made = []
        for place, label in enumerate(order):
            chance = np.clip(success["AB".index(label)] + skill, 0.02, 0.98)
            mean = base + slower * (label == "B") - practice * place
            made += [
                {
                    "mapping": label,
                    "task": "pick a cube",
                    "number": number,
                    "limit": 60.0,
                    "seconds": float(np.clip(generator.normal(mean, 3.0), 1.0, 60.0)),
                    "is_success": bool(generator.random() < chance),
                    "drops": int(generator.poisson(0.6)),
                }
                for number in range(trials)
            ]
        load = generator.normal(45.0, 15.0)
        answers = {
            label: np.clip(generator.normal(load, 12.0, 6), 0.0, 100.0).round()
            for label in order
        }
        result |= {
            "order": order,
            "trials": made,
            "workload": [
                {"mapping": label} | dict(zip(SCALES, own.tolist(), strict=True))
                for label, own in answers.items()
            ],
            "preference": str(generator.choice(["A", "B", "none"], p=[0.4, 0.4, 0.2])),
        }
        people.append(result)
    return people


def as_results(people: Sequence[dict[str, Any]]) -> list[StudyFile]:
    """Return typed results of plain ones."""
    return msgspec.convert(list(people), list[StudyFile])


def write_results(folder: Path, people: Sequence[dict[str, Any]]) -> list[str]:
    """Write a file for each person, and return their paths."""
    files = []
    for i, person in enumerate(people):
        file = folder / f"{i:04}.json"
        file.write_text(json.dumps(person), encoding="utf-8")
        files.append(str(file))
    return files
