"""Teach a skin: learn from presses at known places what the physics gets wrong on this very skin.

Presses are reconstructed, each from a cold start. Each quarter of them, in order of time, is judged
by what the others teach; what locates no better than the physics alone is not kept. Presses that
the others contradict, and coordinates in another unit or frame, are named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo_models.archive import read_arrays
from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.batch import read_scans
from tactomo_models.calibration.calibration_file import Subject
from tactomo_models.calibration.press_regression import ForceRegression, PressRegression
from tactomo_models.calibration.taught_skin import TaughtSkin, are_forces, load_of, press_changes
from tactomo_models.errors import CalibrationError, DataError
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.reference import Reference
from tactomo_models.sensor.description import SensorDescription

MIN_PRESSES: Final = 20
"""Fifteen to learn from where five are judged; fewer tell no improvement from chance."""
HELD_OUT_PARTS: Final = 4  # parts, in order of time, each judged by what the others teach
ODD_RATIO: Final = 10.0
"""Median errors from which the other presses contradict a press. Of five measured skins the worst
of 800 good presses is 8.9 medians off, and of those with x and y swapped four in five are above."""
OTHER_FRAME_RATIO: Final = 0.5
"""Of the distance as given: coordinates in another frame or unit are nearer to the contacts."""

FACTORS_AS_GIVEN: Final = (0.6, 1.6)
"""Factors between places and contacts that pass as the model's. It is off by 1 % on simulated
hand-made skins; one doubled axis is 0.5."""
TURNED_DEG: Final = 15.0  # likewise; 16 electrodes are 22 degrees apart
SHIFTED_SHARE: Final = 0.25  # likewise, of the skin's size; counted from a corner it is 0.5
LEARNT_RATIO: Final = 0.5
"""Of the error that the middle of all places makes: what locates no better has learnt nothing.
With shuffled places it is 1.0, of 100 presses on the worst of five measured skins 0.2."""
OTHER_UNIT: Final = 5.0
"""Times the physics' force, from which a known force seems to be in grams (102), kilograms (0.10)
or another unit; a cover that takes a quarter of the load makes it 1.3."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class KnownPresses:
    """Presses at known places, in order of time."""

    scans: Mapping[str, FloatArray]  # (P, M) volts of each channel
    reference: Reference  # of the unpressed skin
    xy_mm: FloatArray  # (P, 2) where each was, in the description's frame
    force_n: FloatArray  # (P,) how hard each was, newtons; NaN where that is not known


def read_presses(path: Path, description: SensorDescription) -> KnownPresses:
    """Read what `tactomo reconstruct` reads, `xy_mm` (P, 2) and, if there, `force_n` (P,).

    Raises DataError where the file cannot be read or does not fit the sensor.
    """
    scans, reference, _ = read_scans(path, description)
    count = len(next(iter(scans.values())))
    arrays = read_arrays(path)
    xy_mm, force_n = arrays.get("xy_mm", np.zeros(0)), arrays.get("force_n", np.full(count, np.nan))
    if xy_mm.dtype.kind not in "fiu" or xy_mm.shape != (count, 2):
        raise DataError(
            f"{path}: xy_mm is {xy_mm.dtype} of shape {xy_mm.shape}; where each of the {count} "
            f"presses was is needed, as real numbers of shape {count} x 2, in mm from the middle"
        )
    if force_n.dtype.kind not in "fiu" or force_n.shape != (count,):
        raise DataError(
            f"{path}: force_n is {force_n.dtype} of shape {force_n.shape}; give the newtons of "
            f"each of the {count} presses, NaN where they are not known, or leave it out"
        )
    return KnownPresses(scans, reference, xy_mm.astype(np.float64), force_n.astype(np.float64))


