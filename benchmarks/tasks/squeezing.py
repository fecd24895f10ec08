"""Presets that press with a force, as mappings of `handmap score --tasks`.

    handmap score --tasks cap --methods benchmarks/tasks/squeezing.py:teleoperation_1

The number is the option `squeeze` [N]. All else is as in the preset.
"""

from handmap_qp import Teleoperation

teleoperation_1 = Teleoperation(squeeze=1.0)
teleoperation_2 = Teleoperation(squeeze=2.0)
teleoperation_3 = Teleoperation(squeeze=3.0)
picking_2 = Teleoperation(picking=1.0, squeeze=2.0)
