"""The panel on the right: play bar, clutch, display settings, options.

viser calls callbacks in threads of its own. They only record a request, which the viewer's `tick`
carries out, so that mapping and drawing happen in one thread.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from handmap_qp.errors import HandmapError
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.options_file import options_text
from handmap_qp.mapping.presets import PRESETS, Choice
from handmap_qp.viewer.option_controls import OptionControls
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser

SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}


class DisplayControls:
    """What the scene shows.

    Args:
        server: A running viser server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        hint = "hands: keep each hand in place; world: show how it travels"
        self.follow = server.gui.add_dropdown(
            "follow", ("hands", "world"), initial_value="hands", hint=hint
        )
        hint = "Shape of a ball or cube at the pivot after T_def"
        self.shape = server.gui.add_dropdown(
            "deformation", ("ellipsoid", "cube", "off"), initial_value="ellipsoid", hint=hint
        )

    def apply_to(self, scene: HandScene) -> None:
        """Copy the settings to the scene; its next drawing shows them."""
        scene.follow, scene.deformation_shape = self.follow.value, self.shape.value


class SteeringControls:
    """Clutch, display settings, options, and a message about the last request.

    Args:
        server: A running viser server.
        robot: The robot hand.
        choice: Preset and options to start from.
        presets: The presets that the hands can be mapped with.

    Attributes:
        release: Button that freezes the robot. Two buttons instead of a toggle, so that a click
            cannot act on a label that has just changed.
        clutch: Button that resumes mapping from where the robot is.
        message: What is being done, or why the last request failed; hidden if empty.
        display: What the scene shows.
        preset: List of presets; choosing one brings its own options.
        options: Sliders, lists and boxes for the options.
        reset: Button that restores the initial preset and options, and clutches.
        save: Button that downloads preset and options as a file for `--options`.
        options_text: The text of that file.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        robot: Hand,
        choice: Choice,
        presets: tuple[str, ...] = (),
    ) -> None:
        gui = server.gui
        self.release = gui.add_button("Release", hint="Freeze the robot until Clutch is pressed")
        self.clutch = gui.add_button(
            "Clutch",
            hint="Resume mapping from where the robot is",
            disabled=True,
        )
        self.message = gui.add_markdown("", visible=False)
        self.display = DisplayControls(server)
        names = dict.fromkeys((*presets, choice.preset))
        self.preset = gui.add_dropdown(
            "preset",
            tuple(names),
            initial_value=choice.preset,
            hint="; ".join(f"{name}: {PRESETS[name].purpose}" for name in names),
        )
        self._taken_preset: str = choice.preset
        self.options = OptionControls(server, robot, choice)
        self.reset = gui.add_button(
            "Reset options and clutch",
            hint="Restore the initial preset and options, and resume mapping",
        )
        self.save = gui.add_button(
            "Save options", hint="Download preset and options, for --options of the commands"
        )
        self.options_text = options_text(choice)
        self.save.on_click(self._download_options)
        self._requests: list[str] = []
        self.release.on_click(lambda _: self._requests.append("release"))
        self.clutch.on_click(lambda _: self._requests.append("clutch"))
        self.reset.on_click(lambda _: self._requests.append("reset"))

    def _download_options(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            event.client.send_file_download("options.yaml", self.options_text.encode())

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
        self.options_text = options_text(choice)
        self.options.show(choice)

    def show_released(self, is_released: bool) -> None:
        """Enable the button that has an effect."""
        self.release.disabled, self.clutch.disabled = is_released, not is_released

    def show_message(self, text: str) -> None:
        """Show a line below the clutch button; hide it if the text is empty."""
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


def dock_main_panel(server: viser.ViserServer) -> None:
    """Dock the main panel, where all later controls go, to the right of the hands."""
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(330)
