"""The command `handmap view`."""

from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from handmap_core.errors import InvalidInputError, did_you_mean, expect, require
from handmap_qp.apps.addresses import check_port
from handmap_qp.apps.arguments import (
    InputArguments,
    InputFlags,
    KeyFiles,
    MappingArguments,
    MappingFlags,
    OpenSession,
    PersonFile,
    hinted,
    person_of,
    read_robot,
)
from handmap_qp.hands import joined
from handmap_qp.human import fit_recording
from handmap_qp.mapping import possible_presets
from handmap_qp.output_files import check_output, replaced_file
from .live import LiveViewer
from .replay import Replay, ReplayViewer
from .serving import run_frames, showing


@dataclass(frozen=True)
class View:
    """Show a mapping in the browser, and change its preset and options while it plays.

    Shows the human hand and the robot hand side by side, their reference points and targets, the
    deformation T_def as an ellipsoid, the robot's joints between their limits, point and wrist
    errors, pinch gaps [mm], and the time per step [us]. A second method can be compared with the
    first. Ctrl-C ends the view.

    Examples:
        handmap view recording.npz --robot allegro_right
        handmap view demo --robot allegro_right --compare fingertip-vectors
        handmap view left.npz right.npz --robot g1
        handmap view recording.npz --robot three_finger --html page.html
        handmap view --live 127.0.0.1      (beside a running handmap serve)

    Attributes:
        recording: Recording of a human hand, as for `handmap retarget`; for a robot with both
            hands, of one of them or of both.
        robot: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml; `allegro`
            is the Allegro of the recording's side. Or a robot with both hands: a name of
            `handmap robots list`, or the path of its robot.yaml.
            Required for a recording. A service names its own.
        other: Recording of the other hand.
        live: Show a session of a running mapping service instead of a recording. Its client must
            have opened it with has_detail or is_shared. A shared session can also be steered.
        session: Name of the service's session.
        keys: For an encrypted service, the files NAME.key_secret and server.key.
        mirror: Map the mirror image of a recording of the other hand.
        person: File of the person's hand, of `handmap calibrate`.
        compare: Preset or method that a second robot follows the same hand by, as for
            `handmap compare`.
        html: Write the recording as a page that plays without a server, and end.
        host: Address to listen on. Everyone who can reach it can use the view, so keep it on
            loopback unless you trust the network.
        port: Port to listen on. The next free one is taken if it is in use.
        open: Open the browser.
        inputs: How the recording is to be read.
        arguments: Preset, reference points and initial options, for a recording only.
    """

    recording: Positional[
        Annotated[Path | None, hinted("[RECORDING]", "(or give --live)")]
    ] = None
    robot: Annotated[str | None, hinted("HAND", "(default: the service's)")] = None
    other: Positional[
        Annotated[Path | None, hinted("[RECORDING]", "(of the other hand)")]
    ] = None
    live: Annotated[str | None, hinted("HOST[:PORT]", "(port: 5570)")] = None
    session: OpenSession = None
    keys: KeyFiles = None
    mirror: bool = False
    person: PersonFile = None
    compare: Annotated[str | None, hinted("METHOD")] = None
    html: Annotated[Path | None, hinted("PAGE.html", "(default: serve)")] = None
    host: str = "127.0.0.1"
    port: int = 8080
    open: bool = False
    inputs: InputFlags = InputArguments()
    arguments: MappingFlags = MappingArguments()

    def run(self) -> None:
        """Map the recording or connect to the service, and show it until interrupted."""
        # Check first: mapping takes a while.
        require("viser", "view")
        check_port("--port", self.port)
        is_one = (self.recording is None) != (self.live is None)
        expect(is_one, "", "either a recording or --live HOST")
        self._refuse_unused_options()
        if self.live is not None:
            self._show_live(self.live)
        elif self.recording:
            if self.robot is None:
                raise InvalidInputError(
                    "missing",
                    argument="--robot",
                    advice="name a hand that `handmap hands list` prints",
                )
            if self.html:
                check_output("--html", self.html, (".html", ".htm"))
            replay = self.replay(self.recording, self.robot)
            if not self.html:
                with showing(self.host, self.port, opens=self.open) as server:
                    run_frames(ReplayViewer(server, replay).tick)
                return
            page = replay.page()
            with replaced_file(self.html, "--html") as stream:
                stream.write(page)
            print(f"wrote {self.html}")

    def _refuse_unused_options(self) -> None:
        """Refuse options that would have no effect."""
        changed = self.arguments.changed()
        usual = vars(View())
        values = vars(self) | vars(self.inputs) | dict.fromkeys(changed, "given")
        problems = dict.fromkeys(("session", "keys"), "needs --live")
        if self.html:
            problems |= dict.fromkeys(
                ("host", "port", "open"), "has no effect with --html"
            )
        if self.live is not None:
            problems = dict.fromkeys(
                ("mirror", "compare", "layout", "side"), "needs a recording"
            )
            problems["html"] = "needs a recording: a running session has no end"
            chosen = "needs a recording: the service's client chooses it"
            problems |= dict.fromkeys(("person", *changed), chosen)
        for name, problem in problems.items():
            if values[name] != usual.get(name):
                option = f"--{name.removeprefix('--')}"
                raise InvalidInputError(problem, argument=option)

    def _show_live(self, live: str) -> None:
        # It needs the extra `service`, as the view of a recording does not.
        from .remote import ServiceSession

        # Connect before serving, so that a missing session is reported at once.
        connect = partial(ServiceSession, live, robot=self.robot, keys=self.keys)
        source = connect(session=self.session)
        try:
            with showing(self.host, self.port, opens=self.open) as server:
                while True:
                    with closing(LiveViewer(server, source)) as window:
                        # Until interrupted, or until its hands have changed.
                        run_frames(window.tick, partial(getattr, source, "is_outdated"))
                    server.gui.reset()
                    server.scene.reset()
                    source = connect(session=source.name)
        finally:
            source.close()

    def replay(self, file: Path, name: str) -> Replay:
        """Return a recording mapped to a robot, as the view shows it."""
        files = [file, self.other] if self.other else [file]
        robot, recordings = read_robot(name, files, self)
        lengths = person_of(recordings, self.person).lengths
        motions = [fit_recording(each, lengths=lengths) for each in recordings]
        humans = [m.human.with_points(self.arguments.human_points) for m in motions]
        human = joined("human", *humans)
        names = possible_presets(humans[0], robot.hands[0])
        compared = self.compare
        expect(
            compared in (None, *names),
            "--compare",
            f"one of {', '.join(names)}",
            value=compared,
            advice=did_you_mean(compared or "", names),
        )
        upright = recordings[0].upright
        choice = self.arguments.preset_for(humans[0], robot.hands[0], upright)
        replay = Replay(human, robot, choice, *zip(recordings, motions, strict=True))
        if compared:
            replay.compare(compared)
        return replay
