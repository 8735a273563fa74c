"""Speed against accuracy: every method under every budget, on the same scenes.

Two kinds of scene. *Still*: each by itself from a cold start, so that a budget which ends early
leaves what one frame could do. *Moving*: frame after frame as the daemon has them, so that what
one frame does not finish the next one goes on with; every frame is reconstructed, however long
that takes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from tactomo_models.batch import BUDGET_S
from tactomo_models.methods.registry import BUDGETED
from tactomo_models.reconstruct import DEFAULT_BUDGET_S

from tactomo_lab.evaluation.play import Outcome, Variant
from tactomo_lab.scenes.measures import Summary, summarise_by

SceneKind = Literal["still", "moving"]

UNHURRIED: Final = ("levelset",)  # charted under the last budget alone
BUDGETS_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, DEFAULT_BUDGET_S)
STILL_BUDGETS_S: Final = (*BUDGETS_S, BUDGET_S)  # the last one: as much as a scene needs


def variants(methods: Iterable[str], budgets_s: Sequence[float] = BUDGETS_S) -> list[Variant]:
    """Every method: `auto` under each of some budgets, others that one bounds under the last."""
    chosen = []
    for method in methods:
        if method not in BUDGETED:
            chosen.append(Variant(method))
        else:
            budgets = budgets_s[-1:] if method in UNHURRIED else budgets_s
            chosen += [Variant(method, budget_s) for budget_s in budgets]
    return chosen


@dataclass(frozen=True)
class Point:
    """How fast and how right a variant is on scenes of one kind."""

    scene: SceneKind
    snr_db: float
    variant: Variant
    summary: Summary


def points_of(outcomes: Iterable[Outcome]) -> list[Point]:
    """What became of cases, one point for each kind of scene, ratio and variant."""

    def key(outcome: Outcome) -> tuple[SceneKind, float, Variant]:
        kind: SceneKind = "still" if outcome.case.is_still else "moving"
        return kind, outcome.score.snr_db, outcome.variant

    found = summarise_by((key(outcome), outcome.score) for outcome in outcomes)
    return [Point(*of, summary) for of, summary in found.items()]


def panels(points: Iterable[Point]) -> Iterator[list[Point]]:
    """Points that can be compared: of one kind of scene and one signal-to-noise ratio."""
    groups: dict[tuple[SceneKind, float], list[Point]] = {}
    for point in points:
        groups.setdefault((point.scene, point.snr_db), []).append(point)
    yield from groups.values()


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Points than which none is both as fast and as right, and better in one; fastest first."""
    known = [point for point in points if np.isfinite(point.summary.icc)]
    best = [one for one in known if not any(_dominates(other, one) for other in known)]
    return sorted(best, key=lambda point: point.summary.seconds)


def _dominates(one: Point, other: Point) -> bool:
    a, b = ((point.summary.seconds, -point.summary.icc) for point in (one, other))
    return a != b and a[0] <= b[0] and a[1] <= b[1]
