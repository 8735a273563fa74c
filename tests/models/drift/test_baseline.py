"""Baseline tracking: drift leaves no ghost, and nothing that presses is taken for drift."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from faulty_skin import touches
from noisy_skin import rms
from tactomo_models import (
    Artifact,
    BaselineTracker,
    Flag,
    Press,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.drift.drift_model import CREEP
from tactomo_protocol import Channel

Presses = tuple[Press, ...]

PRESS = Press(0.01, -0.02, 180.0)
TOUCH = replace(PRESS, pressure_kpa=2.0)  # far too light for the magnitude channel
NOISE_SHARE = 2.5e-4  # of the largest voltage at rest, as the twin has it


class Life:
    """A skin in time: what presses on it, how its gain drifts, and what the tracker makes of it."""

    def __init__(
        self,
        simulator: SkinSimulator,
        reconstructor: Reconstructor,
        lead: Callable[[FloatArray], FloatArray] = lambda volts: volts,
    ) -> None:
        self.now_s = 1000.0
        self.lead = lead  # what a broken one makes of the voltages
        self.gain = 1.0
        self._simulator = simulator
        self._rest = simulator.voltages(())
        self._rng = np.random.default_rng(5)
        self.reconstructor = reconstructor
        self.tracker = BaselineTracker(reconstructor)
        self.tare()

    def tare(self) -> None:
        scans = [self.scan() for _ in range(20)]
        stacks = (np.array([scan[name] for scan in scans]) for name in ("magnitude", "structure"))
        self.tracker.begin(self.reconstructor.take(Reference.from_scans(*stacks)))

    def scan(self, *presses: Press) -> dict[str, FloatArray]:
        return {
            name: self.lead(
                self.gain * volts
                + NOISE_SHARE
                * np.abs(self._rest[name]).max()
                * self._rng.standard_normal(len(volts))
            )
            for name, volts in self._simulator.voltages(presses).items()
        }

    def lives(
        self,
        seconds: float,
        *presses: Press,
        step_s: float = 2.0,
        gain: float = 1.0,
        presses_at: Callable[[float], Presses] | None = None,
    ) -> list[Reconstruction]:
        """Go on for so long, while the gain changes by a factor; returns the frames."""
        steps = round(seconds / step_s)
        frames = []
        for step in range(1, steps + 1):
            self.now_s += step_s
            self.gain *= gain ** (1 / steps)
            now = presses if presses_at is None else presses_at(step / steps)
            frames.append(self.tracker.reconstruct(self.now_s, **self.scan(*now)))
        return frames


@pytest.fixture
def life(simulator: SkinSimulator, paper: SensorDescription, artifact: Artifact) -> Life:
    made = Life(simulator, Reconstructor(paper, artifact))
    made.lives(20)
    return made


def count(frames: list[Reconstruction]) -> list[int]:
    return [len(frame.contacts) for frame in frames]


@pytest.mark.slow
def test_a_sheet_that_warms_leaves_no_ghost_and_untracked_it_does(life: Life) -> None:
    tare = life.tracker.reference
    frames = life.lives(1200, gain=0.95)
    frames += life.lives(300)
    assert {frame.tier for frame in frames} == {"quiet"}
    assert life.tracker.drift[Channel.STRUCTURE].gain == pytest.approx(-0.05, abs=2e-3)
    assert life.tracker.state == "following"
    assert tare is not None
    life.reconstructor.set_reference(replace(tare, magnitude_drift=None, structure_drift=None))
    assert life.reconstructor.reconstruct(**life.scan()).tier != "quiet"


@pytest.mark.slow
def test_a_contact_of_an_hour_stays_while_the_sheet_cools_and_leaves_no_ghost(life: Life) -> None:
    life.lives(10, PRESS, step_s=1.0)
    frames = life.lives(3600, PRESS, step_s=30.0, gain=1.03)
    assert set(count(frames)) == {1}
    magnitudes = [frame.contacts[0].magnitude for frame in frames]
    # A quarter: while a kind is open, the mean over kinds moves with their odds.
    assert np.ptp(magnitudes) < 0.25 * np.mean(magnitudes)
    assert life.tracker.drift[Channel.STRUCTURE].gain == pytest.approx(0.03, abs=3e-3)
    assert life.tracker.state == "held"
    assert set(count(life.lives(20))) == {0}


@pytest.mark.slow
@pytest.mark.parametrize("kpa", [1.5, 180.0])
def test_a_contact_that_lasts_is_never_erased(life: Life, kpa: float) -> None:
    frames = life.lives(12 * 3600, replace(PRESS, pressure_kpa=kpa), step_s=600.0)
    assert 0 not in count(frames)
    assert life.tracker.drift[Channel.STRUCTURE].uneven < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("diameter_m", "kpa", "comes_s"), [(0.11, 10.0, 1.0), (0.08, 3.0, 600.0)])
def test_a_palm_that_comes_is_one_contact(
    life: Life, diameter_m: float, kpa: float, comes_s: float
) -> None:
    """Once they were four and nine contacts in two frames of three, and no flag."""
    palm = Press(0.0, 0.0, kpa, radius_m=diameter_m / 2)
    step_s = max(comes_s / 300, 0.025)
    frames = life.lives(
        comes_s, step_s=step_s, presses_at=lambda share: (replace(palm, pressure_kpa=share * kpa),)
    )
    several = [len(frame.contacts) > 1 and not frame.flags for frame in frames]
    assert np.mean(several) < 0.05
    assert set(count(life.lives(10 * step_s, palm, step_s=step_s))) == {1}


def test_a_touch_that_stays_when_a_press_is_eased_is_not_taken_for_creep(life: Life) -> None:
    life.lives(600, PRESS, step_s=10.0)
    assert set(count(life.lives(120, TOUCH))) == {1}


def test_what_creep_may_hide_is_not_known(life: Life) -> None:
    """A touch beside what was let go is told, or flagged: most of its frames showed nothing."""
    touch = Press(0.012, 0.012, 4.8, radius_m=0.006)
    assert set(count(life.lives(10, touch, step_s=0.5))) == {1}, "alone it is told"
    life.lives(10)
    life.lives(60, Press(0.0, 0.0, 180.0), step_s=1.0)
    frames = life.lives(40, touch, step_s=0.5)
    assert all(frame.contacts or frame.flags for frame in frames)
    assert any(Flag.CREEPING in frame.flags for frame in frames)
    frames = life.lives(300)
    assert not frames[-1].flags
    assert set(count(frames)) == {0}


def test_a_finger_that_comes_down_within_a_minute_is_reported(life: Life) -> None:
    def presses_at(share: float) -> Presses:
        return (replace(PRESS, pressure_kpa=100.0 * share),)

    frames = life.lives(60, presses_at=presses_at, step_s=0.5)
    assert count(frames[8:]) == [1] * len(frames[8:])  # from 7 kPa on
    assert set(count(life.lives(20))) == {0}


@pytest.mark.slow
def test_what_creeps_back_after_a_long_press_is_no_ghost(life: Life) -> None:
    life.lives(1800, PRESS, step_s=20.0)
    # 3 per cent more conductive where it was pressed: 0.15 kPa, as a touch would have it.
    left = replace(PRESS, pressure_kpa=5.0 * 3 * CREEP)
    assert {f.tier for f in life.lives(60, left)} == {"quiet"}
    assert life.tracker.moves
    life.tare()
    assert life.tracker.state == "waiting"
    life.lives(20)
    assert life.tracker.drift[Channel.STRUCTURE].uneven < 1e-3


@pytest.mark.slow
def test_a_step_that_no_skin_makes_is_refused_and_said(life: Life) -> None:
    """A fifth less is a drift that the fit allows for, three tenths are not."""
    assert life.lives(60, gain=0.7)[-1].flags
    life.lives(30)
    assert life.tracker.state == "refused"
    assert life.tracker.refusal


def test_flagged_frames_teach_nothing(life: Life) -> None:
    before = life.tracker.drift
    life.gain = 1.002
    for _ in range(60):
        life.now_s += 2.0
        life.tracker.reconstruct(life.now_s, **life.scan(), saturated=[Channel.STRUCTURE])
        life.tracker.reconstruct(life.now_s, life.scan()["magnitude"], None)
    assert life.tracker.drift == before


# A broken lead


LEAD = 5  # at the right side, 18 mm below the middle
BESIDE_LEAD = Press(0.05, -0.018, 1.5)


@pytest.fixture(params=["silent", pytest.param("floats", marks=pytest.mark.slow)])
def broken(
    request: pytest.FixtureRequest,
    simulator: SkinSimulator,
    paper: SensorDescription,
    artifact: Artifact,
) -> Life:
    """A life with a lead that was broken before the tare."""
    rng, size = np.random.default_rng(8), rms(simulator.voltages(())[Channel.MAGNITUDE])
    mine = touches(paper, LEAD)
    made: dict[str, Callable[[FloatArray], FloatArray]] = {
        "silent": lambda volts: np.where(mine, 0.0, volts),
        "floats": lambda volts: np.where(mine, size * rng.normal(size=len(volts)), volts),
    }
    life = Life(simulator, Reconstructor(paper, artifact), made[request.param])
    life.lives(20)
    assert life.tracker.state == "following"
    return life


def test_a_skin_with_a_lead_broken_for_good_is_followed_like_any(broken: Life) -> None:
    frames = broken.lives(1200, gain=0.95)
    frames += broken.lives(300)
    assert {frame.tier for frame in frames} == {"quiet"}
    assert {Flag.ELECTRODE_FAULT in frame.flags for frame in frames} == {True}
    assert broken.tracker.drift[Channel.STRUCTURE].gain == pytest.approx(-0.05, abs=2e-3)
    assert broken.tracker.reference is not None
    assert broken.tracker.reference.structure_drift is not None
    assert np.abs(broken.tracker.reference.structure_drift).max() < 0.1  # also of that lead's


@pytest.mark.slow
@pytest.mark.parametrize("press", [PRESS, BESIDE_LEAD], ids=["firm", "light, beside it"])
def test_a_contact_that_lasts_is_never_erased_where_a_lead_is_broken(
    broken: Life, press: Press
) -> None:
    frames = broken.lives(12 * 3600, press, step_s=600.0, gain=1.02)
    assert 0 not in count(frames)
    assert set(count(broken.lives(20))) == {0}


@pytest.mark.slow
def test_a_lead_that_breaks_after_the_tare_ends_the_following_until_the_next(
    life: Life, paper: SensorDescription
) -> None:
    before = life.tracker.drift
    life.lead = lambda volts: np.where(touches(paper, LEAD), 0.0, volts)
    life.lives(120, gain=1.002)
    assert life.tracker.drift == before
    life.tare()
    life.lives(300, gain=1.01)
    assert life.tracker.drift[Channel.STRUCTURE].gain == pytest.approx(0.01, abs=2e-3)


@pytest.mark.slow
def test_equal_frames_lead_to_equal_references(
    simulator: SkinSimulator, paper: SensorDescription, artifact: Artifact
) -> None:
    ends = []
    for _ in range(2):
        life = Life(simulator, Reconstructor(paper, artifact))
        life.lives(300, gain=1.02)
        life.lives(20, PRESS)
        life.lives(20)
        ends.append(life.tracker.reference)
    assert ends[0] is not None
    assert ends[1] is not None
    np.testing.assert_array_equal(ends[0].structure_drift, ends[1].structure_drift)


@pytest.mark.slow
def test_a_drifted_reference_says_the_same_again_wherever_it_is_put_in_force(
    life: Life, paper: SensorDescription, artifact: Artifact
) -> None:
    life.lives(300, gain=1.02)
    reference = life.tracker.reference
    assert reference is not None
    other = Reconstructor(paper, artifact)
    other.set_reference(reference)
    scan = life.scan(PRESS)
    life.reconstructor.reset()
    ours, theirs = life.reconstructor.reconstruct(**scan), other.reconstruct(**scan)
    np.testing.assert_array_equal(ours.map, theirs.map)
    assert [(c.x_m, c.y_m) for c in ours.contacts] == [(c.x_m, c.y_m) for c in theirs.contacts]
