"""Measured frames in the place of a simulated skin: what the twin's device says is what one said.

The files are those that `tactomo import` reads. Of single-ended readings the electrodes' own
potentials are kept, so that an instrument that sends those says them again to the last bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tactomo_models import Press, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel

from tactomo.recordings.imported_scans import (
    electrode_potentials,
    is_single_ended,
    load_arrays,
    read_scans,
)

REST_FRAMES = 40  #: how often a file's reference is said first, so that a daemon can tare by it


class PlayedFrame(Mapping[Channel, FloatArray]):
    """One frame: volts of each channel in the description's order."""

    def __init__(
        self, volts: Mapping[Channel, FloatArray], potentials: NDArray[np.complexfloating] | None
    ) -> None:
        # (injections, electrodes) volts against ground, where the file has them; the injections in
        # the description's order
        self.potentials = potentials
        self._volts = volts

    def __getitem__(self, name: Channel) -> FloatArray:
        return self._volts[name]

    def __iter__(self) -> Iterator[Channel]:
        return iter(self._volts)

    def __len__(self) -> int:
        return len(self._volts)


class Player:
    """The frames of a file one after another, whatever presses; a `SkinModel`.

    Used by one thread; `is_over` may be read by others.

    Raises ImportFileError where the file cannot be read, or does not fit the sensor.
    """

    def __init__(self, path: Path, description: SensorDescription, once: bool = False) -> None:
        scans = read_scans(path, description, None)
        arrays = load_arrays(path)
        self._potentials = (
            electrode_potentials(path, arrays, description) if is_single_ended(arrays) else None
        )
        self._volts = dict(scans.volts)
        self._order = list(range(scans.count))
        if scans.reference:  # the row after the last
            for channel, volts in scans.reference.items():
                self._volts[channel] = np.vstack([self._volts[channel], volts])
            self._order = [scans.count] * REST_FRAMES + self._order
        seconds = 0.0 if scans.time_s is None else float(scans.time_s[-1])
        # mean rate of the frames; None where the file does not say
        self.rate_hz = (scans.count - 1) / seconds if seconds else None
        self.is_over = False  # whether the last frame has been said and none follows
        self._once = once
        self._next = 0

    @property
    def largest_v(self) -> float:
        """The largest voltage in the file, of any channel."""
        return max(float(np.nanmax(np.abs(volts))) for volts in self._volts.values())

    def voltages(self, _: Sequence[Press]) -> PlayedFrame:
        """Return the next frame."""
        row = self._order[self._next]
        self._next = (self._next + 1) % len(self._order)
        self.is_over = self._once and self._next == 0
        potentials = None if self._potentials is None else self._potentials[row]
        return PlayedFrame({name: volts[row] for name, volts in self._volts.items()}, potentials)
