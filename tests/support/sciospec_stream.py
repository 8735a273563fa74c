"""What a Sciospec instrument says, byte for byte, without an instrument or a line."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from tactomo.protocols.sciospec import requests
from tactomo.twin.foreign import Frame
from tactomo.twin.sciospec import SciospecSpeaker
from tactomo_models import SensorDescription

PERIOD_S = 0.05


def started(description: SensorDescription) -> SciospecSpeaker:
    """Return an instrument that was asked for all that is wanted, and measures."""
    speaker = SciospecSpeaker(description, 1 / PERIOD_S)
    for request in requests(description):
        assert speaker.hear(request.message) == [b"\x18\x01\x83\x18"], request.what
    assert speaker.is_streaming
    return speaker


def frames(
    description: SensorDescription, scans: Iterable[NDArray[np.float64]], begin_s: float = 1.0
) -> list[list[bytes]]:
    """Return the messages of each scan's frame; scans are (M,) volts."""
    speaker = started(description)
    return [
        speaker.frame(Frame(volts, None, begin_s + PERIOD_S * number))
        for number, volts in enumerate(scans)
    ]


def used(messages: Sequence[bytes], groups: int = 1) -> list[bytes]:
    """Return those of groups that have electrodes."""
    return [each for each in messages if each[2] <= groups]
