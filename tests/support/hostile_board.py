"""A board that keeps framing and checksum and breaks everything else.

Every packet's CRC is right, so all of it reaches the daemon's own code: headers at their edges and
beyond, rates and scales that cannot be, samples of every kind of nonsense, clocks and counters that
go anywhere, channels and sizes that no hello has declared. It changes its *act* every second or so,
and is a proper board in between, long enough to be tared and to make frames.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any
from zlib import crc32

import numpy as np
from cobs import cobs
from numpy.typing import NDArray
from pty_skin import PtySkin, Volts
from tactomo.twin.line import SerialLine
from tactomo_protocol import Acknowledge, AckStatus, Channel, Packet, UnknownPacket, encode

ACT_S = 1.0
PROPER_S = 1.5
PERIOD_S = 0.02
Change = Callable[[bytes], bytes]
Samples = NDArray[Any]

EDGES_U32 = (0, 1, 2**31 - 1, 2**31, 2**32 - 1)
EDGES_U64 = (0, 1, 2**31, 2**53 - 1, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
EDGES_F64 = (
    *(0.0, -0.0, 5e-324, 1e-308, 1e-30, 1e-3, 1.0, 20.0, 1e6, 1e30, 1e308, -1.0, -1e308),
    *(math.inf, -math.inf, math.nan),
)
SPECIAL_F32 = (0.0, 1e-45, 1e-38, 1.0, -1.0, 1e30, -1e30, 3e38, math.inf, -math.inf, math.nan)


def framed(content: bytes) -> bytes:
    """Return the frame of any content, its checksum right."""
    payload = content + crc32(content).to_bytes(4, "little")
    return b"\0" + bytes(cobs.encode(payload)) + b"\0"


def content_of(packet: Packet) -> bytes:
    """Return version, type and body."""
    return bytes(cobs.decode(encode(packet)[1:-1])[:-4])


@dataclass
class Act:
    """How the board behaves for a while: each function changes a scan's content, or the hello's."""

    name: str
    scan: Change = lambda content: content
    hello: Change = lambda content: content
    more: Callable[[], bytes] = bytes


class HostileBoard:
    """Plays on a `PtySkin`; the same `seed` gives the same acts.

    Args:
        skin: on one port or two.
        rest: voltages of the bare skin.
        scenes: further ones, for its proper moments.
        seed: of the acts.

    Attributes:
        packets: how many were sent.
        acts: the names of those that were played.

    """

    def __init__(self, skin: PtySkin, rest: Volts, scenes: list[Volts], seed: int) -> None:
        self.packets = 0
        self.acts: list[str] = []
        self._skin = skin
        self._rest = rest
        self._scenes = scenes
        self._random = np.random.default_rng(seed)

    def play(self, seconds: float, stop: Callable[[], bool] = lambda: False) -> None:
        """Play act after act for so long, or until `stop`."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and not stop():
            self.behave(PROPER_S)
            act = self._random.choice(np.array(self._acts(), dtype=object))
            self.acts.append(act.name)
            self._perform(act, ACT_S)

    def behave(self, seconds: float) -> None:
        """Be a proper board for a while."""
        for line in self._skin.each:
            self._say_hello(line, lambda content: content)
        scene = self._scenes[int(self._random.integers(len(self._scenes)))]
        volts = scene if self._random.random() < 0.3 else self._rest
        self._pace(seconds, lambda: self._skin.say(volts))

    def _perform(self, act: Act, seconds: float) -> None:
        for line in self._skin.each:
            self._say_hello(line, act.hello)
        self._pace(seconds, lambda: self._say(act))

    def _pace(self, seconds: float, say: Callable[[], object]) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            say()
            self.packets += 2
            time.sleep(PERIOD_S)

    def _say(self, act: Act) -> None:
        skin = self._skin
        counter = skin.counter
        skin.counter = (counter + 1) % 2**32
        for channel in Channel:
            scan = skin.scan(channel, counter, self._rest[channel])
            skin.send(skin.lines[channel], framed(act.scan(content_of(scan))) + act.more())

    def _say_hello(self, line: SerialLine, change: Change) -> None:
        self._skin.send(line, framed(change(content_of(self._skin.hello(line)))))

    def _acts(self) -> list[Act]:
        any_of, put = self._any_of, self._put
        acts = [
            Act("proper"),
            Act("clock", scan=put(8, lambda: struct.pack("<Q", any_of(EDGES_U64)))),
            Act("one clock", scan=put(8, _same(struct.pack("<Q", any_of(EDGES_U64))))),
            Act("two clocks", scan=self._two_clocks),
            Act("counter", scan=put(4, lambda: struct.pack("<I", any_of(EDGES_U32)))),
            Act("one counter", scan=put(4, _same(struct.pack("<I", any_of(EDGES_U32))))),
            Act("channel", scan=put(2, lambda: bytes([any_of((0, 1, 2, 255))]))),
            Act("swapped channels", scan=lambda c: c[:2] + bytes([1 - c[2]]) + c[3:]),
            Act("flags", scan=put(3, lambda: self._random.bytes(1))),
            Act("format", scan=put(16, lambda: bytes([any_of((0, 1, 2, 3, 4, 255))]))),
            Act("count", scan=put(18, lambda: struct.pack("<H", any_of((0, 1, 207, 209, 65535))))),
            Act("header", scan=lambda c: c[:2] + self._random.bytes(14) + c[16:]),
            Act("repeated", scan=lambda c: c, more=self._again),
            Act("rate", hello=put(16, lambda: struct.pack("<d", any_of(EDGES_F64)))),
            Act("scale", hello=put(8, lambda: struct.pack("<d", any_of(EDGES_F64)))),
            Act("hello's channels", hello=put(2, lambda: bytes([any_of(range(8))]))),
            Act("hello's bytes", hello=self._some_bytes),
            Act("strings", hello=lambda c: c[:25] + self._random.bytes(len(c) - 25)),
            Act("version", scan=put(0, lambda: bytes([any_of((0, 2, 255))]))),
            Act("type", scan=put(1, lambda: self._random.bytes(1))),
            Act("answers", more=self._answers),
            Act("any content", more=self._any_content),
        ]
        return acts + [
            Act(f"samples: {name}", scan=lambda c, make=make: self._samples(c, make))  # type: ignore[misc]
            for name, make in self._sample_kinds().items()
        ]

    def _sample_kinds(self) -> dict[str, Callable[[int], Samples]]:
        random = self._random
        return {
            "zero": lambda n: np.zeros(n, np.int32),
            "least": lambda n: np.full(n, -(2**31), np.int32),
            "largest": lambda n: np.full(n, 2**31 - 1, np.int32),
            "any": lambda n: random.integers(-(2**31), 2**31, n).astype(np.int32),
            "tiny": lambda n: random.integers(-1, 2, n).astype(np.int32),
            "one odd": lambda n: np.where(np.arange(n) == random.integers(n), 2**31 - 1, 10**6),
            "floats": lambda n: np.array([self._any_of(SPECIAL_F32) for _ in range(n)], np.float32),
            "NaN": lambda n: np.full(n, math.nan, np.float32),
            "infinite": lambda n: np.full(n, math.inf, np.float32),
            "any floats": lambda n: np.frombuffer(random.bytes(4 * n), np.float32),
        }

    def _samples(self, content: bytes, make: Callable[[int], Samples]) -> bytes:
        (count,) = struct.unpack_from("<H", content, 18)
        values = make(count)
        is_float = values.dtype == np.float32
        if is_float:  # as this board's hello would have to say, too
            for line in self._skin.each:
                self._say_hello(line, self._put(3, lambda: b"\3"))
        data = values.astype("<f4" if is_float else "<i4").tobytes()
        return content[:16] + (b"\3" if is_float else b"\2") + content[17:20] + data

    def _put(self, at: int, make: Callable[[], bytes]) -> Change:
        def change(content: bytes) -> bytes:
            new = make()
            return content[:at] + new + content[at + len(new) :]

        return change

    def _two_clocks(self, content: bytes) -> bytes:
        own_us, ahead_us = struct.unpack_from("<Q", content, 8)[0], 10**12
        return content[:8] + struct.pack("<Q", own_us + ahead_us * content[2]) + content[16:]

    def _some_bytes(self, content: bytes) -> bytes:
        changed = bytearray(content)
        for _ in range(int(self._random.integers(1, 4))):
            changed[int(self._random.integers(2, len(changed)))] = int(self._random.integers(256))
        return bytes(changed)

    def _again(self) -> bytes:
        scan = self._skin.scan(
            Channel.STRUCTURE, self._skin.counter - 1, self._rest[Channel.STRUCTURE]
        )
        older = replace(scan, counter=(scan.counter - 3) % 2**32)
        return encode(scan) + encode(scan) + encode(older)

    def _answers(self) -> bytes:
        request, command = (int(number) for number in self._random.integers(0, 256, 2))
        status = AckStatus(int(self._random.integers(4)))
        return encode(Acknowledge(request, command, status)) + encode(
            UnknownPacket(0x55, b"of the future")
        )

    def _any_content(self) -> bytes:
        kind = self._any_of((1, 2, 3, 0x70, 0x81))
        size = int(self._random.integers(0, 200))
        return framed(bytes([1, kind]) + self._random.bytes(size))

    def _any_of(self, values: Sequence[Any]) -> Any:
        return values[int(self._random.integers(len(values)))]


def _same(value: bytes) -> Callable[[], bytes]:
    return lambda: value
