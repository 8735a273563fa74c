"""What is read of a machine's adapters: on a folder laid out as a real one, and on this machine."""

from __future__ import annotations

import os
import pty
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fake_machine import USB, FakeMachine
from tactomo.acquisition.adapters import (
    Adapter,
    holders,
    lasting_name,
    latency_timer_ms,
    list_adapters,
    modem_manager_runs,
)
from tactomo.acquisition.connection import Connection


@pytest.fixture
def machine(tmp_path: Path) -> FakeMachine:
    return FakeMachine(tmp_path / "machine")


def adapter_at(machine: FakeMachine, path: str) -> Adapter:
    return next(adapter for adapter in list_adapters(machine.root) if adapter.path == path)


def test_an_ftdi_adapter_is_described_in_full(machine: FakeMachine) -> None:
    machine.plug_ftdi("ttyUSB0", "1-3", "A50285BI")
    assert list_adapters(machine.root) == [
        Adapter(
            path="/dev/ttyUSB0",
            names=(
                "/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A50285BI-if00-port0",
                "/dev/serial/by-path/pci-0000:00:14.0-usb-0:3:1.0",
            ),
            driver="ftdi_sio",
            vendor_id=0x0403,
            product_id=0x6001,
            maker="FTDI",
            product="FT232R USB UART",
            serial_number="A50285BI",
            interface=0,
            latency_timer_ms=16,
            is_kept_from_modem_manager=False,
        )
    ]


def test_usb_comes_first_by_number_and_what_is_not_there_not_at_all(machine: FakeMachine) -> None:
    machine.build_in("ttyS0", 4)
    machine.build_in("ttyS1", 0)
    (machine.root / "sys/class/tty/tty1").mkdir()  # a console
    for number in (10, 2):
        machine.plug_acm(f"ttyACM{number}", f"1-{number}", str(number))
    paths = [adapter.path for adapter in list_adapters(machine.root)]
    assert paths == ["/dev/ttyACM2", "/dev/ttyACM10", "/dev/ttyS0"]


def test_a_microcontroller_has_no_latency_timer_and_our_own_rules_name_goes_first(
    machine: FakeMachine,
) -> None:
    machine.plug_acm("ttyACM0", "1-4", "7F3A")
    machine.link("dev/tactomo/left_forearm", "dev/ttyACM0")
    [adapter] = list_adapters(machine.root)
    assert (adapter.driver, adapter.serial_number) == ("cdc_acm", "7F3A")
    assert adapter.latency_timer_ms is None
    assert lasting_name(adapter, [adapter]) == "/dev/tactomo/left_forearm"


@pytest.mark.parametrize(
    ("number", "line"), [("188:0", "E:ID_MM_PORT_IGNORE=1"), ("189:13", "E:ID_MM_DEVICE_IGNORE=1")]
)
def test_modem_manager_is_known_to_be_kept_away(
    machine: FakeMachine, number: str, line: str
) -> None:
    machine.plug_ftdi("ttyUSB0", "1-3", "A5")
    assert not adapter_at(machine, "/dev/ttyUSB0").is_kept_from_modem_manager
    machine.udev_property(number, line)
    assert adapter_at(machine, "/dev/ttyUSB0").is_kept_from_modem_manager


def test_programs_that_run_and_hold_ports_are_seen(machine: FakeMachine) -> None:
    machine.run(70, "NetworkManager")
    machine.run(812, "screen /dev/ttyUSB0 115200", "/dev/ttyUSB0", "/dev/null")
    machine.run(813, "less notes.txt", "/home/notes.txt")
    (holder,) = holders("/dev/ttyUSB0", machine.root)
    assert str(holder) == "pid 812: screen /dev/ttyUSB0 115200"
    assert not modem_manager_runs(machine.root)
    machine.run(71, "ModemManager --filter-policy=strict")
    assert modem_manager_runs(machine.root)


def test_a_link_may_go_while_it_is_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = tmp_path / "skin"
    link.symlink_to("/dev/null")

    def gone(path: str) -> str:
        raise FileNotFoundError(path)

    monkeypatch.setattr(os, "readlink", gone)
    assert holders(str(link)) == []
    assert latency_timer_ms(str(link)) is None


def test_an_adapter_may_go_while_it_is_looked_at(machine: FakeMachine) -> None:
    machine.plug_ftdi("ttyUSB0", "1-3", "A5")
    device = machine.root / USB / "1-3"
    for file in ("idProduct", "serial", "1-3:1.0/bInterfaceNumber", "1-3:1.0/ttyUSB0/driver"):
        (device / file).unlink()
        list_adapters(machine.root)
    shutil.rmtree(device)
    assert list_adapters(machine.root) == []


@pytest.mark.parametrize(("timer_ms", "is_told"), [(16, True), (1, False), (None, False)])
def test_a_latency_timer_that_stays_long_is_told(
    machine: FakeMachine, line: Any, timer_ms: int | None, is_told: bool
) -> None:
    told: list[str] = []

    def on_event(name: str, detail: str, next_step: str = "", *_: str, **__: str) -> None:
        told.append(f"{name}: {detail}; {next_step}")

    number = os.path.basename(os.path.realpath(line.path))
    if timer_ms is not None:
        machine.write(f"sys/class/tty/{number}/device/latency_timer", str(timer_ms))
    connection = Connection(str(line.path), 921_600, on_event, machine.root)
    connection.open()  # a pseudo-terminal refuses to be set to low latency
    connection.close()
    assert connection.latency_timer_ms == latency_timer_ms(str(line.path), machine.root) == timer_ms
    assert [event.partition(":")[0] for event in told] == ["latency_timer"] * is_told
    assert all("16 ms" in event and "latency_timer" in event for event in told)


# Opens pseudo-terminals of its own until one has the wanted name, as in a container, and gives that
# one to a program; says its process.
NAMESAKE = """
import os, pty, subprocess, sys
name = ""
while name != sys.argv[1]:
    far_end, near_end = pty.openpty()
    name = os.ttyname(near_end)
with subprocess.Popen(["sleep", "60"], stdin=near_end) as program:
    print(program.pid, flush=True)
    sys.stdin.read()
    program.kill()
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount")
def test_a_container_has_pseudo_terminals_of_the_same_names() -> None:
    far_end, near_end = pty.openpty()
    name = os.ttyname(near_end)
    mount = (
        "mount -t devpts -o newinstance,ptmxmode=0666 devpts /dev/pts"
        ' && mount --bind /dev/pts/ptmx /dev/ptmx && exec "$@"'
    )
    command = ["unshare", "--mount", "sh", "-c", mount, "sh", sys.executable, "-c", NAMESAKE, name]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as container:
        assert container.stdin is not None
        assert container.stdout is not None
        pid = container.stdout.readline()
        if not pid:
            pytest.skip("nothing may be mounted here")
        found = [who.pid for who in holders(name)]
        container.stdin.close()
    assert os.readlink(f"/proc/self/fd/{near_end}") == name
    assert found == [os.getpid()]
    os.close(far_end)
    os.close(near_end)
