"""A recording, mapped as a whole, by one method or by two: `Replay`."""

from __future__ import annotations

from collections.abc import Sequence

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.human.recording import HumanMotion, Recording, recording_samples
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.presets import Choice, possible_presets, preset_choice
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.smoothing import Smoothing
from handmap_qp.viewer.sample import Variant, ViewSample, view_sample


class Replay:
    """A recording, mapped as a whole and again whenever options change.

    Landmarks are mapped as they were measured. Joint angles are fitted for drawing only.

    Args:
        recording: The recording.
        motion: Joint angles and wrist poses fitted to it (`fit_recording`).
        human: The human hand, scaled to the person, with the reference points to use.
        robot: The robot hand.
        choice: Preset and options.
        smoothing: How samples are smoothed; not at all if omitted.
        contact_gap: The measured contact gap [m], for other presets than the one chosen.

    Attributes:
        human: The human hand.
        time: Time since the first instant [s], shape (T,).
        choice: Preset and options of `variant`.
        switches: Sample indices at which the user released (True) or clutched (False).
        variant: The robot as `choice` moves it.
        other: The robot as another method moves it; None if nothing is compared.

    Raises:
        InvalidInputError: If no sample of the motion is valid.
        HandmapError: If the options do not fit the hands.
    """

    def __init__(
        self,
        recording: Recording,
        motion: HumanMotion,
        human: Hand,
        robot: Hand,
        choice: Choice,
        *,
        smoothing: Smoothing | None = None,
        contact_gap: float | None = None,
    ) -> None:
        if not motion.valid.any():
            raise InvalidInputError(
                argument="motion", problem="no sample is valid, there is nothing to show"
            )
        self.human = human
        self.time = motion.time - motion.time[0]
        self.switches: dict[int, bool] = {}
        self._recording, self._motion, self._given_robot = recording, motion, robot
        self._smoothing, self.contact_gap = smoothing, contact_gap
        self.other: Variant | None = None
        self.remap(choice)

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self._recording.name

    @property
    def robot(self) -> Hand:
        """The robot hand, with the reference points that the method moves."""
        return self.variant.robot

    @property
    def samples(self) -> Sequence[ViewSample]:
        """The samples of `variant`, one per instant."""
        return self.variant.samples

    @property
    def variants(self) -> tuple[Variant, ...]:
        """The robots to show: `variant`, and `other` if there is one."""
        return (self.variant,) if self.other is None else (self.variant, self.other)

    @property
    def presets(self) -> tuple[str, ...]:
        """The presets that these hands can be mapped with."""
        return possible_presets(self.human, self._given_robot)

    def preset(self, name: str) -> Choice:
        """Return a preset with its own options and the measured contact gap."""
        return preset_choice(name, self.contact_gap)

    def remap(self, choice: Choice) -> None:
        """Map the whole recording with another preset or other options.

        Args:
            choice: Preset and options.

        Raises:
            HandmapError: If the options cannot be used; the replay is then unchanged.
        """
        is_changed = bool(self.preset(choice.preset).changes_to(choice))
        label = f"{choice.preset}, changed" if is_changed else choice.preset
        variant, other = self._map(choice, label), self.other
        if other is not None and self._other_switches != self.switches:
            # Both robots are released and clutched at the same samples.
            other = self._map(other.choice, other.label)
        self.variant, self.choice, self.other = variant, choice, other
        self._other_switches = dict(self.switches)

    def compare(self, choice: Choice | None, label: str = "") -> None:
        """Map the recording by another method too.

        Args:
            choice: Preset and options; None to end the comparison.
            label: Its name; that of the preset if omitted.

        Raises:
            HandmapError: If it cannot be used; the replay is then unchanged.
        """
        self.other = None if choice is None else self._map(choice, label or choice.preset)
        self._other_switches = dict(self.switches)

    def is_released(self, index: int) -> bool:
        """Return whether the robot is released at a sample."""
        earlier = [i for i in self.switches if i <= index]
        return bool(earlier) and self.switches[max(earlier)]

    def _map(self, choice: Choice, label: str) -> Variant:
        mapper = HandMapper(
            self.human,
            self._given_robot,
            choice.method,
            ik=choice.ik,
        )
        follower = Follower(mapper, smoothing=self._smoothing)
        motion, recording, steps = self._motion, self._recording, []
        for i, sample in enumerate(recording_samples(recording)):
            if i in self.switches:
                (mapper.release if self.switches[i] else mapper.clutch)()
            steps.append(follower.map_sample(sample))
        # Until the hand is first seen, show the reference.
        followed = [not step.is_held for step in steps]
        first = followed.index(True) if any(followed) else 0
        steps[:first] = [steps[first]] * first
        samples = tuple(
            view_sample(
                float(self.time[i]),
                step,
                human_q=motion.q[i],
                human_wrist=motion.wrist[i],
                landmarks=recording.landmarks[i] if recording.valid[i] else None,
                is_seen=followed[i],
            )
            for i, step in enumerate(steps)
        )
        return Variant(label, mapper.robot, choice, samples)
