"""Simulated skins to evaluate on: each one as uneven as a real one, and no inverse's own model.

A scene has two sheets of its own, each with uneven conductivity and uneven electrodes. They are
solved directly on a mesh that is finer than the one that inverts and shares next to no node with
it; conductivity is constant in each triangle and as sharp at an outline as the triangles allow,
while what inverts has it linear between its nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactomo_models.description import (
    MagnitudeChannel,
    MagnitudeResponse,
    Modality,
    SensorDescription,
    StructureChannel,
    StructureResponse,
)
from tactomo_models.forward import scan_voltages, transfer_resistances, volts_per_unit
from tactomo_models.mesh import mesh_sheet
from tactomo_models.scene import Press, Shape, strongest
from tactomo_models.simulator import conductivity_ratio, smooth_noise

FloatArray = NDArray[np.float64]
Volts = dict[Modality, FloatArray]

SPACING_SHARE = 0.58  # of the map's nodes' distance: 1.74 mm on the paper's sensor
REFINEMENTS = 3  # at the electrodes' ends, one more than what inverts
UNEVENNESS = 0.05  # standard deviation of a sheet's smooth conductivity error
IMPEDANCE_SPREAD = 0.2  # standard deviation of the logarithm of the contact impedances
CELL_SAMPLES = 5  # per side of a map cell, where the truth's coverage is averaged


class FineMesh:
    """Mesh that scenes are simulated on; made once, it serves them all.

    Attributes:
        sheet: the mesh, T triangles.
        centres: (2, T) their centroids, metres.
        samples: (2, T, 4) points in each, each for a quarter of it.
        sample_m: about the distance of those points.
    """

    def __init__(self, description: SensorDescription) -> None:
        spacing_m = SPACING_SHARE * description.width_m / (description.map.nodes_x - 1)
        self.sheet = mesh_sheet(description, spacing_m, REFINEMENTS)
        corners = self.sheet.mesh.p[:, self.sheet.mesh.t]  # (2, 3, T)
        self.centres = corners.mean(axis=1)
        # The four congruent parts that the middles of the sides cut a triangle into.
        outer = (corners + self.centres[:, None]) / 2
        self.samples = np.concatenate([self.centres[:, None], outer], axis=1).transpose(0, 2, 1)
        self.sample_m = spacing_m / 2


class UnevenSkin:
    """The sheets of one sensor, uneven in their own way, and what they show of presses.

    Args:
        description: the sensor; its responses are the true ones.
        mesh: made for a sensor of the same geometry.
        rng: draws the unevenness.
    """

    def __init__(
        self, description: SensorDescription, mesh: FineMesh, rng: np.random.Generator
    ) -> None:
        self.description = description
        self._mesh = mesh
        self._background: Volts = {}
        self._impedance: Volts = {}
        length_m = description.width_m / 4
        for name in description.modalities:
            noise = smooth_noise(mesh.centres[0], mesh.centres[1], length_m, rng)
            self._background[name] = 1 + UNEVENNESS * noise
            spread = IMPEDANCE_SPREAD * rng.standard_normal(description.electrode_count)
            self._impedance[name] = np.exp(spread)

    def voltages(self, presses: Sequence[Press]) -> Volts:
        """Noise-free voltages (M,) of each channel, volts."""
        x, y = self._mesh.samples
        pressure, coverage = strongest(presses, x, y, self._mesh.sample_m)
        volts: Volts = {}
        for name in self.description.modalities:
            ratio = conductivity_ratio(self.description, name, pressure, coverage)
            change = np.exp(np.log(ratio).mean(axis=1))
            transfer = transfer_resistances(
                self.description,
                self._mesh.sheet,
                self._background[name] * change,
                self._impedance[name],
            )
            relative = scan_voltages(self.description, transfer)
            volts[name] = relative * volts_per_unit(self.description)
        return volts


@dataclass(frozen=True)
class TrueContact:
    """What really presses in one place.

    Attributes:
        x_m, y_m: its centroid.
        area_m2: its area.
        pressure_kpa: its pressure.
        magnitude: |relative conductivity change| of the magnitude channel under it.
        shape: of its indenter.
    """

    x_m: float
    y_m: float
    area_m2: float
    pressure_kpa: float
    magnitude: float
    shape: Shape


@dataclass(frozen=True)
class Truth:
    """What a perfect reconstruction of a scene would show.

    Attributes:
        map: (nodes_y, nodes_x) |relative conductivity change| of the magnitude channel, averaged
            over the cell around each node.
        pressed: (nodes_y, nodes_x) share of each cell that is pressed.
        contacts: one for each indenter.
    """

    map: FloatArray
    pressed: FloatArray
    contacts: tuple[TrueContact, ...]


def truth_of(description: SensorDescription, presses: Sequence[Press]) -> Truth:
    """What a map of these presses should be; needs the sensor's magnitude channel."""
    assert description.magnitude is not None
    response = description.magnitude.response
    x, step_x = _cell_samples(description.map_x_m)
    y, step_y = _cell_samples(description.map_y_m)
    pressure, coverage = strongest(presses, *np.meshgrid(x, y), max(step_x, step_y))
    magnitude = coverage * np.abs(response.change(pressure))
    return Truth(
        map=_over_cells(magnitude),
        pressed=_over_cells(coverage),
        contacts=tuple(
            TrueContact(
                x_m=press.x_m,
                y_m=press.y_m,
                area_m2=float(
                    strongest([press], *np.meshgrid(x, y), max(step_x, step_y))[1].sum()
                    * (step_x * step_y)
                ),
                pressure_kpa=press.pressure_kpa,
                magnitude=float(np.abs(response.change(np.array(press.pressure_kpa)))),
                shape=press.shape,
            )
            for press in presses
        ),
    )


