"""The hands that clients may open, loaded once and shared by all sessions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from handmap_qp.errors import HandError, RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import HUMAN_HANDS, hand_files, load_hand, missing_hands
from handmap_qp.hands.spec import Mount, Side, read_hand_spec
from handmap_qp.human.landmarks import human_name
from handmap_qp.service.refusals import with_field_errors

_CACHED_HANDS = 32


class HandCache:
    """The hands that clients may open, by name.

    Sessions share a `Hand`, because it does not change. Threads may share the cache.

    Args:
        files: Further robot hands: paths of `hand.yaml` files. Clients never name paths.

    Raises:
        HandError: If one cannot be read, or two hands have the same name.

    Attributes:
        missing: Why each hand that is not installed cannot be opened, by name.
    """

    def __init__(self, files: Sequence[Path] = ()) -> None:
        self._files = {name: file for name, file in hand_files().items() if name not in HUMAN_HANDS}
        self.missing = missing_hands()
        for file in files:
            spec = read_hand_spec(file)
            if spec.name in self.robots:
                raise HandError(
                    f"there is already a hand {spec.name!r}", file=file, key="name", value=spec.name
                )
            self._files[spec.name] = file
            self.missing.pop(spec.name, None)
        self._load = lru_cache(maxsize=_CACHED_HANDS)(load_hand)

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robot hands that are installed."""
        return tuple(name for name in self._files if name not in self.missing)

    def robot(self, name: str, points: str | None, mount: Mount | None) -> Hand:
        """Return a robot hand.

        Args:
            name: Its name.
            points: Set of reference points; the hand's own if None.
            mount: How its wrist is mounted; as in the description if None.

        Raises:
            RefusedError: If no hand has this name, or it cannot be loaded so.
        """
        if name not in self._files:
            raise RefusedError(
                "invalid",
                f"no hand {name!r:.80}; there are {', '.join(self.robots)}",
                field="robot",
            )
        file = self._files[name]
        return with_field_errors("robot", lambda: self._load(file, points=points, mount=mount))

    def human(self, side: Side, points: str | None) -> Hand:
        """Return a human hand of the model's size."""
        return self._load(human_name(side), points=points)
