"""The numbers of `ik.nearest_posture`, where the compiled core reads them."""

from handmap_qp.ik.nearest_posture import _LEAST_CURVATURE as _LEAST_CURVATURE
from handmap_qp.ik.nearest_posture import _LEAST_DECREASE as _LEAST_DECREASE
from handmap_qp.ik.nearest_posture import _MOST_STEPS as _MOST_STEPS
from handmap_qp.ik.nearest_posture import _ROUNDING as _ROUNDING
from handmap_qp.ik.nearest_posture import _SMALLEST_SHARE as _SMALLEST_SHARE
from handmap_qp.ik.nearest_posture import _SMALLEST_STEP as _SMALLEST_STEP
