"""The panel on the right: play bar, clutch, choices of the picture, a slider or a list for every option.

Callbacks of the browser come in threads of their own. They only leave their wish where the viewer's `tick` finds it, so that
mapping and drawing happen in one thread.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from handmap_qp.errors import HandmapError
from handmap_qp.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.options import MappingOptions
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser

SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}


class _Slider(NamedTuple):
    """A number among the options: its name, range, step and explanation."""

    name: str
    low: float
    high: float
    step: float
    hint: str


_MAPPING_SLIDERS = (
    _Slider("ridge", 0.0, 1.0, 0.005, "Pull of the estimated motion towards a rotation; 0 is the paper's least squares"),
    _Slider("scale", 0.0, 3.0, 0.05, "Factor on translations"),
    _Slider("deformation_gain", 0.0, 2.0, 0.05, "Exponent of the stretch; 1 is the paper, 0 leaves the fingers undeformed"),
    _Slider("residual_gain", 0.0, 1.0, 0.05, "Part of a human point's misfit to T that its partner takes over"),
    _Slider("stretch_min", 0.05, 1.0, 0.05, "Smallest stretch that is passed on"),
    _Slider("stretch_max", 1.0, 5.0, 0.05, "Largest stretch that is passed on"),
)
_IK_SLIDERS = (
    _Slider("point_weight", 0.0, 5.0, 0.05, "Of the reference points' positions, per 10 mm"),
    _Slider("wrist_position_weight", 0.0, 10.0, 0.1, "Of the wrist's position, per 10 mm"),
    _Slider("wrist_orientation_weight", 0.0, 10.0, 0.1, "Of the wrist's orientation, per 0.1 rad"),
    _Slider("rest_weight", 0.0, 3.0, 0.02, "Pull of every joint to its rest angle"),
    _Slider("damping", 0.01, 2.0, 0.01, "Cost of any motion"),
    _Slider("error_damping", 0.0, 3.0, 0.05, "Cost of motion that grows with the error (Levenberg-Marquardt)"),
    _Slider("max_iterations", 1, 20, 1, "Linearisations per sample"),
)
_CHOICES = {
    "rigid_from": (("points", "wrist", "none"), "Where the rigid part T_rb comes from"),
    "pivot": (("centroid", "palm", "world"), "The point about which rotation and deformation act"),
    "alignment": (("world", "palm"), "Rotation from the human's world axes to the robot's"),
    "reference": (("initial", "previous"), "Configuration that T starts from"),
}
_GIVEN = "as given"


class OptionControls:
    """Sliders and lists for the options.

    Args:
        server: A running viser server.
        robot: The robot hand; one with a fixed wrist has no choice of `rigid_from`.
        mapping: The options to start from.
        ik: Those of the QP.
    """

    def __init__(self, server: viser.ViserServer, robot: Hand, mapping: MappingOptions, ik: IkOptions) -> None:
        self._mapping, self._ik = mapping, ik
        self.handles: dict[str, Any] = {}
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Mapping"):
            for name, (choices, hint) in _CHOICES.items():
                self._add_choice(server, name, choices if robot.is_floating or name != "rigid_from" else ("none",), hint)
            for slider in _MAPPING_SLIDERS:
                self._add_slider(server, slider, getattr(mapping, slider.name))
        with tabs.add_tab("QP"):
            for slider in _IK_SLIDERS:
                self._add_slider(server, slider, getattr(ik, slider.name))
            self.handles["has_velocity_limits"] = server.gui.add_checkbox("speed limits", ik.has_velocity_limits)
        # What the controls show at first may be a rounded or clipped picture of the options; only what the user moves is taken.
        self._shown = self._values()

    def options(self) -> tuple[MappingOptions, IkOptions]:
        """The options as the controls stand now.

        Raises:
            InvalidOptionsError: If they contradict each other.
        """
        moved = {name: value for name, value in self._values().items() if value != self._shown[name]}
        ik = {name: moved.pop(name) for name in list(moved) if name in IkOptions.__slots__}
        if "pivot" in moved:
            moved["pivot_point"] = None
        return replace(self._mapping, **moved), replace(self._ik, **ik)

    def reset(self) -> None:
        """Put every control back to where it was at first."""
        for name, value in self._shown.items():
            self.handles[name].value = value

    def _values(self) -> dict[str, Any]:
        return {name: handle.value for name, handle in self.handles.items()}

    def _add_slider(self, server: viser.ViserServer, slider: _Slider, value: float) -> None:
        # An option beyond the usual range widens it; an infinite one stands at its end.
        low = min(slider.low, value)
        high = max(slider.high, value) if value < float("inf") else slider.high
        self.handles[slider.name] = server.gui.add_slider(
            _label(slider.name), low, high, slider.step, min(value, high), hint=slider.hint
        )

    def _add_choice(self, server: viser.ViserServer, name: str, choices: tuple[str, ...], hint: str) -> None:
        value = getattr(self._mapping, name)
        if value not in choices:
            # A point or a rotation that the user gave in numbers.
            value = value if isinstance(value, str) else _GIVEN
            choices = (*choices, value)
        self.handles[name] = server.gui.add_dropdown(_label(name), choices, initial_value=value, hint=hint)


class PictureControls:
    """What the picture shows.

    Args:
        server: A running viser server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        hint = "Hold each hand in place, or see it travel"
        self.follow = server.gui.add_dropdown("follow", ("hands", "world"), initial_value="hands", hint=hint)
        hint = "What T_def makes of a ball or a cube at the pivot"
        self.shape = server.gui.add_dropdown("deformation", ("ellipsoid", "cube", "off"), initial_value="ellipsoid", hint=hint)

    def apply_to(self, scene: HandScene) -> None:
        """Let the scene know; seen with its next drawing."""
        scene.follow, scene.deformation_shape = self.follow.value, self.shape.value


