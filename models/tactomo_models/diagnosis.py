"""What scans of a skin at rest show of its health: noise, reciprocity, electrodes, clipping, drift.

Pure functions from voltages to findings, each with what to do about it. What is a fault of a scan
is defined in `plausibility`; here many scans are looked at together, which shows more: how noisy
each voltage is, a lead that is loose now and then, two leads that changed places.

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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from tactomo_models.description import SensorDescription
from tactomo_models.errors import DataError
from tactomo_models.forward import exchanged, scan_voltages
from tactomo_models.pattern import Pairs, scan_pairs
from tactomo_models.plausibility import (
    MOST_DEVIATION,
    TINY,
    Flag,
    Layout,
    ScanCheck,
    Wiring,
    asymmetry_of,
    deviation,
    examine_reference,
)
from tactomo_models.signs import Signs

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

GOOD_SNR_DB = 36.0  # 40 dB, less what a few scans know of their own noise
POOR_SNR_DB = 20.0  # presses change voltages by some per cent: below, none can be seen
GOOD_RECIPROCITY = 0.05  # of all voltages together; devices that serve have 1 to 6 %
POOR_RECIPROCITY = 0.2  # nothing can be located
FEWEST_FOR_NOISE = 5  # scans
STILL = 1e-3  # movement over the voltages, rms, that a skin at rest does not reach in a second
UNSTEADY = 1e-2  # likewise where no time tells, only reciprocity
STILL_NOISES = 3.0  # or times its noise
STILLEST = 20  # scans that are looked at where the others move
LOOSE_NOISE = 4.0  # times the noise that its size leads one to expect
LOOSE_SCANS = 2  # in so many an electrode reads nonsense, and not in the others
DEAD_SHARE = 0.1  # of the size expected
BROKEN_SHARE = 1 / 3  # of the electrodes
MOST_EXCHANGES = 3
EXCHANGE_GAIN = 0.5  # of the deviation that must be left after an exchange, at most
DRIFT_NOTED = 0.5  # per cent a minute: tare now and then
DRIFT_POOR = 5.0  # per cent a minute
SHORTEST_FOR_DRIFT_S = 2.0
MOST_CHANCE = 2.0  # mean square of changes over their noise: more is no chance with 50 voltages
UNEVEN_CHANGE = 0.5  # of the even change
SIGNIFICANT = 4.0  # standard deviations


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
    """One thing that was looked at.

    Attributes:
        about: what, in a word that programs may rely on.
        level: how bad it is.
        detail: what was found, for people.
        next_step: what to do about it; empty where nothing need be done.
        figures: the numbers, each with its unit in its name.
    """

    about: str
    level: Level
    detail: str
    next_step: str = ""
    figures: Mapping[str, float | list[float] | list[int] | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Diagnosis:
    """What was found out about one channel.

    Attributes:
        findings: one for each thing that was looked at.
        electrodes: (L,) state of each: good, dead, loose, misread or swapped.
        noise: (L,) how many times noisier than the others the voltages of each are.
        volts: (M,) mean of the scans that were looked at.
        snr_db: (M,) of each voltage; NaN where unknown.
        reciprocal: (n, 2) positions of reciprocal voltages.
        pairs: electrodes of each voltage.
    """

    findings: tuple[Finding, ...]
    electrodes: tuple[str, ...]
    noise: FloatArray
    volts: FloatArray
    snr_db: FloatArray
    reciprocal: NDArray[np.intp]
    pairs: Pairs

    @property
    def level(self) -> Level:
        """The worst of the findings; unknown where neither noise nor reciprocity could be told."""
        found = worst(finding.level for finding in self.findings if finding.level != Level.UNKNOWN)
        known = {f.about for f in self.findings if f.level != Level.UNKNOWN}
        serious = found in (Level.FAULT, Level.BROKEN)
        return found if serious or known & {"snr", "reciprocity"} else Level.UNKNOWN


@dataclass(frozen=True)
class PatternLayout:
    """A pattern without a sheet: for devices of which no description is at hand."""

    pairs: Pairs
    electrode_count: int


def diagnose(
    layout: Layout,
    scans: FloatArray,
    *,
    times_s: FloatArray | None = None,
    transfer: FloatArray | None = None,
    contrast: float = 100.0,
    saturated: int = 0,
) -> Diagnosis:
    """Examine scans of a skin on which nothing presses.

    Where something does, the stillest scans are looked at for all but clipping and loose leads.

    Args:
        layout: the sensor's description, or its pattern alone.
        scans: (T, M) volts, on any scale.
        times_s: (T,) when each was taken; drift stays unknown without.
        transfer: (L, L) transfer resistances of the sheet's model, see `BareSheet`; without them
            voltages are held against their likes further round the rim.
        contrast: factor by which pressing changes conductivity at most.
        saturated: scans of which the device said that it clipped.

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
    still = _stillest(wiring, scans)
    is_moved = still != slice(0, len(scans)) or _moves(wiring, scans)
    examined = _Examined(wiring, layout, scans, still, transfer, contrast)
    findings = [
        _scans_found(len(scans), int((~whole).sum()), still, is_moved),
        _snr_found(examined),
        _reciprocity_found(examined),
        *_electrodes_found(examined),
        _model_found(examined, transfer is not None, is_moved),
        _saturation_found(examined, saturated),
        _drift_found(scans[still], None if times_s is None else times_s[still]),
    ]
    return Diagnosis(
        tuple(finding for finding in findings if finding is not None),
        tuple(examined.states),
        examined.electrode_noise,
        examined.mean,
        examined.snr_db,
        examined.wiring.reciprocal,
        layout.pairs,
    )


