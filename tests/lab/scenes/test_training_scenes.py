"""Training scenes: what is drawn, and how well the simulation agrees with the finer one."""

from __future__ import annotations

import numpy as np
import pytest
from tactomo_lab.scenes.case import draw_still
from tactomo_lab.scenes.presets import TrainingScene, draw_scene
from tactomo_lab.scenes.simulation import UnevenSheet, UnevenSkin, displaced, fine_mesh
from tactomo_lab.training.training_scenes import SceneSimulator
from tactomo_models import Press, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import scan_voltages, transfer_resistances, volts_per_unit
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet
from variants import variant

TWO = (Press(-0.03, 0.02, 180.0, 0.018, 0.011, 0.6), Press(0.04, -0.03, 150.0, 0.010))
ERROR = {"magnitude": 0.015, "structure": 0.03}  # of the changes


@pytest.fixture(scope="module")
def robust_scenes(paper: SensorDescription) -> list[TrainingScene]:
    return [draw_scene(paper, 0, number) for number in range(200)]


def on_even_sheets(
    description: SensorDescription, presses: tuple[Press, ...], contrast: float, opposite: bool
) -> TrainingScene:
    electrodes = description.electrode_count
    even = UnevenSheet(0, 0.0, np.ones(electrodes))
    return TrainingScene(presses, contrast, opposite, (even, even), np.zeros((2, electrodes)))


def test_robust_scenes_have_everything_that_makes_a_skin_hard(
    robust_scenes: list[TrainingScene],
) -> None:
    presses = [press for scene in robust_scenes for press in scene.presses]
    assert {len(scene.presses) for scene in robust_scenes} == set(range(11))
    assert {press.shape for press in presses} == {"ellipse", "rectangle", "ring"}
    assert {press.profile for press in presses} == {"flat", "dome"}
    assert {scene.opposite for scene in robust_scenes} == {True, False}
    sheets = [sheet for scene in robust_scenes for sheet in scene.sheets]
    assert max(sheet.unevenness for sheet in sheets) > 0.07
    assert max(sheet.impedance.max() for sheet in sheets) > 5
    displaced_m = np.concatenate([scene.displaced_m for scene in robust_scenes])
    assert 0.0005 < displaced_m.std() < 0.001


def test_no_training_scene_is_one_of_the_evaluations(
    paper: SensorDescription, robust_scenes: list[TrainingScene]
) -> None:
    trained = {press.x_m for scene in robust_scenes for press in scene.presses}
    reported = {
        press.x_m
        for seeds in ("tuning", "reporting")
        for contacts in (1, 2, 3, 4)
        for number in range(20)
        for press in draw_still(paper, seeds, contacts, number).frames[0]
    }
    assert trained.isdisjoint(reported)


def test_another_sensor_gets_scenes_of_its_own_size(
    small: SensorDescription, robust_scenes: list[TrainingScene]
) -> None:
    scenes = [draw_scene(small, 0, number) for number in range(120)]
    half_axes = [press.radius_m for scene in scenes for press in scene.presses]
    assert max(half_axes) < 0.05 / 0.15 * 0.023
    assert {len(scene.presses) for scene in scenes} >= {1, 2, 3, 4}
    flat = [p.pressure_kpa for scene in scenes for p in scene.presses if p.profile == "flat"]
    assert 190 < max(flat) <= 200  # where its table ends


def test_one_sheet_has_scenes_of_its_own(small: SensorDescription) -> None:
    alone = variant(small, structure=None)
    made = SceneSimulator(alone).simulate(draw_scene(alone, 0, 1))
    assert {name for name in made if name.endswith("_change")} == {"magnitude_change"}
    assert made["map"].any()


def test_voltages_agree_with_the_evaluations_finer_simulation(paper: SensorDescription) -> None:
    """Which follows the outlines down to 0.2 mm."""
    skin = UnevenSkin(
        paper, fine_mesh(paper), np.random.SeedSequence(1), unevenness=0.0, impedance_deviation=0.0
    )
    rest, pressed = skin.voltages([]), skin.voltages(TWO)
    made = SceneSimulator(paper).simulate(on_even_sheets(paper, TWO, 100.0, False))
    for name in paper.channels:
        fine = (pressed[name] - rest[name]) / np.abs(rest[name])
        error = np.linalg.norm(made[f"{name}_change"] - fine) / np.linalg.norm(fine)
        assert error < ERROR[name], name
        np.testing.assert_allclose(made[f"{name}_rest"], rest[name], rtol=5e-3)


def test_a_scenes_truth_and_facts(small: SensorDescription) -> None:
    presses = (Press(0.01, 0.0, 150.0, 0.008),)
    made = SceneSimulator(small).simulate(on_even_sheets(small, presses, 30.0, True))
    assert made["contacts"] == 1
    assert made["opposite"]
    assert made["map"].max() == pytest.approx(0.125, rel=1e-3)  # half way from 100 to 200 kPa
    assert made["pressed"].max() == 1
    assert made["map"].shape == made["pressed"].shape == (21, 21)
    bare = SceneSimulator(small).simulate(on_even_sheets(small, (), 30.0, True))
    for name in ("magnitude", "structure"):
        assert not bare[f"{name}_change"].any()
        np.testing.assert_array_equal(bare[f"{name}_rest"], made[f"{name}_rest"])
    # Of one sign: a conductivity that falls where the other rises.
    assert (made["magnitude_change"] @ made["structure_change"]) < 0


def test_sheets_of_a_scene_are_its_own_whatever_was_simulated_before(
    small: SensorDescription,
) -> None:
    """A simulator keeps the last sheets, as scenes in a row share them."""
    scenes = [draw_scene(small, 0, number) for number in (0, 1, 8)]
    scenes.append(on_even_sheets(small, scenes[0].presses, 30.0, False))
    one = SceneSimulator(small)
    for scene in (*scenes, *reversed(scenes)):
        again, anew = one.simulate(scene), SceneSimulator(small).simulate(scene)
        for key, value in anew.items():
            np.testing.assert_array_equal(again[key], value)


@pytest.mark.parametrize("shift_m", [0.0015, -0.001])
def test_displaced_electrodes_act_as_electrodes_meshed_there(
    paper: SensorDescription, shift_m: float
) -> None:
    """A wider pitch: the outer ones of each side move along it, by three times as much."""
    spacing_m, refinements = 0.0025, 3
    here = mesh_sheet(paper, spacing_m, refinements)
    pitch_m = paper.electrodes.pitches_m[0] + 2 / 3 * shift_m
    moved = variant(paper, electrodes={"pitch_m": pitch_m})
    along = np.tile([-1.0, -1 / 3, 1 / 3, 1.0], 4) * shift_m

    def volts(description: SensorDescription, mesh: SheetMesh) -> FloatArray:
        transfer = transfer_resistances(description, mesh, np.ones(mesh.mesh.t.shape[1]))
        return scan_voltages(description, transfer) * volts_per_unit(description)

    rest, meshed = volts(paper, here), volts(moved, mesh_sheet(moved, spacing_m, refinements))
    pulled = volts(paper, displaced(here, paper, along))
    effect = (meshed - rest) / np.abs(rest)
    error = (pulled - meshed) / np.abs(rest)
    assert np.linalg.norm(effect) > 0.01 * np.sqrt(len(effect))
    assert np.linalg.norm(error) < 0.1 * np.linalg.norm(effect)
