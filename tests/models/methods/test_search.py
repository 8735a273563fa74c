"""The search: what one frame leaves to the next, and what contacts are told for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass, replace

import numpy as np
import pytest
from pressed import PLENTY_S, Sensor, contact, contacts, data_of, described
from tactomo_models import Channel, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.account import Frame
from tactomo_models.methods.kinds import Kind, kind_of
from tactomo_models.methods.search import Belief, Search
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.scene.areas import AreaFinder
from tactomo_models.scene.field_account import FieldAccountant
from tactomo_models.scene.field_fit import Budget, Measured
from tactomo_models.scene.parameters import PEAK, SIZE, UNIT_M, X, Y
from tactomo_models.scene.press import Press
from tactomo_models.simulation.simulator import SkinSimulator

NOISE = 1e-3  # of each relative change

LEFT = contact(-0.012, -0.004, 0.007)
RIGHT = contact(0.013, 0.006, 0.006)
OTHERS = ["structure alone", "resistive structure alone", "both falling", "one graded"]


@dataclass
class Skin:
    """Frames of contacts on a sensor, with noise that is another in each."""

    sensor: Sensor
    rng: np.random.Generator

    def measured(self, *each: FloatArray, noise: float = NOISE) -> Measured:
        field = self.sensor.at(contacts(*each), self.sensor.no_data())
        return data_of(self.sensor.changes(field), noise, self.rng)

    def frame(self, *each: FloatArray, noise: float = NOISE, budget_s: float = PLENTY_S) -> Frame:
        return Frame(self.measured(*each, noise=noise), Budget(budget_s))


@pytest.fixture(
    scope="module",
    params=["both", *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)],
)
def sensor(
    request: pytest.FixtureRequest, forward: ForwardModel, small: SensorDescription
) -> Sensor:
    return Sensor.of(forward, described(small, request.param))


@pytest.fixture(scope="module")
def large(paper: SensorDescription) -> Sensor:
    """A sheet of sixteen electrodes: eight tell no six contacts, nor what each of three is."""
    forward = ForwardModel(paper, solve_bare_sheet(paper, mesh_sheet(paper, refinements=1)))
    return Sensor.of(forward, paper)


@pytest.fixture
def skin(sensor: Sensor) -> Skin:
    return Skin(sensor, np.random.default_rng(2))


@pytest.fixture
def stacked(large: Sensor) -> Skin:
    return Skin(large, np.random.default_rng(2))


def assert_at(belief: Belief, *each: FloatArray) -> None:
    """Right many contacts, a third of a millimetre off at most, and nothing left unexplained."""
    assert belief.done
    assert belief.account.fitted.misfit < 1.5
    places = sorted((one[X] * UNIT_M, one[Y] * UNIT_M) for one in each)
    found = sorted((one[X] * UNIT_M, one[Y] * UNIT_M) for one in belief.account.contacts)
    np.testing.assert_allclose(found, places, atol=3e-4)


def followed(search: Search, frames: Iterable[Frame]) -> Belief:
    """What is believed after some frames, the first of which starts cold."""
    belief = None
    for frame in frames:
        belief = search.advance(belief, frame)
    assert belief is not None
    return belief


def kinds_by_x(belief: Belief) -> list[Kind]:
    """Kinds of contacts from left to right."""
    each = belief.account.contacts
    return [kind_of(one) for one in each[each[:, X].argsort()]]


# From frame to frame


@pytest.mark.slow
def test_an_outline_that_the_mesh_has_bent_is_seldom_surely_another(
    large: Sensor, paper: SensorDescription
) -> None:
    """Round tools on a finer mesh: without errors of outlines 4 of these 10 are surely rounded."""
    rng, search = np.random.default_rng(1), Search(large.fit)
    sheets = SkinSimulator(paper, spacing_m=1e-3, unevenness=0.0, impedance_spread=0.0)
    bare, are_bent = sheets.voltages([]), []
    for radius_m in 5 * [0.007] + 5 * [0.010]:
        x_m, y_m = rng.uniform(-0.04, 0.04, 2)
        volts = sheets.voltages([Press(x_m, y_m, 180.0, radius_m)])
        changes = {name: (volts[name] - v) / np.abs(v) for name, v in bare.items()}
        frame = Frame(data_of(changes, 2e-4, rng), Budget(PLENTY_S))
        belief = search.advance(None, frame)
        [found], [rivals] = belief.account.contacts, belief.rivals
        is_sure = all(rival.log_odds < -3 for rival in rivals.values())
        are_bent.append(kind_of(found) is Kind.ROUNDED and is_sure)
    assert np.count_nonzero(are_bent) <= 1


@pytest.mark.parametrize("above", [1.1, 1.3])
def test_a_faint_press_is_told_that_a_noise_test_overlooks(stacked: Skin, above: float) -> None:
    """Begun below the onset, where a peak has no slope, as where the graded sheet is quiet."""
    faint = contact(-0.02, 0.01, 0.011, peak=above * stacked.sensor.field.onset)
    measured = stacked.measured(faint, noise=2e-4)
    quiet = replace(measured[Channel.MAGNITUDE], quiet=True)
    frame = Frame({**measured, Channel.MAGNITUDE: quiet}, Budget(PLENTY_S))
    belief = Search(stacked.sensor.fit).advance(None, frame)
    [found], [sigmas] = belief.account.contacts, belief.account.sigmas
    assert found[PEAK] > stacked.sensor.field.onset
    assert found[PEAK] == pytest.approx(faint[PEAK], abs=4 * sigmas[PEAK])


def test_a_press_that_grows_faint_by_faint_is_followed_over_the_onset(stacked: Skin) -> None:
    onset = stacked.sensor.field.onset
    peaks = np.linspace(0.8 * onset, 1.2 * onset, 9)
    frames = [stacked.frame(contact(-0.02, 0.01, 0.011, peak=peak), noise=2e-4) for peak in peaks]
    belief = followed(Search(stacked.sensor.fit), frames)
    [found], [sigmas] = belief.account.contacts, belief.account.sigmas
    assert found[PEAK] == pytest.approx(peaks[-1], abs=4 * sigmas[PEAK])


def test_a_still_frame_is_held(skin: Skin, solves: list[int]) -> None:
    """Noise of one sigma keeps the belief, and costs no solve."""
    search = Search(skin.sensor.fit)
    belief = search.advance(None, skin.frame(LEFT, RIGHT))
    frames = [skin.frame(LEFT, RIGHT) for _ in range(20)]
    solves.clear()
    for frame in frames:
        again = search.advance(belief, frame)
        assert again.how == "still"
        np.testing.assert_array_equal(again.account.contacts, belief.account.contacts)
        belief = again
    assert not solves


def test_what_is_held_is_judged_by_the_new_frame(skin: Skin) -> None:
    search = Search(skin.sensor.fit)
    belief = search.advance(None, skin.frame(LEFT))
    frame = skin.frame(LEFT)
    again = search.advance(belief, frame)
    left = skin.sensor.fit.compare(belief.account.fitted, belief.judged(frame.measured)).residual
    np.testing.assert_array_equal(again.account.fitted.residual, left)


def test_a_contact_that_slides_is_followed(skin: Skin, solves: list[int]) -> None:
    """With one to three solves of each sheet a frame, once its pace is known."""
    search, belief, x_m, spent = Search(skin.sensor.fit), None, -0.016, []
    for _ in range(16):
        x_m += 0.002
        pressed = contact(x_m, 0.002, 0.007)
        frame = skin.frame(pressed)
        solves.clear()
        belief = search.advance(belief, frame)
        spent.append(len(solves) / len(skin.sensor.fit.responses))
        assert_at(belief, pressed)
    # Two solves are those that start: where the contact was, and where it would be.
    assert np.median(spent[3:]) <= 3


def test_a_contact_that_leaves_the_sheet_is_one_until_it_is_gone(stacked: Skin) -> None:
    search, belief = Search(stacked.sensor.fit), None
    for x_m in (0.050, 0.055, 0.060, 0.065, 0.070):
        belief = search.advance(belief, stacked.frame(contact(x_m, 0.01, 0.012)))
        assert belief.account.family.count == 1
        assert np.isfinite(belief.account.contacts).all()
    assert_at(search.advance(belief, stacked.frame()))


# One call


def same(one: object, other: object) -> bool:
    """Whether values are the same bit for bit, arrays in them too."""
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")  # type: ignore[arg-type]
    if is_dataclass(one):
        return all(
            same(getattr(one, each.name), getattr(other, each.name))
            for each in fields(one)
            if not callable(getattr(one, each.name))
        )
    if isinstance(one, dict):
        return isinstance(other, dict) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return isinstance(other, tuple) and all(map(same, one, other))
    return one is other or bool(one == other)


def said(belief: Belief) -> tuple[object, ...]:
    """What a belief says, in copies."""
    account = belief.account
    return (
        account.contacts.copy(),
        account.fitted.residual.copy(),
        account.hessian.copy(),
        account.log_evidence,
        tuple(dict(mine) for mine in belief.rivals),
        None if belief.since is None else (belief.since.mean.copy(), belief.since.count),
        belief.moved.copy(),
        belief.rounds,
        belief.done,
        belief.how,
    )


@pytest.mark.parametrize("change", ["still", "moved", "landed", "lifted"])
def test_a_step_is_a_pure_function(skin: Skin, change: str) -> None:
    """The belief that is given stays as it is, and the same call says the same bit for bit."""
    moved = LEFT.copy()
    moved[[X, Y]] += 0.1, 0.06
    after = {"still": (LEFT,), "moved": (moved,), "landed": (LEFT, RIGHT), "lifted": ()}[change]
    search = Search(skin.sensor.fit)
    belief = search.advance(None, skin.frame(LEFT))
    before, measured = said(belief), skin.measured(*after)
    one = search.advance(belief, Frame(measured, Budget(PLENTY_S)))
    search.advance(one, skin.frame(RIGHT))  # what a search may remember of another scene
    other = search.advance(belief, Frame(measured, Budget(PLENTY_S)))
    assert same(said(belief), before)
    assert same(said(one), said(other))


def test_pressures_follow_what_moves_also_when_time_is_short(skin: Skin) -> None:
    """Once it is found, a step a frame has to do for outline and pressure."""
    if Channel.MAGNITUDE not in skin.sensor.fit.responses:
        pytest.skip("no sheet tells pressures")
    pressed = [
        contact(-0.010 + 2.5e-4 * k, 0.002, 0.009, peak=0.7 + 0.25 * k / 39) for k in range(40)
    ]
    frames = (
        skin.frame(each, noise=2e-4, budget_s=1e-4 if k else PLENTY_S)
        for k, each in enumerate(pressed)
    )
    (one,) = followed(Search(skin.sensor.fit), frames).account.contacts
    assert one[PEAK] == pytest.approx(pressed[-1][PEAK], abs=0.03)
    assert one[X] * UNIT_M == pytest.approx(pressed[-1][X] * UNIT_M, abs=1e-3)


@pytest.mark.parametrize(
    "proposed",
    [(LEFT, RIGHT), (contact(0.02, -0.018, 0.004),), ()],
    ids=["right", "wrong", "nothing"],
)
def test_what_is_proposed_is_judged_by_the_data(
    skin: Skin, proposed: tuple[FloatArray, ...]
) -> None:
    frame = Frame(skin.measured(LEFT, RIGHT), Budget(PLENTY_S), lambda: contacts(*proposed))
    belief = Search(skin.sensor.fit).advance(None, frame)
    assert_at(belief, LEFT, RIGHT)
    assert len(proposed) != 2 or belief.how == "proposed"


# Kinds


SIDE_BY_SIDE = {
    Kind.RING: contact(-0.04, 0.01, 0.014, hole=1.0),
    Kind.FALLING: contact(0.0, -0.02, 0.014, peak=0.9, edge=0.5),
    Kind.EVEN: contact(0.04, 0.01, 0.013, e=(0.25, 0.1)),
}


def rectangle_on(stacked: Skin, noise: float) -> Measured:
    """Fourfold bulges make an ellipse a rounded rectangle: they belong to what is drawn."""
    rounded = contact(0.0, 0.03, 0.016, waves=(0.0, 0.0, -0.05, 0.0))
    return stacked.measured(*SIDE_BY_SIDE.values(), rounded, noise=noise)


@pytest.mark.parametrize("seed", range(3))
def test_a_ring_a_dome_and_an_even_press_side_by_side_are_told_apart(
    large: Sensor, seed: int
) -> None:
    skin = Skin(large, np.random.default_rng(seed))
    belief = Search(large.fit).advance(None, skin.frame(*SIDE_BY_SIDE.values(), noise=2e-4))
    assert_at(belief, *SIDE_BY_SIDE.values())
    assert kinds_by_x(belief) == list(SIDE_BY_SIDE)
    peaks = belief.account.contacts[belief.account.contacts[:, X].argsort(), PEAK]
    assert peaks == pytest.approx([one[PEAK] for one in SIDE_BY_SIDE.values()], rel=0.05)


def test_a_rounded_rectangle_is_told_from_what_is_beside_it(stacked: Skin) -> None:
    frame = Frame(rectangle_on(stacked, 1e-4), Budget(PLENTY_S))
    belief = Search(stacked.sensor.fit).advance(None, frame)
    each = belief.account.contacts
    assert kind_of(each[each[:, Y].argmax()]) is Kind.ROUNDED
    assert sorted(map(kind_of, each)) == sorted([*SIDE_BY_SIDE, Kind.ROUNDED])
    assert belief.account.fitted.misfit < 1.5


def test_what_a_small_contact_at_little_signal_is_stays_open(stacked: Skin) -> None:
    """Its odds are, and what is told of its peak covers each of what it may be."""
    pressed = contact(0.01, 0.02, 0.008, peak=0.8)
    search = Search(stacked.sensor.fit)
    frame = stacked.frame(pressed, noise=1e-2)
    belief = search.advance(None, frame)
    (alternatives,) = belief.alternatives
    likely = [one for one in alternatives if one.odds > 0.05]
    assert likely
    accountant = FieldAccountant(stacked.sensor.fit, AreaFinder(stacked.sensor.fit.forward))
    fitted = belief.account.fitted
    told = accountant.account(fitted, frame.measured, belief.alternatives).contacts
    assert told is not None
    own = belief.account.contacts[0]
    apart = [
        abs(told.peak_magnitude[0] - magnitude_of(search, one))
        for one in (own, *(each.contact for each in likely))
    ]
    odds = np.array([1.0, *(one.odds for one in likely)])
    assert told.peak_magnitude_sigma[0] >= np.sqrt(odds / odds.sum() @ np.square(apart)) * 0.99


def magnitude_of(search: Search, one: FloatArray) -> float:
    """|Relative change| under a contact's peak."""
    response = search.fit.responses[Channel.MAGNITUDE]
    peak_kpa = np.array([search.field.unit_kpa * one[PEAK]])
    return float(abs(response.conductivity(np.ones(1), peak_kpa, 1.0)[0][0] - 1))


