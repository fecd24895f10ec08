"""The browser window: hands, gauges and controls, from the play bar to the files to save.

viser calls callbacks in threads of its own. They only record a request, which the viewer's `tick`
carries out, so that mapping and drawing happen in one thread.
"""

import math
import time
from collections import namedtuple
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from handmap_core.errors import HandmapError
from handmap_core.options import Option, Options, options_of
from handmap_core.se3 import Array
from handmap_qp.hands import Hand, Names, Values
from handmap_qp.mapping import PRESETS, Choice
from .gauges import Gauges
from .sample import Variant
from .scene import Display, HandScene
from .serving import ViserServer

NOTHING = "nothing"
KEPT = "kept options"
"""Entries of the list of methods to compare with, besides the methods."""
LEFT_OUT = ("step_tolerance", "point_tolerance", "tasks")
"""Options without a control: tolerances, and names of tasks."""
_GIVEN = "as given"
# Largest value of a slider without a bound, in units of its default; and where that is 0 or none.
_SPAN = 4.0
_UNKNOWN = 20.0
_OPTIONAL = 200.0
# Least time between two updates of plots and joint bars [s]; they cost more than poses.
_GAUGES_PERIOD = 0.1
_PANEL_WIDTH = 300
# How long a browser may take to draw a picture [s].
_PATIENCE = 60.0
_GROUPS = msgspec.yaml.decode(Path(__file__).with_suffix(".yaml").read_bytes())


def add_controls(
    gui: Any, group: str, press: Callable[[str, Any], object] = lambda *_: None
) -> Any:
    """Add a group of controls, as `controls.yaml` describes them.

    Args:
        gui: Where viser adds controls.
        group: Name of the group.
        press: Called with a button's name and the browser's handle when the button is pressed; of
            one in a row of buttons, with the row's name and the button's text.

    Returns:
        The viser controls in their order, a tuple with their names.
    """
    add: dict[str, Callable[..., Any]] = {
        "button": gui.add_button,
        "buttons": gui.add_button_group,
        "checkbox": gui.add_checkbox,
        "dropdown": gui.add_dropdown,
        "html": gui.add_html,
        "markdown": gui.add_markdown,
    }
    handles = []
    for name, control in _GROUPS[group].items():
        ((kind, arguments),) = control.items()
        handle = add[kind](**arguments)
        handles.append(handle)
        if kind == "button":
            handle.on_click(lambda event, name=name: press(name, event.client))
        elif kind == "buttons":
            handle.on_click(lambda event, name=name: press(name, event.target.value))
    return namedtuple(group, _GROUPS[group], rename=True)(*handles)


def say(handle: Any, message: str | HandmapError | None) -> None:
    """Show a message in a text of viser; an error as why something is not possible.

    Args:
        handle: The text, which is hidden if there is nothing to say.
        message: The message.
    """
    text = (
        f"**Not possible:** {message}"
        if isinstance(message, HandmapError)
        else message or ""
    )
    handle.visible = text != ""
    handle.content = text


@contextmanager
def reporting(handle: Any, message: str) -> Iterator[None]:
    """Show a message while the block runs, and afterwards only why it was not possible.

    Args:
        handle: See `say`.
        message: The message.
    """
    say(handle, message)
    failure = None
    try:
        yield
    except HandmapError as error:
        failure = error
    say(handle, failure)


@dataclass
class _Control:
    """A viser control, whose changes by the user are taken once.

    The functions convert a value to the handle's, which may be rounded or clipped, and back.
    """

    handle: Any
    to_shown: Callable[[Any], Any] = lambda value: value
    to_value: Callable[[Any], Any] = lambda value: value

    def __post_init__(self) -> None:
        self.taken = self.handle.value

    def take(self) -> Any:
        """Return the value."""
        self.taken = self.handle.value
        return self.to_value(self.taken)

    def show(self, value: Any) -> None:
        """Show a value, except where the user has just changed the control."""
        shown = self.to_shown(value)
        if shown != self.taken:
            self.handle.value = self.taken = shown


