"""What other packages add by their entry points, under its public names.

See `handmap_core.plugins`.
"""

from handmap_core.plugins import PluginError as PluginError
from handmap_core.plugins import Plugins as Plugins
