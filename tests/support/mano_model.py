"""A hand model in MANO's layout, with numbers of our own: the real one is licensed."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse


def write_mano_model(path: Path, seed: int = 0) -> None:
    """Write a model, as `.npz` or as a pickle; landmarks of different seeds differ."""
    rng = np.random.default_rng(seed)
    parents = np.array([0, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14])
    model: dict[str, Any] = {
        "v_template": rng.normal(0.0, 0.05, (778, 3)),
        "shapedirs": rng.normal(0.0, 1e-3, (778, 3, 10)),
        "posedirs": rng.normal(0.0, 1e-4, (778, 3, 135)),
        "J_regressor": rng.dirichlet(np.ones(778), 16),
        "weights": rng.dirichlet(np.ones(16), 778),
        "hands_mean": rng.normal(0.0, 0.1, 45),
        "hands_components": np.linalg.qr(rng.normal(size=(45, 45)))[0],
        "kintree_table": np.array([parents, np.arange(16)]),
    }
    if path.suffix == ".npz":
        np.savez(path, **model)
    else:
        model["J_regressor"] = scipy.sparse.csc_matrix(model["J_regressor"])
        path.write_bytes(pickle.dumps(model))
