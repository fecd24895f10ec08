"""The controls: play bar, preset, comparison, clutch, options, and what the scene shows.

viser calls callbacks in threads of its own. They only record a request, which the viewer's `tick`
carries out, so that mapping and drawing happen in one thread.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from handmap_qp.errors import HandmapError
from handmap_qp.mapping.presets import PRESETS, Choice
from handmap_qp.viewer.option_controls import OptionControls
from handmap_qp.viewer.scene import HandScene
from handmap_qp.viewer.trails import LENGTH as TRAIL_LENGTH

if TYPE_CHECKING:
    import viser

NOTHING, KEPT = "nothing", "kept options"
"""Entries of the list of methods to compare with, besides the methods."""
SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}


class DisplayControls:
    """What the scene shows.

    Args:
        server: A running viser server.

    Attributes:
        clear: Button that clears the trails.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        gui = server.gui
        hint = "hands: keep each hand in place; world: show how it travels"
        self.follow = gui.add_dropdown(
            "follow", ("hands", "world"), initial_value="hands", hint=hint
        )
        hint = "Shape of a ball or cube at the pivot after T_def"
        self.shape = gui.add_dropdown(
            "deformation", ("ellipsoid", "cube", "off"), initial_value="ellipsoid", hint=hint
        )
        self.landmarks = gui.add_checkbox(
            "landmarks", initial_value=False, hint="The tracker's landmarks, beside the hand"
        )
        self.trails = gui.add_checkbox(
            "trails",
            initial_value=False,
            hint=f"Where the fingertips were in the last {TRAIL_LENGTH:g} s",
        )
        self.clear = gui.add_button("Clear trails", hint="Start the trails again from here")
        self._is_to_clear = False
        self.clear.on_click(self._request_clear)

    @property
    def state(self) -> tuple[object, ...]:
        """The settings; the scene has to be drawn again if they change."""
        return self.follow.value, self.shape.value, self.landmarks.value, self.trails.value

    def apply_to(self, scene: HandScene) -> None:
        """Copy the settings to the scene; its next drawing shows them."""
        if self._is_to_clear or (scene.has_trails and not self.trails.value):
            self._is_to_clear = False
            scene.clear_trails()
        scene.follow, scene.deformation_shape = self.follow.value, self.shape.value
        scene.has_landmarks, scene.has_trails = self.landmarks.value, self.trails.value

    def _request_clear(self, _: object) -> None:
        self._is_to_clear = True


class CompareControls:
    """Choice of a second method, whose robot stands beside the first.

    Args:
        server: A running viser server.
        names: The presets and methods to choose from.
        chosen: The one to start with.

    Attributes:
        choice: List of methods.
        keep: Button that keeps the robot as it is now for comparison with later options.
    """

    def __init__(
        self, server: viser.ViserServer, names: tuple[str, ...], chosen: str = NOTHING
    ) -> None:
        self.choice = server.gui.add_dropdown(
            "compare with",
            (NOTHING, *names, KEPT),
            initial_value=chosen,
            hint="A second robot follows the same hand by another method",
        )
        self.keep = server.gui.add_button(
            "Keep for comparison", hint="Keep the robot as it is now beside later options"
        )
        self._taken = self.choice.value
        self._is_to_keep = False
        self.keep.on_click(self._request_keep)

    def take_choice(self) -> str | None:
        """Return what the user has chosen since the last call; None if nothing changed."""
        if self._is_to_keep:
            self._is_to_keep = False
            self.choice.value = KEPT
        elif self.choice.value == self._taken:
            return None
        self._taken = self.choice.value
        return self._taken

    def show(self, name: str) -> None:
        """Show a choice that was not made here."""
        self.choice.value = self._taken = name

    def _request_keep(self, _: object) -> None:
        self._is_to_keep = True


