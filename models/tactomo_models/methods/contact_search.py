"""Finding the next contact: where a small disc would explain most of what is left unexplained.

A disc of area A in a locally even field E disturbs the voltage between drive d and measurement m
as a dipole does,

    delta V = -2 A (c - 1) / (c + 1) E_d . E_m          (c its ratio of conductivities)

in the field of the sheet as already pressed, so that what one contact hides of another is
allowed for. The residual is matched against such discs on a grid (a step of matching pursuit);
the best one's place and area start a new contact.

Source of the disc's dipole: Ammari & Kang, "Reconstruction of small inhomogeneities from boundary
measurements", Springer (2004), polarisation tensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.methods.account import Account, Frame
from tactomo_models.physics.compiled_sheet import Solution
from tactomo_models.physics.forward import ForwardModel, Probes
from tactomo_models.scans.changes import Changes
from tactomo_models.scene.field_fit import FieldFit
from tactomo_models.scene.parameters import SIZE, SMALLEST_SIZE, UNIT_M, X, Y

MAX_MISSING = 2  # places that are told of: the third was never the one
NEAR_M = 0.012  # of two places, or a place and an outline: nearer ones mean the same contact
RADIUS_M = (0.006, 0.02)  # of a contact to begin with


@dataclass(frozen=True)
class MissingContact:
    """A contact that may be missing.

    Attributes:
        x_m, y_m: its place.
        radius_m: as it would be for a disc.
        gain: by how much the squared misfit would fall, to first order.
    """

    x_m: float
    y_m: float
    radius_m: float
    gain: float


@lru_cache(maxsize=1)  # takes a tenth of a second, and is the same for each tare
def _spots(forward: ForwardModel) -> tuple[IntArray, FloatArray, FloatArray, Probes]:
    """The spots that are looked at: their nodes, places (N,) in metres, and probes there."""
    grid = 2.0  # distance of the spots, in distances of map nodes
    description, bare = forward.description, forward.bare
    spacing = description.spacing_m
    x, y = bare.points[:, bare.pressable]
    cell = np.round(np.stack([x, y]) / (grid * spacing)).astype(int)
    _, chosen = np.unique(cell, axis=1, return_index=True)
    nodes = np.sort(chosen)
    return nodes, x[nodes], y[nodes], forward.probes(nodes)


class ContactSearch:
    """Looks for contacts in what is left unexplained.

    Args:
        fit: of the sensor's sheets.
        ratios: conductivity of a typical contact over the bare sheet's, of each sheet.
    """

    def __init__(self, fit: FieldFit, ratios: Mapping[Channel, float]) -> None:
        self._fit, self._forward = fit, fit.forward
        self._dipoles = {name: 2 * (ratio - 1) / (ratio + 1) for name, ratio in ratios.items()}
        self._nodes, self._x, self._y, self._probes = _spots(fit.forward)

    def missing(self, account: Account, frame: Frame, *, far: bool) -> list[MissingContact]:
        """The discs that would explain clearly more than chance, the best first.

        What the known contacts would make of a disc by moving aside is allowed for: its
        signature counts as far as theirs do not span it (orthogonal matching pursuit: Pati et
        al., Asilomar 1993).

        Args:
            account: what is known to be pressed, at its minimum.
            frame: what it is fitted to.
            far: whether only away from the contacts; nearby, a part of their form may be missing.
        """
        gain, area = self._gains(account, frame)
        drawing = account.fitted.drawing
        pressed = np.zeros(self._forward.bare.pressable.shape)
        pressed[drawing.nodes] = np.abs(drawing.enclosed)
        gain[pressed[self._nodes] >= 0.1] = 0.0
        if far and account.family.count:
            gain[self._gaps_m(account.contacts) < NEAR_M] = 0.0
        # The best of so many places gains this much by noise alone. What a companion feels that no
        # contact explains yet says nothing of the sheets' noise.
        felt = np.zeros_like(account.fitted.companion_residuals)
        residual = np.concatenate([*account.fitted.residuals.values(), felt])
        unit = frame.likelihood.unit(frame.likelihood.chi_squared(residual))
        by_chance = 2 * np.log(len(self._nodes)) / unit
        found: list[MissingContact] = []
        for spot in np.argsort(-gain):
            if gain[spot] < by_chance or len(found) == MAX_MISSING:
                break
            x, y = float(self._x[spot]), float(self._y[spot])
            # What is smaller than the mesh can show is an error of the model, not a contact.
            if area[spot] < np.pi * np.exp(2 * SMALLEST_SIZE):
                continue
            if all(np.hypot(x - other.x_m, y - other.y_m) > NEAR_M for other in found):
                radius = min(max(float(np.sqrt(area[spot] / np.pi)), RADIUS_M[0]), RADIUS_M[1])
                found.append(MissingContact(x, y, radius, float(gain[spot])))
        return found

    def _gaps_m(self, contacts: FloatArray) -> FloatArray:
        """Distance of each spot from the nearest outline, about."""
        dx, dy = self._x - UNIT_M * contacts[:, X, None], self._y - UNIT_M * contacts[:, Y, None]
        return np.asarray((np.hypot(dx, dy) - np.exp(contacts[:, SIZE, None])).min(axis=0))

    def _gains(self, account: Account, frame: Frame) -> tuple[FloatArray, FloatArray]:
        """What a disc at each spot (C,) would take off the cost, and its area, to first order."""
        fitted, measured = account.fitted, frame.measured
        J = account.jacobian
        normal, gradient = self._fit.normal_equations(fitted, J)
        aside = np.linalg.solve(normal, gradient)
        gain, area = np.zeros((2, len(self._nodes)))
        clearest = max(measured, key=lambda name: abs(self._dipoles[name]))
        of_sheets = sum(map(len, fitted.residuals.values()))  # companions come last
        for name, own in zip(measured, np.split(J[:of_sheets], len(measured)), strict=True):
            residual = fitted.residuals[name]
            beside = np.column_stack([own, residual])
            found, square = self._signatures(name, fitted.solutions[name], measured[name], beside)
            cross, unexplained = found[:-1], found[-1] - aside @ found[:-1]
            spanned = (cross * np.linalg.solve(normal, cross)).sum(axis=0)
            power = np.maximum(square - spanned, 1e-30)
            needed = np.maximum(-unexplained / power, 0.0)
            gain += needed**2 * power
            area = needed if name == clearest else area
        return gain, area

    def _signatures(
        self, name: Channel, solution: Solution, changes: Changes, beside: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Products of the weighted change by each spot's disc with `beside` (M, R), and its square.

        Shapes (R, C) and (C,). The changes themselves, as many as voltages, are never made.
        """
        sheet = self._fit.sheet(name)
        by_product = sheet.spot_sensitivity(self._probes, solution)
        over = changes.weight * self._dipoles[name] / np.abs(sheet.bare_voltages)
        rows = changes.less_nuisance(beside)
        if changes.nuisance is not None:
            along, share = changes.nuisance
            rows = np.hstack([rows, along * np.sqrt(share * (2 - share))])
        found = (sheet.by_product @ (over[:, None] * rows)).T @ by_product
        found, less = np.split(found, [beside.shape[1]])
        square = (abs(sheet.by_product) @ over**2) @ by_product**2 - (less**2).sum(axis=0)
        return found, square