class SteeringControls:
    """Preset, comparison, clutch, options, and a message about the last request.

    Each option has a slider, a list or a box, made from its type and range.

    Args:
        choice: Preset and options to start from.
        presets: The presets that the hands can be mapped with.
        compared: The preset that is compared with, or `NOTHING`; None if nothing can be compared.

    Attributes:
        controls: By name, the list of presets (`preset`; choosing one brings its own options), that
            of methods to compare with (`compare`, if something can be compared), and what changes
            each option of the method and the QP.
        keep: Button that keeps the robot as it is now for comparison with later options; None if
            nothing can be compared.
        release: Button that freezes the robot. Two buttons instead of a toggle, so that a click
            cannot act on a label that has just changed.
        clutch: Button that resumes mapping from where the robot is.
        message: What is being done, or why the last request failed; hidden if empty.
        reset: Button that restores the initial preset and options, and clutches.
    """

    _method: type[Options] | None = None

    def __init__(
        self,
        server: ViserServer,
        choice: Choice,
        presets: Names,
        compared: str | None = None,
    ) -> None:
        self._gui = gui = server.gui
        self._requests: list[str] = []
        names = dict.fromkeys((*presets, choice.preset))
        purposes = "; ".join(f"{name}: {PRESETS[name].purpose}" for name in names)
        self.controls = self._lasting = {
            "preset": self._list("preset", names, choice.preset, purposes)
        }
        self.keep = None
        if compared:
            self._lasting["compare"] = self._list(
                "compare with",
                (NOTHING, *presets, KEPT),
                compared,
                "A second robot follows the same hand by another method",
            )
            (self.keep,) = add_controls(gui, "comparing", self._note)
        self.message = gui.add_markdown("", visible=False)
        tabs = gui.add_tab_group()
        self._tab = tabs.add_tab("Mapping")
        with tabs.add_tab("QP"):
            self._lasting |= self._controls_of(type(choice.ik))
        self.show_choice(choice)
        self.reset, self.release, self.clutch = add_controls(
            gui, "engaging", self._note
        )

    def _note(self, name: str, _: Any) -> None:
        self._requests.append(name)

    def take_requests(self) -> list[str]:
        """Return the buttons pressed since the last call: `release`, `clutch`, `reset`, `keep`."""
        return [self._requests.pop(0) for _ in range(len(self._requests))]

    def take_changes(self) -> Values:
        """Return what the user has changed since the last call: `preset`, `compare`, options."""
        return {
            name: each.take()
            for name, each in self.controls.items()
            if each.handle.value != each.taken
        }

    def show_choice(self, choice: Choice) -> None:
        """Show preset and options, except where the user has just changed a control.

        If the method is another one, its controls replace those of the one before.
        """
        if self._method is not type(choice.method):
            self._method = type(choice.method)
            for name in self.controls.keys() - self._lasting.keys():
                self.controls[name].handle.remove()
            with self._tab:
                self.controls = self._controls_of(self._method) | self._lasting
        values = choice.method.values | choice.ik.values | {"preset": choice.preset}
        for name in values.keys() & self.controls.keys():
            self.controls[name].show(values[name])

    def show_released(self, is_released: bool) -> None:
        """Enable the button that has an effect."""
        self.release.disabled = is_released
        self.clutch.disabled = not is_released

    def _controls_of(self, kind: type[Options]) -> dict[str, _Control]:
        return {
            option.name: self._control(option)
            for option in options_of(kind)
            if option.name not in LEFT_OUT
        }

    def _control(self, option: Option) -> _Control:
        """Make the control that suits an option's values."""
        label = option.name.replace("_", " ")
        hint = option.about
        if option.plain is bool:
            return _Control(
                self._gui.add_checkbox(label, bool(option.default), hint=hint)
            )
        if option.choices:
            return self._list(label, option.choices, str(option.default), hint)
        if option.range:
            return self._slider(option, label, *option.range)
        handle = self._gui.add_text(label, _as_text(option.default), hint=hint)
        return _Control(handle, _as_text, _from_text)

    def _slider(self, option: Option, label: str, low: float, high: float) -> _Control:
        is_optional = option.default is None
        usual = _OPTIONAL if is_optional else _SPAN * option.default or _UNKNOWN
        high = min(high, max(usual, low + 1.0) if low else usual)
        step = 10.0 ** math.floor(math.log10((high - low) / 40.0))
        if isinstance(option.default, int):
            step = 1
            high = int(high)
        handle = self._gui.add_slider(label, low, high, step, low, hint=option.about)

        def to_shown(value: float | None) -> float:
            # Widen the range to a value outside it; show infinity as the maximum.
            value = value or 0.0
            if handle.max < value < math.inf:
                handle.max = value
            return min(value, handle.max)

        return _Control(
            handle, to_shown, lambda value: (value or None) if is_optional else value
        )

    def _list(
        self, label: str, words: Iterable[str], shown: str, hint: str
    ) -> _Control:
        values: Values = {word: word for word in words}
        handle = self._gui.add_dropdown(
            label, tuple(values), initial_value=shown, hint=hint
        )

        def to_shown(value: Any) -> str:
            # A value beside the words may be a rotation matrix.
            shown = value if isinstance(value, str) else _GIVEN
            values[shown] = value
            if shown not in handle.options:
                handle.options = tuple(values)
            return shown

        return _Control(handle, to_shown, values.__getitem__)


def _as_text(value: Any) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return ", ".join(map(str, value))


def _from_text(text: str) -> Any:
    """Return the value of a text: nothing, a word, or numbers with commas between."""
    try:
        return (
            tuple(yaml.safe_load(f"[{text}]")) if "," in text else yaml.safe_load(text)
        )
    except yaml.YAMLError:
        return text


