"""What the emulated boards print is what the protocols read."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo.protocols import emulator_of, protocol_named
from tactomo.twin.foreign import Frame
from tactomo_models import SensorDescription, load_description
from tactomo_protocol import Scan
from variants import variant

OPENEIT = load_description("openeit_disc")
MATRIX = load_description("matrix_disc")
SIGNED = {"voltages": "signed"}


@pytest.mark.parametrize(
    ("protocol", "sensor"),
    [
        ("openeit", OPENEIT),
        ("matrix", MATRIX),
        ("matrix", variant(MATRIX, instrument={"volts_per_unit": 1e-4, **SIGNED})),
        ("matrix", variant(MATRIX, instrument={"referenced": "single_ended", **SIGNED})),
        ("matrix", variant(MATRIX, pattern={"drive": [[0, 8], [3, 5]], "measure_offset": 2})),
        ("matrix", load_description("matrix_square")),
    ],
)
def test_a_frame_is_read_as_it_was_measured(protocol: str, sensor: SensorDescription) -> None:
    volts = [np.random.default_rng(n).normal(size=sensor.measurements) for n in range(3)]
    board, port = emulator_of(protocol)(sensor, 20.0), protocol_named(protocol, sensor)
    port.feed(b"".join(board.greeting()) + b"\n")
    for message in port.introduction():
        board.hear(message)
    assert board.is_streaming
    for row in volts:
        [*_, scan] = port.feed(b"".join(board.frame(Frame(row, 0.0))))
        assert isinstance(scan, Scan)
        expected = np.abs(row) if sensor.instrument.voltages == "unsigned" else row
        gain = float(scan.samples @ expected / (expected @ expected))
        assert scan.samples == pytest.approx(gain * expected, abs=1e-4 * gain * np.ptp(expected))
    assert port.counts.corrupt == 0


def test_a_board_that_waits_is_silent_until_it_is_told() -> None:
    sensor = variant(MATRIX, instrument={"start": "y"})
    board = emulator_of("matrix")(sensor, 20.0)
    board.greeting()
    board.hear(b"d")
    assert not board.is_streaming
    board.hear(b"y")
    assert board.is_streaming
