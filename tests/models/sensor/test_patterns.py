"""Other patterns, other numbers of electrodes, and devices that tell sizes alone."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_models import (
    Artifact,
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
from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.health.diagnosis import diagnose
from tactomo_models.health.findings import Level
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.plausibility import Wiring
from tactomo_models.scans.polarity import Polarity
from tactomo_models.sensor.pattern import rim_signs, scan_pairs
from tactomo_protocol import Channel
from variants import variant

PRESS = Press(x_m=0.012, y_m=-0.009, pressure_kpa=100.0, radius_m=0.008)
UNSIGNED = {"voltages": "unsigned"}


def disc(electrodes: int, **pattern: Any) -> SensorDescription:
    """The round skin with so many electrodes, on a coarse map."""
    return variant(
        load_description("skin_round"),
        electrodes={"count": electrodes},
        pattern={"drive_offset": 1, **pattern},
        map={"nodes_x": 25, "nodes_y": 25},
        structure={"conductivity_ratio": 20.0},
    )


def skipping(electrodes: int) -> list[list[int]]:
    """Drives of every second electrode across two, and back: no offset says that."""
    return [[k, (k + 3) % electrodes] for k in range(0, electrodes, 2)] + [
        [(k + 3) % electrodes, k] for k in range(0, electrodes, 2)
    ]


SENSORS = {
    "8, adjacent": disc(8),
    "8, opposite": disc(8, drive_offset=4),
    "16, opposite": disc(16, drive_offset=8),
    "16, skip 3": disc(16, drive_offset=4, measure_offset=3),
    "16, listed": disc(16, drive=skipping(16)),
    "32, adjacent": disc(32),
    "32, opposite": disc(32, drive_offset=16),
}


@cache
def simulator(sensor: SensorDescription) -> SkinSimulator:
    return SkinSimulator(sensor, unevenness=0.03, impedance_spread=0.1, seed=4)


class Built(dict[str, Artifact]):
    """Artifacts by the hash that they belong to: the same with and without signs."""

    def of(self, sensor: SensorDescription) -> Artifact:
        if sensor.sha256 not in self:
            self[sensor.sha256] = build_artifact(sensor)
        return self[sensor.sha256]


BUILT = Built()


SLOW = ("16, skip 3", "32, opposite", "32, adjacent")  # as the others, and dear


def pressed(
    sensor: SensorDescription, *, unsigned: bool = False, press: Press = PRESS
) -> Reconstruction:
    """One press, as a device of either kind would have it reconstructed."""
    skin = Skin(simulator(sensor))
    read = np.abs if unsigned else np.asarray
    rest = np.array([read(skin.scan()["structure"]) for _ in range(20)])
    sensor = variant(sensor, instrument=UNSIGNED) if unsigned else sensor
    made = Reconstructor(sensor, BUILT.of(sensor), budget_s=1.0)
    made.set_reference(Reference.from_scans(None, rest))
    return made.reconstruct(None, read(skin.scan(press)["structure"]))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in SENSORS],
)
def test_a_press_is_found_by_any_pattern(name: str) -> None:
    frame = pressed(SENSORS[name])
    assert not frame.flags & ~Flag.MISFIT_HIGH
    [contact] = frame.contacts
    off_mm = 1e3 * np.hypot(contact.x_m - PRESS.x_m, contact.y_m - PRESS.y_m)
    assert off_mm < (4.0 if name.startswith("8") else 1.5)


@pytest.mark.parametrize(
    "name", ["16, opposite", "16, listed", pytest.param("32, adjacent", marks=pytest.mark.slow)]
)
def test_sizes_alone_show_the_same(name: str) -> None:
    """Same scenes, same noise: between neighbours no sign is lost with the sign."""
    signed, unsigned = pressed(SENSORS[name]), pressed(SENSORS[name], unsigned=True)
    assert [c.x_m for c in unsigned.contacts] == pytest.approx([c.x_m for c in signed.contacts])
    assert unsigned.misfit == pytest.approx(signed.misfit)
    assert unsigned.flags == signed.flags


def signs_of(sensor: SensorDescription) -> tuple[Polarity, FloatArray, BoolArray]:
    model = ForwardModel(sensor, BUILT.of(sensor).bare)
    wiring = Wiring(sensor)
    return Polarity(sensor, wiring, model.bare_voltages), model.bare_voltages, wiring.ordered


def test_a_small_voltage_of_crossing_pairs_has_no_certain_sign() -> None:
    """Such a one is left out, and that is nobody's fault: no flag."""
    sensor = variant(disc(16, drive_offset=8, measure_offset=8), instrument=UNSIGNED)
    signs, predicted, ordered = signs_of(sensor)
    assert not ordered.any()
    uncertain = np.abs(predicted[~signs.certain])
    assert 0 < len(uncertain) < len(predicted) / 3
    assert uncertain.max() < np.abs(predicted[signs.certain]).min()
    frame = pressed(sensor, unsigned=True)
    assert not frame.flags & Flag.INVALID_VOLTAGE
    assert np.isfinite(frame.misfit)


