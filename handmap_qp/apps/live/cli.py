"""`handmap track`: send live samples of a human hand to the service, or record them."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from handmap_core.errors import HandmapError, InvalidInputError, expect
from handmap_qp.apps.arguments import FileSide, KeyFiles, OpenSession, hinted
from handmap_qp.apps.interrupts import ended_by_signals
from handmap_qp.apps.tables import print_result
from handmap_qp.hands import Values, load_hand, sided_name
from handmap_qp.human import read_person
from handmap_qp.trackers import read_recording
from .mediapipe_source import MediapipeSource, environment_python, install_environment
from .source import Recorder, Replay, Sink, Source, run

_RARE = (
    "lost",
    "not_in_order",
    "hand_lost",
    "flags",
    "refusals",
    "last_refusal",
    "unanswered",
    "reopened",
    "troubles",
)
"""Rows of the table that are left out if there is nothing to count."""


@dataclass(frozen=True)
class Target:
    """Where samples go: to the service, into a file, or both.

    Attributes:
        to: Address of the service's requests.
        robot: Robot hand that the service moves; `handmap hands` lists those of the package.
        record: Recording to write (.npz or .csv).
        session: Public name of the session.
        preset: What the mapping is for, as in `handmap retarget`.
        person: File of the person's hand, of `handmap calibrate`.
        shared: Let other clients engage and configure the session, clear its stops, and say where
            the robot's joints are, so that it grips.
        keys: For an encrypted service, the files NAME.key_secret and server.key.
        json: Print the summary as one JSON object instead of a table.
    """

    to: Annotated[str | None, hinted("HOST[:PORT]", "(port: 5570)")] = None
    robot: Annotated[str | None, hinted("HAND", "")] = None
    record: Annotated[Path | None, hinted("FILE", "(default: no file)")] = None
    session: Annotated[str | None, hinted("NAME", "(default: made up)")] = None
    preset: Annotated[
        str | None, hinted("PRESET", "(default: the service decides)")
    ] = None
    person: Annotated[
        Path | None, hinted("PERSON.yaml", "(default: measured in the first samples)")
    ] = None
    shared: bool = False
    keys: KeyFiles = None
    json: bool = False

    def check(self) -> None:
        """Refuse options that contradict each other, before any work.

        Raises:
            InvalidInputError: With the option at fault.
        """
        where = "--to HOST, --record FILE.npz or both"
        expect(self.to or self.record, "", where, advice="samples need a place to go")
        if not self.to:
            for name in ("robot", "session", "preset", "person", "keys"):
                if getattr(self, name) is not None:
                    raise InvalidInputError("needs --to", argument=f"--{name}")
            if self.shared:
                raise InvalidInputError("needs --to", argument="--shared")
        elif not self.robot:
            raise InvalidInputError(
                "missing",
                argument="--robot",
                advice="name a hand that `handmap hands` lists",
            )

    def send(self, source: Source) -> None:
        """Send the samples of a source here until it ends or Ctrl-C, and print a summary.

        Raises:
            InvalidInputError: If the service cannot be reached, refuses the session or every
                sample, or the file cannot be written.
        """
        sinks: list[Sink] = []
        if self.record:
            sinks.append(Recorder(self.record, "--record", source.upright))
        if self.to and self.robot:
            # It needs the extra `service`, as the commands without it do not.
            from .service import ServiceSink

            sinks.append(
                ServiceSink(
                    self.to,
                    self.robot,
                    source.side,
                    person=read_person(self.person) if self.person else None,
                    keys=self.keys,
                    name=self.session,
                    preset=self.preset,
                    is_shared=self.shared or None,
                    # Servers before this field refuse it.
                    upright=source.upright or None,
                )
            )
        summary = send(source, sinks, is_json=self.json)
        if summary.get("refusals") and not summary["accepted"]:
            raise InvalidInputError(
                f"the service refused every sample: {summary['last_refusal']}"
            )

    def lead(self, source: Source) -> None:
        """Send the samples of a source: the former name of `send`."""
        self.send(source)


TargetFlags = Annotated[Target, arg(name="")]
"""Where the samples of a command go."""


@dataclass(frozen=True)
class TrackReplay:
    """Play a recording as if it were live.

    Examples:
        handmap track replay demo.npz --to 127.0.0.1 --robot allegro_right
        handmap track replay demo.npz --speed 2 --loop --to 127.0.0.1 --robot hey5

    Attributes:
        recording: Recording of a human hand, as for `handmap retarget`.
        speed: Factor on the speed of time, 0.01 to 100.
        loop: Start again at the end, until Ctrl-C.
        side: Which hand the recording is of, where the file does not say.
        fps: Samples a second, in place of the time in the file; needed where it has none.
        target: Where the samples go.
    """

    recording: Positional[Annotated[Path, arg(metavar="RECORDING")]]
    speed: float = 1.0
    loop: bool = False
    side: FileSide = None
    fps: float | None = None
    target: TargetFlags = Target()

    def run(self) -> None:
        """Replay the recording until its end or Ctrl-C."""
        self.target.check()
        robot = sided_name(self.target.robot or "", "right")
        side = None
        with suppress(HandmapError):  # the service may have hands that are not here
            side = load_hand(robot).side
        recording = read_recording(self.recording, self.side or side, fps=self.fps)
        self.target.send(Replay(recording, speed=self.speed, loop=self.loop))


@dataclass(eq=False)
class TrackMediapipe(MediapipeSource):
    """Track a hand in a camera's picture or a video file with MediaPipe.

    MediaPipe needs an older numpy, so it runs in an environment of its own: make it once by
    --install (0.3 GB). A video is played at its own speed, or as fast as possible with --record
    alone. The hand's distance follows from the camera's field of view.

    Examples:
        handmap track mediapipe --install
        handmap track mediapipe --camera 0 --to 127.0.0.1 --robot allegro_right
        handmap track mediapipe --video hand.mp4 --side left --record hand.npz

    Attributes:
        install: Make the environment of MediaPipe, and end.
        target: Where the samples go.
    """

    install: bool = False
    target: TargetFlags = Target()

    def run(self) -> None:
        """Track until the video ends or Ctrl-C."""
        if self.install:
            folder = install_environment(print)
            size = sum(file.lstat().st_size for file in folder.rglob("*"))
            print(f"MediaPipe is ready in {folder} ({size / 1e6:.0f} MB)")
            return
        self.target.check()
        # Check it before a session is opened.
        environment_python()
        self.is_paced = self.target.to is not None
        self.target.send(self)


@dataclass(frozen=True)
class TrackRecord:
    """Record the human samples of a session of the service.

    Works beside a headset's page, `handmap track` in another terminal, or a program of your own
    that opens its session with has_detail. Ends with the session or by Ctrl-C.

    Examples:
        handmap track record session.npz --from 127.0.0.1
        handmap track record right.npz --from 127.0.0.1 --session webxr-right

    Attributes:
        out: Recording to write (.npz or .csv); one that exists is replaced at the end.
        source: Address of the service's requests.
        session: Public name of the session.
        keys: For an encrypted service, the files NAME.key_secret and server.key.
        json: Print the summary as one JSON object instead of a table.
    """

    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    source: Annotated[
        str,
        arg(name="from", metavar="HOST[:PORT]", help_behavior_hint="(port: 5570)"),
    ]
    session: OpenSession = None
    keys: KeyFiles = None
    json: bool = False

    def run(self) -> None:
        """Record until the session ends or Ctrl-C."""
        recorder = Recorder(self.out, "OUT")
        # It needs the extra `service`, as the commands without it do not.
        from .service import ServiceSource

        source = ServiceSource(self.source, session=self.session, keys=self.keys)
        recorder.upright = source.upright
        send(source, [recorder], is_json=self.json)


def send(source: Source, sinks: Sequence[Sink], *, is_json: bool) -> Values:
    """Send samples to sinks until the source ends or Ctrl-C; print and return a summary.

    Args:
        source: The samples.
        sinks: Where each sample goes.
        is_json: Print the summary as one JSON object instead of a table.

    Returns:
        The summary, by label.
    """
    # The state in one line on stderr, if stderr is a terminal.
    line = Console(stderr=True).status("waiting for the first sample")
    with ended_by_signals(), line:
        summary = run(source, sinks, line.update)
    # Labels in words, counts by name in one line.
    rows = {
        name.replace("_", " "): ", ".join(
            f"{text}: {count}" for text, count in value.items()
        )
        if isinstance(value, dict)
        else value
        for name, value in summary.items()
        if value or name not in _RARE
    }
    print_result(summary, {source.name: rows}, as_json=is_json)
    return summary
