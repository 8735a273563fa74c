"""A skin on real pseudo-terminals, a daemon on real sockets, and a listener to what it publishes.

The skin says exactly what a test tells it to, when it tells it to: nothing depends on how fast
the computer is. The reconstructor is quick and remembers the frame before, as the real one does.
"""

from __future__ import annotations

import os
import pty
import time
import tty
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, Self

import numpy as np
from ears import listening
from mcap.reader import make_reader
from tactomo.recordings.recording import open_recording
from tactomo.service.daemon import Daemon
from tactomo_client import Keys, request
from tactomo_client.messages import KINDS, Message, array_from_wire, decode_message, topic
from tactomo_models import Contact, Flag, Reconstruction, Reference
from tactomo_models.arrays import FloatArray, Image
from tactomo_models.scans.companion_forces import CompanionReading
from tactomo_models.scene.pressure import PressureCurve
from tactomo_protocol import (
    Channel,
    Command,
    Decoder,
    Hello,
    Packet,
    SampleFormat,
    Scan,
    ScanFlag,
    encode,
)
from waiting import PATIENCE_S, wait_until

MEASUREMENTS = 208
VOLTS_PER_COUNT = 1e-6
REST = np.linspace(0.05, 0.2, MEASUREMENTS)
PATIENT_SYNC_MS = 20_000.0
"""Longer than a daemon may be told to wait for a channel: a stopped computer loses none."""
BOTH = (Channel.MAGNITUDE, Channel.STRUCTURE)
NO_FLAGS = ScanFlag(0)
ANYWHERE = {"stream": "tcp://127.0.0.1:0", "control": "tcp://127.0.0.1:0"}
LOCAL: dict[str, Any] = {"name": "left", **ANYWHERE, "tare_scans": 3}
"""Keys of the configuration of a daemon that a test has in its own process."""
UNUSED: Any = SimpleNamespace(method="auto", budget_s=None, take=None)
"""The reconstructor of a daemon that makes no frame."""

HELLO = Hello(
    device_id="bench-1",
    firmware="1.2.3",
    channels=BOTH,
    electrodes=16,
    drive_offset=1,
    measure_offset=1,
    samples_per_scan=MEASUREMENTS,
    sample_format=SampleFormat.INT32,
    volts_per_count=VOLTS_PER_COUNT,
    scan_rate_hz=20.0,
)


class Line:
    """The device's end of one pseudo-terminal, under a name that survives unplugging."""

    def __init__(self, path: Path, channels: tuple[Channel, ...] = BOTH) -> None:
        self.path = path
        self.hello = replace(HELLO, channels=channels)
        self.descriptor = -1
        self._decoder = Decoder()
        self.plug()

    def plug(self) -> None:
        self.descriptor, host_end = pty.openpty()
        tty.setraw(host_end)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(host_end))
        os.close(host_end)
        os.set_blocking(self.descriptor, False)

    def unplug(self) -> None:
        if self.descriptor >= 0:
            self.path.unlink(missing_ok=True)  # first: its number may be another's at once
            os.close(self.descriptor)
            self.descriptor = -1

    def say(self, *packets: Packet | bytes) -> None:
        """Send packets, or raw bytes, and wait until the line has taken them."""
        data = b"".join(p if isinstance(p, bytes) else encode(p) for p in packets)
        deadline = time.monotonic() + PATIENCE_S
        while data:
            assert time.monotonic() < deadline, "nobody reads the line"
            try:
                data = data[os.write(self.descriptor, data) :]
            except BlockingIOError:
                time.sleep(0.001)

    def heard(self) -> list[Command]:
        """Return the commands that came since the last call."""
        try:
            data = os.read(self.descriptor, 65_536)
        except (BlockingIOError, OSError):
            return []
        return [p for p in self._decoder.feed(data) if isinstance(p, Command)]

    def introduce(self) -> None:
        """Wait until the host asks, and say hello."""
        wait_until(self.heard, "for the host to ask who is there")
        self.say(self.hello)


