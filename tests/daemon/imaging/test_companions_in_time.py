"""Companions that fall silent, and their readings at the beginning of a recording."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_bench import Bench
from fixture_types import Start
from tactomo.imaging.companions import Companions
from tactomo.protocols.native import NativeProtocol
from tactomo.scans import ChannelScan, DualScan, Felt
from tactomo_models import SkinSimulator, load_description
from tactomo_models.scans.companion_forces import CompanionReading as Told
from tactomo_models.sensor.description_file import shipped_text
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


def tare(b: Bench, reading: float | None, volts: Any) -> None:
    """Ask for a tare and send scans with this reading of the cell until it is answered."""
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(b.ask, "tare")
        while not answer.done():
            step(b, reading, volts)


def step(b: Bench, reading: float | None, volts: Any) -> dict[str, Any]:
    """Send a scan, a second after the one before, with this reading of the cell."""
    counter = b.skin.counter + 1
    at_us = 1_000_000 * counter
    if reading is not None:
        b.skin.lines[0].say(CompanionReading(0, ScanFlag(0), at_us, reading))
    only = (Channel.MAGNITUDE,)
    return b.listener.frame(b.skin.scan(channels=only, volts=volts, device_us=at_us))


@pytest.mark.slow
@pytest.mark.parametrize("dead", [None, 1e4], ids=["silent", "beyond its limits"])
def test_a_tare_without_a_reading_leaves_what_the_companion_read_at_rest(
    bench: Start, tmp_path: Path, dead: float | None
) -> None:
    """It does not go back to the description's offset, and takes no reading that is none."""
    cell = "gain_n_per_unit = 2.0\noffset = 5.0\nnoise_n = 0.5\nlimits = [-100.0, 1000.0]\n"
    sensor = tmp_path / "cell.toml"
    sensor.write_text(f"{shipped_text('graded_square')}\n[companion.cell]\n{cell}", "utf-8")
    volts = SkinSimulator(load_description("graded_square"), spacing_m=0.008).voltages([])
    b = bench(real=True, description=str(sensor))
    b.skin.lines[0].introduce()
    while not any(event["name"] == "tared" for event in b.listener.of("event")):
        step(b, 25.0, volts)
    while "companion_missing" not in step(b, dead, volts)["flags"]:
        pass
    tare(b, dead, volts)
    frame = [step(b, 25.0, volts) for _ in range(3)][-1]
    felt = b.ask("status")["companions"]["cell"]
    assert (felt["reading"], felt["force_n"]) == (25.0, 0.0)
    assert not {"companion_missing", "companion_disputed"} & set(frame["flags"])
