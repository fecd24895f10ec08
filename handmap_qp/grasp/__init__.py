"""Grasps.

Contacts of a hand with an object, what they bear, how good they are and how they come about (Sec.
IV of the paper).

The grasp as a value, from `contacts`, and its statics with soft synergies, from `statics`, can be
imported from here. `quality` rates a grasp; `preshape` and `closing` close a hand on an object, and
`planning` does so many times and ranks what it gets; `reference` has the paper's own pair.
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
