"""Training end to end, on a tiny set of scenes: checkpoints, export, and what ONNX Runtime runs."""

from __future__ import annotations

import copy
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from fixture_types import Run
from small_sensor import SMALL
from tactomo_lab.commands.training import ConfigurationName
from tactomo_lab.training.batches import Batch, SceneBatches
from tactomo_lab.training.configurations import WIDTHS, Prepared, export_trained, prepare
from tactomo_lab.training.train import (
    Settings,
    Training,
    begin,
    load_checkpoint,
    save_checkpoint,
    train,
)
from tactomo_lab.training.training_scenes import FORMAT, simulate
from tactomo_models import ModelError, SensorDescription, load_description
from tactomo_models.methods.trained_networks import (
    FusionNetwork,
    Network,
    SensorNetworks,
    load_network,
)
from tactomo_models.sensor.symmetry import symmetries
from variants import variant

pytestmark = pytest.mark.train
SCENES = 50
TINY = Settings(epochs=2, batch=16, seed=3)


@pytest.fixture(scope="session")
def square_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small sheet with all eight symmetries."""
    file = tmp_path_factory.mktemp("sensor") / "square.toml"
    file.write_text(SMALL.replace("width_m = 0.06", "width_m = 0.05"))
    return file


@pytest.fixture(scope="session")
def square(square_file: Path) -> SensorDescription:
    return load_description(square_file)


def simulated(scenes: int, description: SensorDescription, factory: Any) -> Path:
    folder: Path = factory.mktemp("scenes")
    assert sum(simulate(description, folder, scenes, jobs=1)) == scenes
    return folder


@pytest.fixture(scope="session")
def robust(square: SensorDescription, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(SCENES, square, tmp_path_factory)


@pytest.fixture(scope="session")
def ours(robust: Path, square: SensorDescription) -> Prepared:
    """Our network, far narrower than it ships, before its first step."""
    return prepare(6, robust, square)


def begun(prepared: Prepared, settings: Settings = TINY) -> Training:
    """A training with a network of its own."""
    return begin(copy.deepcopy(prepared.network), settings)


def assert_same_weights(one: torch.nn.Module, other: torch.nn.Module) -> None:
    for (name, first), second in zip(
        one.state_dict().items(), other.state_dict().values(), strict=True
    ):
        assert torch.equal(first, second), name


def test_a_training_that_was_broken_off_ends_with_the_same_network(
    ours: Prepared, tmp_path: Path
) -> None:
    whole = begun(ours)
    assert len(list(train(whole, ours.objective, TINY))) == 2
    path = tmp_path / "ours.pt"
    next(train(begun(ours), ours.objective, TINY, path))  # broken off after one epoch
    resumed = begun(ours)
    load_checkpoint(resumed, TINY, path)
    assert len(resumed.history) == 1
    assert len(list(train(resumed, ours.objective, TINY, path))) == 1
    assert str(resumed.history) == str(whole.history)  # means of no scenes are NaN
    assert_same_weights(resumed.network, whole.network)
    assert_same_weights(resumed.averaged, whole.averaged)


def test_a_network_of_one_sheet_sees_that_sheet(
    square: SensorDescription, tmp_path_factory: pytest.TempPathFactory
) -> None:
    alone = variant(square, structure=None)
    folder = simulated(20, alone, tmp_path_factory)
    prepared = prepare(6, folder, alone)
    training = begun(prepared)
    assert len(list(train(training, prepared.objective, replace(TINY, epochs=1)))) == 1
    export_trained(prepared, training, file := folder / "network.onnx")
    assert load_network(alone, "network", file).channels == ("magnitude",)


def test_training_learns(ours: Prepared) -> None:
    """On scenes that it sees again and again."""
    training = begun(ours)
    epochs = list(train(training, ours.objective, replace(TINY, epochs=12)))
    assert epochs[-1].loss < 0.9 * epochs[0].loss


class TestCheckpoint:
    @pytest.fixture
    def path(self, ours: Prepared, tmp_path: Path) -> Path:
        save_checkpoint(begun(ours), TINY, tmp_path / "ours.pt")
        return tmp_path / "ours.pt"

    def test_a_corrupt_one_is_said_to_be_one(self, ours: Prepared, path: Path) -> None:
        whole = path.read_bytes()
        for content in (b"", b"no checkpoint", whole[: len(whole) // 2]):
            path.write_bytes(content)
            with pytest.raises(ModelError, match=r"no checkpoint, or a damaged one: .*delete it"):
                load_checkpoint(begun(ours), TINY, path)

    def test_one_of_other_settings_is_refused(self, ours: Prepared, path: Path) -> None:
        with pytest.raises(ModelError, match="was begun with seed 3, not 4: name another file"):
            load_checkpoint(begun(ours), replace(TINY, seed=4), path)

    def test_one_of_another_network_is_refused(
        self, path: Path, robust: Path, square: SensorDescription
    ) -> None:
        wider = prepare(9, robust, square)
        with pytest.raises(ModelError, match="is of another network: name another file"):
            load_checkpoint(begun(wider), TINY, path)

    def test_one_that_cannot_be_written_is_told(self, ours: Prepared, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(ModelError, match=r"cannot write .*free some space or name another"):
            save_checkpoint(begun(ours), TINY, tmp_path / "file" / "ours.pt")


class TestExported:
    """ONNX Runtime gives what PyTorch gives; weights are stored in half precision."""

    def test_ours(self, ours: Prepared, square: SensorDescription, tmp_path: Path) -> None:
        training = begun(ours)
        list(train(training, ours.objective, TINY))
        export_trained(ours, training, tmp_path / "ours.onnx")
        network = Network(tmp_path / "ours.onnx", square, "network")
        rng = np.random.default_rng(0)
        inputs = int(ours.network.inputs)
        for _ in range(5):
            data = rng.standard_normal(inputs).astype(np.float32)
            with torch.inference_mode():
                expected = training.averaged(torch.as_tensor(data)[None])
            made = network.run({"data": data})
            for name, value in zip(("map", "structure", "confidence"), expected, strict=True):
                np.testing.assert_allclose(made[name], value[0].numpy(), atol=2e-3)

    def test_what_runs_filters_as_training_does(
        self, ours: Prepared, square: SensorDescription, robust: Path, tmp_path: Path
    ) -> None:
        export_trained(ours, begun(ours), tmp_path / "ours.onnx")
        running = FusionNetwork(Network(tmp_path / "ours.onnx", square, "network"))
        batches: SceneBatches = ours.objective.batches
        for basis, trained in zip(running.bases.values(), batches.bases, strict=True):
            np.testing.assert_allclose(basis, trained, rtol=1e-5, atol=1e-9)


def test_permuted_electrodes_are_a_turned_scene(ours: Prepared, square: SensorDescription) -> None:
    """Filtered data turn within the space of signals: a wrong permutation would leave it."""
    batches: SceneBatches = ours.objective.batches
    scenes = torch.arange(20)

    def drawn(turn: int) -> Batch:
        return batches.draw(scenes, torch.Generator().manual_seed(0), snr_db=90.0, turn=turn)

    upright, turns = drawn(0), symmetries(square)
    assert batches.turns == len(turns) == 8
    for number, symmetry in enumerate(turns):
        turned = drawn(number)
        nodes = torch.as_tensor(symmetry.nodes)
        assert torch.equal(turned.map.flatten(1), upright.map.flatten(1)[:, nodes])
        assert torch.equal(turned.pressed.flatten(1), upright.pressed.flatten(1)[:, nodes])
        sizes = turned.inputs.norm(dim=1) / upright.inputs.norm(dim=1)
        assert torch.allclose(sizes, torch.ones(20), atol=0.01), sizes


def test_more_noise_tells_less(ours: Prepared) -> None:
    """The filters shrink what they cannot know, and say so."""
    batches: SceneBatches = ours.objective.batches
    known = [
        batches.draw(torch.arange(20), torch.Generator().manual_seed(0), snr_db=snr_db).inputs
        for snr_db in (60.0, 30.0, 0.0)
    ]
    of_magnitude = [inputs[:, 20 : 20 + 8].mean(dim=0) for inputs in known]
    assert (of_magnitude[0] >= of_magnitude[1]).all()
    assert (of_magnitude[1] >= of_magnitude[2]).all()
    assert of_magnitude[2].mean() < 0.8 * of_magnitude[0].mean()


class TestCommand:
    def test_it_trains_exports_and_draws(
        self, tactomo: Run, robust: Path, square_file: Path, tmp_path: Path
    ) -> None:
        command = ("models", "train", robust, "--configuration", "ours-small", "-d", square_file)
        files = ("--output", "ours.onnx", "--checkpoint", "ours.pt")
        result = tactomo(*command, *files, "--epochs", 1, "--jobs", 1, status=0)
        assert re.search(r"epoch 1: loss \d+\.\d*[1-9]", result.stderr)
        Network(tmp_path / "ours.onnx", load_description(square_file), "network")
        again = tactomo(*command, *files, "--epochs", 1, status=0)
        assert "going on after epoch 1" in again.stderr
        other = tactomo(*command, *files, "--epochs", 2)
        assert "was begun with epochs 1, not 2" in other.stderr

    def test_a_trained_network_is_used_from_then_on(
        self,
        tactomo: Run,
        robust: Path,
        square_file: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        command = ("models", "train", robust, "--configuration", "ours-small", "--epochs", 1)
        tactomo(*command, "--checkpoint", "ours.pt", "--description", square_file, status=0)
        description = load_description(square_file)
        assert load_network(description, "network").path.is_relative_to(tmp_path)
        assert not SensorNetworks(description).missing

    def test_wrong_scenes_are_told(
        self, tactomo: Run, robust: Path, square_file: Path, tmp_path: Path
    ) -> None:
        result = tactomo("models", "train", tmp_path, "--description", square_file, status=1)
        assert "holds no simulated scenes; make some: tactomo models simulate" in result.stderr
        result = tactomo("models", "train", robust)
        assert f"holds scenes of format {FORMAT}, sensor" in result.stderr

    def test_a_gpu_that_is_not_there_is_told(self, tactomo: Run, robust: Path) -> None:
        if torch.cuda.is_available():
            pytest.skip("there is one")
        result = tactomo("models", "train", robust, "--device", "cuda", status=1)
        assert "PyTorch finds no GPU here; leave out --device, or use cpu" in result.stderr


def test_the_command_offers_every_recipe() -> None:
    assert get_args(ConfigurationName) == tuple(WIDTHS)
