"""The simulated skin: noise-free voltages of both channels for what presses on it.

It solves on a finer mesh than the one that reconstructs, with other nodes, and its sheet and
electrodes may be uneven: data must never come from the model that inverts them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import scan_voltages, solve_bare_sheet, transfer_resistances
from tactomo_models.physics.compiled_sheet import reflection
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.press import Press, strongest
from tactomo_models.sensor.description import SensorDescription


class SkinSimulator:
    """Voltages of a pressed skin, in volts.

    Args:
        description: the sensor.
        spacing_m: distance of the mesh nodes; two thirds of the map's if None.
        unevenness: standard deviation of the sheet's smooth conductivity error (0.05 is 5 %).
        impedance_spread: standard deviation of the logarithm of the contact impedances.
        seed: of that unevenness.
    """

    def __init__(
        self,
        description: SensorDescription,
        spacing_m: float | None = None,
        *,
        unevenness: float = 0.0,
        impedance_spread: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.description = description
        #: distance of the nodes
        self.spacing_m = spacing_m or description.spacing_m * 2 / 3
        self._sheet = mesh_sheet(description, self.spacing_m)
        rng = np.random.default_rng(seed)
        x, y = self._sheet.mesh.p
        self._conductivity = 1 + unevenness * smooth_noise(x, y, description.width_m / 4, rng)
        spread = impedance_spread * rng.standard_normal(description.electrode_count)
        self._impedance = np.exp(spread)
        bare = solve_bare_sheet(
            description, self._sheet, self._conductivity, self._impedance, quick=True
        )
        #: its forward model; P of its mesh's nodes can be pressed
        self.forward = ForwardModel(description, bare)
        self._background = self._conductivity[bare.pressable]
        self._x, self._y = bare.points[:, bare.pressable]
        self._last: tuple[tuple[Press, ...], dict[Channel, FloatArray]] | None = None

    def voltages(self, presses: Sequence[Press]) -> dict[Channel, FloatArray]:
        """Noise-free voltages (M,) of each channel the sensor has.

        An unchanged scene costs nothing; a moved contact costs milliseconds by its area.
        """
        scene = tuple(presses)
        if self._last is None or self._last[0] != scene:
            channels = self.description.channels
            self._last = (scene, {name: self.solve(self.ratio(name, scene)) for name in channels})
        return self._last[1]

    def forces_n(self, presses: Sequence[Press]) -> dict[str, float]:
        """The force in newtons that each companion of the sensor feels."""
        pressure, coverage = strongest(presses, self._x, self._y, self.spacing_m)
        return self.forces_under(pressure, coverage)

    def forces_under(self, pressure_kpa: FloatArray, coverage: FloatArray) -> dict[str, float]:
        """The same for any pressure at the nodes, as `voltages_under` has it."""
        return {
            name: float(self.forward.newtons_per_kpa(one.region_m) @ (pressure_kpa * coverage))
            for name, one in self.description.companion.items()
        }

    def voltages_under(
        self,
        pressure_kpa: FloatArray,  # (P,) where the nodes are covered
        coverage: FloatArray,  # (P,) share of each node's neighbourhood that is covered, 0 to 1
    ) -> dict[Channel, FloatArray]:
        """Noise-free voltages (M,) of each channel for any pressure at the nodes."""
        return {
            name: self.solve(conductivity_ratio(self.description, name, pressure_kpa, coverage))
            for name in self.description.channels
        }

    def ratio(self, channel: Channel, presses: Sequence[Press]) -> FloatArray:
        """Conductivity over the bare sheet's at the mesh's P nodes that can be pressed."""
        pressure, coverage = strongest(presses, self._x, self._y, self.spacing_m)
        return conductivity_ratio(self.description, channel, pressure, coverage)

    def solve(self, ratio: FloatArray) -> FloatArray:
        """Noise-free volts (M,) where those nodes conduct so many times better, (P,)."""
        change = self._background * (ratio - 1)
        least, most = float(ratio.min()), float(ratio.max())
        solved = self.forward.solve(change, float(reflection(most if least * most > 1 else least)))
        return solved.voltages * self.forward.volts_per_unit

    def smooth_field(self, rng: np.random.Generator) -> FloatArray:
        """A random field (N,) at all of the mesh's nodes, of unit standard deviation."""
        x, y = self._sheet.mesh.p
        return smooth_noise(x, y, self.description.width_m / 4, rng)

    def sensitivity(
        self,
        # (N,) change of the logarithm of conductivity at the mesh's nodes
        field: FloatArray | float = 0.0,
        impedance: FloatArray | float = 0.0,  # (L,) that of the contact impedances
    ) -> FloatArray:
        """By how much the logarithms of the bare sheet's voltages (M,) change."""
        step = 0.01  # central differences: the error is of the order of its square
        up, down = (self._directly(side * step, field, impedance) for side in (1, -1))
        with np.errstate(divide="ignore", invalid="ignore"):
            change = np.log(up / down) / (2 * step)
        return np.nan_to_num(change, posinf=0.0, neginf=0.0)

    def _directly(
        self, step: float, field: FloatArray | float, impedance: FloatArray | float
    ) -> FloatArray:
        conductivity = self._conductivity * np.exp(step * np.asarray(field))
        by_triangle = conductivity[self._sheet.mesh.t].mean(axis=0)
        contacts = self._impedance * np.exp(step * np.asarray(impedance))
        transfer = transfer_resistances(self.description, self._sheet, by_triangle, contacts)
        return scan_voltages(self.description, transfer)


