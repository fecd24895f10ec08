"""What mappings make of many objects: `try_all`, `tried_row`, `loss_rows`."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from handmap_core.errors import InvalidInputError, reason_of
from handmap_qp.apps.tables import Row, progress
from .pinch import PinchOutcome, PinchScene, PinchTrial
from .pinch_rows import OUTCOME_COLUMNS, outcome_row, success_rate, trial_row

REFUSED = "refused: no clear start"
"""Why an object was not tried, in the words of tables."""


class Tried(NamedTuple):
    """What one mapping made of all objects.

    Attributes:
        outcomes: What became of them, by their index.
        refusals: Why the others could not be tried, by their index.
    """

    outcomes: dict[int, PinchOutcome]
    refusals: dict[int, InvalidInputError]

    @property
    def held(self) -> list[int]:
        """Indices of the objects that were held."""
        return [i for i, outcome in self.outcomes.items() if outcome.is_held]

    @property
    def losses(self) -> dict[str, int]:
        """How many were not held, by the cause, the most frequent one first."""
        causes = [outcome.loss for outcome in self.outcomes.values() if outcome.loss]
        counted = Counter(map(str, causes)).most_common()
        return dict(counted) | ({REFUSED: len(self.refusals)} if self.refusals else {})


def try_all(name: str, scene: PinchScene, trials: Sequence[PinchTrial]) -> Tried:
    """Pinch every object by one mapping, with a progress bar."""
    tried = Tried({}, {})
    with progress(name, len(trials)) as advance:
        for i, trial in enumerate(trials):
            try:
                tried.outcomes[i] = scene.run(trial)
            except InvalidInputError as error:
                tried.refusals[i] = error
            advance(i + 1, f"({len(tried.held)} held)")
    return tried


def single_row(name: str, tried: Tried) -> Row:
    """Describe what one mapping made of a single object in a row of a table."""
    if tried.outcomes:
        return outcome_row(name, tried.outcomes[0])
    return (
        {"mapping": name}
        | dict.fromkeys(OUTCOME_COLUMNS, "-")
        | {
            "held": "refused",
            "why not": reason_of(tried.refusals[0]),
        }
    )


def in_the_way_cell(outcomes: Mapping[str, PinchOutcome]) -> Row:
    """Describe which fingers passed through a single object; no cell if none did.

    Args:
        outcomes: What became of it, by the mappings' names.
    """
    fingers = [
        f"{', '.join(outcome.in_the_way)} ({name})"
        for name, outcome in outcomes.items()
        if outcome.in_the_way
    ]
    if not fingers:
        return {}
    says = "in the object's place before the pads meet; touches it once it has left"
    return {"finger in the way": f"{'; '.join(fingers)}: {says}"}


def tried_row(name: str, tried: Tried) -> Row:
    """Summarise the trials of one mapping in a row of a table."""
    drawn = len(tried.outcomes) + len(tried.refusals)
    rate, low, high = success_rate(len(tried.held), drawn)
    return trial_row(name, [*tried.outcomes.values()]) | {
        "refused": len(tried.refusals),
        "held % of all": round(100.0 * rate, 1),
        "95 % interval of all": f"{100.0 * low:.0f}-{100.0 * high:.0f}",
    }


def loss_rows(tried: Mapping[str, Tried]) -> list[Row]:
    """Return how many objects each mapping lost by each cause, in rows of a table."""
    total: Counter[str] = Counter()
    for one in tried.values():
        total.update(one.losses)
    causes = [cause for cause, _ in total.most_common()]
    return [
        {"why not held": cause}
        | {name: one.losses.get(cause, 0) for name, one in tried.items()}
        for cause in causes
    ]


def fates(
    tried: Mapping[str, Tried], trial: int
) -> dict[str, list[str] | dict[str, str]]:
    """Return by the mappings' names who tried one object, who held it, and why others did not."""
    return {
        "tried": [name for name, one in tried.items() if trial in one.outcomes],
        "held": [name for name, one in tried.items() if trial in one.held],
        "lost": {
            name: str(loss)
            for name, one in tried.items()
            if trial in one.outcomes and (loss := one.outcomes[trial].loss)
        },
        "refused": {
            name: reason_of(one.refusals[trial])
            for name, one in tried.items()
            if trial in one.refusals
        },
    }
