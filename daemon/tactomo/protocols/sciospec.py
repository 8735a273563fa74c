"""Sciospec EIT16 to EIT128: binary messages of single-ended complex potentials.

After EITLabworks/sciopy (com_util.py, usb_message_parser.py at 1789b54, EIT_16_32_64_128.py at
0becb7e), which was written beside the instrument; there was none here. Every message, both ways:

    tag | length u8 | bytes | tag

The host asks for one thing after another and waits for each to be acknowledged (18 01 83 18):

    B4 01 00 B4                 stop
    B0 01 01 B0                 reset the set-up
    B0 03 02 00 00 B0           burst count 0: frames until stopped
    B0 09 05 f64 B0             amplitude, A: the description's `current_a`
    B0 05 03 f32 B0             frames a second: its `instrument.scan_rate_hz`
    B0 0C 04 f32 f32 00 01 00 B0  one frequency: its `instrument.frequency_hz`, Hz
    B0 03 08 01 01 B0           single-ended
    B0 03 06 source sink B0     once for each drive of its pattern, electrodes from 1
    B2 02 01|02|03 01 B2        data say their injection, frequency row and time
    B4 01 01 B4                 start

ADC range, gain and the kind of switch stay as the reset leaves them. 81 and 82 in the place of 83
are refusals; 84 and 04 say that the instrument has started, so that all of it is asked again; 92
that it could not get rid of its data.

Data, one for each injection and each group of 16 channels; four groups come even where one is used:

    B4 89 | group u8 | source u8 | sink u8 | frequency row u16 | time u32 | 16 x (f32, f32) | B4

all big-endian. A frame is one message of each injection and each group that has electrodes. They
come in the pattern's order; a frame that lacks one is dropped as soon as the order begins again, or
where the times between its messages tell that it is put together from two. Of complex potentials
the differences' real part is taken, as by `imported`, and a source and sink that are exchanged turn
the sign.

The time is in milliseconds by one reading of that code and a float by another. Whichever makes
successive frames come about as far apart as was asked for is believed; by default, milliseconds.
"""

from __future__ import annotations

import math
import re
import struct
from collections import deque
from collections.abc import Iterator
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tactomo_models import SensorDescription

from tactomo.errors import ConfigError
from tactomo.protocols.interface import ForeignProtocol, Reading, Trouble, oriented
from tactomo.scans import MAX_QUADRATURE

AMPLITUDE_A: Final = (100e-9, 10e-3)
CHANNELS: Final = 16  # in a group, and in a message
DATA_TAG: Final = 0xB4
ACK_TAG: Final = 0x18
DATA: Final = np.dtype(
    [
        ("tag", "u1"),
        ("length", "u1"),
        ("group", "u1"),
        ("source", "u1"),
        ("sink", "u1"),
        ("frequency_row", ">u2"),
        ("time", ">u4"),
        ("volts", ">f4", (CHANNELS, 2)),
        ("end", "u1"),
    ]
)
"""One data message."""
DATA_LENGTH: Final = DATA.itemsize - 3
_TIME: Final = slice(7, 11)

_CODES: Final = b"\x01\x02\x04\x11\x81\x82\x83\x84\x92"
_START: Final = re.compile(rb"\xb4\x89|\x18\x01|\xb4$|\x18$")
_ANY: Final = re.compile(
    rb"\x18\x01[" + re.escape(_CODES) + rb"]\x18|\xb4\x89.{137}\xb4", re.DOTALL
)
_FLOAT_FROM: Final = 0x3A80_0000  # floats above a thousandth; 11 days, read as milliseconds
_GAP: Final = 8.0
"""Times the usual one between messages, above which they are of two frames; it is a frame's 16."""
_CLOCK_TRIES: Final = 5
_EDGE: Final = 0.8  # of what is too much out of phase, what is little enough again


class Ack(IntEnum):
    """What the instrument answers."""

    TIMEOUT = 0x02
    AWAKE = 0x04
    NOT_EXECUTED = 0x81
    NOT_RECOGNISED = 0x82
    DONE = 0x83
    READY = 0x84
    HELD_UP = 0x92


