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
