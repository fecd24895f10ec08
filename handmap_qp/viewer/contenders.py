"""Mappings that the view can compare with the one that its controls change, by name."""

from __future__ import annotations

from typing import NamedTuple

from handmap_qp.errors import HandmapError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.method import Method
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.mapping.options import Alignment, Rotation
from handmap_qp.mapping.presets import Choice, possible_presets
from handmap_qp.offline.compared_methods import method_by_name, own_methods
from handmap_qp.viewer.option_table import option_texts


class Contender(NamedTuple):
    """A method with QP weights.

    Attributes:
        label: Its name.
        method: The method.
        ik: The QP's weights.
    """

    label: str
    method: Method
    ik: IkOptions

    @property
    def alignment(self) -> Alignment | Rotation:
        """Rotation from the human's world axes to the robot's, as of `MappingOptions`."""
        method = self.method
        return method.options.alignment if isinstance(method, Homogeneous) else "world"

    @property
    def options(self) -> dict[str, tuple[str, bool]]:
        """Its options as text, and whether each differs from its default."""
        method = self.method
        own = method.options if isinstance(method, Homogeneous) else method
        return option_texts(own, self.ik)


def contender_of(choice: Choice, label: str) -> Contender:
    """Return a preset with its options under another name."""
    return Contender(label, choice.method, choice.ik)


def named_contender(name: str, contact_gap: float | None) -> Contender:
    """Return a preset or a method with its own options.

    Args:
        name: One of `contender_names`.
        contact_gap: The measured contact gap [m]; the preset's if omitted.
    """
    return Contender(name, *method_by_name(name, contact_gap))


def contender_names(human: Hand, robot: Hand) -> tuple[str, ...]:
    """Return the names of presets and methods that two hands can be mapped with.

    Args:
        human: The hand that leads.
        robot: The hand that follows.
    """
    presets = possible_presets(human, robot)
    others = [name for name in own_methods() if name not in presets]
    return (*presets, *(name for name in others if _fits(name, human, robot)))


def _fits(name: str, human: Hand, robot: Hand) -> bool:
    try:
        method_by_name(name)[0].bind(human, robot)
    except HandmapError:
        return False
    return True
