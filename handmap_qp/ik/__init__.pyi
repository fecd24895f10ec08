from . import (
    collision as collision,
)
from . import (
    mink_problem as mink_problem,
)
