"""Real recordings with faults of trackers: `DEMO`, `faulty`."""

from __future__ import annotations

import numpy as np
from injection import inject, parse_faults

from handmap_core.human.recording import Recording, sample_columns
from handmap_qp.trackers.formats import read_recording

DEMO = read_recording("demo", "right")


def faulty(text: str) -> Recording:
    """Return two seconds of `DEMO` with faults, as `parse_faults` reads them."""
    samples = list(inject(sample_columns(DEMO.part(slice(0, 120))), parse_faults(text)))
    return Recording(
        name="faulty",
        time=np.array([sample.time for sample in samples]),
        landmarks=np.array([sample.landmarks for sample in samples]),
        valid=np.array([sample.valid for sample in samples]),
        side=DEMO.side,
        confidence=np.array([sample.confidence for sample in samples]),
    )
