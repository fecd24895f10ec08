"""How well MediaPipe sees our own human hand: `python benchmarks mediapipe_accuracy`.

Renders a moving hand, whose landmarks are known, into a video, tracks it by `handmap track
mediapipe`'s own source, and compares. MediaPipe must be installed (`handmap track mediapipe
--install`); its environment also writes the video.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.apps.live.mediapipe_source import MediapipeSource, environment_python
from handmap_qp.errors import HandmapError
from handmap_qp.hands import Side
from handmap_qp.hands.library import load_hand
from handmap_qp.se3 import rigid_fit

RATE = 30.0
SIZE = (480, 640)
FOV = 65.0
_SKIN = np.array([0.86, 0.64, 0.52])
_LIGHT = np.array([-0.4, -0.6, -0.7]) / np.linalg.norm([-0.4, -0.6, -0.7])
_RADII = np.array(
    [
        *(22, 16, 12.5, 10.5, 8.5, 10.5, 9.2, 8.2, 7.2),
        *(10.8, 9.5, 8.5, 7.5, 10.5, 9, 8, 7, 9.5, 8, 7, 6.2),
    ]
)
"""Half the thickness of a hand at its landmarks [mm]."""
_BONES = [
    *(
        (0, 1),
        (1, 2),
        (2, 3),
        (3, 4),
        (0, 5),
        (5, 6),
        (6, 7),
        (7, 8),
        (0, 9),
        (9, 10),
        (10, 11),
    ),
    *(
        (11, 12),
        (0, 13),
        (13, 14),
        (14, 15),
        (15, 16),
        (0, 17),
        (17, 18),
        (18, 19),
        (19, 20),
    ),
    *((5, 9), (9, 13), (13, 17), (2, 5), (1, 5), (1, 9)),
]
_FOCAL = 0.5 * SIZE[1] / np.tan(np.radians(0.5 * FOV))
_ENCODER = """
import sys, cv2, numpy as np
frames = np.load(sys.argv[1])
height, width = frames.shape[1:3]
code = cv2.VideoWriter_fourcc(*"mp4v")
out = cv2.VideoWriter(sys.argv[2], code, float(sys.argv[3]), (width, height))
for frame in frames:
    out.write(frame[:, :, ::-1])
out.release()
"""


def moving_landmarks(count: int, side: Side) -> np.ndarray:
    """Return landmarks of a hand that closes finger by finger, turns and moves.

    Returns:
        In camera axes, x right, y down, z forward, the palm seen [m], shape (count, 21, 3).
    """
    human = load_hand("human" if side == "right" else "human_left", points="landmarks")
    names = human.joint_names
    seen = np.diag([-1.0, -1.0, 1.0])
    landmarks = np.empty((count, 21, 3))
    for i in range(count):
        q, phase = 0.1 * human.rest, 2.0 * np.pi * i / 60.0
        for k, finger in enumerate(("index", "middle", "ring", "little")):
            share = 0.5 - 0.5 * np.cos(phase - 0.3 * k)
            for joint, angle in (("MCP", 1.0), ("PIP", 1.2), ("DIP", 0.7)):
                q[names.index(f"{finger}_{joint}_flexion")] = 0.1 + angle * share
        q = np.clip(q, human.lower_limits, human.upper_limits)
        angles = np.array([15, 20, 10]) * np.sin(phase / np.array([2, 3, 2]))
        turn = seen @ Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        place = 0.03 * np.sin(phase / 2), 0.08, 0.38 + 0.05 * np.sin(phase / 4)
        landmarks[i] = human.points(q) @ turn.T + place
    return landmarks


def draw_hand(landmarks: np.ndarray) -> np.ndarray:
    """Draw a skin-coloured hand with a forearm as many shaded spheres.

    Args:
        landmarks: In camera axes [m], shape (21, 3).

    Returns:
        Red, green and blue, bytes, shape (480, 640, 3).
    """
    height, width = SIZE
    ys, xs = np.mgrid[0:height, 0:width]
    depth, normals = np.full(SIZE, np.inf), np.zeros((*SIZE, 3))
    for centre, radius in _spheres(landmarks):
        u, v = _FOCAL * centre[:2] / centre[2] + (width / 2, height / 2)
        size = _FOCAL * radius / centre[2]
        box = np.s_[
            max(0, int(v - size)) : max(0, int(v + size) + 2),
            max(0, int(u - size)) : max(0, int(u + size) + 2),
        ]
        x, y = (xs[box] - u) / size, (ys[box] - v) / size
        z = np.sqrt(np.maximum(0.0, 1.0 - x * x - y * y))
        near = (z > 0.0) & (centre[2] - radius * z < depth[box])
        depth[box][near] = (centre[2] - radius * z)[near]
        normals[box][near] = np.stack([x, y, -z], axis=-1)[near]
    is_hand = np.isfinite(depth)
    shade = 0.45 + 0.6 * np.clip(normals @ _LIGHT, 0.0, 1.0)
    edges = np.hypot(*np.gradient(np.where(is_hand, depth, depth[is_hand].max())))
    skin = _SKIN * (shade * (1.0 - 0.35 * np.clip(edges / 0.004, 0.0, 1.0)))[..., None]
    wall = np.linspace(0.55, 0.75, height)[:, None, None] * np.array([0.75, 0.85, 1.0])
    picture = np.where(is_hand[..., None], np.clip(skin, 0.0, 1.0), wall)
    return (255 * picture).astype(np.uint8)


def _spheres(landmarks: np.ndarray) -> list[tuple[np.ndarray, float]]:
    found = []
    for a, b in _BONES:
        count = max(2, int(np.linalg.norm(landmarks[b] - landmarks[a]) / 0.0015))
        for share in np.linspace(0.0, 1.0, count):
            centre = landmarks[a] + share * (landmarks[b] - landmarks[a])
            found.append((centre, 1e-3 * (_RADII[a] + share * (_RADII[b] - _RADII[a]))))
    arm = landmarks[0] - 0.5 * (landmarks[9] + landmarks[13])
    arm /= np.linalg.norm(arm)
    found += [
        (landmarks[0] + share * arm, 0.024 + 0.04 * share)
        for share in np.linspace(0, 0.22, 120)
    ]
    return found


def write_video(landmarks: np.ndarray, file: Path) -> None:
    """Draw and encode a video, with the OpenCV of MediaPipe's environment."""
    frames = file.with_suffix(".npy")
    np.save(frames, np.array([draw_hand(each) for each in landmarks]))
    words = [environment_python(), "-c", _ENCODER, frames, file, str(RATE)]
    subprocess.run([str(word) for word in words], check=True, capture_output=True)
    frames.unlink()


