"""What the paper prints and says of its figures, each beside what comes out here.

Its numbers of Figs. 7 to 12 were measured on hardware, those of Fig. 5 simulated; ours are all
simulated. Where it gives words alone, the bound that stands for a word is one of the constants.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Final, Literal

import numpy as np

from tactomo_models.evaluation.measures import mean
from tactomo_models.evaluation.paper import (
    COUNTS,
    SNR_DB,
    Cell,
    Estimates,
    Localisation,
    MagnitudeError,
    Response,
    SeveralAreas,
)

Source = Literal["hardware", "simulated"]

TIKHONOV: Final = "tikhonov"
SINGLE: Final = "cnn-single"
MULTIMODAL: Final = "cnn-multimodal"

# Figs. 8 and 9: magnitude error, and the pressure at which it was that large, in kPa.
MAGNITUDE_ERROR: Final = {TIKHONOV: (0.76, 200.0), SINGLE: (0.57, 160.0), MULTIMODAL: (0.21, 180.0)}
# Fig. 10: mean and standard deviation, in mm.
LOCALISATION_MM: Final = {TIKHONOV: (7.7, 6.6), SINGLE: (7.6, 5.8), MULTIMODAL: (6.4, 5.5)}

ONSET_KPA: Final = 140.0
SATURATED_KPA: Final = 100.0

BARELY: Final = 0.01  # of ICC: "barely any difference"
SLIGHTLY: Final = 0.05  # of ICC: "only slightly decreased"
STABLE: Final = 0.05  # of the last reading
MOST: Final = 0.75  # of the cases
HALF: Final = 0.5  # of them: what chance alone would give


@dataclass(frozen=True)
class Claim:
    """A statement of the paper.

    Attributes:
        figure: that it is about.
        source: what it was seen on.
        says: the statement.
        ours: what it comes to here; empty where a method is not at hand.
        holds: whether it is so here, too; None where a method is not at hand.
    """

    figure: int
    source: Source
    says: str
    ours: str
    holds: bool | None


def simulation_claims(cells: Sequence[Cell]) -> list[Claim]:
    """Statements about Fig. 5."""
    icc = {(c.method, c.snr_db, c.contacts): c.summary.icc for c in cells}
    rie = {(c.method, c.snr_db, c.contacts): c.summary.rie for c in cells}
    methods = {cell.method for cell in cells}

    def beats(one: str, other: str, counts: Iterable[int] = COUNTS) -> list[bool]:
        """Whether by both measures, for each count and ratio."""
        at = [(snr_db, count) for snr_db in SNR_DB for count in counts]
        return [
            icc[one, *key] > icc[other, *key] and rie[one, *key] < rie[other, *key] for key in at
        ]

    def gain(count: int) -> float:
        return mean(icc[MULTIMODAL, snr, count] - icc[SINGLE, snr, count] for snr in SNR_DB)

    def loss(snr_db: float) -> float:
        """Largest of the methods' mean losses of ICC against noise-free data."""
        known = [method for method in (TIKHONOV, SINGLE, MULTIMODAL) if method in methods]
        clean = SNR_DB[0]
        return max(mean(icc[m, clean, n] - icc[m, snr_db, n] for n in COUNTS) for m in known)

    claim = _claims(5, "simulated", methods)
    pair = (SINGLE, MULTIMODAL)
    return [
        claim(
            "both CNNs are more accurate than Tikhonov regularisation",
            (TIKHONOV, *pair),
            lambda: _all(beats(SINGLE, TIKHONOV) + beats(MULTIMODAL, TIKHONOV), "cells"),
        ),
        claim(
            "one or two areas: the multimodal CNN is the better one",
            pair,
            lambda: _all(beats(MULTIMODAL, SINGLE, (1, 2)), "cells"),
        ),
        claim(
            "three areas: it has barely any advantage",
            pair,
            lambda: (f"ICC {gain(3):+.3f}", abs(gain(3)) < BARELY),
        ),
        claim(
            "four areas: the single CNN is the better one",
            pair,
            lambda: _all(beats(SINGLE, MULTIMODAL, (4,)), "cells"),
        ),
        claim(
            "40 dB: barely any difference from noise-free, whatever the method",
            (TIKHONOV,),
            lambda: (f"ICC falls by {loss(40.0):.3f} at most", loss(40.0) < BARELY),
        ),
        claim(
            "10 dB: only slightly less accurate, whatever the method",
            (TIKHONOV,),
            lambda: (f"ICC falls by {loss(10.0):.3f} at most", loss(10.0) < SLIGHTLY),
        ),
    ]


