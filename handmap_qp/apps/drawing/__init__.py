"""A software renderer for hands, without a display."""

from .contact_sheet import landmarks_in_palm, save_contact_sheet
from .hands import (
    AXIS_COLOURS,
    GREY,
    HUMAN_COLOUR,
    ROBOT_COLOUR,
    UPRIGHT,
    draw_hands,
    load_shape,
    require_drawing,
    require_matplotlib,
    save_panels,
    save_picture,
    spheres,
    tube,
)
from .layout_pictures import save_layout_picture
from .moments import ShownHand, ShownMotion, moments_sheet
from .raster import Camera, Colour, Triangles, merged
from .scene import PANEL, Scene
from .shapes import LinkShape, read_shapes, shape_meshes

__all__ = [
    "AXIS_COLOURS",
    "GREY",
    "HUMAN_COLOUR",
    "PANEL",
    "ROBOT_COLOUR",
    "UPRIGHT",
    "Camera",
    "Colour",
    "LinkShape",
    "Scene",
    "ShownHand",
    "ShownMotion",
    "Triangles",
    "draw_hands",
    "landmarks_in_palm",
    "load_shape",
    "merged",
    "moments_sheet",
    "read_shapes",
    "require_drawing",
    "require_matplotlib",
    "save_contact_sheet",
    "save_layout_picture",
    "save_panels",
    "save_picture",
    "shape_meshes",
    "spheres",
    "tube",
]