@pytest.mark.parametrize(("edge", "hole"), [(0.0, 0.0), (0.5, 0.0), (0.0, 1.0)])
def test_edges_and_holes_are_what_the_data_say(skin: Skin, edge: float, hole: float) -> None:
    """And the peak with them, to a tenth."""
    if Channel.MAGNITUDE not in skin.sensor.fit.responses:
        pytest.skip("no sheet tells pressures")
    pressed = contact(-0.004, 0.002, 0.012, peak=0.85, edge=edge, hole=hole)
    frames = (skin.frame(pressed, noise=1e-4) for _ in range(6))
    belief = followed(Search(skin.sensor.fit), frames)
    (one,), (mine,) = belief.account.contacts, belief.rivals
    likely = {kind_of(one), *(kind for kind, rival in mine.items() if rival.log_odds > -3)}
    if kind_of(one) is kind_of(pressed):
        assert one[PEAK] == pytest.approx(pressed[PEAK], rel=0.1)
    else:  # one graded sheet alone may leave it open, and says so by an alternative
        assert len(skin.sensor.fit.responses) == 1
        assert len(likely) > 1


@pytest.mark.parametrize("budget_s", [0.005, 0.02, PLENTY_S])
def test_an_even_press_that_lands_is_not_soft_for_want_of_time(skin: Skin, budget_s: float) -> None:
    """A fit that was cut short says nothing about edges."""
    pressed = contact(-0.004, 0.002, 0.012, peak=0.85)
    frames = (skin.frame(pressed, noise=2e-4, budget_s=budget_s) for _ in range(60))
    (one,) = followed(Search(skin.sensor.fit), frames).account.contacts
    assert kind_of(one) is Kind.EVEN
    assert np.exp(one[SIZE]) == pytest.approx(0.012, rel=0.02)


