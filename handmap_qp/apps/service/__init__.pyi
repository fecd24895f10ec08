from . import keys as keys
from . import server as server
