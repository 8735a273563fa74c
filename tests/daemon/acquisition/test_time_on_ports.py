"""When scans were acquired, as a daemon tells it: late bytes, two boards, a clock that is set."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Start
from tactomo.log import configure_logging
from tactomo.recordings.recording_writer import write_recording
from tactomo_protocol import (
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    Hello,
    SampleFormat,
    Scan,
    ScanFlag,
)

MAGNITUDE, STRUCTURE = Channel.MAGNITUDE, Channel.STRUCTURE
PERIOD_S = 0.05
DAY_S = 86_400.0
DATES = ("delay_ns", "dated_by", "skew_ms", "flags", "device_us")


def recorded(
    path: Path,
    held_up_s: dict[int, float] | None = None,
    device_us: Callable[[int], int] = lambda number: number * 50_000,
    structure_after_us: int = 0,
) -> Path:
    """Write a recording of 400 dual scans at 20 Hz, of which some came late."""
    hello = Hello("made", "1", tuple(Channel), 16, 1, 1, 208, SampleFormat.FLOAT32, 1.0, 20.0)
    volts = np.linspace(0.05, 0.2, 208).astype(np.float32)
    scans = []
    for number in range(400):
        came_s = number * PERIOD_S + (held_up_s or {}).get(number, 0.0)
        for channel, after_us in ((MAGNITUDE, 0), (STRUCTURE, structure_after_us)):
            us = device_us(number) + after_us
            scans.append((came_s, Scan(channel, number, us, ScanFlag(0), volts)))
    write_recording(
        path, hello, scans, sensor="s", description="paper_square", description_sha256=""
    )
    return path


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0, 60])
def test_what_waited_in_a_buffer_is_as_old_as_it_is(
    replay: Start, tmp_path: Path, speed: float
) -> None:
    held_up = {300 + n: (20 - n) * PERIOD_S for n in range(20)}  # one second of it, at once
    frames = replay(recorded(tmp_path / "late.mcap", held_up), speed=speed, lossless=True).of("map")
    assert [frame["scan_counter"] for frame in frames] == list(range(400))
    assert {frame["dated_by"] for frame in frames[:190]} == {"arrival"}
    assert {frame["dated_by"] for frame in frames[290:]} == {"device"}
    late_ms = [round(frame["delay_ns"] * 1e-6) for frame in frames[290:330]]
    assert late_ms == [round(1e3 * held_up.get(290 + n, 0.0)) for n in range(40)]
    for frame in frames[290:330]:
        assert frame["age_ns"] >= frame["delay_ns"]


def test_a_clock_that_jumps_is_said_to_have_jumped(
    replay: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def wrapped(number: int) -> int:
        return (2**32 - 300 * 50_000 + number * 50_000) % 2**32

    configure_logging("info", "text")
    frames = replay(recorded(tmp_path / "wrap.mcap", device_us=wrapped), lossless=True).of("map")
    assert [len(frame["flags"]) for frame in frames[20:]] == [0] * 380  # paired all the same
    assert {frame["dated_by"] for frame in frames[290:300]} == {"device"}
    assert {frame["dated_by"] for frame in frames[300:]} == {"arrival"}
    assert "device_clock_jumped" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(("ports", "speed"), [(1, 20), (2, 0)])
def test_an_exact_replay_has_the_dates_and_flags_of_the_live_run(
    bench: Start, replay: Start, tmp_path: Path, ports: int, speed: float
) -> None:
    path = tmp_path / "live.mcap"
    b = bench(ports=ports, recording={"file": path}, sync_wait_ms=30).tare()
    for number in range(8):
        b.skin.scan(channels=(MAGNITUDE,), device_us=10**7 + number * 50_000)
        sent_ns = time.monotonic_ns()
        b.until(lambda since_ns=sent_ns: time.monotonic_ns() > since_ns + 5_000_000)  # held up
        b.skin.scan(
            channels=(STRUCTURE,), counter=b.skin.counter, device_us=10**7 + number * 50_000 + 9
        )
        b.listener.frame(b.skin.counter)
    b.daemon.stop()
    live = {m["scan_counter"]: m for m in b.listener.of("map")}
    again = {m["scan_counter"]: m for m in replay(path, speed=speed).of("map")}
    assert again.keys() == live.keys()
    for counter, frame in live.items():
        assert {key: again[counter][key] for key in DATES} == {key: frame[key] for key in DATES}
    assert any(frame["delay_ns"] > 4e6 for frame in live.values())


class Boards:
    """Two boards with counters of their own, in a world where a second takes 20 scans."""

    def __init__(self, bench: Any, magnitude: int, structure: int) -> None:
        self.bench = bench
        self.counters = {MAGNITUDE: magnitude, STRUCTURE: structure}
        self.device_us = {MAGNITUDE: 500_000_000, STRUCTURE: 9_000_000}

    def scan(self) -> int:
        for channel in Channel:
            self.counters[channel] += 1
            self.device_us[channel] += 50_000
            self.bench.skin.scan(
                channels=(channel,),
                counter=self.counters[channel],
                device_us=self.device_us[channel],
            )
        return self.counters[MAGNITUDE]

    def commands(self) -> dict[Channel, list[Command]]:
        return {channel: self.bench.skin.line_of(channel).heard() for channel in Channel}


def test_boards_out_of_step_are_flagged_zeroed_and_forgiven(bench: Start) -> None:
    b = bench(ports=2, sync_wait_ms=50).tare()
    boards = Boards(b, magnitude=5000, structure=40)
    boards.commands()
    heard: dict[Channel, list[Command]] = {channel: [] for channel in Channel}

    def are_asked() -> bool:
        boards.scan()
        for channel, commands in boards.commands().items():
            heard[channel] += [c for c in commands if c.code == CommandCode.ZERO_COUNTERS]
        return all(heard.values())

    b.until(are_asked)
    event = b.listener.event("channels_skewed")
    assert "sync line" in event["next_step"]
    b.listener.wait("map", lambda frame: "channels_skewed" in frame["flags"])  # after the event
    for channel, status in ((MAGNITUDE, AckStatus.OK), (STRUCTURE, AckStatus.UNKNOWN_COMMAND)):
        command = heard[channel][0]
        b.skin.line_of(channel).say(Acknowledge(command.request, command.code, status))

    boards.counters = dict.fromkeys(Channel, -1)
    b.until(lambda: boards.scan() > 10 and "channels_in_step" in events(b))
    b.until(lambda: b.listener.frame(boards.scan())["flags"] == [])
    assert "counters_zeroed" in events(b)
    assert "command_refused" not in events(b)


@pytest.mark.slow
def test_an_exact_replay_knows_what_was_known_when_the_recording_began(
    bench: Start, replay: Start, tmp_path: Path
) -> None:
    path = tmp_path / "live.mcap"
    b = bench(ports=2, sync_wait_ms=50).tare()
    boards = Boards(b, magnitude=5000, structure=40)
    b.until(lambda: boards.scan() and "channels_skewed" in events(b))
    b.ask("record_start", path=path.name)
    counters = [boards.scan() for _ in range(3)]
    b.listener.frame(counters[-1])
    b.ask("record_stop")
    again = replay(path).of("map")
    assert again
    assert all("channels_skewed" in frame["flags"] for frame in again)


def test_a_board_that_is_reset_alone_is_never_paired_with_the_other(bench: Start) -> None:
    b = bench(ports=2, sync_wait_ms=50).tare()
    boards = Boards(b, magnitude=100, structure=100)
    b.listener.frame(boards.scan())
    boards.counters[STRUCTURE], boards.device_us[STRUCTURE] = -1, 0
    b.until(lambda: boards.scan() and "channels_skewed" in events(b))
    assert "device_restarted" in events(b)
    alone = [frame for frame in b.listener.of("map") if frame["scan_counter"] > 101]
    assert all({"structure_missing", "magnitude_missing"} & set(f["flags"]) for f in alone)


def test_status_tells_one_reset_of_two_channels_once(bench: Start) -> None:
    b = bench(ports=2, sync_wait_ms=50).tare()
    boards = Boards(b, magnitude=100, structure=100)
    b.listener.frame(boards.scan())
    boards.counters = dict.fromkeys(Channel, -1)
    boards.device_us = dict.fromkeys(Channel, 0)
    for _ in range(3):
        b.listener.frame(boards.scan())
    told = b.ask("status")["events"]
    [reset] = [each for each in told["troubles"] if each["name"] == "device_restarted"]
    assert reset["detail"].endswith("; once since the start")
    assert told["counts"]["device_restarted"] == 1


def events(b: Any) -> set[str]:
    return {event["name"] for event in b.listener.of("event")}


def test_a_wall_clock_set_back_by_a_day_moves_no_age(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench().tare()
    before = b.step()
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() - round(DAY_S * 1e9))
    event = b.listener.event("wall_clock_jumped")
    told = re.search(r"set (\S+) s back", event["detail"])
    assert told
    assert float(told[1]) == pytest.approx(DAY_S, abs=1)
    after = b.step()
    assert before["acquired_monotonic_ns"] < after["acquired_monotonic_ns"]
    assert 0 <= after["age_ns"] < 10e9
    gone_s = (after["acquired_realtime_ns"] - before["acquired_realtime_ns"]) * 1e-9
    assert gone_s == pytest.approx(-DAY_S, abs=60)
    status = b.ask("status")
    assert status["wall_clock"]["jumps"] == 1
    assert status["wall_clock"]["last_jump_s"] == pytest.approx(-DAY_S, abs=1)
    b.until(lambda: b.step() and b.ask("status")["state"] == "running")


@pytest.mark.slow
@pytest.mark.parametrize("lossless", [True, False])
def test_every_scan_is_accounted_for(bench: Start, lossless: bool) -> None:
    b = bench(ports=2, seconds=0.02, lossless=lossless).tare()
    for number in range(30):
        b.skin.scan(channels=(MAGNITUDE,) if number % 5 == 0 else tuple(Channel))
        if number % 7 == 0:  # once more
            b.skin.scan(channels=(MAGNITUDE,), counter=b.skin.counter)
    sent = 2 * 3 + 6 + 2 * 24 + 5
    tally = b.until(lambda: settled(b.ask("status")["scan_tally"], sent))
    assert tally["repeated"] == 5
    assert (tally["dropped"] == 0) == lossless
    assert tally["used"] > 0


def settled(scans: dict[str, int], sent: int) -> dict[str, int] | None:
    assert scans["waiting"] >= 0
    return scans if scans["received"] == sent and not scans["waiting"] else None
