"""Recordings of the MANO hand model as `.npz`: by its 21 joints, or by its parameters.

Parameters go through the user's own copy of the licensed model file (Romero, Tzionas and Black,
Embodied Hands, SIGGRAPH Asia 2017: linear blend skinning with shape and pose offsets). Only the
joints and the five fingertips are computed.
"""

import abc
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from handmap_core.errors import InvalidInputError, RecordingError, expect
from handmap_core.se3 import Array, Arrays, affine, as_floats, transform_points
from handmap_qp.hands import Names, Side, Values
from handmap_qp.human import LANDMARK_COUNT, Recording, regular_time
from .archive import OF_MANO, member_names, read_archive, save_npz
from .base import Entry, RecordingFormat, build_recording, reading, side_of
from .pickled import Sparse, read_table

FROM_MANO = np.r_[0, 13:17, 1:4, 17, 4:7, 18, 10:13, 19, 7:10, 20]
"""Index in MANO's order of each landmark.

That order is 16 joints (wrist; index, middle, little, ring and thumb, three each), then the tips
from thumb to little.
"""
HandArrays = dict[str, Values]
"""Hands as arrays of `ManoFormat`, by the names of their entries."""
_KNOWN = {"side", "time", "fps", "valid", "betas", "transl", "v_template", *OF_MANO}
_KNOWN |= {"global_orient", "flat_hand_mean", "object_pose", "object_shape"}


class HandModelFormat(RecordingFormat):
    """Files whose hands are joints or parameters of MANO."""

    def model_of(self, side: Side) -> Arrays:
        """Load the arrays of `_MODEL` of the user's file or folder, `HANDMAP_MANO`."""
        name = f"MANO_{side.upper()}.pkl"
        found = os.environ.get(ENVIRONMENT)
        if not found:
            raise RecordingError(
                "MANO parameters need the licensed model (mano.is.tue.mpg.de): give the path of "
                f"{name} by --mano, or set {ENVIRONMENT}; joints need no model",
                file=Path(name),
            )
        file = Path(found)
        file = file / name if file.is_dir() else file
        values = read_archive(file) if file.suffix == ".npz" else read_table(file)
        with reading(file):
            arrays = {
                name: as_floats(_dense(values.get(name)), name, shape=shape)
                for name, shape in _MODEL.items()
            }
            parents = arrays["kintree_table"][0, 1:]
            expect(
                (parents < np.arange(1, _JOINTS)).all(),
                "kintree_table",
                "parents before children",
            )
        return arrays

    @abc.abstractmethod
    def hands(self, path: Path) -> HandArrays:
        """Read each recording, by the name of its entry, as arrays of `ManoFormat`."""

    def entries(self, path: Path) -> Sequence[Entry]:
        """List the recordings."""
        entries = []
        for entry, arrays in self.hands(path).items():
            main = next(arrays[name] for name in OF_MANO if name in arrays)
            given = arrays.get("side")
            side = (
                self.hints.side_of_file() if given is None else side_of(given, "side")
            )
            entries.append(Entry(entry, side, len(np.atleast_1d(main))))
        return entries

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one recording."""
        arrays = self.hands(path)[entry.name]
        if "joints" in arrays:
            shape = ("T", LANDMARK_COUNT, 3)
            joints = as_floats(arrays["joints"], "joints", shape=shape)
        else:
            model = self.model_of(entry.side)
            joints = _joints_of_parameters(model, arrays, entry.samples)
        time = arrays.get("time")
        time_source = ""
        if self.hints.fps is not None or not {"time", "fps"} & arrays.keys():
            time = self.hints.time_of_file(len(joints))
        elif time is None:
            fps = float(as_floats(arrays["fps"], "fps", shape=(), is_finite=True))
            time = regular_time(len(joints), fps)
            time_source = f"{fps:g} samples/s, as the file or its format says"
        return build_recording(
            path,
            entry,
            time,
            joints[:, FROM_MANO],
            valid=arrays.get("valid"),
            source=self.name.upper(),
            time_source=time_source,
            object_pose=arrays.get("object_pose"),
            object_shape=str(arrays.get("object_shape", "")),
        )


class ManoFormat(HandModelFormat):
    """Arrays of MANO by name.

    Needed: `side` (right or left), `time (T,)` [s] or `fps`, and either `joints (T, 21, 3)` [m] in
    MANO's order (16 joints, then the tips from thumb to little), or parameters: `pose (T, 48)`, or
    `global_orient (T, 3)` and `hand_pose (T, 45)` or fewer principal components, as rotation
    vectors [rad]; `betas (10,)`, or `v_template (778, 3)` [m], the mesh at rest; `transl (T, 3)`
    [m]; and `flat_hand_mean`, whether 0 is the flat hand. Parameters need the user's copy of the
    model. An object may have `object_pose (T, 4, 4)`, in the same world, and `object_shape`.
    """

    name = "mano"
    suffixes = (".npz",)
    lacks = (
        "wrist",
        "confidence",
        "source",
        "upright",
        "task",
        "time_source",
        "object_pose",
    )

    def recognises(self, path: Path) -> bool:
        """Tell whether the archive has joints or parameters."""
        return path.is_file() and not member_names(path).isdisjoint(OF_MANO)

    def hands(self, path: Path) -> HandArrays:
        """Read the one hand."""
        return {"": read_archive(path)}

    def unread(self, path: Path) -> Names:
        """Name the arrays that a recording cannot hold."""
        return tuple(sorted(member_names(path) - _KNOWN))

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write the joints of one hand."""
        self.check_one_per_hand([*recordings, *recordings[1:]])
        recording = recordings[0]
        arrays = {
            "side": np.array(recording.side),
            "time": recording.time,
            "joints": recording.landmarks[:, np.argsort(FROM_MANO)],
            "valid": recording.valid,
        }
        save_npz(path, arrays)


