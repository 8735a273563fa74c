"""The forward model against a series: a disc, bare and with a concentric inclusion.

Current through the rim of a disc is a sum of harmonics, and so is the potential it makes there;
each harmonic of the one makes the same harmonic of the other, by a factor that is known in closed
form for a homogeneous disc and for one with a concentric inclusion, be its edge sharp or a power
of the radius. What remains of the complete
electrode model is an equation on the electrodes alone, solved here with Legendre polynomials:
no mesh, no triangles, nothing in common with the code under test.

Source: Cheng, Isaacson, Newell & Gisser, "Electrode models for electric current computed
tomography", IEEE Trans. Biomed. Eng. 36 (1989); the series is carried further than theirs.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import spherical_jn
from tactomo_lab.scenes.simulation import UnevenSkin, fine_mesh, with_contrast
from tactomo_models import Press, SensorDescription, load_description
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import solve_bare_sheet, volts_per_unit
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_protocol import Channel
from variants import variant

INCLUSION_M = 0.04
CORE_M = 0.015  # of an inclusion with a soft edge
SPACINGS_M = (0.01, 0.005, 0.0025)


@pytest.fixture(scope="module")
def tank() -> SensorDescription:
    """A tank that is pressable in the middle only: the Green's function is what takes time."""
    return variant(load_description("tank_disc"), sheet={"frame_width_m": 0.0499})


@cache
def series_voltages(
    tank: SensorDescription,
    ratio: float = 1.0,
    inclusion_m: float = 0.0,
    core_m: float | None = None,
    modes: int = 10_000,
    order: int = 8,
) -> FloatArray:
    """Voltages (M,) of a disc with a concentric inclusion of a conductivity ratio to the rest.

    The ratio holds up to core_m; from there to inclusion_m it goes to 1 as a power of the radius.
    Its edge is sharp where core_m is not given.

    Current density on electrode l is sum_p c_lp P_p(s), s from -1 to 1 along it. Where it flows,
    potential and contact impedance give U_l = u + zeta j; tested with the same polynomials, and
    with c_l0 known from the current, this is a linear system for the other c_lp and then for U_l.
    """
    radius, electrodes = tank.width_m / 2, tank.electrode_count
    half = tank.electrodes.length_m / 2 / radius  # angle
    zeta = tank.electrodes.contact_impedance_ohm_m * tank.sheet_conductance_s
    angle = np.arctan2(*tank.electrode_centres_m.T[::-1])
    n, p = np.arange(1.0, modes + 1), np.arange(order)
    seen = ratio if core_m is None else graded_conductivity(ratio, core_m / inclusion_m, n)
    mirror = (seen - 1) / (seen + 1) * (inclusion_m / radius) ** (2.0 * n)
    gain = (1 - mirror) / (1 + mirror) / n  # of harmonic n, from current to potential
    # Fourier coefficients of a Legendre polynomial are spherical Bessel functions.
    legendre = (half / np.pi) * (-1j) ** p * spherical_jn(p, n[:, None] * half)
    harmonics = np.exp(-1j * np.outer(n, angle))[:, :, None] * legendre[:, None, :]
    F = harmonics.reshape(modes, electrodes * order)
    system = 4 * np.pi * radius**2 * np.real(F.conj().T @ (gain[:, None] * F))
    system += np.diag(np.tile(zeta * radius * half * 2 / (2 * p + 1), electrodes))
    even = np.tile(p == 0, electrodes)
    width = 2 * half * radius
    known = np.eye(electrodes) / width
    others = -np.linalg.solve(system[np.ix_(~even, ~even)], system[np.ix_(~even, even)] @ known)
    transfer = (system[np.ix_(even, even)] @ known + system[np.ix_(even, ~even)] @ others) / width
    drive, measure = tank.pairs.drive.T, tank.pairs.measure.T
    return np.asarray(
        transfer[measure[0], drive[0]]
        - transfer[measure[0], drive[1]]
        - transfer[measure[1], drive[0]]
        + transfer[measure[1], drive[1]]
    )


def graded_conductivity(ratio: float, core: float, n: FloatArray) -> FloatArray:
    """Conductivity of the homogeneous inclusion that harmonics n cannot tell from a graded one.

    Where conductivity is r^k from r = core to 1, harmonic n is a sum of r^s with s (s + k) = n^2;
    inside the core it is r^n, and at the core's edge it and its slope are continuous.
    """
    k = np.log(ratio) / np.log(core)
    root = np.sqrt(k**2 / 4 + n**2)
    rising, falling = root - k / 2, -root - k / 2
    share = (n - falling) / (2 * root)  # of the rising power at the core's edge
    fallen = (1 - share) * core ** (2 * root)
    return np.asarray((rising * share + falling * fallen) / (n * (share + fallen)))


