"""Grasps: contacts, objects and statics (Sec. IV of the paper)."""

from handmap_qp.apps.grasp.contacts import Contact, Grasp
from handmap_qp.apps.grasp.statics import QuasiStatic, grasp_matrix, quasistatic

__all__ = ["Contact", "Grasp", "QuasiStatic", "grasp_matrix", "quasistatic"]
