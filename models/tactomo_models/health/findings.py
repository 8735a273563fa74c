"""What is found in scans of a skin at rest: how bad each thing is, and what to do about it.

- signal-to-noise ratio: root mean square of the voltages over that of their standard deviation
  about a straight line in time, so that drift is not counted as noise.
- reciprocity error: the mean of |V - V'| over the mean size of V and V', where V' is read with
  drive and measuring pair exchanged; and the same of all voltages together, which goes by their
  size and is what is judged, since a voltage near zero has a large share of any noise.

Sources: Adler et al., "GREIT" (Physiol. Meas. 30, 2009) and Yerworth & Bayford, "The effect of
serial data collection on the accuracy of EIT" on signal-to-noise and reciprocity as figures of
merit; Asfaw & Adler (2005), see `plausibility`, on erroneous electrodes.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.health.examination import (
    BROKEN_SHARE,
    MIN_SCANS_FOR_NOISE,
    SIGNIFICANT,
    Examination,
    noise_about_line,
    rms,
)
from tactomo_models.scans.plausibility import TINY, Flag
from tactomo_models.sensor.pattern import Pairs

GOOD_SNR_DB = 36.0  # 40 dB, less what a few scans know of their own noise
POOR_SNR_DB = 20.0  # presses change voltages by some per cent: below, none can be seen
GOOD_RECIPROCITY = 0.05  # of all voltages together; devices that serve have 1 to 6 %
POOR_RECIPROCITY = 0.2  # nothing can be located
DRIFT_NOTED = 0.5  # per cent a minute: a light press in minutes
DRIFT_POOR = 5.0  # per cent a minute: a light press in seconds
MAX_CHANCE = 2.0  # mean square of changes over their noise: more is no chance with 50 voltages
AT_REST = "leave the skin alone while it is examined; of a file, choose scans at rest by --frames"
LONGER = "; from a daemon by --seconds"


class Level(StrEnum):
    """How bad a finding is; from harmless to worst."""

    OK = "ok"
    UNKNOWN = "unknown"
    ADVICE = "advice"  # it serves; better is possible
    FAULT = "fault"  # to be mended
    BROKEN = "broken"  # nothing can be trusted


def worst(levels: Iterator[Level]) -> Level:
    """Return the worst of some levels; ok if there are none."""
    order = list(Level)
    return max(levels, key=order.index, default=Level.OK)


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    about: str  # what, in a word that programs may rely on
    level: Level  # how bad it is
    detail: str  # what was found, for people
    next_step: str = ""  # what to do about it; empty where nothing need be done
    # the numbers, each with its unit in its name
    figures: Mapping[str, float | list[float] | list[int] | None] = field(default_factory=dict)


def scans_found(count: int, lost: int, still: slice, is_moved: bool) -> Finding:
    """How many scans there are, and which of them are looked at."""
    figures: dict[str, float | list[int]] = {"scans": float(count)}
    if is_moved:
        detail = f"{count} scans, in which something moves"
        if still.stop - still.start < count:
            detail += f": {still.start} to {still.stop - 1}, the stillest, are looked at"
        step = "leave the skin alone while it is examined"
        figures |= {"examined": [still.start, still.stop]}
        return Finding("scans", Level.ADVICE, detail, step, figures)
    if lost:
        detail = f"{count} scans; {lost} more hold values that are not numbers"
        step = "check the converter and the firmware"
        return Finding("scans", Level.ADVICE, detail, step, figures)
    return Finding("scans", Level.OK, f"{count} scan(s)", "", figures)


def snr_found(examined: Examination) -> Finding:
    """The signal-to-noise ratio of all voltages, and of the worst ones."""
    if examined.is_frozen:
        step = "a real converter has some; is it simulated, or does the firmware repeat one scan?"
        return Finding("snr", Level.ADVICE, "there is no noise at all", step)
    if examined.is_moving:
        return Finding("snr", Level.UNKNOWN, "not known: something moves all the time", AT_REST)
    if not examined.has_noise:
        step = f"give at least {MIN_SCANS_FOR_NOISE} scans of the unpressed skin{LONGER}"
        return Finding("snr", Level.UNKNOWN, f"not known from {examined.count} scan(s)", step)
    good = examined.good
    signal, noise = rms(examined.mean[good]), rms(examined.noise[good])
    overall = float(20 * np.log10(max(signal, TINY) / max(noise, TINY)))
    level, step = Level.OK, ""
    if overall < GOOD_SNR_DB:
        level = Level.BROKEN if overall < POOR_SNR_DB else Level.FAULT
        step = "look for interference: cable shields, a loose ground, a motor or charger near by"
    known = np.flatnonzero(np.isfinite(examined.snr_db))
    order = known[np.argsort(examined.snr_db[known])][:3]
    pairs = _voltages_words(examined.pairs, order)
    middle = float(np.median(examined.snr_db[known])) if len(known) else np.nan
    beside = "" if good.all() else " beside the electrodes named below"
    detail = f"{overall:.1f} dB{beside}; of single voltages {middle:.1f} dB (median), worst {pairs}"
    figures = {
        "snr_db": overall,
        "median_db": middle,
        "worst_voltages": order.tolist(),
        "worst_db": examined.snr_db[order].tolist(),
    }
    return Finding("snr", level, detail, step, figures)


def _voltages_words(pairs: Pairs, which: IntArray) -> str:
    """Name voltages as V(drive pair; measuring pair)."""
    return ", ".join(
        f"V({'-'.join(map(str, pairs.drive[n]))}; {'-'.join(map(str, pairs.measure[n]))})"
        for n in which.tolist()
    )


def reciprocity_found(examined: Examination) -> Finding:
    """How far voltages differ that are the same on any sheet."""
    i, j = examined.wiring.reciprocal.T
    if len(i) == 0:
        detail = "the pattern has no reciprocal pairs: no voltage is read twice"
        step = "no fault; drive and measure by the same offset to have this check"
        return Finding("reciprocity", Level.UNKNOWN, detail, step)
    difference = np.abs(examined.mean[i] - examined.mean[j])
    size = np.maximum((np.abs(examined.mean[i]) + np.abs(examined.mean[j])) / 2, TINY)
    each, together = float(np.mean(difference / size)), float(difference.sum() / size.sum())
    good = examined.good[i] & examined.good[j]  # those of no electrode that is known bad
    of_good = float(difference[good].sum() / max(size[good].sum(), TINY))
    noise = np.hypot(examined.noise[i], examined.noise[j]) / np.sqrt(examined.count)
    by_noise = float(np.sqrt(2 / np.pi) * noise.sum() / size.sum())
    beyond = float(np.sqrt(max(together**2 - by_noise**2, 0.0)))
    level, step = Level.OK, ""
    if min(beyond, of_good) > POOR_RECIPROCITY:
        level = Level.BROKEN
        step = (
            "nothing can be located from these voltages: check the order of drive and measuring "
            "pairs, the current source and the multiplexer; measure a resistor phantom"
        )
    elif beyond > GOOD_RECIPROCITY:
        level, step = Level.FAULT, "mend the electrodes that are named; else compare the gains"
    detail = f"error {each:.1%} (mean of pairs), {together:.1%} of all voltages together"
    figures = {"pairs_percent": 1e2 * each, "together_percent": 1e2 * together}
    return Finding("reciprocity", level, detail, step, figures)


_ELECTRODE_WORDS = {
    "dead": ("reads next to nothing", "check its lead and its contact with the sheet"),
    "loose": ("is noisier than the others, or jumps", "fasten its connector; move its lead gently"),
    "misread": ("breaks laws that any sheet obeys", "check its lead for a break or a short"),
}


def electrodes_found(examined: Examination) -> Iterator[Finding]:
    """The electrodes that are bad, by what is wrong with them."""
    states = examined.states
    bad = [n for n, state in enumerate(states) if state != "good"]
    if not bad:
        yield Finding("electrodes", Level.OK, f"all {len(states)} read as they should")
        return
    level, at_once = Level.FAULT, ""
    if len(bad) > BROKEN_SHARE * len(states):
        level = Level.BROKEN
        at_once = "so many at once are rather the multiplexer, the ground or the order of the pairs"
    for state, (what, step) in _ELECTRODE_WORDS.items():
        named = [n for n in bad if states[n] == state]
        if named:
            numbers = ", ".join(map(str, named))
            subject = f"electrodes {numbers}: each" if len(named) > 1 else f"electrode {numbers}"
            figures = {"electrodes": named}
            yield Finding(
                f"{state}_electrodes", level, f"{subject} {what}", at_once or step, figures
            )
    if examined.order.exchanged:
        pairs = " and ".join(f"{a} with {b}" for a, b in examined.order.exchanged)
        detail, step = f"leads changed places: {pairs}", "exchange the plugs, then tare"
        figures = {"electrodes": sorted(itertools.chain(*examined.order.exchanged))}
        yield Finding("swapped_electrodes", Level.FAULT, detail, step, figures)


def model_found(examined: Examination, is_of_sheet: bool | None, is_moved: bool) -> Finding:
    """Whether the voltages are those of the sensor that is described, if that is known."""
    if is_of_sheet is None:
        detail = "no description of the sheet: swapped electrodes cannot be found"
        return Finding("model", Level.UNKNOWN, detail, "give the sensor's description")
    if examined.order.turned:
        detail = f"all leads are on by {examined.order.turned} of {len(examined.states)} electrodes"
        step = "turn the plug, or renumber the electrodes in the description"
        return Finding("model", Level.FAULT, detail, step)
    if is_of_sheet:
        return Finding("model", Level.OK, "as the description says")
    detail = "the voltages are not those of this sensor unloaded"
    step = "does something press, are leads in another order, or is this another sensor?"
    return Finding("model", Level.ADVICE if is_moved else Level.FAULT, detail, step)


def saturation_found(examined: Examination, saturated: int) -> Finding:
    """How many scans the converter clipped; `saturated` is what the device says of that."""
    count = len(examined.later)
    clipped = max(saturated, sum(Flag.SATURATED in flags for flags, _ in examined.later))
    if not clipped:
        return Finding("saturation", Level.OK, "no scan was clipped")
    detail, step = f"{clipped} of {count} scans were clipped", "lower the gain or the current"
    figures = {"clipped_percent": 1e2 * clipped / count}
    return Finding("saturation", Level.FAULT, detail, step, figures)


def drift_found(still: FloatArray, times_s: FloatArray | None) -> Finding:
    """How fast the scans at rest (n, M) change; `times_s` (n,) says when each was taken."""
    if times_s is None:
        step = "give scans with their times, or a recording"
        return Finding("drift", Level.UNKNOWN, "not known: nobody says when scans were taken", step)
    span_s = float(times_s[-1] - times_s[0])
    if len(times_s) < 3 or span_s < 2:  # a mains beat is no drift
        at_least = "3 scans" if len(times_s) < 3 else "2 s"
        step = f"examine {at_least} at rest, or more{LONGER}"
        detail = f"not known from {len(times_s)} scan(s) at rest in {span_s:.1f} s"
        return Finding("drift", Level.UNKNOWN, detail, step)
    mean = still.mean(axis=0)
    gain = still @ mean / max(float(mean @ mean), TINY)
    time = times_s - times_s.mean()
    slope = float(time @ (gain - gain.mean()) / (time @ time))
    residual = gain - gain.mean() - slope * time
    sigma = float(np.sqrt((residual @ residual) / (len(time) - 2) / (time @ time)))
    percent, sigma = 6e3 * slope, 6e3 * sigma
    if _changes_unevenly(still, time):
        detail = "the voltages change, and not all alike: something presses, or a contact changes"
        step = f"{AT_REST}; if it stays so, check the electrodes"
        return Finding("drift", Level.ADVICE, detail, step)
    level, step = Level.OK, ""
    if abs(percent) > max(DRIFT_NOTED, SIGNIFICANT * sigma):
        level, step = Level.ADVICE, "let it warm up; tare now and then"
    if abs(percent) > max(DRIFT_POOR, SIGNIFICANT * sigma):
        level, step = Level.FAULT, "let it warm up; look for moisture, strain or a weak contact"
    figures = {"percent_per_min": percent, "sigma_percent_per_min": sigma}
    detail = f"{percent:+.2f} % a minute (standard uncertainty {sigma:.2f})"
    return Finding("drift", level, detail, step, figures)


def _changes_unevenly(still: FloatArray, time: FloatArray) -> bool:
    """Tell whether voltages change half as much otherwise as all by the same factor."""
    slopes = time @ (still - still.mean(axis=0)) / (time @ time)
    mean = still.mean(axis=0)
    alike = mean * (mean @ slopes) / max(float(mean @ mean), TINY)
    sigma = noise_about_line(still) / np.sqrt(time @ time)
    if not sigma.all():
        return False
    chance = np.mean(((slopes - alike) / sigma) ** 2)
    return bool(chance > MAX_CHANCE and rms(slopes - alike) > rms(alike) / 2)
