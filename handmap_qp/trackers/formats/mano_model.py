"""The joints of the MANO hand model, from the user's own copy of the licensed model file.

Romero, Tzionas and Black, Embodied Hands, SIGGRAPH Asia 2017: linear blend skinning with shape and
pose offsets. Only the joints and the five fingertips are computed.
"""

from __future__ import annotations

import io
import os
import pickle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_qp.errors import RecordingError
from handmap_qp.trackers.formats.archive import DAMAGES, read_archive

ENVIRONMENT = "HANDMAP_MANO"
"""Environment variable with the model file, or the folder of MANO_LEFT.pkl and MANO_RIGHT.pkl."""
TIP_VERTICES = (744, 320, 443, 554, 671)
"""Vertices of the fingertips, thumb to little (those of the smplx package)."""
_JOINTS, _VERTICES, _SHAPES = 16, 778, 10
_SHAPES_OF = {
    "v_template": (_VERTICES, 3),
    "shapedirs": (_VERTICES, 3, _SHAPES),
    "posedirs": (_VERTICES, 3, 9 * (_JOINTS - 1)),
    "J_regressor": (_JOINTS, _VERTICES),
    "weights": (_VERTICES, _JOINTS),
    "hands_mean": (3 * (_JOINTS - 1),),
    "hands_components": (3 * (_JOINTS - 1), 3 * (_JOINTS - 1)),
    "kintree_table": (2, _JOINTS),
}


class ManoModel(NamedTuple):
    """The arrays of a MANO model of one hand, by their names in the file."""

    v_template: np.ndarray
    shapedirs: np.ndarray
    posedirs: np.ndarray
    J_regressor: np.ndarray
    weights: np.ndarray
    hands_mean: np.ndarray
    hands_components: np.ndarray
    kintree_table: np.ndarray

    def joints(
        self, turns: np.ndarray, shape: np.ndarray, translation: np.ndarray
    ) -> np.ndarray:
        """Compute joints and fingertips.

        Args:
            turns: Rotation vectors of the 16 joints, the wrist's first [rad], shape (T, 16, 3).
            shape: Shape coefficients, shape (10,).
            translation: Translation [m], shape (T, 3).

        Returns:
            The 16 joints in MANO's order, then the tips from thumb to little [m], shape (T, 21, 3).
        """
        tips = list(TIP_VERTICES)
        vertices = self.v_template + self.shapedirs @ shape
        rest = self.J_regressor @ vertices
        rotations = _rotations(turns)
        offsets = (rotations[:, 1:] - np.eye(3)).reshape(len(turns), -1)
        posed = vertices[tips] + np.einsum("vck,tk->tvc", self.posedirs[tips], offsets)
        parents = self.kintree_table[0].astype(int)
        turn, place = np.empty_like(rotations), np.empty((len(turns), _JOINTS, 3))
        turn[:, 0], place[:, 0] = rotations[:, 0], rest[0]
        for joint in range(1, _JOINTS):
            up = parents[joint]
            turn[:, joint] = turn[:, up] @ rotations[:, joint]
            place[:, joint] = place[:, up] + turn[:, up] @ (rest[joint] - rest[up])
        # Skin the tips: each joint carries the vertex from its place at rest to its place now.
        carried = np.einsum("tjab,tvjb->tvja", turn, posed[:, :, None] - rest)
        carried += place[:, None]
        skinned = np.einsum("vj,tvja->tva", self.weights[tips], carried)
        return np.concatenate([place, skinned], axis=1) + translation[:, None]


def load_model(side: str, given: Path | None = None) -> ManoModel:
    """Load the user's model file.

    Args:
        side: Which hand.
        given: The file, or its folder; that of the environment variable `HANDMAP_MANO` if omitted.

    Raises:
        RecordingError: If there is none, it cannot be read, or an array has another shape. A pickle
            is read without running code in it: it may hold arrays only.
    """
    named = given or (
        Path(os.environ[ENVIRONMENT]) if os.environ.get(ENVIRONMENT) else None
    )
    if named is None:
        raise RecordingError(
            "MANO parameters need the licensed model (mano.is.tue.mpg.de): give the path of "
            f"MANO_{side.upper()}.pkl by --mano, or set {ENVIRONMENT}; joints need no model",
            file=Path(f"MANO_{side.upper()}.pkl"),
        )
    file = named / f"MANO_{side.upper()}.pkl" if named.is_dir() else named
    values: dict[str, Any] = (
        read_archive(file) if file.suffix == ".npz" else _read_pickle(file)
    )
    arrays = {}
    for name, shape in _SHAPES_OF.items():
        if name not in values:
            raise RecordingError("is missing", file=file, array=name)
        value: Any = values[name]
        array = np.asarray(value.toarray() if hasattr(value, "toarray") else value)
        if array.shape != shape or array.dtype.kind not in "biuf":
            got = f"{array.dtype} of shape {array.shape}"
            raise RecordingError(
                f"expected numbers of shape {shape}, got {got}", file=file, array=name
            )
        arrays[name] = array.astype(float)
    parents = arrays["kintree_table"][0, 1:]
    if not (parents < np.arange(1, _JOINTS)).all():
        raise RecordingError(
            "expected parents before children", file=file, array="kintree_table"
        )
    return ManoModel(**arrays)


def _rotations(turns: np.ndarray) -> np.ndarray:
    """Return the rotation matrices of rotation vectors (..., 3), shape (..., 3, 3)."""
    angle = np.linalg.norm(turns, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(turns, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    cross = cross.reshape(*turns.shape[:-1], 3, 3)
    # sin(a)/a and (1 - cos(a))/a^2 by sinc, which is exact at 0.
    first, half = np.sinc(angle / np.pi), np.sinc(angle / (2.0 * np.pi))
    return np.eye(3) + first * cross + 0.5 * half**2 * (cross @ cross)


class _Shell:
    """Stands for chumpy's classes, which wrap the model's arrays; holds their state."""

    x: Any = None

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.x, dtype=dtype)


_ALLOWED = {
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
    ("scipy.sparse.csc", "csc_matrix"),
    ("scipy.sparse._csc", "csc_matrix"),
}


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickles arrays, and nothing that could run code."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "chumpy":
            return _Shell
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"holds {module}.{name}, which is not read")
        return super().find_class(module, name)


def _read_pickle(file: Path) -> dict[str, Any]:
    try:
        content = file.read_bytes()
        values = _ArrayUnpickler(io.BytesIO(content), encoding="latin1").load()
    except (pickle.UnpicklingError, ImportError, *DAMAGES) as error:
        text = " ".join(str(error).split())
        raise RecordingError(
            f"cannot be read as a MANO model: {text[:160]}", file=file
        ) from error
    if not isinstance(values, dict):
        raise RecordingError(
            "cannot be read as a MANO model: it is no table", file=file
        )
    return values
