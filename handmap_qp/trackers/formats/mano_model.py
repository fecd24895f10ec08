"""The joints of the MANO hand model, from the user's own copy of the licensed model file.

Romero, Tzionas and Black, Embodied Hands, SIGGRAPH Asia 2017: linear blend skinning with shape and
pose offsets. Only the joints and the five fingertips are computed.
"""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_qp.errors import RecordingError
from handmap_qp.trackers.formats.archive import DAMAGES, read_archive

ENVIRONMENT = "HANDMAP_MANO"
"""Environment variable with the model file, or the folder of MANO_LEFT.pkl and MANO_RIGHT.pkl."""
TIP_VERTICES = (744, 320, 443, 554, 671)
"""Vertices of the fingertips, thumb to little (those of the smplx package)."""
_JOINTS = 16
_VERTICES = 778
_SHAPES = 10
_TURNS = 3 * (_JOINTS - 1)
_SHAPES_OF = {
    "v_template": (_VERTICES, 3),
    "shapedirs": (_VERTICES, 3, _SHAPES),
    "posedirs": (_VERTICES, 3, 3 * _TURNS),
    "J_regressor": (_JOINTS, _VERTICES),
    "weights": (_VERTICES, _JOINTS),
    "hands_mean": (_TURNS,),
    "hands_components": (_TURNS, _TURNS),
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
        self,
        turns: np.ndarray,
        shape: np.ndarray,
        translation: np.ndarray,
    ) -> np.ndarray:
        """Compute joints and fingertips.

        Args:
            turns: Rotation vectors of the 16 joints, the wrist's first [rad], shape (T, 16, 3).
            shape: Shape coefficients, shape (10,).
            translation: Translation [m], shape (T, 3).

        Returns:
            The 16 joints in MANO's order, then the tips from thumb to little [m], shape (T, 21, 3).
        """
        from scipy.spatial.transform import Rotation

        tips = list(TIP_VERTICES)
        vertices = self.v_template + self.shapedirs @ shape
        rest = self.J_regressor @ vertices
        rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
        rotations = rotations.reshape(*turns.shape, 3)
        offsets = (rotations[:, 1:] - np.eye(3)).reshape(len(turns), -1)
        posed = vertices[tips] + np.einsum("vck,tk->tvc", self.posedirs[tips], offsets)
        parents = self.kintree_table[0].astype(int)
        turn = np.empty_like(rotations)
        place = np.empty((len(turns), _JOINTS, 3))
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
    name = f"MANO_{side.upper()}.pkl"
    found = given or os.environ.get(ENVIRONMENT)
    if not found:
        raise RecordingError(
            "MANO parameters need the licensed model (mano.is.tue.mpg.de): give the path of "
            f"{name} by --mano, or set {ENVIRONMENT}; joints need no model",
            file=Path(name),
        )
    file = Path(found)
    file = file / name if file.is_dir() else file
    values = read_archive(file) if file.suffix == ".npz" else _read_pickle(file)
    arrays = {key: _array(values, key, file) for key in _SHAPES_OF}
    parents = arrays["kintree_table"][0, 1:]
    if not (parents < np.arange(1, _JOINTS)).all():
        problem = "expected parents before children"
        raise RecordingError(
            problem,
            file=file,
            array="kintree_table",
        )
    return ManoModel(**arrays)


def _array(
    values: Mapping[str, Any],
    name: str,
    file: Path,
) -> np.ndarray:
    """Return an array of the model, dense and of its shape."""
    if name not in values:
        raise RecordingError(
            "is missing",
            file=file,
            array=name,
        )
    value, shape = values[name], _SHAPES_OF[name]
    array = np.asarray(value.toarray() if hasattr(value, "toarray") else value)
    if array.shape != shape or array.dtype.kind not in "biuf":
        got = f"{array.dtype} of shape {array.shape}"
        problem = f"expected numbers of shape {shape}, got {got}"
        raise RecordingError(
            problem,
            file=file,
            array=name,
        )
    return array.astype(float)


class _Shell:
    """Stands for chumpy's classes, which wrap the model's arrays; holds their state."""

    x: Any = None

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.x, dtype=dtype)


_ALLOWED = {
    "numpy.core.multiarray": ("_reconstruct", "scalar"),
    "numpy._core.multiarray": ("_reconstruct", "scalar"),
    "numpy": ("ndarray", "dtype"),
    "_codecs": ("encode",),
    "scipy.sparse.csc": ("csc_matrix",),
    "scipy.sparse._csc": ("csc_matrix",),
}


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickles arrays, and nothing that could run code."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "chumpy":
            return _Shell
        if name not in _ALLOWED.get(module, ()):
            raise pickle.UnpicklingError(f"holds {module}.{name}, which is not read")
        return super().find_class(module, name)


def _read_pickle(file: Path) -> dict[str, Any]:
    problem = "cannot be read as a MANO model"
    try:
        content = io.BytesIO(file.read_bytes())
        values = _ArrayUnpickler(content, encoding="latin1").load()
    except (pickle.UnpicklingError, ImportError, *DAMAGES) as error:
        text = " ".join(str(error).split())[:160]
        raise RecordingError(f"{problem}: {text}", file=file) from error
    if not isinstance(values, dict):
        raise RecordingError(f"{problem}: it is no table", file=file)
    return values
