"""The base of all options, under its public name; see `handmap_core.options`."""

from handmap_core.options import LARGEST as LARGEST
from handmap_core.options import NotNegative as NotNegative
from handmap_core.options import Option as Option
from handmap_core.options import Options as Options
from handmap_core.options import Positive as Positive
from handmap_core.options import Share as Share
from handmap_core.options import number as number
from handmap_core.options import options_of as options_of
