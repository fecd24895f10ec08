"""The names of `plugins`: nothing is added to a saved hand."""

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import TypeVar

T = TypeVar("T")


class Plugins(Mapping[str, T]):
    """Things by name, the package's own, made at the first use."""

    def __init__(
        self, group: str, own: Callable[[], Mapping[str, T]], kind: str
    ) -> None:
        del group, kind
        self._make = own

    @cached_property
    def own(self) -> Mapping[str, T]:
        """The package's own."""
        return self._make()

    def __getitem__(self, name: str) -> T:
        """Return one by name."""
        return self.own[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.own)

    def __len__(self) -> int:
        return len(self.own)
