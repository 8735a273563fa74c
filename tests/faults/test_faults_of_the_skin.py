"""What a skin may do that is not so: freeze, be two, be pressed while it is tared, come slowly."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Figure, Listen, Play, StartProcess
from pty_skin import Playing, PtySkin, Scenes, moving, still
from tactomo_models import Press, SensorDescription, SkinSimulator
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel, Scan
from waiting import wait_until

PALM_S, PALM_KPA, PALM_RADIUS_M = 30.0, 20.0, 0.04


@pytest.mark.faults
@pytest.mark.parametrize("frozen", [("magnitude",), ("structure",), ("magnitude", "structure")])
@pytest.mark.fault(
    "A converter freezes: {frozen} repeat bit for bit while counters go on, a contact moves",
    "event converter_frozen; every later frame has the flag of the missing channel",
    "20 dual scans/s for 10 s after a tare",
)
def test_a_frozen_converter(
    tared: StartProcess,
    skin: PtySkin,
    scenes: Scenes,
    play: Play,
    listen: Listen,
    figure: Figure,
    monkeypatch: pytest.MonkeyPatch,
    frozen: tuple[str, ...],
) -> None:
    daemon = tared()
    ears = listen(daemon)
    measured, kept = skin.scan, dict[Channel, Scan]()

    def converted(channel: Channel, counter: int, volts: FloatArray) -> Scan:
        scan = measured(channel, counter, volts)
        if channel not in frozen:
            return scan
        kept.setdefault(channel, scan)
        return replace(kept[channel], counter=counter, device_us=scan.device_us)

    monkeypatch.setattr(skin, "scan", converted)
    play(moving(scenes.one))
    flags = {f"{channel}_missing" for channel in frozen}
    ears.wait(lambda h: flags <= set(h.fields["flags"]), "the flag")
    first = len(ears.heard)
    time.sleep(10.0)
    later = ears.heard[first:]
    missing = sum(flags <= set(heard.fields["flags"]) for heard in later)
    figure(f"first flagged frame is number {first}; {missing} of {len(later)} after it flagged")
    assert {event["detail"].split()[0] for event in daemon.told("converter_frozen")} >= set(frozen)
    assert missing == len(later) > 10


@pytest.mark.faults
@pytest.mark.fault(
    "Two whole skins on one daemon",
    "the second skin is refused by name (device_refused); contacts of the first skin show",
    "two ports, each with both channels; the second skin pressed all the time, 20 dual scans/s",
)
def test_two_skins_on_one_daemon(
    tmp_path: Path,
    description: SensorDescription,
    scenes: Scenes,
    start: StartProcess,
    listen: Listen,
    figure: Figure,
) -> None:
    first, second = (PtySkin(tmp_path / name, description, 1) for name in ("first", "second"))
    daemon = start([*first.paths, *second.paths])
    ears = listen(daemon)
    resting = Playing(first, still(scenes.rest), 20.0)
    try:
        wait_until(lambda: daemon.told("tared"), "a reference")
        other = Playing(second, moving(scenes.two), 20.0)
        wait_until(lambda: daemon.told("device_refused"), "the refusal")
        resting.stop()
        before = len(ears.heard)
        pressing = Playing(first, moving(scenes.one), 20.0)
        wait_until(lambda: len(ears.heard) > before + 25, "frames of the first skin")
        pressing.stop()
        other.stop()
    finally:
        resting.stop()
        for each in (first, second):
            each.close()
    frames = ears.heard[before + 5 :]
    one = sum(len(heard.fields["contacts"]) == 1 for heard in frames)
    figure(f"{one} of {len(frames)} frames with the one contact of the first skin")
    assert one > 0.9 * len(frames)


@pytest.mark.faults
@pytest.mark.fault(
    "A tare under a press",
    "reference_disputed until the skin is at rest; then the reference before the tare",
    "a contact of 180 kPa is held, tared and released, 20 dual scans/s",
)
def test_a_tare_under_a_press(
    tared: StartProcess, scenes: Scenes, play: Play, listen: Listen, figure: Figure
) -> None:
    daemon = tared()
    ears = listen(daemon)
    held = play(still(scenes.one[0]))
    ears.wait(lambda h: h.fields["contacts"], "the contact")
    daemon.ask("tare")
    first = len(ears.heard)
    time.sleep(5.0)
    under = ears.heard[first:]
    held.stop()
    let_go = play(still(scenes.rest))
    ears.wait(lambda h: not h.fields["flags"] and not h.fields["contacts"], "rest", len(ears.heard))
    let_go.stop()
    play(still(scenes.one[0]))
    pressed = len(ears.heard)
    ears.wait(lambda h: h.fields["contacts"] and not h.fields["flags"], "the contact", pressed)
    disputed = sum("reference_disputed" in heard.fields["flags"] for heard in under)
    figure(f"{disputed} of {len(under)} frames disputed while it was held; then as before")
    assert disputed == len(under) > 5


@pytest.mark.faults
@pytest.mark.fault(
    "A tare while one channel creeps",
    "the channel is used afterwards, and a contact shows in every frame",
    "the magnitude channel rises by 0.2 % a second for 6 s, tared meanwhile; then 3 s at rest and "
    "3 s of a contact of 180 kPa, 20 dual scans/s",
)
def test_a_tare_while_a_channel_creeps(
    tared: StartProcess, scenes: Scenes, play: Play, listen: Listen, figure: Figure
) -> None:
    daemon = tared()
    ears = listen(daemon)
    magnitude = Channel.MAGNITUDE
    creep = [
        {**scenes.rest, magnitude: scenes.rest[magnitude] * (1 + 1e-4 * n)} for n in range(120)
    ]
    creeping = play(iter(creep))
    ears.wait(lambda _: True, "a frame")
    daemon.ask("tare")
    creeping.join()
    first = len(ears.heard)
    play(itertools.repeat(scenes.rest, 60)).join()
    pressed = len(ears.heard)
    play(itertools.repeat(scenes.one[0], 60)).join()
    frames = ears.heard[first:]
    missing = sum("magnitude_missing" in heard.fields["flags"] for heard in frames)
    shown = sum(len(heard.fields["contacts"]) == 1 for heard in ears.heard[pressed + 3 :])
    later = len(ears.heard) - pressed - 3
    figure(f"{missing} of {len(frames)} frames without the channel; {shown} of {later} show it")
    assert missing == 0
    assert shown == later > 20
    assert not daemon.told("converter_frozen")


@pytest.mark.faults
@pytest.mark.measure(
    "A palm that comes lightly: a pad of 80 mm to 20 kPa within 30 s",
    "no promise",
    "the pressure rises evenly, 20 dual scans/s; frames counted by their number of contacts",
)
def test_a_palm_that_comes_lightly(
    tared: StartProcess,
    skin: PtySkin,
    description: SensorDescription,
    play: Play,
    listen: Listen,
    figure: Figure,
) -> None:
    bare = SkinSimulator(description, 4e-3, unevenness=0.03, impedance_spread=0.1)
    levels_kpa = np.linspace(0.5, PALM_KPA, 40)
    volts = [bare.voltages([Press(0.0, 0.0, kpa, PALM_RADIUS_M)]) for kpa in levels_kpa]
    daemon = tared()
    ears = listen(daemon)
    wait_until(lambda: daemon.status()["subscribers"] == 1, "the subscription")
    before = daemon.status()["dropped_scans"]
    already = len(ears.heard)
    each = round(PALM_S * 20 / len(volts))
    sent = play(itertools.chain.from_iterable([level] * each for level in volts)).join()
    ears.wait(lambda h: h.fields["scan_counter"] == skin.counter - 1, "the last frame")
    frames = ears.heard[already:]
    dropped = daemon.status()["dropped_scans"] - before
    shown: Counter[Any] = Counter(
        "flagged" if heard.fields["flags"] else len(heard.fields["contacts"]) for heard in frames
    )
    told = ", ".join(f"{count} of {what} contacts" for what, count in shown.most_common())
    figure(f"{told}, {dropped} dropped")
    assert len(frames) + dropped == sent