def _joints_of_parameters(
    model: Arrays,
    arrays: Values,
    count: int,
) -> Array:
    """Return the joints of parameters in MANO's order [m], shape (T, 21, 3)."""
    if "flat_hand_mean" not in arrays:
        raise InvalidInputError(
            "has no array 'flat_hand_mean', which says whether a pose of 0 is the flat hand"
        )

    def given(name: str, *shape: int | str) -> Array:
        return as_floats(arrays.get(name), name, shape=shape, is_finite=True)

    if "pose" in arrays:
        root, fingers = np.split(given("pose", count, 48), [3], axis=1)
    else:
        root = given("global_orient", count, 3)
        fingers = given("hand_pose", count, "k")
    shape = given("betas", _SHAPES) if "betas" in arrays else np.zeros(_SHAPES)
    components = fingers.shape[1]
    expect(
        components <= _TURNS,
        "hand_pose",
        f"at most {_TURNS} numbers",
        value=components,
    )
    if components < _TURNS:
        fingers = fingers @ model["hands_components"][:components]
    if not arrays["flat_hand_mean"]:
        fingers = fingers + model["hands_mean"]
    turns = np.hstack([root, fingers]).reshape(count, _JOINTS, 3)
    if "v_template" in arrays:
        model = model | {"v_template": given("v_template", _VERTICES, 3)}
    joints = _posed_joints(model, turns, shape)
    if "transl" in arrays:
        joints += given("transl", count, 3)[:, None]
    return joints


ENVIRONMENT = "HANDMAP_MANO"
"""Environment variable with the model file, or the folder of MANO_LEFT.pkl and MANO_RIGHT.pkl."""
TIP_VERTICES = [744, 320, 443, 554, 671]
"""Vertices of the fingertips, thumb to little (those of the smplx package)."""
_JOINTS = 16
_VERTICES = 778
_SHAPES = 10
_TURNS = 3 * (_JOINTS - 1)
_MODEL = {
    "v_template": (_VERTICES, 3),
    "shapedirs": (_VERTICES, 3, _SHAPES),
    "posedirs": (_VERTICES, 3, 3 * _TURNS),
    "J_regressor": (_JOINTS, _VERTICES),
    "weights": (_VERTICES, _JOINTS),
    "hands_mean": (_TURNS,),
    "hands_components": (_TURNS, _TURNS),
    "kintree_table": (2, _JOINTS),
}
"""The arrays of a model file, and their shapes."""


def _posed_joints(
    model: Arrays,
    turns: Array,
    shape: Array,
) -> Array:
    """Return joints in MANO's order [m], (T, 21, 3), of rotation vectors [rad], (T, 16, 3)."""
    vertices = model["v_template"] + model["shapedirs"] @ shape
    rest = model["J_regressor"] @ vertices
    rotations = rotations_of(turns)
    offsets = (rotations[:, 1:] - np.eye(3)).reshape(len(turns), -1)
    directions = model["posedirs"][TIP_VERTICES]
    tips = vertices[TIP_VERTICES] + np.einsum("vck,tk->tvc", directions, offsets)
    parents = model["kintree_table"][0, 1:].astype(int)
    poses = affine(rotations, np.vstack([rest[:1], rest[1:] - rest[parents]]))
    for joint, up in enumerate(parents, start=1):
        poses[:, joint] = poses[:, up] @ poses[:, joint]
    # Skin the tips: each joint carries the vertex from its place at rest to its place now.
    carried = transform_points(poses, tips[:, None] - rest[:, None])
    skinned = np.einsum("vj,tjva->tva", model["weights"][TIP_VERTICES], carried)
    return np.hstack([poses[..., :3, 3], skinned])


def rotations_of(turns: Array) -> Array:
    """Return rotations, shape (..., 3, 3), of rotation vectors [rad], shape (..., 3)."""
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
    return rotations.reshape(*turns.shape, 3)


def _dense(values: Any) -> Any:
    """Return the array of a sparse matrix, and anything else as it is."""
    return values.toarray() if isinstance(values, Sparse) else values