def teach(
    presses: KnownPresses,  # at known places
    description: SensorDescription,  # the sensor
    subject: Subject,  # what they are of
    *,
    keep_odd: bool = False,  # learn also from presses that the others contradict
    progress: Progress | None = None,  # called with presses done and presses in all
) -> tuple[TaughtSkin, list[str]]:
    """Learn from presses; also, in words, what was left out.

    Raises:
        CalibrationError: they are too few, contradict each other or the sensor, or teach nothing.
    """
    _check_numbers(presses, description)
    with threadpool_limits(1):
        seen = _reconstructed(presses, description, progress)
        one = np.flatnonzero(np.isfinite(seen.places_mm).all(axis=1))
        notes = _left_out(np.setdiff1d(np.arange(len(presses.xy_mm)), one))
        if len(one) < MIN_PRESSES:
            raise CalibrationError(
                f"{len(one)} of {len(presses.xy_mm)} presses show one contact, and {MIN_PRESSES} "
                "are needed; press harder, one place at a time, and take the reference unpressed"
            )
        xy_mm, guess_mm = presses.xy_mm[one], seen.places_mm[one]
        _check_frame(xy_mm, guess_mm, description)
        usable = np.asarray(seen.valid[one].all(axis=0))
        changes = seen.changes[one][:, usable]
        odd = _odd(changes, xy_mm, guess_mm, one)
        if odd and not keep_odd:
            raise CalibrationError(
                f"nothing is kept, as all others contradict {'; '.join(odd)} (counted from "
                "0). Correct them, or leave them out, and run this again; or give --keep-odd"
            )
        best, without_mm, with_mm = _best(changes, xy_mm, guess_mm)
        loads, force_n = seen.loads[one], presses.force_n[one]
        force_error, note = _judged_forces(loads, xy_mm, force_n, seen.forces_n[one])
        notes += note
    channels = tuple(name for name in description.channels if name in presses.scans)
    taught = TaughtSkin(
        subject,
        datetime.now(UTC).isoformat(timespec="seconds"),
        channels,
        usable,
        changes,
        xy_mm,
        guess_mm if best == "corrected" else None,
        loads,
        force_n,
        seen.tiers,
        without_mm,
        with_mm,
        force_error,
        np.array([getattr(presses.reference, name) for name in channels]),
    )
    return taught, [*notes, *(f"{each} is kept against the others" for each in odd)]


def _check_numbers(presses: KnownPresses, description: SensorDescription) -> None:
    """Refuse what no robot reports of a skin, before anything is computed."""
    xy_mm = presses.xy_mm
    if len(xy_mm) < MIN_PRESSES:
        raise CalibrationError(f"{len(xy_mm)} presses are too few; give {MIN_PRESSES} or more")
    if not np.isfinite(xy_mm).all():
        first = int(np.flatnonzero(~np.isfinite(xy_mm).all(axis=1))[0])
        raise CalibrationError(f"press {first} has no place; give xy_mm, or leave the press out")
    width_mm = 1e3 * max(description.width_m, description.height_m)
    if np.abs(xy_mm).max() < 0.01 * width_mm:  # a hundredth of the skin teaches nothing, either
        raise CalibrationError(
            f"all places are within {np.abs(xy_mm).max():.2g} mm of the middle: they seem to be "
            "metres; give millimetres"
        )
    if not are_forces(presses.force_n).all():
        raise CalibrationError(
            f"a force of {np.nanmin(presses.force_n):g} N presses nothing: give newtons, above 0 "
            "where the skin is pressed, and NaN where the force is not known"
        )
    scans = np.hstack(list(presses.scans.values()))
    for k in range(1, len(scans)):
        if np.array_equal(scans[k], scans[k - 1]):
            raise CalibrationError(
                f"presses {k - 1} and {k} hold the very same voltages: one was stored twice, and "
                "the places after it may be shifted; take them again"
            )


class _Seen(NamedTuple):
    """What P presses look like."""

    changes: FloatArray  # (P, V) of all channels, one after the other
    valid: BoolArray  # (P, V) which of them are
    places_mm: FloatArray  # (P, 2) of each one's contact; NaN where there is none, or several
    loads: FloatArray  # (P,) of each one's contact, see `load_of`; NaN, likewise
    forces_n: FloatArray  # (P,) by the physics, likewise
    tiers: frozenset[str]  # what made the contacts


def _reconstructed(
    presses: KnownPresses, description: SensorDescription, progress: Progress | None
) -> _Seen:
    """Reconstruct each press from a cold start, as the daemon does by default."""
    reconstructor = Reconstructor(description)
    reconstructor.set_reference(presses.reference)
    channels = [name for name in description.channels if name in presses.scans]
    width = len(channels) * description.measurements
    count, tiers = len(presses.xy_mm), set()
    changes, valid = np.zeros((count, width)), np.zeros((count, width), bool)
    places_mm, (loads, forces_n) = np.full((count, 2), np.nan), np.full((2, count), np.nan)
    for index in range(count):
        scan = {name: volts[index] for name, volts in presses.scans.items()}
        measurement = reconstructor.compare(
            scan.get(Channel.MAGNITUDE), scan.get(Channel.STRUCTURE)
        )
        if measurement.changes:
            changes[index], valid[index] = press_changes(measurement, channels)
            reconstructor.reset()
            frame = reconstructor.solve(measurement)
            if len(frame.contacts) == 1:
                (contact,) = frame.contacts
                places_mm[index] = 1e3 * contact.x_m, 1e3 * contact.y_m
                loads[index], forces_n[index] = load_of(contact), contact.force_n
                tiers.add(frame.tier)
        if progress:
            progress(index + 1, count)
    return _Seen(changes, valid, places_mm, loads, forces_n, frozenset(tiers))


