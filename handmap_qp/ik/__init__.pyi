from . import (
    collision as collision,
)
from . import (
    compiled as compiled,
)
from . import (
    mink_problem as mink_problem,
)
from . import (
    solvers as solvers,
)
from .collision import pair_bounds as pair_bounds
from .compiled import core_tree as core_tree
from .core import Compiled as Compiled
from .core import Parts as Parts
from .core import in_core as in_core
from .limits import SHORTEST_DT as SHORTEST_DT
from .limits import Gate as Gate
from .limits import Motion as Motion
from .limits import braking_displacement as braking_displacement
from .limits import feasible as feasible
from .options import LENGTH_UNIT as LENGTH_UNIT
from .options import IkOptions as IkOptions
from .qp import WRIST_LEVERS as WRIST_LEVERS
from .qp import IkResult as IkResult
from .qp import PointIk as PointIk
from .qp import Status as Status
from .qp import solve_by_daqp as solve_by_daqp
from .qp import wrist_error as wrist_error
from .tasks import AttachedPoints as AttachedPoints
from .tasks import PointDistances as PointDistances
from .tasks import PointOffset as PointOffset
from .tasks import Task as Task
from .tasks import TaskRows as TaskRows
