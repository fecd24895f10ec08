"""A slider, a list or a box for each option.

`OptionControls` returns what the user has changed, and shows the values in force.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.options import Alignment, Pivot, ReferenceAt, RigidFrom
from handmap_qp.mapping.presets import Choice

if TYPE_CHECKING:
    import viser


class _Slider(NamedTuple):
    """Name, range, step and tooltip of a numeric option."""

    name: str
    low: float
    high: float
    step: float
    hint: str


_MAPPING_SLIDERS = (
    _Slider(
        "ridge",
        0.0,
        1.0,
        0.005,
        "Pull of the estimated motion towards a rotation; 0: least squares (eq. 6)",
    ),
    _Slider("scale", 0.0, 3.0, 0.05, "Factor on translations; 1: as the human"),
    _Slider(
        "deformation_gain",
        0.0,
        2.0,
        0.05,
        "Exponent g of the stretch U^g; 1: the paper, 0: no deformation",
    ),
    _Slider(
        "residual_gain",
        0.0,
        1.0,
        0.05,
        "Share of each human point's residual added to its partner's target",
    ),
    _Slider("stretch_min", 0.05, 1.0, 0.05, "Stretches below this value are raised to it"),
    _Slider("stretch_max", 1.0, 5.0, 0.05, "Stretches above this value are lowered to it"),
)
_TELEOPERATION_SLIDERS = (
    _Slider(
        "residual_gain",
        0.0,
        1.0,
        0.05,
        "Share of each finger's residual to T that its partner takes over",
    ),
    _Slider("extension_weight", 0.0, 10.0, 0.1, "Weight of the fingers' extension, per 10 mm"),
    _Slider("thumb_extension_weight", 0.0, 10.0, 0.1, "Weight of the thumb's extension, per 10 mm"),
    _Slider("pinch_weight", 0.0, 20.0, 0.1, "Weight of a pinch, per 10 mm between pads; 0: none"),
    _Slider("scale", 0.0, 2.0, 0.05, "Factor on the palm's translation"),
    _Slider(
        "contact_gap",
        0.0,
        0.04,
        0.001,
        "Distance between the landmarks of thumb and finger where the skin touches [m]",
    ),
    _Slider("ridge", 0.005, 1.0, 0.005, "Pull of the estimated motion towards a rotation"),
)
_IK_SLIDERS = (
    _Slider("point_weight", 0.0, 5.0, 0.05, "Weight of the reference points' positions, per 10 mm"),
    _Slider("wrist_position_weight", 0.0, 10.0, 0.1, "Weight of the wrist's position, per 10 mm"),
    _Slider(
        "wrist_orientation_weight", 0.0, 10.0, 0.1, "Weight of the wrist's orientation, per 0.1 rad"
    ),
    _Slider("rest_weight", 0.0, 3.0, 0.02, "Weight of the distance from the rest angles, per rad"),
    _Slider(
        "damping",
        0.01,
        2.0,
        0.01,
        "Cost of any joint motion; keeps steps short near singular postures",
    ),
    _Slider(
        "error_damping",
        0.0,
        3.0,
        0.05,
        "Levenberg-Marquardt damping: cost of motion that grows with the error",
    ),
    _Slider("speed_weight", 0.0, 10.0, 0.1, "Cost of joint motion within a sample; smooths, lags"),
    _Slider(
        "acceleration_weight",
        0.0,
        20.0,
        0.1,
        "Cost of changes of joint speed from sample to sample; smooths",
    ),
    _Slider("max_iterations", 1, 20, 1, "Largest number of linearisations per sample"),
    _Slider(
        "max_acceleration",
        0.0,
        200.0,
        1.0,
        "Acceleration limit of every coordinate [rad/s², m/s²]; 0: none",
    ),
)
_CHOICES = {
    "rigid_from": (get_args(RigidFrom), "Source of the rigid part T_rb"),
    "pivot": (get_args(Pivot), "Point about which rotation and deformation act"),
    "alignment": (get_args(Alignment), "Rotation from the human's world axes to the robot's"),
    "reference": (get_args(ReferenceAt), "Configuration that T starts from"),
}
_GIVEN = "as given"


def _identity(value: Any) -> Any:
    return value


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
    to_shown: Callable[[Any], Any] = _identity
    to_option: Callable[[Any], Any] = _identity
    taken: Any = None

    def __post_init__(self) -> None:
        """Start from the value shown."""
        self.taken = self.handle.value


class OptionControls:
    """Sliders, lists and boxes for the options; those of another method are hidden.

    Args:
        server: A running viser server.
        robot: The robot hand. With a fixed wrist, `rigid_from` is `none`. Without collision pairs
            in its description, there is no box for self-collision.
        choice: The initial options.
    """

    def __init__(self, server: viser.ViserServer, robot: Hand, choice: Choice) -> None:
        self._gui = server.gui
        self._mapping: dict[str, _Control] = {}
        self._teleoperation: dict[str, _Control] = {}
        self._ik: dict[str, _Control] = {}
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Mapping"):
            self._add_mapping(robot)
            self._add_teleoperation()
        with tabs.add_tab("QP"):
            for slider in _IK_SLIDERS:
                self._add_slider(self._ik, slider)
            self._add_box(
                self._ik,
                "has_velocity_limits",
                "speed limits",
                "Enforce speed limits; position limits always hold",
            )
            if robot.spec.collision is not None:
                self._add_box(
                    self._ik,
                    "avoids_self_collision",
                    "self-collision",
                    "Keep the link pairs of the hand's `collision` key apart",
                )
        self._method = self._mapping
        self.show(choice)

    @property
    def handles(self) -> dict[str, Any]:
        """The viser controls of the method and the QP, by option name."""
        return {name: control.handle for name, control in self._active.items()}

    @property
    def _active(self) -> dict[str, _Control]:
        return self._method | self._ik

    def take_changes(self) -> dict[str, Any]:
        """Return the options that the user has changed since the last call, by name."""
        changes = {}
        for name, control in self._active.items():
            value = control.handle.value
            if value != control.taken:
                control.taken, changes[name] = value, control.to_option(value)
        if "pivot" in changes:
            is_point = self._mapping["pivot"].taken == "point"
            changes["pivot_point"] = self._mapping["pivot_point"].taken if is_point else None
        self._show_point()
        return changes

    def show(self, choice: Choice) -> None:
        """Show the options, except where the user has changed a control since `take_changes`.

        If the method is another one, show its controls instead.
        """
        method = self._teleoperation if choice.is_teleoperation else self._mapping
        if method is not self._method:
            for control in self._method.values():
                # What the user changed last was of the method before.
                control.taken = control.handle.value
        self._method = method
        for controls in (self._mapping, self._teleoperation):
            for control in controls.values():
                if control.handle.visible != (controls is method):
                    control.handle.visible = controls is method
        for controls, part in ((self._method, choice.options), (self._ik, choice.ik)):
            for name, control in controls.items():
                shown = control.to_shown(getattr(part, name))
                if shown != control.taken:
                    control.handle.value = control.taken = shown
        self._show_point()

    def _show_point(self) -> None:
        """Show the pivot point only where it counts."""
        is_used = self._method is self._mapping and self._mapping["pivot"].taken == "point"
        self._mapping["pivot_point"].handle.visible = is_used

    def _add_mapping(self, robot: Hand) -> None:
        for name, (choices, hint) in _CHOICES.items():
            if name == "rigid_from" and not robot.has_moving_wrist:
                choices = ("none",)
            self._add_choice(name, choices, hint)
            if name == "pivot":
                self._add_point()
        for slider in _MAPPING_SLIDERS:
            self._add_slider(self._mapping, slider)

    def _add_teleoperation(self) -> None:
        for slider in _TELEOPERATION_SLIDERS:
            self._add_slider(self._teleoperation, slider)
        self._add_box(
            self._teleoperation,
            "avoids_contact",
            "keep links apart",
            "Keep links apart that do not pinch",
        )

    def _add_slider(self, controls: dict[str, _Control], slider: _Slider) -> None:
        handle = self._gui.add_slider(
            _label(slider.name), slider.low, slider.high, slider.step, slider.low, hint=slider.hint
        )

        def to_shown(value: float | None) -> float:
            # Widen the range to a value outside it; show infinity as the maximum.
            value = 0.0 if value is None else value
            if value < handle.min:
                handle.min = value
            if handle.max < value < float("inf"):
                handle.max = value
            return min(value, handle.max)

        is_optional = slider.name == "max_acceleration"
        controls[slider.name] = _Control(
            handle, to_shown, lambda value: (value or None) if is_optional else value
        )

    def _add_choice(self, name: str, choices: tuple[str, ...], hint: str) -> None:
        handle = self._gui.add_dropdown(_label(name), choices, hint=hint)
        given: list[Any] = []

        def to_shown(value: Any) -> str:
            if not isinstance(value, str):
                # Alignment given as a rotation matrix.
                given[:], value = [value], _GIVEN
            if value not in handle.options:
                handle.options = (*handle.options, value)
            return value

        self._mapping[name] = _Control(
            handle, to_shown, lambda value: given[0] if value == _GIVEN else value
        )

    def _add_point(self) -> None:
        hint = "The pivot if pivot = point, the same in both worlds [m]"
        handle = self._gui.add_vector3("pivot point", (0.0, 0.0, 0.0), step=0.01, hint=hint)
        self._mapping["pivot_point"] = _Control(
            handle, lambda value: handle.value if value is None else tuple(value)
        )

    def _add_box(self, controls: dict[str, _Control], name: str, label: str, hint: str) -> None:
        controls[name] = _Control(self._gui.add_checkbox(label, initial_value=False, hint=hint))


def _label(name: str) -> str:
    return name.replace("_", " ")
