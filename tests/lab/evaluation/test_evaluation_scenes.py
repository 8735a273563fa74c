"""Scenes to evaluate on: what is drawn, what is simulated, and what its truth is."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tactomo_lab.scenes.case import Case, SnrOf, draw_still, measure, simulate
from tactomo_lab.scenes.drawing import (
    BOTH_CHANNELS,
    GAP_M,
    PRESSURE_KPA,
    SHAPES,
    gap_m,
    outline_of,
    seed_of,
)
from tactomo_lab.scenes.simulation import UnevenSkin, fine_mesh, truth_of, with_contrast
from tactomo_models import DataError, Press, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet
from tactomo_protocol import Channel

presses = st.builds(
    Press,
    x_m=st.floats(-0.05, 0.05),
    y_m=st.floats(-0.05, 0.05),
    pressure_kpa=st.just(180.0),
    radius_m=st.floats(0.007, 0.02),
    radius_y_m=st.floats(0.007, 0.02),
    angle_rad=st.floats(0, np.pi),
    shape=st.sampled_from(SHAPES),
)


@pytest.fixture(scope="module")
def mesh(paper: SensorDescription) -> SheetMesh:
    return fine_mesh(paper)


@settings(max_examples=30)
@given(contacts=st.integers(1, 6), number=st.integers(0, 10**6))
def test_a_layout_keeps_its_promises(paper: SensorDescription, contacts: int, number: int) -> None:
    layout = draw_still(paper, "tuning", contacts, number)
    assert len(layout.frames[0]) == contacts
    assert 10 <= layout.contrast <= 100
    for press in layout.frames[0]:
        x, y = outline_of(press)
        assert paper.on_sheet(x, y, paper.sheet.frame_width_m).all()
        assert PRESSURE_KPA[0] <= press.pressure_kpa <= PRESSURE_KPA[1]
        assert press.shape == layout.shape or layout.shape == "mixed"
    assert all(gap_m(a, b) >= GAP_M for a, b in combinations(layout.frames[0], 2))


def test_no_scene_is_in_both_seed_sets(paper: SensorDescription) -> None:
    of = {
        seed_set: {draw_still(paper, seed_set, contacts, n).frames[0][0].x_m for n in range(50)}
        for contacts in (1, 2)
        for seed_set in ("tuning", "reporting")
    }
    assert of["tuning"].isdisjoint(of["reporting"])
    assert draw_still(paper, "tuning", 2, 3) == draw_still(paper, "tuning", 2, 3)


@given(press=presses)
def test_an_outline_is_where_coverage_ends(press: Press) -> None:
    """A hair inside its outline an indenter covers, a hair outside it does not."""
    outline = outline_of(press)
    centre = np.array([[press.x_m], [press.y_m]])
    for scale, covered in ((0.98, 1.0), (1.02, 0.0)):
        x, y = centre + scale * (outline - centre)
        np.testing.assert_array_equal(press.coverage(x, y, 1e-9), covered)


def test_the_gap_of_indenters() -> None:
    left = Press(-0.02, 0.0, 180.0, 0.01)
    assert gap_m(left, Press(0.02, 0.0, 180.0, 0.01)) == pytest.approx(0.02, rel=1e-3)
    assert gap_m(left, Press(-0.015, 0.0, 180.0, 0.01)) == 0
    around = Press(-0.02, 0.0, 180.0, 0.04, shape="ring")
    assert gap_m(left, around) == gap_m(around, left) == 0


@given(press=presses)
def test_the_truth_has_the_area_the_place_and_the_magnitude(
    paper: SensorDescription, press: Press
) -> None:
    truth = truth_of(paper, [press])
    (contact,) = truth.contacts
    a, b = press.radius_m, press.radius_y_m or 0
    area = {"ellipse": np.pi, "rectangle": 4.0, "ring": 0.75 * np.pi}[press.shape] * a * b
    assert contact.area_m2 == pytest.approx(area, rel=0.02)
    assert truth.pressed.sum() * 9e-6 == pytest.approx(area, rel=0.02)
    x, y = np.meshgrid(paper.map_x_m, paper.map_y_m)
    centre = [float((truth.pressed * axis).sum() / truth.pressed.sum()) for axis in (x, y)]
    np.testing.assert_allclose(centre, [press.x_m, press.y_m], atol=2e-4)
    assert contact.magnitude == pytest.approx(0.03 + 0.22 * 40 / 60)  # of the table, at 180 kPa
    np.testing.assert_allclose(truth.map, contact.magnitude * truth.pressed)


def test_a_light_press_is_pressed_in_part_and_has_no_magnitude(paper: SensorDescription) -> None:
    light, firm = (truth_of(paper, [Press(0, 0, kpa, 0.012)]) for kpa in (5.0, 150.0))
    np.testing.assert_allclose(light.pressed, firm.pressed * np.log(2) / np.log(100))
    assert not light.map.any()
    assert firm.map.max() == pytest.approx(0.03 + 0.22 / 6)


@pytest.mark.slow
def test_the_simulation_converges(paper: SensorDescription) -> None:
    """Voltage changes are right to about a percent: a mesh with other nodes says the same."""
    press = Press(0.021, -0.034, 180.0, 0.012, 0.009, 0.4)
    sensor = with_contrast(paper, 50.0)
    changes = []
    for spacing_m in (0.00174, 0.00131):
        seed = np.random.SeedSequence(5)
        skin = UnevenSkin(sensor, mesh_sheet(sensor, spacing_m), seed)
        rest, pressed = skin.voltages([]), skin.voltages([press])
        changes.append([pressed[name] - rest[name] for name in BOTH_CHANNELS])
    for coarse, fine, limit in zip(*changes, (0.003, 0.015), strict=True):
        assert 1e-6 < np.linalg.norm(coarse - fine) / np.linalg.norm(fine) < limit


def one(paper: SensorDescription, snr_db: float = 40, snr_of: SnrOf = "change") -> Case:
    plan = draw_still(paper, "tuning", 2, 0)
    simulated = simulate(paper, plan, seed_of("tuning", "sheet", 2, 0))
    noise = seed_of("tuning", "noise", 2, 0)
    noisy = replace(simulated, plan=replace(plan, snr_db=snr_db, snr_of=snr_of))
    return measure(noisy, "tuning", 0, noise)


def scan_of(case: Case) -> FloatArray:
    return case.frames[0].scans[Channel.STRUCTURE]


@pytest.mark.parametrize("snr_of", ["change", "voltage"])
def test_noise_is_what_the_ratio_says(paper: SensorDescription, snr_of: SnrOf) -> None:
    """Of one size in volts on every voltage, in scan and reference."""
    clean, noisy = one(paper, np.inf), one(paper, 20, snr_of)
    for name in BOTH_CHANNELS:
        rest, pressed = getattr(clean.tare, name), clean.frames[0].scans[name]
        signal = rest if snr_of == "voltage" else pressed - rest
        expected = 0.1 * np.sqrt(np.mean(signal**2))
        noise = noisy.frames[0].scans[name] - pressed
        assert np.std(noise) == pytest.approx(expected, rel=0.2)
        small = np.abs(rest) < np.median(np.abs(rest))
        assert np.std(noise[small]) == pytest.approx(np.std(noise[~small]), rel=0.3)
        averaged = getattr(noisy.tare, name) - rest
        assert np.std(averaged) == pytest.approx(expected / np.sqrt(20), rel=0.2)
        known = np.mean(getattr(noisy.tare, f"{name}_noise"))
        assert known == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_the_same_scene_comes_out_of_the_cache(
    paper: SensorDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    first = one(paper)
    (file,) = (tmp_path / "scenes").iterdir()
    written_ns = file.stat().st_mtime_ns
    again = one(paper)
    assert file.stat().st_mtime_ns == written_ns
    file.write_bytes(file.read_bytes()[:100])  # a disc that damages it costs time only
    mended = one(paper)
    for scene in (again, mended):
        np.testing.assert_array_equal(scan_of(scene), scan_of(first))


def test_more_contacts_than_there_is_room_for(small: SensorDescription) -> None:
    with pytest.raises(DataError, match="no room for 30"):
        draw_still(small, "tuning", 30, 0)
