"""`handmap ros2`: a session as topics and services of ROS 2."""

import os
import re
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated

from tyro.conf import Positional, arg

from handmap_qp.apps.arguments import KeyFiles, hinted
from handmap_qp.apps.interrupts import ended_by_signals
from handmap_qp.errors import HandmapError, expect


@dataclass(frozen=True)
class Ros2:
    """Publish the commands of a session in ROS 2, and stop, clear and engage it from there.

    Needs no ROS: it speaks DDS. Topics are joint_commands (JointState) and wrist_command
    (PoseStamped) in the namespace, /CONTROLLER/commands and /CONTROLLER/joint_trajectory for
    ros2_control, and /diagnostics with status and epoch. Ends by Ctrl-C or SIGTERM.

    Examples:
        handmap ros2 lab
        handmap ros2 lab --namespace left --controller left_hand_controller --domain 7

    Attributes:
        session: Public name of the session.
        source: Address of the service's requests.
        namespace: Namespace of topics and services.
        controller: Name of the ros2_control controller.
        domain: Domain of DDS.
        keys: For an encrypted service, the files NAME.key_secret and server.key.
    """

    session: Positional[Annotated[str, arg(metavar="SESSION")]]
    source: Annotated[str, arg(name="from", metavar="HOST[:PORT]")] = "127.0.0.1"
    namespace: str = "handmap"
    controller: str = "hand_controller"
    domain: Annotated[
        str | None, hinted("NUMBER", "(default: ROS_DOMAIN_ID, or 0)")
    ] = None
    keys: KeyFiles = None

    def run(self) -> None:
        """Publish until Ctrl-C."""
        domain = self.domain or os.environ.get("ROS_DOMAIN_ID", "0")
        is_domain = re.fullmatch(r"\d{1,3}", domain) and int(domain) <= 232
        expect(is_domain, "--domain", "0 to 232", value=domain)
        for option in ("namespace", "controller"):
            name = getattr(self, option)
            is_name = re.fullmatch(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", name, re.ASCII)
            expect(
                is_name,
                f"--{option}",
                "letters, digits and _, as left/hand",
                value=name,
            )
        try:
            dds = import_module(".dds", __package__)
        except ModuleNotFoundError as missing:
            advice = "pip install 'packages/ros2[dds]' in a checkout"
            raise HandmapError(
                f"{missing.name} is not installed: {advice}"
            ) from missing
        node = dds.DdsNode(int(domain), self.namespace)
        with ended_by_signals():
            node.follow(self.session, self.source, self.keys, self.controller)