def response_claims(points: Sequence[Response]) -> list[Claim]:
    """Statements about Fig. 7, of the means over the sensors."""
    pressures = sorted({point.pressure_kpa for point in points})

    def reading(name: Literal["magnitude", "structure"], kpa: float) -> float:
        return mean(point.peak[name] for point in points if point.pressure_kpa == kpa)

    last = pressures[-1]
    structure = [reading("structure", kpa) for kpa in pressures if kpa >= SATURATED_KPA]
    floor = max(reading("magnitude", kpa) for kpa in pressures if kpa < ONSET_KPA)
    above = [reading("magnitude", kpa) for kpa in pressures if kpa >= ONSET_KPA]
    seen = [kpa for kpa in pressures if reading("magnitude", kpa) > floor]
    moves = float(np.ptp(structure)) / reading("structure", last)
    claim = _claims(7, "hardware", set())
    return [
        claim(
            "the structure channel is stable from 100 kPa on",
            (),
            lambda: (f"moves by {moves:.1%}", moves < STABLE),
        ),
        claim(
            "the magnitude channel senses from 140 kPa on",
            (),
            lambda: (f"from {seen[0]:g} kPa on", seen[0] == ONSET_KPA) if seen else ("no", False),
        ),
        claim(
            "and still rises up to 200 kPa",
            (),
            lambda: _all([b > a for a, b in pairwise(above)], "steps"),
        ),
    ]


def magnitude_claims(estimates: Estimates, errors: Sequence[MagnitudeError]) -> list[Claim]:
    """Statements about Figs. 8 and 9.

    Args:
        estimates: of the images.
        errors: of each method on each sensor.
    """
    methods = {error.method for error in errors}
    rises = {m: [e.rises for e in errors if e.method == m] for m in methods}
    size = {m: mean(e.error for e in errors if e.method == m) for m in methods}

    def lower(case: int, other: int) -> list[bool]:
        return [
            value < estimates[method, sheet, other, kpa]
            for (method, sheet, number, kpa), value in estimates.items()
            if method == TIKHONOV and number == case
        ]

    claim = _claims(9, "hardware", methods)
    every = (TIKHONOV, SINGLE, MULTIMODAL)
    return [
        claim(
            "Tikhonov reads lower in the middle than at (36, 36)",
            (TIKHONOV,),
            lambda: _all(lower(1, 2) + lower(3, 4), "pairs"),
        ),
        claim(
            "Tikhonov reads higher under a larger indenter",
            (TIKHONOV,),
            lambda: _all(lower(1, 3) + lower(2, 4), "pairs"),
        ),
        claim(
            "the multimodal CNN rises with every step of pressure, in every case",
            (MULTIMODAL,),
            lambda: (f"in {mean(rises[MULTIMODAL]):.0%}", min(rises[MULTIMODAL]) == 1),
        ),
        claim(
            "the single CNN does not, at (36, 36)",
            (SINGLE,),
            lambda: (f"rises in {mean(rises[SINGLE]):.0%} of the cases", max(rises[SINGLE]) < 1),
        ),
        claim(
            "magnitude errors: multimodal CNN < single CNN < Tikhonov",
            every,
            lambda: _ordered(size, every, lambda value: f"{value:.0%}"),
        ),
    ]


def localisation_claims(places: Sequence[Localisation]) -> list[Claim]:
    """Statements about Fig. 10."""
    methods = {place.method for place in places}
    every = (TIKHONOV, SINGLE, MULTIMODAL)
    error = {m: mean(p.mass_error_mm for p in places if p.method == m) for m in methods}
    rim = max(abs(place.x_m) for place in places) - 1e-9

    def inwards_mm(method: str) -> float:
        outer = [p for p in places if p.method == method and max(abs(p.x_m), abs(p.y_m)) >= rim]
        return 1e3 * mean(np.hypot(p.x_m, p.y_m) - np.hypot(*p.mass_m) for p in outer)

    def towards_middle() -> tuple[str, bool]:
        drawn = [inwards_mm(method) for method in every if method in methods]
        return f"outer ones by {min(drawn):.1f} to {max(drawn):.1f} mm", min(drawn) > 0

    claim = _claims(10, "hardware", methods)
    return [
        claim(
            "errors: multimodal CNN < single CNN < Tikhonov",
            every,
            lambda: _ordered(error, every, lambda value: f"{value:.1f}"),
        ),
        claim(
            "places near the boundary are drawn towards the middle, by every method",
            (TIKHONOV,),
            towards_middle,
        ),
    ]


