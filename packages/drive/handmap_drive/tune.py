"""`handmap calibrate-actuators`: measure how a hand responds to commands, and write it down."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from time import monotonic, sleep
from typing import Annotated, Any

from msgspec.structs import asdict, replace
from tyro.conf import Positional

from handmap_qp.apps.arguments import HandName, hinted
from handmap_qp.apps.drawing import save_picture
from handmap_qp.apps.onboarding.detect import Detection
from handmap_qp.apps.onboarding.write import check_free, write_hand
from handmap_qp.apps.refusals import naming
from handmap_qp.apps.tables import print_result, progress
from handmap_qp.errors import require
from handmap_qp.hands import load_hand
from handmap_qp.output_files import check_output
from .motion import Log, Motion
from .ritual import find_tuning
from .running import Effort, MotorsFile, effort_of, find_driver, stopping
from .tuning import Tuning, tuned


@dataclass(frozen=True)
class Tune:
    """Measure how a hand responds to commands, by its encoders, in two minutes; without a camera.

    `handmap tune` is the same command by its former name.

    Lay the hand on its back with nothing between its fingers, and keep your own away. It opens,
    moves each joint a little, then over its range, and closes each pinch. That finds of each joint
    gain, zero, delay, backlash, stretch, friction and range, and of each pinch by how much it is
    off. They are written into a hand.yaml: serve that one (`handmap serve --hand OUT`), and
    give it to `handmap drive --tuning OUT`, which makes up for them. Ctrl-C ends it at any time,
    and nothing is written.

    Examples:
        handmap calibrate-actuators leap_right --driver leap --port /dev/ttyUSB0 --out mine.yaml
        handmap calibrate-actuators a.yaml --driver servos --motors m.yaml --port COM3 --out b.yaml
        handmap calibrate-actuators leap_right --driver simulated --port leap_right:1 --out try.yaml

    Attributes:
        hand: Name of a hand of the package, or path of a hand.yaml.
        driver: What motors they are, as in `handmap drive`; simulated without a hand.
        port: Port of the motors.
        out: The hand.yaml to write; the hand has its name.
        motors: Table of motors, in place of the driver's own.
        effort: Limit of the torque, a share of the motors' largest.
        picture: File of a picture of what joints were commanded and did (.png, .svg, .pdf).
        overwrite: Replace the file if it exists.
        json: Print what was found as one JSON object instead of a table.
    """

    hand: Positional[HandName]
    driver: str
    port: str
    out: Annotated[Path, hinted("FILE.yaml", "(required)")]
    motors: MotorsFile = None
    effort: Effort = None
    picture: Annotated[Path | None, hinted("FILE.png")] = None
    overwrite: bool = False
    json: bool = False

    def run(self) -> None:
        """Move the hand, and write its file."""
        maker = find_driver(self.driver)
        check_free(self.out, overwrite=self.overwrite)
        if self.picture:
            check_output("--picture", self.picture, (".png", ".svg", ".pdf"))
            require("matplotlib", "plot")
        hand = load_hand(self.hand, mount="fixed")
        with naming("--port"):
            driver = maker(self.port, hand.joint_names, self.motors)
            effort = effort_of(driver, self.effort)
            driver.connect()
            with stopping(driver) as over, progress("tuning", 100) as advance:
                motion = Motion(driver, effort, turns(driver.rate, over))
                tuning = find_tuning(motion, hand, advance)
        spec = replace(tuned(hand.spec, tuning), name=self.out.stem)
        origin = Detection(spec, (), (f"tuned from {hand.name}",), {})
        write_hand(origin, self.out, by="`handmap calibrate-actuators`")
        if self.picture:
            draw(self.picture, tuning, motion.log())
        files = filter(None, (self.out, self.picture))
        print_result(spec.tuning, tables(tuning), files, as_json=self.json)


def turns(rate: float, over: Event) -> Iterator[float]:
    """Wait for each turn of a loop at a rate [Hz], and yield the time [s].

    Raises:
        KeyboardInterrupt: When it is over.
    """
    due = monotonic()
    while not over.is_set():
        due = max(due + 1.0 / rate, monotonic())
        sleep(max(0.0, due - monotonic()))
        yield monotonic()
    raise KeyboardInterrupt


def tables(tuning: Tuning) -> dict[str, Any]:
    """Return what was found as tables."""
    joints = [{"joint": name} | asdict(each) for name, each in tuning.joints.items()]
    pinches = [
        {"thumb and": finger, "off [mm]": 1e3 * gap}
        for finger, gap in tuning.pinches.items()
    ]
    return {"Joints [rad, s, shares of the largest torque]": joints, "Pinches": pinches}


def draw(path: Path, tuning: Tuning, log: Log) -> None:
    """Draw where joints were over what they were commanded, and a joint that does it exactly."""
    columns = 4
    rows = -(-len(tuning.joints) // columns)
    figure = require("matplotlib.figure", "plot").Figure(
        (3.0 * columns, 2.2 * rows), layout="constrained"
    )
    lines = zip(tuning.joints, log.commanded.T, log.q.T, strict=True)
    for k, (name, commanded, q) in enumerate(lines, 1):
        axes = figure.add_subplot(rows, columns, k)
        axes.axline((0.0, 0.0), slope=1.0, color="0.8")
        axes.plot(commanded, q, linewidth=0.6)
        axes.set_title(name, fontsize=9)
    figure.supxlabel("commanded [rad]")
    figure.supylabel("encoder [rad]")
    save_picture(figure, path)
