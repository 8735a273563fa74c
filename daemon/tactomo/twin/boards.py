"""Boards that print their readings, emulated.

The gain is set by the first frame, so that the largest reading is 1; as on a real board, what is
printed is on a scale of its own.
"""

from __future__ import annotations

import numpy as np
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray, IntArray

from tactomo.twin.foreign import Emulator, Frame


class MatrixBoard(Emulator):
    """A board that prints a table at its own pace, once it was told to; see `protocols.matrix`."""

    def __init__(self, description: SensorDescription, rate_hz: float) -> None:
        super().__init__(description, rate_hz)
        self._gain = 0.0
        self._heard = b""
        pairs = description.pairs
        self._place = (
            _numbered(description.drive_pairs, pairs.drive),
            _numbered(description.measure_pairs, pairs.measure),
        )
        self._start = description.instrument.start.encode()
        self._is_single_ended = description.instrument.referenced == "single_ended"

    def greeting(self) -> list[bytes]:
        """See `Emulator`."""
        self.is_streaming = not self._start
        return []

    def hear(self, data: bytes) -> list[bytes]:
        """See `Emulator`."""
        self._heard = (self._heard + data)[-32:]
        if self._start and self._start in self._heard:
            self.is_streaming = True
        return []

    def frame(self, frame: Frame) -> list[bytes]:
        """See `Emulator`."""
        numbers = self._table(frame) / self._description.instrument.volts_per_unit
        return [b"".join(b"%.4f, " % value for value in numbers.ravel()) + b"\n"]

    def _table(self, frame: Frame) -> FloatArray:
        if self._is_single_ended:
            potentials = self._grounded.potentials(self._read(frame.volts))
            return np.asarray(potentials - potentials.min(axis=1, keepdims=True))
        drives, pairs = len(self._description.drive_pairs), len(self._description.measure_pairs)
        table = np.zeros((drives, pairs))
        table[self._place] = self._read(frame.volts)
        return table

    def _read(self, volts: FloatArray) -> FloatArray:
        if not self._gain:
            self._gain = 1.0 / float(np.abs(volts).max())
        read = volts * self._gain
        return read if self._description.instrument.voltages == "signed" else np.abs(read)


def _numbered(listed: IntArray, pairs: IntArray) -> IntArray:
    """Which of the listed pairs each one is."""
    place = {pair: number for number, pair in enumerate(map(tuple, listed.tolist()))}
    return np.array([place[pair] for pair in map(tuple, pairs.tolist())], dtype=np.intp)
