"""What of a dual scan was measured: companions that have fallen silent, converters that are frozen.

A frozen converter's scans repeat earlier ones while their counter goes on, see
`tactomo_models.scans.repeats`. A channel that is frozen all through its first tare cannot be told
from a source without noise.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from tactomo_models import Reference, SensorDescription
from tactomo_models.scans.companion_forces import CompanionReading
from tactomo_models.scans.repeats import Repeats
from tactomo_models.sensor.pattern import Pairs

from tactomo.events import OnEvent
from tactomo.scans import DualScan, Volts


class FrozenConverters:
    """Leaves out what repeats itself. Belongs to one thread."""

    def __init__(self, pairs: Pairs, on_event: OnEvent) -> None:
        self._on_event = on_event
        self._repeats = Repeats(pairs)

    def forget(self) -> None:
        """Take the next dual scan for the first one."""
        self._repeats.forget()

    def without(self, volts: Volts, reference: Reference | None, is_taring: bool) -> Volts:
        """What was measured of a dual scan; told when that changes for a channel.

        A channel that repeats itself is left out; voltages of one that does so in part are NaN.
        While somebody tares, a channel is not left out for having less noise than at the last tare.
        """
        measured: Volts = {}
        for channel, scan in volts.items():
            found = self._repeats.find(channel, scan, reference)
            if found is None or (is_taring and found.is_another):
                measured[channel] = scan
                continue
            parts, repeated, _ = found
            if repeated.any():
                what = f"{channel} {', '.join(parts) or 'scans'}"
                self._on_event(
                    "converter_frozen",
                    f"{what} repeat earlier ones; maps go on without them",
                    "switch that channel's board off and on; if its scans still repeat, its "
                    "converter or firmware is at fault; if its noise really fell to a tenth, tare",
                    channel,
                )
            else:
                self._on_event("converter_back", f"{channel} scans are measured again", "", channel)
            if (left := found.without(scan)) is not None:
                measured[channel] = left
        return measured


LOST_US: Final = 1_000_000
"""How long a companion may be without a reading before that is told."""


class Companions:
    """Reads the companions of one sensor. For use by the pipeline thread."""

    def __init__(self, description: SensorDescription, on_event: OnEvent) -> None:
        self._companions = description.companion
        self._on_event = on_event
        self._heard_us: dict[str, int] = {}

    def read(self, dual: DualScan) -> list[CompanionReading]:
        """Return what the companions that were heard within their limits say of a dual scan."""
        if not self._companions:
            return []
        now_us, known = dual.scans[0].device_us, self._companions
        felt = {k: one for k, one in dual.companions.items() if known[k].may_read(one.value)}
        self._tell_lost(now_us, felt.keys())
        return [
            CompanionReading(name, one.value, 1e-6 * now_us, 1e-6 * one.since_us)
            for name, one in felt.items()
        ]

    def _tell_lost(self, now_us: int, usable: Collection[str]) -> None:
        for name in self._companions:
            heard_us = self._heard_us.get(name, now_us)
            if name in usable or heard_us > now_us:  # a clock that went back begins anew
                heard_us = now_us
            self._heard_us[name] = heard_us
            if name in usable:
                self._on_event("companion_back", f"{name} reads again within its limits", "", name)
            elif now_us - heard_us > LOST_US:
                self._on_event(
                    "companion_lost",
                    f"companion {name} has no reading within its limits; the sheets stand alone",
                    "check its cable, and `index` and `limits` in the sensor description; if it "
                    "repeats one reading, switch it off and on",
                    name,
                )
