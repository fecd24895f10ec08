"""The hands that clients may open, loaded once and shared by all sessions."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path

from handmap_qp.errors import HandError, RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import HUMAN_HANDS, hand_names, load_hand
from handmap_qp.hands.spec import Mount, Side, read_hand_spec
from handmap_qp.service.refusals import with_field_errors
from handmap_qp.trackers.landmarks import human_name

_CACHED_HANDS = 32


class HandCache:
    """The hands that clients may open, by name.

    Sessions share a `Hand`, because it does not change. Threads may share the cache.

    Args:
        files: Further robot hands: paths of `hand.yaml` files. Clients never name paths.

    Raises:
        HandError: If one cannot be read, or two hands have the same name.
    """

    def __init__(self, files: Sequence[Path] = ()) -> None:
        self._files: dict[str, Path | str] = {
            name: name for name in hand_names() if name not in HUMAN_HANDS
        }
        for file in files:
            spec = read_hand_spec(file)
            if spec.name in self._files:
                raise HandError(
                    f"there is already a hand {spec.name!r}", file=file, key="name", value=spec.name
                )
            self._files[spec.name] = file
        self._cache: OrderedDict[Hashable, Hand] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robot hands."""
        return tuple(self._files)

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
                f"no hand {name!r:.80}; there are {', '.join(self._files)}",
                field="robot",
            )
        file = self._files[name]
        return with_field_errors(
            "robot",
            lambda: self._cached(
                (name, points, mount), lambda: load_hand(file, points=points, mount=mount)
            ),
        )

    def human(self, side: Side, points: str | None) -> Hand:
        """Return a human hand of the model's size."""
        name = human_name(side)
        return self._cached((name, points), lambda: load_hand(name, points=points))

    def _cached(self, key: Hashable, load: Callable[[], Hand]) -> Hand:
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        hand = load()
        with self._lock:
            self._cache[key] = hand
            if len(self._cache) > _CACHED_HANDS:
                self._cache.popitem(last=False)
        return hand
