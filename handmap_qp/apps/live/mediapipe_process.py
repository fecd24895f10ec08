"""Track a hand in pictures with MediaPipe: a program of its own, in an environment of its own.

MediaPipe 0.10.21, the last version that brings its hand model, needs numpy below 2. So this file
imports nothing of handmap_qp but, for --to, its client. `handmap track mediapipe` runs
it and reads its samples, one JSON object a line. On a machine with a camera and without handmap_qp,
copy this file and the folder client there, install what docs/live.md lists (0.3 GB), and run:

    python mediapipe_process.py --camera 0 --to tcp://192.168.1.5:5570 --robot allegro_right

Landmarks are in metres, in the axes of the camera turned upright: x right in the picture, y up, z
towards the camera; the origin is the camera. Their shape is MediaPipe's own; their distance from
the camera follows from the field of view.
"""

import argparse
import contextlib
import importlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import numpy as np

# From the camera's axes (x right, y down, z forward) to upright ones (x right, y up, z back).
_UPRIGHT = (1.0, -1.0, -1.0)
_OTHER = {"Left": "right", "Right": "left"}
"""MediaPipe names hands for pictures mirrored as in a selfie; ours are not."""
Hand = dict[str, Any]
"""What a picture shows of the hand: fields of a sample; empty if it is not there."""
_LOST = 30
"""Pictures in a row that a camera may fail to give."""


def position_in_camera(
    shape: np.ndarray,
    places: np.ndarray,
    focal_length: float,
    centre: tuple[float, float],
) -> np.ndarray:
    """Return where a hand is, from its shape and its picture.

    Solves the equations of a pinhole camera, `f (X_k + t_x) = u_k (Z_k + t_z)` and the same of y,
    for t by least squares; they are linear because the axes of the shape are the camera's.

    Args:
        shape: Landmarks relative to the hand, in camera axes [m], shape (n, 3).
        places: Their places in the picture [pixel], shape (n, 2).
        focal_length: Focal length [pixel].
        centre: Principal point [pixel].

    Returns:
        The hand's origin in camera axes [m], shape (3,).
    """
    u = (places - centre) / focal_length
    unity = np.tile(np.eye(2), (len(u), 1))
    rows = np.column_stack([unity, -u.ravel()])
    sides = u * shape[:, 2:] - shape[:, :2]
    return np.linalg.lstsq(rows, sides.ravel(), rcond=None)[0]


def hand_finder(arguments: argparse.Namespace) -> Callable[[np.ndarray], Hand]:
    """Return a function that finds the hand in pixels by MediaPipe.

    It returns `landmarks` in upright camera axes [m], shape (21, 3), and `confidence`: MediaPipe's
    score of the hand being this one of the two, 0 to 1; nothing if the hand is not there.

    Args:
        arguments: The program's `side`, and `fov`, the horizontal field of view [deg].
    """
    # Imported by MediaPipe for drawings, which are not made here, and 60 MB.
    empty = ModuleType("matplotlib")
    sys.modules.update({"matplotlib": empty, "matplotlib.pyplot": empty})
    try:
        from mediapipe.python.solutions.hands import Hands
    except ImportError as error:
        _stop(f"mediapipe cannot be imported: {error}")
    tracker = Hands(max_num_hands=2, model_complexity=1)
    half_width = math.tan(math.radians(0.5 * arguments.fov))

    def find(pixels: np.ndarray) -> Hand:
        result = tracker.process(pixels)
        hands = zip(
            result.multi_handedness or (),
            result.multi_hand_landmarks or (),
            result.multi_hand_world_landmarks or (),
            strict=True,
        )
        height, width = pixels.shape[:2]
        focal_length = 0.5 * width / half_width
        centre = (0.5 * width, 0.5 * height)
        best: Hand = {}
        for named, image, world in hands:
            kind = named.classification[0]
            confidence = min(1.0, kind.score)
            is_ours = _OTHER.get(kind.label) == arguments.side
            if is_ours and confidence > best.get("confidence", -1.0):
                shape = _rows(world)
                places = _rows(image)[:, :2] * (width, height)
                position = position_in_camera(shape, places, focal_length, centre)
                landmarks = ((shape + position) * _UPRIGHT).tolist()
                best = {"landmarks": landmarks, "confidence": confidence}
        return best

    return find


