"""The panel on the right: play bar, clutch, choices of the picture, options.

Callbacks of the browser come in threads of their own. They only leave their wish where the viewer's
`tick` finds it, so that mapping and drawing happen in one thread.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from handmap_qp.errors import HandmapError
from handmap_qp.hands.hand import Hand
from handmap_qp.viewer.option_controls import OptionControls, Options
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser

SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}


class PictureControls:
    """What the picture shows.

    Args:
        server: A running viser server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        hint = "Hold each hand in place, or see it travel"
        self.follow = server.gui.add_dropdown(
            "follow", ("hands", "world"), initial_value="hands", hint=hint
        )
        hint = "What T_def makes of a ball or a cube at the pivot"
        self.shape = server.gui.add_dropdown(
            "deformation", ("ellipsoid", "cube", "off"), initial_value="ellipsoid", hint=hint
        )

    def apply_to(self, scene: HandScene) -> None:
        """Let the scene know; seen with its next drawing."""
        scene.follow, scene.deformation_shape = self.follow.value, self.shape.value


class SteeringControls:
    """Clutch, picture, options, and a word on what could not be done.

    Args:
        server: A running viser server.
        robot: The robot hand.
        options: The options to start from.

    Attributes:
        release: The button that lets go. There are two, so that no click ever means what the button
            said a moment ago.
        clutch: The button that takes hold again.
        message: What is being done, or why the last wish was not fulfilled; not visible where there
            is nothing to say.
        picture: What the picture shows.
        options: Sliders, lists and boxes for the options.
        reset: The button that asks for the first options back.
    """

    def __init__(self, server: viser.ViserServer, robot: Hand, options: Options) -> None:
        gui = server.gui
        self.release = gui.add_button("Release", hint="The robot holds still until you clutch")
        self.clutch = gui.add_button(
            "Clutch",
            hint="Take hold of the robot again; it goes on from where it is",
            disabled=True,
        )
        self.message = gui.add_markdown("", visible=False)
        self.picture = PictureControls(server)
        self.options = OptionControls(server, robot, options)
        self.reset = gui.add_button("Reset options and clutch")
        self._wishes: list[str] = []
        self.release.on_click(lambda _: self._wishes.append("release"))
        self.clutch.on_click(lambda _: self._wishes.append("clutch"))
        self.reset.on_click(lambda _: self._wishes.append("reset"))

    def take_wishes(self) -> list[str]:
        """The buttons pressed since the last call: `release`, `clutch` and `reset`."""
        return [self._wishes.pop(0) for _ in range(len(self._wishes))]

    def show_released(self, is_released: bool) -> None:
        """Let that button be pressed which would change something."""
        self.release.disabled, self.clutch.disabled = is_released, not is_released

    def say(self, text: str) -> None:
        """Show a line below the clutch button; nothing for an empty one."""
        self.message.visible, self.message.content = text != "", text

    def complain(self, error: HandmapError | None) -> None:
        """Say why a wish was not fulfilled, or that the last one was."""
        self.say("" if error is None else f"**Not possible:** {error}")


class PlayBar:
    """Play and pause, speed, scrubbing.

    Args:
        server: A running viser server.
        duration: Time from the first to the last [s].

    Attributes:
        is_playing: Whether time runs.
        time: Where it is [s].
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
        """Let time run, or take it from the slider where the user moved that.

        Args:
            elapsed: Since the last call [s].
        """
        if self.slider.value != self._written:
            self.time = self.slider.value
        elif self.is_playing:
            self.time += SPEEDS[self.speed.value] * elapsed
            if self.time > self._duration:
                self.time = 0.0
        self.slider.value = self._written = round(self.time, 2)


def dock_main_panel(server: viser.ViserServer) -> None:
    """Put what follows to the right of the hands."""
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(330)
