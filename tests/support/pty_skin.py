"""A skin on real pseudo-terminals that says prepared scans at any rate, whatever the host does.

The twin is the device for whoever wants a device; this one is for rates that its forward model
cannot keep, and for knowing each byte that was sent.
"""

from __future__ import annotations

import itertools
import os
import select
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from tactomo.twin.line import SerialLine
from tactomo_models import Press, SensorDescription, SkinSimulator
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel, Hello, SampleFormat, Scan, ScanFlag, encode

HELLO_PERIOD_S = 1.0
VOLTS_PER_COUNT = 2e-8
NOISE_COUNTS = 60.0
"""What a good converter has: 60 dB below the largest voltages' rms, about."""
PATH_STEPS = 60
SLIDE_M, SLIDE_M_S = 0.09, 0.1
"""A finger that strokes: 10 cm/s."""
PATIENCE_S = 60.0

Volts = Mapping[Channel, FloatArray]


class Scenes:
    """Voltages of the bare skin and of contacts that move, computed once.

    Attributes:
        rest: nothing pressed.
        one, two: so many contacts at the steps of a path that ends where it began.

    """

    def __init__(self, description: SensorDescription) -> None:
        skin = self._skin = SkinSimulator(description, 4e-3, unevenness=0.03, impedance_spread=0.1)

        def volts(*presses: Press) -> Volts:
            return skin.voltages(presses)

        angles = np.linspace(0, 2 * np.pi, PATH_STEPS, endpoint=False)
        circle = [(0.035 * float(np.cos(a)), 0.035 * float(np.sin(a))) for a in angles]
        self.rest = volts()
        self.one = [volts(Press(x, y, 180.0)) for x, y in circle]
        self.two = [volts(Press(x, y, 180.0), Press(-x, -y, 170.0)) for x, y in circle]

    def sliding(self, rate_hz: float) -> list[Volts]:
        """One contact that slides to and fro at SLIDE_M_S, at so many scans a second."""
        steps = round(SLIDE_M / SLIDE_M_S * rate_hz)
        to = [Press(x, 0.01, 180.0) for x in np.linspace(-SLIDE_M / 2, SLIDE_M / 2, steps)]
        path = [self._skin.voltages((press,)) for press in to]
        return [*path, *path[-2:0:-1]]


class PtySkin:
    """The device; `say` from one thread at a time.

    Attributes:
        counter: of the next dual scan.
        lines: the serial line of each channel; one and the same where there is one port.

    """

    def __init__(self, folder: Path, description: SensorDescription, ports: int = 2) -> None:
        names = [channel if ports == 2 else "skin" for channel in Channel]
        made = {name: SerialLine(name, folder) for name in dict.fromkeys(names)}
        self.lines = {channel: made[name] for channel, name in zip(Channel, names, strict=True)}
        self.paths = [line.path for line in made.values()]
        self.counter = 1
        self.began_s = time.monotonic()
        self._description = description
        self._noise = np.random.default_rng(1)
        self._hello_s = 0.0
        self._lock = threading.Lock()

    @property
    def each(self) -> list[SerialLine]:
        """Every line once."""
        return list(dict.fromkeys(self.lines.values()))

    def hello(self, line: SerialLine) -> Hello:
        """What the device says of itself on a line."""
        pattern = self._description.pattern
        return Hello(
            device_id="pty-skin",
            firmware="1",
            channels=tuple(c for c, at in self.lines.items() if at is line),
            electrodes=self._description.electrode_count,
            drive_offset=pattern.drive_offset,
            measure_offset=pattern.measure_offset,
            samples_per_scan=self._description.measurements,
            sample_format=SampleFormat.INT32,
            volts_per_count=VOLTS_PER_COUNT,
            scan_rate_hz=20.0,
        )

    def scan(self, channel: Channel, counter: int, volts: FloatArray) -> Scan:
        """Return the scan as the converter would give it, noise included."""
        noise = self._noise.normal(0, NOISE_COUNTS, len(volts))
        counts = np.rint(volts / VOLTS_PER_COUNT + noise).astype(np.int32)
        device_us = round((time.monotonic() - self.began_s) * 1e6)
        return Scan(channel, counter, device_us, ScanFlag(0), counts)

    def say(self, volts: Volts) -> int:
        """Send the next dual scan, waiting while the lines are full; returns its counter."""
        counter = self.counter
        self.counter = (counter + 1) % 2**32
        self.attend()
        for channel, values in volts.items():
            self.send(self.lines[channel], encode(self.scan(channel, counter, values)))
        return counter

    def attend(self) -> None:
        """Say hello where the host asks for it, or when it is time to."""
        is_time = time.monotonic() - self._hello_s > HELLO_PERIOD_S
        for line in self.each:
            with self._lock:
                is_asked = line.is_plugged and bool(line.receive())
            if is_asked or is_time:
                self.send(line, encode(self.hello(line)))
        if is_time:
            self._hello_s = time.monotonic()

    def send(self, line: SerialLine, data: bytes) -> None:
        """Send bytes, waiting while the line is full; lost where nobody listens."""
        deadline = time.monotonic() + PATIENCE_S
        while data:
            with self._lock:
                if not line.is_plugged or not line.is_open:
                    return
                try:
                    data = data[os.write(line.fileno(), data) :]
                    continue
                except BlockingIOError:
                    descriptor = line.fileno()
            assert time.monotonic() < deadline, "nobody reads the line"
            select.select([], [descriptor], [], 0.005)

    def unplug(self) -> None:
        """Pull every cable."""
        with self._lock:
            for line in self.each:
                line.unplug()

    def plug(self) -> None:
        """Put them back."""
        with self._lock:
            for line in self.each:
                line.plug()

    def close(self) -> None:
        """Pull every cable for good."""
        self.unplug()
        for line in self.each:
            line.close()


class Playing:
    """Says dual scans from a thread of its own, at `rate_hz` or as fast as they are taken.

    Args:
        skin: the device.
        volts: those of the dual scans to come; the thread ends with them.
        rate_hz: dual scans a second; None for as fast as they are taken.
        before: called before each one.

    Attributes:
        sent: the counter of each dual scan and the monotonic nanoseconds at which it was sent.

    """

    def __init__(
        self,
        skin: PtySkin,
        volts: Iterator[Volts],
        rate_hz: float | None,
        before: Callable[[], None] = lambda: None,
    ) -> None:
        self.sent: dict[int, int] = {}
        self.failure: BaseException | None = None
        self._skin = skin
        self._volts = volts
        self._period_s = 1 / rate_hz if rate_hz else 0.0
        self._before = before
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="playing")
        self._thread.start()

    def stop(self) -> int:
        """End the playing; returns how many dual scans were sent."""
        self._stopping.set()
        return self.join()

    def join(self) -> int:
        """Wait for the last one; returns how many were sent."""
        self._thread.join()
        if self.failure is not None:
            raise self.failure
        return len(self.sent)

    def _run(self) -> None:
        due_s = time.monotonic()
        try:
            for volts in self._volts:
                if self._stopping.wait(max(0.0, due_s - time.monotonic())):
                    return
                self._before()
                counter = self._skin.say(volts)
                self.sent[counter] = time.monotonic_ns()
                due_s = max(due_s + self._period_s, time.monotonic() - 0.1)
        except BaseException as error:
            self.failure = error


def still(volts: Volts) -> Iterator[Volts]:
    """The same for ever."""
    return itertools.repeat(volts)


def moving(path: Sequence[Volts]) -> Iterator[Volts]:
    """Round and round the path."""
    return itertools.cycle(path)
