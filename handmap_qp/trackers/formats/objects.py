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


def _holding(
    hands: HandArrays,
    thing: str,
    poses: Array,
    path: Path,
    mesh: str = "",
) -> HandArrays:
    """Return hands with an object, at 30 frames a second if they do not say it.

    Args:
        hands: Arrays by side.
        thing: Name of the object.
        poses: Its poses, as `build_recording` takes them; NaN where it is not seen.
        path: The file or folder that is read.
        mesh: The object's mesh, in a folder above it; its shape is not known if there is none.
    """
    # An object that is never seen has no shape either.
    files = [
        str(folder / mesh)
        for folder in path.absolute().parents
        if np.isfinite(poses).any()
    ]
    shape = next(filter(os.path.isfile, files), "")
    return {
        f"{side}_{thing}": {
            "side": side,
            "fps": 30.0,
            "object_pose": poses,
            "object_shape": shape,
            **arrays,
        }
        for side, arrays in hands.items()
    }


class DexYcbFormat(HandModelFormat):
    """The folder of a camera, or that of a sequence, whose first camera is taken then.

    Joints and poses are those of the camera's frame. The object is the one that is grasped.
    """

    name = "dexycb"
    suffixes: Names = ()
    left_out = ("other cameras", "objects that are not grasped")

    def recognises(self, path: Path) -> bool:
        """Tell whether the folder has labels, or folders with labels."""
        return any([*path.glob("labels_*.npz"), *path.glob("*/labels_*.npz")])

    def hands(self, path: Path) -> HandArrays:
        """Read the one hand, with the object that it grasps."""
        files = sorted(path.glob("labels_*.npz"))
        if not files:
            return self.hands(min(path.glob("*/labels_*.npz")).parent)
        meta = path.absolute().parent / "meta.yml"
        with reading(meta):
            given = msgspec.yaml.decode(meta.read_bytes())
            place = given["ycb_grasp_ind"]
            thing = _YCB.split()[given["ycb_ids"][place]]
            side = given["mano_sides"][0]
        joints, poses = [], []
        for file in files:
            with reading(file):
                arrays = read_archive(file)
                joints.append(_seen(arrays["joint_3d"], 21, 3))
                poses.append(_seen(arrays["pose_y"][place], 12))
        hand = np.array(joints)[:, np.argsort(FROM_MANO)]
        return _holding(
            {side: {"joints": hand}},
            thing,
            np.array(poses),
            path,
            f"models/{thing}/textured_simple.obj",
        )


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
        with path.open("rb") as stream:
            tables = read_table(stream)
        file = path.with_suffix("").with_suffix(".object.npy")
        with reading(file):
            rows = as_floats(np.load(file), "", shape=("T", 7))
        hands = {
            side: {
                "global_orient": own["rot"],
                "hand_pose": own["pose"],
                "transl": own["trans"],
                "betas": np.reshape(own["shape"], (-1, 10))[0],
                "flat_hand_mean": False,
            }
            for side, own in tables.items()
        }
        pose = affine(rotations_of(rows[:, 1:4]), 1e-3 * rows[:, 4:])
        return _holding(hands, path.name.partition("_")[0], pose, path)
