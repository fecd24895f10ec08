"""Damaged bytes of models, as those of a saved hand may be, in the core under the sanitizers.

The bytes of the models of some hands are altered by bytes, numbers, lengths and pieces. The core
refuses them, or computes with them without a read or write outside of its arrays. What the
sanitizers find ends the run with their report; the exit code is 1 then.

    nice python tests/judges model_fuzz --seconds 3600 --seed 7
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from cpp_programs import compiled

from handmap_core.ik.limits import box_limits
from handmap_core.ik.options import ik_model
from handmap_core.mapping.homogeneous import HomogeneousMap
from handmap_core.mapping.teleoperation import TeleoperationMap
from handmap_qp.hands import Hand, load_hand
from handmap_qp.hands.compiled import hand_model
from handmap_qp.human import landmarks_at_rest
from handmap_qp.ik import IkOptions
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.mapping import HandMapper
from handmap_qp.models import GuardModel, Model, encode

PROGRAM = Path(__file__).with_suffix(".cpp")
CHECKS = "address,undefined,float-cast-overflow"
HANDS = ("three_finger", "allegro_right", "panda_gripper")
"""Hands whose models are damaged: of spheres and meshes, and a gripper."""


def models_of(human: Hand, robot: Hand) -> Iterator[Model]:
    """Yield the models that the core is made of for two hands."""
    yield hand_model(robot)
    yield box_limits(robot)
    yield ik_model(robot, IkOptions())
    yield GuardModel(side="right", landmarks=landmarks_at_rest(human))
    for preset in ("teleoperation", "paper"):
        mapper = HandMapper(human, robot, preset=preset)
        mapper.map_landmarks(landmarks_at_rest(human))
        yield mapper.landmarks.model
        collisions = mapper.point_ik.gate.collisions
        if isinstance(collisions, CollisionLimit):
            yield collisions.model
            yield collisions.bounds.model()
        target_map = mapper.target_map
        if isinstance(target_map, TeleoperationMap):
            yield target_map.method.model
            yield target_map.palm_model()
            yield target_map.method.distances.model()
        elif isinstance(target_map, HomogeneousMap):
            yield target_map.model()


def write_models(folder: Path) -> int:
    """Write the bytes of valid models, each into a file named after its model; count them."""
    count = 0
    human = load_hand("human", mount="floating")
    for name in HANDS:
        robot = load_hand(name)
        for model in models_of(human, robot):
            file = folder / f"{type(model).__name__}-{name}-{count}"
            file.write_bytes(encode(model))
            count += 1
    return count


def fuzz(seed: int, seconds: float, rounds: int | None = None) -> tuple[int, int]:
    """Try damaged models; return how many were tried, and how many of them accepted.

    Args:
        seed: Seed of the damage.
        seconds: How long to go on [s].
        rounds: How many to try instead.

    Raises:
        RuntimeError: With the report, if the sanitizers find something.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        models = folder / "models"
        models.mkdir()
        write_models(models)
        program = compiled(PROGRAM, folder, CHECKS)
        command = [str(program), str(models), str(seed), str(seconds)]
        if rounds:
            command.append(str(rounds))
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode:
        raise RuntimeError(run.stdout[-500:] + run.stderr[-5000:])
    tried, _, accepted, _ = run.stdout.split()
    return int(tried), int(accepted)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Damaged models in the core.")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long [s]")
    parser.add_argument("--seed", type=int, default=1, help="seed of the damage")
    arguments = parser.parse_args()
    try:
        tried, accepted = fuzz(arguments.seed, arguments.seconds)
    except RuntimeError as error:
        sys.exit(str(error))
    print(f"{tried} damaged models, {accepted} of them accepted, no finding")


if __name__ == "__main__":
    main()
