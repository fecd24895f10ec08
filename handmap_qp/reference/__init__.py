"""The published method in one place, to read and to compare with.

Salvietti, Malvezzi, Gioioso and Prattichizzo, *On the Use of Homogeneous Transformations to Map
Human Hand Movements onto Robotic Hands*, ICRA 2014. In the order in which a sample goes through it:

    estimation             T by least squares (eqs. 5-6)
    decomposition          T = T_def T_rb by polar decomposition (eqs. 2-3)
    targets                both parts imposed on the robot's points (eq. 7)
    teleoperation_targets  what `teleoperation` adds to that
    problem                the cost of the QP in place of eq. (8), over Pinocchio
    task_rows              what distances between points add to it
    mink_problem           the same cost, built by mink
    daqp_solver, solvers   solvers of QPs: DAQP, and all that qpsolvers finds
    inverse_kinematics     the iterations of a sample, through the gate of the robot

The compiled core has the same formulas and is 10 to 40 times faster. A `PublishedMethod` computes
targets here, and `IkOptions(formulation="mink", solver="osqp")` poses and solves the QP here.
A mapping by the core does not load this package.
"""

from .daqp_solver import solve_by_daqp
from .decomposition import Decomposition, Primitives, decompose, polar, primitives
from .estimation import estimate, estimate_motion
from .inverse_kinematics import ReferenceIk
from .problem import direct_cost, point_rows, wrist_rows
from .targets import PublishedMethod

__all__ = [
    "Decomposition",
    "Primitives",
    "PublishedMethod",
    "ReferenceIk",
    "decompose",
    "direct_cost",
    "estimate",
    "estimate_motion",
    "point_rows",
    "polar",
    "primitives",
    "solve_by_daqp",
    "wrist_rows",
]
