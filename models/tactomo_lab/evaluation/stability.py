"""Whether methods say so where they fail: cases of every regime, reconstructed and judged.

A map is bad where its ICC with the truth is below `BAD_ICC`. What counts is what a user is told: a
bad map with no flag of `DISTRUST` is a silent failure, a good one with such a flag a false alarm.
Other flags, such as a lead that was left out, are counted apart: the map claims to stand on the
rest of the data.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.scans.plausibility import DISTRUST
from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.evaluation.play import Player, Variant
from tactomo_lab.evaluation.regimes import make_case
from tactomo_lab.evaluation.trade_off import left_out
from tactomo_lab.scenes.case import Case
from tactomo_lab.scenes.drawing import SeedSet, require_both_channels
from tactomo_lab.scenes.measures import BAD_ICC, correlation, mean


@dataclass(frozen=True)
class CaseScore:
    """How one case came out."""

    # regime, case, method: which
    regime: str
    case: str
    method: str
    # contacts, found: how many press, and were reported
    contacts: int
    found: int
    # of the magnitude map; of the pressed shape where nothing presses hard enough to show in it;
    # where nothing presses at all, 1 if nothing was reported and else 0
    icc: float
    warned: bool  # whether a flag of `DISTRUST`, or the lack of a map, told not to trust it
    flags: tuple[str, ...]  # names of all that were raised
    # tier, reason, misfit, confidence: as reported
    tier: str
    reason: str
    misfit: float
    confidence: float

    @property
    def bad(self) -> bool:
        """Whether the map shows something else than what presses."""
        return self.icc < BAD_ICC

    def as_json(self) -> dict[str, Any]:
        """All of it as numbers and names."""
        return {**asdict(self), "bad": self.bad}


def judge(regime: str, case: Case, methods: Iterable[str]) -> list[CaseScore]:
    """Reconstruct a case by one method after the other; the last frame is judged.

    Raises ModelError where a method's network is not there.
    """
    player, truth = Player(case.description), case.truth
    found = []
    for method in methods:
        *_, last = player.play(case, Variant(method))
        made = last.made
        shown, true = made.map, truth.map
        if not truth.map.any():
            shown, true = made.structure, truth.pressed
        is_pressed = bool(truth.pressed.any())
        found.append(
            CaseScore(
                regime=regime,
                case=f"{case.seed_set} {case.number}",
                method=method,
                contacts=len(truth.contacts),
                found=len(made.contacts),
                icc=correlation(shown, true) if is_pressed else float(not made.contacts),
                warned=bool(made.flags & DISTRUST) or shown is None,
                flags=tuple(made.flags.names()),
                tier=made.tier,
                reason=made.reason,
                misfit=made.misfit,
                confidence=made.confidence,
            )
        )
    return found


def evaluate_regimes(
    description: SensorDescription,
    regimes: Iterable[str],
    methods: Sequence[str],
    seed_set: SeedSet,
    count: int,
    *,
    jobs: int = 1,
) -> Iterator[list[CaseScore]]:
    """Reconstruct cases of some regimes by some methods.

    Yields:
        Each case's scores, of the methods that its sensor has; in the order of regimes and
        numbers whatever `jobs`.

    Raises DataError where the sensor has a single channel, or no room for what presses.
    """
    require_both_channels(description)
    load_or_build_artifact(description)  # built once, by this process
    work = partial(_evaluate_case, description, tuple(methods), seed_set)
    which = [(regime, number) for regime in regimes for number in range(count)]
    if jobs == 1:
        yield from map(work, which)
        return
    # Not forked: what runs threads does not survive that.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(work, which)


def _evaluate_case(
    description: SensorDescription,
    methods: tuple[str, ...],
    seed_set: SeedSet,
    which: tuple[str, int],
) -> list[CaseScore]:
    case = make_case(description, which[0], seed_set, which[1])
    missing = left_out(case.description, methods)  # a regime may have a sensor of its own
    return judge(which[0], case, (method for method in methods if method not in missing))


@dataclass(frozen=True)
class Trust:
    """Whether flags told bad maps from good ones."""

    maps: int  # how many
    icc: float  # mean
    bad: int  # how many have an ICC below `BAD_ICC`
    bad_unwarned: int  # of those, how many had no flag of `DISTRUST`
    bad_unflagged: int  # of those, how many had no flag at all
    good_warned: int  # good maps that were flagged as not to be trusted
    good_flagged: int  # good maps with any flag


def trust(scores: Iterable[CaseScore]) -> Trust:
    """Count bad maps and warnings."""
    known = list(scores)
    bad = [score for score in known if score.bad]
    good = [score for score in known if not score.bad]
    return Trust(
        maps=len(known),
        icc=mean(score.icc for score in known),
        bad=len(bad),
        bad_unwarned=sum(not score.warned for score in bad),
        bad_unflagged=sum(not (score.warned or score.flags) for score in bad),
        good_warned=sum(score.warned for score in good),
        good_flagged=sum(score.warned or bool(score.flags) for score in good),
    )


def trust_by_regime(scores: Iterable[CaseScore]) -> dict[str, dict[str, Trust]]:
    """Counts of every regime, and of all of them under "all", by method."""
    known = list(scores)
    methods = dict.fromkeys(score.method for score in known)

    def by_method(chosen: list[CaseScore]) -> dict[str, Trust]:
        return {m: trust(score for score in chosen if score.method == m) for m in methods}

    regimes = dict.fromkeys(score.regime for score in known)
    rows = {r: by_method([score for score in known if score.regime == r]) for r in regimes}
    return {**rows, "all": by_method(known)}
