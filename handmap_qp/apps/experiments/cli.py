"""The commands `handmap demo`, `handmap figures` and `handmap compare`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from handmap_qp.apps.arguments import HandName, InputArguments, PersonFile, hinted
from handmap_qp.apps.experiments.compare import run_comparison
from handmap_qp.apps.experiments.demo import run_demo, run_gestures
from handmap_qp.apps.experiments.paper import run_figures
from handmap_qp.apps.offline.summary import summarise, table_rows
from handmap_qp.apps.tables import print_rows, print_table, progress


@dataclass(frozen=True)
class Demo:
    """Map a human hand's motion to a robot hand; needs no data of your own.

    With --robot, maps the recording that comes with the package: a hand that opens, makes a fist,
    points, pinches with every finger, spreads and turns. The picture shows the gestures of both
    hands. The recording is made from the human model, with the noise of a headset.

    Without, the wrist follows the paper's arc (470 mm by 150 mm, Sec. IV) while the first postural
    synergy closes and opens the hand, and the three-fingered hand follows.

    Writes the robot's trajectory (.npz), a picture of both hands, and plots (.png).

    Examples:
        handmap demo
        handmap demo --robot allegro_right
        handmap demo --robot my_hand.yaml --out results/demo
        handmap view demo --robot allegro_right

    Attributes:
        robot: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml.
        out: Folder to write to; created if it does not exist.
    """

    robot: Annotated[
        str | None,
        hinted("HAND", "(default: the paper's arc)"),
    ] = None
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("demo")

    def run(self) -> None:
        """Run the demo, and print its errors and files."""
        with progress("mapping") as advance:
            if self.robot is None:
                result = run_demo(self.out, progress=advance)
                title = (
                    "The paper's arc with the first synergy, human hand to three_finger"
                )
            else:
                result = run_gestures(self.robot, self.out, advance)
                title = f"the package's recording to {result.trajectory.robot.name}"
        print_table(title, table_rows(summarise(result.trajectory)))
        for file in result.files:
            print(f"wrote {file}")


@dataclass(frozen=True)
class Figures:
    """Repeat the paper's numerical experiment (Sec. IV) and draw its figures.

    Two hands hold the same cube. The human's wrist moves along an arc while a synergy is activated,
    and the robot follows. Each figure is written as PNG, SVG and CSV, and report.md holds the table
    "what the paper claims, what we find". Runs beyond the paper are in a checkout:
    benchmarks/beyond_the_paper.py.

    Attributes:
        out: Folder to write to; created if it does not exist.
    """

    out: Path = Path("figures")

    def run(self) -> None:
        """Make the figures and print the table."""
        with progress("figures") as advance:
            result = run_figures(
                self.out, progress=lambda what, done, _: advance(done, what)
            )
        print_rows("What the paper claims, what we find", result.claims)
        print(
            f"wrote {len(result.files)} files to {self.out}; start with {self.out / 'report.md'}"
        )


@dataclass(frozen=True)
class Compare:
    """Compare mapping methods on recordings of a human hand, by what the robot's hand shows.

    Maps every recording by every method, and measures fingers, object, palm, pinches and smoothness
    against the raw landmarks. Prints the means over the recordings. A left recording is mirrored
    for a right robot, and the other way round.

    --out writes table.md (overall and each recording), results.json, metrics.png (a panel for each
    metric) and poses.png (human and methods side by side in open, pointing, fist, pinches, spread).

    --peers adds retargeting libraries by others, dex-retargeting and dexi-rs. They are run in
    environments of their own, which `make peers` builds in a checkout. Hands outside the package
    are given by path; benchmarks/hands/leap_right.yaml and svh_right.yaml need HANDMAP_HANDS, the
    folder of their URDFs.

    Examples:
        handmap compare recording.npz --robot allegro_right
        handmap compare *.npz --robot allegro_right --peers --out comparison
        handmap compare a.npz b.npz --robot my_hand.yaml --methods object paper

    Attributes:
        recordings: Recordings of a human hand, as of `handmap map`. The tracker's wrist poses are
            used where a file has them: wrist_pose, shape (T, 7), position [m] and quaternion wxyz.
        robot: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml.
        methods: Methods to run: presets and other mappings by name, with +smooth for smoothed
            samples, with +look-ahead for smoothing with the future too. Peers may be named too,
            such as dex-vector; then --peers runs those only.
        peers: Run the peers too.
        peers_from: Folder of the program that runs the peers, compare.py.
        out: Folder to write to; created if it does not exist.
        person: File of the person's hand, of `handmap calibrate`, if all recordings are of one.
        json: Print JSON instead of tables.
        inputs: How the recordings are to be read.
    """

    recordings: tyro.conf.Positional[
        Annotated[
            tuple[Path, ...],
            hinted("RECORDING...", "(required)"),
        ]
    ]
    robot: HandName
    methods: Annotated[
        tuple[str, ...],
        hinted("METHOD...", "(default: every preset, and the first one +smooth)"),
    ] = ()
    peers: bool = False
    peers_from: Annotated[
        Path | None,
        hinted("FOLDER", "(default: benchmarks/peers of the checkout)"),
    ] = None
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    person: PersonFile = None
    json: bool = False
    inputs: Annotated[InputArguments, tyro.conf.arg(name="")] = field(
        default_factory=InputArguments
    )

    def run(self) -> None:
        """Check everything, measure, print and write."""
        run_comparison(self)
