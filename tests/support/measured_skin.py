"""Measured scans in the place of a simulated skin: what the twin's device says is what one said."""

from __future__ import annotations

from collections.abc import Sequence

from tactomo_models import Press
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel


class MeasuredSkin:
    """Says scans (T, M), volts, one after another, again and again, whatever presses."""

    def __init__(self, scans: FloatArray) -> None:
        self._scans = scans
        self.said = 0

    def voltages(self, presses: Sequence[Press]) -> dict[Channel, FloatArray]:
        # The first call is the converter's, which asks how large voltages are.
        scan = self._scans[max(self.said - 1, 0) % len(self._scans)]
        self.said += 1
        return {Channel.STRUCTURE: scan}