# Crowds


CORNERS = tuple(
    contact(x, y, 0.008)
    for x, y in ((-0.046, -0.045), (-0.042, 0.046), (0.042, -0.044), (0.046, 0.045))
)
BESIDE = contact(-0.014, -0.002, 0.008), contact(0.014, 0.0, 0.008)


def test_two_in_a_crowd_are_not_taken_for_one(stacked: Skin) -> None:
    """Also where what is proposed is one for two; and they stay two."""
    search = Search(stacked.sensor.fit)
    proposed = contacts(*CORNERS, contact(0.0, 0.0, 0.012))
    measured = stacked.measured(*CORNERS, *BESIDE, noise=2e-4)
    belief = search.advance(None, Frame(measured, Budget(PLENTY_S), lambda: proposed))
    assert_at(belief, *CORNERS, *BESIDE)
    belief = search.advance(belief, stacked.frame(*CORNERS, *BESIDE, noise=2e-4))
    assert_at(belief, *CORNERS, *BESIDE)
    assert belief.how == "still"


PALM = contact(0.004, -0.002, 0.036, peak=0.06)  # 18 kPa
PIECES = tuple(
    contact(x, y, 0.012)
    for x, y in ((-0.015, -0.02), (0.02, -0.018), (0.022, 0.016), (-0.014, 0.015))
)