def _left_out(others: IntArray) -> list[str]:
    if not len(others):
        return []
    shown = ", ".join(map(str, others[:10])) + (", ..." if len(others) > 10 else "")
    return [f"{len(others)} presses that show no contact, or several, are left out: {shown}"]


def _check_frame(xy_mm: FloatArray, guess_mm: FloatArray, description: SensorDescription) -> None:
    """Refuse coordinates that fit the contacts far better in another frame or unit."""
    known = np.column_stack([xy_mm, np.ones(len(xy_mm))])
    near = np.ones(len(known), bool)
    for _ in range(2):  # again without the fifth that fits worst: single places may be wrong
        map_ = np.linalg.lstsq(known[near], guess_mm[near], rcond=None)[0]
        off_mm = np.linalg.norm(known @ map_ - guess_mm, axis=1)
        near = off_mm <= np.quantile(off_mm, 0.8)
    as_given = float(np.median(np.linalg.norm(xy_mm - guess_mm, axis=1)))
    there = float(np.median(off_mm))
    factors, shift_mm = np.linalg.norm(map_[:2], axis=1), map_[2]
    mirror = 1.0 if np.linalg.det(map_[:2]) >= 0 else -1.0
    turn_deg = np.degrees(
        np.arctan2(map_[0, 1] - mirror * map_[1, 0], map_[0, 0] + mirror * map_[1, 1])
    )
    size_mm = 1e3 * np.array([description.width_m, description.height_m])
    is_like = (
        FACTORS_AS_GIVEN[0] < factors.min() <= factors.max() < FACTORS_AS_GIVEN[1]
        and mirror > 0
        and abs(turn_deg) < TURNED_DEG
        and (np.abs(shift_mm) < SHIFTED_SHARE * size_mm).all()
    )
    if there < OTHER_FRAME_RATIO * as_given and not is_like:
        raise CalibrationError(
            f"places and contacts are {as_given:.0f} mm apart (median), and {there:.0f} mm if x is "
            f"multiplied by {factors[0]:.2g}, y by {mirror * factors[1]:.2g}, both are turned by "
            f"{turn_deg:.0f} degrees and moved by ({shift_mm[0]:.0f}, {shift_mm[1]:.0f}) mm: give "
            "x to the right and y up from the middle, seen from the pressed side, in mm"
        )
    _check_order(xy_mm, guess_mm)
    outside = np.flatnonzero(~description.on_sheet(*1e-3 * xy_mm.T))
    if len(outside):
        place = ", ".join(f"{each:.1f}" for each in xy_mm[outside[0]])
        raise CalibrationError(
            f"{len(outside)} presses are off the skin, the first at ({place}) mm; give places in "
            "mm from its middle"
        )


def _check_order(xy_mm: FloatArray, guess_mm: FloatArray) -> None:
    """Refuse places that from some press on fit the contact of the press before or behind."""
    own_mm = np.linalg.norm(xy_mm - guess_mm, axis=1)
    for shift, why in ((1, "one was stored twice"), (-1, "one is missing")):
        other_mm = np.linalg.norm(np.roll(xy_mm, -shift, axis=0) - guess_mm, axis=1)
        gain = np.cumsum((own_mm - other_mm)[::-1])[::-1]
        first = int(gain.argmax())
        count = len(own_mm) - first
        shifted_mm, as_given_mm = np.median(other_mm[first:]), np.median(own_mm[first:])
        if count > 2 and shifted_mm < OTHER_FRAME_RATIO**2 * as_given_mm:
            raise CalibrationError(
                f"from press {first} on (counted from 0), {count} places fit the contacts of the "
                f"presses beside them: {why}; put the places right, or take them again"
            )


def _odd(
    changes: FloatArray, xy_mm: FloatArray, guess_mm: FloatArray, numbers: IntArray
) -> list[str]:
    """Name the presses that the physics contradicts, or the others where they locate better."""
    odd: dict[int, str] = {}
    best_mm = np.inf
    for found_mm in (guess_mm, PressRegression(changes, xy_mm).found_mm):
        off_mm = np.asarray(np.linalg.norm(found_mm - xy_mm, axis=1))
        median_mm = float(np.median(off_mm))
        for k in np.flatnonzero(off_mm > ODD_RATIO * median_mm) if median_mm < best_mm else ():
            x, y = xy_mm[k]
            odd[numbers[k]] = f"press {numbers[k]} at ({x:.1f}, {y:.1f}) mm"
        best_mm = median_mm
    return [odd[number] for number in sorted(odd)]


