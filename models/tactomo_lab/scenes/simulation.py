"""Simulated skins to evaluate on: each one as uneven as a real one, and no inverse's own model.

A scene has two sheets of its own, each with uneven conductivity and uneven electrodes. They are
solved directly on a mesh that is finer than the one that inverts and shares next to no node with
it; it is finer still along the outlines of what presses. Conductivity is constant in each triangle
and jumps at an outline, while what inverts has it linear between its nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import skfem
from scipy.spatial.distance import pdist
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import (
    exchanged,
    scan_voltages,
    transfer_resistances,
    volts_per_unit,
)
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet, with_electrodes
from tactomo_models.scene.press import Press, Shape, strongest
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.response import (
    MagnitudeChannel,
    MagnitudeResponse,
    StructureChannel,
    StructureResponse,
)
from tactomo_models.simulation.simulator import conductivity_ratio, smooth_noise
from tactomo_protocol import Channel

Volts = dict[Channel, FloatArray]
Warp = Callable[[SheetMesh], SheetMesh]

SPACING_SHARE = 0.58  # of the map's nodes' distance: 1.74 mm on the paper's sensor
REFINEMENTS = 3  # at the electrodes' ends, one more than what inverts
SHARP_M = 1e-9  # width of an outline: a point lies inside or outside
OUTLINE_REFINEMENTS = 3  # to 0.2 mm: voltage changes are right to 1 %; without, to 10 %
UNEVENNESS = 0.05
IMPEDANCE_DEVIATION = 0.2
ELECTRODE_REACH_M = 0.008  # of the stretch around an electrode that sits off its place, at most
REACH_SHARE = 0.30  # of the electrodes' distance: neighbours do not pull at each other
CELL_SAMPLES = 5  # per side of a map cell, where the truth's coverage is averaged


@lru_cache(maxsize=1)
def fine_mesh(description: SensorDescription) -> SheetMesh:
    """Mesh that scenes of a sensor are simulated on; made once, it serves them all."""
    spacing_m = SPACING_SHARE * description.spacing_m
    return mesh_sheet(description, spacing_m, REFINEMENTS)


@dataclass(frozen=True)
class SheetState:
    """What has become of a sheet; as it was made by default."""

    warming: float = 0.0  #: relative change of its conductivity, everywhere alike
    drift: float = 0.0  #: standard deviation of a smooth relative change of its conductivity
    impedance: tuple[float, ...] = ()  #: (L,) factors on its contact impedances; 1 where empty
    #: (L,) the electrode that each of the device's leads is on; its own where empty
    leads: tuple[int, ...] = ()


AS_MADE = SheetState()


@dataclass(frozen=True, eq=False)
class UnevenSheet:
    """One sheet, uneven in its own way."""

    seed: int  #: of the smooth field of its conductivity errors, the same on whatever mesh
    unevenness: float  #: standard deviation of that field
    impedance: FloatArray  #: (L,) contact impedances, relative to the description's

    def voltages(
        self,
        description: SensorDescription,  # the sensor
        mesh: SheetMesh,
        # (T,) how many times its own at rest the conductivity of each triangle is
        ratio: FloatArray | float = 1.0,
        state: SheetState = AS_MADE,
    ) -> FloatArray:
        """Noise-free volts (M,)."""
        x, y = centroids(mesh)
        length_m = description.width_m / 4
        field = smooth_noise(x, y, length_m, np.random.default_rng(self.seed))
        conductivity = (1 + self.unevenness * field) * ratio * (1 + state.warming)
        if state.drift:
            drift = smooth_noise(x, y, length_m, np.random.default_rng([self.seed, 1]))
            conductivity = conductivity * (1 + state.drift * drift)
        impedance = self.impedance * np.array(state.impedance or 1.0)
        transfer = transfer_resistances(description, mesh, conductivity, impedance)
        if state.leads:
            transfer = exchanged(transfer, state.leads)
        return scan_voltages(description, transfer) * volts_per_unit(description)


class UnevenSkin:
    """The sheets of one sensor, uneven in their own way, and what they show of presses."""

    def __init__(
        self,
        description: SensorDescription,  # the sensor; its responses are the true ones
        mesh: SheetMesh,  # see `fine_mesh`; of a sensor of the same geometry
        seed: np.random.SeedSequence,  # of the unevenness
        *,
        # standard deviation of each sheet's smooth conductivity error
        unevenness: float = UNEVENNESS,
        # standard deviation of the logarithm of the contact impedances
        impedance_deviation: float = IMPEDANCE_DEVIATION,
        # moves the nodes of a mesh to where they are on this skin; they stay if None
        warp: Warp | None = None,
    ) -> None:
        self.description = description
        self._mesh = mesh
        self._warp: Warp = warp or (lambda mesh: mesh)
        rng = np.random.default_rng(seed)
        self._sheets = {}
        for name in description.channels:
            own = int(rng.integers(2**63))
            spread = impedance_deviation * rng.standard_normal(description.electrode_count)
            self._sheets[name] = UnevenSheet(own, unevenness, np.exp(spread))
        self._rest: dict[tuple[Channel, SheetState], FloatArray] = {}

    def voltages(
        self, presses: Sequence[Press], states: Mapping[Channel, SheetState] | None = None
    ) -> Volts:
        """Noise-free voltages (M,) of each channel, volts."""
        states = states or {}
        volts = {name: self._at_rest(name, states.get(name, AS_MADE)) for name in self._sheets}
        if not presses:
            return volts
        mesh = self._warp(fitted_mesh(self._mesh, presses, self.description, self._warp))
        x, y = centroids(mesh)
        pressure, coverage = strongest(presses, x, y, edge_m=SHARP_M)
        for name, sheet in self._sheets.items():
            state = states.get(name, AS_MADE)
            ratio = conductivity_ratio(self.description, name, pressure, coverage)
            pressed = sheet.voltages(self.description, mesh, ratio, state)
            # Of one mesh, so that no change is a change of mesh.
            at_rest = sheet.voltages(self.description, mesh, state=state)
            volts[name] = volts[name] + pressed - at_rest
        return volts

    def _at_rest(self, name: Channel, state: SheetState) -> FloatArray:
        if (name, state) not in self._rest:
            mesh = self._warp(self._mesh)
            sheet = self._sheets[name]
            self._rest[name, state] = sheet.voltages(self.description, mesh, state=state)
        return self._rest[name, state]


def centroids(sheet: SheetMesh) -> FloatArray:
    """Centroids (2, T) of the triangles."""
    return np.asarray(sheet.mesh.p[:, sheet.mesh.t].mean(axis=1))


def fitted_mesh(
    sheet: SheetMesh,  # mesh with its nodes and electrodes in place
    presses: Sequence[Press],  # what presses
    description: SensorDescription,  # the sensor
    # moves the nodes to where they are when an outline cuts them; what is returned is still in
    # place
    warp: Warp = lambda mesh: mesh,
) -> SheetMesh:
    """Halve the triangles that an outline cuts, `OUTLINE_REFINEMENTS` times."""
    mesh = sheet.mesh
    for _ in range(OUTLINE_REFINEMENTS):
        x, y = warp(SheetMesh(mesh, ())).mesh.p
        cut = np.zeros(mesh.t.shape[1], bool)
        for press in presses:
            corners = press.coverage(x, y, SHARP_M)[mesh.t]
            cut |= corners.max(axis=0) != corners.min(axis=0)
        mesh = mesh.refined(np.flatnonzero(cut))
    return with_electrodes(mesh, description)


def displaced(
    sheet: SheetMesh,  # mesh with the electrodes in place
    description: SensorDescription,  # the sensor
    displaced_m: FloatArray,  # (L,) by how much along the rim, counter-clockwise
) -> SheetMesh:
    """Mesh of a sheet whose electrodes sit off their places."""
    ends, centres = description.electrode_ends_m, description.electrode_centres_m
    along = ends[:, 1] - ends[:, 0]
    step = displaced_m[:, None] * along / np.linalg.norm(along, axis=1, keepdims=True)
    off = sheet.mesh.p.T[:, None, :] - centres
    reach_m = min(ELECTRODE_REACH_M, REACH_SHARE * float(pdist(centres).min()))
    pull = np.exp(-0.5 * (off**2).sum(axis=2) / reach_m**2)
    return replace(sheet, mesh=skfem.MeshTri(sheet.mesh.p + (pull @ step).T, sheet.mesh.t))


@dataclass(frozen=True)
class TrueContact:
    """What really presses in one place."""

    #: x_m, y_m: its centroid
    x_m: float
    y_m: float
    area_m2: float  #: its area
    pressure_kpa: float  #: its highest pressure
    magnitude: float  #: |relative conductivity change| of the magnitude channel, mean over its area
    shape: Shape  #: of its indenter


@dataclass(frozen=True)
class Truth:
    """What a perfect reconstruction of a scene would show."""

    #: (nodes_y, nodes_x) |relative conductivity change| of the magnitude channel, averaged over the
    #: cell around each node
    map: FloatArray
    #: (nodes_y, nodes_x) share of each cell that is pressed; below saturation, of the structure
    #: channel's change, in logarithm
    pressed: FloatArray
    contacts: tuple[TrueContact, ...]  #: one for each indenter
    force_n: float  #: of all of them


def truth_of(description: SensorDescription, presses: Sequence[Press]) -> Truth:
    """What a map of these presses should be; zeros where there is no magnitude channel."""
    along_x, step_x = _cell_samples(description.map_x_m)
    along_y, step_y = _cell_samples(description.map_y_m)
    x, y = np.meshgrid(along_x, along_y)
    edge_m = max(step_x, step_y)
    sample_m2 = step_x * step_y * description.area_factor(x, y)
    pressure, coverage = strongest(presses, x, y, edge_m)
    magnitude = coverage * np.abs(_change(description, pressure))
    contacts = []
    for press in presses:
        own = press.coverage(x, y, edge_m)
        change = _change(description, np.broadcast_to(press.pressure_at(x, y), x.shape))
        contacts.append(
            TrueContact(
                x_m=press.x_m,
                y_m=press.y_m,
                area_m2=float((own * sample_m2).sum()),
                pressure_kpa=press.pressure_kpa,
                magnitude=float(np.average(np.abs(change), weights=own * sample_m2)),
                shape=press.shape,
            )
        )
    return Truth(
        map=_over_cells(magnitude),
        pressed=_over_cells(coverage * _saturation(description, pressure)),
        contacts=tuple(contacts),
        force_n=1e3 * float((coverage * pressure * sample_m2).sum()),
    )


def _change(description: SensorDescription, pressure_kpa: FloatArray) -> FloatArray:
    """Relative change of the magnitude channel at a pressure; 0 without one; same shape."""
    if description.magnitude is None:
        return np.zeros_like(pressure_kpa)
    return description.magnitude.response.change(pressure_kpa)


def _saturation(description: SensorDescription, pressure_kpa: FloatArray) -> FloatArray:
    """Share of the structure channel's full change, in logarithm, at a pressure; same shape."""
    if description.structure is None or description.structure.response is None:
        return np.asarray((pressure_kpa > 0).astype(np.float64))
    ratio = description.structure.response.ratio(pressure_kpa)
    return np.asarray(np.log(ratio) / np.log(description.structure.saturated_ratio))


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
    return description.model_copy(update={Channel.MAGNITUDE: MagnitudeChannel(response=turned)})


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
    return description.model_copy(update={Channel.STRUCTURE: channel})
