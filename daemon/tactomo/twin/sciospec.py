"""A Sciospec EIT instrument, emulated: the other side of `protocols.sciospec`.

It acknowledges what it is asked, refuses nonsense and what it cannot do, is configured only while
it does not measure, and sends potentials of all four channel groups, however few have electrodes.
The skin gives differences of potentials, so the potentials are the smallest that have those.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray

from tactomo.protocols.interface import oriented
from tactomo.protocols.sciospec import (
    ACK_TAG,
    AMPLITUDE_A,
    CHANNELS,
    DATA,
    DATA_LENGTH,
    DATA_TAG,
    Ack,
    message,
)
from tactomo.twin.foreign import Emulator, Frame

GROUPS: Final = 4
RATE_HZ: Final = (0.1, 100.0)
FREQUENCY_HZ: Final = (100.0, 1e6)
TIMEOUT_S: Final = 0.2  #: how long it waits for the rest of a message


class SciospecEmulator(Emulator):
    """See `Emulator`."""

    def __init__(self, description: SensorDescription, rate_hz: float) -> None:
        super().__init__(description, rate_hz)
        self._drives = oriented(description.drive_pairs + 1)
        self._buffer = b""
        self._heard_s = 0.0
        self._obey: Mapping[int, Callable[[bytes], bool]] = {
            0x01: self._reset,
            0x02: self._set_burst,
            0x03: self._set_rate,
            0x04: self._set_frequency,
            0x05: self._set_amplitude,
            0x06: self._add_injection,
            0x08: lambda content: content == b"\x01\x01",
            0x09: lambda content: content in (b"\x01\x00", b"\x01\x01", b"\x01\x02", b"\x01\x03"),
            0x0C: lambda content: content in (b"\x01", b"\x02"),
            0x0D: lambda content: content in (b"\x01", b"\x02", b"\x03"),
        }
        self._reset(b"")

    def held_up(self) -> list[bytes]:
        """Return that data could not be sent."""
        return [_ack(Ack.HELD_UP)]

    def hear(self, data: bytes) -> list[bytes]:
        """Answer every whole message; refuse junk, and forget half a message after a while."""
        now_s = time.monotonic()
        answers = []
        if self._buffer and now_s - self._heard_s > TIMEOUT_S:
            self._buffer = b""
            answers.append(_ack(Ack.TIMEOUT))
        self._heard_s = now_s
        self._buffer += data
        is_junk = False
        while len(self._buffer) > 1 and len(self._buffer) >= (end := self._buffer[1] + 3):
            if self._buffer[end - 1] == self._buffer[0]:
                answers += self._answer(self._buffer[0], self._buffer[2 : end - 1])
                self._buffer = self._buffer[end:]
            else:
                self._buffer, is_junk = self._buffer[1:], True
        return [*answers, _ack(Ack.NOT_RECOGNISED)] if is_junk else answers

    def frame(self, frame: Frame) -> list[bytes]:
        """Return the data messages of all injections and groups."""
        scale = self._amplitude_a / self._description.pattern.current_a
        potentials = scale * self.potentials_of(frame.volts)
        pairs = list(self._injections)
        messages = np.zeros((len(pairs), GROUPS), DATA)
        messages["tag"] = messages["end"] = DATA_TAG
        messages["length"], messages["frequency_row"] = DATA_LENGTH, 1
        messages["group"] = np.arange(GROUPS) + 1
        messages["source"] = np.array([[source] for source, _ in pairs])
        messages["sink"] = np.array([[sink] for _, sink in pairs])
        step_s = 1 / (self.rate_hz * len(pairs))
        seconds = frame.time_s + step_s * np.arange(len(pairs))
        messages["time"] = np.rint(seconds[:, None] * 1e3).astype(np.int64) % 2**32
        said = np.zeros((len(pairs), GROUPS * CHANNELS), np.complex64)
        rows = [row for row, _ in self._injections.values()]
        signs = np.array([[sign] for _, sign in self._injections.values()])
        said[:, : potentials.shape[1]] = signs * potentials[rows]
        messages["volts"] = said.view(np.float32).reshape(len(pairs), GROUPS, CHANNELS, 2)
        self._burst -= self._burst > 0
        self.is_streaming = self.is_streaming and self._burst != 0
        return [each.tobytes() for each in messages.ravel()]

    def potentials_of(self, volts: FloatArray) -> NDArray[np.complex128]:
        """Return potentials (drives, electrodes) that have a scan's voltages (M,), the least."""
        return self._grounded.potentials(volts).astype(np.complex128)

    def _answer(self, tag: int, content: bytes) -> list[bytes]:
        if tag == DATA_TAG and content in (b"\0", b"\1"):
            return [_ack(Ack.DONE if self._start(content == b"\1") else Ack.NOT_EXECUTED)]
        if tag == 0xA1 and not content:
            self._reset(b"")
            self.is_streaming = False
            return [_ack(Ack.DONE), _ack(Ack.READY)]
        if tag == 0xD1 and not content:
            return [message(tag, rest=b"tactomo twin"), _ack(Ack.DONE)]
        if tag == 0xB2 and len(content) == 2 and content[0] in (1, 2, 3):
            return [_ack(Ack.DONE if content[1] == 1 else Ack.NOT_EXECUTED)]
        if tag != 0xB0 or not content or content[0] not in self._obey:
            return [_ack(Ack.NOT_RECOGNISED)]
        is_done = not self.is_streaming and self._obey[content[0]](content[1:])
        return [_ack(Ack.DONE if is_done else Ack.NOT_EXECUTED)]

    def _start(self, is_start: bool) -> bool:
        if is_start and not self._injections:
            return False
        self._burst = self._bursts or -1
        self.is_streaming = is_start
        return True

    def _reset(self, content: bytes) -> bool:
        self._injections: dict[tuple[int, int], tuple[int, int]] = {}  # to drive and its sign
        self._amplitude_a = self._description.pattern.current_a
        self._bursts, self._burst = 1, 0
        return not content

    def _set_burst(self, content: bytes) -> bool:
        if len(content) == 2:
            self._bursts = int.from_bytes(content, "big")
        return len(content) == 2

    def _set_rate(self, content: bytes) -> bool:
        rate_hz = _number(">f", content)
        if RATE_HZ[0] <= rate_hz <= RATE_HZ[1]:
            self.rate_hz = rate_hz
            return True
        return False

    def _set_frequency(self, content: bytes) -> bool:
        if len(content) != 11:
            return False
        least, most, count, scale = struct.unpack(">ffHB", content)
        is_possible = FREQUENCY_HZ[0] <= least <= most <= FREQUENCY_HZ[1]
        return is_possible and count == 1 and scale in (0, 1)

    def _set_amplitude(self, content: bytes) -> bool:
        amplitude_a = _number(">d", content)
        if AMPLITUDE_A[0] <= amplitude_a <= AMPLITUDE_A[1]:
            self._amplitude_a = amplitude_a
            return True
        return False

    def _add_injection(self, content: bytes) -> bool:
        """Take an injection that the skin's description has, either way round."""
        if len(content) != 2:
            return False
        source, sink = content
        place = self._drives.get((source, sink))
        if place is not None:
            self._injections[source, sink] = place
        return place is not None


def _ack(code: Ack) -> bytes:
    return message(ACK_TAG, code)


def _number(form: str, content: bytes) -> float:
    """Return a number, NaN where the content is not of its length."""
    if len(content) != struct.calcsize(form):
        return float("nan")
    return float(struct.unpack(form, content)[0])
