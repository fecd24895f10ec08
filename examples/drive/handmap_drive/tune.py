"""`handmap tune`: what a hand makes of its commands, found by its encoders and written down."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from signal import SIGINT, signal
from threading import Event
from time import monotonic, sleep
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec.structs import replace
from tyro.conf import Positional

from handmap_qp.apps.arguments import HandName, hinted
from handmap_qp.apps.drawing import save_picture
from handmap_qp.apps.onboarding.detect import Detection
from handmap_qp.apps.onboarding.write import check_free, write_hand
from handmap_qp.apps.refusals import naming
from handmap_qp.apps.tables import print_result, progress
from handmap_qp.errors import did_you_mean, expect, require
from handmap_qp.hands import load_hand
from handmap_qp.output_files import check_output
from . import DRIVERS
from .fit import Log
from .ritual import Ritual
from .tuning import Tuning, tuned


@dataclass(frozen=True)
class Tune:
    """Find what a hand makes of its commands, by moving it for two minutes; it needs no camera.

    Lay the hand on its back with nothing between its fingers, and keep your own away. It opens,
    moves each joint a little, then over its range, and closes each pinch. That finds of each joint
    gain, zero, delay, backlash, stretch, friction and range, and of each pinch by how much it is
    off. They are written into a hand.yaml: serve that one (`handmap serve --hand OUT`), and
    give it to `handmap drive --tuning OUT`, which makes up for them. Ctrl-C ends it at any time,
    and nothing is written.

    Examples:
        handmap tune leap_right --driver leap --port /dev/ttyUSB0 --out my_leap.yaml
        handmap tune a.yaml --driver servos --motors motors.yaml --port /dev/ttyACM0 --out b.yaml
        handmap tune allegro_right --driver simulated --port allegro_right:1 --out try.yaml

    Attributes:
        hand: Name of a hand of the package, or path of a hand.yaml.
        driver: What motors they are, as of `handmap drive`; simulated without a hand.
        port: Port of the motors.
        out: The hand.yaml to write; the hand has its name.
        motors: Table of motors, in place of the driver's own.
        effort: Limit of the torque, a share of the motors' largest.
        picture: File of a picture of what joints were told and did (.png, .svg, .pdf).
        overwrite: Replace the file if it exists.
        json: Print what was found as one JSON object instead of a table.
    """

    hand: Positional[HandName]
    driver: str
    port: str
    out: Annotated[Path, hinted("FILE.yaml", "(required)")]
    motors: Annotated[Path | None, hinted("MOTORS.yaml", "(default: the driver's)")] = (
        None
    )
    effort: Annotated[float | None, hinted("SHARE", "(default: the driver's)")] = None
    picture: Annotated[Path | None, hinted("FILE.png")] = None
    overwrite: bool = False
    json: bool = False

    def run(self) -> None:
        """Move the hand, and write its file."""
        expect(
            self.driver in DRIVERS,
            "--driver",
            f"one of {', '.join(DRIVERS)}",
            value=self.driver,
            advice=did_you_mean(self.driver, DRIVERS),
        )
        check_free(self.out, overwrite=self.overwrite)
        if self.picture:
            check_output("--picture", self.picture, (".png", ".svg", ".pdf"))
            require("matplotlib", "plot")
        hand = load_hand(self.hand, mount="fixed")
        with naming("--port"):
            driver = DRIVERS[self.driver](self.port, hand.joint_names, self.motors)
            driver.connect()
            effort = driver.effort if self.effort is None else self.effort
            expect(0.0 < effort <= 1.0, "--effort", "a share, 0 to 1", value=effort)
            over = Event()
            # Not in the middle of a message, as an exception would end it.
            signal(SIGINT, lambda *_: over.set())
            try:
                with progress("tuning", 100) as tell:
                    times = turns(driver.rate, over)
                    ritual = Ritual(driver, hand, effort, times, tell)
                    tuning = ritual.run()
            finally:
                for _ in range(3):
                    with suppress(OSError):
                        driver.stop()
        spec = replace(tuned(load_hand(self.hand).spec, tuning), name=self.out.stem)
        write_hand(Detection(spec, (), (f"tuned from {hand.name}",), {}), self.out)
        files = [self.out]
        if self.picture:
            draw(self.picture, tuning, ritual.log)
            files.append(self.picture)
        print_result(
            msgspec.to_builtins(tuning), tables(tuning), files, as_json=self.json
        )


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
    joints = [
        {
            "joint": name,
            "gain": round(joint.gain, 3),
            "zero [deg]": round(np.degrees(joint.zero), 1),
            "delay [ms]": round(1e3 * joint.delay),
            "backlash [deg]": round(np.degrees(joint.backlash), 1),
            "stretch [deg]": round(np.degrees(joint.stretch), 1),
            "friction": round(joint.friction, 3),
            "encoder [deg]": round(np.degrees(joint.encoder), 1),
            "range [deg]": " to ".join(f"{np.degrees(end):.0f}" for end in joint.range),
        }
        for name, joint in tuning.joints.items()
    ]
    pinches = [
        {"thumb and": finger, "off [mm]": round(1e3 * gap, 1)}
        for finger, gap in tuning.pinches.items()
    ]
    return {"Joints": joints, "Pinches": pinches}


def draw(path: Path, tuning: Tuning, log: Log) -> None:
    """Draw where joints were over what they were told, and a joint that does it exactly."""
    columns = 4
    rows = -(-len(tuning.joints) // columns)
    figure = require("matplotlib.figure", "plot").Figure(
        (3.0 * columns, 2.2 * rows), layout="constrained"
    )
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid[len(tuning.joints) :]:
        axes.set_axis_off()
    for axes, name, told, q in zip(
        grid, tuning.joints, log.told.T, log.q.T, strict=False
    ):
        axes.axline((0.0, 0.0), slope=1.0, color="0.8")
        axes.plot(told, q, linewidth=0.6)
        axes.set_title(name, fontsize=9)
    figure.supxlabel("told [rad]")
    figure.supylabel("encoder [rad]")
    save_picture(figure, path)
