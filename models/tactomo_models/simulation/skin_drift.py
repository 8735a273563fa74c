"""How a simulated skin drifts: temperature, and the creep of what was pressed.

Velostat's conductivity creeps under pressure, and does not quite come back after it, both with the
logarithm of time. A press of T seconds leaves, t seconds after its end, as many decades as lie
between t and t + T: that is how creep forgets as slowly as it was made. All of that counts from one
second on: before, a press counts as one of its instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.scene.press import Press
from tactomo_models.simulation.simulator import SkinSimulator

PRESSED: Final = 1e-3  # logarithm of a conductivity ratio from which a node counts as pressed
WANDER_S: Final = (3600.0, 28_800.0)  # periods of contact impedances: an hour to a shift


@dataclass(frozen=True, slots=True)
class SkinDrift:
    """What a skin's sheets do by themselves."""

    swing_k: float = 0.0  # temperature of a day, from its coldest to its warmest, in kelvin
    period_s: float = 86_400.0  # length of that day
    step_k: float = 0.0  # temperature that has been added at once, in kelvin
    per_kelvin: float = 0.02  # relative change of conductivity per kelvin
    # share of that change that differs from place to place (standard deviation)
    uneven: float = 0.1
    # what a decade of time adds under pressure, as a share of the pressed change, and leaves
    # behind, as a share of the bare conductivity or of the pressed change if less
    creep: float = 0.0
    impedance: float = 0.0  # amplitude by which contact impedances wander, of their logarithm

    def warming(self, time_s: float) -> float:
        """Logarithm of the factor on the sheets' conductivity; the skin starts at a middle one."""
        swing_k = self.swing_k / 2 * np.sin(2 * np.pi * time_s / self.period_s)
        return float(self.per_kelvin * (swing_k + self.step_k))

    def left(self, ratio: FloatArray, decades: FloatArray | float) -> FloatArray:
        """Factor on the bare conductivity that a press of this conductivity ratio leaves."""
        return 1 + self.creep * decades * np.minimum(1.0, np.abs(ratio - 1)) * np.sign(ratio - 1)

    def grown(self, ratio: FloatArray, pressed_s: FloatArray | float) -> FloatArray:
        """The conductivity ratio of what has been pressed for so long."""
        return 1 + (ratio - 1) * (1 + self.creep * np.log10(1 + pressed_s))


def decades_left(pressed_s: FloatArray | float, ago_s: FloatArray | float) -> FloatArray:
    """Decades of creep that are left so long after a press of so long; 0 where nobody sees them."""
    decades = np.asarray(np.log10(1 + pressed_s / (np.asarray(ago_s) + 1)))
    return np.where(decades < 0.05, 0.0, decades)


