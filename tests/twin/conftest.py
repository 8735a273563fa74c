"""A skin that is quick to compute, and a host at the other end of the twin's lines."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

import numpy as np
import pytest
import serial
from tactomo.twin import Twin, TwinConfig
from tactomo_client import request
from tactomo_models import Press, SkinSimulator, load_description
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel, Command, CommandCode, Decoder, Packet, Scan, encode
from waiting import PATIENCE_S, wait_until

MEASUREMENTS = 208
PAPER = load_description("paper_square")


class FlatSkin(SkinSimulator):
    """Every voltage of a channel is the same and tells the sum of the pressures.

    0.1 V unloaded; 1 mV more a kPa on the magnitude channel, 2 mV on the structure channel.
    """

    def __init__(self, seconds: float = 0.0) -> None:  # without a mesh
        self.description = PAPER
        self.seconds = seconds

    def voltages(self, presses: Sequence[Press]) -> dict[Channel, FloatArray]:
        time.sleep(self.seconds)
        kpa = sum(press.pressure_kpa for press in presses)
        return {
            Channel.MAGNITUDE: np.full(MEASUREMENTS, 0.1 + 1e-3 * kpa),
            Channel.STRUCTURE: np.full(MEASUREMENTS, 0.1 + 2e-3 * kpa),
        }


class Host:
    """Reads and writes the twin's ports as a daemon would."""

    def __init__(self, paths: Sequence[str]) -> None:
        self.ports = [serial.Serial(path, timeout=0) for path in paths]
        self.decoders = [Decoder() for _ in paths]
        self.packets: list[list[Packet]] = [[] for _ in paths]

    def send(self, code: int, request: int = 1, rate_hz: float = 0.0, port: int = 0) -> None:
        self.ports[port].write(encode(Command(code, request, rate_hz)))

    def start(self) -> Self:
        for port in range(len(self.ports)):
            self.send(CommandCode.START, port=port)
        return self

    def read(self) -> None:
        for port, decoder, packets in zip(self.ports, self.decoders, self.packets, strict=True):
            packets += decoder.feed(port.read(65_536))

    def wait_for(self, condition: Callable[[], Any]) -> Any:
        """Read until the condition holds and return its value."""
        return wait_until(condition, meanwhile=self.read)

    def kind(self, kind: type[Any], port: int = 0) -> list[Any]:
        return [packet for packet in self.packets[port] if isinstance(packet, kind)]

    def scans(self, port: int = 0) -> list[Scan]:
        return self.kind(Scan, port)

    def close(self) -> None:
        for port in self.ports:
            port.close()


class Bench:
    """A running twin and the ways to reach it."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        self.hosts: list[Host] = []

    def host(self, paths: Sequence[str] | None = None) -> Host:
        self.hosts.append(Host(paths or self.twin.ports))
        return self.hosts[-1]

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        return request(command, self.twin.control, timeout_s=PATIENCE_S, **arguments)


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    """Start twins of the paper's sensor on a flat skin; stops them afterwards."""
    running: list[Bench] = []

    def start(
        skin: SkinSimulator | None = None,
        solve_s: float = 0.0,
        sensor: str = "paper_square",
        **config: Any,
    ) -> Bench:
        config = {"control": "tcp://127.0.0.1:0", "noise_v": 0.0, "rate_hz": 100.0, **config}
        description = load_description(sensor)
        started = Bench(Twin(TwinConfig(description, **config), skin or FlatSkin(solve_s)))
        running.append(started)
        started.twin.start()
        return started

    yield start
    for one in running:
        for host in one.hosts:
            host.close()
        one.twin.stop()
