"""Never a confident wrong map: what the data do not support is flagged, or absent.

What the data cannot show is not claimed here. A reference taken under a load that stays is one
such thing: against it, more pressing looks like pressing.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from model_fixtures import Tared
from noisy_skin import Skin
from tactomo_models import (
    Channel,
    Flag,
    Press,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.magnitudes import BAD_MISFIT
from tactomo_models.scans.frame_noise import noise_limit
from variants import variant

Scans = dict[str, FloatArray]

PRESS = Press(0.03, -0.02, 180.0)
OTHER = Press(-0.03, 0.03, 170.0)


@pytest.fixture
def rest(skin: Skin) -> Reference:
    return skin.reference()


def frames(
    reconstructor: Reconstructor,
    skin: Skin,
    *presses: Press,
    change: Callable[[Scans], Scans] = lambda scans: scans,
    count: int = 10,
) -> list[Reconstruction]:
    return [reconstructor.reconstruct(**change(skin.scan(*presses))) for _ in range(count)]


def mirrored(volts: FloatArray, around: FloatArray | None) -> FloatArray:
    """As if the sheet's conductivity had changed the other way."""
    assert around is not None
    return 2 * around - volts


@pytest.mark.slow
@pytest.mark.parametrize("channel", Channel)
def test_a_sheet_against_the_sensors_sign_is_flagged(
    reconstructor: Reconstructor, skin: Skin, rest: Reference, channel: Channel
) -> None:
    def turn(scans: Scans) -> Scans:
        return {**scans, channel: mirrored(scans[channel], getattr(rest, channel))}

    for frame in frames(reconstructor, skin, PRESS, change=turn):
        assert Flag.MISFIT_HIGH in frame.flags
        if channel == Channel.MAGNITUDE:
            assert all(math.isnan(contact.pressure_kpa) for contact in frame.contacts)


@pytest.mark.parametrize("change_at_200_kpa", [0.25, -0.25])
def test_a_magnitude_is_right_along_the_sensors_sign_and_flagged_against_it(
    small: SensorDescription, change_at_200_kpa: float
) -> None:
    """Also where the fit explains the data to their noise."""
    sensor, opposite = (
        variant(small, magnitude={"response": response_to(change)})
        for change in (change_at_200_kpa, -change_at_200_kpa)
    )
    skin, other = (Skin(SkinSimulator(described), 1e-4) for described in (sensor, opposite))
    reconstructor = Reconstructor(sensor, method="fit")
    reconstructor.set_reference(skin.reference())
    press = Press(0.006, 0.004, 180.0, 0.008)
    along = reconstructor.reconstruct(**skin.scan(press))
    assert Flag.MISFIT_HIGH not in along.flags
    assert [contact.magnitude > 0.1 for contact in along.contacts] == [True]
    light = reconstructor.reconstruct(**skin.scan(Press(0.006, 0.004, 60.0, 0.008)))
    assert len(light.contacts) == 1
    assert Flag.MISFIT_HIGH not in light.flags, "neither way"
    against = reconstructor.reconstruct(
        **{**skin.scan(press), "magnitude": other.scan(press)["magnitude"]}
    )
    assert Flag.MISFIT_HIGH in against.flags
    assert [contact.magnitude for contact in against.contacts] == pytest.approx([0], abs=1e-3)


def response_to(change_at_200_kpa: float) -> dict[str, tuple[float, ...]]:
    return {
        "pressure_kpa": (0.0, 100.0, 200.0),
        "relative_change": (0.0, 0.0, change_at_200_kpa),
    }


@pytest.mark.parametrize("structure", ["at rest", pytest.param("missing", marks=pytest.mark.slow)])
def test_a_magnitude_that_no_contact_explains_is_flagged(
    reconstructor: Reconstructor, skin: Skin, rest: Reference, structure: str
) -> None:
    def alone(scans: Scans) -> Scans:
        if structure == "at rest":
            return {**scans, "structure": skin.scan()["structure"]}
        return {"magnitude": mirrored(scans["magnitude"], rest.magnitude), "structure": None}  # type: ignore[dict-item]

    for frame in frames(reconstructor, skin, PRESS, change=alone):
        assert frame.flags & (Flag.MISFIT_HIGH | Flag.LOW_CONFIDENCE)


