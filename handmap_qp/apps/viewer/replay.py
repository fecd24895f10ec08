"""A recording, mapped by one method or two (`Replay`), and in the browser (`ReplayViewer`)."""

from collections.abc import Iterator
from contextlib import suppress
from functools import partial

import numpy as np

from handmap_core.errors import HandmapError, InvalidInputError
from handmap_qp.hands import Hand, Names, Side, Values
from handmap_qp.human import HumanMotion, Recording
from handmap_qp.mapping import (
    Choice,
    HandMapper,
    MapStep,
    RobotMapper,
    find_alignment,
    fist_time,
    options_text,
    parse_object,
    possible_presets,
    preset_choice,
    slow_note,
    surface,
)
from handmap_qp.stream import Follower, RobotFollower, follow_recording, paired
from .controls import (
    KEPT,
    NOTHING,
    PlayBar,
    SteeringControls,
    Window,
    reporting,
    say,
)
from .page import make_page
from .sample import HumanView, Variant, ViewSample
from .serving import ViserServer


class Replay:
    """A recording, mapped as a whole and again whenever options change.

    Landmarks are mapped as they were measured. Joint angles are fitted for drawing only.

    Args:
        human: The human hand, scaled to the person, with the reference points to use; for several,
            as one (`joined`).
        robot: The robot hand; for a robot with several, likewise.
        choice: Preset and options.
        *seen: A recording, and the joint angles and wrist poses fitted to it (`fit_recording`); for
            a robot with several hands, those of each in its order.

    Attributes:
        human: The human hand.
        time: Time since the first instant of the longest recording [s], shape (T,).
        choice: Preset and options of `variant`.
        switches: Sample indices at which the user released (True) or clutched (False).
        variant: The robot as `choice` moves it.
        other: The robot as another method moves it; None if nothing is compared.
        compared: The preset of `other`, or `KEPT`; `NOTHING` if nothing is compared.

    Raises:
        InvalidInputError: If no sample of the first motion is valid.
        HandmapError: If the options do not fit the hands.
    """

    def __init__(
        self,
        human: Hand,
        robot: Hand,
        choice: Choice,
        *seen: tuple[Recording, HumanMotion],
    ) -> None:
        self._recording, motion = seen[0]
        if not motion.valid.any():
            raise InvalidInputError(
                "no sample is valid, there is nothing to show", argument="motion"
            )
        self.human = human
        self._seen = seen
        self._time = max((each.time for each, _ in self._seen), key=len)
        self.time = self._time - self._time[0]
        self.switches: dict[int, bool] = {}
        self._robot = robot
        self._first = human.hands[0], robot.hands[0]
        self.other: Variant | None = None
        self.compared = NOTHING
        self.remap(choice)

    @property
    def variants(self) -> tuple[Variant, ...]:
        """The robots to show: `variant`, and `other` if there is one."""
        return (self.variant, self.other) if self.other else (self.variant,)

    @property
    def slow_note(self) -> str:
        """A line if the robot's joints are slower than a person; empty if not, or not known."""
        with suppress(HandmapError):
            return slow_note(fist_time(self.human, self._robot))
        return ""

    @property
    def presets(self) -> Names:
        """The presets that these hands can be mapped with."""
        return possible_presets(*self._first)

    def preset(self, name: str) -> Choice:
        """Return a preset with its own options, the measured contact gap and alignment."""
        human, robot = self._first
        choice = preset_choice(name, human)
        upright = self._recording.upright
        return choice.with_changes(find_alignment(choice.method, robot, upright))

    def options_text(self) -> str:
        """Return the text of a file with the options in force."""
        return options_text(self.choice, self.preset(self.choice.preset))

    def page(self) -> bytes:
        """Return a page of the recording, with the mapping that it is compared with."""
        methods = " against ".join(variant.label for variant in self.variants)
        title = f"{self._recording.name} on {self.variant.robot.name}, {methods}"
        return make_page(title, self.human, self.variants)

    def remap(self, choice: Choice) -> None:
        """Map the whole recording with another preset or other options.

        Args:
            choice: Preset and options.

        Raises:
            HandmapError: If the options cannot be used; the replay is then unchanged.
        """
        label = choice.preset
        if self.preset(label).changes_to(choice):
            label += ", changed"
        variant = self._map(choice, label)
        other = self.other
        if other and other.choice and self._other_switches != self.switches:
            # Both robots are released and clutched at the same samples.
            other = self._map(other.choice, other.label)
        self.variant = variant
        self.choice = choice
        self.other = other
        self._other_switches = dict(self.switches)

    def compare(self, name: str) -> None:
        """Map the recording by another method too.

        Args:
            name: Its preset; `KEPT` for the robot as it is now, `NOTHING` to end the comparison.

        Raises:
            HandmapError: If it cannot be used; the replay is then unchanged.
        """
        if name == KEPT:
            self.other = self.variant._replace(label=f"{self.variant.label}, kept")
        else:
            self.other = None if name == NOTHING else self._map(self.preset(name), name)
        self.compared = name
        self._other_switches = dict(self.switches)

    def switch(self, request: str, index: int) -> None:
        """Note a `release` or `clutch` at a sample; `reset` forgets all of them."""
        if request == "reset":
            self.switches.clear()
        elif request in ("release", "clutch"):
            self.switches[index] = request == "release"

    def is_released(self, index: int) -> bool:
        """Return whether the robot is released at a sample."""
        earlier = [i for i in self.switches if i <= index]
        return bool(earlier) and self.switches[max(earlier)]

    def _map(self, choice: Choice, label: str) -> Variant:
        robot = self._robot
        if robot.parts:
            humans = self.human.by_side
            both = RobotMapper(robot, humans, choice.method, ik=choice.ik)
            mapper: HandMapper | RobotMapper = both
            samples = paired({each.side: each for each, _ in self._seen})
            mapped: Iterator[MapStep] = map(RobotFollower(both).map_samples, samples)
        else:
            mapper = HandMapper(self.human, robot, choice.method, ik=choice.ik)
            mapped = follow_recording(Follower(mapper), self._recording)
        steps: list[MapStep] = []
        for i in range(len(self.time)):
            if i in self.switches:
                (mapper.release if self.switches[i] else mapper.clutch)()
            steps.append(next(mapped))
        # Until the hand is first seen, show the reference.
        followed = [not step.is_held for step in steps]
        first = int(np.argmax(followed))
        steps[:first] = [steps[first]] * first
        shown = tuple(
            self._sample(i, step, followed[i]) for i, step in enumerate(steps)
        )
        shape = self._recording.object_shape
        is_held = any(sample.object_pose is not None for sample in shown)
        solid = surface(parse_object(shape)) if is_held else None
        return Variant(label, mapper.robot, choice, shown, solid)

    def _sample(self, i: int, step: MapStep, is_seen: bool) -> ViewSample:
        """Return what the view shows of one step of a mapper."""
        hands: dict[Side, MapStep] = getattr(step, "hands", {})
        led = [*hands.values()] or [step]
        goals: Values = {}
        if step.status != "released":
            goals["targets"] = step.targets
            goals["wrist_error"] = np.max([each.wrist_error for each in led], axis=0)
        return ViewSample(
            **goals,
            time=float(self.time[i]),
            robot_q=step.command.q,
            robot_wrist=step.command.wrist,
            robot_points=step.points,
            object_pose=step.diagnostics.get("object_pose"),
            is_limited=step.at_bound,
            status=step.status,
            held_by=step.held_by,
            rule=step.rule,
            duration=step.duration,
            is_seen=is_seen,
            humans=[
                self._human(i, each, *seen)
                for each, seen in zip(led, self._seen, strict=True)
            ],
        )

    def _human(
        self, i: int, step: MapStep, recording: Recording, fitted: HumanMotion
    ) -> HumanView:
        """Return what the view shows of a human hand, by the step of the robot's."""
        results = step.diagnostics
        # Its newest sample.
        k = np.searchsorted(recording.time[1:], self._time[i], "right")
        return HumanView(
            step.human_points,
            fitted.q[k],
            fitted.wrist[k],
            recording.landmarks[k] if recording.valid[k] else None,
            results.get("motion_deformation"),
            results.get("pivot_image"),
        )


