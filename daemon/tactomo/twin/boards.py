"""Boards that print their readings, emulated: OpenEIT's, and those that print a table.

Each sets its gain by the first frame, so that the largest reading suits its format; as on a real
board, what is printed is on a scale of its own.
"""

from __future__ import annotations

import numpy as np
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray, IntArray

from tactomo.protocols.openeit import KEYS
from tactomo.twin.foreign import Frame, Grounded


class _Printer:
    largest: float

    def __init__(self, description: SensorDescription, rate_hz: float) -> None:
        self.rate_hz = rate_hz  # frames a second
        self.is_streaming = False  # whether it sends frames
        self._description = description
        self._gain = 0.0
        self._heard = b""

    def held_up(self) -> list[bytes]:
        """See `Emulator`: nothing."""
        return []

    def _keys(self, data: bytes) -> list[bytes]:
        """Return the lines that the host has completed, without their ends."""
        *lines, self._heard = (self._heard + data).replace(b"\r", b"\n").split(b"\n")
        self._heard = self._heard[-16:]
        return lines

    def _read(self, volts: FloatArray) -> FloatArray:
        if not self._gain:
            self._gain = self.largest / float(np.abs(volts).max())
        read = volts * self._gain
        return read if self._description.instrument.voltages == "signed" else np.abs(read)


class OpenEitBoard(_Printer):
    """A Spectra board, which images from power-up on; see `protocols.openeit`."""

    largest = 4096.0

    def __init__(self, description: SensorDescription, rate_hz: float) -> None:
        super().__init__(description, rate_hz)
        self._own_key = KEYS[description.electrode_count].strip()
        self._mode = b"d"

    def greeting(self) -> list[bytes]:
        """See `Emulator`."""
        self.is_streaming = True
        menu = b"Press:\n a for Time-Series,\n b for Bioimpedance Spectroscopy,\n"
        keys = b" c, d, e for Imaging with 8, 16, 32 electrodes, followed by return key.\n"
        stars = b"*******************\n"
        return [b"\n" + stars + b"OpenEIT:\n" + menu + keys + stars]

    def hear(self, data: bytes) -> list[bytes]:
        """See `Emulator`."""
        answers = []
        for key in self._keys(data):
            if key in _MODES and key != self._mode:
                self._mode = key
                answers.append(_MODES[key])
        return answers

    def frame(self, frame: Frame) -> list[bytes]:
        """See `Emulator`."""
        volts = self._read(frame.volts)
        if self._mode == b"a":
            return [_fixed(volts[0]) + b" \r\n"]
        if self._mode == b"b":
            return [b"magnitudes:%d;%s \r\n" % (f, _fixed(volts[0])) for f in (200, 500, 800)]
        if self._mode != self._own_key:  # no electrodes where it looks for them: zeros
            count = next(n for n, key in KEYS.items() if key.strip() == self._mode)
            volts = np.zeros(count * (count - 4))
        return [b"magnitudes: " + b"".join(_fixed(v) + b"," for v in volts) + b"\r\n"]


_MODES = {
    b"a": b"mode 1: time series\n",
    b"b": b"mode 2: bioimpedance spectroscopy\n",
    **{key.strip(): b"mode 3: imaging\n" for key in KEYS.values()},
}


def _fixed(value: float) -> bytes:
    """A number in the firmware's fixed-point format: sixteenths, printed as %8d.%04d."""
    whole, sixteenths = divmod(round(float(value) * 16), 16)
    return b"%8d.%04d" % (whole, sixteenths * 625)


class MatrixBoard(_Printer):
    """A board that prints a table at its own pace, once it was told to; see `protocols.matrix`."""

    largest = 1.0

    def __init__(self, description: SensorDescription, rate_hz: float) -> None:
        super().__init__(description, rate_hz)
        pairs = description.pairs
        self._place = (
            _numbered(description.drive_pairs, pairs.drive),
            _numbered(description.measure_pairs, pairs.measure),
        )
        self._grounded = Grounded(description)
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


def _numbered(listed: IntArray, pairs: IntArray) -> IntArray:
    """Which of the listed pairs each one is."""
    place = {pair: number for number, pair in enumerate(map(tuple, listed.tolist()))}
    return np.array([place[pair] for pair in map(tuple, pairs.tolist())], dtype=np.intp)