@pytest.mark.slow
@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
@pytest.mark.parametrize("noise", ["known", "unknown"])
def test_a_reference_with_a_bad_voltage_still_serves(
    tared: Tared, skin: Skin, rest: Reference, bad: float, noise: str
) -> None:
    assert rest.structure is not None
    structure = np.where(np.arange(len(rest.structure)) == 17, bad, rest.structure)
    given = (rest.magnitude_noise, rest.structure_noise, rest.scans) if noise == "known" else ()
    reconstructor = tared(Reference(rest.magnitude, structure, *given))
    frame = frames(reconstructor, skin, PRESS)[-1]
    assert Flag.INVALID_VOLTAGE in frame.flags
    (contact,) = frame.contacts
    assert math.dist((contact.x_m, contact.y_m), (PRESS.x_m, PRESS.y_m)) < 0.002


@pytest.mark.parametrize("value", [math.nan, 0.0])
def test_a_reference_of_nothing_gives_no_map(tared: Tared, skin: Skin, value: float) -> None:
    nothing = np.full(208, value)
    for frame in frames(tared(Reference(nothing, nothing)), skin, PRESS, count=2):
        assert frame.map is None
        assert frame.structure is None
        assert Flag.MAGNITUDE_MISSING | Flag.STRUCTURE_MISSING in frame.flags


@pytest.mark.slow
@pytest.mark.parametrize("noise_share", [1e-4, 1e-3])
def test_what_is_quiet_has_no_misfit_that_would_be_flagged(
    tared: Tared, simulator: SkinSimulator, noise_share: float
) -> None:
    skin = Skin(simulator, noise_share)
    reconstructor = tared(on=skin)

    def drift(scans: Scans) -> Scans:
        return {name: 1.003 * volts for name, volts in scans.items()}

    for frame in frames(reconstructor, skin, change=drift):
        assert (frame.tier, frame.flags) == ("quiet", Flag(0))
        assert 0.5 < frame.misfit < math.sqrt(noise_limit(208) / 208) < BAD_MISFIT


def test_a_budget_that_is_too_small_is_said_and_made_up_for(
    reconstructor: Reconstructor, skin: Skin
) -> None:
    reconstructor.budget_s = 1e-3
    made = frames(reconstructor, skin, PRESS, OTHER, count=60)
    assert Flag.NOT_CONVERGED in made[0].flags
    assert made[-1].flags == Flag(0)
    assert len(made[-1].contacts) == 2


def test_the_linear_map_is_linear(
    reconstructor: Reconstructor, skin: Skin, rest: Reference
) -> None:
    reconstructor.method = "tikhonov"
    reconstructor.set_reference(rest)
    assert rest.magnitude is not None
    change = skin.scan(PRESS)["magnitude"] - rest.magnitude
    once, twice = (
        reconstructor.reconstruct(rest.magnitude + factor * change, None).map for factor in (1, 2)
    )
    assert once is not None
    assert twice is not None
    assert once.max() > 0.02
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("tier", "bad"), [("auto", "reversed"), ("fit", "louder"), ("levelset", "noisier")]
)
def test_one_bad_frame_is_forgotten(
    reconstructor: Reconstructor, skin: Skin, tier: str, bad: str
) -> None:
    """What explained a bad frame, badly or well, has no claim on the good ones after it."""
    spoil: Callable[[FloatArray], FloatArray] = {
        "reversed": lambda volts: volts[::-1].copy(),
        "louder": lambda volts: 1.02 * volts,
        "noisier": lambda volts: volts * (1 + 0.02 * np.cos(7 * np.arange(len(volts)))),
    }[bad]
    reconstructor.method = tier
    before = frames(reconstructor, skin, PRESS, OTHER, count=12)[-1]
    scan = skin.scan(PRESS, OTHER)
    assert reconstructor.reconstruct(**{name: spoil(volts) for name, volts in scan.items()}).flags
    after = frames(reconstructor, skin, PRESS, OTHER, count=15)[-1]
    assert after.flags == before.flags == Flag(0)
    assert len(after.contacts) == len(before.contacts) == 2
    for one, other in zip(
        sorted(before.contacts, key=lambda c: c.x_m),
        sorted(after.contacts, key=lambda c: c.x_m),
        strict=True,
    ):
        assert np.hypot(one.x_m - other.x_m, one.y_m - other.y_m) < 1.5e-3
        assert other.magnitude == pytest.approx(one.magnitude, rel=0.15)