def pictures(arguments: argparse.Namespace) -> Iterator[tuple[float, np.ndarray]]:
    """Yield time [s] and pixels (height, width, 3) of the camera or the video, unmirrored."""
    import cv2

    is_file = arguments.video is not None
    kind, source = "camera", arguments.camera
    if is_file:
        kind, source = "video", str(arguments.video)
    name = f"{kind} {source}"
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        _stop(f"{name} cannot be read")
    rate = capture.get(cv2.CAP_PROP_FPS) or 30.0
    start = time.monotonic()
    count = 0
    for count, picture in enumerate(_read(capture, is_file), start=1):
        stamp = start + (count - 1) / rate if is_file else time.monotonic()
        time.sleep(max(0.0, stamp - time.monotonic()) * arguments.paced)
        pixels = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
        yield stamp, cv2.flip(pixels, 1) if arguments.mirrored else pixels
    if not (is_file and count):
        _stop(f"{name} {'gives no more' if count else 'holds no'} pictures")


def _read(capture: Any, is_file: bool) -> Iterator[np.ndarray]:
    """Yield pictures until a file's next one is missing, or too many of a camera's in a row."""
    lost = 0
    while lost <= (0 if is_file else _LOST):
        is_there, picture = capture.read()
        lost = 0 if is_there else lost + 1
        if is_there:
            yield picture


def printed(sample: Hand) -> None:
    """Print a sample as one line of JSON."""
    print(json.dumps(sample), flush=True)


def sent(
    arguments: argparse.Namespace, closing: contextlib.ExitStack
) -> Callable[[Hand], None]:
    """Open a session of the service until `closing`; return a function that sends samples to it."""
    client = _client_module()
    session = closing.enter_context(client.Client(arguments.to))
    failures = client.ServiceError, client.ServiceTimeoutError
    try:
        session.open(
            arguments.robot, input="landmarks", side=arguments.side, has_detail=True
        )
    except failures as error:
        _stop(str(error))

    def send(sample: Hand) -> None:
        try:
            session.send(**sample)
        except failures as error:
            print(f"mediapipe_process: {error}", file=sys.stderr)

    return send


def main() -> None:
    """Track until the video ends or the program is stopped."""
    arguments = _parse()
    find = hand_finder(arguments)
    with contextlib.ExitStack() as closing:
        emit = sent(arguments, closing) if arguments.to else printed
        # Ctrl-C and a reader that has gone end this process without a traceback.
        with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):
            for stamp, pixels in pictures(arguments):
                hand = find(pixels)
                emit({"time": stamp, "valid": bool(hand), **hand})


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track a hand with MediaPipe.")
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--camera", type=int, default=0, help="number of the camera (default: 0)"
    )
    source.add_argument("--video", type=Path, help="video file in place of a camera")
    add = parser.add_argument
    add("--side", choices=("right", "left"), default="right", help="hand to track")
    add("--fov", type=float, default=65.0, help="horizontal field of view [deg]")
    add("--mirrored", action="store_true", help="pictures are mirrored (selfie)")
    add("--paced", action="store_true", help="play a video at its own speed")
    add("--to", help="service to send to, tcp://HOST:PORT; else print JSON lines")
    add("--robot", help="robot hand, for --to")
    arguments = parser.parse_args()
    if arguments.to and not arguments.robot:
        _stop("--to needs --robot")
    if not 1.0 <= arguments.fov <= 170.0:
        _stop("--fov: expected 1 to 170 degrees")
    arguments.paced |= arguments.to is not None
    return arguments


def _rows(landmarks: Any) -> np.ndarray:
    return np.array([(point.x, point.y, point.z) for point in landmarks.landmark])


def _client_module() -> Any:
    """Import the folder `client` from beside this file, or from its place in handmap_core."""
    folder = Path(__file__).resolve().parent
    # Packages are beside each other where they are installed; a checkout has the core's in core.
    packages = folder.parents[2]
    homes = [folder, packages / "handmap_core", packages / "core" / "handmap_core"]
    sys.path += map(str, homes)
    try:
        return importlib.import_module("client")
    except ModuleNotFoundError as error:
        _stop(f"{error}: the folder client of handmap_core must lie beside this file")


def _stop(message: str) -> NoReturn:
    print(f"mediapipe_process: {message}", file=sys.stderr)
    raise SystemExit(2)


if __name__ == "__main__":
    main()
