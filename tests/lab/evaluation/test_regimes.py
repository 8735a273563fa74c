"""Regimes where methods fail: each breaks what it says, and what is flagged is counted right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_score import made_score
from tactomo_lab.evaluation.field import frames_of_row
from tactomo_lab.evaluation.play import Outcome, play
from tactomo_lab.evaluation.regimes import KINDS, REGIMES, draw_plan, make_case
from tactomo_lab.scenes.case import Case, Plan
from tactomo_lab.scenes.drawing import BOTH_CHANNELS, gap_m, outline_of
from tactomo_lab.scenes.measures import Score, summarise
from tactomo_lab.scenes.simulation import SheetState, UnevenSkin, displaced, fine_mesh
from tactomo_models import Reconstructor, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics import tikhonov as linear
from tactomo_models.scene.press import Press, Profile, Shape
from tactomo_protocol import Channel

CASES = range(8)


def plans(description: SensorDescription, regime: str) -> list[Plan]:
    return [draw_plan(description, regime, "tuning", number) for number in CASES]


@pytest.mark.parametrize("regime", REGIMES)
def test_cases_are_the_same_every_time_and_fit_on_the_sheet(
    paper: SensorDescription, small: SensorDescription, regime: str
) -> None:
    for sensor in (paper, small):
        drawn = plans(sensor, regime)
        assert drawn == plans(sensor, regime)
        assert len({repr(plan) for plan in drawn}) == len(drawn)
        assert repr(draw_plan(sensor, regime, "reporting", 0)) != repr(drawn[0])
        for press in {press for plan in drawn for frame in plan.frames for press in frame}:
            x, y = outline_of(press)
            assert sensor.on_sheet(x, y, sensor.sheet.frame_width_m).all()


def test_regimes_are_what_they_are_called(paper: SensorDescription) -> None:
    near = {number: plan.frames[0] for number, plan in enumerate(plans(paper, "near-touch"))}
    gaps = [1e3 * gap_m(*presses) for presses in near.values()]
    assert 1 <= min(gaps) < 2
    assert 5 <= max(gaps) < 6.1
    assert {len(plan.frames[0]) for plan in plans(paper, "many")} == {8, 9, 10}
    mixed = [plan.frames[0] for plan in plans(paper, "mixed")]
    assert [len(presses) for presses in mixed] == [1, 2, 3, 4] * 2
    assert {kind(press) for presses in mixed for press in presses} == set(KINDS)
    assert max(len({kind(press) for press in presses}) for presses in mixed) >= 3
    for name, profiles in (("crowded-soft", {"dome"}), ("crowded-mixed", {"flat", "dome"})):
        crowds = [plan.frames[0] for plan in plans(paper, name)]
        assert {len(presses) for presses in crowds} == {5, 6}
        assert {press.profile for presses in crowds for press in presses} == profiles
    for plan in plans(paper, "edges"):
        for press in plan.frames[0]:
            assert 0.0669 < np.abs(outline_of(press)).max() < 0.0691
    assert all(np.hypot(*centre(plan)) < 0.015 for plan in plans(paper, "weak-centre"))
    beyond = [plan.frames[0] for plan in plans(paper, "overload")]
    assert all(300 <= presses[0].pressure_kpa <= 600 for presses in beyond)
    for plan in plans(paper, "jump"):
        before, after = set(plan.frames[-2]), set(plan.frames[-1])
        assert len(before - after) == len(after - before) == 1
    for plan in plans(paper, "palm"):
        kpa = [press.pressure_kpa for frame in plan.frames for press in frame]
        assert not plan.frames[0]
        assert kpa == sorted(kpa)
        assert 2 <= kpa[-1] == kpa[-2] <= 200
    for regime in ("one-scan-apart", "lost-scans"):
        for plan in plans(paper, regime):
            (a,), (b,) = plan.frames[-2:]
            assert 3 <= 1e3 * np.hypot(b.x_m - a.x_m, b.y_m - a.y_m) <= 10


def kind(press: Press) -> tuple[Shape, Profile]:
    return press.shape, press.profile


def centre(plan: Plan) -> tuple[float, float]:
    first = plan.frames[0][0]
    return first.x_m, first.y_m


def case_of(small: SensorDescription, regime: str, number: int = 0) -> Case:
    return make_case(small, regime, "tuning", number)


@pytest.mark.slow
def test_a_case_is_measured_as_planned(small: SensorDescription) -> None:
    lost = case_of(small, "lost-scans", 1)
    assert [set(frame.scans) for frame in lost.frames[-3:]] == [
        set(BOTH_CHANNELS),
        {"magnitude"},
        {"magnitude"},
    ]
    late = case_of(small, "one-scan-apart")
    before, last = (frame.scans for frame in late.frames[-2:])
    np.testing.assert_array_equal(before[Channel.STRUCTURE], last[Channel.STRUCTURE])
    assert change(before[Channel.MAGNITUDE], last[Channel.MAGNITUDE]) > 3e-4
    rest = case_of(small, "drift-at-rest")
    assert not rest.truth.pressed.any()
    assert rest.tare.structure is not None
    assert 0.005 < change(rest.frames[0].scans[Channel.STRUCTURE], rest.tare.structure) < 0.2


def change(volts: FloatArray, others: FloatArray) -> float:
    return float(np.linalg.norm(volts - others) / np.linalg.norm(others))


def test_a_lead_opens_on_one_sheet_in_the_last_frame(small: SensorDescription) -> None:
    case = case_of(small, "intermittent")
    assert case.plan.lead
    (broken,) = case.plan.at_fault
    (good,) = set(BOTH_CHANNELS) - {broken}
    *_, before, last = (frame.scans for frame in case.frames)
    assert change(last[good], before[good]) < 1e-2
    driven = (small.pairs.drive == case.plan.lead.electrode).any(axis=1)
    assert np.abs(last[broken][driven]).max() < 0.1 * np.abs(before[broken][driven]).max()


def test_states_of_a_sheet(small: SensorDescription) -> None:
    """Conductivity scales voltages, half a turn is a symmetry, and one sheet alone changes."""
    mesh = fine_mesh(small)
    seed = np.random.SeedSequence(3)
    even = UnevenSkin(small, mesh, seed, unevenness=0, impedance_deviation=0)
    made = even.voltages([])
    warm = even.voltages([], {Channel.STRUCTURE: SheetState(warming=0.04)})
    np.testing.assert_allclose(warm[Channel.STRUCTURE], made[Channel.STRUCTURE] / 1.04, rtol=0.01)
    np.testing.assert_array_equal(warm[Channel.MAGNITUDE], made[Channel.MAGNITUDE])
    drifted = even.voltages([], {Channel.STRUCTURE: SheetState(drift=0.02)})
    assert 0.005 < np.std(drifted[Channel.STRUCTURE] / made[Channel.STRUCTURE]) < 0.05
    count = small.electrode_count
    turned = [(e + count // 2) % count for e in range(count)]
    for order, same in ((turned, True), ([1, 0, *range(2, count)], False)):
        wired = even.voltages([], {Channel.STRUCTURE: SheetState(leads=tuple(order))})
        assert (change(wired[Channel.STRUCTURE], made[Channel.STRUCTURE]) < 0.01) is same
    poor = tuple(30.0 if e == 2 else 1.0 for e in range(count))
    loose = even.voltages([], {Channel.STRUCTURE: SheetState(impedance=poor)})
    assert 1e-4 < change(loose[Channel.STRUCTURE], made[Channel.STRUCTURE]) < 0.2


def test_a_skin_may_be_warped(small: SensorDescription) -> None:
    """A contact lies where it lies, whatever the sheet beneath it does."""
    off = np.where(np.arange(small.electrode_count) == 1, 0.001, 0.0)
    (press,) = draw_plan(small, "ordinary", "tuning", 0).frames[0]
    plain, warped = (
        UnevenSkin(small, fine_mesh(small), np.random.SeedSequence(3), warp=warp)
        for warp in (None, lambda mesh: displaced(mesh, small, off))
    )
    touched = (np.hstack([small.pairs.drive, small.pairs.measure]) == 1).any(axis=1)
    one, other = plain.voltages([])[Channel.STRUCTURE], warped.voltages([])[Channel.STRUCTURE]
    assert change(other[touched], one[touched]) > 3 * change(other[~touched], one[~touched]) > 0
    changes = [
        skin.voltages([press])[Channel.STRUCTURE] - rest
        for skin, rest in ((plain, one), (warped, other))
    ]
    assert 0 < change(*changes) < 0.2


def last_of(case: Case) -> Outcome:
    *_, last = play([case], "tikhonov")
    return last


@pytest.mark.slow
def test_regularisation_is_so_many_times_what_the_rule_chooses(
    small: SensorDescription, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, factor = case_of(small, "ordinary"), 0.01
    right = last_of(case).made.map
    instrument = small.instrument.model_copy(update={"regularisation": factor})
    told = case.description.model_copy(update={"instrument": instrument})
    made = last_of(replace(case, description=told)).made.map
    monkeypatch.setattr(
        "tactomo_models.methods.linear.prior_weight",
        lambda *given: factor * linear.prior_weight(*given),
    )
    expected = last_of(case).made.map
    assert made is not None
    assert right is not None
    assert expected is not None
    top = float(expected.max())
    np.testing.assert_allclose(made, expected, atol=1e-3 * top)
    assert np.abs(right - expected).max() > 0.1 * top


def test_a_case_is_judged_by_its_last_frame(small: SensorDescription) -> None:
    case = case_of(small, "jump")
    (outcome,) = frames_of_row(small, "jump", "tikhonov", "tuning", 1)["jump"]
    alone = Reconstructor(case.description, method="tikhonov")
    alone.set_reference(case.tare)
    scans = case.frames[-1].scans
    frame = alone.reconstruct(scans[Channel.MAGNITUDE], scans[Channel.STRUCTURE])
    assert frame.map is not None
    expected = np.corrcoef(frame.map.ravel(), case.truth.map.ravel())[0, 1]
    assert outcome.score.icc == pytest.approx(expected)
    assert outcome.score.groups == len(case.plan.frames[-1])


@pytest.mark.slow
def test_what_is_right_where_the_magnitude_channel_shows_nothing(small: SensorDescription) -> None:
    """The pressed shape counts; at rest, whether a contact is reported; a lack of a map warns."""
    light = case_of(small, "light")
    assert not light.truth.map.any()
    outcome = last_of(light)
    shape = outcome.made.structure
    assert shape is not None
    expected = np.corrcoef(shape.ravel(), light.truth.pressed.ravel())[0, 1]
    assert outcome.score.likeness == pytest.approx(expected)
    drifted = case_of(small, "drift-at-rest")
    ghosts = last_of(drifted).score
    assert (ghosts.likeness == 0) is (ghosts.found > 0)
    rest = {name: getattr(drifted.tare, name) for name in BOTH_CHANNELS}
    still = replace(drifted, frames=[replace(drifted.frames[0], scans=rest)])
    assert last_of(still).score.likeness == 1
    ordinary = case_of(small, "ordinary")
    absent = last_of(replace(ordinary, frames=[replace(ordinary.frames[0], scans={})])).score
    assert absent.bad
    assert absent.warned


def one(icc: float, flags: tuple[str, ...] = (), has_map: bool = True) -> Score:
    return made_score(icc=icc, icc_structure=icc, flags=flags, has_map=has_map)


def test_warnings_are_counted() -> None:
    lead = ("electrode_fault",)
    counted = summarise(
        [
            *(one(0.69), one(0.2, flags=lead), one(0.1, flags=("misfit_high",))),
            *(one(0.7), one(0.9, flags=lead), one(0.8, has_map=False), one(0.95)),
        ]
    )
    assert counted.icc == pytest.approx(4.34 / 7)
    assert counted.bad_unflagged == pytest.approx(2 / 7)
    assert counted.good_flagged == pytest.approx(1 / 4)