def measure(count: int, side: Side, folder: Path) -> dict[str, float]:
    """Render, track and compare.

    Returns:
        Share of pictures in which the hand was found; mean landmark error after a rigid fit [mm];
        smallest correlation over the fingers of tip-to-knuckle distance; mean ratio of the
        distances from the camera.
    """
    truth = moving_landmarks(count, side)
    video = folder / f"{side}.mp4"
    write_video(truth, video)
    truth = truth * (1.0, -1.0, -1.0)
    source = MediapipeSource(video=video, side=side, fov=FOV, is_paced=False)
    samples = list(source)
    if len(samples) != count:
        raise RuntimeError(f"{len(samples)} samples of {count} pictures")
    seen = [i for i, sample in enumerate(samples) if sample.valid]
    found, known = np.array([samples[i].landmarks for i in seen]), truth[seen]
    errors = []
    for one, other in zip(found, known, strict=True):
        fit = rigid_fit(one, other)
        errors.append(
            np.linalg.norm(one @ fit[:3, :3].T + fit[:3, 3] - other, axis=1).mean()
        )
    tips, knuckles = [8, 12, 16, 20], [5, 9, 13, 17]
    reach = [
        np.linalg.norm(each[:, tips] - each[:, knuckles], axis=2)
        for each in (found, known)
    ]
    correlations = [np.corrcoef(reach[0][:, k], reach[1][:, k])[0, 1] for k in range(4)]
    return {
        "seen": len(seen) / count,
        "shape_error_mm": 1e3 * float(np.mean(errors)),
        "extension_correlation": float(min(correlations)),
        "distance_ratio": float(np.mean(found[:, 0, 2] / known[:, 0, 2])),
    }


def main() -> None:
    """Print the figures of both hands."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--pictures", type=int, default=240, help="pictures for each hand"
    )
    count = parser.parse_args().pictures
    try:
        environment_python()
    except HandmapError as error:
        parser.error(str(error))
    with tempfile.TemporaryDirectory() as folder:
        sides: tuple[Side, Side] = ("right", "left")
        for side in sides:
            print(
                json.dumps(
                    {
                        "side": side,
                        "pictures": count,
                        **measure(count, side, Path(folder)),
                    }
                )
            )


if __name__ == "__main__":
    sys.exit(main())
