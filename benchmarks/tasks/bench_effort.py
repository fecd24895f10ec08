"""Whether one session holds an egg without breaking it, and then a bottle of 300 g.

    python benchmarks bench_effort --seed 21 --json effort.json --picture effort.png
    python benchmarks bench_effort --robots allegro_right --picks 4 --trials 1 --objects egg

A robot follows every pick of `picks.py` by `GripFollower` with the object's place known. The
wanted force is told as a session does it (`configure`): 2.5 N for the egg, which is gripped gently,
7 N for the bottle. The egg, a ball of 42 mm and 60 g, breaks when one link presses on it with more
than 4 N; pads are soft (a time of contact of 8 ms). Friction is .3 to .8. The mapping is wrong
about the stiffness of the joints by up to 20 %, and commands reach the joints 40 ms late. `--force`
is for both objects, gently below 4 N; `--rough` grips nothing gently.

Forces are measured in every step of the simulation, 2 ms. The force error is that of the thumb's
mean force from .3 s after the touch on, of objects that are held. An object that the open hand
overlaps, or whose pads are less than 15 mm clear of it, is refused: it counts in no share.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import pinocchio as pin
from bench_grips import held_cells, losses
from picks import picks

from handmap_qp import load_hand
from handmap_qp.apps.offline.comparison import prepare_take
from handmap_qp.apps.simulation.commands import find_pinch
from handmap_qp.apps.simulation.gripping import GripScene
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.pinch import PinchTrial, random_trials
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.errors import InvalidInputError
from handmap_qp.mapping.objects import Cylinder, Sphere
from handmap_qp.stream.grip import GripOptions

OBJECTS = {
    "egg": (PinchTrial(Sphere(0.021), 0.06), 2.5),
    "bottle": (PinchTrial(Cylinder(0.02, 0.12), 0.3), 7.0),
}
"""Each object, and the force that is told for it [N]."""
BREAKS = 4.0
"""Force of a link at which the egg breaks [N]."""
BROKEN = "held, but broken"
"""Why an egg that was carried is not held, beside the causes of `simulate`."""
MEASURED = ("whole %", "peak N", "peak p95 N", "error within a fifth %")
"""Columns of `row` that only trials have which could start."""
DELAY = 0.04
"""Time that a command takes to the joints [s]."""
FRICTIONS, GAINS = (0.3, 0.8), (0.8, 1.2)
_SETTLED = 0.3
_SOFT = 8e-3


class EffortScene(GripScene):
    """A pick whose commands come late, and whose forces are measured in every step.

    Attributes:
        peak: Largest force of a link on the object [N].
        forces: Forces of the thumb while the object is gripped [N].
    """

    def prepare(self, force: float, gain: float, *, gentle: bool) -> None:
        """Tell the force [N], and a stiffness that is wrong by a factor."""
        stiffness = gain * self.physics.joint_stiffness
        self._options = GripOptions(stiffness=stiffness, force=force, gentle=gentle)
        self.peak = 0.0
        self.forces: list[float] = []

    def _play(self, simulator: Simulator, start: int) -> Iterator[float]:
        return super()._play(LateSimulator(self, simulator), start)


class LateSimulator(Simulator):
    """A simulator that gets commands late, and notes forces in every step.

    Args:
        scene: Where forces are noted.
        simulator: The simulator.
    """

    def __init__(self, scene: EffortScene, simulator: Simulator) -> None:
        vars(self).update(vars(simulator))
        self._scene = scene
        self._simulator = simulator
        self._waiting: deque[tuple[float, np.ndarray]] = deque()
        self._told = 0.0
        self._gripped = 0.0

    def follow(
        self,
        goal: np.ndarray,
        duration: float,
        others: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> None:
        """Move to the newest command that is old enough, as `Simulator.follow`."""
        self._told += duration
        self._waiting.append((self._told, goal))
        while len(self._waiting) > 1 and self._waiting[1][0] <= self._told - DELAY:
            self._waiting.popleft()
        _, goal = self._waiting[0]
        start = self._simulator.target
        count = max(1, round(duration / self.physics.time_step))
        for share in np.arange(1, count + 1) / count:
            now = pin.interpolate(self.hand.model, start, goal, share)
            self._simulator.follow(now, duration / count, others)
            self._note(duration / count)

    def _note(self, duration: float) -> None:
        pressing = self.pressing()
        scene = self._scene
        scene.peak = max(scene.peak, *pressing.values(), 0.0)
        thumb = sum(pressing.get(name, 0.0) for name in scene.pads._of_thumb)
        is_gripped = thumb > 0.0 and len(pressing) > 1
        self._gripped = self._gripped + duration if is_gripped else 0.0
        if self._gripped > _SETTLED:
            scene.forces.append(thumb)


def tried(
    scene: EffortScene,
    what: str,
    trial: PinchTrial,
    force: float,
    gain: float,
    *,
    gentle: bool,
) -> dict[str, Any]:
    """Return what became of an object."""
    scene.prepare(force, gain, gentle=gentle)
    try:
        outcome = scene.run(trial)
    except InvalidInputError as error:
        return {"held": None, "refused": str(error)}
    mean = float(np.mean(scene.forces)) if scene.forces else np.nan
    is_whole = what != "egg" or scene.peak <= BREAKS
    return {
        "held": bool(outcome.is_held and is_whole),
        "whole": is_whole,
        "peak N": scene.peak,
        "error": mean / force - 1.0 if outcome.is_held else np.nan,
        "friction": trial.friction,
        "gain": gain,
        "loss": outcome.loss or ("" if is_whole else BROKEN),
    }


def row(name: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Summarise trials in a row of a table."""
    shown, done, held = held_cells(name, found)
    if not done:
        return shown | dict.fromkeys(MEASURED, "-")
    peaks = [each["peak N"] for each in done]
    errors = np.abs([each["error"] for each in held])
    return shown | {
        "whole %": round(100.0 * np.mean([each["whole"] for each in done])),
        "peak N": round(float(np.median(peaks)), 1),
        "peak p95 N": round(float(np.percentile(peaks, 95.0)), 1),
        "error within a fifth %": round(100.0 * np.mean(errors < 0.2)) if held else "-",
    }