def _cell_samples(nodes_m: FloatArray) -> tuple[FloatArray, float]:
    """Points along one axis, `CELL_SAMPLES` around each node, and their distance."""
    step = (nodes_m[1] - nodes_m[0]) / CELL_SAMPLES
    around = (np.arange(CELL_SAMPLES) - (CELL_SAMPLES - 1) / 2) * step
    return (nodes_m[:, None] + around).ravel(), float(step)


def _over_cells(fine: FloatArray) -> FloatArray:
    rows, columns = (n // CELL_SAMPLES for n in fine.shape)
    cells = fine.reshape(rows, CELL_SAMPLES, columns, CELL_SAMPLES)
    return np.asarray(cells.mean(axis=(1, 3)))


def with_opposite_magnitude(description: SensorDescription) -> SensorDescription:
    """The same sensor, with a magnitude channel that changes by as much the other way."""
    assert description.magnitude is not None
    response = description.magnitude.response
    turned = MagnitudeResponse(
        pressure_kpa=response.pressure_kpa,
        relative_change=tuple(-change for change in response.relative_change),
    )
    return description.model_copy(update={"magnitude": MagnitudeChannel(response=turned)})


def with_contrast(description: SensorDescription, contrast: float) -> SensorDescription:
    """The same sensor, whose structure channel saturates at another contrast (at least 1).

    Its ratio is the contrast where pressure raises the conductivity, else one over it.
    """
    assert description.structure is not None
    response, old = description.structure.response, description.structure.saturated_ratio
    ratio = contrast if old > 1 else 1 / contrast
    if response is None:
        channel = StructureChannel(conductivity_ratio=ratio)
    else:  # the logarithm of the whole response, stretched
        power = np.log(ratio) / np.log(old)
        stretched = tuple(float(r**power) for r in response.conductivity_ratio)
        channel = StructureChannel(
            response=StructureResponse(
                pressure_kpa=response.pressure_kpa, conductivity_ratio=stretched
            )
        )
    return description.model_copy(update={"structure": channel})
