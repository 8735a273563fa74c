"""Companions' readings against scans, by the device's clock alone."""

from __future__ import annotations

import math

import pytest
from tactomo.acquisition.companion_log import CompanionLog
from tactomo_models import SensorDescription, load_description
from tactomo_protocol import CompanionReading, ScanFlag
from variants import variant

CELL = {"gain_n_per_unit": 1.0, "noise_n": 0.5}
MS = 1000


def sensor(**companions: dict[str, float]) -> SensorDescription:
    return variant(load_description("graded_square"), companion=companions)


def log_of(*readings: tuple[int, float], **cell: float) -> CompanionLog:
    """A log of one load cell's readings: at so many milliseconds, of such a value."""
    log = CompanionLog(sensor(cell={**CELL, **cell}))
    for at_ms, value in readings:
        assert log.take(CompanionReading(0, ScanFlag(0), at_ms * MS, value))
    return log


@pytest.mark.parametrize(
    ("scan_ms", "value", "since_ms"),
    [
        (15, 3.0, 0),  # between two readings
        (20, 4.0, 0),
        (50, 4.0, 30),  # the newest is 30 ms old: tells of the scan if nothing moved since
    ],
)
def test_a_reading_is_of_the_scans_time(scan_ms: int, value: float, since_ms: int) -> None:
    [felt] = log_of((10, 2.0), (20, 4.0)).at(scan_ms * MS)
    assert felt == ("cell", value, since_ms * MS)


def test_dead_time_and_lag_are_waited_for() -> None:
    [felt] = log_of((10, 2.0), (20, 4.0), dead_time_s=0.005, lag_s=0.01).at(10 * MS)
    assert felt == ("cell", 3.0, 40 * MS)  # four time constants
    [felt] = log_of((10, 2.0), (20, 4.0), dead_time_s=0.05).at(20 * MS)
    assert felt == ("cell", 4.0, 50 * MS)


def test_one_that_falls_silent_has_no_reading() -> None:
    log = log_of((10, 2.0))
    assert log.at(400 * MS)
    assert not log.at(600 * MS)
    slow = log_of((0, 2.0), (1000, 2.0))  # a reading a second
    assert slow.at(3900 * MS)
    assert not slow.at(4100 * MS)


def test_a_reading_may_come_again_and_a_clock_that_goes_back_begins_anew() -> None:
    log = log_of((1000, 2.0), (2000, 4.0), (1000, 9.0))
    assert log.at(2000 * MS)[0].value == 4.0
    log.take(CompanionReading(0, ScanFlag(0), 5 * MS, 7.0))
    assert log.at(5 * MS)[0].value == 7.0
    assert not log.at(2000 * MS)


def test_a_clipped_reading_is_no_number_and_an_index_must_be_known() -> None:
    log = log_of((10, 2.0))
    log.take(CompanionReading(0, ScanFlag.SATURATED, 20 * MS, 99.0))
    assert math.isnan(log.at(20 * MS)[0].value)
    assert not log.take(CompanionReading(1, ScanFlag(0), 20 * MS, 1.0))


def test_one_that_repeats_a_reading_for_longer_than_ever_is_frozen() -> None:
    def value_after(*readings: float) -> float:
        log = log_of(*((10 * at, value) for at, value in enumerate(readings)))
        return log.at(10 * (len(readings) - 1) * MS)[0].value

    fine = [float(at) for at in range(150)]
    assert math.isnan(value_after(*fine, *[7.0] * 60))
    assert value_after(*fine, *[7.0] * 60, 8.0) == 8.0
    assert math.isnan(value_after(*fine, *[7.0] * 60, 8.0, *[7.0] * 60))
    assert value_after(*fine, *[7.0] * 40) == 7.0
    # One that is so coarse that it read the same for 0.2 s before.
    assert value_after(*[3.0] * 20, *fine, *[7.0] * 190) == 7.0
    assert value_after(*[7.0] * 500) == 7.0


def test_companions_go_by_their_index_or_else_their_place() -> None:
    both = sensor(pad={**CELL, "index": 7}, cell=CELL)
    assert both.companion_indices == {7: "pad", 1: "cell"}
    with pytest.raises(ValueError, match="two share an index"):
        sensor(pad={**CELL, "index": 1}, cell=CELL)
