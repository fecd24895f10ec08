"""Hypothesis strategies for rotations, motions and point sets.

Hypothesis draws sizes, scales and conditions, which shrink to something readable; a seed draws the
bulk of the numbers.
"""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

seeds = st.integers(min_value=0, max_value=2**32 - 1)
generators = seeds.map(np.random.default_rng)

coordinates = st.floats(min_value=-2.0, max_value=2.0, allow_subnormal=False)
translations = st.tuples(coordinates, coordinates, coordinates).map(np.array)


def _unit_quat(generator: np.random.Generator) -> np.ndarray:
    quat = generator.normal(size=4)
    return quat / np.linalg.norm(quat)


# A normalised Gaussian has no preferred direction, so the rotations are uniform.
unit_quats = generators.map(_unit_quat)
rotations = unit_quats.map(lambda quat: Rotation.from_quat(quat).as_matrix())


def motion_of(linear: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The 4x4 of `x -> linear @ x + translation`, written out.

    Tests do not depend on the tested code.
    """
    motion = np.eye(4)
    motion[:3, :3] = linear
    motion[:3, 3] = translation
    return motion


poses = st.builds(motion_of, rotations, translations)


@st.composite
def linear_maps(
    draw: st.DrawFn, largest: float = 3.0, mirrored: bool | None = False
) -> np.ndarray:
    """Invertible (3, 3) matrices with singular values in [1 / largest, largest].

    `mirrored=None` draws either sign.
    """
    stretches = np.array(
        [draw(st.floats(min_value=1.0 / largest, max_value=largest)) for _ in range(3)]
    )
    if draw(st.booleans()) if mirrored is None else mirrored:
        stretches[0] *= -1.0
    return (draw(rotations) * stretches) @ draw(rotations)


@st.composite
def affine_motions(
    draw: st.DrawFn, largest: float = 3.0, mirrored: bool | None = False
) -> np.ndarray:
    """Invertible motions (4, 4) whose condition is at most `largest ** 2`."""
    return motion_of(draw(linear_maps(largest, mirrored)), draw(translations))


@st.composite
def point_sets(
    draw: st.DrawFn,
    *,
    middle: tuple[float, float] = (0.1, 1.0),
    smallest: tuple[float, float] = (0.1, 1.0),
    least: int = 4,
) -> np.ndarray:
    """Points (n, 3) [m], a centimetre to a metre large, anywhere within 2 m of the origin.

    `middle` and `smallest` bound the singular values of the centred points as parts of the next
    larger one, so that the condition is known: at most 100 by default.
    """
    count = draw(st.integers(min_value=least, max_value=12))
    spread = draw(st.floats(min_value=0.01, max_value=1.0))
    second = spread * draw(st.floats(*middle))
    third = second * draw(st.floats(*smallest))
    cloud = draw(generators).normal(size=(count, 3))
    # Centring first makes the columns of the orthonormal factor centred as well.
    directions, _ = np.linalg.qr(cloud - cloud.mean(axis=0))
    return directions * (spread, second, third) @ draw(rotations).T + draw(translations)


near_coplanar_point_sets = point_sets(middle=(0.5, 1.0), smallest=(1e-6, 1e-2))
coplanar_point_sets = point_sets(middle=(0.5, 1.0), smallest=(0.0, 0.0))
collinear_point_sets = point_sets(middle=(0.0, 0.0), smallest=(0.0, 0.0))


def weights_for(points: np.ndarray) -> st.SearchStrategy[np.ndarray]:
    """Positive weights (n,) for these points, a hundredfold apart at most."""
    return st.lists(
        st.floats(min_value=0.1, max_value=10.0),
        min_size=len(points),
        max_size=len(points),
    ).map(np.array)


def noise_like(points: np.ndarray, size: float) -> st.SearchStrategy[np.ndarray]:
    """Gaussian noise [m] in the shape of these points."""
    return generators.map(lambda generator: size * generator.normal(size=points.shape))
