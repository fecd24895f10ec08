"""What the package offers by name, and what other packages add to it by their entry points.

A package adds to a group in its `pyproject.toml`, and needs no change here:

    [project.entry-points."handmap_qp.presets"]
    my-method = "my_package.my_method:PRESET"
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

from handmap_core.errors import HandmapError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")


class PluginError(HandmapError):
    """An entry point of another package cannot be used."""


class Plugins(Mapping[str, T]):
    """Things by name: the package's own first, then those of other packages in their order.

    Other packages are searched for only where a name is not the package's own, or all are asked
    for: that takes some 10 ms. A thing that cannot be used is not listed; asked for by its name, it
    raises the error that says why.

    Args:
        group: Group of the entry points.
        own: Makes the package's own things, at the first use.
        kind: Class of all of them, as `module:name`; imported when another package has one.
        others: Other names of some, which are not listed.
    """

    def __init__(
        self,
        group: str,
        own: Callable[[], Mapping[str, T]],
        kind: str,
        **others: str,
    ) -> None:
        self._names = others
        self._group = group
        self._make = own
        self._kind = kind

    @cached_property
    def own(self) -> Mapping[str, T]:
        """The package's own."""
        return self._make()

    @cached_property
    def _others(self) -> dict[str, EntryPoint]:
        # Takes a third of the time in which all else here is imported.
        from importlib.metadata import entry_points

        found = entry_points(group=self._group)
        return {point.name: point for point in found if point.name not in self.own}

    def __getitem__(self, name: str) -> T:
        """Return one by name; see `Plugins`.

        Raises:
            KeyError: If there is none.
            PluginError: If that of another package cannot be used.
        """
        name = self._names.get(name, name)
        return self.own[name] if name in self.own else self._load(self._others[name])

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        for name, point in self._others.items():
            with suppress(PluginError):
                self._load(point)
                yield name

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _load(self, point: EntryPoint) -> T:
        from pkgutil import resolve_name

        try:
            found = point.load()
            if not isinstance(found, resolve_name(self._kind)):
                raise TypeError(f"expected a {self._kind}, got {found!r:.60}")
        except Exception as error:
            raise PluginError(
                f"{self._group}: {point.name} ({point.value}): {error}"
            ) from error
        return found
