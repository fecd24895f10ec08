"""Names of a package that are imported at their first use: not every module is here."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def named(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package.

    Args:
        package: Its name.
        homes: The module of each name; one of the same name in the package is that module itself.
    """

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"{package} has no {name}")
        home = import_module(homes[name])
        return home if homes[name] == f"{package}.{name}" else getattr(home, name)

    return find
