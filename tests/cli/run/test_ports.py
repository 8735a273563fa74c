"""`tactomo ports`: what a machine with adapters shows, and asking a device who it is."""

from __future__ import annotations

import json
import os
import pty
import threading
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from daemon_bench import HELLO
from fake_machine import FakeMachine
from fixture_types import Run
from tactomo.acquisition.connection import identify
from tactomo.cli.run.ports import lines, question, survey
from tactomo_protocol import Channel, Command, Decoder, encode
from waiting import wait_until

SAID = replace(HELLO, device_id="skin-7f3a", channels=(Channel.MAGNITUDE,))


@pytest.fixture
def device() -> Iterator[Callable[[bytes], str]]:
    """Start a device that answers whatever it is asked with these bytes; returns its path."""
    ends: list[int] = []
    threads: list[threading.Thread] = []

    def answer(end: int, reply: bytes) -> None:
        decoder = Decoder()
        while True:
            try:
                data = os.read(end, 4096)
            except OSError:  # the test is over
                return
            if any(isinstance(packet, Command) for packet in decoder.feed(data)):
                os.write(end, reply)

    def start(reply: bytes) -> str:
        device_end, host_end = pty.openpty()
        tty.setraw(host_end)
        ends.extend((device_end, host_end))
        threads.append(threading.Thread(target=answer, args=(device_end, reply)))
        threads[-1].start()
        return os.ttyname(host_end)

    yield start
    for end in reversed(ends):  # the host's end first, which ends the read at the other
        os.close(end)
    for thread in threads:
        thread.join()


def shown(machine: FakeMachine, *paths: str) -> str:
    return "\n".join(lines(survey(paths, machine.root), {}))


def test_adapters_are_shown_with_their_names_holders_and_troubles(tmp_path: Path) -> None:
    machine = FakeMachine(tmp_path / "machine")
    machine.plug_ftdi("ttyUSB0", "1-3", "A50285BI")
    machine.plug_ch340("ttyUSB1", "1-1")
    machine.plug_ch340("ttyUSB2", "1-2")
    machine.run(812, "screen /dev/ttyUSB0", "/dev/ttyUSB0")
    machine.run(70, "ModemManager")
    text = shown(machine)
    assert "FTDI FT232R USB UART (0403:6001, ftdi_sio, serial number A50285BI)" in text
    assert "/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A50285BI-if00-port0" in text
    assert "pid 812: screen /dev/ttyUSB0" in text
    assert "holds bytes back for up to 16 ms" in text
    assert "looks the same as /dev/ttyUSB2" in text
    assert "/dev/serial/by-id/usb-1a86" not in text
    assert text.count("ModemManager runs") == 3
    assert "ttyUSB1" not in shown(machine, "/dev/ttyUSB0")


def test_nothing_there_says_what_to_do(tactomo: Run) -> None:
    result = tactomo("ports", status=0)
    if "ttyUSB" not in result.stdout and "ttyACM" not in result.stdout:
        assert "no USB adapter is there" in result.stdout
        assert "tactomo twin" in result.stdout


def test_a_device_is_asked_who_it_is(tactomo: Run, device: Callable[[bytes], str]) -> None:
    path = device(encode(SAID))
    result = tactomo("ports", path, "--ask", "--json")
    (port,) = json.loads(result.stdout)["ports"]
    assert port["device"]["device_id"] == "skin-7f3a"
    assert port["no_device_because"] is None
    text = " ".join(tactomo("ports", path, "--ask").stdout.split())
    assert "skin-7f3a: magnitude; 20 scans/s; firmware 1.2.3" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reply", "says"),
    [
        (b"", "no answer"),
        (b"\xf8\x00\x7f\x06", "no packet at 115200 baud"),
        (encode(Command(1, 1)), "packets, but no hello"),
    ],
)
def test_who_does_not_say_hello_is_no_skin(
    device: Callable[[bytes], str], reply: bytes, says: str
) -> None:
    path = device(reply)

    def is_said() -> bool:  # within a second, unless the computer is busy
        answer = identify(path, 115_200, patience_s=1.0)
        assert isinstance(answer, str)
        return says in answer

    wait_until(is_said, says)


def test_a_port_that_cannot_be_opened_says_why(tmp_path: Path) -> None:
    path = str(tmp_path / "nowhere")
    assert "does not exist" in str(question([path], 921_600)[path])
