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
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.evaluation.play import Player, Variant
from tactomo_lab.evaluation.regimes import make_case
from tactomo_lab.evaluation.trade_off import left_out
from tactomo_lab.scenes.case import Case
from tactomo_lab.scenes.drawing import SeedSet
from tactomo_lab.scenes.measures import BAD_ICC, Score, mean, score


class Judged(NamedTuple):
    """A method's score on the last frame of a regime's case."""

    regime: str
    method: str
    score: Score

    @property
    def is_bad(self) -> bool:
        """Whether what is shown is something else than what presses."""
        return self.score.likeness < BAD_ICC

    def as_json(self) -> dict[str, Any]:
        """All of it as numbers and names."""
        return {
            "regime": self.regime,
            "method": self.method,
            "bad": self.is_bad,
            **self.score.as_json(),
        }


def judge(regime: str, case: Case, methods: Iterable[str]) -> list[Judged]:
    """Reconstruct a case by one method after the other; the last frame is judged.

    Raises ModelError where a method's network is not there.
    """
    player = Player(case.description)
    found = []
    for method in methods:
        *_, last = player.play(case, Variant(method))
        found.append(Judged(regime, method, score(case, last.frame, last.made, last.seconds, {})))
    return found


def evaluate_regimes(
    description: SensorDescription,
    regimes: Iterable[str],
    methods: Sequence[str],
    seed_set: SeedSet,
    count: int,
    *,
    jobs: int = 1,
) -> Iterator[list[Judged]]:
    """Reconstruct cases of some regimes by some methods.

    Yields:
        Each case's scores, of the methods that its sensor has; in the order of regimes and
        numbers whatever `jobs`.

    Raises DataError where a regime cannot happen to the sensor, or has no room on it.
    """
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
) -> list[Judged]:
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


def trust(judged: Iterable[Judged]) -> Trust:
    """Count bad maps and warnings."""
    known = list(judged)
    bad = [one.score for one in known if one.is_bad]
    good = [one.score for one in known if not one.is_bad]
    return Trust(
        maps=len(known),
        icc=mean(one.score.likeness for one in known),
        bad=len(bad),
        bad_unwarned=sum(not score.warned for score in bad),
        bad_unflagged=sum(not (score.warned or score.flags) for score in bad),
        good_warned=sum(score.warned for score in good),
        good_flagged=sum(score.warned or bool(score.flags) for score in good),
    )


def trust_by_regime(judged: Iterable[Judged]) -> dict[str, dict[str, Trust]]:
    """Counts of every regime, and of all of them under "all", by method."""
    known = list(judged)
    methods = dict.fromkeys(one.method for one in known)

    def by_method(chosen: list[Judged]) -> dict[str, Trust]:
        return {m: trust(one for one in chosen if one.method == m) for m in methods}

    regimes = dict.fromkeys(one.regime for one in known)
    rows = {r: by_method([one for one in known if one.regime == r]) for r in regimes}
    return {**rows, "all": by_method(known)}
