"""The command `handmap simulate`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from handmap_qp.arguments import HandName
from handmap_qp.errors import InvalidInputError, MissingExtraError
from handmap_qp.output_files import check_output
from handmap_qp.tables import print_rows, progress

if TYPE_CHECKING:
    from handmap_qp.hands.hand import Hand
    from handmap_qp.simulation.actuators import Actuators
    from handmap_qp.simulation.episode import Episode
    from handmap_qp.simulation.grip import GripForce
    from handmap_qp.simulation.physics import Body, Physics
    from handmap_qp.simulation.pinch import PinchScene, PinchTrial

Up = Literal["x", "y", "z", "-x", "-y", "-z"]
_FILMS = (".gif", ".webp", ".png")
_FRICTION = 0.8


def _optional(metavar: str, default: str) -> Any:
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


@dataclass(frozen=True)
class Simulate:
    """Simulate a mapped hand that holds an object, with contacts, friction and gravity.

    With a recording of a pinch: an object stands where the robot's pads meet. It must stay between
    them until the human opens the hand. With --trials, random objects and places are tried, and the
    table shows how many were held by every mapping.

    Without a recording: the paper's experiment (Sec. IV). The human's and the robot's hand hold the
    object in planned grasps. The human's wrist follows an arc while a synergy is activated.

    Links touch the object, not each other. Actuators are springs with critical damping: servos, or
    motors that are told torques. The hand's own weight is compensated.

    Examples:
        handmap simulate pinch.npz --robot allegro_right --film pinch.gif
        handmap simulate pinch.npz --robot allegro_right --trials 200 --methods teleoperation object
        handmap simulate --robot three_finger --gamma 0.5 --actuators torque --html arc.html
        handmap simulate --robot allegro_right --serve lab --object sphere:0.04

    Attributes:
        recording: Recording with a pinch of thumb and index finger; the paper's arc if omitted.
        robot: Robot hand, by name or by the path of its hand.yaml.
        methods: Mappings, as of `handmap compare`; for a recording.
        peers: Folder of the program that runs outside methods, such as benchmarks/peers.
        object: box:SIDE, box:XxYxZ, sphere:DIAMETER, cylinder:DIAMETERxLENGTH [m], or a mesh file.
        mass: Mass of the object [kg].
        friction: Coulomb coefficient.
        stiffness: Stiffness of the fingers' actuators [N m/rad].
        actuators: Servos that are told positions, or motors that are told the torques of this
            stiffness; on the arc the human's synergy is then soft too, as in Sec. IV.
        up: World axis against gravity.
        trials: Random objects and places, for every mapping; for a recording.
        objects: Random objects (varied), or the same object at random places (nominal).
        seed: Seed of the random numbers.
        grip: Force between the pads [N] that a squeeze term keeps while they press on the object,
            for a recording.
        synergy: Synergy that the human activates, for the arc.
        gamma: Its activation at the end.
        fingers: Inverse kinematics of the robot's fingers, for the arc.
        squeeze: Planned normal force of every contact [N], for the arc.
        out: File of the robot's simulation, .npz.
        picture: Picture of four instants, or of the success of trials, .png.
        film: Moving picture, .gif or .webp.
        html: Page that plays in a browser without a server, .html: every mapping, or both hands.
        serve: Name of a session of the mapping service to follow as a stand-in for its robot,
            until Ctrl-C; no recording then.
        server: Address of that service.
        duration: Time to follow it [s].
        json: Print one JSON object instead of a table.
    """

    recording: tyro.conf.Positional[
        Annotated[Path | None, _optional("[RECORDING]", "the paper's arc")]
    ] = None
    robot: HandName = "three_finger"
    methods: tuple[str, ...] = ("teleoperation",)
    peers: Annotated[Path | None, _optional("FOLDER", "none")] = None
    object: Annotated[str | None, _optional("OBJECT", "box:0.03, or box:0.05 on the arc")] = None
    mass: Annotated[float | None, _optional("KG", "0.05, or 0.1 on the arc")] = None
    friction: float = _FRICTION
    stiffness: float = 3.0
    actuators: Literal["position", "torque"] = "position"
    up: Annotated[Up | None, _optional("AXIS", "y for a recording, z for the arc")] = None
    trials: int = 0
    objects: Literal["nominal", "varied"] = "varied"
    seed: int = 0
    grip: Annotated[float | None, _optional("N", "position control alone")] = None
    synergy: Literal[1, 2, 3] = 1
    gamma: float = 0.5
    fingers: Literal["pseudoinverse", "clipped", "damped", "qp", "frozen"] = "qp"
    squeeze: float = 4.0
    out: Annotated[Path | None, _optional("FILE.npz", "none")] = None
    picture: Annotated[Path | None, _optional("FILE.png", "none")] = None
    film: Annotated[Path | None, _optional("FILE.gif", "none")] = None
    html: Annotated[Path | None, _optional("PAGE.html", "none")] = None
    serve: Annotated[str | None, _optional("SESSION", "none")] = None
    server: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "tcp://127.0.0.1:5570"
    duration: Annotated[float, _optional("SECONDS", "until Ctrl-C")] = math.inf
    json: bool = False

    def run(self) -> None:
        """Simulate, print a table, and write the files."""
        for option, path, suffixes in (
            ("--out", self.out, (".npz",)),
            ("--picture", self.picture, (".png",)),
            ("--film", self.film, _FILMS),
            ("--html", self.html, (".html", ".htm")),
        ):
            if path is not None:
                check_output(option, path, suffixes)
        if self.trials and (self.recording is None or any((self.out, self.film, self.html))):
            raise InvalidInputError(
                argument="--trials",
                problem="needs a recording, and writes no file but --picture",
                value=self.trials,
            )
        is_given = self.object is not None or self.mass is not None or self.friction != _FRICTION
        if self.trials and self.objects == "varied" and is_given:
            raise InvalidInputError(
                argument="--trials",
                problem="draws object, mass and friction",
                value=self.trials,
                advice="add --objects nominal to draw places alone",
            )
        if self.serve is not None:
            self._stand_in(self.serve)
            return
        if self.recording is not None and self.trials:
            self._trials(self.recording)
            return
        rows, episodes = self._arc() if self.recording is None else self._pinches(self.recording)
        if self.json:
            print(json.dumps({"robot": self.robot, "seed": self.seed, "rows": rows}))
        else:
            print_rows(f"{self.robot}: simulated", rows)
        self._write(episodes)

    def _physics(self) -> Physics:
        from handmap_qp.simulation.physics import Physics

        axis = self.up or ("z" if self.recording is None else "y")
        sign = 9.81 if axis.startswith("-") else -9.81
        gravity = tuple(sign * (axis[-1] == name) + 0.0 for name in "xyz")
        return Physics(
            friction=self.friction,
            joint_stiffness=self.stiffness,
            gravity=(gravity[0], gravity[1], gravity[2]),
        )

    def _actuators(self) -> Actuators:
        from handmap_qp.simulation.actuators import PositionActuators, TorqueActuators

        return TorqueActuators() if self.actuators == "torque" else PositionActuators()

    def _body(self) -> Body:
        from handmap_qp.simulation.physics import Body
        from handmap_qp.simulation.shapes import parse_object

        size, mass = ("box:0.05", 0.1) if self.recording is None else ("box:0.03", 0.05)
        return Body(parse_object(self.object or size), mass if self.mass is None else self.mass)

    def _robot(self) -> Hand:
        from handmap_qp.hands.library import load_hand

        return load_hand(self.robot)

    def _stand_in(self, session: str) -> None:
        """Follow a session of the mapping service."""
        try:
            from handmap_qp.client import Client, ServiceError, ServiceTimeoutError
        except ImportError as missing:
            raise MissingExtraError(str(missing.name), "service") from missing
        from handmap_qp.simulation.simulator import Simulator
        from handmap_qp.simulation.stand_in import Report, StandIn

        if self.recording is not None:
            raise InvalidInputError(argument="--serve", problem="takes no recording", value=session)

        def show(report: Report) -> None:
            print(
                f"{report.time:7.1f} s  {report.commands} commands, epoch {report.epoch}, wrist "
                f"{1e3 * report.wrist_error:.1f} mm off, {report.touching} links press with "
                f"{report.force:.1f} N",
                flush=True,
            )

        simulator = Simulator(self._robot(), self._body(), self._physics(), self._actuators())
        try:
            with Client(self.server) as client:
                StandIn(simulator, client, session).run(self.duration, show)
        except (ServiceError, ServiceTimeoutError, ValueError) as error:
            if isinstance(error, InvalidInputError):
                raise
            raise InvalidInputError(
                argument="--serve", problem=str(error), value=session
            ) from error

    def _arc(self) -> tuple[list[dict[str, Any]], dict[str, Episode]]:
        """Carry the object with both hands along the paper's arc."""
        from handmap_qp.experiments.section_four import Setting
        from handmap_qp.simulation.arc import ArcOptions, arc_row, carry_along_arc, planned_scene

        setting = Setting(
            synergy=self.synergy, gamma=self.gamma, fingers=self.fingers, ridge=_RIDGE
        )
        body, physics, robot = self._body(), self._physics(), self._robot()
        with progress("planning grasps") as advance:
            scene = planned_scene(robot, body.shape, seed=self.seed, progress=advance)
        options = ArcOptions(normal_force=self.squeeze)
        outcome = carry_along_arc(scene, setting, body.mass, physics, options, self.actuators)
        episodes = {"robot": outcome.robot.episode, "human": outcome.human.episode}
        return [arc_row(outcome)], episodes

    def _scenes(self, recording: Path) -> Iterator[tuple[str, PinchScene]]:
        """Map a pinch by every mapping."""
        from handmap_qp.offline.comparison import prepare_take
        from handmap_qp.simulation.mapped import chosen_methods, map_commands
        from handmap_qp.simulation.pinch import PinchScene
        from handmap_qp.simulation.pinch_window import find_pinch
        from handmap_qp.trackers.recording import read_recording

        read, robot, physics = read_recording(recording), self._robot(), self._physics()
        methods = chosen_methods(self.methods, self.peers, self.robot)
        window, take = find_pinch(read), prepare_take(read, robot.spec.side)
        actuators = self._actuators()
        for method in methods:
            commands = map_commands(method, take, robot)
            yield method.name, PinchScene(commands, window, physics, actuators)

    def _trial(self) -> PinchTrial:
        from handmap_qp.simulation.pinch import PinchTrial

        body = self._body()
        return PinchTrial(shape=body.shape, mass=body.mass, friction=self.friction)

    def _regulator(self) -> GripForce | None:
        from handmap_qp.simulation.grip import GripForce

        return None if self.grip is None else GripForce(self.grip)

    def _pinches(self, recording: Path) -> tuple[list[dict[str, Any]], dict[str, Episode]]:
        """Pinch one object by every mapping."""
        from handmap_qp.simulation.trials import outcome_row

        trial, grip = self._trial(), self._regulator()
        outcomes = {name: scene.run(trial, grip) for name, scene in self._scenes(recording)}
        rows = [outcome_row(name, outcome) for name, outcome in outcomes.items()]
        return rows, {name: outcome.episode for name, outcome in outcomes.items()}

    def _trials(self, recording: Path) -> None:
        """Pinch many objects by every mapping; print and draw which are held."""
        from handmap_qp.simulation.breakdown import draw_splits, split_rows
        from handmap_qp.simulation.trials import (
            describe_trial,
            random_trials,
            run_trials,
            trial_row,
        )

        drawn = random_trials(self.trials, self.seed, self.objects, self._trial())
        grip = self._regulator()
        rows: list[dict[str, Any]] = []
        held: dict[str, list[bool]] = {}
        for name, scene in self._scenes(recording):
            with progress(name, len(drawn)) as advance:
                outcomes = run_trials(scene, drawn, advance, grip)
            rows.append(trial_row(name, outcomes))
            held[name] = [outcome.is_held for outcome in outcomes]
        if self.json:
            trials = [
                {**describe_trial(trial), "held": [name for name in held if held[name][i]]}
                for i, trial in enumerate(drawn)
            ]
            found = {"robot": self.robot, "seed": self.seed, "rows": rows, "trials": trials}
            print(json.dumps(found))
        else:
            print_rows(f"{self.robot}: simulated, seed {self.seed}", rows)
            print_rows("Which objects are held", split_rows(drawn, held))
        if self.picture is not None:
            title = f"{recording.stem} on {self.robot}: {len(drawn)} pinches, seed {self.seed}"
            draw_splits(self.picture, title, drawn, held)
            if not self.json:
                print(f"wrote {self.picture}")

    def _write(self, episodes: dict[str, Episode]) -> None:
        """Write the files: of the robot, or of the first mapping; the page shows all."""
        import numpy as np

        from handmap_qp.offline.trajectory import save_npz
        from handmap_qp.simulation.film import Stage, film, picture
        from handmap_qp.simulation.page import write_page

        written, episode = [], next(iter(episodes.values()))
        up = -np.array(self._physics().gravity)
        if self.out is not None:
            save_npz(self.out, episode.columns)
            written.append(self.out)
        if self.picture is not None or self.film is not None:
            stage = Stage(episode, up)
            if self.picture is not None:
                picture(stage, self.picture)
                written.append(self.picture)
            if self.film is not None:
                with progress("rendering") as advance:
                    film(stage, self.film, progress=advance)
                written.append(self.film)
        if self.html is not None:
            with progress("writing the page") as advance:
                write_page(self.html, episodes, up, f"{self.robot} - handmap simulate", advance)
            written.append(self.html)
        if not self.json:
            for path in written:
                print(f"wrote {path}")


# Three contacts do not determine T without a ridge, nor do contacts in one plane.
_RIDGE = 0.1
