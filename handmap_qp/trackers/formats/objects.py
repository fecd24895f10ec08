"""Data sets of hands with objects: DexYCB and ARCTIC; read, not written.

Written from what the data sets' documents and files say:

- DexYCB (Chao et al. 2021): a sequence has `meta.yml` and a folder for each camera, with
  `labels_000000.npz` and so on in that camera's frame.
- ARCTIC (Fan et al. 2023): a sequence is `NAME.mano.npy`, a pickled table, and `NAME.object.npy`,
  whose translation is in millimetres.
"""

import os
from pathlib import Path

import msgspec
import numpy as np

from handmap_qp.hands import Names
from handmap_qp.se3 import Array, affine, as_floats
from .archive import read_archive
from .base import reading
from .mano import FROM_MANO, HandArrays, HandModelFormat, read_table, rotations_of

_YCB = """
background
002_master_chef_can 003_cracker_box 004_sugar_box 005_tomato_soup_can 006_mustard_bottle
007_tuna_fish_can 008_pudding_box 009_gelatin_box 010_potted_meat_can 011_banana 019_pitcher_base
021_bleach_cleanser 024_bowl 025_mug 035_power_drill 036_wood_block 037_scissors 040_large_marker
051_large_clamp 052_extra_large_clamp 061_foam_brick
"""
"""Names of the objects of DexYCB by their numbers."""


_RATE = 30.0
"""Frames per second of all of them."""


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
        folders = files[0].absolute().parents
        meta = folders[1] / "meta.yml"
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
            meshes = (f / "models" / thing / "textured_simple.obj" for f in folders)
            arrays["object_shape"] = next(filter(os.path.isfile, meshes), "")
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