def conductivity_ratio(
    description: SensorDescription, channel: Channel, pressure_kpa: FloatArray, coverage: FloatArray
) -> FloatArray:
    """Conductivity over the bare sheet's at each point, same shape.

    A point that an indenter covers in part conducts in between, see `blended`.
    """
    if channel == Channel.MAGNITUDE:
        assert description.magnitude is not None
        full = 1 + description.magnitude.response.change(pressure_kpa)
    else:
        assert description.structure is not None
        response = description.structure.response
        saturated = np.where(pressure_kpa > 0, description.structure.saturated_ratio, 1.0)
        full = response.ratio(pressure_kpa) if response else saturated
    return blended(full, coverage)


def blended(full: FloatArray, coverage: FloatArray) -> FloatArray:
    """Conductivity ratios of points of which a share (0 to 1) conducts `full` times as well.

    It is the power mean whose exponent is the reflection; see there.
    """
    k = reflection(full)
    even = np.abs(k) < 1e-6  # its limit, the geometric mean
    power = np.where(even, 1.0, k)
    mixed = np.log1p(coverage * np.expm1(power * np.log(full))) / power
    return np.asarray(np.exp(np.where(even, coverage * np.log(full), mixed)))


def noisy(
    volts: Mapping[Channel, FloatArray],  # (..., M) of each channel
    noise_v: Mapping[Channel, FloatArray | float],  # standard deviation of each channel's noise
    rng: np.random.Generator,
    *scans: int,  # shape of what is drawn, but for the voltages
) -> dict[Channel, FloatArray]:
    """Volts (*scans, M) of each channel, with a noise of one size on every voltage of a scan."""
    return {
        name: v + noise_v[name] * rng.standard_normal((*scans, v.shape[-1]))
        for name, v in volts.items()
    }


def smooth_noise(
    x: FloatArray, y: FloatArray, length_m: float, rng: np.random.Generator
) -> FloatArray:
    """Random field of unit standard deviation that varies over about `length_m`."""
    waves = 64
    direction = rng.normal(scale=1 / length_m, size=(waves, 2))
    phase = rng.uniform(0, 2 * np.pi, waves)
    return np.asarray(
        np.cos(np.outer(x, direction[:, 0]) + np.outer(y, direction[:, 1]) + phase).sum(axis=1)
        * np.sqrt(2 / waves)
    )
