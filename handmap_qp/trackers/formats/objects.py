"""Data sets of hands with objects: DexYCB, ARCTIC, GRAB and HOT3D; read, not written.

Written from what the data sets' documents and files say:

- DexYCB (Chao et al. 2021): a sequence has `meta.yml` and a folder for each camera, with
  `labels_000000.npz` and so on in that camera's frame.
- ARCTIC (Fan et al. 2023): a sequence is `NAME.mano.npy`, a pickled table, and `NAME.object.npy`,
  whose translation is in millimetres.
- GRAB (Taheri et al. 2020): archives of pickled tables. HOT3D (Banerjee et al. 2025): folders.
"""

import os
from collections import defaultdict
from itertools import product
from pathlib import Path

import msgspec
import numpy as np

from handmap_core.errors import require
from handmap_core.se3 import Array, Arrays, affine, as_floats, pose_from_xyz_quat
from handmap_qp.hands import Names, Side
from .archive import read_archive
from .base import SIDES, reading
from .mano import (
    FROM_MANO,
    HandArrays,
    HandModelFormat,
    rotations_of,
)
from .pickled import load_table, read_table

_YCB = """
background
002_master_chef_can 003_cracker_box 004_sugar_box 005_tomato_soup_can 006_mustard_bottle
007_tuna_fish_can 008_pudding_box 009_gelatin_box 010_potted_meat_can 011_banana 019_pitcher_base
021_bleach_cleanser 024_bowl 025_mug 035_power_drill 036_wood_block 037_scissors 040_large_marker
051_large_clamp 052_extra_large_clamp 061_foam_brick
"""
"""Names of the objects of DexYCB by their numbers."""


_RATE = 30.0
"""Frames per second of DexYCB and ARCTIC."""
_HANDS = "mano_hand_pose_trajectory.jsonl"
_LOST = np.nan * np.eye(4)


def _above(path: Path, name: str) -> str:
    """Return the path of a file in a folder above, the nearest one; empty if there is none."""
    files = (str(folder / name) for folder in path.absolute().parents)
    return next(filter(os.path.isfile, files), "")


class DexYcbFormat(HandModelFormat):
    """The folder of a camera, or that of a sequence, whose first camera is taken then.

    Joints and poses are those of the camera's frame. The object is the one that is grasped.
    """

    name = "dexycb"
    suffixes: Names = ()
    left_out = ("other cameras", "objects that are not grasped")

    def recognises(self, path: Path) -> bool:
        """Tell whether the folder has labels, or folders with labels."""
        return bool(_labels(path))

    def hands(self, path: Path) -> HandArrays:
        """Read the one hand, with the object that it grasps."""
        files = _labels(path)
        meta = files[0].absolute().parents[1] / "meta.yml"
        with reading(meta):
            given = msgspec.yaml.decode(meta.read_bytes())
            place = given["ycb_grasp_ind"]
            thing = _YCB.split()[given["ycb_ids"][place]]
            side = given["mano_sides"][0]
        joints, poses = [], []
        for file in files:
            with reading(file):
                arrays = read_archive(file, ("joint_3d", "pose_y"))
                joints.append(_seen(arrays["joint_3d"], 21, 3))
                poses.append(_seen(arrays["pose_y"][place], 12))
        arrays = {
            "side": side,
            "fps": _RATE,
            "joints": np.array(joints)[:, np.argsort(FROM_MANO)],
            "object_pose": np.array(poses),
        }
        # An object that is never seen has no shape either.
        if np.isfinite(poses).any():
            mesh = f"models/{thing}/textured_simple.obj"
            arrays["object_shape"] = _above(files[0], mesh)
        return {f"{side}_{thing}": arrays}


def _labels(path: Path) -> list[Path]:
    """Return the labels of a camera, the first one if the folder is that of a sequence."""
    files = sorted(path.glob("labels_*.npz")) or sorted(path.glob("*/labels_*.npz"))
    return [file for file in files if file.parent == files[0].parent]


def _seen(values: Array, *shape: int) -> Array:
    """Return numbers in a shape; NaN where all are the same, as DexYCB has what is not seen."""
    return np.where(np.ptp(values), values, np.nan).reshape(shape)


