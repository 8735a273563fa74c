"""OpenEIT's Spectra board: a line of magnitudes for each frame, in ASCII.

115 200 baud. A frame is `magnitudes: `, then a field of `%8d.%04d,` for each voltage, then CR LF:
32, 192 or 896 of them, for opposite drive and adjacent measurement of 8, 16 or 32 electrodes. They
are sizes in the board's own unit, so the description says `voltages = "unsigned"`. The host chooses
the electrodes by a key and a line feed: `c` 8, `d` 16, `e` 32. The board greets with lines for
people. Other modes than imaging print one number a line (a, a time series) or
`magnitudes:FREQUENCY;VALUE` (b, a spectrum): those are named, not reconstructed.

Builds differ: some print a menu and wait for `c` and a carriage return. What is written is then
`[instrument] start` of the description, such as "c\\r". There is no clock, so scans are dated by
their arrival, and no command to stop.

Source: OpenEIT/EIT_Firmware, OpenEIT.c, at 38a1813, 0e8c65e and later; OpenEIT/OpenEIT,
serialhandler.py, at 418b5e1. Its table of adjacent pairs lists source, sink, V+, V- drive-major,
measuring pairs ascending, those that touch left out, as ours does; the one of opposite pairs was
not to be had and is taken to do the same.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from tactomo_models import SensorDescription
from tactomo_models.sensor.pattern import ring_pairs

from tactomo.errors import ConfigError
from tactomo.protocols.interface import Reading
from tactomo.protocols.lines import LineProtocol, electrodes_of, numbers

FRAME: Final = b"magnitudes:"
KEYS: Final = {8: b"c\n", 16: b"d\n", 32: b"e\n"}
ANOTHER_MODE: Final = "start imaging: `[instrument] start` of the description says by which keys"


class OpenEit(LineProtocol):
    """See `PortProtocol`; raise ConfigError where the description is of no such board."""

    name = "openeit"
    device_id = "openeit"
    emulator = "tactomo.twin.boards:OpenEitBoard"
    patience_s = 10.0  # a frame of 32 electrodes takes seconds, and a key begins it anew

    def __init__(self, description: SensorDescription) -> None:
        super().__init__(description)
        electrodes = description.electrode_count
        if electrodes not in KEYS or not _is_opposite(description):
            raise ConfigError(
                f"{description.name} has {electrodes} electrodes and {description.pattern}; an "
                "OpenEIT board has 8, 16 or 32, drives opposite ones and measures adjacent pairs",
                "give a description such as openeit_disc",
            )
        if description.instrument.voltages == "signed":
            raise ConfigError(
                f"{description.name} is of signed voltages, and an OpenEIT board tells sizes alone",
                'put voltages = "unsigned" under [instrument] in the description',
            )

    def introduction(self) -> list[bytes]:
        """Choose the electrodes, which starts imaging."""
        said = self.description.instrument.start
        return [said.encode() if said else KEYS[self.description.electrode_count]]

    def take(self, line: bytes) -> Reading | None:
        """See `LineProtocol`."""
        if not line:
            return None
        if line.startswith(FRAME):
            return self._frame(line)
        if numbers(line) is not None:
            self.misfit("one number a line: the board is in mode a, a time series", ANOTHER_MODE)
        else:
            self.words(line)
        return None

    def _frame(self, line: bytes) -> Reading | None:
        values = numbers(line)
        if values is None:
            self.counts.unreadable += 1
        elif b";" in line:
            self.misfit("one frequency a line: the board is in mode b, a spectrum", ANOTHER_MODE)
        elif len(values) != self.description.measurements:
            self.misfit(
                f"{len(values)} numbers a line{electrodes_of(len(values))}; the description "
                f"{self.description.name} has {self.description.electrode_count}, "
                f"{self.description.measurements} voltages",
                "give the description of the board that is connected",
            )
        else:
            return self.understood(values)
        return None

    @classmethod
    def recognises(cls, data: bytes) -> bool:
        """See `ForeignProtocol`."""
        return FRAME in data or b"OpenEIT" in data


def _is_opposite(description: SensorDescription) -> bool:
    electrodes = description.electrode_count
    return np.array_equal(
        description.drive_pairs, ring_pairs(electrodes, electrodes // 2)
    ) and np.array_equal(description.measure_pairs, ring_pairs(electrodes, 1))