class ReplayViewer(Window):
    """Show a recording, and map it again whenever the preset or an option changes.

    Args:
        replay: The recording.

    Attributes:
        replay: The recording.
        play_bar: Play, pause, scrub.
        slow_text: Whether the robot's joints are slower than a person; hidden if not.
        steering: Preset, comparison, clutch and options.
    """

    def __init__(self, server: ViserServer, replay: Replay) -> None:
        self.server = server
        self.replay = replay
        super().__init__(
            server, replay.human, replay.variants, replay.options_text, replay.page
        )
        # Options count from `_base`: the initial ones, or those of a preset chosen later.
        self._start = self._base = replay.choice
        self._changes: Values = {}
        self._pending = []
        with self.control:
            self.play_bar = PlayBar(server, float(replay.time[-1]))
            self.slow_text = server.gui.add_markdown("", visible=False)
            say(self.slow_text, replay.slow_note)
            self.steering = SteeringControls(
                server, self._start, replay.presets, replay.compared
            )
        self.tick(0.0)

    @property
    def index(self) -> int:
        """Index of the sample that is shown."""
        now = self.play_bar.time + 0.005
        return int(np.searchsorted(self.replay.time, now, side="right")) - 1

    @property
    def sample(self) -> ViewSample:
        """The sample of the first robot that is shown."""
        return self.replay.variant.samples[self.index]

    def tick(self, elapsed: float) -> None:
        """Carry out the user's requests, advance time, and draw.

        Args:
            elapsed: Time since the last call [s]; 0 also updates the gauges at once.
        """
        self.play_bar.advance(elapsed)
        self._take_requests()
        self._map_pending()
        self.draw(self.replay.variants, self.index, at_once=elapsed == 0.0)
        self.steering.show_released(self.replay.is_released(self.index))

    def _take_requests(self) -> None:
        """Note what the user has requested; a preset or Reset overrides changed options."""
        steering = self.steering
        replay = self.replay
        changes = steering.take_changes()
        requests = steering.take_requests()
        preset = changes.pop("preset", None)
        compared = changes.pop("compare", None)
        if preset or "reset" in requests:
            self._base = self._start if "reset" in requests else replay.preset(preset)
            self._changes = {}
            changes = {}
            steering.show_choice(self._base)
        for request in requests:
            replay.switch(request, self.index)
        self._changes |= changes
        if preset or changes or set(requests) - {"keep"}:
            self._pending.append(
                lambda: replay.remap(self._base.with_changes(self._changes))
            )
        if "keep" in requests:
            compared = KEPT
        if compared:
            self._pending.append(partial(replay.compare, compared))

    def _map_pending(self) -> None:
        """Map as requested, and show why if that is not possible."""
        while self._pending:
            with reporting(self.steering.message, "mapping …"):
                # The request stays pending if this fails (`skip_wakeup_race`).
                self.server.flush()
                self._pending.pop(0)()
                self.set_variants(self.replay.variants)
            self.steering.controls["compare"].show(self.replay.compared)
