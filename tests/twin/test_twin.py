"""The twin from outside: its ports, as a daemon sees them, and its control socket."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from fixture_types import Start
from hostile_page import post
from tactomo.errors import AddressError, ConfigError, TactomoError
from tactomo.protocols.native import NativeProtocol
from tactomo.twin import Scene, TwinConfig
from tactomo.twin.firmware import RATE_HZ_MIN
from tactomo_client import ControlError
from tactomo_client.messages import encode_request
from tactomo_models import Press, SensorDescription, SkinSimulator, load_description
from tactomo_models.arrays import FloatArray
from tactomo_protocol import (
    Acknowledge,
    AckStatus,
    Channel,
    CommandCode,
    Decoder,
    Hello,
    Packet,
    Scan,
    ScanFlag,
)
from waiting import PATIENCE_S, wait_until

PAPER = load_description("paper_square")


def volts(host: Any, scan: Scan, port: int = 0) -> float:
    return float(np.mean(scan.volts(host.kind(Hello, port)[-1].volts_per_count)))


def test_what_the_device_is_asked_it_does_or_refuses(bench: Start) -> None:
    host = bench().host()
    host.send(CommandCode.IDENTIFY, request=77)
    host.send(CommandCode.SET_RATE, 1, rate_hz=1e6)
    host.send(99, 2)
    host.send(CommandCode.SET_RATE, 3, rate_hz=1e-9)  # slower than it can
    host.wait_for(lambda: len(host.kind(Acknowledge)) == 4)
    assert host.kind(Acknowledge) == [
        Acknowledge(77, CommandCode.IDENTIFY, AckStatus.OK),
        Acknowledge(1, CommandCode.SET_RATE, AckStatus.BAD_ARGUMENT),
        Acknowledge(2, 99, AckStatus.UNKNOWN_COMMAND),
        Acknowledge(3, CommandCode.SET_RATE, AckStatus.OK),
    ]
    host.wait_for(lambda: RATE_HZ_MIN in [hello.scan_rate_hz for hello in host.kind(Hello)])
    hello = host.kind(Hello)[-1]
    assert hello.device_id.startswith("twin")
    assert hello.channels == (Channel.MAGNITUDE, Channel.STRUCTURE)
    assert (hello.electrodes, hello.drive_offset, hello.measure_offset) == (16, 1, 1)
    assert hello.samples_per_scan == 208


@pytest.mark.slow
def test_hello_repeats_unasked(bench: Start) -> None:
    host = bench().host()
    host.wait_for(lambda: len(host.kind(Hello)) >= 2)
    assert host.scans() == []


def test_one_port_carries_both_channels_of_the_same_instant(bench: Start) -> None:
    host = bench().host().start()
    host.wait_for(lambda: len(host.scans()) >= 10)
    for first, second in zip(host.scans()[0:10:2], host.scans()[1:10:2], strict=True):
        assert (first.channel, second.channel) == (Channel.MAGNITUDE, Channel.STRUCTURE)
        assert (first.counter, first.device_us) == (second.counter, second.device_us)
        assert first.flags & ScanFlag.SIMULATED
    assert [scan.counter for scan in host.scans()[0:10:2]] == [0, 1, 2, 3, 4]
    assert host.decoders[0].counts.corrupt == 0


def test_a_press_off_the_sheet_is_refused_with_its_size(bench: Start) -> None:
    twin = bench()
    for x_mm, y_mm in ((100, 0), (0, -1000)):
        with pytest.raises(ControlError, match=f"x_mm = {x_mm}, y_mm = {y_mm} is off") as caught:
            twin.ask("press", x_mm=x_mm, y_mm=y_mm)
        assert caught.value.name == "bad_argument"
        assert "150 x 150 mm" in str(caught.value)
    assert twin.ask("scene") == {"presses": []}
    twin.ask("press", x_mm=85, y_mm=0)  # its rim is still on it


def test_two_ports_share_counter_and_stamp_and_each_starts_by_itself(bench: Start) -> None:
    host = bench(ports=2).host()
    host.send(CommandCode.START, port=0)
    host.wait_for(lambda: len(host.scans(0)) >= 20 and host.kind(Hello, 1))
    assert host.scans(1) == []
    assert host.kind(Hello, 0)[-1].scan_rate_hz > 0
    assert host.kind(Hello, 1)[-1].scan_rate_hz == 0  # PROTOCOL.md: the leader gives the pulses
    host.send(CommandCode.START, port=1)
    host.wait_for(lambda: len(host.scans(1)) >= 5)
    host.wait_for(lambda: host.scans(0)[-1].counter >= host.scans(1)[-1].counter)
    for port, channel in enumerate(Channel):
        assert host.kind(Hello, port)[-1].channels == (channel,)
        assert {scan.channel for scan in host.scans(port)} == {channel}
    stamps = [{scan.counter: scan.device_us for scan in host.scans(port)} for port in (0, 1)]
    shared = stamps[0].keys() & stamps[1].keys()
    assert len(shared) >= 3
    assert all(stamps[0][counter] == stamps[1][counter] for counter in shared)


def test_scans_keep_the_rate_on_the_devices_clock(bench: Start) -> None:
    host = bench(rate_hz=50.0).host().start()
    host.wait_for(lambda: len(host.scans()) >= 80)
    stamps_us = np.array([s.device_us for s in host.scans() if s.channel == Channel.MAGNITUDE])
    assert np.all(np.diff(stamps_us) > 0)
    # A loaded machine may be late for an instant, and nothing runs ahead of them.
    behind_us = (stamps_us - stamps_us[0]) - 20_000 * np.arange(len(stamps_us))
    assert np.min(behind_us) > -20_000
    assert np.median(np.diff(stamps_us)) == pytest.approx(20_000, abs=4_000)


def test_rate_stop_and_zero_counters(bench: Start) -> None:
    host = bench().host().start()
    host.wait_for(lambda: host.scans() and host.scans()[-1].counter > 5)
    host.send(CommandCode.SET_RATE, 3, rate_hz=200.0)
    host.wait_for(lambda: any(hello.scan_rate_hz == 200.0 for hello in host.kind(Hello)))
    host.send(CommandCode.STOP, 4)
    host.wait_for(lambda: Acknowledge(4, CommandCode.STOP, AckStatus.OK) in host.packets[0])
    last = host.packets[0].index(Acknowledge(4, CommandCode.STOP, AckStatus.OK))
    host.send(CommandCode.ZERO_COUNTERS, 5)
    host.send(CommandCode.START, 6)
    host.wait_for(lambda: any(isinstance(packet, Scan) for packet in host.packets[0][last:]))
    after = [packet for packet in host.packets[0][last:] if isinstance(packet, Scan)]
    assert after[0].counter == 0


def test_a_scan_that_takes_longer_is_late_and_says_so(bench: Start) -> None:
    host = bench(solve_s=0.15, rate_hz=10.0).host().start()
    host.wait_for(lambda: len(host.scans()) >= 6)
    assert all(scan.flags & ScanFlag.LATE for scan in host.scans())
    steps = np.diff([s.device_us for s in host.scans() if s.channel == Channel.MAGNITUDE])
    assert np.all(steps >= 150_000)  # sampled anew after each solve, not queued up
    assert [scan.counter for scan in host.scans()[0:6:2]] == [0, 1, 2]


class StallingSkin(SkinSimulator):
    """Needs half a second for its first solve after the unloaded one, then no time."""

    def __init__(self) -> None:
        self.description, self.solves = PAPER, 0

    def voltages(self, presses: Sequence[Press]) -> dict[Channel, FloatArray]:
        self.solves += 1
        if self.solves == 2:
            time.sleep(0.5)
        return {Channel.MAGNITUDE: np.full(208, 0.1), Channel.STRUCTURE: np.full(208, 0.1)}


def test_scans_missed_in_a_stall_are_not_made_up(bench: Start) -> None:
    host = bench(StallingSkin(), rate_hz=100.0).host().start()
    host.wait_for(lambda: len(host.scans()) >= 60)
    stamps_us = np.array([s.device_us for s in host.scans() if s.channel == Channel.MAGNITUDE])
    assert stamps_us[1] - stamps_us[0] >= 500_000
    soon_after = np.count_nonzero(stamps_us[1:] < stamps_us[1] + 100_000)
    assert soon_after <= 12  # ten a tenth of a second; 60 if the stall were made up for


def test_a_program_that_knows_nothing_of_terminals_reads_the_bytes_as_they_are(
    bench: Start,
) -> None:
    descriptor = os.open(bench().twin.ports[0], os.O_RDONLY | os.O_NOCTTY)
    decoder = Decoder()
    try:
        packets: list[Packet] = []
        while not packets:
            packets = decoder.feed(os.read(descriptor, 4096))
    finally:
        os.close(descriptor)
    assert isinstance(packets[0], Hello)
    assert decoder.counts.corrupt == 0


def test_a_scan_in_time_is_not_late(bench: Start) -> None:
    started = bench(rate_hz=2.0)
    host = started.host().start()

    def late() -> list[bool]:
        return [bool(scan.flags & ScanFlag.LATE) for scan in host.scans()]

    host.wait_for(lambda: late().count(False) >= 4)  # a computer that stops is late indeed
    said = started.ask("status")["late_scans"]
    host.wait_for(lambda: late().count(True) >= said)


class WaitingSkin(SkinSimulator):
    """Its solves after the unloaded one last until `go` is set."""

    def __init__(self) -> None:
        self.description, self.solves = PAPER, 0
        self.go = threading.Event()

    def voltages(self, presses: Sequence[Press]) -> dict[Channel, FloatArray]:
        self.solves += 1
        assert self.solves == 1 or self.go.wait(PATIENCE_S)
        return {Channel.MAGNITUDE: np.full(208, 0.1), Channel.STRUCTURE: np.full(208, 0.1)}


def test_acknowledgements_do_not_wait_for_a_slow_solve(bench: Start) -> None:
    skin = WaitingSkin()
    host = bench(skin, rate_hz=10.0).host().start()
    host.wait_for(lambda: host.kind(Acknowledge))
    host.send(CommandCode.IDENTIFY, request=9)
    host.wait_for(lambda: len(host.kind(Acknowledge)) == 2)
    assert host.scans() == []
    skin.go.set()
    host.wait_for(host.scans)


def test_a_live_press_shows_until_it_is_released(bench: Start) -> None:
    started = bench()
    host = started.host().start()
    host.wait_for(lambda: host.scans() and host.kind(Hello))
    started.ask("press", id="a", x_mm=10.0, y_mm=-5.0, pressure_kpa=150.0)
    started.ask("press", id="b", x_mm=0.0, y_mm=0.0, pressure_kpa=50.0)

    def pressed_by_both() -> list[Scan] | None:
        newest = [s for s in host.scans() if s.counter == host.scans()[-1].counter]
        return newest if len(newest) == 2 and volts(host, newest[0]) > 0.28 else None

    magnitude, structure = host.wait_for(pressed_by_both)
    assert volts(host, magnitude) == pytest.approx(0.3, abs=1e-3)
    assert volts(host, structure) == pytest.approx(0.5, abs=1e-3)
    assert [p["id"] for p in started.ask("scene")["presses"]] == ["a", "b"]
    started.ask("press", id="a", x_mm=20.0, y_mm=-5.0, pressure_kpa=100.0)
    assert started.ask("scene")["presses"][0]["x_mm"] == 20.0
    assert started.ask("release", id="a") == {"released": True}
    assert started.ask("release", id="a") == {"released": False}
    started.ask("press", id=7, x_mm=0.0, y_mm=0.0)  # as `tactomo poke press id=7` sends it
    assert started.ask("release", id="7") == {"released": True}
    started.ask("clear")
    host.wait_for(lambda: volts(host, host.scans()[-1]) < 0.11)
    assert started.ask("scene")["presses"] == []


@pytest.mark.slow
def test_a_script_starts_with_the_first_scan_that_a_host_receives(bench: Start) -> None:
    script = Scene.model_validate(
        {"press": [{"at_s": 0.5, "duration_s": 1.5, "x_mm": 0, "y_mm": 0, "pressure_kpa": 100}]}
    )
    started = bench(scene=script, rate_hz=20.0)
    # Past the press, if the script's clock had started with power-up.
    wait_until(lambda: started.ask("status")["uptime_s"] > 0.6)
    host = started.host().start()
    host.wait_for(lambda: len(host.scans()) >= 90 and host.kind(Hello))
    scans = [scan for scan in host.scans() if scan.channel == Channel.MAGNITUDE]
    seen = [volts(host, scan) > 0.15 for scan in scans]
    begin, end = seen.index(True), len(seen) - seen[::-1].index(True)
    after_us = [scan.device_us - scans[0].device_us for scan in scans]
    assert after_us[begin - 1] < 500_000 <= after_us[begin] + 2
    assert after_us[end - 1] < 2_000_000 <= after_us[end] + 2


def test_scene_and_noise_are_changed_while_it_runs(bench: Start) -> None:
    started = bench()
    with pytest.raises(ControlError, match="no scripted scene"):
        started.ask("play")
    press = {"id": "p", "at_s": 0, "duration_s": 3600, "x_mm": 1, "y_mm": 2}
    assert started.ask("play", scene={"press": [press]}) == {"length_s": 3600.0}
    assert [p["id"] for p in started.ask("scene")["presses"]] == ["p"]
    host = started.host().start()
    host.wait_for(lambda: host.scans())
    assert np.ptp(host.scans()[0].samples) == 0
    started.ask("noise", noise_v=0.01)
    host.wait_for(lambda: np.ptp(host.scans()[-1].samples) > 0)


def test_equal_seeds_give_equal_scans(bench: Start) -> None:
    def first_scans(seed: int) -> list[bytes]:
        host = bench(seed=seed, noise_v=1e-4).host()
        host.start()
        host.wait_for(lambda: len(host.scans()) >= 6)
        return [scan.samples.tobytes() for scan in host.scans()[:6]]

    assert first_scans(1) == first_scans(1) != first_scans(2)


def test_the_skin_drifts_as_it_is_told_live_and_by_a_scene(
    bench: Start, small: SensorDescription, small_file: Path
) -> None:
    started = bench(skin=SkinSimulator(small), sensor=str(small_file))
    host = started.host().start()
    host.wait_for(lambda: host.scans())
    rest = host.scans()[0].samples
    started.ask("drift", step_k=5.0, uneven=0.0)
    host.wait_for(lambda: not np.array_equal(host.scans()[-1].samples, rest))
    warm = host.scans()[-1].samples
    large = np.abs(rest) > 0.1 * np.abs(rest).max()
    np.testing.assert_allclose(warm[large] / rest[large], np.exp(-0.1), rtol=1e-3)
    press = {"at_s": 3000, "duration_s": 1, "x_mm": 0, "y_mm": 0}
    started.ask("play", scene={"press": [press], "drift": {"step_k": 0.0}})
    host.wait_for(lambda: np.array_equal(host.scans()[-1].samples, rest))
    with pytest.raises(ControlError, match="swing_k"):
        started.ask("drift", swing_k=-1.0)


def test_nobody_gets_old_scans_and_nobody_blocks_the_twin(bench: Start) -> None:
    started = bench()
    early = started.host()
    early.start()
    early.wait_for(lambda: early.scans())
    early.close()
    before = started.ask("status")["ports"][0]["unheard"]
    wait_until(lambda: started.ask("status")["ports"][0]["unheard"] > before + 50)
    now = started.ask("status")["counter"]
    late = started.host()
    late.wait_for(lambda: late.scans())
    assert late.scans()[0].counter >= now - 1


def test_a_host_that_does_not_read_loses_whole_frames(bench: Start) -> None:
    started = bench(rate_hz=500.0)
    host = started.host().start()
    wait_until(lambda: started.ask("status")["ports"][0]["dropped"] > 50)
    host.wait_for(lambda: host.scans() and host.scans()[-1].counter > 60)
    assert host.decoders[0].counts.corrupt == 0
    counters = [scan.counter for scan in host.scans()]
    assert np.max(np.diff(counters)) > 1


def test_garbage_costs_no_other_packet(bench: Start) -> None:
    started = bench(ports=2, rate_hz=30.0)  # seconds of it wait on the line for a busy host
    host = started.host().start()
    host.wait_for(lambda: host.scans(0) and host.scans(1))
    started.ask("garbage", port=0, count=4000)
    host.wait_for(lambda: host.decoders[0].counts.corrupt > 0)
    seen = host.scans(0)[-1].counter
    host.wait_for(lambda: host.scans(0)[-1].counter > seen + 20)
    assert np.all(np.diff([scan.counter for scan in host.scans(0)]) == 1)
    assert host.decoders[1].counts.corrupt == 0


@pytest.mark.slow
def test_a_muted_channel_is_silent_and_comes_back(bench: Start) -> None:
    started = bench(ports=2)
    host = started.host().start()
    host.wait_for(lambda: host.scans(0) and host.scans(1))
    started.ask("mute", channel="structure", seconds=2.0)
    host.wait_for(lambda: np.max(np.diff([s.counter for s in host.scans(1)]), initial=0) >= 25)
    assert np.max(np.diff([s.counter for s in host.scans(0)])) < 25


def test_unplug_and_replug_by_a_stable_link(bench: Start, tmp_path: Path) -> None:
    started = bench(ports=2, link_folder=tmp_path / "dev")
    paths = [str(tmp_path / "dev" / name) for name in ("magnitude", "structure")]
    assert list(started.twin.ports) == paths
    host = started.host().start()
    host.wait_for(lambda: host.scans(0) and host.scans(1))
    started.ask("unplug", port=1)
    assert not os.path.lexists(paths[1])
    with pytest.raises((serial.SerialException, OSError)):
        host.wait_for(lambda: False)
    host.ports[1].close()
    assert started.ask("status")["ports"][1]["plugged"] is False
    started.ask("replug")
    # Its board has kept its power: it goes on streaming on the new line.
    again = started.host([paths[1]])
    again.wait_for(lambda: again.scans())
    assert again.scans()[0].channel == Channel.STRUCTURE


def test_links_are_removed_at_the_end_and_files_of_the_user_stay(
    bench: Start, tmp_path: Path
) -> None:
    started = bench(link_folder=tmp_path)
    assert os.readlink(tmp_path / "skin").startswith("/dev/")
    started.twin.stop()
    assert not os.path.lexists(tmp_path / "skin")
    (tmp_path / "skin").write_text("precious")
    with pytest.raises(TactomoError, match="cannot make the link"):
        bench(link_folder=tmp_path)
    assert (tmp_path / "skin").read_text() == "precious"


WRONG: list[tuple[str, dict[str, Any], str]] = [
    ("press", {"x_mm": "left", "y_mm": 0}, "x_mm = 'left'"),
    ("press", {"x_mm": 1}, "y_mm is missing"),
    ("press", {"x_mm": 1, "y_mm": 2, "force": 3}, "unknown key force"),
    ("press", {"x_mm": float("nan"), "y_mm": 2}, "x_mm = nan"),
    ("noise", {"noise_v": -1}, "noise_v = -1"),
    ("mute", {"channel": "both", "seconds": 1}, "'magnitude' or 'structure'"),
    ("unplug", {"port": 1}, "no port 1"),
    ("dance", {}, "known commands: status"),
]


def test_wrong_commands_are_refused(bench: Start) -> None:
    started = bench()
    for command, arguments, says in WRONG:
        with pytest.raises(ControlError) as caught:
            started.ask(command, **arguments)
        assert says in str(caught.value)
    assert started.ask("status")["counter"] == 0
    press = encode_request("press", {"x_mm": 0.0, "y_mm": 0.0})
    assert b"ok" not in post(started.twin.control, [b"", press])  # by a web page
    assert started.ask("scene")["presses"] == []
    with pytest.raises(AddressError, match="in use"):
        bench(control=started.twin.control)


class BreakingSkin(SkinSimulator):
    """Solves for an unloaded skin only."""

    def __init__(self) -> None:
        self.description = PAPER

    def voltages(self, presses: Sequence[Press]) -> dict[Channel, FloatArray]:
        if presses:
            raise ArithmeticError("singular")
        return {Channel.MAGNITUDE: np.full(208, 0.1), Channel.STRUCTURE: np.full(208, 0.1)}


def test_a_skin_that_fails_stops_the_twin_with_its_error(bench: Start) -> None:
    started = bench(BreakingSkin())
    host = started.host().start()
    host.wait_for(lambda: host.scans())
    started.ask("press", x_mm=0, y_mm=0)
    with pytest.raises(ArithmeticError, match="singular"):
        started.twin.wait(PATIENCE_S)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"control": "tcp://0.0.0.0:0"}, "other computers"),
        ({"control": "here"}, "use tcp://"),
        ({"ports": 3}, "3 ports"),
        ({"rate_hz": 0.0}, "rate of 0"),
        ({"noise_v": -1.0}, "noise of"),
    ],
)
def test_a_wrong_setup_is_refused(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        TwinConfig(load_description("paper_square"), **wrong)


@pytest.mark.parametrize("begin", [TwinConfig, NativeProtocol], ids=["twin", "daemon"])
def test_more_voltages_than_a_scan_can_have_are_told_at_the_start(
    begin: Callable[[SensorDescription], object],
) -> None:
    raw = load_description("tank_disc").model_dump(by_alias=True, exclude_none=True)
    raw["electrodes"] |= {"count": 64, "length_m": 0.004}
    with pytest.raises(ConfigError, match=r"3904 voltages.*at most 1024; list fewer"):
        begin(SensorDescription.model_validate(raw))


def test_what_the_emulated_board_or_sensor_lacks_is_told_at_the_start() -> None:
    with pytest.raises(ConfigError, match="1 channel"):
        TwinConfig(load_description("tank_disc"), ports=2)
    raw = load_description("openeit_disc").model_dump(by_alias=True, exclude_none=True)
    raw["companion"] = {"cell": {"gain_n_per_unit": 1.0, "noise_n": 0.1}}
    with pytest.raises(ConfigError, match=r"companion, cell, .* of protocol openeit sends no"):
        TwinConfig(SensorDescription.model_validate(raw), protocol="openeit")
