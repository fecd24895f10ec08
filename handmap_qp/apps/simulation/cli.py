"""The command `handmap simulate`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from handmap_core.errors import InvalidInputError, expect
from handmap_qp.apps.arguments import (
    FileSide,
    HandName,
    InputArguments,
    Recordings,
    hinted,
)
from handmap_qp.apps.offline.comparison import own_methods
from handmap_qp.apps.tables import Row, print_result
from handmap_qp.hands import (
    Hand,
    Names,
    Values,
    hand_sides,
    is_robot,
    load_whole,
    sided_name,
    torque_limits,
)
from handmap_qp.mapping import parse_object, surface
from handmap_qp.output_files import check_output
from handmap_qp.stream import has_grasp
from handmap_qp.trackers import save_npz
from .commands import GripName, chosen_methods, map_pinch, map_take, read_pick
from .gripping import GripScene
from .pad_motion import PersonPads, meeting_row
from .physics import Physics, choose_gravity
from .pictures import film, picture, write_page
from .pinch import (
    Objects,
    PinchOutcome,
    PinchScene,
    PinchTrial,
    random_errors,
    random_trials,
)
from .pinch_rows import describe_trial
from .tried import (
    Tried,
    fates,
    in_the_way_cell,
    loss_rows,
    single_row,
    tried_row,
    try_all,
)

Up = Literal["x", "y", "z", "-x", "-y", "-z"]
_FILES = {
    "out": (".npz",),
    "picture": (".png",),
    "film": (".gif", ".webp", ".png"),
    "html": (".html", ".htm"),
}
"""Options that name a file to write, and its suffixes."""
# Pads are so far from the object at the start: in trials, and at least for a single object [m].
_CLEAR_IN_TRIALS, _CLEAR_AT_LEAST = 0.015, 0.005


@dataclass(frozen=True)
class Simulate:
    """Simulate a mapped hand that holds an object, with contacts, friction and gravity.

    The recording shows a pick: an open hand pinches with thumb and index finger. An object stands
    where the robot's pads meet, and must stay between them until the human opens the hand. It is
    there while the hand is still open; other fingers that are then in its place, or come through it
    as after pointing, touch it once they have left. Each object that is not held has its cause.
    With --trials, random objects and places are tried, and the tables show how many were held by
    every mapping, and why the others were not. A fist is no pick: thumb and index finger must face
    each other.

    A robot with both hands follows both; the hand that pinches longest holds the object.

    Links touch the object, not each other. Actuators are springs with critical damping.

    Examples:
        handmap simulate demo --robot allegro_right --picture demo.png
        handmap simulate pinch --robot allegro_right --film pinch.gif
        handmap simulate pinch --robot allegro_right --methods teleoperation dexi-dexpilot
        handmap simulate left.npz right.npz --robot g1 --film pinch.gif
        handmap simulate pinch --robot allegro_right --trials 200 --methods teleoperation object
        handmap simulate pinch --robot allegro_right --stiffness 6 --html pinch.html
        handmap simulate pinch --robot allegro_right --trials 50 --grip grip+place5

    Attributes:
        recordings: Recording with a pinch of thumb and index finger; `demo` and `pinch` come with
            the package. For a robot with both hands, of both in one file or in two.
        robot: Robot hand, by name or by the path of its hand.yaml; `allegro` is the Allegro of the
            recording's side. Or a robot with both hands: a
            name of `handmap robots list`, or the path of its robot.yaml.
        methods: Mappings, as in `handmap compare`; peers by name too, such as dexi-dexpilot.
        peers: Folder of a program that runs further outside methods.
        grip: One mapping more: the first preset, and what thumb and finger meet is held with 5 N by
            the measured joints alone (grip), or with the object's place known too (grip+place), or
            with that place known with an error (grip+place5): its standard deviation is 5 mm along
            each axis, or another number of millimetres. The mapping knows that number, and --seed
            draws the error. If omitted, `grip` where no --methods are named and the hand can; `off`
            for none.
        object: box:SIDE, box:XxYxZ, sphere:DIAMETER, cylinder:DIAMETERxLENGTH [m], or a mesh file.
        mass: Mass of the object [kg].
        friction: Coulomb coefficient.
        stiffness: Stiffness of the fingers' actuators [N m/rad].
        sliding_stiffness: The same of joints that slide, such as those of jaws [N/m].
        torque: Largest torque of the fingers' actuators [N m], beside the URDF's; the maker's if
            omitted. 1000 leaves the URDF's alone.
        up: World axis against gravity; the recording's if omitted, or that of a robot with both
            hands. Where the recording does not say, y is assumed.
        place: The object stands where each mapping's own pads meet (robot), or where the person's
            would, on a hand of the robot's size (person): the same place for every mapping.
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
    grip: Annotated[
        str | None,
        hinted(
            "{grip,grip+place,grip+placeMM,off}", "(default: grip, if the hand can)"
        ),
    ] = None
    object: Annotated[str, arg(metavar="OBJECT")] = "box:0.03"
    mass: Annotated[float, arg(metavar="KG")] = 0.05
    friction: float = 0.8
    stiffness: float = Physics().joint_stiffness
    sliding_stiffness: float = Physics().sliding_stiffness
    torque: Annotated[float | None, hinted("FLOAT", "(default: the maker's)")] = None
    up: Annotated[
        Up | None, hinted("{x,y,z,-x,-y,-z}", "(default: the recording's)")
    ] = None
    place: Literal["robot", "person"] = "robot"
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
        """Simulate, print tables and what was assumed, and write the files."""
        shape = parse_object(self.object, is_centred=True)
        trial = PinchTrial(shape, self.mass, self.friction)
        self._check(trial)
        (error,) = random_errors(1, self.seed)
        trials = [trial._replace(place_error=error)]
        if self.trials:
            trials = random_trials(self.trials, self.seed, self.objects, trial)
        scenes, assumed, person = self._scenes()
        tried = {name: try_all(name, scene, trials) for name, scene in scenes.items()}
        if not any(one.outcomes for one in tried.values()):
            first = next(iter(tried.values()))
            raise first.refusals[len(trials) - 1]
        found: Values = {"robot": self.robot, "seed": self.seed, "assumed": assumed}
        tables = {f"{self.robot}: simulated": self._rows(tried)}
        found["rows"] = tables[f"{self.robot}: simulated"]
        if self.trials:
            found["trials"] = [
                describe_trial(trial) | fates(tried, i)
                for i, trial in enumerate(trials)
            ]
            found["losses"] = {name: one.losses for name, one in tried.items()}
            tables["Why objects were not held"] = loss_rows(tried)
        else:
            outcomes = {n: one.outcomes[0] for n, one in tried.items() if one.outcomes}
            assumed |= in_the_way_cell(outcomes)
            self._write(outcomes)
        if person:
            width = float(surface(shape).extents[0])
            found["pads"] = [
                meeting_row(name, person.offset(scene.closing, width))
                for name, scene in scenes.items()
            ]
            tables["Where the pads meet, from where the person's do"] = found["pads"]
        tables["Assumed"] = assumed
        files = filter(None, map(vars(self).get, _FILES))
        print_result(found, tables, files, as_json=self.json)

    def _rows(self, tried: Mapping[str, Tried]) -> list[Row]:
        """Return a row for each mapping."""
        if self.trials:
            return [tried_row(name, one) for name, one in tried.items()]
        return [single_row(name, one) for name, one in tried.items()]

    def _check(self, trial: PinchTrial) -> None:
        """Reject options that contradict each other, before any work is done."""
        if self.grip not in (None, "off"):
            wanted = "grip, grip+place, grip+place5 (5 mm, or another number), or off"
            is_known = GripName.parse(f"{own_methods()[0]}+{self.grip}") is not None
            expect(is_known, "--grip", wanted, got=self.grip)
            one_hand = "a robot with one hand"
            expect(not is_robot(self.robot), "--grip", one_hand, value=self.robot)
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

    def _scenes(self) -> tuple[dict[str, PinchScene], Row, PersonPads | None]:
        """Return what each mapping makes of the recording, what is assumed, and the person's pads.

        The pads are None of a robot whose palm does not go where the person's is: on an arm, or
        with both hands.
        """
        name = self.robot
        inputs = InputArguments(side=self.side, fps=self.fps)
        if hand_sides(name) and self.recordings:
            name = sided_name(name, inputs.side_of(self.recordings[0]))
        methods = chosen_methods(self.methods, self.peers, name)
        robot = load_whole(name)
        is_on_person = robot.is_floating and not robot.parts
        wanted = "a hand without an arm"
        expect(
            is_on_person or self.place == "robot", "--place", wanted, value=self.robot
        )
        take = person = None
        if robot.parts:
            mapped, window = map_pinch(methods, robot, self.recordings, inputs)
            gravity, up = choose_gravity(self.up, robot.spec.upright, "of the robot")
        else:
            take, window = read_pick(robot, self.recordings, inputs)
            mapped = map_take(methods, take, robot)
            upright = take.recording.upright
            gravity, up = choose_gravity(self.up, upright, "of the recording")
            person = PersonPads(take, window, robot) if is_on_person else None
        physics = Physics(
            friction=self.friction,
            joint_stiffness=self.stiffness,
            sliding_stiffness=self.sliding_stiffness,
            torque=self.torque,
            gravity=gravity,
        )
        least_clear = _CLEAR_IN_TRIALS if self.trials else _CLEAR_AT_LEAST
        placing = person.motion if person and self.place == "person" else None
        scenes = {
            method.name: PinchScene(commands, window, physics, placing, least_clear)
            for method, commands in zip(methods, mapped, strict=True)
        }
        grip = self._grip_of(robot)
        name = f"{own_methods()[0]}+{grip}"
        gripped = GripName.parse(name)
        deviation = (gripped and gripped.deviation) or 0.0
        if gripped and take:
            gripping = GripScene(take, robot, window, physics, gripped.sees, deviation)
            scenes[name] = gripping
            gripping.placing = placing
            gripping.least_clear = least_clear
        assumed = {
            "up": up,
            "torque": torque_limits(robot, self.torque).source,
            "object": f"stands where the {self.place}'s pads meet",
        }
        if deviation:
            assumed["known place"] = (
                f"off by {1e3 * deviation:g} mm along each axis (standard deviation)"
            )
        return scenes, assumed, person

    def _grip_of(self, robot: Hand) -> str:
        """Return how the first preset grips; nothing if it is not to be simulated."""
        if self.grip is not None:
            return "" if self.grip == "off" else self.grip
        is_plain = not (self.methods or robot.parts)
        return "grip" if is_plain and has_grasp(robot) else ""

    def _write(self, outcomes: dict[str, PinchOutcome]) -> None:
        """Write the files: of the first mapping that could start; the page shows all."""
        first = next(iter(outcomes.values()))
        if self.out:
            save_npz(self.out, first.columns)
        if self.picture:
            picture(first.episode, self.picture)
        if self.film:
            film(first.episode, self.film)
        if self.html:
            episodes = {name: one.episode for name, one in outcomes.items()}
            write_page(self.html, episodes, f"{self.robot}, simulated")
