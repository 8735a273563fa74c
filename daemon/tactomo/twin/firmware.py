"""The simulated firmware: what runs on the microcontroller of a real skin.

It keeps the device's clock and scan counter, samples the skin at a fixed rate, says hello every
second and answers commands, all in wire protocol v1. It knows nothing of sockets or threads:
`Firmware.step` does what is due and returns.

A scan carries the time at which the skin was *sampled*, and shows the skin as it was then. The
forward model may need longer than a scan period; then the scan goes out late, with its true time
and the LATE flag, and the next one is sampled afterwards. Missed scans are not made up, and the
scan counter counts those that were made.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.companion import Companion
from tactomo_protocol import (
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    CompanionReading,
    Decoder,
    Hello,
    Scan,
    ScanFlag,
    encode,
)

from tactomo.twin.line import SerialLine


@dataclass(eq=False)
class SimulatedCompanion:
    """A companion of a sensor: a load cell or the like, which feels what presses the skin.

    Noise, the gain's error, lag and dead time are those of the description; noise depends on
    nothing but the seed, the companion and the scan's counter. For one thread; time only goes on.
    """

    _index: int
    _companion: Companion
    _seed: int

    def __post_init__(self) -> None:
        off = np.random.default_rng([self._seed, self._index, 8]).standard_normal()
        self._gain = 1 + self._companion.relative_error * float(off)
        self._to_come: deque[tuple[float, float]] = deque()  # forces within the dead time
        self._through_n = 0.0  # the force that has come through the dead time
        self._seen_n, self._seen_s = 0.0, 0.0  # the force behind the lag, and when

    def read(self, force_n: float, time_s: float, counter: int) -> CompanionReading:
        """Return what it reads at a scan, of the force that presses on it then."""
        companion = self._companion
        noise = np.random.default_rng([self._seed, self._index, counter, 3]).standard_normal()
        felt_n = self._gain * self._behind(force_n, time_s) + companion.noise_n * float(noise)
        value = companion.reading_of(felt_n)
        flags = ScanFlag.SIMULATED
        if not companion.may_read(value):
            flags |= ScanFlag.SATURATED
        return CompanionReading(self._index, flags, round(1e6 * time_s), value)

    def _behind(self, force_n: float, time_s: float) -> float:
        """Return the force as it is seen behind dead time and lag."""
        self._to_come.append((time_s, force_n))
        while self._to_come and self._to_come[0][0] <= time_s - self._companion.dead_time_s:
            _, self._through_n = self._to_come.popleft()
        lag_s, passed_s = self._companion.lag_s, time_s - self._seen_s
        share = 1.0 if lag_s == 0 else -math.expm1(-passed_s / lag_s)
        self._seen_n += share * (self._through_n - self._seen_n)
        self._seen_s = time_s
        return self._seen_n


ADC_BITS = 24


@dataclass
class Converter:
    """What amplifier and ADC make of volts: noise, then counts, clipped at the converter's range.

    Noise depends on nothing but the seed, the channel and the scan's counter. `noise_v` may be
    changed between scans.
    """

    full_scale_v: float  # volts at the end of the converter's range, either sign
    noise_v: float  # standard deviation of the noise in volts, the same on every measurement
    seed: int = 0  # equal seeds give equal noise

    @property
    def volts_per_count(self) -> float:
        """Size of one count, in volts."""
        return float(self.full_scale_v / 2 ** (ADC_BITS - 1))

    def convert(
        self, volts: FloatArray, *, channel: Channel, counter: int
    ) -> tuple[NDArray[np.int32], bool]:
        """Return the counts of one scan, (M,), and whether any of them hit the end of the range."""
        noise = np.random.default_rng([self.seed, channel.number, counter, 1])
        seen_v = volts + self.noise_v * noise.standard_normal(len(volts))
        top = 2 ** (ADC_BITS - 1) - 1
        counts = np.rint(seen_v / self.volts_per_count)
        saturated = bool(np.any(np.abs(counts) > top))
        return np.clip(counts, -top, top).astype(np.int32), saturated


HELLO_PERIOD_S = 1.0
RATE_HZ_MIN, RATE_HZ_MAX = 0.1, 500.0

Voltages = Mapping[Channel, FloatArray]


@dataclass(slots=True)
class Port:
    """One line of the device with the channels that it carries."""

    line: SerialLine
    channels: tuple[Channel, ...]
    decoder: Decoder = field(default_factory=Decoder)
    is_streaming: bool = False


@dataclass(frozen=True, slots=True)
class Sample:
    """A scan in the making: sampled at `time_s`, its voltages still being computed."""

    counter: int
    time_s: float
    voltages: Future[Voltages]
    readings: Sequence[CompanionReading]


@dataclass(eq=False)
class Firmware:
    """The device behind its lines. For use by one thread."""

    hello: Hello  # as of all channels and the rate at first
    ports: Sequence[Port]
    _sample: Callable[[float], Future[Voltages]]  # starts computing the voltages of a time
    _converter: Converter
    _clock: Callable[[], float]  # the seconds since power-up
    # what the companions read at a time, at the scan of that counter
    _read: Callable[[float, int], Sequence[CompanionReading]]

    def __post_init__(self) -> None:
        self.rate_hz = self.hello.scan_rate_hz
        self.counter = 0
        self.late = 0
        self._pending: Sample | None = None
        self._next_sample_s = 0.0
        self._next_hello_s = 0.0
        self._mute_until_s: dict[Channel, float] = {}

    def due_in_s(self) -> float:
        """Return the seconds until there is something to do by the clock; 0 when overdue."""
        next_s = self._next_hello_s
        if self._pending is None and self._is_streaming:
            next_s = min(next_s, self._next_sample_s)
        return max(0.0, next_s - self._clock())

    def step(self) -> None:
        """Do what is due: answer commands, say hello, sample, send."""
        self._listen()
        self._greet_when_due()
        self._begin_scan()
        self._finish_scan()

    def mute(self, channel: Channel, seconds: float) -> None:
        """Send nothing of one channel for a while, as a sheet whose board hangs would."""
        self._mute_until_s[channel] = self._clock() + seconds

    def babble(self, port: Port, count: int) -> None:
        """Send `count` random bytes on one line, as a loose contact or a wrong baud rate would."""
        port.line.send(random.randbytes(count))

    @property
    def _is_streaming(self) -> bool:
        return any(port.is_streaming for port in self.ports)

    def _listen(self) -> None:
        for port in self.ports:
            for packet in port.decoder.feed(port.line.receive()):
                if isinstance(packet, Command):
                    self._obey(port, packet)

    def _greet_when_due(self) -> None:
        if self._clock() >= self._next_hello_s:
            self._next_hello_s = self._clock() + HELLO_PERIOD_S
            self._greet(self.ports)

    def _begin_scan(self) -> None:
        if self._pending is not None or not self._is_streaming:
            return
        now_s = self._clock()
        if now_s < self._next_sample_s:
            return
        # The grid of instants is kept while the solves keep up with it; what was missed is missed.
        self._next_sample_s = max(self._next_sample_s + 1.0 / self.rate_hz, now_s)
        readings = self._read(now_s, self.counter)
        self._pending = Sample(self.counter, now_s, self._sample(now_s), readings)
        self.counter = (self.counter + 1) % 2**32

    def _finish_scan(self) -> None:
        if self._pending is None or not self._pending.voltages.done():
            return
        sample, self._pending = self._pending, None
        voltages = sample.voltages.result()
        flags = ScanFlag.SIMULATED
        if self._clock() - sample.time_s > 1.0 / self.rate_hz:
            flags |= ScanFlag.LATE
            self.late += 1
        leader = self.ports[0]
        if leader.is_streaming:
            for reading in sample.readings:
                leader.line.send(encode(reading))
        for port in self.ports:
            for channel in port.channels:
                if port.is_streaming and self._mute_until_s.get(channel, 0.0) <= self._clock():
                    self._say(port, channel, sample, flags, voltages)

    def _say(
        self, port: Port, channel: Channel, sample: Sample, flags: ScanFlag, voltages: Voltages
    ) -> None:
        port.line.send(encode(self._scan(channel, sample, flags, voltages)))

    def _scan(self, channel: Channel, sample: Sample, flags: ScanFlag, voltages: Voltages) -> Scan:
        counts, saturated = self._converter.convert(
            voltages[channel], channel=channel, counter=sample.counter
        )
        return Scan(
            channel=channel,
            counter=sample.counter,
            device_us=round(sample.time_s * 1e6),
            flags=flags | ScanFlag.SATURATED if saturated else flags,
            samples=counts,
        )

    def _obey(self, port: Port, command: Command) -> None:
        status = AckStatus.OK
        if command.code == CommandCode.START:
            if not self._is_streaming:
                self._next_sample_s = self._clock()
            port.is_streaming = True
        elif command.code == CommandCode.STOP:
            port.is_streaming = False
            if not self._is_streaming:
                self._pending = None  # a scan of before would be the next stream's first
        elif command.code == CommandCode.ZERO_COUNTERS:
            self.counter = 0
        elif command.code == CommandCode.SET_RATE:
            status = self._set_rate(command.rate_hz)
        elif command.code != CommandCode.IDENTIFY:
            status = AckStatus.UNKNOWN_COMMAND
        port.line.send(encode(Acknowledge(command.request, command.code, status)))
        if command.code == CommandCode.IDENTIFY:
            self._greet([port])

    def _set_rate(self, rate_hz: float) -> AckStatus:
        if not 0 < rate_hz <= RATE_HZ_MAX:
            return AckStatus.BAD_ARGUMENT
        self.rate_hz = max(RATE_HZ_MIN, rate_hz)
        self._next_hello_s = self._next_sample_s = self._clock()
        return AckStatus.OK

    def _greet(self, ports: Sequence[Port]) -> None:
        for port in ports:
            # A follower's pulses come from the leader.
            rate_hz = self.rate_hz if port is self.ports[0] else 0.0
            hello = replace(self.hello, channels=port.channels, scan_rate_hz=rate_hz)
            port.line.send(encode(hello))
