"""Speed against accuracy: what is on the Pareto front, and that what is asked for is measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_lab.commands.chart import Point, panels, pareto_front, points_of, variants
from tactomo_lab.evaluation.play import Variant, play
from tactomo_lab.scenes.case import draw_still, still_case
from tactomo_lab.scenes.measures import summarise
from tactomo_models import SensorDescription, available_methods
from tactomo_models.methods.registry import BUDGETED


def point(p50_s: float, icc: float, snr_db: float = 40.0) -> Point:
    return Point("still", snr_db, Variant("auto"), replace(NOTHING, icc=icc, seconds=p50_s))


NOTHING = summarise([])
LATE_PERIODS = st.sampled_from([0.1, 0.2, 0.3, 0.5])  # so that some are equal


@given(st.lists(st.builds(point, LATE_PERIODS, LATE_PERIODS | st.just(float("nan"))), max_size=12))
def test_nothing_is_better_than_the_front_and_the_front_is_better_than_all_else(
    points: list[Point],
) -> None:
    front = pareto_front(points)

    def better(one: Point, other: Point) -> bool:
        (a, b), (c, d) = ((p.summary.seconds, p.summary.icc) for p in (one, other))
        return (a, b) != (c, d) and a <= c and b >= d

    for on in front:
        assert not any(better(one, on) for one in points)
    for off in points:
        if not any(off is on for on in front):
            assert np.isnan(off.summary.icc) or any(better(on, off) for on in front)
    assert [on.summary.seconds for on in front] == sorted(on.summary.seconds for on in front)


def test_points_that_cannot_be_compared_are_not() -> None:
    points = [point(1, 0.9), point(2, 0.8, snr_db=20), point(3, 0.7)]
    assert list(panels(points)) == [[points[0], points[2]], [points[1]]]


def test_every_method_has_a_point_and_auto_and_fit_one_for_every_budget() -> None:
    chosen = variants(available_methods(), (0.01, 2.0))
    assert {v.method for v in chosen} == set(available_methods())
    some = [(v.method, v.budget_name) for v in chosen if v.method in ("auto", "levelset", "noser")]
    assert some == [("auto", "10 ms"), ("auto", "2 s"), ("noser", ""), ("levelset", "2 s")]
    assert all((v.budget_s is None) is (v.method not in BUDGETED) for v in chosen)


@pytest.mark.slow
def test_still_scenes_are_measured_under_each_budget(paper: SensorDescription) -> None:
    drawn = [still_case(paper, draw_still(paper, "tuning", 3, 0), "tuning", 0, 20.0)]
    asked = [Variant("tikhonov"), Variant("fit", 0.001), Variant("fit", 0.2)]
    linear, hasty, patient = points_of(play(drawn, *asked))
    assert [linear.variant, hasty.variant, patient.variant] == asked
    assert {p.summary.frames for p in (linear, hasty, patient)} == {1}
    assert {(p.scene, p.snr_db) for p in (linear, hasty, patient)} == {("still", 20.0)}
    icc = [point.summary.icc for point in (linear, hasty, patient)]
    seconds = [point.summary.seconds for point in (linear, hasty, patient)]
    assert max(icc[:2]) < icc[2]
    # A millisecond of work is about what a linear image takes.
    assert max(seconds[:2]) < seconds[2] <= patient.summary.seconds_99
    assert hasty.summary.warned == 1