class PlayBar:
    """Play and pause, speed, scrubbing.

    Args:
        duration: Time from the first to the last sample [s].

    Attributes:
        is_playing: Whether time advances.
        time: Current time since the first sample [s].
    """

    def __init__(self, server: ViserServer, duration: float) -> None:
        self.is_playing = True
        self.time = self._written = 0.0
        self._duration = duration
        self.button, self.speed = add_controls(
            server.gui, "playing", lambda *_: self.toggle()
        )
        self.slider = server.gui.add_slider(
            "time [s]", 0.0, max(round(duration, 2), 0.01), 0.01, 0.0
        )

    def toggle(self) -> None:
        """Play or pause."""
        self.is_playing = not self.is_playing
        self.button.label = "Pause" if self.is_playing else "Play"
        self.button.icon = f"player-{self.button.label.lower()}"

    def advance(self, elapsed: float) -> None:
        """Advance time, or take it from the slider if the user moved it.

        Args:
            elapsed: Time since the last call [s].
        """
        if self.slider.value != self._written:
            self.time = self.slider.value
        elif self.is_playing:
            self.time += float(Fraction(self.speed.value)) * elapsed
            if self.time > self._duration:
                self.time = 0.0
        self.slider.value = self._written = round(self.time, 2)


def _picture(client: Any) -> bytes:
    """Return what a browser draws of the hands as a PNG file."""
    camera = client.camera
    return on_white(
        client.get_render(
            camera.image_height,
            camera.image_width,
            transport_format="png",
            timeout=_PATIENCE,
        )
    )


def on_white(image: Array) -> bytes:
    """Return a picture as a PNG file on a white background.

    Args:
        image: Red, green, blue and opacity, 0 to 255, shape (rows, columns, 4).
    """
    import imageio.v3 as imageio

    opacity = image[..., 3:] / 255.0
    opaque = image[..., :3] * opacity + 255.0 * (1.0 - opacity)
    return bytes(
        imageio.imwrite("<bytes>", opaque.round().astype(np.uint8), extension=".png")
    )


class Window:
    """The browser window of a view.

    The gauges are on the left, in viser's main panel, because only that one can be folded away for
    one browser (`BrowserCameras`). The tabs are on the right.

    Args:
        human: The human hand.
        variants: The robots.
        options_text: Returns the text of the file of options.
        page: Returns the page; may raise `HandmapError`.

    Attributes:
        scene: The hands.
        gauges: Numbers, plots and joint bars.
        control: The tab for what moves the robots, which is empty.
        display: What the scene shows.
        latest: Length of the plots' time axis, as in `draw_plot`.
    """

    latest: float | None = None

    def __init__(
        self,
        server: ViserServer,
        human: Hand,
        variants: Sequence[Variant],
        options_text: Callable[[], str],
        page: Callable[[], bytes],
    ) -> None:
        self.scene = HandScene(server, human, variants)
        gui = server.gui
        gui.set_panel_label("handmap view: gauges")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(_PANEL_WIDTH)
        # Controls that are added outside the tabs go to the main panel.
        panel = gui.add_panel()
        self.control, show, save = map(panel.add_tab, ("Control", "Show", "Save"))
        panel.dock_right()
        panel.set_width(_PANEL_WIDTH)
        self.gauges = Gauges(server, variants[0].robot, human)
        with show:
            self.display = add_controls(gui, "display")
        with save:
            add_controls(gui, "saving", self.send)
            self._saving = gui.add_markdown("", visible=False)
        self._files = {
            "options.yaml": lambda _: options_text().encode(),
            "handmap.png": _picture,
            "handmap.html": lambda _: page(),
        }
        self._drawn = ()
        self._gauged = ()
        self._gauges_due = 0.0

    def send(self, name: str, client: Any) -> None:
        """Send a file to the browser that asked for it.

        Args:
            name: `options.yaml`, `handmap.png` or `handmap.html`.
            client: The browser's handle of viser.
        """
        with reporting(self._saving, f"writing {name} …"):
            client.send_file_download(name, self._files[name](client))

    def set_variants(self, variants: Sequence[Variant]) -> None:
        """Show these robots."""
        self._drawn = self._gauged = ()
        self.scene.set_variants(variants)

    def draw(
        self, variants: Sequence[Variant], index: int, *, at_once: bool = False
    ) -> None:
        """Draw one instant, unless it is drawn as the display controls ask for.

        Args:
            variants: The robots that are shown, with their samples.
            index: Index of the sample to draw.
            at_once: Whether the gauges are updated too, even if they were a moment ago.
        """
        *settings, clear = self.display
        display = Display(*[setting.value for setting in settings])
        # viser sets a button's value when it is pressed.
        if clear.value or not display.has_trails:
            clear.value = False
            self.scene.clear_trails()
        samples = tuple(variant.samples[index] for variant in variants)
        state = (samples, display)
        if state != self._drawn:
            self.scene.draw(*state)
            self._drawn = state
        self.scene.cameras.update()
        now = time.monotonic()
        if samples != self._gauged and (at_once or now >= self._gauges_due):
            self.gauges.draw(variants, index, latest=self.latest)
            self._gauged = samples
            self._gauges_due = now + _GAUGES_PERIOD
