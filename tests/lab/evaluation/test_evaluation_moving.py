"""Moving scenes: what the choreography asks for, and how a frame of it is scored."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tactomo_lab.evaluation.moving import Step, choreography, follow
from tactomo_lab.evaluation.play import play
from tactomo_lab.scenes.case import Case, Simulated, SimulatedVolts, as_described
from tactomo_lab.scenes.drawing import BOTH_CHANNELS, GAP_M, gap_m, outline_of
from tactomo_lab.scenes.measures import Score
from tactomo_models import Press, SensorDescription, SkinSimulator
from tactomo_models.scene.tracking import MAX_MISSED
from tactomo_protocol import Channel

NOISE = {Channel.MAGNITUDE: 2e-6, Channel.STRUCTURE: 2e-5}
PLACES_MM = {"A": (-38, -38), "B": (35, 10)}


@settings(max_examples=5)
@given(radius_m=st.floats(0.008, 0.012))
def test_contacts_stay_on_the_sheet_and_apart_unless_they_merge(
    paper: SensorDescription, radius_m: float
) -> None:
    steps = choreography(lambda _, x, y: Press(x * 1e-3, y * 1e-3, 180.0, radius_m))
    for step in steps:
        for press in step.presses.values():
            x, y = outline_of(press)
            assert paper.on_sheet(x, y, paper.sheet.frame_width_m).all()
        if step.phase not in ("merge", "split"):
            gaps = [gap_m(a, b) for a, b in combinations(step.presses.values(), 2)]
            assert all(gap >= GAP_M for gap in gaps)
    merged = [step for step in steps if step.phase == "merge"][-1]
    assert gap_m(*merged.presses.values()) == 0


def test_what_happens_in_it() -> None:
    steps = choreography(lambda _, x, y: Press(x * 1e-3, y * 1e-3, 180.0, 0.01))
    assert sum(step.tare for step in steps) == 1
    assert {step.lost for step in steps} == {
        (),
        ("structure",),
        ("magnitude",),
        ("magnitude", "structure"),
    }
    for before, now in pairwise(steps):
        for name in before.presses.keys() & now.presses.keys():
            (x, y), (u, v) = ((s.presses[name].x_m, s.presses[name].y_m) for s in (before, now))
            assert np.hypot(u - x, v - y) < 0.006  # 120 mm/s at 20 frames a second


def press(name: str, x_mm: float | None = None, kpa: float = 180.0) -> Press:
    x, y = PLACES_MM[name]
    return Press((x if x_mm is None else x_mm) * 1e-3, y * 1e-3, kpa)


def sequence(
    paper: SensorDescription,
    simulator: SkinSimulator,
    *steps: Step,
    shown: tuple[Step, ...] | None = None,
) -> Case:
    """A moving scene of these steps, on a sheet that is cheap to solve; scans are of `shown`."""
    pressed = [tuple(step.presses.values()) for step in shown or steps]
    scans = [simulator.voltages(list(presses)) for presses in pressed]
    volts = SimulatedVolts(
        simulator.voltages([]), {n: np.array([scan[n] for scan in scans]) for n in BOTH_CHANNELS}
    )
    simulated = Simulated(as_described(paper, *pressed), paper, paper, volts)
    return follow(simulated, steps, NOISE, np.random.default_rng(0), "tuning", 0)


def played(case: Case, method: str = "auto") -> list[Score]:
    return [outcome.score for outcome in play([case], method)]


@pytest.mark.slow
def test_frames_are_scored_one_by_one(paper: SensorDescription, simulator: SkinSimulator) -> None:
    one = {"A": press("A")}
    steps = [
        Step("rest", {}),
        Step("land", {"A": press("A", kpa=100.0)}),
        *[Step("hold", one)] * 3,
        Step("lost", one, (Channel.STRUCTURE,)),
        Step("lost", one, (Channel.MAGNITUDE, Channel.STRUCTURE)),
        Step("tare", {}, tare=True),
        Step("again", one),
    ]
    rest, land, *hold, half, none, tare, again = played(sequence(paper, simulator, *steps))
    for empty in (rest, tare):
        assert (empty.groups, empty.found, empty.count_right) == (0, 0, True)
        assert np.isnan([empty.icc, empty.rie, empty.icc_structure]).all()
    assert np.isnan(land.icc)  # too light for the magnitude channel
    for score in (*hold, again):
        assert score.icc > 0.85
        assert score.icc_structure > 0.85
        assert (score.groups, score.found, score.switches) == (1, 1, 0)
        assert not any(contact.missed for contact in score.contacts)
    assert np.isnan(half.icc_structure)
    for lost in (half, none):
        assert not lost.countable
    assert [score.phase for score in hold] == ["hold"] * 3


def test_contacts_that_touch_are_one_and_near_ones_are_not_counted(
    paper: SensorDescription, simulator: SkinSimulator
) -> None:
    def beside(gap_mm: float) -> Step:
        other = replace(press("B"), x_m=press("B").x_m - 0.03 - gap_mm * 1e-3)
        return Step("near", {"A": press("B"), "B": other})

    touching, near, apart = played(
        sequence(paper, simulator, beside(-5), beside(4), beside(20)), "tikhonov"
    )
    assert (touching.groups, touching.countable) == (1, True)
    assert (near.groups, near.countable) == (2, False)
    assert (apart.groups, apart.countable) == (2, True)


@pytest.mark.slow
def test_identities_that_are_lost(paper: SensorDescription, simulator: SkinSimulator) -> None:
    """Scans of nothing for longer than a contact is remembered: it gets a new identity."""
    held, gap = Step("hold", {"A": press("A")}), MAX_MISSED + 1
    lifted = (held, *[Step("hold", {})] * gap, held)
    scene = sequence(paper, simulator, held, *[held] * gap, held)
    blinking = sequence(paper, simulator, held, *[held] * gap, held, shown=lifted)
    none = [0] * (gap + 1)
    assert [score.switches for score in played(scene)] == [*none, 0]
    assert [score.switches for score in played(blinking)] == [*none, 1]
    told = played(sequence(paper, simulator, *lifted))
    assert [score.switches for score in told] == [*none, 0]  # a new one, and told so


@pytest.mark.slow
def test_a_tare_forgets_who_was_who(paper: SensorDescription, simulator: SkinSimulator) -> None:
    held = Step("hold", {"A": press("A")})
    scores = played(sequence(paper, simulator, held, held, replace(held, tare=True)))
    assert [score.switches for score in scores] == [0, 0, 1]