class ArcticFormat(HandModelFormat):
    """The file of both hands; that of the object is beside it. Its articulation is not kept."""

    name = "arctic"
    suffixes = (".mano.npy",)
    left_out = ("the articulation of the object",)

    def hands(self, path: Path) -> HandArrays:
        """Read each hand with the object, whose shape is not known."""
        file = path.with_suffix("").with_suffix(".object.npy")
        with reading(file):
            rows = as_floats(np.load(file), "", shape=("T", 7))
        poses = affine(rotations_of(rows[:, 1:4]), 1e-3 * rows[:, 4:])
        thing, _, _ = path.name.partition("_")
        return {
            f"{side}_{thing}": {
                "side": side,
                "fps": _RATE,
                "global_orient": own["rot"],
                "hand_pose": own["pose"],
                "transl": own["trans"],
                "betas": np.atleast_2d(own["shape"])[0],
                "flat_hand_mean": False,
                "object_pose": poses,
            }
            for side, own in read_table(path).items()
        }


class GrabFormat(HandModelFormat):
    """Both hands with one object; the shapes of the hands are the person's meshes."""

    name = "grab"
    suffixes = (".npz",)
    left_out = ("body and face", "the table", "contacts")

    def hands(self, path: Path) -> HandArrays:
        """Read each hand with the object."""
        trimesh = require("trimesh", "plot")
        found = read_archive(path, ("lhand", "rhand", "object"), load_table)
        held = found["object"]
        moved = held["params"]
        turns = rotations_of(moved["global_orient"]).mT  # They turn rows.
        hands: HandArrays = {}
        for side in SIDES:
            own = found[f"{side[0]}hand"]
            person = path.absolute().parents[2] / own["vtemp"]
            hands[side] = {
                **own["params"],
                "side": side,
                "fps": 120.0,
                "v_template": trimesh.load(person, process=False).vertices,
                "flat_hand_mean": True,
                "object_pose": affine(turns, moved["transl"]),
                "object_shape": _above(path, held["object_mesh"]),
            }
        return hands


class Hot3dFormat(HandModelFormat):
    """The folder of a sequence: each hand, while it is seen, with each object by its number."""

    name = "hot3d"
    suffixes: Names = ()
    left_out = ("hands of UmeTrack", "images and the headset")

    def recognises(self, path: Path) -> bool:
        """Tell whether the folder has hands of MANO."""
        return (path / _HANDS).is_file()

    def model_of(self, side: Side) -> Arrays:
        """Load a model; in x, a left hand's shapes that are the right hand's are mirrored."""
        model, right = map(super().model_of, (side, "right"))
        shapes = model["shapedirs"][:, 0]
        if side == "left" and np.abs(shapes - right["shapedirs"][:, 0]).sum() < 1.0:
            shapes *= -1.0
        return model

    def hands(self, path: Path) -> HandArrays:
        """Read each hand with each object."""
        from scipy.spatial.transform import Rotation

        file = path / "dynamic_objects.csv"
        with reading(file):
            rows = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
            placed = pose_from_xyz_quat(rows[:, 2:], "wxyz", "")
        # Numbers and instants are floats here, and are looked up as floats below.
        poses = dict(zip(map(tuple, rows[:, :2]), placed, strict=True))
        found = defaultdict(list)
        for sample in msgspec.json.Decoder().decode_lines((path / _HANDS).read_bytes()):
            for key, hand in sample["hand_poses"].items():
                at = hand["wrist_xform"]
                own = sample["timestamp_ns"], at["t_xyz"], at["q_wxyz"], hand["pose"]
                found[SIDES[int(key)]].append((*own, hand["betas"]))
        hands: HandArrays = {}
        for (side, own), number in product(found.items(), np.unique(rows[:, 0])):
            times, places, quats, fingers, shapes = zip(*own, strict=True)
            hands[f"{side}_{number:.0f}"] = {
                "side": side,
                "time": 1e-9 * np.array(times),
                "global_orient": Rotation.from_quat(
                    quats, scalar_first=True
                ).as_rotvec(),
                "hand_pose": fingers,
                "transl": places,
                "betas": shapes[0],
                "flat_hand_mean": False,
                "object_pose": [poses.get((number, float(at)), _LOST) for at in times],
                "object_shape": _above(path, f"assets/{number:.0f}.glb"),
            }
        return hands