@pytest.mark.parametrize(("kind", "sign"), [("positive", 1.0), ("negative", -1.0)])
def test_a_converter_of_one_sign_is_believed_in_its_half(kind: str, sign: float) -> None:
    """What it reads of the other half is noise, and nobody's fault."""
    sensor = variant(SENSORS["16, opposite"], instrument={"voltages": kind})
    signs, predicted, _ = signs_of(sensor)
    np.testing.assert_array_equal(signs.certain, np.sign(predicted) == sign)
    skin = Skin(simulator(SENSORS["16, opposite"]))
    rng = np.random.default_rng(3)

    def read(volts: FloatArray) -> FloatArray:
        noise = 1e-3 * np.abs(volts).max() * rng.standard_normal(len(volts))
        return np.where(np.sign(predicted) == sign, np.abs(volts), np.abs(noise))

    rest = np.array([read(skin.scan()["structure"]) for _ in range(20)])
    made = Reconstructor(sensor, BUILT.of(sensor), budget_s=1.0)
    made.set_reference(Reference.from_scans(None, rest))
    frame = made.reconstruct(None, read(skin.scan(PRESS)["structure"]))
    [contact] = frame.contacts
    assert np.hypot(contact.x_m - PRESS.x_m, contact.y_m - PRESS.y_m) < 1.5e-3
    assert not frame.flags & ~Flag.MISFIT_HIGH


@pytest.mark.parametrize("kind", ["signed", "unsigned", "positive"])
def test_a_healthy_device_of_any_kind_is_called_so(kind: str) -> None:
    sensor = SENSORS["16, opposite"]
    _, predicted, _ = signs_of(sensor)
    skin = Skin(simulator(sensor))
    scans = np.array([skin.scan()["structure"] for _ in range(30)])
    if kind != "signed":
        scans = np.abs(scans)
    if kind == "positive":
        noise = 1e-3 * scans.max() * np.random.default_rng(0).standard_normal(scans.shape)
        scans = np.where(predicted > 0, scans, np.abs(noise))
    sensor = variant(sensor, instrument={"voltages": kind})
    found = diagnose(sensor, scans, even=BUILT.of(sensor).bare, contrast=20.0)
    assert found.level is Level.OK
    assert set(found.electrodes) == {"good"}


def test_a_device_that_tells_signs_is_believed() -> None:
    signs, predicted, _ = signs_of(disc(16, drive_offset=8, measure_offset=8))
    assert signs.certain.all()
    np.testing.assert_array_equal(signs.apply(-predicted), -predicted)


@pytest.mark.parametrize("name", ["16, opposite", "16, listed"])
def test_no_press_turns_a_voltage_whose_pairs_do_not_cross(name: str) -> None:
    """What the signs rest on; it is a theorem, held here against the forward model."""
    sensor = SENSORS[name]
    _, predicted, ordered = signs_of(sensor)
    assert ordered.all()
    skin = SkinSimulator(sensor, unevenness=0.05, impedance_spread=0.2, seed=1)
    rng = np.random.default_rng(2)
    for _ in range(10):
        x_m, y_m = rng.uniform(-0.02, 0.02, 2)
        press = Press(x_m=x_m, y_m=y_m, pressure_kpa=100.0, radius_m=rng.uniform(0.004, 0.015))
        volts = skin.voltages([press])[Channel.STRUCTURE]
        np.testing.assert_array_equal(np.sign(volts), np.sign(predicted))


def test_voltages_between_pads_alone_have_no_signs() -> None:
    with np.errstate(all="raise"):
        assert not rim_signs(scan_pairs(8), np.full(8, -1)).any()
