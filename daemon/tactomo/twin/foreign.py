"""Other people's instruments, emulated: the twin's skin behind another language than ours.

`ForeignFirmware` does what they have in common: sampling, a line that may be slow, faults. Each
language is an `Emulator`, which turns frames into bytes and obeys the host; `MatrixBoard` is one.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray, IntArray
from tactomo_protocol import Channel, Hello, ScanFlag

from tactomo.twin.firmware import Converter, Firmware, Port, Sample, Voltages

MAX_WAITING_BYTES = 1 << 17
"""What an instrument keeps for a host that is slow to take it; then frames are lost."""
PUMP_S = 0.001


@dataclass(frozen=True, slots=True)
class Frame:
    """What an instrument has measured in one go round the electrodes."""

    volts: FloatArray  #: (M,) in the description's order
    time_s: float  #: when it began, by the instrument's clock


class Emulator:
    """One instrument's side of its language, made of the sensor and the frames a second at first.

    A protocol's class names a subclass as its `emulator`. For use by one thread.
    """

    is_streaming = False  # whether it sends frames at present

    def __init__(self, description: SensorDescription, rate_hz: float) -> None:
        self.rate_hz = rate_hz  # frames a second; the host may have changed it
        self._description = description
        self._grounded = Grounded(description)

    def greeting(self) -> list[bytes]:
        """Return what it says when it is switched on, or plugged in."""
        return []

    def hear(self, data: bytes) -> list[bytes]:
        """Obey what the host says, in any chunking, and return the answers."""
        raise NotImplementedError

    def frame(self, frame: Frame) -> list[bytes]:
        """Return what it sends of a frame, message by message."""
        raise NotImplementedError

    def held_up(self) -> list[bytes]:
        """Return what it says when the host did not take a frame; often nothing."""
        return []


class Grounded:
    """A scan's voltages as instruments have them that read each electrode against ground.

    The voltages between pairs say nothing of a potential that all electrodes share, nor of the
    driven ones: of all potentials that have them, the least are taken.
    """

    def __init__(self, description: SensorDescription) -> None:
        pairs, electrodes = description.pairs, np.eye(description.electrode_count)
        differences = electrodes[pairs.measure[:, 0]] - electrodes[pairs.measure[:, 1]]
        of_drives = [(pairs.drive == drive).all(axis=1) for drive in description.drive_pairs]
        self._least = [(here, np.linalg.pinv(differences[here])) for here in of_drives]

    def potentials(self, volts: FloatArray) -> FloatArray:
        """Return potentials (drives, electrodes) that have a scan's voltages (M,)."""
        return np.array([least @ volts[here] for here, least in self._least])


class ForeignFirmware(Firmware):
    """An instrument behind its one line. For use by one thread."""

    def __init__(
        self,
        emulator: Emulator,
        hello: Hello,
        port: Port,
        sample: Callable[[float], Future[Voltages]],
        converter: Converter,
        clock: Callable[[], float],
    ) -> None:
        super().__init__(hello, [port], sample, converter, clock, lambda _, __: ())
        self._emulator = emulator
        self._port = port
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._was_open = False

    def due_in_s(self) -> float:
        """See `Firmware`; while bytes wait for the line, soon."""
        due_s = super().due_in_s()
        return min(due_s, PUMP_S) if self._waiting else due_s

    def step(self) -> None:
        """See `Firmware`."""
        super().step()
        self._pump()

    def babble(self, port: Port, count: int) -> None:
        """See `Firmware`."""
        self._put([random.randbytes(count)])

    def _listen(self) -> None:
        is_open = self._port.line.is_open
        if is_open and not self._was_open:
            self._put(self._emulator.greeting())
        self._was_open = is_open
        data = self._port.line.receive()
        if data:
            self._put(self._emulator.hear(data))
        if self._emulator.is_streaming and not self._port.is_streaming:
            self._next_sample_s = self._clock()
        self._port.is_streaming = self._emulator.is_streaming
        self.rate_hz = self._emulator.rate_hz

    def _greet_when_due(self) -> None:
        self._next_hello_s = self._clock() + 1.0  # it says no hello

    def _say(
        self, port: Port, channel: Channel, sample: Sample, flags: ScanFlag, voltages: Voltages
    ) -> None:
        scan = self._scan(channel, sample, flags, voltages)
        frame = Frame(scan.volts(self._converter.volts_per_count), sample.time_s)
        if not port.line.is_open:
            port.line.unheard += 1
        elif self._waiting_bytes > MAX_WAITING_BYTES:
            port.line.dropped += 1
            self._put(self._emulator.held_up())
        else:
            port.line.sent += 1
            self._put(self._emulator.frame(frame))

    def _put(self, messages: list[bytes]) -> None:
        self._waiting.extend(messages)
        self._waiting_bytes += sum(map(len, messages))

    def _pump(self) -> None:
        """Hand the line what it takes; what nobody listens to is lost."""
        if not self._port.line.is_open:
            self._waiting.clear()
            self._waiting_bytes = 0
        while self._waiting:
            message = self._waiting.popleft()
            rest = self._port.line.push(message)
            self._waiting_bytes -= len(message) - len(rest)
            if rest:
                self._waiting.appendleft(rest)
                return


class MatrixBoard(Emulator):
    """A board that prints a table at its own pace, once it was told to; see `protocols.matrix`."""

    def __init__(self, description: SensorDescription, rate_hz: float) -> None:
        super().__init__(description, rate_hz)
        self._gain = 0.0
        self._heard = b""
        pairs = description.pairs
        self._place = (
            _numbered(description.drive_pairs, pairs.drive),
            _numbered(description.measure_pairs, pairs.measure),
        )
        self._start = description.instrument.start.encode()
        self._is_single_ended = description.instrument.referenced == "single_ended"

    def greeting(self) -> list[bytes]:
        """See `Emulator`."""
        self.is_streaming = not self._start
        return []

    def hear(self, data: bytes) -> list[bytes]:
        """See `Emulator`."""
        self._heard = (self._heard + data)[-32:]
        if self._start and self._start in self._heard:
            self.is_streaming = True
        return []

    def frame(self, frame: Frame) -> list[bytes]:
        """See `Emulator`."""
        numbers = self._table(frame) / self._description.instrument.volts_per_unit
        return [b"".join(b"%.4f, " % value for value in numbers.ravel()) + b"\n"]

    def _table(self, frame: Frame) -> FloatArray:
        if self._is_single_ended:
            potentials = self._grounded.potentials(self._read(frame.volts))
            return np.asarray(potentials - potentials.min(axis=1, keepdims=True))
        drives, pairs = len(self._description.drive_pairs), len(self._description.measure_pairs)
        table = np.zeros((drives, pairs))
        table[self._place] = self._read(frame.volts)
        return table

    def _read(self, volts: FloatArray) -> FloatArray:
        if not self._gain:
            self._gain = 1.0 / float(np.abs(volts).max())
        read = volts * self._gain
        return read if self._description.instrument.voltages == "signed" else np.abs(read)


def _numbered(listed: IntArray, pairs: IntArray) -> IntArray:
    """Which of the listed pairs each one is."""
    place = {pair: number for number, pair in enumerate(map(tuple, listed.tolist()))}
    return np.array([place[pair] for pair in map(tuple, pairs.tolist())], dtype=np.intp)
