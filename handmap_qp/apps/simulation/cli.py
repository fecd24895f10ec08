"""The command `handmap simulate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from handmap_qp.apps.arguments import (
    FileSide,
    HandName,
    InputArguments,
    Recordings,
    hinted,
)
from handmap_qp.apps.offline.comparison import own_methods
from handmap_qp.apps.tables import print_result, progress
from handmap_qp.errors import InvalidInputError, expect
from handmap_qp.hands import (
    Hand,
    Names,
    Values,
    hand_sides,
    is_robot,
    load_whole,
    sided_name,
)
from handmap_qp.human import axis_direction
from handmap_qp.mapping import parse_object
from handmap_qp.output_files import check_output
from handmap_qp.stream import has_grasp
from handmap_qp.trackers import save_npz
from .commands import chosen_methods, map_pinch, read_pick
from .gripping import GripScene
from .physics import Physics
from .pictures import film, picture, write_page
from .pinch import (
    Objects,
    PinchOutcome,
    PinchScene,
    PinchTrial,
    describe_trial,
    outcome_row,
    random_trials,
    trial_row,
)
from .simulator import Episode

Outcomes = dict[str, dict[int, PinchOutcome]]
"""By the mapping's name and the trial's index; objects that overlap its hand are left out."""
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
_FILES = {
    "out": (".npz",),
    "picture": (".png",),
    "film": (".gif", ".webp", ".png"),
    "html": (".html", ".htm"),
}
"""Options that name a file to write, and its suffixes."""


@dataclass(frozen=True)
class Simulate:
    """Simulate a mapped hand that holds an object, with contacts, friction and gravity.

    The recording shows a pinch: an object stands where the robot's pads meet. It must stay between
    them until the human opens the hand. With --trials, random objects and places are tried, and the
    table shows how many were held by every mapping.

    A robot with both hands follows both; the hand that pinches longest holds the object.

    Links touch the object, not each other. Actuators are springs with critical damping.

    Examples:
        handmap simulate pinch.npz --robot allegro_right --film pinch.gif
        handmap simulate left.npz right.npz --robot g1 --film pinch.gif
        handmap simulate pinch.npz --robot allegro_right --trials 200 --methods teleoperation object
        handmap simulate pinch.npz --robot allegro_right --stiffness 6 --html pinch.html
        handmap simulate pinch.npz --robot allegro_right --trials 50 --grip grip+place

    Attributes:
        recordings: Recording with a pinch of thumb and index finger; for a robot with both hands,
            of both in one file or in two.
        robot: Robot hand, by name or by the path of its hand.yaml; `allegro` is the Allegro of the
            recording's side. Or a robot with both hands: a
            name of `handmap robots list`, or the path of its robot.yaml.
        methods: Mappings, as of `handmap compare`.
        peers: Folder of the program that runs outside methods, such as benchmarks/peers.
        grip: One mapping more: the first preset, and what thumb and finger meet is held with 5 N by
            the measured joints alone (grip), or with the object's place known too (grip+place). If
            omitted, `grip` where no --methods are named and the hand can; `off` for none.
        object: box:SIDE, box:XxYxZ, sphere:DIAMETER, cylinder:DIAMETERxLENGTH [m], or a mesh file.
        mass: Mass of the object [kg].
        friction: Coulomb coefficient.
        stiffness: Stiffness of the fingers' actuators [N m/rad].
        torque: Largest torque of the fingers' actuators [N m]; 1000 stands for none but the URDF's.
        up: World axis against gravity; y if omitted, z for a robot with both hands.
        side: Which hand the recording is of, where the file does not say.
        fps: Samples a second, in place of the time in the file; needed where it has none.
        trials: Random objects and places, for every mapping.
        objects: Random objects (varied), or the same object at random places (nominal).
        seed: Seed of the random numbers.
        out: File of the first mapping's simulation, .npz.
        picture: Picture of four instants of the first mapping, .png.
        film: Moving picture of the first mapping, .gif or .webp.
        html: Page that plays every mapping in a browser without a server, .html.
        json: Print one JSON object instead of a table.
    """

    recordings: Recordings
    robot: HandName = "three_finger"
    methods: Annotated[Names, hinted("METHOD...", "(default: the first preset)")] = ()
    peers: Annotated[Path | None, hinted("FOLDER")] = None
    grip: Literal["grip", "grip+place", "off"] | None = None
    object: Annotated[str, arg(metavar="OBJECT")] = "box:0.03"
    mass: Annotated[float, arg(metavar="KG")] = 0.05
    friction: float = 0.8
    stiffness: float = 3.0
    torque: float = 1e3
    up: Up | None = None
    side: FileSide = None
    fps: float | None = None
    trials: int = 0
    objects: Objects = "varied"
    seed: int = 0
    out: Annotated[Path | None, hinted("FILE.npz")] = None
    picture: Annotated[Path | None, hinted("FILE.png")] = None
    film: Annotated[Path | None, hinted("FILE.gif")] = None
    html: Annotated[Path | None, hinted("PAGE.html")] = None
    json: bool = False

    def run(self) -> None:
        """Simulate, print a table, and write the files."""
        shape = parse_object(self.object, is_centred=True)
        trial = PinchTrial(shape, self.mass, self.friction)
        self._check(trial)
        trials = [trial]
        if self.trials:
            trials = random_trials(self.trials, self.seed, self.objects, trial)
        outcomes = self._simulate(trials)
        found: Values = {"robot": self.robot, "seed": self.seed}
        if self.trials:
            found["rows"] = [
                trial_row(name, [*made.values()]) | {"refused": len(trials) - len(made)}
                for name, made in outcomes.items()
            ]
            found["trials"] = [
                describe_trial(trial) | _by_whom(outcomes, i)
                for i, trial in enumerate(trials)
            ]
        else:
            found["rows"] = [
                outcome_row(name, made[0]) for name, made in outcomes.items()
            ]
            self._write({name: made[0].episode for name, made in outcomes.items()})
        files = filter(None, map(vars(self).get, _FILES))
        tables = {f"{self.robot}: simulated": found["rows"]}
        print_result(found, tables, files, as_json=self.json)

    def _check(self, trial: PinchTrial) -> None:
        """Reject options that contradict each other, before any work is done."""
        is_whole = self.grip not in (None, "off") and is_robot(self.robot)
        expect(not is_whole, "--grip", "a robot with one hand", value=self.robot)
        problem = advice = ""
        if self.objects == "varied" and trial != PinchTrial():
            problem = "draws object, mass and friction"
            advice = "add --objects nominal to draw places alone"
        for name, endings in _FILES.items():
            if path := getattr(self, name):
                check_output(f"--{name}", path, endings)
                problem, advice = "writes no file", ""
        if self.trials and problem:
            raise InvalidInputError(
                problem, argument="--trials", value=self.trials, advice=advice
            )

    def _physics(self) -> Physics:
        up = self.up or ("z" if is_robot(self.robot) else "y")
        # An axis without a sign is the positive one.
        x, y, z = (0.0 - 9.81 * axis_direction(f"{up:+>2}")).tolist()
        return Physics(
            friction=self.friction,
            joint_stiffness=self.stiffness,
            torque=self.torque,
            gravity=(x, y, z),
        )

    def _simulate(self, trials: list[PinchTrial]) -> Outcomes:
        """Pinch every object by every mapping."""
        name = self.robot
        inputs = InputArguments(side=self.side, fps=self.fps)
        if hand_sides(name) and self.recordings:
            name = sided_name(name, inputs.side_of(self.recordings[0]))
        methods = chosen_methods(self.methods, self.peers, name)
        robot = load_whole(name)
        outcomes: Outcomes = {}
        physics = self._physics()
        mapped, window = map_pinch(methods, robot, self.recordings, inputs)
        scenes = {
            method.name: PinchScene(commands, window, physics)
            for method, commands in zip(methods, mapped, strict=True)
        }
        if grip := self._grip_of(robot):
            take, window = read_pick(robot, self.recordings, inputs)
            name = f"{own_methods()[0]}+{grip}"
            sees = grip == "grip+place"
            scenes[name] = GripScene(take, robot, window, physics, sees)
        for name, scene in scenes.items():
            made = outcomes[name] = {}
            with progress(name, len(trials)) as advance:
                for i, trial in enumerate(trials):
                    try:
                        made[i] = scene.run(trial)
                    except InvalidInputError:
                        # A grip that nobody has asked for is left out where none can start.
                        is_asked = len(outcomes) <= len(methods) or self.grip
                        if i + 1 == len(trials) and not made and is_asked:
                            raise
                    advance(i + 1)
        return {name: made for name, made in outcomes.items() if made}

    def _grip_of(self, robot: Hand) -> str:
        """Return how the first preset grips; nothing if it is not to be simulated."""
        if self.grip is not None:
            return "" if self.grip == "off" else self.grip
        is_plain = not (self.methods or robot.parts)
        return "grip" if is_plain and has_grasp(robot) else ""

    def _write(self, episodes: dict[str, Episode]) -> None:
        """Write the files: of the first mapping; the page shows all."""
        episode = next(iter(episodes.values()))
        if self.out:
            save_npz(self.out, episode.columns)
        if self.picture:
            picture(episode, self.picture)
        if self.film:
            film(episode, self.film)
        if self.html:
            write_page(self.html, episodes, f"{self.robot}, simulated")


def _by_whom(outcomes: Outcomes, trial: int) -> dict[str, list[str]]:
    """Return which mappings tried an object, and which held it."""
    tried = [name for name in outcomes if trial in outcomes[name]]
    held = [name for name in tried if outcomes[name][trial].is_held]
    return {"tried": tried, "held": held}
