"""Training the tanks' network: what is turned stays one scene, and what is written runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
import torch
from tactomo_lab.tanks.images import INPUTS, PIXELS, pixel_grid
from tactomo_lab.tanks.model import TankModel
from tactomo_lab.training.tank_network import TankScenes, _turned_grid, train, views
from tactomo_lab.training.tank_scenes import simulate_shard
from tactomo_models import load_description
from tactomo_models.archive import write_arrays


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("scenes")
    write_arrays(found / "tanks-0000000.npz", simulate_shard(0, 3))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("mirrored", [0, 1])
def test_a_turned_scene_has_the_turned_voltages(mirrored: int) -> None:
    """A disc's voltages, dealt out anew, are those of the disc in its new place."""
    model = TankModel(load_description("tank_uef2017"), rings=30)
    view = next(view for view in views() if view.tank == "tank_uef2017")
    x, y, _ = pixel_grid(PIXELS)
    drawn = (np.hypot(x - 0.2, y - 0.5) < 0.25).astype(np.float32)
    kinds = torch.tensor(np.stack([1 - drawn, 0 * drawn, drawn]))[None]
    grid = _turned_grid(np.array([3 * 2 * np.pi / 16]), np.array([mirrored]))
    moved = torch.nn.functional.grid_sample(kinds, grid, align_corners=False)[0, 2].numpy()
    at = np.average(x, weights=moved), np.average(y, weights=moved)

    def change(centre: tuple[float, float]) -> np.ndarray:
        away = np.hypot(*(model.points[model.triangles].mean(axis=1) - centre).T)
        return model.solve(np.exp(np.clip((0.25 - away) / 0.05, -0.5, 0.5) + 0.5))[0] - model.empty

    dealt = view.by_pair @ change((0.2, 0.5))[view.turned[3, mirrored]]
    solved = view.by_pair @ change(at)
    assert np.linalg.norm(dealt - solved) < 0.03 * np.linalg.norm(solved)


@pytest.mark.slow
def test_batches_are_of_every_view(folder: Path) -> None:
    scenes = TankScenes(folder, seed=0)
    for _ in range(4):
        inputs, truth = scenes.draw(5)
        assert inputs.shape == (5, INPUTS, PIXELS, PIXELS)
        assert torch.isfinite(inputs).all()
        inside = inputs[:, -2] > 0
        # Corners of the picture turn into the outermost pixels.
        assert (truth.sum(dim=1)[inside] - 1).abs().mean() < 0.01
    kept = scenes.draw(5)[0], TankScenes(folder, seed=0).draw(5)[0]
    assert not torch.equal(*kept)  # noise and turns are drawn anew


@pytest.mark.slow
def test_what_is_trained_runs(folder: Path, tmp_path: Path) -> None:
    losses = list(train(folder, 3, tmp_path / "tank.onnx"))
    assert losses[-1] < losses[0]
    network = ort.InferenceSession(tmp_path / "tank.onnx", providers=["CPUExecutionProvider"])
    inputs = np.zeros((2, INPUTS, PIXELS, PIXELS), np.float32)
    with pytest.raises(Exception, match="Got: 2"):
        network.run(None, {"inputs": inputs})  # one tank at a time
    assert network.run(None, {"inputs": inputs[:1]})[0].shape == (1, 3, PIXELS, PIXELS)
    assert (tmp_path / "tank.onnx").stat().st_size < 2e6
