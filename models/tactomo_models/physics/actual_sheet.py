"""The sheet as it is: what its reference voltages tell of how it was made.

A sheet is never even, and a hand does not set electrodes to a tenth of a millimetre. Both show in
the voltages of the unpressed sheet, and both bend what a press does to them. So the tare does not
only divide: a smooth conductivity, the contact impedances and the electrodes' places along the rim
are fitted to the reference (Gauss-Newton, each with a prior of what such skins have), and presses
are then solved on that sheet instead of an even one. Where no such sheet explains the reference,
nothing is known of it and the even one stays.

Sources: for the impedances, Vilhunen et al., "Simultaneous reconstruction of electrode contact
impedances and internal electrical properties", Meas. Sci. Technol. 13 (2002); for the electrodes'
places, Darde et al., "Fine-tuning electrode information in electrical impedance tomography",
Inverse Probl. Imaging 6 (2012).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
import skfem
from tactomo_protocol import Channel

from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.physics.artifact import GREEN_DTYPE, INVERSE_REFINEMENTS, MODEL_ERROR
from tactomo_models.physics.bare_sheet import (
    BareSheet,
    assemble_sheet,
    electrode_fields,
    electrode_terms,
    scan_voltages,
    solve_bare_sheet,
    transfer_of,
)
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import SheetMesh, hat_gradients, mesh_sheet
from tactomo_models.sensor.description import SensorDescription

MAX_NODES = 6000  # that can be pressed: 75 MB of Green's function a sheet; the paper's has 2,500
MAX_LEFT = 0.02  # relative error of a reference that the sheet explains: a tenth of hand-made ones'
MODES = 6  # cosines along each side: with 8 nothing gets better
UNEVENNESS = 0.15  # prior standard deviation of the logarithm of conductivity
SMOOTH = 0.25  # its length over the sheet's width; 0.15 serves as well
IMPEDANCE = 0.4  # of the logarithm of a contact impedance
WARMING = 0.1  # of a sheet's conductivity since the tare: 5 K at 2 % per kelvin
UNEVEN_DRIFT = 0.01  # likewise from place to place; 0.02 explains scans that are one apart, too
DISPLACED_M = 1e-3  # of an electrode along the rim
REACH = 0.4  # radius that an electrode draws along, over their distance: none meets another
MAX_SLOPE_ERROR = 1.0  # as a share of what is left to explain; with 0.3 places run away
EXPLAINED_MISFIT = (
    1.5  # times its noise, left of a reference: of unloaded skins up to 0.9, of pressed ones 5
)
STEPS = 6  # of Gauss-Newton at most: electrodes 1.5 mm off take them all, ordinary ones three
SETTLED = 1.0  # of the sum of squares, that a last step takes off; with 0.1 nothing gets better

Sheets = Mapping[Channel, ForwardModel]


@dataclass(frozen=True)
class _Shape:
    """A sheet with its parameters, and its fields."""

    mesh: SheetMesh
    conductivity: FloatArray
    impedance: FloatArray
    system: sp.csc_matrix
    contacts: FloatArray
    fields: FloatArray
    voltages: FloatArray


def explains(
    sheet: ForwardModel, voltages: FloatArray, usable: BoolArray, noise: FloatArray
) -> bool:
    """Whether these voltages are of this sheet, unloaded, any scale aside.

    A skin made by hand may be far from the even sheet; what presses is no making of any sheet, and
    leaves more than the noise. Arguments as of `SheetEstimator.estimate`.
    """
    if not usable.any():
        return False
    ratio = voltages[usable] / sheet.bare_voltages[usable]
    left = (ratio / np.median(ratio) - 1) / noise[usable]
    return bool(np.sqrt(np.mean(left**2)) < EXPLAINED_MISFIT)


class SheetEstimator:
    """Finds how the sheets of one sensor were made.

    Args:
        description: the sensor.
        even: its even sheet, solved.
    """

    def __init__(self, description: SensorDescription, even: BareSheet) -> None:
        self._description, self._even = description, even
        self._mesh = mesh_sheet(description, refinements=INVERSE_REFINEMENTS)
        x, y = self._mesh.mesh.p
        width, height = description.width_m, description.height_m
        i, j = np.divmod(np.arange(1, (MODES + 1) ** 2), MODES + 1)
        self._modes = np.cos(np.pi * i[:, None] * (x / width + 0.5)) * np.cos(
            np.pi * j[:, None] * (y / height + 0.5)
        )
        wave = (np.pi * i / width) ** 2 + (np.pi * j / height) ** 2
        prior = np.exp(-wave * (SMOOTH * width) ** 2 / 4)
        prior *= UNEVENNESS / np.sqrt((prior**2).sum() / 4)
        others = np.repeat([IMPEDANCE, 1.0], description.electrode_count)
        self._sigma = np.append(prior, others)  # places are in units of DISPLACED_M
        ends, centres = description.electrode_ends_m, description.electrode_centres_m
        along = ends[:, 1] - ends[:, 0]
        self._along = along / np.linalg.norm(along, axis=1, keepdims=True)
        apart = np.linalg.norm(centres[:, None] - centres, axis=2)
        reach_m = REACH * float(apart[apart > 0].min())
        off = ((self._mesh.mesh.p.T[:, None] - centres) ** 2).sum(axis=2)
        self._pull = np.clip(1 - off / reach_m**2, 0, None) ** 2  # (N, L)
        # Unknowns around each electrode, its potential included; the last one's is 0 and none.
        nearest = np.append(off.argmin(axis=1), np.arange(len(centres) - 1))
        self._around = [np.flatnonzero(nearest == k) for k in range(len(centres))]

    def estimate(
        self,
        voltages: FloatArray,  # (M,) of the unpressed sheet, volts on any scale
        usable: BoolArray,  # (M,) which of them count
        noise: FloatArray,  # (M,) their relative standard deviations
    ) -> ForwardModel | None:
        """The model of the sheet that these voltages are of.

        None where none explains them, or where the sheet is too large for a model of its own.
        """
        if len(self._even.support) > MAX_NODES:
            return None
        # Far from its drive a voltage may be all noise, its sign included. Of hand-made L-shaped
        # palms, fits leave 0.24 % (median) with this limit, half and twice of it.
        noisy = 0.05
        usable = usable & (noise < noisy)
        parameters = np.zeros(len(self._sigma))
        prior = np.append(self._sigma**-2.0, 0.0)  # any scale is as likely
        for _ in range(STEPS):
            shape = self._shape(parameters)
            left = self._left(voltages, shape, usable)
            if left is None:
                return None
            # Far from the minimum a slope is no surer than this: else places leap by centimetres.
            error = np.hypot(noise, max(MODEL_ERROR, MAX_SLOPE_ERROR * float(np.std(left[usable]))))
            precision = usable / error**2
            slopes = self._slopes(parameters, shape) / shape.voltages[:, None]
            slopes = np.append(slopes, np.ones((len(left), 1)), axis=1)
            normal = slopes.T @ (precision[:, None] * slopes) + np.diag(prior)
            gradient = slopes.T @ (precision * left) - prior * np.append(parameters, 0.0)
            step = np.linalg.solve(normal, gradient)
            parameters = parameters + step[:-1]
            if step @ gradient < SETTLED:
                break
        shape = self._shape(parameters)
        left = self._left(voltages, shape, usable)
        if left is None or np.sqrt(np.mean(left[usable] ** 2)) > MAX_LEFT:
            return None
        bare = solve_bare_sheet(
            self._description,
            shape.mesh,
            shape.conductivity,
            shape.impedance,
            drawn_on=self._even,
            green_dtype=GREEN_DTYPE,
        )
        return ForwardModel(self._description, bare)

    def drift(self) -> FloatArray:
        """What the even sheet may do to its voltages by itself: warm, and unevenly so.

        Returns:
            (M, K) changes over the voltages themselves, each of one standard deviation.
        """
        rest = np.zeros(len(self._sigma))
        shape = self._shape(rest)
        slopes = self._slopes(rest, shape)[:, : len(self._modes)] / shape.voltages[:, None]
        uneven = UNEVEN_DRIFT / UNEVENNESS * self._sigma[: len(self._modes)] * slopes
        return np.column_stack([np.full(len(uneven), WARMING), uneven])

    def _left(self, voltages: FloatArray, shape: _Shape, usable: BoolArray) -> FloatArray | None:
        """Logarithms (M,) of what a sheet leaves, any scale aside; None where signs differ."""
        ratio = np.where(usable, voltages / shape.voltages, 1.0)
        if not usable.any():
            return None
        with np.errstate(over="ignore"):
            ratio[usable] /= np.median(ratio[usable])
        return np.log(ratio) if ((ratio > 0) & (ratio < np.inf)).all() else None

    def _shape(self, parameters: FloatArray) -> _Shape:
        modes, impedances, places = np.split(
            parameters, [len(self._modes), len(self._modes) + self._description.electrode_count]
        )
        mesh = self._moved(places)
        conductivity, impedance = np.exp(modes @ self._modes), np.exp(impedances)
        triangles = conductivity[mesh.mesh.t].mean(axis=0)
        system = assemble_sheet(self._description, mesh, triangles, impedance)
        fields = electrode_fields(self._description, system)
        contacts = electrode_terms(self._description, mesh, impedance) @ fields
        voltages = scan_voltages(self._description, transfer_of(self._description, fields))
        return _Shape(mesh, conductivity, impedance, system, contacts, fields, voltages)

    def _moved(self, places: FloatArray) -> SheetMesh:
        """The mesh with electrodes off their places, by units of DISPLACED_M along the rim."""
        step = DISPLACED_M * places[:, None] * self._along
        mesh = self._mesh.mesh
        return replace(self._mesh, mesh=skfem.MeshTri(mesh.p + (self._pull @ step).T, mesh.t))

    def _slopes(self, parameters: FloatArray, shape: _Shape) -> FloatArray:
        """Derivatives (M, N) of the voltages: dR = -u^T dA u with the fields u."""
        electrodes = self._description.electrode_count
        first, second = np.triu_indices(electrodes - 1)
        columns = [self._by_modes(shape)]
        nudge = 0.1  # of a millimetre, by which all electrodes move at once: none meets another
        triangles = shape.conductivity[shape.mesh.mesh.t].mean(axis=0)
        moved = self._moved(parameters[-electrodes:] + nudge)
        changed = assemble_sheet(self._description, moved, triangles, shape.impedance)
        by_place = (changed - shape.system) @ shape.fields / nudge
        for currents in (-shape.contacts, by_place):
            each = []
            for rows in self._around:
                product = shape.fields[rows].T @ currents[rows]
                each.append(-product[first, second])
            columns.append(np.stack(each, axis=1))
        slopes = np.concatenate(columns, axis=1)
        transfer = np.zeros((electrodes, electrodes, slopes.shape[1]))
        transfer[first, second] = transfer[second, first] = slopes
        return scan_voltages(self._description, transfer)

    def _by_modes(self, shape: _Shape) -> FloatArray:
        """Derivatives (pairs, modes) of transfer resistances by the modes of conductivity."""
        corners = shape.mesh.mesh.t
        hats, area = hat_gradients(shape.mesh.mesh.p[:, corners], shape.mesh.stretch)
        field = np.einsum("dct,cta->adt", hats, shape.fields[corners])  # (L - 1, 2, T)
        weight = (shape.conductivity * self._modes)[:, corners].mean(axis=1) * area
        # Of pairs in the order of `np.triu_indices`.
        products = np.concatenate(
            [x * field[k:, 0] + y * field[k:, 1] for k, (x, y) in enumerate(field)]
        )
        return np.asarray(-products @ weight.T)
