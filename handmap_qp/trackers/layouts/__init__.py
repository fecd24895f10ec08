"""Layouts of trackers, by name or by file.

A layout is a table, a YAML file of this folder or one of the user's own, not code. Other packages
add layouts by entry points of the group `handmap_qp.layouts`.

    layout = load_layout("openxr26")
    sample = layout.read(poses, time=0.0, side="right")     # a HumanSample
    values = layout.write(sample)                           # the same in the layout's own form
"""

from handmap_qp.trackers.layouts.base import LAYOUTS as LAYOUTS