class DriftingSkin:
    """A simulated skin that remembers what pressed it, and knows the time.

    Args:
        simulator: the skin as it was made.
        seed: of how unevenly it drifts.
    """

    def __init__(
        self, simulator: SkinSimulator, drift: SkinDrift | None = None, seed: int = 0
    ) -> None:
        # may be replaced between two calls, by another thread, too
        self.drift = drift or SkinDrift()
        self._simulator = simulator
        self._seed = seed
        self._swing = (0.0, 0.0)
        self._swings_from_s = 0.0
        self._creep = {name: _Creep() for name in simulator.description.channels}
        rng = np.random.default_rng([seed, 7])
        electrodes = simulator.description.electrode_count
        self._wander_s = rng.uniform(*WANDER_S, electrodes)
        self._phase = rng.uniform(0, 2 * np.pi, electrodes)

    def voltages(self, presses: Sequence[Press], time_s: float) -> dict[Channel, FloatArray]:
        """Noise-free volts (M,) of each channel under these presses; time only goes on."""
        drift = self.drift
        if drift == SkinDrift():
            return self._simulator.voltages(presses)
        if self._swing != (drift.swing_k, drift.period_s):  # a day begins at its middle
            self._swing, self._swings_from_s = (drift.swing_k, drift.period_s), time_s
        return {
            name: self._pressed(name, drift, tuple(presses), time_s)
            * np.exp(self._by_itself(name, drift, time_s))
            for name in self._simulator.description.channels
        }

    def _pressed(
        self, name: Channel, drift: SkinDrift, presses: tuple[Press, ...], time_s: float
    ) -> FloatArray:
        if not drift.creep:
            return self._simulator.voltages(presses)[name]
        return self._creep[name].volts(self._simulator, name, drift, presses, time_s)

    def _by_itself(self, name: Channel, drift: SkinDrift, time_s: float) -> FloatArray | float:
        """Logarithms (M,) of what temperature and contact impedances make of the voltages."""
        change: FloatArray | float = 0.0
        if warming := drift.warming(time_s - self._swings_from_s):
            change = change - warming + warming * drift.uneven * self._unevenly[name]
        if drift.impedance:
            angle = 2 * np.pi * time_s / self._wander_s + self._phase
            now = drift.impedance * (np.sin(angle) - np.sin(self._phase))
            change = change + self._by_electrode @ now
        return change

    @cached_property
    def _unevenly(self) -> dict[Channel, FloatArray]:
        names = self._simulator.description.channels
        rngs = [np.random.default_rng([self._seed, number]) for number in range(len(names))]
        fields = [self._simulator.smooth_field(rng) for rng in rngs]
        return {
            name: self._simulator.sensitivity(field)
            for name, field in zip(names, fields, strict=True)
        }

    @cached_property
    def _by_electrode(self) -> FloatArray:
        each = np.eye(self._simulator.description.electrode_count)
        return np.stack([self._simulator.sensitivity(impedance=one) for one in each], axis=1)


class _Creep:
    """What presses have done to one channel's sheet, node by node, and the voltages of that."""

    def __init__(self) -> None:
        self._scene: tuple[Press, ...] | None = None
        self._volts: FloatArray | None = None
        self._fresh_until_s = self._last_s = 0.0

    def volts(
        self,
        simulator: SkinSimulator,
        name: Channel,
        drift: SkinDrift,
        presses: tuple[Press, ...],
        time_s: float,
    ) -> FloatArray:
        """Volts (M,) of the sheet; solved anew where what presses or what is left has changed."""
        if self._scene != presses:
            self._turn(simulator.ratio(name, presses), presses, time_s)
        self._pressed_s += (time_s - self._last_s) * self._is_pressed
        self._left_s[self._is_pressed] = self._last_s = time_s
        if self._volts is None or time_s >= self._fresh_until_s:
            decades = np.where(
                self._is_pressed, 0.0, decades_left(self._pressed_s, time_s - self._left_s)
            )
            self._pressed_s[(decades == 0) & ~self._is_pressed] = 0.0
            left = drift.left(self._strongest, decades)
            self._volts = simulator.solve(left * drift.grown(self._ratio, self._pressed_s))
            # For a fiftieth of that time, creep that goes by its logarithm hardly changes.
            self._fresh_until_s = time_s + 0.02 * (time_s - self._turned_s + 1)
        return self._volts

    def _turn(self, ratio: FloatArray, presses: tuple[Press, ...], time_s: float) -> None:
        """Something is pressed, moved or let go."""
        if self._scene is None:
            self._pressed_s, self._left_s = np.zeros_like(ratio), np.zeros_like(ratio)
            self._strongest, self._last_s = np.ones_like(ratio), time_s
        self._scene, self._ratio, self._turned_s, self._volts = presses, ratio, time_s, None
        self._is_pressed = np.abs(np.log(ratio)) > PRESSED
        begun = self._is_pressed & (self._pressed_s == 0)
        self._strongest[begun] = 1.0
        stronger = np.abs(np.log(ratio)) > np.abs(np.log(self._strongest))
        self._strongest[stronger] = ratio[stronger]