class Clock(IntEnum):
    """How the four bytes of a message's time are to be read."""

    UNDECIDED = 0
    MILLISECONDS = 1
    FLOAT_S = 2
    FLOAT_MS = 3
    NONE = 4


class Request(NamedTuple):
    """One thing that is asked of the instrument."""

    what: str  # in words, for when it is refused
    message: bytes


def message(tag: int, *content: int, rest: bytes = b"") -> bytes:
    """Return one message of either side."""
    body = bytes(content) + rest
    return bytes([tag, len(body)]) + body + bytes([tag])


STOP: Final = message(DATA_TAG, 0)


class Sciospec(ForeignProtocol):
    """See `PortProtocol` and this module's beginning.

    Raises ConfigError where the instrument cannot do what the description has.
    """

    name = "sciospec"
    baud = 9600
    device_id = "sciospec"
    emulator = "tactomo.twin.sciospec:SciospecEmulator"

    def __init__(self, description: SensorDescription) -> None:
        super().__init__(description, description.instrument.scan_rate_hz)
        _check(description)
        drives = description.drive_pairs
        self.patience_s = self._usual_patience_s = max(4.0, 3 / description.instrument.scan_rate_hz)
        self._groups = -(-description.electrode_count // CHANNELS)
        self._sinks = oriented(drives + 1)
        row_of = {tuple(pair): row for row, pair in enumerate(drives.tolist())}
        self._rows = np.array([row_of[tuple(pair)] for pair in description.pairs.drive.tolist()])
        self._buffer = b""
        self._is_skipping = False
        self._measure = description.pairs.measure.T
        self._parts: dict[tuple[int, int], bytes] = {}  # a frame's messages, by row and group
        self._strangers = 0  # messages of injections that were not asked for, in a row
        self._frame_time: int | None = None  # the previous frame's, while the clock is undecided
        self._tries = 0
        self._requests: deque[Request] = deque()
        self._asked: Request | None = None
        self._replies: list[bytes] = []

    @property
    def has_clock(self) -> bool:  # type: ignore[override]
        """Whether the messages' times make sense."""
        return self.clock_format not in (Clock.UNDECIDED, Clock.NONE)

    def introduction(self) -> list[bytes]:
        """Begin to ask for all that is wanted; the first request."""
        self._requests = deque(requests(self.description))
        self._asked = None
        return self._next_request()

    def replies(self) -> list[bytes]:
        """Return the next request, once the one before was acknowledged."""
        replies, self._replies = self._replies, []
        return replies

    def stop(self) -> list[bytes]:
        """See `PortProtocol`."""
        return [STOP]

    def restart(self) -> None:
        """See `PortProtocol`."""
        super().restart()
        self.patience_s = self._usual_patience_s
        self._buffer, self._replies, self._asked = b"", [], None
        self._requests.clear()
        self._forget_frame()

    def begun(self) -> bytes:
        """Return the messages of the frame that has begun, and the beginning of the next one."""
        return b"".join(self._parts.values()) + self._buffer

    @classmethod
    def recognises(cls, data: bytes) -> bool:
        """Tell whether there is a whole message in it."""
        return _ANY.search(data) is not None

    def parse(self, data: bytes) -> Iterator[Reading]:
        """Yield the frames that are complete."""
        for found in self._messages(data):
            if found[0] == ACK_TAG:
                self._hear(found[2])
                continue
            reading = self._take(found)
            if reading is not None:
                yield reading

    def _messages(self, data: bytes) -> Iterator[bytes]:
        """Yield whole messages; what lies between them is skipped and counted once."""
        buffer = self._buffer + data
        at = 0
        while match := _START.search(buffer, at):
            if match.start() > at:
                self._skip()
            at = match.start()
            end = at + (4 if buffer[at] == ACK_TAG else DATA.itemsize)
            if end > len(buffer):
                break
            if is_message(buffer[at:end]):
                self._is_skipping = False
                self.counts.packets += 1
                yield buffer[at:end]
                at = end
            else:
                self._skip()
                at += 1
        else:
            if at < len(buffer):
                self._skip()
            at = len(buffer)
        self._buffer = buffer[at:]

    def _skip(self) -> None:
        if not self._is_skipping:
            self.counts.unreadable += 1
        self._is_skipping = True

    def _take(self, found: bytes) -> Reading | None:
        place = self._sinks.get((found[3], found[4]))
        if place is None:
            self._note_stranger(found)
            return None
        self._strangers = 0
        key = (place[0], found[2])
        if key[1] > self._groups:
            return None
        last = next(reversed(self._parts), (-1, 0))
        if key <= last:  # the order begins again
            self.counts.unreadable += 1
            if key == last and found[_TIME] == self._parts[key][_TIME]:
                return None  # the same once more
            self._forget_frame()
        self._parts[key] = found
        if len(self._parts) < len(self.description.drive_pairs) * self._groups:
            return None
        parts = np.frombuffer(b"".join(self._parts.values()), DATA)
        self._forget_frame()
        return self._frame(parts.reshape(-1, self._groups))

    def _frame(self, parts: NDArray[np.void]) -> Reading | None:
        """Return the reading of a whole frame, (drives, groups); None if it is not to be used."""
        times = parts["time"][:, 0]
        if not self._is_of_one(times) or not np.isfinite(parts["volts"]).all():
            self.counts.unreadable += 1
            return None
        self._decide_clock(int(times[0]))
        differences = self._differences(parts)
        size = float(np.linalg.norm(differences))
        quadrature = float(np.linalg.norm(differences.imag)) / size if size else 0.0
        if not self._is_in_phase(quadrature) or self.clock_format == Clock.UNDECIDED:
            return None
        return Reading(differences.real, microseconds(int(times[0]), Clock(self.clock_format)))

    def _is_in_phase(self, quadrature: float) -> bool:
        """Tell whether the real part is the signal; not to and fro where it is on the edge."""
        limit = MAX_QUADRATURE * (_EDGE if math.isinf(self.patience_s) else 1.0)
        is_in_phase = quadrature <= limit
        if is_in_phase:
            self.trouble, self.patience_s = None, self._usual_patience_s
        elif math.isfinite(self.patience_s):  # to ask it anew would change nothing
            self.patience_s = math.inf
            self.trouble = Trouble(
                f"{quadrature:.0%} of the signal is out of phase with the current",
                "calibrate the instrument with a resistor, or lower `instrument.frequency_hz`",
            )
        return is_in_phase

    def _differences(self, parts: NDArray[np.void]) -> NDArray[np.complex128]:
        """Return the description's voltages of a frame's potentials."""
        pairs = parts["volts"].astype(np.float64)
        potentials = (pairs[..., 0] + 1j * pairs[..., 1]).reshape(len(parts), -1)
        ends = zip(parts["source"][:, 0].tolist(), parts["sink"][:, 0].tolist(), strict=True)
        signs = np.array([self._sinks[pair][1] for pair in ends])
        plus, minus = self._measure
        found = potentials[self._rows, plus] - potentials[self._rows, minus]
        return np.asarray(signs[self._rows] * found)

    def _is_of_one(self, times: NDArray[np.uint32]) -> bool:
        """Tell whether messages follow one another as in one frame, as far as their times tell."""
        clock = self.clock_format
        if clock in (Clock.UNDECIDED, Clock.NONE) or len(times) < 3:
            return True
        gaps_us = np.diff([microseconds(time, Clock(clock)) for time in times.tolist()])
        usual_us = max(float(np.median(gaps_us)), 1000.0)
        return bool(gaps_us.min() >= 0 and gaps_us.max() <= _GAP * usual_us)

    def _decide_clock(self, time: int) -> None:
        """Decide how times are to be read, by those of two frames."""
        if self.clock_format != Clock.UNDECIDED:
            return
        before, self._frame_time = self._frame_time, time
        if before is None:
            return
        floats = [Clock.FLOAT_S, Clock.FLOAT_MS] if time >= _FLOAT_FROM else []
        for clock in (*floats, Clock.MILLISECONDS):
            step_us = microseconds(time, clock) - microseconds(before, clock)
            periods = step_us * 1e-6 * self.description.instrument.scan_rate_hz
            if 0.25 < periods < 8:
                self.clock_format = clock
                return
        self._tries += 1
        if self._tries >= _CLOCK_TRIES:
            self.clock_format = Clock.NONE

    def _note_stranger(self, found: bytes) -> None:
        self._strangers += 1
        if self._strangers > 8 * CHANNELS * self._groups and self.trouble is None:
            self.trouble = Trouble(
                f"the instrument injects at {found[3]} and {found[4]} (from 1), which is "
                f"not in the pattern of {self.description.name}",
                "reset the instrument if another program uses it, or correct the description's "
                "pattern",
            )

    def _forget_frame(self) -> None:
        self._parts = {}

    def _hear(self, code: int) -> None:
        """Go on with the requests, or give up, as the instrument answers."""
        asked = self._asked
        if code in (Ack.AWAKE, Ack.READY) and asked is None and not self._requests:
            self._replies = self.introduction()
        elif code == Ack.DONE and asked is not None:
            self._replies += self._next_request()
        elif code in (Ack.NOT_EXECUTED, Ack.NOT_RECOGNISED) and asked is not None:
            why = "will not" if code == Ack.NOT_EXECUTED else "does not know how to"
            self.trouble = Trouble(
                f"the instrument {why} {asked.what} (NACK {code:02X})",
                "correct current_a, [pattern] or [instrument] in the sensor's description; restart "
                "the instrument if another program uses it",
            )
            self._requests.clear()
            self._asked = None

    def _next_request(self) -> list[bytes]:
        self._asked = self._requests.popleft() if self._requests else None
        return [] if self._asked is None else [self._asked.message]


def requests(description: SensorDescription) -> Iterator[Request]:
    """Yield what the instrument is asked, in order."""
    current_a = description.pattern.current_a
    rate_hz, frequency_hz = description.instrument.scan_rate_hz, description.instrument.frequency_hz
    yield Request("stop", STOP)
    yield Request("reset its set-up", message(0xB0, 0x01))
    yield Request("measure until stopped", message(0xB0, 0x02, 0, 0))
    yield Request(f"inject {current_a:g} A", message(0xB0, 0x05, rest=struct.pack(">d", current_a)))
    yield Request(
        f"measure {rate_hz:g} frames a second", message(0xB0, 0x03, rest=struct.pack(">f", rate_hz))
    )
    yield Request(
        f"inject at {frequency_hz:g} Hz",
        message(0xB0, 0x04, rest=struct.pack(">ffHB", frequency_hz, frequency_hz, 1, 0)),
    )
    yield Request("measure single-ended", message(0xB0, 0x08, 1, 1))
    for source, sink in (description.drive_pairs + 1).tolist():
        yield Request(
            f"inject between electrodes {source} and {sink}", message(0xB0, 0x06, source, sink)
        )
    for option in (1, 2, 3):
        yield Request("say what its data mean", message(0xB2, option, 1))
    yield Request("start", message(DATA_TAG, 1))


def microseconds(time: int, clock: Clock) -> int:
    """Return a message's time by one reading of it; 0 where that is no time."""
    if clock in (Clock.UNDECIDED, Clock.NONE):
        return 0
    if clock is Clock.MILLISECONDS:
        return time * 1000
    value = struct.unpack(">f", struct.pack(">I", time))[0]
    scaled = value * (1e6 if clock is Clock.FLOAT_S else 1e3)
    return round(scaled) if 0 <= scaled < 2**63 else 0


def is_message(data: bytes) -> bool:
    """Tell whether bytes of a message's length, which begin as one, are one."""
    if data[0] == ACK_TAG:
        return data[2] in _CODES and data[3] == ACK_TAG
    return data[-1] == DATA_TAG and 1 <= data[2] <= 8 and bool(data[3] and data[4])


def _check(description: SensorDescription) -> None:
    current_a, (least_a, most_a) = description.pattern.current_a, AMPLITUDE_A
    if not least_a <= current_a <= most_a:
        raise ConfigError(
            f"{description.name} has pattern.current_a = {current_a:g}; the instrument injects "
            f"{least_a:g} to {most_a:g} A",
            "correct the description",
        )
