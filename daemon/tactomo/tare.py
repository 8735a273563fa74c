"""Taking a reference: the mean of some dual scans of the unloaded skin, and their noise.

Somebody who presses meanwhile would be averaged into the reference, so scans that move while they
are collected are refused. A press that lasts and stays the same cannot be told from a bare skin
whose reference is out of date: whoever tares is told how many contacts were shown meanwhile.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from concurrent.futures import Future
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tactomo_models import Reference
from tactomo_protocol import Channel

from tactomo.errors import CommandError

MOVEMENT_LIMIT: Final = 1e-3
"""Relative change of the voltages, rms, that a skin at rest does not reach within a second."""
SMALLEST_SHARE: Final = 1e-3
"""Voltages below this share of the largest one do not count for more than it when compared."""

Volts = NDArray[np.float64]


class Tare:
    """Collects dual scans until there are enough of them."""

    def __init__(self, scans: int) -> None:
        self.answers: list[Future[Mapping[str, Any]]] = []
        self._wanted = scans
        self._volts: dict[Channel, list[Volts]] = {}

    def add(self, volts: dict[Channel, Volts], needed: Collection[Channel]) -> bool:
        """Take one dual scan; returns whether there are enough of every needed channel now."""
        for channel, values in volts.items():
            self._volts.setdefault(channel, []).append(values)
        return all(len(self._volts.get(channel, ())) >= self._wanted for channel in needed)

    def reference(self) -> Reference:
        """Return the reference; raise CommandError where the scans moved too much for one."""
        stacks = {
            channel: np.stack(volts)
            for channel, volts in self._volts.items()
            if len(volts) >= self._wanted
        }
        for channel, stack in stacks.items():
            movement, noise = movement_and_noise(stack)
            if movement > max(noise, MOVEMENT_LIMIT):
                raise CommandError(
                    f"the {channel.name.lower()} channel moved by {movement:.2%} meanwhile "
                    f"(its noise is {noise:.2%})",
                    "take the load off the skin, then tare again",
                    "tare_refused",
                )
        return Reference.from_scans(stacks.get(Channel.MAGNITUDE), stacks.get(Channel.STRUCTURE))


def movement_and_noise(scans: Volts) -> tuple[float, float]:
    """Tell slow movement from noise in scans (n, M) of one channel, n at least 2.

    Half the mean square of successive differences estimates the noise whether or not there is a
    trend (von Neumann); what the variance has beyond it is movement. Both are relative to the
    voltages, rms over the measurements.
    """
    size = np.abs(scans.mean(axis=0))
    relative = scans / np.maximum(size, max(size.max() * SMALLEST_SHARE, np.finfo(float).tiny))
    noise = 0.5 * np.mean(np.diff(relative, axis=0) ** 2)
    movement = np.mean(relative.var(axis=0, ddof=1)) - noise
    return float(np.sqrt(max(movement, 0.0))), float(np.sqrt(noise))
