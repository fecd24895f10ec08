"""The command `handmap view`."""

from __future__ import annotations

import importlib.util
import sys
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from handmap_qp.errors import InvalidInputError, MissingExtraError
from handmap_qp.ik.options import IkOptions
from handmap_qp.options import MappingOptions

if TYPE_CHECKING:
    from handmap_qp.viewer.samples import Replay


@dataclass(frozen=True)
class View:
    """Look at a mapping in the browser, and change its options while it plays.

    Shows the human hand and the robot hand side by side, reference points and targets, what T_def makes of a ball, the robot's
    joints between their limits, errors and timing.

    Examples: `handmap view recording.npz --robot allegro_right`, or
    `handmap view recording.npz --robot three_finger --html page.html` for a page that plays without a server.

    Attributes:
        recording: Recording of a human hand, as for `handmap map`.
        robot: Robot hand: a name that `handmap hands` lists, or the path of a hand.yaml.
        html: Write a page that plays by itself to this file, and end.
        host: Address to serve on. Whoever reaches it can use the view: leave it on loopback unless you trust the network.
        port: Port to serve on; the next free one where it is taken.
        open: Open the browser.
        human_points: Reference points on the human hand: the name of a set.
        robot_points: Reference points on the robot hand: the name of a set; its own default if omitted.
        mapping: How the human's motion becomes the robot's, to start with.
        ik: Weights and settings of the QP, to start with.
    """

    recording: tyro.conf.Positional[Path]
    robot: str
    html: Path | None = None
    host: str = "127.0.0.1"
    port: int = 8080
    open: bool = False
    human_points: str | None = None
    robot_points: str | None = None
    mapping: Annotated[MappingOptions, tyro.conf.arg(name="")] = field(default_factory=MappingOptions)
    ik: Annotated[IkOptions, tyro.conf.arg(name="ik")] = field(default_factory=IkOptions)

    def run(self) -> None:
        """Read, fit, map, and show until interrupted."""
        # Said first, for the rest takes a while.
        if importlib.util.find_spec("viser") is None:
            raise MissingExtraError("viser", "view")
        if not 0 <= self.port <= 65535:
            raise InvalidInputError(f"--port: expected 0 to 65535, got {self.port}", value=self.port)

        from handmap_qp.viewer.app import ReplayViewer
        from handmap_qp.viewer.page import check_page, write_page
        from handmap_qp.viewer.scene import serving

        page = None if self.html is None else check_page(self.html)
        replay = self._replay()
        if page is not None:
            with serving() as server:
                write_page(page, server, replay)
            print(f"wrote {page}")
            return
        with serving(self.host, self.port) as server:
            viewer = ReplayViewer(server, replay)
            address = f"http://{server.get_host()}:{server.get_port()}"
            print(f"showing {self.recording.stem} on {replay.robot.name} at {address} (Ctrl-C ends it)")
            sys.stdout.flush()
            if self.open:
                webbrowser.open(address)
            viewer.run()

    def _replay(self) -> Replay:
        from handmap_qp.library import load_hand
        from handmap_qp.recording import read_recording
        from handmap_qp.trackers.landmarks import fit_recording
        from handmap_qp.viewer.samples import Replay

        recording = read_recording(self.recording)
        robot = load_hand(self.robot, points=self.robot_points)
        motion = fit_recording(recording)
        return Replay(motion, motion.human.with_points(self.human_points), robot, self.mapping, self.ik)
