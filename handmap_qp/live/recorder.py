"""`Recorder`: a sink that writes samples into a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.human.recording import Recording
from handmap_qp.human.sample import HumanSample
from handmap_qp.output_files import check_output
from handmap_qp.trackers.formats import write_recordings

SUFFIXES = (".npz", ".csv")
"""Files that hold everything of a sample, and whose writing needs no further package."""


class Recorder:
    """Collects samples, and writes them to a file at the end.

    Samples whose time stamps do not increase are left out and counted, because recordings are in
    the order of time.

    Args:
        file: The file to write, `.npz` or `.csv`; one that exists is replaced at the end. `handmap
            convert` makes other formats of it.
        argument: Argument or option that names it, for errors.

    Raises:
        InvalidInputError: If the file cannot be written there.
    """

    def __init__(self, file: Path, argument: str = "file") -> None:
        self.file, self._argument = check_output(argument, file, SUFFIXES), argument
        self._samples: list[HumanSample] = []
        self._disordered = 0

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # An exception of the source comes before the complaint that nothing was seen.
        if kind is None or any(sample.valid for sample in self._samples):
            self._write()

    def put(self, sample: HumanSample) -> None:
        """Keep a sample.

        Raises:
            InvalidInputError: If it is of the other hand than the first one.
        """
        if self._samples and sample.side != self._samples[0].side:
            raise InvalidInputError(
                argument="side",
                expected=f"samples of the {self._samples[0].side} hand",
                value=sample.side,
            )
        if self._samples and sample.time <= self._samples[-1].time:
            self._disordered += 1
        else:
            self._samples.append(sample)

    def status(self) -> str:
        """Return the number of samples kept."""
        return f"recording {len(self._samples)}"

    def summary(self) -> dict[str, Any]:
        """Return the file and counts."""
        counts = {"recorded": len(self._samples), "not_in_order": self._disordered}
        return counts | {"record": str(self.file)}

    def _write(self) -> None:
        """Write the file.

        Raises:
            InvalidInputError: If the hand was never seen, or the file cannot be written.
        """
        samples = self._samples
        if not any(sample.valid for sample in samples):
            raise InvalidInputError(
                argument=self._argument,
                problem=f"the hand was not seen in any of {len(samples)} samples",
                advice="nothing was written",
            )
        recording = Recording(
            name=self.file.stem,
            time=np.array([sample.time for sample in samples]) - samples[0].time,
            landmarks=np.array([sample.landmarks for sample in samples]),
            valid=np.array([sample.valid for sample in samples]),
            side=samples[0].side,
            source="handmap track",
            confidence=np.array([sample.confidence for sample in samples]),
        )
        write_recordings([recording], self.file)