def model(tank: SensorDescription, spacing_m: float) -> ForwardModel:
    return ForwardModel(tank, solve_bare_sheet(tank, mesh_sheet(tank, spacing_m)))


@pytest.fixture(scope="module")
def models(tank: SensorDescription) -> list[ForwardModel]:
    return [model(tank, spacing_m) for spacing_m in SPACINGS_M]


def relative_error(voltages: FloatArray, truth: FloatArray) -> float:
    return float(np.linalg.norm(voltages - truth) / np.linalg.norm(truth))


def test_the_series_itself_has_converged(tank: SensorDescription) -> None:
    rough = series_voltages(tank, 100.0, INCLUSION_M, modes=5000, order=6)
    np.testing.assert_allclose(rough, series_voltages(tank, 100.0, INCLUSION_M), rtol=5e-5)


def test_the_bare_disc_converges_to_the_series(
    tank: SensorDescription, models: list[ForwardModel]
) -> None:
    """Measured: 0.45 %, 0.11 % and 0.053 %; the polygonal rim and the electrodes' ends cost it."""
    truth = series_voltages(tank)
    errors = [relative_error(each.bare_voltages, truth) for each in models]
    assert errors[-1] < 7e-4
    assert np.log2(errors[0] / errors[-1]) / 2 > 1.2


@pytest.mark.parametrize("ratio", [100.0, 2.0, 0.01])
def test_an_inclusion_matches_the_series(
    tank: SensorDescription, models: list[ForwardModel], ratio: float
) -> None:
    """Nodes carry the conductivity, so a sharp edge is smeared over one row of triangles.

    The voltages are those of a sharp circle within that row. But for this one number, its
    radius, 208 voltages agree as closely as those of the bare disc do.
    """
    bare = series_voltages(tank)
    forward, spacing_m = models[-1], SPACINGS_M[-1]
    inside = np.hypot(*forward.bare.points[:, forward.bare.pressable]) < INCLUSION_M + 1e-6
    voltages = forward.solve(np.where(inside, ratio - 1, 0.0)).voltages

    def error(inclusion_m: float) -> float:
        sharp = series_voltages(tank, ratio, inclusion_m, modes=3000, order=5)
        return float(np.linalg.norm(voltages / bare - sharp / bare))

    row = (INCLUSION_M, INCLUSION_M + spacing_m)
    found = minimize_scalar(error, bounds=row, method="bounded", options={"xatol": 1e-5})
    assert found.fun / np.linalg.norm(voltages / bare - 1) < 2e-3


@pytest.mark.parametrize(
    ("contrast", "limit"),
    [
        pytest.param(2.0, 0.002, marks=pytest.mark.slow),
        pytest.param(30.0, 0.006, marks=pytest.mark.slow),
        (100.0, 0.01),
    ],
)
def test_scenes_to_evaluate_on_are_simulated_right(
    tank: SensorDescription, contrast: float, limit: float
) -> None:
    """No free radius here: voltage changes of a sharp circle, as large as it was asked for."""
    assert tank.structure
    conductive = variant(tank, structure={"conductivity_ratio": 100.0})
    sensor = with_contrast(conductive, contrast)
    seed = np.random.SeedSequence(0)
    skin = UnevenSkin(sensor, fine_mesh(sensor), seed, unevenness=0.0, impedance_deviation=0.0)
    press = Press(0.0, 0.0, pressure_kpa=1.0, radius_m=INCLUSION_M)
    change = skin.voltages([press])[Channel.STRUCTURE] - skin.voltages([])[Channel.STRUCTURE]
    series = series_voltages(tank, contrast, INCLUSION_M) - series_voltages(tank)
    assert relative_error(change / volts_per_unit(sensor), series) < limit


@pytest.mark.parametrize("ratio", [100.0, 1.25, 0.01])
def test_a_soft_inclusion_converges_to_the_series(
    tank: SensorDescription, models: list[ForwardModel], ratio: float
) -> None:
    """Halved spacings, conductivity linear in each triangle: what it changes is of second order."""
    bare = series_voltages(tank)
    truth = series_voltages(tank, ratio, INCLUSION_M, CORE_M) / bare - 1
    errors = []
    for forward in models:
        radius = np.hypot(*forward.bare.points[:, forward.bare.pressable])
        depth = np.log(INCLUSION_M / radius.clip(CORE_M, INCLUSION_M))
        power = np.log(ratio) / np.log(INCLUSION_M / CORE_M)
        change = forward.solve(np.expm1(power * depth)).voltages / forward.bare_voltages - 1
        errors.append(relative_error(change, truth))
    assert errors[-1] < 8e-3
    assert np.log2(errors[-2] / errors[-1]) == pytest.approx(2, abs=0.2)