def scan(
    channel: Channel,
    counter: int,
    volts: FloatArray | None = None,
    flags: ScanFlag = NO_FLAGS,
    device_us: int | None = None,
) -> Scan:
    """Return a scan; its voltages differ a little from scan to scan, as noise would have it."""
    noise = np.random.default_rng([counter, channel.number]).normal(0, 2e-6, MEASUREMENTS)
    values = (REST if volts is None else volts) + noise
    return Scan(
        channel,
        counter,
        counter * 50_000 if device_us is None else device_us,
        flags,
        np.round(values / VOLTS_PER_COUNT).astype(np.int32),
    )


class Skin:
    """One line that carries both channels, or a line for each."""

    def __init__(self, folder: Path, ports: int) -> None:
        self.counter = 0
        if ports == 1:
            self.lines = [Line(folder / "both")]
        else:
            self.lines = [Line(folder / c, (c,)) for c in BOTH]

    def line_of(self, channel: Channel) -> Line:
        return next(line for line in self.lines if channel in line.hello.channels)

    def introduce(self) -> None:
        for line in self.lines:
            line.introduce()

    def scan(
        self,
        load: float = 0.0,
        channels: tuple[Channel, ...] = BOTH,
        counter: int | None = None,
        volts: Mapping[str, FloatArray] | None = None,
        **details: Any,
    ) -> int:
        """Send the next dual scan: `volts`, or the rest with the share `load` more on each."""
        self.counter = self.counter + 1 if counter is None else counter
        for channel in channels:
            values = REST * (1 + load) if volts is None else volts[channel]
            self.line_of(channel).say(scan(channel, self.counter, values, **details))
        return self.counter

    def close(self) -> None:
        for line in self.lines:
            line.unplug()