class _Examined:
    """All that is worked out from the scans of one channel, before it is put into words."""

    def __init__(
        self,
        wiring: Wiring,
        layout: Layout,
        scans: FloatArray,
        still: slice,
        transfer: FloatArray | None,
        contrast: float,
    ) -> None:
        self.wiring = wiring
        self.pairs = layout.pairs
        at_rest = scans[still]
        self.count = len(at_rest)
        self.mean = at_rest.mean(axis=0)
        self.noise = noise_about_line(at_rest)
        self.is_moving = _moves(wiring, at_rest)
        self.has_noise = self.count >= FEWEST_FOR_NOISE and not self.is_moving
        self.is_frozen = self.count >= 3 and not self.noise.any()
        self.snr_db = _decibels(np.abs(self.mean), self.noise)
        excess = _excess_noise(self.mean, self.noise)
        self.electrode_noise = np.array([np.median(excess[t]) for t in self.wiring.electrodes])
        of_mean = self.noise / np.sqrt(self.count)
        self.sought = _sought(wiring, layout, transfer)
        self.order = self._order(layout, transfer, of_mean)
        expected = self.order.expected
        if (scans >= 0).all():  # a device that reports sizes alone
            expected = np.abs(expected)
        self.verdict = examine_reference(
            self.wiring, self.mean, expected, of_mean, contrast, self.sought
        )
        self.later = self._each(scans, contrast)
        self.states = self._states(layout.electrode_count, excess, expected)
        self.good = self._good()

    def _order(self, layout: Layout, transfer: FloatArray | None, noise: FloatArray) -> Order:
        if isinstance(layout, SensorDescription) and transfer is not None:
            return find_order(layout, transfer, self.mean, noise, self.sought)
        return Order((), 0, _likes(layout, self.mean))

    def _each(self, scans: FloatArray, contrast: float) -> list[tuple[Flag, tuple[int, ...]]]:
        """What is wrong with each single scan, by laws that hold whatever presses."""
        bad = list(self.verdict.electrodes)
        usable = (self.mean != 0) & self.sought & ~self.wiring.electrodes[bad].any(axis=0)
        own = asymmetry_of(self.wiring, self.mean)
        check = ScanCheck(self.wiring, self.mean, self.noise, usable, contrast, own)
        verdicts = [check.examine(scan) for scan in scans]
        return [(verdict.flags, verdict.electrodes) for verdict in verdicts]

    def _states(self, count: int, excess: FloatArray, expected: FloatArray) -> list[str]:
        states = ["good"] * count
        noisy = set(self.wiring.blamed(excess > LOOSE_NOISE)) if self.has_noise else set()
        hits = np.bincount([e for _, found in self.later for e in found] or [0], minlength=count)
        loose = noisy | set(np.flatnonzero(hits >= LOOSE_SCANS).tolist() if any(hits) else [])
        scale = _scale(self.mean, expected)
        for electrode in {*self.verdict.electrodes, *loose}:
            touched = self.wiring.electrodes[electrode]
            share = np.abs(self.mean[touched]) / np.maximum(scale * np.abs(expected[touched]), TINY)
            is_dead = float(np.median(share)) < DEAD_SHARE
            states[electrode] = "dead" if is_dead else "loose" if electrode in loose else "misread"
        for electrode in itertools.chain(*self.order.exchanged):
            states[electrode] = "swapped"
        return states

    def _good(self) -> BoolArray:
        """Voltages (M,) that no bad electrode has part in; all where most electrodes are bad."""
        bad = [n for n, state in enumerate(self.states) if state not in ("good", "swapped")]
        good = self.sought & ~self.wiring.electrodes[bad].any(axis=0)
        few = len(bad) > BROKEN_SHARE * len(self.states)
        return self.sought if few or not good.any() else good


