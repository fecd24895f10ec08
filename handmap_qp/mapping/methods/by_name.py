"""The mapping methods that come with the package, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import MappingProxyType

from handmap_qp.mapping.method import Method
from handmap_qp.mapping.methods.fingertip_vectors import FingertipVectors
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.mapping.methods.joint_to_joint import JointToJoint
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.mapping.methods.virtual_ellipsoid import VirtualEllipsoid
from handmap_qp.mapping.methods.virtual_sphere import VirtualSphere

METHODS: MappingProxyType[str, Callable[[], Method]] = MappingProxyType(
    {
        "homogeneous": Homogeneous,
        "teleoperation": Teleoperation,
        "fingertip-vectors": FingertipVectors,
        "finger-vectors": partial(FingertipVectors, origin="knuckle"),
        "joint-to-joint": JointToJoint,
        "virtual-sphere": VirtualSphere,
        "virtual-ellipsoid": VirtualEllipsoid,
    }
)
"""Constructor of each method, by the name that a user gives."""
