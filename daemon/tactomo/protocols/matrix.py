"""Boards that print a table of numbers: what many open Arduino, Teensy and ESP32 boards do.

A frame is one line of every drive by every measuring pair (N x N), drive-major, with whatever the
board likes where pairs share an electrode; or one line of the description's voltages alone; or a
line `A`, or an empty one, and then a line for each drive. Numbers are whole or not, separated by
commas, semicolons or white space, also at the end, after a prefix such as `magnitudes:` or none.

`[instrument]` of the description says the rest: `volts_per_unit`; `voltages`; `referenced`, where
`single_ended` are readings of every electrode for each drive, against the one that the current
leaves by; `start`, what the board waits for, if it does. There is no clock, so scans are dated by
their arrival.

Known to speak so: OpenEIT's Spectra board (OpenEIT/EIT_Firmware, OpenEIT.c, at 38a1813), sizes of
opposite drive after `magnitudes: `, begun by the key of its electrodes, `c` 8, `d` 16, `e` 32;
Teensy and AD5930 boards (lorcan2440/EIT_Touch_Sensor at 3b65e12;
knazari/eit_hybrid_state_estimation at 69ca5ea, whose builds wait for `y` or `d`), volts rms, a
trailing comma, zeros where pairs share an electrode; the ESP32 of richgumy/black_sensor at
11ba7e9, lines of whole tenths of a millivolt after `A`.
"""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.pattern import touching

from tactomo.protocols.interface import Reading
from tactomo.protocols.lines import LineProtocol, electrodes_of, numbers

BEGINNINGS: Final = (b"", b"A")
ANOTHER_BOARD: Final = "give the description of the board that is connected"
FEWEST_IN_ROW: Final = 8  # numbers in a line of a table, or of a row of it, at least


class Matrix(LineProtocol):
    """See `PortProtocol`."""

    name = "matrix"
    device_id = "matrix"
    emulator = "tactomo.twin.foreign:MatrixBoard"
    patience_s = 10.0  # a frame of 32 electrodes takes seconds, and a key may begin it anew

    def __init__(self, description: SensorDescription) -> None:
        super().__init__(description)
        drive, measure = description.drive_pairs, description.measure_pairs
        self._drives = len(drive)
        self._is_single_ended = description.instrument.referenced == "single_ended"
        self._width = description.electrode_count if self._is_single_ended else len(measure)
        every = np.repeat(drive, len(measure), axis=0), np.tile(measure, (len(drive), 1))
        self._drive, self._pair = np.divmod(np.flatnonzero(~touching(*every)), len(measure))
        self._plus, self._minus = description.pairs.measure.T
        self._rows: list[bytes] | None = None  # since a line that begins a frame of several

    def introduction(self) -> list[bytes]:
        """Write what the board waits for, if it does."""
        start = self.description.instrument.start
        return [start.encode()] if start else []

    def rows_begun(self) -> list[bytes]:
        """See `LineProtocol`."""
        return [] if self._rows is None else [BEGINNINGS[1], *self._rows]

    def restart(self) -> None:
        """See `PortProtocol`."""
        super().restart()
        self._rows = None

    def take(self, line: bytes) -> Reading | None:
        """See `LineProtocol`."""
        if line in BEGINNINGS:
            self._begin_rows()
            return None
        values = numbers(line)
        if values is None:
            self._rows = None
            self.words(line)
            return None
        if len(values) == self._drives * self._width:
            return self.understood(self._of_table(values.reshape(self._drives, self._width)))
        if len(values) == self.description.measurements and not self._is_single_ended:
            return self.understood(values)
        if len(values) == self._width and self._rows is not None:
            return self._take_row(line, self._rows)
        self._tell_misfit(len(values))
        return None

    def _begin_rows(self) -> None:
        if self._rows:
            self.misfit(
                f"frames of {len(self._rows)} lines of {self._width} numbers; the description "
                f"{self.description.name} has {self._drives} drives",
                ANOTHER_BOARD,
            )
        self._rows = []

    def _take_row(self, line: bytes, rows: list[bytes]) -> Reading | None:
        rows.append(line)
        if len(rows) < self._drives:
            return None
        self._rows = None
        table = np.array([numbers(row) for row in rows])
        return self.understood(self._of_table(table))

    def _of_table(self, table: FloatArray) -> FloatArray:
        """Voltages (M,) of a table (drives, pairs), or (drives, electrodes) where single-ended."""
        if self._is_single_ended:
            return np.asarray(table[self._drive, self._plus] - table[self._drive, self._minus])
        return np.asarray(table[self._drive, self._pair])

    def _tell_misfit(self, count: int) -> None:
        described = (
            f"the description {self.description.name} has {self.description.electrode_count} and "
            f"takes {self._drives * self._width} or {self.description.measurements}"
        )
        if count == self._width:
            described = "and no line, empty or of an A, that says where a frame begins"
        self.misfit(f"{count} numbers a line{electrodes_of(count)}; {described}", ANOTHER_BOARD)

    @classmethod
    def recognises(cls, data: bytes) -> bool:
        """See `ForeignProtocol`: two whole lines of as many numbers."""
        found = Counter(
            len(values)
            for line in data.split(b"\n")[1:-1]
            if (values := numbers(line)) is not None and len(values) >= FEWEST_IN_ROW
        )
        return any(lines > 1 for lines in found.values())