def _sought(wiring: Wiring, layout: Layout, transfer: FloatArray | None) -> BoolArray:
    """Voltages (M,) that the instrument reads at all."""
    if not isinstance(layout, SensorDescription) or transfer is None:
        return np.ones(len(layout.pairs.drive), dtype=bool)
    return Signs(layout, wiring, scan_voltages(layout, transfer)).certain


def noise_about_line(scans: FloatArray) -> FloatArray:
    """Standard deviation (M,) of scans (n, M) about a straight line in time; 0 where unknown."""
    count = len(scans)
    if count < 3:
        return np.zeros(scans.shape[1])
    line = np.linspace(-1, 1, count)
    line /= np.linalg.norm(line)
    rest = scans - scans.mean(axis=0)
    rest = rest - np.outer(line, line @ rest)
    noise = np.sqrt((rest**2).sum(axis=0) / (count - 2))
    return np.asarray(np.where(noise > 1e-12 * np.abs(scans).max(), noise, 0.0))


def _decibels(signal: FloatArray, noise: FloatArray) -> FloatArray:
    known = (noise > 0) & (signal > 0)
    ratio = np.divide(signal, noise, out=np.ones_like(signal), where=known)
    return np.where(known, 20 * np.log10(ratio), np.nan)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _scale(volts: FloatArray, expected: FloatArray) -> float:
    """Factor from what is expected to what is read, whatever the units."""
    known = expected != 0
    return float(np.median(np.abs(volts[known] / expected[known]))) if known.any() else 1.0