def _parts(count: int) -> list[BoolArray]:
    """Which presses (P,) are held out each time, in order of time."""
    part = np.arange(count) * HELD_OUT_PARTS // count
    return [part == k for k in range(HELD_OUT_PARTS)]


def _judged_forces(
    loads: FloatArray, xy_mm: FloatArray, force_n: FloatArray, by_physics_n: FloatArray
) -> tuple[float, list[str]]:
    """Median relative error of held-out forces; NaN where they are not learnt, and then why not."""
    if not np.isfinite(force_n).any():
        return np.nan, []
    known = np.flatnonzero(np.isfinite(force_n * loads))
    if len(known) < MIN_PRESSES:
        why = f"{len(known)} are known of contacts with a magnitude, and {MIN_PRESSES} are needed"
        return np.nan, [f"forces are not learnt: {why}"]
    loads, xy_mm, force_n, by_physics_n = (
        each[known] for each in (loads, xy_mm, force_n, by_physics_n)
    )
    found_n = np.empty(len(known))
    try:
        for out in _parts(len(known)):
            learnt = ForceRegression(loads[~out], xy_mm[~out], force_n[~out])
            found_n[out], _ = learnt.force(loads[out], xy_mm[out])
    except DataError as error:
        return np.nan, [f"forces are not learnt: {error}"]

    def error_of(others_n: FloatArray) -> float:
        there = np.isfinite(others_n)
        off = np.abs(others_n[there] / force_n[there] - 1)
        return float(np.median(off)) if there.any() else np.inf

    taught, physics = error_of(found_n), error_of(by_physics_n)
    alike = error_of(np.full(len(known), np.median(force_n)))
    if taught < min(physics, LEARNT_RATIO * alike):
        times = force_n[np.isfinite(by_physics_n)] / by_physics_n[np.isfinite(by_physics_n)]
        ratio = float(np.median(times)) if len(times) else 1.0
        if 1 / OTHER_UNIT < ratio < OTHER_UNIT:
            return taught, []
        return np.nan, [
            f"forces are not learnt: they are {ratio:.2g} times those of the physics (median); "
            "give newtons, or correct the description's response"
        ]
    others = "" if np.isinf(physics) else f"by the physics alone {physics:.0%}, "
    return np.nan, [
        f"forces are not learnt: held-out ones are {taught:.0%} off (median) as taught, {others}"
        f"and {alike:.0%} if all were alike"
    ]


def _best(changes: FloatArray, xy_mm: FloatArray, guess_mm: FloatArray) -> tuple[str, float, float]:
    """What locates held-out presses best, and the median errors without and with it, mm."""
    places = {"voltages": np.empty_like(xy_mm), "corrected": np.empty_like(xy_mm)}
    for out in _parts(len(xy_mm)):
        rest = ~out
        alone = PressRegression(changes[rest], xy_mm[rest])
        places["voltages"][out] = alone.locate(changes[out]).xy_mm
        corrected = PressRegression(changes[rest], xy_mm[rest], guess_mm[rest])
        places["corrected"][out] = corrected.locate(changes[out], guess_mm[out]).xy_mm

    def errors_mm(found_mm: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(found_mm - xy_mm, axis=1))

    errors = {name: errors_mm(found_mm) for name, found_mm in places.items()}
    physics = errors_mm(guess_mm)
    best = min(errors, key=lambda name: float(np.median(errors[name])))
    without_mm, with_mm = float(np.median(physics)), float(np.median(errors[best]))
    if with_mm >= without_mm or errors[best].mean() >= physics.mean():
        raise CalibrationError(
            f"nothing is kept: of {len(physics)} presses, each quarter judged by what the others "
            f"teach, places are {with_mm:.2f} mm off (median), and the physics alone is "
            f"{without_mm:.2f} mm off; give more presses, spread over the skin"
        )
    middle_mm = float(np.median(np.linalg.norm(xy_mm - xy_mm.mean(axis=0), axis=1)))
    if with_mm > LEARNT_RATIO * middle_mm:
        raise CalibrationError(
            f"nothing is kept: places are {with_mm:.1f} mm off (median) as taught, and would be "
            f"{middle_mm:.1f} mm off if all were in the middle of all: places and voltages do not "
            "belong together, or presses are too few; check the order of both"
        )
    return best, without_mm, with_mm
