"""What companions say of a dual scan, and which of them has fallen silent."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from tactomo_models import Reference, SensorDescription
from tactomo_models.scans.companion_forces import CompanionReading
from tactomo_protocol import Channel

from tactomo.events import OnEvent
from tactomo.imaging.tare import is_at_rest
from tactomo.scans import DualScan, Volts

LOST_US: Final = 1_000_000
"""How long a companion may be without a reading before that is told."""


class Companions:
    """Reads the companions of one sensor. For use by the pipeline thread.

    A reading that is older than its scan, or of a companion with a dead time or a lag, tells of the
    scan only where the sheets have been still since.
    """

    def __init__(self, description: SensorDescription, on_event: OnEvent) -> None:
        self._companions = description.companion
        self._on_event = on_event
        # the scans that all those since are like, and when they were taken, by the device's clock
        self._still: tuple[int, Volts] | None = None
        self._heard_us: dict[str, int] = {}

    def forget(self) -> None:
        """Forget for how long the sheets have been still: what comes does not follow on that."""
        self._still = None

    def read(
        self, dual: DualScan, volts: Volts, reference: Reference | None
    ) -> list[CompanionReading]:
        """Return the readings that tell of a dual scan; `reference` has the noise of its volts."""
        if not self._companions or not dual.scans:
            return []
        now_us = dual.scans[0].device_us
        still_us = self._still_us(now_us, volts, reference)
        felt = dual.companions
        self._tell_lost(now_us, {k for k, one in felt.items() if self._may_read(k, one.value)})
        return [
            CompanionReading(name, one.value, one.since_us > still_us) for name, one in felt.items()
        ]

    def _may_read(self, name: str, value: float) -> bool:
        return self._companions[name].may_read(value)

    def _still_us(self, now_us: int, volts: Volts, reference: Reference | None) -> int:
        """For how long the sheets have been still."""
        if self._still is not None:
            since_us, before = self._still
            then = replace(
                reference or Reference(None, None),
                magnitude=before.get(Channel.MAGNITUDE),
                structure=before.get(Channel.STRUCTURE),
            )
            if now_us >= since_us and is_at_rest(volts, then):
                return now_us - since_us
        self._still = now_us, volts
        return 0

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
