"""What companions say of a dual scan, and which of them has fallen silent."""

from __future__ import annotations

from typing import Final

from tactomo_models import SensorDescription
from tactomo_models.scans.companion_forces import CompanionReading

from tactomo.events import OnEvent
from tactomo.scans import DualScan

LOST_US: Final = 1_000_000
"""How long a companion may be without a reading before that is told."""


class Companions:
    """Reads the companions of one sensor. For use by the pipeline thread."""

    def __init__(self, description: SensorDescription, on_event: OnEvent) -> None:
        self._companions = description.companion
        self._on_event = on_event
        self._heard_us: dict[str, int] = {}

    def read(self, dual: DualScan) -> list[CompanionReading]:
        """Return what the companions that were heard say of a dual scan."""
        if not self._companions:
            return []
        now_us, felt = dual.scans[0].device_us, dual.companions
        known = self._companions
        self._tell_lost(now_us, {k for k, one in felt.items() if known[k].may_read(one.value)})
        return [
            CompanionReading(name, one.value, 1e-6 * now_us, 1e-6 * one.since_us)
            for name, one in felt.items()
        ]

    def _tell_lost(self, now_us: int, usable: set[str]) -> None:
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
                    "check its cable, and `index` and `limits` in the sensor description",
                    name,
                )
