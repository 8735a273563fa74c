"""A converter that is frozen: its scans repeat bit for bit while their counter goes on.

Noise makes every scan another one. Where the scans of a tare had noise, one that is the last one
over again was not measured, however whole its packet: what it says of the skin is of another time.
A channel that is frozen all through its first tare cannot be told from a source without noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from tactomo_models import Reference
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel

from tactomo.events import OnEvent
from tactomo.scans import Volts


class FrozenConverters:
    """Leaves out channels that repeat themselves. Belongs to one thread."""

    def __init__(self, on_event: OnEvent) -> None:
        self._on_event = on_event
        self._last: Volts = {}

    def without(self, volts: Volts, reference: Reference | None) -> Volts:
        """The channels of a dual scan that were measured; told when that changes for one."""
        repeats = {
            channel
            for channel, scan in volts.items()
            if channel in self._last
            and np.array_equal(scan, self._last[channel])
            and _is_noisy(reference, channel, scan)
        }
        self._last = self._last | volts
        for channel in volts:
            if channel in repeats:
                self._on_event(
                    "converter_frozen",
                    f"{channel} scans repeat bit for bit; maps go on without them",
                    "switch that channel's board off and on; if it stays so, its converter or "
                    "firmware is at fault",
                    channel,
                )
            else:
                self._on_event("converter_back", f"{channel} scans are measured again", "", channel)
        return {channel: scan for channel, scan in volts.items() if channel not in repeats}


def _is_noisy(reference: Reference | None, channel: Channel, scan: FloatArray) -> bool:
    """Whether scans at rest differed in most voltages, by more than a mean of equals rounds."""
    noise: Any = getattr(reference, f"{channel}_noise", None)
    if reference is None or not reference.is_noise_measured or noise is None:
        return False
    return float(np.median(noise)) > 0 and bool(np.any(noise > 1e-12 * np.abs(scan)))
