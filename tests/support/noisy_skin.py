"""A simulated skin behind a noisy converter."""

from __future__ import annotations

import numpy as np
from tactomo_models import Press, Reference, SkinSimulator
from tactomo_models.arrays import FloatArray


class Skin:
    """A simulated skin with converter noise, on a finer mesh than the one that reconstructs."""

    def __init__(self, simulator: SkinSimulator, noise_share: float = 1e-3) -> None:
        self._simulator = simulator
        self._noise_share = noise_share
        self._rng = np.random.default_rng(7)

    def scan(self, *presses: Press) -> dict[str, FloatArray]:
        """Voltages of each channel, with noise of the same size in volts on each of them."""
        clean = self._simulator.voltages(presses)
        return {
            name: volts + self._noise_share * rms(volts) * self._rng.standard_normal(len(volts))
            for name, volts in clean.items()
        }

    def reference(self, scans: int = 20, *presses: Press) -> Reference:
        """Average of some scans."""
        taken = [self.scan(*presses) for _ in range(scans)]
        channels = {name: np.array([scan[name] for scan in taken]) for name in taken[0]}
        return Reference.from_scans(channels.get("magnitude"), channels.get("structure"))


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
