"""Grasps: contacts, statics, quality measures, closing and planning (Sec. IV of the paper).

`Grasp` and `Contact` are in `contacts`; the statics with soft synergies are in `statics`. Both can
be imported from here. `measures` rates a grasp. `preshape` and `closing` close a hand on an object;
`planning` closes it from many palm poses and ranks the grasps. `paper_cube` holds the two grasps of
the paper.
"""

from handmap_qp.grasp.contacts import Contact, Grasp, contact_jacobian, contact_points
from handmap_qp.grasp.statics import QuasiStatic, grasp_matrix, quasistatic

__all__ = [
    "Contact",
    "Grasp",
    "QuasiStatic",
    "contact_jacobian",
    "contact_points",
    "grasp_matrix",
    "quasistatic",
]