class SteeringControls:
    """Preset, comparison, clutch, options, and a message about the last request.

    Args:
        server: A running viser server.
        choice: Preset and options to start from.
        presets: The presets that the hands can be mapped with.
        compare: The comparison, which is made between preset and clutch; None without one.

    Attributes:
        preset: List of presets; choosing one brings its own options.
        compare: Choice of a second method; None if nothing can be compared.
        release: Button that freezes the robot. Two buttons instead of a toggle, so that a click
            cannot act on a label that has just changed.
        clutch: Button that resumes mapping from where the robot is.
        message: What is being done, or why the last request failed; hidden if empty.
        options: Sliders, lists and boxes for the options.
        reset: Button that restores the initial preset and options, and clutches.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        choice: Choice,
        presets: tuple[str, ...] = (),
        compare: Callable[[], CompareControls] | None = None,
    ) -> None:
        gui = server.gui
        names = dict.fromkeys((*presets, choice.preset))
        self.preset = gui.add_dropdown(
            "preset",
            tuple(names),
            initial_value=choice.preset,
            hint="; ".join(f"{name}: {PRESETS[name].purpose}" for name in names),
        )
        self._taken_preset: str = choice.preset
        self.compare = None if compare is None else compare()
        self.message = gui.add_markdown("", visible=False)
        self.options = OptionControls(server, choice)
        self.reset = gui.add_button(
            "Reset options and clutch",
            hint="Restore the initial preset and options, and resume mapping",
        )
        self.release = gui.add_button("Release", hint="Freeze the robot until Clutch is pressed")
        self.clutch = gui.add_button(
            "Clutch",
            hint="Resume mapping from where the robot is",
            disabled=True,
        )
        self._requests: list[str] = []
        self.release.on_click(lambda _: self._requests.append("release"))
        self.clutch.on_click(lambda _: self._requests.append("clutch"))
        self.reset.on_click(lambda _: self._requests.append("reset"))

    def take_requests(self) -> list[str]:
        """Return the buttons pressed since the last call: `release`, `clutch` and `reset`."""
        return [self._requests.pop(0) for _ in range(len(self._requests))]

    def take_preset(self) -> str | None:
        """Return the preset that the user has chosen since the last call; None if none."""
        if self.preset.value == self._taken_preset:
            return None
        self._taken_preset = self.preset.value
        return self._taken_preset

    def show_choice(self, choice: Choice) -> None:
        """Show preset and options, except where the user has just changed a control."""
        if choice.preset != self._taken_preset:
            if choice.preset not in self.preset.options:
                self.preset.options = (*self.preset.options, choice.preset)
            self.preset.value = self._taken_preset = choice.preset
        self.options.show(choice)

    def show_released(self, is_released: bool) -> None:
        """Enable the button that has an effect."""
        self.release.disabled, self.clutch.disabled = is_released, not is_released

    def show_message(self, text: str) -> None:
        """Show a line above the options; hide it if the text is empty."""
        self.message.visible, self.message.content = text != "", text

    def show_error(self, error: HandmapError | None) -> None:
        """Show why the last request failed; None clears the message."""
        self.show_message("" if error is None else f"**Not possible:** {error}")


class PlayBar:
    """Play and pause, speed, scrubbing.

    Args:
        server: A running viser server.
        duration: Time from the first to the last sample [s].

    Attributes:
        is_playing: Whether time advances.
        time: Current time since the first sample [s].
    """

    def __init__(self, server: viser.ViserServer, duration: float) -> None:
        import viser

        self.is_playing = True
        self.time = 0.0
        self._duration = duration
        self.button = server.gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self.button.on_click(lambda _: self.toggle())
        self.speed = server.gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1")
        self.slider = server.gui.add_slider(
            "time [s]", 0.0, max(round(duration, 2), 0.01), 0.01, 0.0
        )
        self._written = 0.0

    def toggle(self) -> None:
        """Play or pause."""
        import viser

        self.is_playing = not self.is_playing
        self.button.label = "Pause" if self.is_playing else "Play"
        self.button.icon = viser.Icon.PLAYER_PAUSE if self.is_playing else viser.Icon.PLAYER_PLAY

    def advance(self, elapsed: float) -> None:
        """Advance time, or take it from the slider if the user moved it.

        Args:
            elapsed: Time since the last call [s].
        """
        if self.slider.value != self._written:
            self.time = self.slider.value
        elif self.is_playing:
            self.time += SPEEDS[self.speed.value] * elapsed
            if self.time > self._duration:
                self.time = 0.0
        self.slider.value = self._written = round(self.time, 2)
