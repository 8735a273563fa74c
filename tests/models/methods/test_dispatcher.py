"""The dispatcher: what it hands to a method from frame to frame, and what it makes of estimates."""

from __future__ import annotations

import numpy as np
import pytest
from model_fixtures import Tared
from noisy_skin import Skin
from tactomo_models import (
    Channel,
    Estimate,
    Measurement,
    Press,
    Reconstructor,
    Reference,
)
from tactomo_models import Skin as PreparedSkin

PRESS = Press(0.02, -0.03, 180.0)


class Smooth:
    """Tikhonov's images; what it was given is kept."""

    def __init__(self) -> None:
        self.previous: list[Estimate | None] = []
        self.skins: list[PreparedSkin] = []

    def prepare(self, skin: PreparedSkin) -> None:
        self.skins.append(skin)

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        self.previous.append(previous)
        skin = self.skins[-1]
        image = {
            name: np.abs(skin.areas.on_map(skin.artifact.tikhonov @ each.change))
            for name, each in measurement.changes.items()
        }
        structure = image[Channel.STRUCTURE]
        return Estimate(map=image[Channel.MAGNITUDE], structure=structure / structure.max())


class Answering(Smooth):
    """Returns what it is told to."""

    def __init__(self, made: Estimate) -> None:
        super().__init__()
        self._made = made

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        return self._made


class Unprepared(Smooth):
    """Cannot be prepared."""

    def prepare(self, skin: PreparedSkin) -> None:
        raise KeyError("weights")


def test_a_map_and_a_structure_suffice(tared: Tared, skin: Skin) -> None:
    method = Smooth()
    reconstructor = tared(method=method)
    frame = reconstructor.reconstruct(**skin.scan(PRESS))
    assert (frame.tier, frame.reason, frame.failure) == ("Smooth", "as requested", "")
    assert frame.map is not None
    assert frame.map.dtype == np.float32
    (contact,) = frame.contacts
    assert np.hypot(contact.x_m - PRESS.x_m, contact.y_m - PRESS.y_m) < 5e-3
    assert contact.magnitude > 0
    assert np.isnan(contact.pressure_kpa), "of a magnitude whose uncertainty is not known"


def test_with_an_uncertainty_magnitudes_become_pressures(tared: Tared, skin: Skin) -> None:
    blank = np.zeros((51, 51))
    blank[20:26, 30:36] = 1.0
    made = Estimate(map=0.15 * blank, structure=blank, magnitude_sigmas=0.01)
    frame = tared(method=Answering(made)).reconstruct(**skin.scan(PRESS))
    (contact,) = frame.contacts
    assert contact.magnitude == pytest.approx(0.15)
    assert 140 < contact.pressure_kpa < 200
    assert frame.pressure_kpa is not None
    assert frame.pressure_kpa.max() == pytest.approx(contact.pressure_kpa)


def test_it_goes_on_from_its_last_estimate_until_nothing_presses(tared: Tared, skin: Skin) -> None:
    method = Smooth()
    reconstructor = tared(method=method)
    for presses in ((PRESS,), (PRESS,), (), (PRESS,)):
        reconstructor.reconstruct(**skin.scan(*presses))
    assert [previous is not None for previous in method.previous] == [False, True, False]
    assert len(method.skins) == 1
    reconstructor.set_reference(skin.reference())
    reconstructor.reconstruct(**skin.scan(PRESS))
    assert len(method.skins) == 2
    assert method.previous[-1] is None


def test_one_that_cannot_be_prepared_is_named_in_every_frame(tared: Tared, skin: Skin) -> None:
    reconstructor = tared(method=Unprepared())
    frame = reconstructor.reconstruct(**skin.scan(PRESS))
    assert frame.tier == "tikhonov"
    assert "Unprepared failed to prepare: KeyError" in frame.failure


def test_a_fault_of_ours_is_no_failure_of_the_users(
    reconstructor: Reconstructor, skin: Skin, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("ours")

    monkeypatch.setattr("tactomo_models.methods.auto.Auto.solve", broken)
    with pytest.raises(RuntimeError, match="ours"):
        reconstructor.reconstruct(**skin.scan(PRESS))


@pytest.mark.slow
def test_a_reference_of_one_scan_is_as_good_as_its_noise(tared: Tared, skin: Skin) -> None:
    """It may be the mean of many: the first frame tells how noisy a scan is."""
    rest = skin.reference()
    assert rest.magnitude is not None
    assert rest.structure is not None
    reconstructor = tared(Reference.from_scans(rest.magnitude[None], rest.structure[None]))
    quiet = [reconstructor.reconstruct(**skin.scan()) for _ in range(3)]
    assert {(frame.tier, int(frame.flags)) for frame in quiet} == {("quiet", 0)}
    pressed = reconstructor.reconstruct(**skin.scan(PRESS))
    assert len(pressed.contacts) == 1
    assert not pressed.flags