def _stillest(wiring: Wiring, scans: FloatArray) -> slice:
    """The scans to look at: all of them, or the stillest few where the others move."""
    if len(scans) <= STILLEST or not _moves(wiring, scans):
        return slice(0, len(scans))
    starts = range(0, len(scans) - STILLEST + 1, STILLEST // 2)
    spread = [_rms(scans[n : n + STILLEST].std(axis=0)) for n in starts]
    first = starts[int(np.argmin(spread))]
    return slice(first, first + STILLEST)


def _moves(wiring: Wiring, scans: FloatArray) -> bool:
    """Tell what changes on the sheet from noise.

    Noise differs from scan to scan, and in both of two reciprocal voltages. What presses goes on
    from scan to scan and changes both alike, as do small unsteady gains, which are let pass.
    """
    if len(scans) < FEWEST_FOR_NOISE:
        return False
    spread, size = _rms(noise_about_line(scans)), _rms(scans)

    def beyond(noise: float, still: float) -> bool:
        return spread**2 - noise**2 > max(still * size, STILL_NOISES * noise) ** 2

    i, j = wiring.reciprocal.T
    unequal = _rms(noise_about_line(scans[:, i] - scans[:, j])) if len(i) else spread
    return beyond(_rms(np.diff(scans, axis=0)) / np.sqrt(2), STILL) or beyond(
        unequal / np.sqrt(2), UNSTEADY
    )


def _likes(layout: Layout, volts: FloatArray) -> FloatArray:
    """Voltages (M,) as the median of those that lie alike to their drive, further round the rim."""
    drive, measure = layout.pairs.drive, layout.pairs.measure
    turned = (np.column_stack([drive[:, 1], measure]) - drive[:, :1]) % layout.electrode_count
    expected = np.empty_like(volts)
    for kind in np.unique(turned, axis=0):
        alike = (turned == kind).all(axis=1)
        expected[alike] = np.median(volts[alike])
    return np.where(expected == 0, np.median(np.abs(volts)) or 1.0, expected)


def _excess_noise(volts: FloatArray, noise: FloatArray) -> FloatArray:
    """Noise (M,) over what is usual at a voltage's size: a floor, and a share of the voltage."""
    size = np.abs(volts)
    small = size <= np.median(size)
    floor = float(np.median(noise[small]))
    share = float(np.median(noise[~small] / size[~small])) if not small.all() else 0.0
    usual = np.hypot(floor, share * size)
    return np.divide(noise, usual, out=np.ones_like(noise), where=usual > 0)


@dataclass(frozen=True)
class Order:
    """Which leads are not where they belong, and what is expected with them so.

    Attributes:
        exchanged: pairs of electrodes whose leads changed places.
        turned: places by which all leads are on; 0 where they are not.
        expected: (M,) the model's voltages in that order, relative.
    """

    exchanged: tuple[tuple[int, int], ...]
    turned: int
    expected: FloatArray


def find_order(
    description: SensorDescription,
    transfer: FloatArray,
    volts: FloatArray,
    noise: FloatArray,
    sought: BoolArray | bool = True,
) -> Order:
    """Find the order of leads that explains the voltages (M,) of an unpressed skin.

    Where the order of the description does not, all leads are turned, or else one exchange of two
    leads at a time is taken, the one that explains most, and only where that is much. A turn by
    what leaves the sheet the same, such as a quarter of a square, cannot be seen.

    Args:
        description: the sensor.
        transfer: (L, L) the model's transfer resistances.
        volts: (M,) measured, on any scale; where none is negative, sizes alone are compared.
        noise: (M,) their standard deviation.
        sought: (M,) those to go by.
    """
    known = np.broadcast_to(sought, volts.shape)
    count = description.electrode_count
    is_unsigned = bool((volts >= 0).all())

    def trial(order: Sequence[int]) -> tuple[float, FloatArray]:
        moved = scan_voltages(description, exchanged(transfer, order))
        moved = np.abs(moved) if is_unsigned else moved
        return _deviation(volts[known], moved[known], noise[known]), moved

    straight = list(range(count))
    left, described = trial(straight)
    if left <= MOST_DEVIATION:
        return Order((), 0, described)
    limit = min(MOST_DEVIATION, EXCHANGE_GAIN * left)
    for turn in sorted(range(1, count), key=lambda n: min(n, count - n)):
        after, moved = trial([*straight[turn:], *straight[:turn]])
        if after < limit:
            return Order((), turn, moved)
    order, expected = straight, described
    found: list[tuple[int, int]] = []
    while left > MOST_DEVIATION and len(found) < MOST_EXCHANGES:
        trials = [
            (*trial(_swapped(order, pair)), pair)
            for pair in itertools.combinations(range(count), 2)
        ]
        after, moved, pair = min(trials, key=lambda made: made[0])
        if after > EXCHANGE_GAIN * left:
            break
        left, expected, order = after, moved, _swapped(order, pair)
        found.append(pair)
    # Halfway is no explanation: the rest would be blamed on leads that are where they belong.
    if left > MOST_DEVIATION:
        return Order((), 0, described)
    return Order(tuple(found), 0, expected)


def _swapped(order: Sequence[int], pair: tuple[int, int]) -> list[int]:
    made = list(order)
    made[pair[0]], made[pair[1]] = made[pair[1]], made[pair[0]]
    return made


def _deviation(volts: FloatArray, expected: FloatArray, noise: FloatArray) -> float:
    """Deviation from the model after the common factor that explains most voltages."""
    scale = float(np.median(volts / expected))
    if scale == 0:
        return np.inf
    return deviation(volts / scale, expected, noise / abs(scale), np.ones(len(volts), dtype=bool))


def _scans_found(count: int, lost: int, still: slice, is_moved: bool) -> Finding:
    figures = {"scans": float(count)}
    if is_moved:
        which = f"{still.start} to {still.stop - 1}, the stillest, are looked at"
        whole = still.stop - still.start == count
        return Finding(
            "scans",
            Level.ADVICE,
            f"{count} scans, in which something moves" + ("" if whole else f": {which}"),
            "leave the skin alone while it is examined",
            {**figures, "examined": [still.start, still.stop]},
        )
    if lost:
        return Finding(
            "scans",
            Level.ADVICE,
            f"{count} scans; {lost} more hold values that are not numbers",
            "check the converter and the firmware",
            figures,
        )
    return Finding("scans", Level.OK, f"{count} scan(s)", "", figures)


def _snr_found(examined: _Examined) -> Finding:
    if examined.is_frozen:
        return Finding(
            "snr",
            Level.ADVICE,
            "there is no noise at all",
            "a real converter has some; is it simulated, or does the firmware send one scan again?",
        )
    if examined.is_moving:
        step = "leave the skin alone while it is examined; give scans of one device at rest"
        return Finding("snr", Level.UNKNOWN, "not known: something moves all the time", step)
    if not examined.has_noise:
        step = f"give at least {FEWEST_FOR_NOISE} scans of the unpressed skin"
        return Finding("snr", Level.UNKNOWN, f"not known from {examined.count} scan(s)", step)
    good = examined.good
    signal, noise = _rms(examined.mean[good]), _rms(examined.noise[good])
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
    return Finding(
        "snr",
        level,
        f"{overall:.1f} dB{beside}; of single voltages {middle:.1f} dB (median), worst {pairs}",
        step,
        {
            "snr_db": overall,
            "median_db": middle,
            "worst_voltages": order.tolist(),
            "worst_db": examined.snr_db[order].tolist(),
        },
    )


def _voltages_words(pairs: Pairs, which: NDArray[np.intp]) -> str:
    """Name voltages as V(drive pair; measuring pair)."""
    return ", ".join(
        f"V({'-'.join(map(str, pairs.drive[n]))}; {'-'.join(map(str, pairs.measure[n]))})"
        for n in which.tolist()
    )


def _reciprocity_found(examined: _Examined) -> Finding:
    i, j = examined.wiring.reciprocal.T
    if len(i) == 0:
        return Finding(
            "reciprocity",
            Level.UNKNOWN,
            "the pattern has no reciprocal pairs: no voltage is read twice",
            "no fault; drive and measure by the same offset to have this check",
        )
    one, other = examined.mean[i], examined.mean[j]
    difference, size = np.abs(one - other), (np.abs(one) + np.abs(other)) / 2
    together = float(difference.sum() / max(size.sum(), TINY))
    each = float(np.mean(difference / np.maximum(size, TINY)))
    chance = np.hypot(examined.noise[i], examined.noise[j]) / np.sqrt(examined.count)
    by_noise = float(np.sqrt(2 / np.pi) * chance.sum() / max(size.sum(), TINY))
    beyond = float(np.sqrt(max(together**2 - by_noise**2, 0.0)))
    level, step = Level.OK, ""
    if beyond > GOOD_RECIPROCITY:
        level, step = Level.FAULT, "mend the electrodes that are named; else compare the gains"
    if beyond > POOR_RECIPROCITY:
        level = Level.BROKEN if _reciprocity_of_good(examined) > POOR_RECIPROCITY else Level.FAULT
    if level == Level.BROKEN:
        step = (
            "nothing can be located from these voltages: check the order of drive and measuring "
            "pairs, the current source and the multiplexer; measure a resistor phantom"
        )
    return Finding(
        "reciprocity",
        level,
        f"error {each:.1%} (mean of pairs), {together:.1%} of all voltages together",
        step,
        {"pairs_percent": 1e2 * each, "together_percent": 1e2 * together},
    )


def _reciprocity_of_good(examined: _Examined) -> float:
    """Reciprocity error of all voltages together but those of electrodes that are known bad."""
    i, j = examined.wiring.reciprocal.T
    keep = examined.good[i] & examined.good[j]
    one, other = examined.mean[i[keep]], examined.mean[j[keep]]
    size = (np.abs(one) + np.abs(other)).sum() / 2
    return float(np.abs(one - other).sum() / max(size, TINY))


_ELECTRODE_WORDS = {
    "dead": ("reads next to nothing", "check its lead and its contact with the sheet"),
    "loose": ("is noisier than the others, or jumps", "fasten its connector; move its lead gently"),
    "misread": ("breaks laws that any sheet obeys", "check its lead for a break or a short"),
}


def _electrodes_found(examined: _Examined) -> Iterator[Finding]:
    states = examined.states
    bad = [n for n, state in enumerate(states) if state != "good"]
    if not bad:
        yield Finding("electrodes", Level.OK, f"all {len(states)} read as they should")
        return
    many = len(bad) > BROKEN_SHARE * len(states)
    for state, (what, step) in _ELECTRODE_WORDS.items():
        named = [n for n in bad if states[n] == state]
        if named:
            plural = f"electrodes {_numbers(named)}: each" if len(named) > 1 else _only(named)
            yield Finding(
                f"{state}_electrodes",
                Level.BROKEN if many else Level.FAULT,
                f"{plural} {what}",
                "so many at once are rather the multiplexer, the ground or the order of the pairs"
                if many
                else step,
                {"electrodes": named},
            )
    if examined.order.exchanged:
        told = " and ".join(f"{a} with {b}" for a, b in examined.order.exchanged)
        yield Finding(
            "swapped_electrodes",
            Level.FAULT,
            f"leads changed places: {told}",
            "exchange the plugs, then tare",
            {"electrodes": sorted(itertools.chain(*examined.order.exchanged))},
        )


def _numbers(named: Sequence[int]) -> str:
    return ", ".join(map(str, named))


def _only(named: Sequence[int]) -> str:
    return f"electrode {named[0]}"


def _model_found(examined: _Examined, has_model: bool, is_moved: bool) -> Finding:
    if not has_model:
        return Finding(
            "model",
            Level.UNKNOWN,
            "no description of the sheet: swapped electrodes cannot be told",
            "give the sensor's description",
        )
    if examined.order.turned:
        return Finding(
            "model",
            Level.FAULT,
            f"all leads are on by {examined.order.turned} of {len(examined.states)} electrodes",
            "turn the plug, or renumber the electrodes in the description",
        )
    if Flag.REFERENCE_MISMATCH not in examined.verdict.flags:
        return Finding("model", Level.OK, "as the description says")
    return Finding(
        "model",
        Level.ADVICE if is_moved else Level.FAULT,
        "the voltages are not those of this sensor unloaded",
        "does something press, are leads in another order, or is this another sensor?",
    )


def _saturation_found(examined: _Examined, saturated: int) -> Finding:
    count = len(examined.later)
    clipped = max(saturated, sum(Flag.SATURATED in flags for flags, _ in examined.later))
    if not clipped:
        return Finding("saturation", Level.OK, "no scan was clipped")
    return Finding(
        "saturation",
        Level.FAULT,
        f"{clipped} of {count} scans were clipped",
        "lower the gain or the current",
        {"clipped_percent": 1e2 * clipped / count},
    )


def _drift_found(still: FloatArray, times_s: FloatArray | None) -> Finding:
    span_s = 0.0 if times_s is None or len(times_s) < 3 else float(times_s[-1] - times_s[0])
    if times_s is None or span_s < SHORTEST_FOR_DRIFT_S:
        step = f"look at {SHORTEST_FOR_DRIFT_S:g} s or more, with times"
        return Finding("drift", Level.UNKNOWN, "not known", step)
    mean = still.mean(axis=0)
    gain = still @ mean / max(float(mean @ mean), TINY)
    time = times_s - times_s.mean()
    slope = float(time @ (gain - gain.mean()) / (time @ time))
    rest = gain - gain.mean() - slope * time
    sigma = float(np.sqrt((rest @ rest) / (len(time) - 2) / (time @ time)))
    percent, sigma = 6e3 * slope, 6e3 * sigma
    if _changes_unevenly(still, time):
        return Finding(
            "drift",
            Level.ADVICE,
            "the voltages change, and not all alike: something presses, or a contact changes",
            "leave the skin alone while it is examined; if it stays so, check the electrodes",
        )
    level, step = Level.OK, ""
    if abs(percent) > max(DRIFT_NOTED, SIGNIFICANT * sigma):
        level, step = Level.ADVICE, "let it warm up; tare now and then"
    if abs(percent) > max(DRIFT_POOR, SIGNIFICANT * sigma):
        level, step = Level.FAULT, "let it warm up; look for moisture, strain or a weak contact"
    figures = {"percent_per_min": percent, "sigma_percent_per_min": sigma}
    detail = f"{percent:+.2f} % a minute (standard uncertainty {sigma:.2f})"
    return Finding("drift", level, detail, step, figures)


def _changes_unevenly(still: FloatArray, time: FloatArray) -> bool:
    """Tell whether voltages change otherwise than all by the same factor."""
    slopes = time @ (still - still.mean(axis=0)) / (time @ time)
    mean = still.mean(axis=0)
    alike = mean * (mean @ slopes) / max(float(mean @ mean), TINY)
    sigma = noise_about_line(still) / np.sqrt(time @ time)
    if not sigma.all():
        return False
    chance = np.mean(((slopes - alike) / sigma) ** 2)
    return bool(chance > MOST_CHANCE and _rms(slopes - alike) > UNEVEN_CHANGE * _rms(alike))


def pattern_of_zeros(scans: FloatArray) -> PatternLayout:
    """Read the pattern off scans (T, L * L) of every drive pair by every measuring pair.

    A device that reports all L measuring pairs for each of L drives has 0 where a measuring pair
    touches a driven electrode: that happens at m - k in {0, drive offset, minus measuring offset,
    their difference}, which tells both offsets. `without_zeros` leaves them out.

    Raises:
        DataError: the number of voltages is no square, or the zeros do not fit just one pattern.
    """
    count = round(np.sqrt(scans.shape[1]))
    if count * count != scans.shape[1]:
        raise DataError(
            f"scans of {scans.shape[1]} voltages are not every drive by every measuring pair; "
            "give --description, or a lookup of electrodes"
        )
    zero = (scans == 0).all(axis=0).reshape(count, count)
    always = [n for n in range(count) if np.all(zero[range(count), (np.arange(count) + n) % count])]
    fits = [
        (drive, measure)
        for drive, measure in itertools.product(range(1, count // 2 + 1), repeat=2)
        if {0, drive, -measure % count, (drive - measure) % count} == set(always)
    ]
    if len(fits) != 1:
        raise DataError(
            f"the zeros of these {count} x {count} voltages fit {len(fits)} patterns of drive and "
            "measuring pairs; give --description, or a lookup of electrodes"
        )
    return PatternLayout(scan_pairs(count, *fits[0]), count)


def without_zeros(layout: PatternLayout, scans: FloatArray) -> FloatArray:
    """Return the scans (T, M) without the measuring pairs that touch a driven electrode."""
    position = layout.pairs.drive[:, 0] * layout.electrode_count + layout.pairs.measure[:, 0]
    return np.asarray(scans[:, position])
