"""Every error that is raised on purpose, under its public name; see `handmap_core.errors`."""

from handmap_core.errors import DegeneratePointsError as DegeneratePointsError
from handmap_core.errors import DiskFullError as DiskFullError
from handmap_core.errors import HandError as HandError
from handmap_core.errors import HandmapError as HandmapError
from handmap_core.errors import InvalidInputError as InvalidInputError
from handmap_core.errors import InvalidOptionsError as InvalidOptionsError
from handmap_core.errors import MapperBusyError as MapperBusyError
from handmap_core.errors import MissingCoreError as MissingCoreError
from handmap_core.errors import MissingExtraError as MissingExtraError
from handmap_core.errors import MissingPackageError as MissingPackageError
from handmap_core.errors import RecordingError as RecordingError
from handmap_core.errors import RefusedError as RefusedError
from handmap_core.errors import describe_value as describe_value
from handmap_core.errors import did_you_mean as did_you_mean
from handmap_core.errors import expect as expect
from handmap_core.errors import reason_of as reason_of
from handmap_core.errors import require as require
from handmap_core.errors import warn as warn
