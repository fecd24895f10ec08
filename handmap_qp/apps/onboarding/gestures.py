"""Gestures of the recording that comes with the package, mapped to a hand: `draw_gestures`."""

from handmap_core.errors import HandError
from handmap_core.se3 import Arrays
from handmap_qp.apps.drawing.contact_sheet import pose_pictures, sheet_rows
from handmap_qp.apps.offline.comparison import (
    compare_methods,
    own_method,
    prepare_take,
)
from handmap_qp.apps.offline.metrics import METRICS
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.hands import Hand
from handmap_qp.mapping import default_preset
from handmap_qp.trackers import DEMO, read_recording

GESTURES = ("open", "pointing", "fist", "index pinch", "middle pinch")
"""The gestures that are shown, names of `find_poses`."""
_SCORES = ("extension_correlation", "finger_direction_deg", "pinch_closed")


def draw_gestures(hand: Hand) -> tuple[Arrays, str]:
    """Map the recording to a hand by its default preset, and draw human and robot.

    Returns:
        Pictures of both by the gesture's name, red, green and blue from 0 to 1, shape (2, height,
        width, 3), and scores of `handmap compare`.

    Raises:
        HandmapError: If the hand cannot be mapped or drawn.
    """
    take = prepare_take(read_recording(DEMO, hand.side), hand.side)
    method = own_method(default_preset(take.human, hand))
    (run,) = compare_methods([take], hand, [method]).runs
    if run.motion is None:
        raise HandError(run.problem)
    found = find_poses(take.recording)
    samples = {name: found[name] for name in GESTURES}
    rows = sheet_rows(take.recording, samples, [run.motion.q])
    # From between palm and thumb.
    pictures = pose_pictures([(hand.name, hand)], rows, side=hand.side)[:, :, 1]
    scores = [
        f"{metric.label} {metric.text(run.values[metric.key])}"
        for metric in METRICS
        if metric.key in _SCORES
    ]
    return dict(zip(samples, pictures, strict=True)), ", ".join(scores)