class Listener:
    """Subscribes to all kinds of one sensor's messages and keeps them."""

    def __init__(
        self, address: str, sensor: str, kinds: tuple[str, ...] = KINDS, keys: Keys | None = None
    ) -> None:
        self.messages: list[Message] = []
        self.socket = listening(address, *(topic(sensor, kind) for kind in kinds), keys=keys)

    def receive(self) -> None:
        while self.socket.poll(0):
            self.messages.append(decode_message(self.socket.recv()))

    def of(self, kind: str) -> list[dict[str, Any]]:
        self.receive()
        return [message.fields for message in self.messages if message.kind == kind]

    def wait(self, kind: str, condition: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """Wait for a message of this kind that satisfies the condition."""
        return wait_until(
            lambda: next((m for m in self.of(kind) if condition(m)), {}),
            f"for a {kind}; there were {[m.kind for m in self.messages][-20:]} and events "
            f"{[e['name'] for e in self.of('event')]}",
        )

    def event(self, name: str) -> dict[str, Any]:
        return self.wait("event", lambda event: event["name"] == name)

    def frame(self, counter: int) -> dict[str, Any]:
        return self.wait("map", lambda frame: frame["scan_counter"] == counter)


class Compared(NamedTuple):
    """What `Memory` is to solve."""

    magnitude: FloatArray | None
    structure: FloatArray | None
    is_saturated: bool


class Memory:
    """A reconstructor: half of each map is the map before, until it is told to forget.

    Its contacts have a pressure by the curve in force.
    """

    def __init__(self, seconds: float = 0.0) -> None:
        self.method = "auto"
        self.budget_s: float | None = None
        self.budgets_s: list[float | None] = []  # of the frames made
        self.seconds = seconds
        self.reference: Reference | None = None
        self.curve: PressureCurve | None = None
        self._before = np.zeros((51, 51), np.float32)

    def take(self, reference: Reference) -> Any:
        return SimpleNamespace(reference=reference)

    def use(self, tare: Any) -> None:
        self.set_reference(tare.reference)

    def set_reference(self, reference: Reference) -> None:
        self.reference = reference
        self.reset()

    def reset(self) -> None:
        self.forget_shape()

    def forget_shape(self) -> None:
        self._before = np.zeros((51, 51), np.float32)

    def compare(
        self,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
        *,
        saturated: Collection[Channel] = (),
        companions: Collection[CompanionReading] = (),
    ) -> Compared:
        assert not companions
        return Compared(magnitude, structure, bool(saturated))

    def solve(self, compared: Compared) -> Reconstruction:
        magnitude, structure, is_saturated = compared
        self.budgets_s.append(self.budget_s)
        time.sleep(self.seconds)
        flags = Flag.SATURATED if is_saturated else Flag(0)
        if magnitude is None:
            flags |= Flag.MAGNITUDE_MISSING
        if structure is None:
            flags |= Flag.STRUCTURE_MISSING
        if self.reference is None:
            return self._result(None, flags | Flag.NO_REFERENCE)
        change = 0.0
        for volts, rest in (
            (magnitude, self.reference.magnitude),
            (structure, self.reference.structure),
        ):
            if volts is not None and rest is not None:
                valid = np.isfinite(volts)
                flags |= Flag(0) if valid.all() else Flag.INVALID_VOLTAGE
                change += float(np.mean((volts / rest - 1)[valid]))
        self._before = (0.5 * self._before + change).astype(np.float32)
        return self._result(self._before, flags)

    def _result(self, image: Image | None, flags: Flag) -> Reconstruction:
        value = 0.0 if image is None else float(image[0, 0])
        kpa = np.nan if self.curve is None else self.curve.pressure(np.array(value))
        contacts = [Contact(1, 0.01, -0.02, 7e-4, value, 1e-3, float(kpa))]
        return Reconstruction(
            map=image,
            pressure_kpa=None,
            structure=image,
            contacts=tuple(contacts) if value > 0.05 else (),
            tier="tikhonov",
            reason="a test",
            misfit=1.0,
            flags=flags,
            stage_s={"solve": 1e-4},
        )


class Bench:
    """A daemon in this process, with its skin and a listener."""

    def __init__(
        self, daemon: Daemon, skin: Skin, listener: Listener, keys: Keys | None = None
    ) -> None:
        self.daemon = daemon
        self.keys = keys
        self.skin = skin
        self.listener = listener

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        address = self.daemon.control_address
        return request(command, address, PATIENCE_S, keys=self.keys, **arguments)

    def until(self, condition: Callable[[], Any]) -> Any:
        """Wait for the condition and return its value."""
        return wait_until(condition)

    def tare(self) -> Self:
        """Say hello and send the scans of the first reference; returns itself."""
        self.skin.introduce()
        whole = 0  # a busy computer may tear one of a short wait for the other channel apart
        while whole < self.daemon.config.tare_scans:
            whole += not {"magnitude_missing", "structure_missing"} & set(self.step()["flags"])
        self.listener.event("tared")
        return self

    def step(self, load: float = 0.0, **details: Any) -> dict[str, Any]:
        """Send one dual scan and wait for its map."""
        return self.listener.frame(self.skin.scan(load, **details))


class Heard:
    """What a replay published, from the first message to the last: recorded, so none is missed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as file:
            records = list(make_reader(file).iter_messages(log_time_order=False))
        self._messages = [
            decode_message(message.data)
            for _, channel, message in records
            if channel.topic in ("map", "contacts")
        ]

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [message.fields for message in self._messages if message.kind == kind]


def maps_of(frames: list[dict[str, Any]]) -> dict[int, Any]:
    """The map of each frame by the counter of its scans; None where it has none."""
    return {f["scan_counter"]: f["map"] and array_from_wire(f["map"]) for f in frames}


def scan_counters(path: Path, channel: Channel = Channel.MAGNITUDE) -> list[int]:
    """The counters of a channel's scans in a recording, as its ports said them."""
    recording = open_recording(path)
    found: list[Packet] = []
    for port in range(len(recording.origin.ports)):
        decoder = Decoder()
        for chunk in recording.chunks(port):
            found += decoder.feed(chunk.data)
    return [p.counter for p in found if isinstance(p, Scan) and p.channel == channel]
