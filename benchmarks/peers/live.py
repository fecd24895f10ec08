"""The peers live in a loop: `compare.py live METHOD HAND`, and mappings of `handmap score --tasks`.

    handmap score --tasks pick --methods teleoperation dexi-dexpilot
    handmap score --tasks pick --methods teleoperation benchmarks/peers/live.py:dexpilot

`command_of` is the command of the worker, which this file is too when it is run: in the peer's
environment, `live.py PEER METHOD ROBOT DATA IS_FILTERED JOINT...` prints the line `"ready"`, then
reads landmarks (21, 3) [m] as lines of JSON and answers joints [rad], or begins anew at the line
`"reset"`. Where the peer's robot has a wrist that ours has not (Shadow's), its turn is left out.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

# Run by path, by this package's interpreter or by the peer's.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

if TYPE_CHECKING:
    from handmap_score.tasks.mapping import Mapping

    from handmap_qp.hands.hand import Hand

_RESET = "reset"
_READY = "ready"


def command_of(method: str, robot: Hand) -> list[str]:
    """Return the command of a worker that answers joints in the order of a robot hand.

    Args:
        method: Name of one of `results.METHODS`.
        robot: A robot hand that the peers have a configuration for.

    Raises:
        InvalidInputError: If there is no such method, or the peers do not know the robot.
        PeerError: If the peers are not built.
    """
    results = importlib.import_module("peers.results")
    build = importlib.import_module("peers.build")
    chosen = results.method_of(method)
    missing = build.missing_peers()
    if chosen.peer in missing:
        raise results.PeerError(build.why_missing(missing))
    joints = [results.peer_joint(robot, name) for name in robot.joint_names]
    return [
        build.python_of(chosen.peer),
        __file__,
        chosen.peer,
        chosen.method,
        results.peer_robot(robot),
        str(build.data_folder()),
        json.dumps(chosen.is_filtered),
        *joints,
    ]


def dexpilot(human: Hand, robot: Hand) -> Mapping:
    """Return dexi-rs's DexPilot without its filter, with our limits.

    The peer does not measure the person.
    """
    return _mapping("dexi-dexpilot-unfiltered", robot)


def vector(human: Hand, robot: Hand) -> Mapping:
    """Return dexi-rs's vector method without its filter, with our limits."""
    return _mapping("dexi-vector-unfiltered", robot)


def _mapping(method: str, robot: Hand) -> Mapping:
    # Only who scores tasks asks for one.
    outside = importlib.import_module("handmap_score.tasks.outside")
    return outside.outside_mapping(method + outside.LIMITS, robot)


def serve(
    peer: str, method: str, robot: str, data: str, is_filtered: str, *joints: str
) -> None:
    """Answer lines until the other end closes."""
    runner = importlib.import_module("peers.runner")
    config = runner.load_config(
        Path(data), method, robot, is_filtered=json.loads(is_filtered)
    )
    indices = runner.human_indices(config)

    def new() -> tuple[runner.Solver, list[int]]:
        solver = runner.SOLVERS[peer](config)
        solver.sign = 1.0 if robot.endswith("right") else -1.0
        return solver, [solver.joint_names.index(name) for name in joints]

    solver, columns = new()
    is_first = True
    print(json.dumps(_READY), flush=True)
    for line in sys.stdin:
        value = json.loads(line)
        if value == _RESET:
            solver, columns = new()
            is_first = True
            answer = []
        else:
            landmarks = np.array(value)
            if is_first and indices.ndim == 1:
                solver.start(landmarks)
            is_first = False
            reference = runner.reference_value(landmarks, indices, solver.sign)
            answer = solver.retarget(reference)[columns].tolist()
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    serve(*sys.argv[1:])
