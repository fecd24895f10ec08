"""The choice of a preset for two hands, and of options: `Choice`."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple

from handmap_core.errors import HandmapError
from handmap_core.options import Option, options_of
from handmap_qp.hands import Hand, Names, Values
from handmap_qp.ik import IkOptions
from .method import PRESETS, MethodOptions, default_preset, get_preset


def known_options() -> dict[str, list[tuple[str, Option]]]:
    """Return all options by name: the presets that have each (`ik`: the QP), and what it is."""
    kinds = {name: type(preset.method) for name, preset in PRESETS.items()}
    found: dict[str, list[tuple[str, Option]]] = {}
    for preset, kind in (kinds | {"ik": IkOptions}).items():
        for option in options_of(kind):
            found.setdefault(option.name, []).append((preset, option))
    return found


def preset_with(names: Iterable[str], human: Hand, robot: Hand) -> str:
    """Choose the preset for two hands that has options of these names.

    That is the default one if it has them, else the first that has.
    """
    first = default_preset(human, robot)
    able = (
        name
        for name in (first, *PRESETS)
        if PRESETS[name].method.values.keys() >= set(names)
    )
    return next(able, first)


def possible_presets(human: Hand, robot: Hand) -> Names:
    """Return the presets that two hands can be mapped with."""
    possible = []
    for name, preset in PRESETS.items():
        with suppress(HandmapError):
            preset.method.bind(human, robot)
            possible.append(name)
    return tuple(possible)


class Choice(NamedTuple):
    """A preset with the options that were chosen for it.

    Attributes:
        preset: Name of the preset.
        method: Its method with its options.
        ik: Weights and settings of the QP.
    """

    preset: str
    method: MethodOptions
    ik: IkOptions

    def with_changes(self, changes: Values) -> Choice:
        """Return a copy with other values for some options.

        Args:
            changes: Values of options of the method and of the QP by name. After a `preset`, other
                options are that preset's, but for those of the setup (`kept_options`).

        Raises:
            InvalidOptionsError: If there is no such preset or option, or options contradict.
        """
        rest = dict(changes)
        start = self
        if "preset" in rest:
            start = preset_choice(rest.pop("preset"))
            own = preset_choice(self.preset).method.changes_to(self.method)
            rest = kept_options(own, start.preset) | rest
        ik = {name: rest.pop(name) for name in IK_NAMES & rest.keys()}
        return start._replace(
            method=start.method.replaced(**rest), ik=start.ik.replaced(**ik)
        )

    def changes_to(self, other: Choice) -> Values:
        """Return the changes that turn this choice into another one."""
        if self.preset != other.preset:
            start = preset_choice(other.preset)
            return {"preset": other.preset} | start.changes_to(other)
        return self.method.changes_to(other.method) | self.ik.changes_to(other.ik)


IK_NAMES = frozenset(IkOptions.__struct_fields__)
"""Names of the options of the QP; no method has an option of such a name."""


def kept_options(options: Values, preset: str) -> Values:
    """Return the options that another preset keeps, which describe the setup: the alignment."""
    names = {"alignment"} & get_preset(preset).method.values.keys()
    return {name: options[name] for name in names & options.keys()}


def preset_choice(name: str, human: Hand | None = None) -> Choice:
    """Return a preset with its own options, or those that a measured person decides.

    Raises:
        InvalidOptionsError: If there is no such preset.
    """
    preset = get_preset(name)
    method = preset.method.fitted_to(human) if human else preset.method
    return Choice(name, method, preset.ik)
