"""What a fitted field says: images, areas, magnitudes, peaks and forces, and how surely."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pressed import Sensor, contact, contacts, data_of, described
from tactomo_models import Channel, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.areas import AreaFinder
from tactomo_models.scene.field_account import (
    OUTLINE_ERROR,
    PLACE_ERROR,
    Alternative,
    FieldAccount,
    FieldAccountant,
)
from tactomo_models.scene.field_fit import FittedField, Measured
from tactomo_models.scene.level_set import LevelSet
from tactomo_models.scene.parameters import (
    COLUMNS,
    EDGE,
    EDGE_LIMITS,
    HERTZ,
    PEAK,
    PRIOR_SIGMA,
    SIZE,
)
from tactomo_models.scene.pressure import ONE_SIDED_95

RADIUS_M = 0.012
AREA_M2 = np.pi * RADIUS_M**2
PEAK_SHARE = 0.8
PEAK_KPA = PEAK_SHARE * 200
COLUMN = {"size": SIZE, "peak": PEAK, "edge": EDGE}
KINDS = {
    "flat": contact(0.003, -0.002, RADIUS_M, peak=PEAK_SHARE),
    "soft": contact(0.003, -0.002, RADIUS_M, peak=PEAK_SHARE, edge=0.5),
    "ring": contact(0.003, -0.002, RADIUS_M, peak=PEAK_SHARE, hole=1.0),
}
GRADED = ["both falling", "both graded", "one graded"]


@pytest.fixture(scope="module", params=GRADED)
def sensor(
    request: pytest.FixtureRequest, forward: ForwardModel, small: SensorDescription
) -> Sensor:
    return Sensor.of(forward, described(small, request.param))


def accountant(sensor: Sensor) -> FieldAccountant:
    return FieldAccountant(sensor.fit, AreaFinder(sensor.fit.forward))


def explained(sensor: Sensor, *each: FloatArray) -> tuple[FittedField, Measured]:
    """A field and the data that it explains without a rest."""
    field = sensor.at(contacts(*each), sensor.no_data())
    data = data_of(sensor.changes(field), 0.003)
    return sensor.fit.compare(field, data), data


def account_of(sensor: Sensor, *each: FloatArray) -> FieldAccount:
    return accountant(sensor).account(*explained(sensor, *each))


def magnitude_at(sensor: Sensor, pressure_kpa: FloatArray) -> FloatArray:
    response = sensor.fit.responses[Channel.MAGNITUDE]
    ones = np.ones(len(pressure_kpa))
    return np.abs(response.conductivity(ones, pressure_kpa, 1.0)[0] - 1)


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_are_those_of_the_contact(sensor: Sensor, kind: str) -> None:
    """Area, centre, peak, force and mean magnitude, by integrals over the unit disc."""
    account = account_of(sensor, KINDS[kind])
    rho = np.sqrt(np.linspace(0, 1, 20001))  # of even shares of the disc's area
    pressed = rho > 0.5 if kind == "ring" else rho >= 0
    gamma = HERTZ if kind == "soft" else 0.0
    pressure = PEAK_KPA * (1 - rho[pressed] ** 2) ** gamma
    area = AREA_M2 * pressed.mean()
    assert account.areas.areas_m2 == pytest.approx([area], rel=0.03)
    assert account.areas.centres_m[0] == pytest.approx([0.003, -0.002], abs=2e-4)
    assert account.contacts is not None
    assert account.contacts.peak_kpa == pytest.approx([PEAK_KPA])
    assert account.contacts.edge == pytest.approx([gamma])
    assert account.contacts.force_n == pytest.approx([1e3 * area * pressure.mean()], rel=0.05)
    size = magnitude_at(sensor, pressure)
    # The mesh shows a falling pressure at nodes 3 mm apart, and a table bends between them.
    assert account.magnitudes == pytest.approx([size.mean()], rel=0.1 if kind == "soft" else 1e-6)
    assert account.contacts.peak_magnitude == pytest.approx(
        magnitude_at(sensor, np.array([PEAK_KPA]))
    )


@pytest.mark.parametrize("kind", KINDS)
def test_images_show_what_presses(sensor: Sensor, kind: str) -> None:
    account = account_of(sensor, KINDS[kind])
    finder = AreaFinder(sensor.fit.forward)
    x, y = finder.map_places
    off = np.hypot(x - 0.003, y + 0.002)
    away = off > RADIUS_M + 0.003
    for image in (account.map, account.structure, account.pressure_kpa):
        assert not image[away].any()
        assert image.min() >= 0
    assert account.pressure_kpa.max() == pytest.approx(PEAK_KPA, rel=0.03)
    assert account.structure.max() <= 1 + 1e-12
    hole = off < 0.003
    assert (account.pressure_kpa[hole].max() == 0) == (kind == "ring")
    cell = (x[0, 1] - x[0, 0]) * (y[1, 0] - y[0, 0])
    assert account.contacts is not None
    force = 1e3 * account.pressure_kpa.sum() * cell
    assert force == pytest.approx(account.contacts.force_n[0], rel=0.05)


def images_of(account: FieldAccount) -> FloatArray:
    return np.stack([account.map, account.structure, account.pressure_kpa])


@pytest.mark.parametrize("sigma", [0.1, 0.2])
def test_where_outlines_are_open_the_mean_over_them_is_nearer_to_the_truth(
    sensor: Sensor, sigma: float
) -> None:
    """Than the image of the likeliest one, which quiet data of that very field show."""
    rng, accounts = np.random.default_rng(3), accountant(sensor)

    def likeliest(field: FittedField) -> FloatArray:
        return images_of(accounts.account(field, data_of(sensor.changes(field), 1e-5)))

    errors = []
    for _ in range(30):
        x_m, y_m = rng.uniform(-0.01, 0.01, 2)
        radius_m = 0.01 * np.exp(0.3 * rng.standard_normal())
        pressed = contacts(contact(x_m, y_m, radius_m, peak=rng.uniform(0.6, 1.0)))
        truth = sensor.at(pressed, sensor.no_data())
        data = data_of(sensor.changes(truth), sigma, rng)
        found = sensor.settled(sensor.fit.compare(truth, data), data)
        shown = images_of(accounts.account(found, data))
        off = np.stack([shown, likeliest(found)]) - likeliest(truth)
        errors.append((off**2).sum(axis=(2, 3)))
    of_mean, of_likeliest = np.mean(errors, axis=0)
    assert (of_mean < of_likeliest).all(), of_mean / of_likeliest


def test_without_a_magnitude_scan_areas_have_no_magnitude(
    forward: ForwardModel, small: SensorDescription
) -> None:
    sensor = Sensor.of(forward, described(small, "structure alone"))
    account = account_of(sensor, KINDS["flat"])
    assert account.areas.areas_m2 == pytest.approx([AREA_M2], rel=0.03)
    assert np.isfinite(account.areas.sigmas).all()
    assert np.isnan(account.magnitudes).all()
    assert np.isnan(account.magnitude_sigmas).all()
    assert account.contacts is None


def test_a_level_set_has_its_account(sensor: Sensor) -> None:
    centre = np.array([[0.003, -0.002]])
    level_set = LevelSet(sensor.fit.forward).owned_by(centre, sensor.field)
    off = np.hypot(sensor.field.x_m - 0.003, sensor.field.y_m + 0.002)
    parameters = np.append(level_set.parameters_of(np.clip(1 - off / 0.02, 0, 1)), PEAK_SHARE)
    field = sensor.fit.evaluate(level_set, parameters, sensor.fit.likely, sensor.no_data())
    assert field is not None
    data = data_of(sensor.changes(field), 0.003)
    account = accountant(sensor).account(sensor.fit.compare(field, data), data)
    assert account.contacts is not None
    assert account.contacts.peak_kpa == pytest.approx([PEAK_KPA])
    assert np.isnan(account.contacts.edge).all()
    assert account.magnitudes == pytest.approx(magnitude_at(sensor, np.array([PEAK_KPA])))
    assert account.areas.centres_m[0] == pytest.approx(centre[0], abs=2e-3)
    for sigma in (account.magnitude_sigmas, account.contacts.force_sigma_n, *account.areas.sigmas):
        assert (np.isfinite(sigma) & (sigma > 0)).all()


def total_of(account: FieldAccount) -> tuple[FloatArray, FloatArray]:
    assert account.contacts is not None
    said = account.contacts
    return np.array([said.total_force_n]), np.array([said.total_force_sigma_n])


NUMBERS: dict[str, Callable[[FieldAccount], tuple[FloatArray, FloatArray]]] = {
    "x": lambda a: (a.areas.centres_m[:, 0], a.areas.sigmas[:, 0]),
    "area": lambda a: (a.areas.areas_m2, a.areas.sigmas[:, 2]),
    "magnitude": lambda a: (a.magnitudes, a.magnitude_sigmas),
    "peak magnitude": lambda a: (a.contacts.peak_magnitude, a.contacts.peak_magnitude_sigma),  # type: ignore[union-attr]
    "force": lambda a: (a.contacts.force_n, a.contacts.force_sigma_n),  # type: ignore[union-attr]
    "total": total_of,
}


def force_by_area(sensor: Sensor) -> float:
    """Power of an area by which a force goes where magnitude times area stays."""
    peaks = PEAK_KPA * np.array([0.99, 1.01])
    steepness = np.diff(np.log(magnitude_at(sensor, peaks)))[0] / np.diff(np.log(peaks))[0]
    return float(1 - 1 / steepness)


def test_without_noise_a_force_is_as_sure_as_its_outline(sensor: Sensor) -> None:
    field, _ = explained(sensor, KINDS["flat"])
    account = accountant(sensor).account(field, data_of(sensor.changes(field), 1e-5))
    assert account.contacts is not None
    share = account.contacts.force_sigma_n / account.contacts.force_n
    outline = 2 * OUTLINE_ERROR * 0.003 / RADIUS_M
    assert share == pytest.approx([abs(force_by_area(sensor)) * outline], rel=0.05, abs=1e-4)


def test_the_force_of_two_that_nearly_touch_is_surer_than_theirs(sensor: Sensor) -> None:
    """Their errors go against each other, so the sum scatters as it says, and less than theirs."""
    two = [contact(side * 0.012, 0.0, 0.008, peak=PEAK_SHARE, edge=0.5) for side in (-1, 1)]
    truth, _ = explained(sensor, *two)
    sigma, rng = 0.003, np.random.default_rng(4)
    noisy = data_of(sensor.changes(truth), sigma, rng)
    known = accountant(sensor).account(sensor.fit.compare(truth, noisy), noisy).contacts
    assert known is not None
    assert known.total_force_n == pytest.approx(known.force_n.sum())
    apart = float(np.linalg.norm(known.force_sigma_n))
    assert known.total_force_sigma_n < apart
    totals, parts = [], []
    for _ in range(30):
        data = data_of(sensor.changes(truth), sigma, rng)
        found = sensor.settled(sensor.fit.compare(truth, data), data)
        contacts_found = accountant(sensor).account(found, data).contacts
        assert contacts_found is not None
        totals.append(contacts_found.total_force_n)
        parts.append(contacts_found.force_n)
    assert np.std(totals) < np.linalg.norm(np.std(parts, axis=0))
    assert np.std(totals) < known.total_force_sigma_n  # which knows that edges may differ, too


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["flat", "soft"])
def test_numbers_scatter_as_their_uncertainties_say(sensor: Sensor, kind: str) -> None:
    """Edges are as wide apart as is likely; a mesh knows a radius no better than it says.

    The graded sheet keeps magnitude times area, so a force goes with the onset's share of it.
    """
    by_area = {"area": 1.0, "magnitude": -1.0, "peak magnitude": -1.0}
    by_area |= dict.fromkeys(("force", "total"), force_by_area(sensor))
    by_area = {"area": 1.0} if kind == "soft" else by_area  # no step, but an outline
    outline = 2 * OUTLINE_ERROR * 0.003 / RADIUS_M
    sigma, rng = 0.02, np.random.default_rng(9)
    accounts, off = accountant(sensor), []
    for _ in range(100):
        true = contacts(KINDS[kind])
        if kind == "soft":
            edge = HERTZ + PRIOR_SIGMA[EDGE] * rng.standard_normal()
            true[0, EDGE] = np.clip(edge, *EDGE_LIMITS)
        truth = sensor.at(true, sensor.no_data())
        data = data_of(sensor.changes(truth), sigma, rng)
        exact = accounts.account(truth, sensor.no_data())
        found = sensor.settled(sensor.fit.compare(truth, data), data)
        account = accounts.account(found, data)
        assert len(account.areas) == 1
        of_mesh = outline * rng.standard_normal()
        errors = []
        for name, of in NUMBERS.items():
            (value, said), true_value = of(account), of(exact)[0]
            error = value - true_value
            error = error + (PLACE_ERROR * 0.003 * rng.standard_normal() if name == "x" else 0.0)
            errors.append((error / said + by_area.get(name, 0) * of_mesh * true_value / said)[0])
        off.append(errors)
    within = dict(zip(NUMBERS, np.mean(np.abs(off) < 1, axis=0), strict=True))
    # Where a peak's range cuts off what noise alone would have it, it is better known than it says.
    assert min(within.values()) > 0.5, within
    assert max(within.values()) < 0.92, within


def test_places_are_no_surer_than_those_of_electrodes(sensor: Sensor) -> None:
    """Without noise, too; areas do not know of it."""
    field, _ = explained(sensor, KINDS["flat"])
    account = accountant(sensor).account(field, data_of(sensor.changes(field), 1e-6))
    assert account.areas.sigmas[0, :2] == pytest.approx(PLACE_ERROR * 0.003, rel=0.05)
    assert account.areas.sigmas[0, 2] < 2.1 * OUTLINE_ERROR * 0.003 / RADIUS_M * AREA_M2


def other_of(contact_: FloatArray, **columns: float) -> FloatArray:
    """A contact with some parameters moved, by the names of their columns."""
    other = contact_.copy()
    for name, step in columns.items():
        other[COLUMN[name]] += step
    return other


def test_another_account_that_is_as_likely_is_half_of_what_is_shown(sensor: Sensor) -> None:
    """Even or falling: images are the mean, and uncertainties know of both."""
    field, data = explained(sensor, KINDS["flat"])
    different = other_of(KINDS["flat"], peak=0.1, edge=0.5, size=0.05)
    other, _ = explained(sensor, different)
    accounts = accountant(sensor)
    own, apart = accounts.account(field, data), accounts.account(other, data)
    alternative = Alternative(1.0, 1.0, different, np.zeros(COLUMNS))
    both = accounts.account(field, data, [[alternative]])
    for name in ("map", "structure", "pressure_kpa"):
        mean = (getattr(own, name) + getattr(apart, name)) / 2
        np.testing.assert_allclose(getattr(both, name), mean, atol=1e-6)
    for name, of in NUMBERS.items():
        (a, said), (b, _), (shown, sigma) = of(own), of(apart), of(both)
        if name == "x":
            continue  # a place has one uncertainty, that of what the contact is taken for
        # Numbers of one are summed over the map's samples, of the other over the mesh.
        assert shown == pytest.approx((a + b) / 2, rel=0.05)
        assert sigma == pytest.approx(np.hypot(said, abs(b - a) / 2), rel=0.3)


@pytest.mark.parametrize("odds", [0.25, 4.0])
def test_bounds_of_a_peak_are_those_of_all_that_it_may_be(sensor: Sensor, odds: float) -> None:
    """A normal distribution's bound is lower than both peaks, or does not know of the rarer."""
    field, data = explained(sensor, KINDS["flat"])
    different = other_of(KINDS["flat"], peak=0.2, edge=0.5)
    accounts = accountant(sensor)
    own = accounts.account(field, data).contacts
    apart = accounts.account(explained(sensor, different)[0], data).contacts
    alternative = Alternative(odds, odds, different, np.zeros(COLUMNS))
    both = accounts.account(field, data, [[alternative]]).contacts
    assert own is not None
    assert apart is not None
    assert both is not None
    rng = np.random.default_rng(0)
    is_other = rng.random(100_000) < odds / (1 + odds)
    sigma = own.peak_magnitude_sigma[0]
    peaks = np.where(is_other, apart.peak_magnitude[0], own.peak_magnitude[0])
    bounds = np.quantile(peaks + sigma * rng.standard_normal(len(peaks)), (0.05, 0.95))
    told = (
        both.peak_magnitude[0] + ONE_SIDED_95 * np.array([-1, 1]) * both.peak_magnitude_sides[:, 0]
    )
    assert told == pytest.approx(bounds, abs=0.2 * sigma)


def test_the_pressure_under_an_even_contact_is_even_where_a_ring_is_as_likely(
    sensor: Sensor,
) -> None:
    """No donut: the numbers know of the ring, the picture is of what the contact is taken for."""
    field, data = explained(sensor, KINDS["flat"])
    ring = Alternative(1.0, 1.0, other_of(KINDS["ring"], peak=0.2), np.zeros(COLUMNS))
    accounts = accountant(sensor)
    account = accounts.account(field, data, [[ring]])
    own = accounts.account(field, data)
    np.testing.assert_allclose(account.pressure_kpa, own.pressure_kpa, atol=1e-6)
    assert account.contacts is not None
    assert own.contacts is not None
    assert account.contacts.mean_sigma_kpa > own.contacts.mean_sigma_kpa
