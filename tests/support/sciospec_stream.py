"""What a Sciospec instrument says, byte for byte, without an instrument or a line."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tactomo.protocols.sciospec import requests
from tactomo.twin.foreign import Frame
from tactomo.twin.sciospec import SciospecEmulator
from tactomo_models import SensorDescription
from tactomo_models.arrays import FloatArray

PERIOD_S = 0.05


def started(description: SensorDescription) -> SciospecEmulator:
    """Return an instrument that was asked for all that is wanted, and measures."""
    emulator = SciospecEmulator(description, 1 / PERIOD_S)
    for request in requests(description):
        assert emulator.hear(request.message) == [b"\x18\x01\x83\x18"], request.what
    assert emulator.is_streaming
    return emulator


def frames(
    description: SensorDescription, scans: Iterable[FloatArray], begin_s: float = 1.0
) -> list[list[bytes]]:
    """Return the messages of each scan's frame; scans are (M,) volts."""
    emulator = started(description)
    return [
        emulator.frame(Frame(volts, begin_s + PERIOD_S * number))
        for number, volts in enumerate(scans)
    ]


def used(messages: Sequence[bytes], groups: int = 1) -> list[bytes]:
    """Return those of groups that have electrodes."""
    return [each for each in messages if each[2] <= groups]
