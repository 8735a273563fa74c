"""Companions that fall silent, and their readings at the beginning of a recording."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tactomo.imaging.companions import Companions
from tactomo.protocols.native import NativeProtocol
from tactomo.scans import ChannelScan, DualScan, Felt
from tactomo_models import load_description
from tactomo_models.scans.companion_forces import CompanionReading as Told
from tactomo_protocol import (
    Channel,
    CompanionReading,
    Hello,
    Packet,
    SampleFormat,
    ScanFlag,
    encode,
)
from variants import variant

CELL = {"gain_n_per_unit": 1.0, "noise_n": 0.5, "limits": [-1.0, 50.0]}
SENSOR = variant(load_description("graded_square"), companion={"cell": CELL})
REST = np.linspace(0.05, 0.2, SENSOR.measurements)


class Heard:
    """Companions of a sensor, their events, and scans at 20 Hz."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.companions = Companions(SENSOR, self.note)
        self.now_us = 0

    def note(self, name: str, *_: Any, **__: Any) -> bool:
        if self.events[-1:] != [name]:
            self.events.append(name)
        return True

    def scan(self, *felt: Felt) -> list[Told]:
        self.now_us += 50_000
        times = (0, 0, 0)
        scan = ChannelScan(
            Channel.MAGNITUDE, 1, self.now_us, ScanFlag(0), REST, *times, 0, companions=felt
        )
        return self.companions.read(DualScan(1, scan, None))


@pytest.mark.parametrize("gone", [(), (Felt("cell", 51.0, 0),), (Felt("cell", np.nan, 0),)])
def test_one_without_a_reading_for_a_second_is_told(gone: tuple[Felt, ...]) -> None:
    heard = Heard()
    heard.scan(Felt("cell", 4.0, 0))
    for _ in range(20):
        heard.scan(*gone)
    assert heard.events == ["companion_back"]  # which the book of events knows to be no news
    heard.scan(*gone)
    assert heard.events[1:] == ["companion_lost"]


def test_a_recording_begins_with_the_newest_readings() -> None:
    hello = Hello(
        *("skin", "1", (Channel.MAGNITUDE,), 16, 1, 1, len(REST), SampleFormat.INT32, 1e-6, 20.0)
    )
    said: list[Packet] = [
        hello,
        *(CompanionReading(1, ScanFlag(0), 10 * n, float(n)) for n in range(40)),
    ]
    protocol = NativeProtocol(SENSOR)
    protocol.feed(b"".join(map(encode, said)))
    begun = encode(said[-1])[:-3]
    protocol.feed(begun)
    later = NativeProtocol(SENSOR)
    assert later.feed(protocol.preamble()) == [hello, *said[-32:]]
    assert later.feed(encode(said[-1])[-3:]) == [said[-1]]
