"""The Sciospec protocol: whatever comes, a scan is of one frame, or it does not come."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sciospec_stream import frames, started, used
from tactomo.errors import ConfigError
from tactomo.protocols import protocol_named, recognised
from tactomo.protocols.sciospec import DATA, Sciospec, requests
from tactomo_models import SensorDescription, load_description
from tactomo_models.sensor.description_file import shipped_text
from tactomo_protocol import Channel, Hello, Packet, Scan

TANK = load_description("tank_disc")
SCANS = [np.linspace(0.1, 0.2, TANK.measurements) + number for number in range(6)]
MESSAGES = frames(TANK, SCANS)
ACK, NACK = b"\x18\x01\x83\x18", b"\x18\x01\x81\x18"


def sensor(folder: Path, **changes: str) -> SensorDescription:
    """Return the round tank with lines of its description exchanged."""
    text = shipped_text("tank_disc")
    for line, new in changes.items():
        old = next(each for each in text.splitlines() if each.startswith(line))
        text = text.replace(old, new)
    path = folder / "tank.toml"
    path.write_text(text)
    return load_description(path)


def scans_of(packets: list[Packet]) -> list[Scan]:
    return [packet for packet in packets if isinstance(packet, Scan)]


def numbers(packets: list[Packet]) -> list[int]:
    """Return which of SCANS came, each of them whole."""
    found = []
    for scan in scans_of(packets):
        number = round(float(scan.samples[0] - 0.1))
        assert scan.samples == pytest.approx(SCANS[number], abs=1e-5)
        found.append(number)
    return found


def stream(messages: list[list[bytes]]) -> bytes:
    return b"".join(b"".join(frame) for frame in messages)


def test_frames_become_scans_after_a_hello() -> None:
    port = Sciospec(TANK)
    packets = port.feed(stream(MESSAGES))
    hello = packets[0]
    assert isinstance(hello, Hello)
    assert (hello.channels, hello.electrodes) == ((Channel.STRUCTURE,), 16)
    assert (hello.samples_per_scan, hello.scan_rate_hz) == (TANK.measurements, 20.0)
    # Two frames tell how times are to be read; the first one goes for that.
    assert numbers(packets) == [1, 2, 3, 4, 5]
    scans = scans_of(packets)
    assert [scan.counter for scan in scans] == [0, 1, 2, 3, 4]
    assert [scan.device_us for scan in scans] == [1_050_000 + 50_000 * n for n in range(5)]
    assert port.has_clock
    assert (port.counts.packets, port.counts.corrupt) == (6 * 64, 0)


@settings(max_examples=20)
@given(st.integers(128, 6 * 64 - 1), st.binary(max_size=300))
def test_what_is_lost_or_damaged_costs_its_frame_and_no_other(place: int, junk: bytes) -> None:
    said = [message for frame in MESSAGES for message in frame]
    hit = place // 64
    for changed in ([junk], [junk, said[place]], [said[place][:70] + junk], []):
        port = Sciospec(TANK)
        packets = port.feed(b"".join([*said[:place], *changed, *said[place + 1 :]]))
        came = numbers(packets)
        assert set(came) >= {1, 2, 3, 4, 5} - {hit, hit + 1}
        is_whole = changed[-1:] == [said[place]]
        assert is_whole or said[place][2] > 1 or hit not in came


def test_two_halves_of_two_frames_are_no_frame() -> None:
    for cut in range(1, 16):
        port = Sciospec(TANK)
        mixed = MESSAGES[3][: 4 * cut] + MESSAGES[4][4 * cut :]
        packets = port.feed(stream([*MESSAGES[:3], mixed, MESSAGES[5]]))
        assert numbers(packets) == [1, 2, 5]
        assert (port.counts.damaged, port.counts.faulty) == (1, 0)


def test_a_message_that_comes_twice_is_counted_and_does_no_harm() -> None:
    port = Sciospec(TANK)
    first = MESSAGES[2][:1]
    assert numbers(port.feed(stream([*MESSAGES[:2], first, *MESSAGES[2:]]))) == [1, 2, 3, 4, 5]
    assert port.counts.corrupt == 1
    doubled = [*MESSAGES[3][:40], *MESSAGES[3][:40], *MESSAGES[3][40:]]
    packets = port.feed(stream([doubled, MESSAGES[4]]))
    assert numbers(packets) == [3, 4]


def test_exchanged_source_and_sink_turn_the_sign() -> None:
    turned = []
    for message in (message for frame in MESSAGES for message in frame):
        data = np.frombuffer(message, DATA).copy()
        if data["source"] == 5:
            data["source"], data["sink"] = 6, 5
            data["volts"] *= -1
        turned.append(data.tobytes())
    assert numbers(Sciospec(TANK).feed(b"".join(turned))) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(("electrodes", "pattern"), [(8, 1), (16, 3), (16, 8), (32, 1), (32, 16)])
def test_any_pattern_of_8_16_and_32_electrodes(
    tmp_path: Path, electrodes: int, pattern: int
) -> None:
    wide = sensor(
        tmp_path,
        count=f"count = {electrodes}",
        drive_offset=f"drive_offset = {pattern}",
        length_m="length_m = 0.004",
    )
    volts = np.random.default_rng(electrodes).normal(size=(4, wide.measurements))
    said = frames(wide, volts)
    assert len(said[0]) == 4 * electrodes
    port = Sciospec(wide)
    got = scans_of(port.feed(stream(said)))
    assert np.array([scan.samples for scan in got]) == pytest.approx(volts[1:], abs=1e-5)
    groups = -(-electrodes // 16)
    without = [used(frame, groups) for frame in said]  # instruments that send no more than needed
    assert len(scans_of(Sciospec(wide).feed(stream(without)))) == 3


def test_injections_may_be_listed(tmp_path: Path) -> None:
    listed = sensor(
        tmp_path,
        drive_offset="drive = [[0, 8], [3, 1], [9, 4], [2, 10]]",
        measure_offset="measure_offset = 2",
    )
    asked = [request.message for request in requests(listed) if "between" in request.what]
    assert asked[1] == b"\xb0\x03\x06\x04\x02\xb0"
    potentials = np.random.default_rng(0).normal(size=(3, 4, 16))
    drive = [[0, 8], [3, 1], [9, 4], [2, 10]]
    rows = [drive.index(pair) for pair in listed.pairs.drive.tolist()]
    plus, minus = listed.pairs.measure.T
    volts = potentials[:, rows, plus] - potentials[:, rows, minus]
    got = scans_of(Sciospec(listed).feed(stream(frames(listed, volts))))
    assert np.array([scan.samples for scan in got]) == pytest.approx(volts[1:], abs=1e-5)


def retimed(read: str, scale: float) -> bytes:
    """Return the stream with its times said otherwise."""
    data = np.frombuffer(stream(MESSAGES), DATA).copy()
    ms = data["time"].astype(np.float64)
    times = [struct.unpack(">I", struct.pack(read, scale * each))[0] for each in ms]
    data["time"] = times
    return data.tobytes()


@pytest.mark.parametrize(("read", "scale"), [(">f", 1e-3), (">f", 1.0)])
def test_times_may_be_floats(read: str, scale: float) -> None:
    port = Sciospec(TANK)
    scans = scans_of(port.feed(retimed(read, scale)))
    steps_us = np.diff([scan.device_us for scan in scans])
    assert steps_us == pytest.approx(50_000, abs=200)
    assert scans[0].device_us == pytest.approx(1_050_000, abs=200)


def test_times_that_make_no_sense_are_done_without() -> None:
    data = np.frombuffer(stream([frame for _ in range(3) for frame in MESSAGES]), DATA).copy()
    data["time"] = 7
    port = Sciospec(TANK)
    scans = scans_of(port.feed(data.tobytes()))
    assert scans
    assert not port.has_clock
    assert {scan.device_us for scan in scans} == {0}


def test_a_recording_that_begins_anywhere_makes_the_same_scans() -> None:
    data = stream(MESSAGES)
    for at in range(8960 * 2 + 1, len(data), 997):
        live = Sciospec(TANK)
        live.feed(data[:at])
        replayed = Sciospec(TANK)
        first = replayed.feed(live.preamble())
        assert isinstance(first[0], Hello)
        after = live.feed(data[at:])
        assert scans_of(replayed.feed(data[at:])) == scans_of(after)
        assert replayed.trouble is None


def test_a_recording_that_lost_bytes_finds_its_place_again() -> None:
    live, replayed = Sciospec(TANK), Sciospec(TANK)
    said = [message for frame in MESSAGES for message in frame]
    want, got = [], []
    for number, message in enumerate(said):
        if number % 50 == 49:
            got += replayed.feed(live.preamble())
        want += scans_of(live.feed(message))
        if not 130 < number < 230:
            got += replayed.feed(message)
    assert [scan.counter for scan in scans_of(got)] == [0, 3, 4]
    assert all(scan in want for scan in scans_of(got))


def converse(port: Sciospec, answers: list[bytes]) -> list[bytes]:
    """Introduce the instrument, answering so; return what it was asked."""
    asked = port.introduction()
    for answer in answers:
        port.feed(answer)
        asked += port.replies()
    return asked


def test_it_is_asked_one_thing_after_another_and_started() -> None:
    want = [request.message for request in requests(TANK)]
    asked = converse(Sciospec(TANK), [ACK] * len(want))
    assert asked == want
    assert asked[0] == b"\xb4\x01\x00\xb4"
    assert asked[-1] == b"\xb4\x01\x01\xb4"
    assert b"\xb0\x09\x05" + struct.pack(">d", 1e-3) + b"\xb0" in asked
    assert b"\xb0\x03\x06\x10\x01\xb0" in asked  # from electrode 16 to 1
    started(TANK)  # the instrument takes every one


def test_an_instrument_that_restarts_is_asked_from_the_beginning() -> None:
    port = Sciospec(TANK)
    converse(port, [ACK] * len(list(requests(TANK))))
    port.feed(b"\x18\x01\x84\x18")
    assert port.replies() == [b"\xb4\x01\x00\xb4"]


def test_a_refusal_says_what_was_refused() -> None:
    port = Sciospec(TANK)
    asked = converse(port, [ACK, ACK, ACK, NACK, ACK, ACK])
    assert len(asked) == 4
    assert port.trouble is not None
    assert "will not inject 0.001 A (NACK 81)" in port.trouble.cause
    assert "current_a" in port.trouble.next_step
    port.feed(stream(MESSAGES))
    assert port.trouble is None  # it measures all the same


def test_potentials_out_of_phase_are_refused() -> None:
    data = np.frombuffer(stream(MESSAGES), DATA).copy()
    data["volts"][..., 1] = 0.5 * data["volts"][..., 0]
    port = Sciospec(TANK)
    assert scans_of(port.feed(data.tobytes())) == []
    assert port.trouble is not None
    assert "45% of the signal is out of phase" in port.trouble.cause


def test_another_programs_injections_are_named(tmp_path: Path) -> None:
    skipping = sensor(tmp_path, drive_offset="drive_offset = 3")
    zeros = np.zeros(skipping.measurements)
    port = Sciospec(TANK)
    port.feed(stream(frames(skipping, [zeros] * 5)))
    assert port.trouble is not None
    assert "not in the pattern of tank_disc" in port.trouble.cause


def test_what_the_instrument_cannot_do_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="two channels"):
        protocol_named("sciospec", load_description("paper_square"))
    with pytest.raises(ConfigError, match=r"injects 1e-07 to 0\.01 A"):
        protocol_named("sciospec", sensor(tmp_path, current_a="current_a = 0.1"))


def test_it_is_recognised_from_anywhere() -> None:
    assert recognised(stream(MESSAGES)[77:]) == "sciospec"
    assert recognised(b"\0\0" + ACK) == "sciospec"
    assert recognised(b"magnitudes: 1, 2, 3\r\n" * 30) != "sciospec"
