"""The client of the mapping service, under its public name; see `handmap_core.client`."""

from handmap_core.client import ADDRESS as ADDRESS
from handmap_core.client import PROTOCOL as PROTOCOL
from handmap_core.client import AsyncClient as AsyncClient
from handmap_core.client import Client as Client
from handmap_core.client import Command as Command
from handmap_core.client import Error as Error
from handmap_core.client import HandFields as HandFields
from handmap_core.client import Hands as Hands
from handmap_core.client import KeyFiles as KeyFiles
from handmap_core.client import Lengths as Lengths
from handmap_core.client import Opened as Opened
from handmap_core.client import Options as Options
from handmap_core.client import Pose as Pose
from handmap_core.client import PoseLike as PoseLike
from handmap_core.client import ServiceError as ServiceError
from handmap_core.client import ServiceTimeoutError as ServiceTimeoutError
from handmap_core.client import State as State
from . import messages as messages
