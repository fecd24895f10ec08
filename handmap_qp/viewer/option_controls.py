"""A slider, a list or a box for each option, made from its type and range.

`OptionControls` returns what the user has changed, and shows the values in force.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import yaml

from handmap_qp.mapping.presets import Choice
from handmap_qp.options import Option, Options, options_of

if TYPE_CHECKING:
    import viser

LEFT_OUT = ("step_tolerance", "point_tolerance", "tasks")
"""Options without a control: tolerances, and names of tasks."""
_GIVEN = "as given"
# Largest value of a slider without a bound, in units of its default; and where that is 0 or none.
_SPAN, _UNKNOWN, _OPTIONAL = 4.0, 20.0, 200.0


@dataclass
class _Control:
    """One option in the panel.

    Attributes:
        handle: The viser control.
        to_shown: Converts an option's value to the handle's, which may be rounded or clipped.
        to_option: Converts the handle's value to the option's.
        taken: The handle's value when it was last read; a different value is a change by the user.
    """

    handle: Any
    to_shown: Callable[[Any], Any] = lambda value: value
    to_option: Callable[[Any], Any] = lambda value: value
    taken: Any = None

    def __post_init__(self) -> None:
        """Start from the value shown."""
        self.taken = self.handle.value


class OptionControls:
    """Controls for the options of the QP and of every method shown so far; one method is visible.

    Args:
        server: A running viser server.
        choice: The initial options.
    """

    def __init__(self, server: viser.ViserServer, choice: Choice) -> None:
        self._gui = server.gui
        tabs = server.gui.add_tab_group()
        self._tab = tabs.add_tab("Mapping")
        self._methods: dict[type[Options], dict[str, _Control]] = {}
        with tabs.add_tab("QP"):
            self._ik = self._controls_of(type(choice.ik))
        self._method: dict[str, _Control] = {}
        self.show(choice)

    @property
    def handles(self) -> dict[str, Any]:
        """The viser controls of the method and the QP, by option name."""
        return {name: control.handle for name, control in (self._method | self._ik).items()}

    def take_changes(self) -> dict[str, Any]:
        """Return the options that the user has changed since the last call, by name."""
        changes = {}
        for name, control in (self._method | self._ik).items():
            value = control.handle.value
            if value != control.taken:
                control.taken, changes[name] = value, control.to_option(value)
        return changes

    def show(self, choice: Choice) -> None:
        """Show the options, except where the user has changed a control since `take_changes`.

        If the method is another one, show its controls instead.
        """
        kind = type(choice.method)
        if kind not in self._methods:
            with self._tab:
                self._methods[kind] = self._controls_of(kind)
        if (method := self._methods[kind]) is not self._method:
            for control in self._method.values():
                # What the user changed last was of the method before.
                control.taken, control.handle.visible = control.handle.value, False
            self._method = method
            for control in method.values():
                control.handle.visible = True
        for controls, part in ((method, choice.method), (self._ik, choice.ik)):
            for name, control in controls.items():
                shown = control.to_shown(getattr(part, name))
                if shown != control.taken:
                    control.handle.value = control.taken = shown

    def _controls_of(self, kind: type[Options]) -> dict[str, _Control]:
        options = [option for option in options_of(kind) if option.name not in LEFT_OUT]
        return {option.name: self._control(option) for option in options}

    def _control(self, option: Option) -> _Control:
        """Make the control that suits an option's values."""
        label, hint = option.name.replace("_", " "), option.about
        if option.plain is bool:
            return _Control(self._gui.add_checkbox(label, bool(option.default), hint=hint))
        if option.choices:
            return self._list(option, label)
        if option.range is not None:
            return self._slider(option, label, *option.range)
        handle = self._gui.add_text(label, _as_text(option.default), hint=hint)
        return _Control(handle, _as_text, _from_text)

    def _slider(self, option: Option, label: str, low: float, high: float) -> _Control:
        usual = _OPTIONAL if option.default is None else _SPAN * option.default or _UNKNOWN
        high = min(high, max(usual, low + 1.0) if low else usual)
        step = 10.0 ** math.floor(math.log10((high - low) / 40.0))
        if isinstance(option.default, int):
            step, high = 1, int(high)
        handle = self._gui.add_slider(label, low, high, step, low, hint=option.about)

        def to_shown(value: float | None) -> float:
            # Widen the range to a value outside it; show infinity as the maximum.
            value = low if value is None else value
            if handle.max < value < math.inf:
                handle.max = value
            return min(value, handle.max)

        is_optional = option.default is None
        return _Control(handle, to_shown, lambda value: (value or None) if is_optional else value)

    def _list(self, option: Option, label: str) -> _Control:
        handle = self._gui.add_dropdown(
            label, option.choices, initial_value=str(option.default), hint=option.about
        )
        given: list[Any] = []

        def to_shown(value: Any) -> str:
            if isinstance(value, str):
                return value
            # A value beside the words, such as a rotation matrix.
            given[:] = [value]
            if _GIVEN not in handle.options:
                handle.options = (*handle.options, _GIVEN)
            return _GIVEN

        return _Control(handle, to_shown, lambda value: given[0] if value == _GIVEN else value)


def _as_text(value: Any) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return ", ".join(map(str, value))


def _from_text(text: str) -> Any:
    """Return the value of a text: nothing, a word, or numbers with commas between."""
    try:
        return yaml.safe_load(f"[{text}]" if "," in text else text)
    except yaml.YAMLError:
        return text
