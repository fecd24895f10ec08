"""Options: fields of a frozen struct that checks them however it is made.

    class Example(Options, frozen=True):
        gain: Share = 0.5

The check, its error, the command line, the messages of the service, the controls of the view and
the pages of reference read the field and what the docstring says of it.
"""

import inspect
import math
import re
from functools import cache
from itertools import starmap
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    Self,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
import numpy as np
from msgspec import Meta

from handmap_core.errors import InvalidOptionsError

_ANY = Meta()
_NOUNS = {int: "an integer", float: "a number", bool: "true or false", str: "a name"}
_ATTRIBUTE = re.compile(r"^ {4}(\w+): (.+(?:\n {5,}.+)*)", re.MULTILINE)
"""Name and text of an attribute in a docstring."""
LARGEST = float(np.finfo(float).max)
"""Bound of numbers that need only be finite."""


def number(low: float = 0.0, high: float = LARGEST, *, above: bool = False) -> Meta:
    """Describe the range of a number.

    Args:
        low: Least value.
        high: Largest value.
        above: Whether `low` itself is too small.
    """
    # NaN fails the lower bound.
    bounds = {"gt" if above else "ge": low, "le": high}
    return Meta(**bounds)  # ty: ignore[no-matching-overload]


NotNegative = Annotated[float, number()]
Positive = Annotated[float, number(above=True)]
Share = Annotated[float, number(high=1.0)]


class Option(NamedTuple):
    """One option of a kind of options.

    Attributes:
        name: Its name.
        type: Its type, annotated with the range.
        plain: Its type alone.
        default: Value if omitted.
        about: What the docstring says of it.
    """

    name: str
    type: Any
    plain: Any
    default: Any
    about: str = ""

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that it takes; empty if there are none."""
        return tuple(
            word
            for bare, _ in _parts(self.type)
            if get_origin(bare) is Literal
            for word in get_args(bare)
        )

    @property
    def range(self) -> tuple[float, float] | None:
        """Least and largest number; None if it takes no numbers."""
        for bare, meta in _parts(self.type):
            if bare in (int, float):
                low = meta.gt if meta.ge is None else meta.ge
                return (
                    -math.inf if low is None else low,
                    math.inf if meta.le is None else meta.le,
                )
        return None

    def read(self, value: Any) -> Any:
        """Return a value as Python's, not numpy's, and lists as tuples.

        Raises:
            InvalidOptionsError: If it has no meaning.
        """
        try:
            return msgspec.convert(_plain(value), self.type)
        except (msgspec.ValidationError, TypeError):
            raise InvalidOptionsError(
                option=self.name, expected=self.expected, value=value
            ) from None

    def takes(self, value: Any) -> bool:
        """Return whether a value has a meaning."""
        try:
            self.read(value)
        except InvalidOptionsError:
            return False
        return True

    @property
    def expected(self) -> str:
        """What its values are, in words."""
        return " or ".join(starmap(_in_words, _parts(self.type)))


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all options.

    Raises:
        InvalidOptionsError: If a value has no meaning; names the option at fault.
    """

    def __post_init__(self) -> None:
        """Check every value, and turn numpy's numbers and lists into Python's."""
        for option in options_of(type(self)):
            value = getattr(self, option.name)
            if value is not option.default:
                msgspec.structs.force_setattr(self, option.name, option.read(value))
        self.check()

    def check(self) -> None:
        """Reject combinations without a meaning, in a subclass.

        Raises:
            InvalidOptionsError: Names the option at fault.
        """

    def replaced(self, **changes: Any) -> Self:
        """Return a copy with other values for some options.

        Raises:
            InvalidOptionsError: If there is no such option, or a value has no meaning.
        """
        if unknown := sorted(changes.keys() - self.values.keys()):
            raise InvalidOptionsError(
                f"{type(self).__name__} has no such option",
                option=unknown[0],
                advice=f"there are {', '.join(self.values)}",
            )
        return msgspec.structs.replace(self, **changes)

    @property
    def values(self) -> dict[str, Any]:
        """All values by name."""
        return msgspec.structs.asdict(self)

    def changes_to(self, other: Self) -> dict[str, Any]:
        """Return the values of another one that differ from these, by name."""
        return {
            name: value
            for name, value in other.values.items()
            if value != self.values[name]
        }


@cache
def options_of(kind: type[Options]) -> tuple[Option, ...]:
    """Return the options of a kind, in their order."""
    plain = get_type_hints(kind)
    about = _documented(kind)
    return tuple(
        Option(
            field.name,
            field.type,
            plain[field.name],
            field.default,
            about.get(field.name, ""),
        )
        for field in msgspec.structs.fields(kind)
    )


def _documented(kind: type) -> dict[str, str]:
    """Return what the docstrings of a class and its bases say of attributes, by name."""
    return {
        name: " ".join(text.split())
        for base in reversed(kind.__mro__)
        for name, text in _ATTRIBUTE.findall(inspect.cleandoc(base.__doc__ or ""))
    }


def _plain(value: Any) -> Any:
    """Return Python's numbers in place of numpy's."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


def _parts(kind: Any, about: Meta = _ANY) -> list[tuple[Any, Meta]]:
    """Return the types of a union, or the type itself, each with its description."""
    if get_origin(kind) is Annotated:
        kind, *notes = get_args(kind)
        return _parts(kind, next((n for n in notes if isinstance(n, Meta)), about))
    if get_origin(kind) in (Union, UnionType):
        return [part for each in get_args(kind) for part in _parts(each, about)]
    return [(kind, about)]


def _in_words(bare: Any, meta: Meta) -> str:
    """Return what the values of a type that is no union are."""
    if get_origin(bare) is Literal:
        return f"one of {', '.join(get_args(bare))}"
    if parts := get_args(bare):  # a tuple
        ((each, inner),) = _parts(parts[0])
        if ... in parts:
            return f"a list, each {_in_words(each, inner)}"
        if row := get_args(each):
            return f"a matrix of shape ({len(parts)}, {len(row)})"
        return f"{len(parts)} finite numbers" + (
            "" if inner.gt is None else f" > {inner.gt:g}"
        )
    noun = _NOUNS.get(bare, "none")
    bracket, sign, low = "[", ">=", meta.ge
    if low is None:
        bracket, sign, low = "(", ">", meta.gt
    if meta.le == LARGEST:
        noun = "a finite number"
    elif meta.le is not None:
        return f"{noun} in {bracket}{low:g}, {meta.le:g}]"
    return noun if low is None else f"{noun} {sign} {low:g}"