def several_areas_claims(read: Sequence[SeveralAreas]) -> list[Claim]:
    """Statements about Figs. 11 and 12, as far as their cases were measured."""
    methods = {one.method for one in read}

    def apart(method: str, *cases: int) -> float:
        return mean(o.told_apart for o in read if o.method == method and o.case in cases)

    def ordered(method: str, *cases: int) -> float:
        chosen = [o for o in read if o.method == method and o.case in cases]
        return mean(right for one in chosen for right in one.ordered)

    def icc(method: str, *cases: int) -> float:
        return mean(o.icc for o in read if o.method == method and o.case in cases)

    def told(share: float, bound: float) -> tuple[str, bool]:
        return f"in {share:.0%}", share >= bound

    def less_reliable() -> tuple[str, bool]:
        shares = {
            len(one.estimates): ordered(MULTIMODAL, *numbers)
            for numbers in ((5, 6), (7, 8), (9, 10))
            for one in read
            if one.case in numbers
        }
        words = ", ".join(f"{share:.0%} of {count}" for count, share in sorted(shares.items()))
        return f"pairs in order: {words} areas", shares[min(shares)] > shares[max(shares)]

    def paler(method: str) -> tuple[str, bool]:
        """Under one pressure: A1, in the middle, of case 5, and A2, the smaller, of case 6."""
        pairs = [o for o in read if o.method == method and o.case in (5, 6) and o.alike]
        lower = [(o.estimates[0] < o.estimates[1]) == (o.case == 5) for o in pairs]
        share = mean(value for one in pairs for value in one.alike)
        return f"by one pressure, in {mean(lower):.0%}; {share:.0%} of the other", all(lower)

    def outperformed() -> tuple[str, bool]:
        values = [icc(method, 7, 8, 9, 10) for method in every]
        return "ICC " + ", ".join(f"{value:.2f}" for value in values), values[0] < min(values[1:])

    every = (TIKHONOV, SINGLE, MULTIMODAL)
    two, more = _claims(11, "hardware", methods), _claims(12, "hardware", methods)
    about_two = [
        two(
            "the multimodal CNN tells both areas apart",
            (MULTIMODAL,),
            lambda: told(apart(MULTIMODAL, 5, 6), 1),
        ),
        two(
            "Tikhonov barely does, in case 5",
            (TIKHONOV,),
            lambda: (f"in {apart(TIKHONOV, 5):.0%}", apart(TIKHONOV, 5) <= HALF),
        ),
        two(
            "the multimodal CNN mostly reads the harder pressed area higher",
            (MULTIMODAL,),
            lambda: told(ordered(MULTIMODAL, 5, 6), MOST),
        ),
        *(
            two(
                f"{name}: the smaller or less sensitive area always reads lower",
                (method,),
                partial(paler, method),
            )
            for name, method in (("Tikhonov", TIKHONOV), ("the single CNN", SINGLE))
        ),
    ]
    about_more = [
        more(
            "both CNNs tell three and four areas apart",
            (SINGLE, MULTIMODAL),
            lambda: told(min(apart(m, 7, 8, 9, 10) for m in (SINGLE, MULTIMODAL)), 1),
        ),
        more("both outperform Tikhonov", every, outperformed),
        more(
            "the multimodal CNN's magnitudes are less reliable the more areas there are",
            (MULTIMODAL,),
            less_reliable,
        ),
    ]
    cases = {one.case for one in read}
    return (about_two if cases & {5, 6} else []) + (about_more if cases & {7, 8, 9, 10} else [])


Finding = Callable[[], tuple[str, bool]]


def _claims(
    figure: int, source: Source, methods: set[str]
) -> Callable[[str, tuple[str, ...], Finding], Claim]:
    """Make claims about a figure; one that needs a method that is not at hand is left open."""

    def claim(says: str, needed: tuple[str, ...], find: Finding) -> Claim:
        if not methods.issuperset(needed):
            return Claim(figure, source, says, "", None)
        return Claim(figure, source, says, *find())

    return claim


def _all(found: Sequence[bool], what: str) -> tuple[str, bool]:
    return f"in {sum(found)} of {len(found)} {what}", all(found)


def _ordered(
    values: dict[str, float], falling: Sequence[str], show: Callable[[float], str]
) -> tuple[str, bool]:
    """The values of these methods, least expected first, and whether they fall as they should."""
    known = [values[method] for method in falling]
    words = ", ".join(show(value) for value in reversed(known))
    return words, all(a > b for a, b in pairwise(known))
