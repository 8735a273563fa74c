"""Diagnosing a skin from its scans at rest: how its electrodes are, what was found, what to do.

Pure functions: many scans are looked at together (`examination`), and what they show is put into
words, each thing with its next step (`findings`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.errors import DataError
from tactomo_models.health.examination import Examination, moves, stillest
from tactomo_models.health.findings import (
    Finding,
    Level,
    drift_found,
    electrodes_found,
    model_found,
    reciprocity_found,
    saturation_found,
    scans_found,
    snr_found,
    worst,
)
from tactomo_models.physics.actual_sheet import SheetEstimator, explains
from tactomo_models.physics.artifact import MODEL_ERROR
from tactomo_models.physics.bare_sheet import BareSheet
from tactomo_models.scans.plausibility import Flag, Layout, Wiring
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.pattern import Pairs


@dataclass(frozen=True)
class Diagnosis:
    """What was found out about one channel."""

    findings: tuple[Finding, ...]  # one for each thing that was looked at
    electrodes: tuple[str, ...]  # (L,) state of each: good, dead, loose, misread or swapped
    noise: FloatArray  # (L,) how many times noisier than the others the voltages of each are
    volts: FloatArray  # (M,) mean of the scans that were looked at
    snr_db: FloatArray  # (M,) of each voltage; NaN where unknown
    reciprocal: IntArray  # (n, 2) positions of reciprocal voltages
    pairs: Pairs  # electrodes of each voltage

    @property
    def level(self) -> Level:
        """The worst of the findings; unknown where neither noise nor reciprocity is known."""
        found = worst(finding.level for finding in self.findings if finding.level != Level.UNKNOWN)
        known = {f.about for f in self.findings if f.level != Level.UNKNOWN}
        serious = found in (Level.FAULT, Level.BROKEN)
        return found if serious or known & {"snr", "reciprocity"} else Level.UNKNOWN


def diagnose(
    layout: Layout,  # the sensor's description, or its pattern alone
    scans: FloatArray,  # (T, M) volts, on any scale
    *,
    times_s: FloatArray | None = None,  # (T,) when each was taken; drift stays unknown without
    # the even sheet, solved; without it voltages are held against their likes further round the rim
    even: BareSheet | None = None,
    contrast: float = 100.0,  # factor by which pressing changes conductivity at most
    saturated: int = 0,  # scans of which the device said that it clipped
) -> Diagnosis:
    """Examine scans of a skin on which nothing presses.

    Where something does, the stillest scans are looked at for all but clipping and loose leads.

    Raises:
        DataError: there is no whole scan, or it has another number of voltages than the pattern.
    """
    scans = np.asarray(scans, dtype=np.float64)
    if scans.ndim != 2 or scans.shape[1] != len(layout.pairs.drive):
        raise DataError(
            f"scans of shape {scans.shape} do not fit a pattern of {len(layout.pairs.drive)} "
            "voltages; give the description or the pattern that they were measured with"
        )
    whole = np.isfinite(scans).all(axis=1)
    if not whole.any():
        raise DataError("there is no scan in which every voltage is a number; check the device")
    times_s = None if times_s is None else times_s[whole]
    scans = scans[whole]
    wiring = Wiring(layout)
    still = stillest(wiring, scans)
    is_moved = still != slice(0, len(scans)) or moves(wiring, scans)
    transfer = None if even is None else even.transfer
    examined = Examination(wiring, layout, scans, still, transfer, contrast)
    findings = [
        scans_found(len(scans), int((~whole).sum()), still, is_moved),
        snr_found(examined),
        reciprocity_found(examined),
        *electrodes_found(examined),
        model_found(examined, _is_of_sheet(examined, layout, even), is_moved),
        saturation_found(examined, saturated),
        drift_found(scans[still], None if times_s is None else times_s[still]),
    ]
    return Diagnosis(
        tuple(findings),
        tuple(examined.states),
        examined.electrode_noise,
        examined.mean,
        examined.snr_db,
        wiring.reciprocal,
        layout.pairs,
    )


def _is_of_sheet(examined: Examination, layout: Layout, even: BareSheet | None) -> bool | None:
    """Whether the voltages are of the sheet that is described, made by hand or not; if known."""
    if even is None:
        return None
    usable, volts = examined.verdict.usable, examined.mean
    if usable.any() and Flag.REFERENCE_MISMATCH not in examined.verdict.flags:
        return True
    bad = examined.verdict.electrodes or not usable.any()
    if bad or not isinstance(layout, SensorDescription):
        return False
    relative = np.divide(examined.noise, np.abs(volts), out=np.ones_like(volts), where=usable)
    noise = np.hypot(relative, MODEL_ERROR)
    sheet = SheetEstimator(layout, even).estimate(volts, usable, noise)
    return sheet is not None and explains(sheet, volts, usable, noise)
