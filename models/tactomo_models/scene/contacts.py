"""Contacts as they are published: each pressed area with its identity over time and pressure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tactomo_models.arrays import FloatArray, Image
from tactomo_models.scene.areas import Areas
from tactomo_models.scene.pressure import FieldContacts, PressureCurve, PressureRange, pressures_of
from tactomo_models.sensor.mount import Mount


@dataclass(frozen=True)
class Contact:
    """One pressed area."""

    id: int  #: its identity over time, counted up from 1
    #: x_m, y_m: its centroid
    x_m: float
    y_m: float
    area_m2: float  #: its area
    #: relative conductivity change of the magnitude channel, without its sign; NaN if unknown
    magnitude: float = float("nan")
    magnitude_sigma: float = float("nan")  #: standard uncertainty of the magnitude
    #: see `pressure_range`; NaN if unknown, a lower bound of 95 % if above
    pressure_kpa: float = float("nan")
    #: x_sigma_m, y_sigma_m: standard uncertainties of the centroid; NaN if unknown
    x_sigma_m: float = float("nan")
    y_sigma_m: float = float("nan")
    area_sigma_m2: float = float("nan")  #: that of the area; NaN if unknown
    #: standard uncertainty of the pressure; NaN but within the range
    pressure_sigma_kpa: float = float("nan")
    #: pressure times area, or as was taught; NaN if unknown, a lower bound of 95 % if above
    force_n: float = float("nan")
    #: standard uncertainty of the force; NaN if that is unknown or a lower bound
    force_sigma_n: float = float("nan")
    #: where the pressure lies, seen from what the magnitude channel answers to
    pressure_range: PressureRange = PressureRange.UNKNOWN
    #: highest pressure under it; NaN if unknown, a lower bound of 95 % if above
    peak_kpa: float = float("nan")
    #: standard uncertainty of the peak; NaN but within the range
    peak_sigma_kpa: float = float("nan")
    #: upper bound of its highest pressure, 95 %, whatever the range; +inf where the curve ends
    #: below it, NaN where nothing bounds it: no magnitude, or no uncertainty
    max_kpa: float = float("nan")
    #: exponent γ of the pressure (1 - ρ²)^γ from the middle to the edge: 0 flat, 0.5 Hertz; NaN if
    #: unknown
    edge: float = float("nan")
    #: whether presses at known places say where it is, and ones of known force how hard it presses;
    #: else the physics alone does
    taught: bool = False
    #: where it is on the link that carries the sheet, and the sheet's outward normal there, in the
    #: link's frame; NaN without a mount
    position_m: tuple[float, float, float] = (float("nan"),) * 3
    normal: tuple[float, float, float] = (float("nan"),) * 3
    frame: str = ""  #: that link's name; empty without a mount

    def in_mm(self) -> dict[str, Any]:
        """Return its fields by the names that files and messages have: mm and mm², not m and m²."""
        said = {}
        for name, value in vars(self).items():
            if name.endswith("_m") and isinstance(value, float):
                said[f"{name}m"] = value * 1e3
            elif name.endswith("_m2"):
                said[f"{name.removesuffix('_m2')}_mm2"] = value * 1e6
            else:
                said[name] = value
        return said


def contacts_of(
    areas: Areas,  # where they are
    ids: Sequence[int],  # the identity of each
    size: FloatArray,  # (K,) magnitudes; NaN where unknown
    sigma: FloatArray,  # (K,) their standard uncertainties
    curve: PressureCurve | None,  # the sensor's; None where it has none
    *,
    # the range that each identity was in; a new one has none
    last: Mapping[int, PressureRange] | None = None,
    # what a fitted field says of them; the magnitudes are even ones if None
    field: FieldContacts | None = None,
) -> tuple[Contact, ...]:
    """Make contacts of K areas."""
    ago = [(last or {}).get(known, PressureRange.UNKNOWN) for known in ids]
    pressures = pressures_of(
        curve, size, sigma, areas.areas_m2, areas.sigmas[:, 2], field=field, last=ago
    )
    edges = np.full(len(areas), np.nan) if field is None else field.edge
    return tuple(
        Contact(
            id=ids[k],
            x_m=float(areas.centres_m[k, 0]),
            y_m=float(areas.centres_m[k, 1]),
            area_m2=float(areas.areas_m2[k]),
            magnitude=float(size[k]),
            magnitude_sigma=float(sigma[k]),
            pressure_kpa=float(pressures.kpa[k]),
            x_sigma_m=float(areas.sigmas[k, 0]),
            y_sigma_m=float(areas.sigmas[k, 1]),
            area_sigma_m2=float(areas.sigmas[k, 2]),
            pressure_sigma_kpa=float(pressures.sigma_kpa[k]),
            force_n=float(pressures.force_n[k]),
            force_sigma_n=float(pressures.force_sigma_n[k]),
            pressure_range=pressures.ranges[k],
            peak_kpa=float(pressures.peak_kpa[k]),
            peak_sigma_kpa=float(pressures.peak_sigma_kpa[k]),
            max_kpa=float(pressures.max_kpa[k]),
            edge=float(edges[k]),
        )
        for k in range(len(areas))
    )


def mounted(contacts: Sequence[Contact], mount: Mount) -> tuple[Contact, ...]:
    """Return contacts with their places on the link that carries the sheet."""
    points, normals = mount.place(np.array([(c.x_m, c.y_m) for c in contacts]).reshape(-1, 2))
    return tuple(
        replace(contact, position_m=tuple(point), normal=tuple(normal), frame=mount.frame)
        for contact, point, normal in zip(contacts, points.tolist(), normals.tolist(), strict=True)
    )


def total_force(
    contacts: Sequence[Contact],
    curve: PressureCurve | None,  # the sensor's; None where it has none
    field: FieldContacts | None = None,  # what a fitted field says of them; None where none is
) -> tuple[float, float]:
    """Force of all contacts together in N, and its standard uncertainty; each NaN where unknown.

    Both are unknown where one contact's is. A fitted field knows how its contacts' errors go
    together; without one they are taken as independent. The curve's own error is in all alike.
    """
    if not contacts:
        return 0.0, float("nan")
    force = np.array([contact.force_n for contact in contacts])
    sigma = np.array([contact.force_sigma_n for contact in contacts])
    total = float(force.sum())
    if field is None or curve is None or len(contacts) == 1 or not np.isfinite(sigma).all():
        return total, float(np.sqrt(sigma @ sigma))
    by_fit = field.total_force_sigma_n * total / max(field.total_force_n, 1e-12)
    by_curve = force @ (curve.sigma(field.peak_magnitude) / curve.pressure(field.peak_magnitude))
    return total, float(np.hypot(by_fit, by_curve))


def map_of(areas: Areas, values: FloatArray) -> Image:
    """Map on which each area carries its own value; areas of unknown value stay 0."""
    fused = np.einsum("k,kyx->yx", np.nan_to_num(values), areas.on_map)
    return np.asarray(fused, dtype=np.float32)


def pressure_map(
    areas: Areas,  # K areas
    contacts: Sequence[Contact],  # one for each
    # (nodes_y, nodes_x) as it falls over each area; even if None
    pressure_kpa: FloatArray | None = None,
) -> Image:
    """Each contact's pressure on its area; NaN, and not 0, where it is touched but unknown."""
    touched = 0.05  # share of a node that a contact covers, from which it is touched
    values = np.array([contact.pressure_kpa for contact in contacts])
    if pressure_kpa is None or not contacts:
        fused = map_of(areas, values)
    else:
        mean = (areas.on_map > 0).astype(float)
        whole = np.maximum(np.einsum("kyx,yx->k", mean, pressure_kpa), 1e-12)
        scale = np.where(np.isnan(values), 0.0, values) * areas.on_map.sum(axis=(1, 2)) / whole
        fused = np.einsum("k,kyx,yx->yx", scale, mean, pressure_kpa).astype(np.float32)
    fused[(areas.on_map[np.isnan(values)] > touched).any(axis=0)] = np.nan
    return fused
