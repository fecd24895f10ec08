from . import remote as remote