class SteeringControls:
    """Clutch, picture, options, and a word on what could not be done.

    Args:
        server: A running viser server.
        robot: The robot hand.
        mapping: The options to start from.
        ik: Those of the QP.

    Attributes:
        clutch: The clutch button.
        message: Why the last wish was not fulfilled; not visible where it was.
        picture: What the picture shows.
        options: A slider or a list for every option.
        reset: The button that puts the options back.
    """

    def __init__(self, server: viser.ViserServer, robot: Hand, mapping: MappingOptions, ik: IkOptions) -> None:
        gui = server.gui
        self.clutch = gui.add_button("Release", hint="The robot holds still until you clutch; then it goes on from where it is")
        self.message = gui.add_markdown("", visible=False)
        self.picture = PictureControls(server)
        self.options = OptionControls(server, robot, mapping, ik)
        self.reset = gui.add_button("Reset options and clutch")
        self._wishes: list[str] = []
        self._asked: tuple[MappingOptions, IkOptions] | None = (mapping, ik)
        self.clutch.on_click(lambda _: self._wishes.append("clutch"))
        self.reset.on_click(lambda _: self._wishes.append("reset"))

    def take_wishes(self) -> list[str]:
        """The buttons pressed since the last call, `clutch` and `reset`; the latter has put the options back already."""
        wishes = [self._wishes.pop(0) for _ in range(len(self._wishes))]
        if "reset" in wishes:
            self.options.reset()
        return wishes

    def take_options(self, *, in_any_case: bool = False) -> tuple[MappingOptions, IkOptions] | None:
        """The options, where they are others than at the last call.

        Args:
            in_any_case: Whether to give them although they are not.

        Raises:
            InvalidOptionsError: If they contradict each other.
        """
        self._asked = None if in_any_case else self._asked
        options = self.options.options()
        if options == self._asked:
            return None
        self._asked = options
        return options

    def show_released(self, is_released: bool) -> None:
        """Let the clutch button say what it would do."""
        self.clutch.label = "Clutch" if is_released else "Release"

    def complain(self, error: HandmapError | None) -> None:
        """Say why a wish was not fulfilled, or that the last one was."""
        self.message.visible = error is not None
        self.message.content = "" if error is None else f"**Not possible:** {error}"


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
        self.slider = server.gui.add_slider("time [s]", 0.0, max(round(duration, 2), 0.01), 0.01, 0.0)
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


def _label(name: str) -> str:
    return name.replace("_", " ")


def dock_main_panel(server: viser.ViserServer) -> None:
    """Put what follows to the right of the hands."""
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(330)
