from . import (
    mjcf as mjcf,
)