def draw_peaks(found: Sequence[dict[str, Any]]) -> Any:
    """Draw the largest force on each object over friction, with the egg's limit."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.5), layout="constrained")
    axes = figure.subplots()
    for k, what in enumerate(OBJECTS):
        for is_held, marker in ((True, "o"), (False, "x")):
            shown = [e for e in found if e["object"] == what and e["held"] is is_held]
            axes.plot(
                [each["friction"] for each in shown],
                [each["peak N"] for each in shown],
                marker,
                color=common.PALETTE[k],
                label=f"{what}, {'held' if is_held else 'not held'}",
            )
    axes.axhline(BREAKS, color="black", linewidth=1)
    axes.set(xlabel="friction", ylabel="largest force of a link [N]", ylim=(0.0, 25.0))
    axes.legend()
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Simulate all trials, print the tables, and write them."""
    parser = common.make_parser((__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=list(common.ROBOTS))
    parser.add_argument("--trials", type=int, default=3, help="for each recording")
    parser.add_argument("--picks", type=int, default=None, help="only the first ones")
    parser.add_argument(
        "--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS)
    )
    parser.add_argument("--force", type=float, default=None, help="for both [N]")
    parser.add_argument("--rough", action="store_true", help="grip nothing gently")
    parser.add_argument("--seed", type=int, default=0)
    arguments = common.parse_arguments(parser, words)
    if arguments.quick:
        arguments.robots, arguments.trials, arguments.picks = ["allegro_right"], 1, 1
    recordings = list(picks(common.find_recordings(arguments.recordings)))
    recordings = recordings[: arguments.picks]
    found: list[dict[str, Any]] = []
    with common.progress("gripping", len(recordings) * len(arguments.robots)) as done:
        for robot in arguments.robots:
            hand = load_hand(robot)
            physics = Physics(gravity=(0.0, -9.81, 0.0), contact_time=_SOFT)
            for k, recording in enumerate(recordings):
                seed = 1000 * arguments.seed + k
                random = np.random.default_rng(seed)
                window = find_pinch(recording, takes_fists=True)
                take = prepare_take(recording, hand.side)
                scene = EffortScene(take, hand, window, physics, sees=True)
                for what, (nominal, told) in OBJECTS.items():
                    for one in random_trials(
                        arguments.trials, seed, "nominal", nominal
                    ):
                        trial = one._replace(friction=random.uniform(*FRICTIONS))
                        where = {"robot": robot, "object": what}
                        where["recording"] = recording.name
                        force = arguments.force or told
                        gain = random.uniform(*GAINS)
                        # Drawn all the same, so that the others stay as they are.
                        if what not in arguments.objects:
                            continue
                        gentle = force < BREAKS and not arguments.rough
                        became = tried(scene, what, trial, force, gain, gentle=gentle)
                        found.append(where | became)
                done()
    to_stderr = arguments.json == "-"
    keys = ("object",), ("robot", "object"), ("recording", "object")
    ending = f", seed {arguments.seed}"
    common.print_groups(found, keys, row, ending, to_stderr=to_stderr)
    if causes := losses(found, "object"):
        title = f"Why objects were not held{ending}"
        common.print_table(title, causes, to_stderr=to_stderr)
    tried_ones = [each for each in found if each["held"] is not None]
    common.save_picture(arguments.picture, lambda: draw_peaks(tried_ones))
    results = {"seed": arguments.seed, "trials": found}
    common.write_json(arguments.json, "bench_effort", results)


if __name__ == "__main__":
    main()
