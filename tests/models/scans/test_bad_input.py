"""Bad input is flagged where the data can show it, and never makes a confident wrong map.

What the data cannot show is here, too: an order of electrodes that is a symmetry of the sheet, and
a bad contact of an ideal device.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from faulty_skin import BAD_LEADS, rewired, shorted, touches
from hypothesis import given
from hypothesis import strategies as st
from model_fixtures import Tared
from noisy_skin import Skin, rms
from shared_data import measured
from tactomo_lab.scenes.case import with_lead
from tactomo_models import (
    Flag,
    Press,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
    build_artifact,
    load_description,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_protocol import Channel
from variants import variant

Scans = dict[str, FloatArray]
Change = Callable[[Scans], Scans]

PRESS = Press(0.03, -0.02, 180.0)
OTHER = Press(-0.03, 0.03, 170.0)
LEAD = 9


class Show:
    """A skin, its tare, and what is shown of its scans."""

    def __init__(self, paper: SensorDescription, tared: Tared, skin: Skin) -> None:
        self.paper, self.tared, self.skin = paper, tared, skin

    def __call__(
        self,
        *presses: Press,
        at_tare: Change = lambda scans: scans,
        later: Change = lambda scans: scans,
        tared_on: Skin | None = None,
        by: Skin | None = None,
        frames: int = 6,
    ) -> Reconstruction:
        skin = by or self.skin
        reconstructor = self.tared(reference_of(tared_on or skin, at_tare))
        for _ in range(frames):
            frame = reconstructor.reconstruct(**later(skin.scan(*presses)))
        return frame


@pytest.fixture
def show(paper: SensorDescription, tared: Tared, skin: Skin) -> Show:
    return Show(paper, tared, skin)


def reference_of(skin: Skin, change: Change, *presses: Press) -> Reference:
    taken = [change(skin.scan(*presses)) for _ in range(20)]
    return Reference.from_scans(
        np.array([scans["magnitude"] for scans in taken]),
        np.array([scans["structure"] for scans in taken]),
    )


def only(channel: str, change: Callable[[FloatArray], FloatArray]) -> Change:
    return lambda scans: {**scans, channel: change(scans[channel])}


def each(change: Callable[[FloatArray], FloatArray]) -> Change:
    return lambda scans: {name: change(volts) for name, volts in scans.items()}


def bad_lead(paper: SensorDescription, kind: str) -> Callable[[FloatArray], FloatArray]:
    """A lead that is open, and what its input does then; or a contact that is poor."""
    rng = np.random.default_rng(4)

    def open_at(volts: FloatArray, level: float) -> FloatArray:
        return with_lead(paper, volts, LEAD, 1e-3, lambda *_: level * rms(volts))

    more: dict[str, Callable[[FloatArray], FloatArray]] = {
        "picks up mains": lambda volts: open_at(volts, 3 * rng.normal()),
        "at the rail": lambda volts: np.clip(open_at(volts, 1e3), -0.8, 0.8),
        "no number": lambda volts: np.where(touches(paper, LEAD), math.nan, volts),
    }
    return more[kind] if kind in more else lambda volts: BAD_LEADS[kind](paper, volts, LEAD)


LEADS = [*BAD_LEADS, "picks up mains", "at the rail", "no number"]
LEADS.remove("gain halved")


def assert_found(frame: Reconstruction, *presses: Press, within_m: float = 0.003) -> None:
    assert len(frame.contacts) == len(presses)
    for press in presses:
        assert within_m > min(
            math.dist((c.x_m, c.y_m), (press.x_m, press.y_m)) for c in frame.contacts
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "when"),
    [
        *((kind, "later") for kind in LEADS),
        *((kind, "at the tare") for kind in ("open, floats", "at the rail", "silent")),
    ],
)
def test_a_bad_lead_is_named_and_the_rest_goes_on(show: Show, kind: str, when: str) -> None:
    broken = bad_lead(show.paper, kind)
    if when == "later":
        frame = show(PRESS, OTHER, later=only("structure", broken), frames=8)
        assert_found(frame, PRESS, OTHER)
    else:
        frame = show(PRESS, at_tare=each(broken), later=each(broken))
        assert f"magnitude electrode {LEAD} left out" in frame.reason
        assert_found(frame, PRESS)
    assert Flag.ELECTRODE_FAULT in frame.flags
    assert frame.reason.endswith(f"structure electrode {LEAD} left out")


@pytest.mark.slow
def test_two_bad_leads_are_survived(show: Show) -> None:
    def broken(volts: FloatArray) -> FloatArray:
        return np.where(touches(show.paper, 3) | touches(show.paper, 9), 0.0, volts)

    frame = show(PRESS, OTHER, later=only("structure", broken), frames=8)
    assert frame.reason.endswith("structure electrodes 3, 9 left out")
    assert_found(frame, PRESS, OTHER)


@pytest.mark.slow
def test_a_poor_contact_alone_does_no_harm(show: Show, paper: SensorDescription) -> None:
    """Four-wire voltages of an ideal device do not depend on the contact that is driven."""
    impedance = np.where(np.arange(paper.electrode_count) == LEAD, 1e6, 1.0)
    sheet = mesh_sheet(paper, spacing_m=0.006)
    good, poor = (
        ForwardModel(paper, solve_bare_sheet(paper, sheet, impedance=given)).bare_voltages
        for given in (None, impedance)
    )

    def change(volts: FloatArray) -> FloatArray:
        return volts * poor / good

    assert np.abs(poor / good - 1).max() < 0.2
    frame = show(PRESS, at_tare=each(change), later=each(change))
    assert frame.flags == Flag(0)
    assert_found(frame, PRESS)


@pytest.mark.slow
@pytest.mark.parametrize("pair", [(3, 4), (1, 9)], ids=str)
@pytest.mark.parametrize("when", ["at the tare", "later"])
def test_a_short_is_flagged(
    show: Show, simulator: SkinSimulator, pair: tuple[int, int], when: str
) -> None:
    short = Skin(shorted(simulator, *pair))
    tared_on = short if when == "at the tare" else show.skin
    frame = show(PRESS, by=short, tared_on=tared_on, frames=2)
    assert Flag.ELECTRODE_FAULT in frame.flags


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "shown"),
    [
        ([*range(1, 16), 0], True),
        ([*range(14, -1, -1), 15], True),
        ([0, 1, 9, *range(3, 9), 2, *range(10, 16)], True),
        ([*range(4, 16), *range(4)], False),
        ([*range(15, -1, -1)], False),
    ],
    ids=["by one", "reversed", "two apart", "by a side", "mirrored"],
)
def test_an_order_of_electrodes_is_flagged_unless_it_is_a_symmetry_of_the_sheet(
    show: Show, simulator: SkinSimulator, order: list[int], shown: bool
) -> None:
    frame = show(PRESS, by=Skin(rewired(simulator, order)), frames=2)
    assert (Flag.REFERENCE_MISMATCH in frame.flags) is shown


@pytest.mark.slow
@pytest.mark.parametrize("when", ["at the tare", "later", "said by the device"])
def test_clipped_voltages_are_left_out(show: Show, when: str) -> None:
    limit = 0.6 * np.abs(show.skin.scan()["structure"]).max()

    def clip(volts: FloatArray) -> FloatArray:
        return np.clip(volts, -limit, limit)

    at_tare = only("structure", clip) if when == "at the tare" else each(np.asarray)
    reconstructor = show.tared(reference_of(show.skin, at_tare))
    for _ in range(6):
        scans = show.skin.scan(PRESS)
        if when == "said by the device":
            worst = np.abs(scans["structure"]).argmax()
            scans["structure"][worst] *= 1.5
            frame = reconstructor.reconstruct(**scans, saturated=[Channel.STRUCTURE])
        else:
            frame = reconstructor.reconstruct(**only("structure", clip)(scans))
    assert Flag.SATURATED in frame.flags
    assert Flag.ELECTRODE_FAULT not in frame.flags
    assert_found(frame, PRESS)


@pytest.mark.slow
def test_a_scan_without_a_number_is_not_called_clipped(show: Show) -> None:
    frame = show(later=each(lambda volts: volts * math.nan))
    assert Flag.SATURATED not in frame.flags
    assert Flag.INVALID_VOLTAGE in frame.flags
    assert Flag.NO_USABLE_SCAN in frame.flags


@pytest.mark.slow
def test_a_tare_under_load_is_flagged_at_once_and_after_the_lift(show: Show, skin: Skin) -> None:
    reconstructor = show.tared(reference_of(skin, each(np.asarray), PRESS, OTHER))
    assert Flag.REFERENCE_MISMATCH in reconstructor.reconstruct(**skin.scan(PRESS, OTHER)).flags
    assert Flag.REFERENCE_MISMATCH in reconstructor.reconstruct(**skin.scan()).flags


@pytest.mark.parametrize(
    "channel", [pytest.param("magnitude", marks=pytest.mark.slow), "structure"]
)
def test_a_lift_after_a_tare_under_load_shows_in_either_channel(
    show: Show, simulator: SkinSimulator, channel: str
) -> None:
    """What the model cannot tell from an uneven sheet, the lift tells by its sign."""
    skin = Skin(simulator, 3e-4)
    light = Press(0.02, 0.02, 190.0, 0.009)
    other: Any = {"magnitude": None, "structure": None}
    del other[channel]
    reconstructor = show.tared(replace(reference_of(skin, each(np.asarray), light), **other))
    loaded, lifted = (
        reconstructor.reconstruct(**(scans | other)) for scans in (skin.scan(light), skin.scan())
    )
    assert Flag.REFERENCE_MISMATCH not in loaded.flags
    assert Flag.REFERENCE_MISMATCH in lifted.flags


@pytest.mark.slow
def test_swapped_channels_are_told(show: Show) -> None:
    def swap(scans: Scans) -> Scans:
        return {"magnitude": scans["structure"], "structure": scans["magnitude"]}

    assert Flag.CHANNELS_SWAPPED in show(PRESS, at_tare=swap, later=swap, frames=1).flags
    assert Flag.CHANNELS_SWAPPED in show(PRESS, later=swap).flags
    assert Flag.CHANNELS_SWAPPED not in show(PRESS, frames=1).flags


@pytest.mark.slow
@pytest.mark.parametrize(
    ("channel", "gain"),
    [("magnitude", 0.5), ("magnitude", 1.3), ("structure", 0.7), ("structure", 2.0)],
)
def test_a_gain_that_changes_is_told_as_one_and_not_as_a_swap(
    reconstructor: Reconstructor, skin: Skin, channel: str, gain: float
) -> None:
    rest, pressed = (skin.scan(*presses) for presses in ((), (PRESS,)))
    for scan in (rest, pressed):
        frame = reconstructor.reconstruct(**{**scan, channel: gain * scan[channel]})
        assert Flag.MISFIT_HIGH in frame.flags
        assert Flag.CHANNELS_SWAPPED not in frame.flags
        is_told = re.search(rf"all {channel} voltages are {gain:g}\d* times", frame.reason)
        assert bool(is_told) == (scan is rest)


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.2, 0.5])
def test_a_gain_that_a_press_of_the_whole_sheet_would_explain_is_told(
    reconstructor: Reconstructor, skin: Skin, gain: float
) -> None:
    for _ in range(3):
        rest = skin.scan()
        frame = reconstructor.reconstruct(rest["magnitude"], gain * rest["structure"])
        assert not frame.contacts or Flag.REFERENCE_MISMATCH in frame.flags


@pytest.mark.slow
def test_interference_is_flagged_and_widens_the_uncertainty(show: Show) -> None:
    rng = np.random.default_rng(5)

    def noisier(times: float) -> Change:
        return each(lambda v: v + times * 1e-3 * rms(v) * rng.standard_normal(len(v)))

    solid = Press(0.02, -0.02, 180.0, radius_m=0.018)  # so large that it is told from a ring
    calm = show(solid)
    some, much = (show(solid, later=noisier(t)) for t in (4, 25))
    assert Flag.NOISE_HIGH not in some.flags
    assert Flag.NOISE_HIGH in much.flags
    sigma = [frame.contacts[0].magnitude_sigma for frame in (calm, some, much)]
    assert sigma[0] < sigma[1]
    if sigma[1] < 2 * sigma[0]:
        pytest.xfail("a calm contact's uncertainty holds kinds that its data should have closed")
    assert sigma[2] > 8 * sigma[0]  # what a mesh cannot tell of an outline is in both
    at_rest = show(later=noisier(4))
    assert at_rest.tier == "quiet", "interference is not pressing"


@pytest.mark.slow
def test_a_broken_device_is_flagged(paper: SensorDescription) -> None:
    """Its reciprocity error is 68 %: nothing can be located from it."""
    sensor = variant(paper, electrodes={"per_side": 8, "pitch_m": 0.018}, magnitude=None)
    with np.load(measured("skin_bad_device_32el.npz")) as stored:
        baseline, dv = (stored[name].astype(float) for name in ("baseline", "dv"))
    apart = (np.arange(32)[:, None] - np.arange(32)) % 32
    kept = ((apart > 1) & (apart < 31)).ravel()  # drive-major; a row holds driven pairs as 0
    reconstructor = Reconstructor(sensor, build_artifact(sensor))
    reconstructor.set_reference(Reference.from_scans(None, baseline[:, kept]))
    for change in dv[:10, kept]:
        frame = reconstructor.reconstruct(None, baseline[:, kept].mean(axis=0) + change)
        assert Flag.NOISE_HIGH | Flag.REFERENCE_MISMATCH in frame.flags


@pytest.mark.slow
def test_clean_scenes_have_no_flag(show: Show, simulator: SkinSimulator) -> None:
    """Seen by the checks alone: what the fits say of themselves is tested with them."""
    rng = np.random.default_rng(6)
    for noise_share in (1e-3, 1e-2):
        skin = Skin(simulator, noise_share)
        reconstructor = show.tared(on=skin, budget_s=1e-3)
        for count in np.tile(np.arange(5), 3):
            presses = [
                Press(float(x), float(y), rng.uniform(60, 200), rng.uniform(0.008, 0.02))
                for x, y in rng.uniform(-0.055, 0.055, (count, 2))
            ]
            frame = reconstructor.reconstruct(**skin.scan(*presses))
            of_the_fits = Flag.NOT_CONVERGED | Flag.MISFIT_HIGH | Flag.LOW_CONFIDENCE
            assert not frame.flags & ~of_the_fits


@pytest.fixture(scope="module")
def small_reconstructor(small: SensorDescription) -> Reconstructor:
    return Reconstructor(small, build_artifact(small), budget_s=2e-3)


STRANGE = [0.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e-310, 1e300, 1e-30, 1.0]


@given(
    seed=st.integers(0, 2**32 - 1),
    strange=st.lists(st.floats() | st.sampled_from(STRANGE), min_size=1, max_size=4),
    shares=st.tuples(*[st.sampled_from([0.0, 0.02, 0.2, 0.6, 1.0])] * 3),
)
def test_whatever_comes_a_map_is_finite_or_absent(
    small_reconstructor: Reconstructor,
    seed: int,
    strange: list[float],
    shares: tuple[float, float, float],
) -> None:
    rng = np.random.default_rng(seed)
    good = small_reconstructor._skin.forward.bare_voltages

    def spoilt(volts: FloatArray, share: float) -> FloatArray:
        return np.where(rng.random(len(volts)) < share, rng.choice(strange, len(volts)), volts)

    in_reference, in_noise, in_scan = shares
    rest = [spoilt(good * rng.uniform(0.97, 1.03, len(good)), in_reference) for _ in range(2)]
    noise = None if in_noise == 1 else spoilt(1e-3 * np.abs(good), in_noise)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small_reconstructor.set_reference(Reference(rest[0], rest[1], noise, None))
        for _ in range(2):
            scans = [spoilt(good * rng.uniform(0.3, 1.1, len(good)), in_scan) for _ in range(2)]
            frame = small_reconstructor.reconstruct(scans[0], scans[1])
            for image in (frame.map, frame.structure):
                assert image is None or np.isfinite(image).all()
            unknown = any(np.isnan(contact.pressure_kpa) for contact in frame.contacts)
            assert frame.pressure_kpa is None or unknown or np.isfinite(frame.pressure_kpa).all()


@pytest.mark.filterwarnings("error")
def test_a_frame_that_is_the_reference_over_again_is_no_division_by_zero(show: Show) -> None:
    """Of numbers that no sheet has, some are left out, and nothing is left to be noise."""
    volts = np.random.default_rng(0).standard_normal(show.paper.measurements)
    made = show.tared(Reference(volts, volts, np.abs(volts), None))
    assert made.reconstruct(volts, volts).flags


@pytest.fixture(scope="module")
def graded() -> Graded:
    return Graded()


class Graded:
    """One graded sheet, of which nothing else tells what presses."""

    def __init__(self) -> None:
        description = load_description("graded_square")
        self.drives = description.pairs.drive[:, 0]
        self.skin = Skin(SkinSimulator(description))
        self.reconstructor = Reconstructor(description)
        self.reconstructor.set_reference(self.skin.reference())
        self.rest = self.skin.scan()["magnitude"]

    def frames(self, later: Change, *presses: Press) -> list[Reconstruction]:
        self.reconstructor.reset()
        self.reconstructor.reconstruct(self.rest, None)
        scans = [later(self.skin.scan(*presses)) for _ in range(3)]
        return [self.reconstructor.reconstruct(scan["magnitude"], None) for scan in scans]


@pytest.mark.parametrize("pressure_kpa", [180.0, 40.0])
def test_a_press_beside_drives_that_are_stuck_is_told_or_not_known(
    graded: Graded, pressure_kpa: float
) -> None:
    """Stuck drives break reciprocity by what presses, as a noisy scan would."""

    def stick(scans: Scans) -> Scans:
        return {"magnitude": np.where(graded.drives < 8, graded.rest, scans["magnitude"])}

    for frame in graded.frames(stick, Press(0.015, -0.01, pressure_kpa, 0.012)):
        assert frame.contacts or Flag.NOISE_HIGH in frame.flags


def test_drives_that_repeat_are_left_out_of_a_frame_and_a_scan_may_be_compared_again(
    graded: Graded,
) -> None:
    pressed = graded.skin.scan(Press(0.015, -0.01, 100.0, 0.012))["magnitude"]
    stuck = np.where(graded.drives < 8, graded.rest, pressed)
    made = graded.reconstructor
    made.reset()
    made.reconstruct(graded.rest, None)
    one, other = (made.compare(stuck, None).changes[Channel.MAGNITUDE] for _ in range(2))
    assert np.array_equal(one.precision, other.precision)
    assert made.reconstruct(stuck, None).flags == Flag.INVALID_VOLTAGE


@pytest.mark.parametrize("pressure_kpa", [180.0, 40.0])
def test_noise_that_may_hide_a_press_is_told(graded: Graded, pressure_kpa: float) -> None:
    rng = np.random.default_rng(5)

    def noisier(scans: Scans) -> Scans:
        return each(lambda v: v + 1e-2 * rms(v) * rng.standard_normal(len(v)))(scans)

    for frame in graded.frames(noisier, Press(0.015, -0.01, pressure_kpa, 0.012)):
        assert frame.contacts or Flag.NOISE_HIGH in frame.flags
    assert not any(frame.flags for frame in graded.frames(lambda scans: scans))


def test_drives_that_were_not_read_are_no_leads_and_their_reciprocals_stand_in(
    graded: Graded,
) -> None:
    def unread(scans: Scans) -> Scans:
        return {"magnitude": np.where(graded.drives < 8, np.nan, scans["magnitude"])}

    for x, y in ((-0.05, -0.05), (0.05, 0.0), (0.0, 0.0)):
        for frame in graded.frames(unread, Press(x, y, 100.0, 0.012)):
            assert frame.flags == Flag.INVALID_VOLTAGE
            (contact,) = frame.contacts
            assert math.hypot(contact.x_m - x, contact.y_m - y) < 0.002


def test_one_sheets_scan_in_both_channels_is_told(reconstructor: Reconstructor, skin: Skin) -> None:
    light = skin.scan(Press(0.015, -0.01, 40.0))["magnitude"]
    assert Flag.CHANNELS_SWAPPED in reconstructor.reconstruct(light, light).flags
    assert not reconstructor.reconstruct(**skin.scan()).flags