@pytest.mark.parametrize("proposed", [(), PIECES], ids=["found", "proposed in pieces"])
def test_a_palm_that_comes_lightly_is_one_contact_of_its_pressure(
    stacked: Skin, proposed: tuple[FloatArray, ...]
) -> None:
    """And no sheet that changes little under a hard press, which would explain the data as well."""
    lighter = PALM.copy()
    lighter[PEAK] /= 2
    frames = (
        Frame(stacked.measured(palm, noise=2e-4), Budget(PLENTY_S), lambda: contacts(*proposed))
        for palm in (lighter, PALM)
    )
    belief = followed(Search(stacked.sensor.fit), frames)
    assert_at(belief, PALM)
    (one,) = belief.account.contacts
    assert one[PEAK] == pytest.approx(PALM[PEAK], rel=0.5)


@pytest.mark.slow
def test_a_crowd_that_moves_shrinks_or_misses_a_sheet_is_followed(stacked: Skin) -> None:
    """What both sheets have found is kept on one, and by the sheets that come back."""
    search = Search(stacked.sensor.fit)
    belief = search.advance(None, stacked.frame(*CORNERS, *BESIDE, noise=2e-4))
    one, other = BESIDE
    for k in range(4):
        moved = one.copy()
        moved[Y] += 0.001 * (k + 1) / UNIT_M
        frame = stacked.frame(*CORNERS, moved, other, noise=2e-4)
        belief = search.advance(belief, frame)
    assert_at(belief, *CORNERS, moved, other)
    structure = {Channel.STRUCTURE: frame.measured[Channel.STRUCTURE]}
    alone = search.advance(belief, Frame(structure, Budget(PLENTY_S)))
    assert alone.account.family.count == 6
    back = search.advance(alone, stacked.frame(*CORNERS, moved, other, noise=2e-4))
    assert_at(back, *CORNERS, moved, other)
    few = search.advance(back, stacked.frame(*CORNERS[:2], noise=2e-4))
    assert_at(few, *CORNERS[:2])


def test_rings_in_a_crowd_are_told_from_discs(stacked: Skin) -> None:
    rings = [
        contact(one[X] * UNIT_M, one[Y] * UNIT_M, 0.013, peak=0.7, hole=1.0) for one in CORNERS
    ]
    belief = Search(stacked.sensor.fit).advance(None, stacked.frame(*rings, noise=2e-4))
    assert [kind_of(one) for one in belief.account.contacts] == 4 * [Kind.RING]
