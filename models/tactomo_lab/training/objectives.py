"""What networks are trained on: how wrong each one's answer is, and how it does on other scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.symmetry import symmetries
from torch import Tensor, nn

from tactomo_lab.baselines.paper_network import FILTER_SIGMA, preprocessed
from tactomo_lab.training.batches import Batch, SceneBatches
from tactomo_lab.training.networks import PaperNetwork
from tactomo_lab.training.preliminary import read_images
from tactomo_lab.training.training_scenes import read_scenes

MIN_CHANGE = 0.4  # squared sum of a map below which scenes count less: 25 nodes of half a range
SHAPE_SHARE = 0.5  # of the loss that the pressed shape has, to one of the map's
MIN_PRESSED = 20.0  # nodes pressed, likewise
TRUST_SHARE = 0.05
REPORT_DB = (40.0, 20.0, 10.0)
PAPER_TESTED = 1 / 6  # share of the paper's scenes, the last ones, that are kept for testing


class FusionObjective:
    """Our network's: maps and shapes from noisy, filtered voltages."""

    def __init__(self, batches: SceneBatches) -> None:
        self.batches = batches

    @property
    def scenes(self) -> int:
        """How many scenes there are to train on."""
        return len(self.batches.trained)

    def loss(
        self, network: nn.Module, chosen: Tensor, random: torch.Generator, device: str
    ) -> Tensor:
        """RIE squared of the map, cross entropy of the shape, and of the confidence."""
        turn = int(torch.randint(8, (1,), generator=random))
        batch = self.batches.draw(chosen, random, turn=turn % self.batches.turns)
        made = network.raw(batch.inputs.to(device))
        return image_loss(made, batch.map.to(device) / network.scale, batch.pressed.to(device))

    def examine(self, network: nn.Module, device: str) -> dict[str, float]:
        """Correlation with the truth, by noise and number of contacts."""
        found: dict[str, float] = {}
        for snr_db in REPORT_DB:
            random = torch.Generator().manual_seed(1)
            icc, contacts = [], []
            for chosen in torch.tensor(self.batches.held_out).split(256):
                batch = self.batches.draw(chosen, random, snr_db=snr_db)
                size, _, _ = network(batch.inputs.to(device))
                icc.append(correlations(size.cpu().float(), batch.map))
                contacts.append(torch.where(batch.map.amax((1, 2)) > 0, batch.contacts, 0))
            found |= by_contacts(f"{snr_db:g} dB", torch.cat(icc), torch.cat(contacts))
        return found


def image_loss(made: tuple[Tensor, Tensor, Tensor], true: Tensor, pressed: Tensor) -> Tensor:
    """RIE squared of the map, cross entropy of the shape, and of the confidence.

    Args:
        made: `FusionNetwork.raw` of n scenes.
        true: (n, rows, columns) maps over the network's scale.
        pressed: (n, rows, columns) shapes.
    """
    size, shape, trust = (part.float() for part in made)
    weight = 1 / ((true**2).sum((1, 2)) + MIN_CHANGE)
    of_map = (((size - true) ** 2).sum((1, 2)) * weight).mean()
    entropy = nn.functional.binary_cross_entropy_with_logits(shape, pressed, reduction="none")
    of_shape = (entropy.sum((1, 2)) / (pressed.sum((1, 2)) + MIN_PRESSED)).mean()
    right = correlations(size.detach(), true).clamp(0, 1)
    told = nn.functional.binary_cross_entropy_with_logits(trust, right, reduction="none")
    of_trust = (told * (true.amax((1, 2)) > 0)).mean()
    return torch.as_tensor(of_map + SHAPE_SHARE * of_shape + TRUST_SHARE * of_trust)


def correlations(images: Tensor, truths: Tensor) -> Tensor:
    """Pearson correlation (n,) of images (n, rows, columns) with the true ones."""
    a, b = (x.flatten(1) - x.flatten(1).mean(1, keepdim=True) for x in (images, truths))
    return torch.as_tensor((a * b).sum(1) / (a.norm(dim=1) * b.norm(dim=1) + 1e-9))


def by_contacts(what: str, icc: Tensor, contacts: Tensor, most: int = 4) -> dict[str, float]:
    """Mean of the correlations of scenes with one, two... contacts."""
    return {
        f"{what}, {count}": float(icc[contacts == count].mean()) for count in range(1, most + 1)
    }


class PaperObjective:
    """The paper's networks': magnitudes from two preliminary images, without noise."""

    def __init__(
        self, folder: Path, description: SensorDescription, *, multimodal: bool, scale: float
    ) -> None:
        scenes, images = read_scenes(folder), read_images(folder)
        if not multimodal:
            del images["structure"]
        whole = {name: image.astype(np.float32) for name, image in images.items()}
        self.scenes = round(len(scenes["map"]) * (1 - PAPER_TESTED))
        self.input_scale = float(whole["magnitude"][: self.scenes].max())
        ready = preprocessed(whole, self.input_scale)
        self._images = [torch.as_tensor(ready[name]) for name in whole]
        self._maps = torch.as_tensor(scenes["map"].astype(np.float32) / np.float32(scale))
        self._contacts = torch.as_tensor(scenes["contacts"].astype(np.int64))
        self._turns = torch.as_tensor(np.stack([turn.nodes for turn in symmetries(description)]))
        self.nodes = (int(self._maps.shape[1]), int(self._maps.shape[2]))

    def draw(self, chosen: Tensor, random: torch.Generator) -> tuple[list[Tensor], Tensor]:
        """Images and maps of some scenes, each turned by one of the sheet's symmetries.

        Not all by the same: the statistics of a batch would be those of its turn.
        """
        turns = self._turns[torch.randint(len(self._turns), (len(chosen),), generator=random)]
        *images, maps = (
            whole[chosen].flatten(1).gather(1, turns).view(-1, *self.nodes)
            for whole in (*self._images, self._maps)
        )
        return images, maps

    def loss(
        self, network: nn.Module, chosen: Tensor, random: torch.Generator, device: str
    ) -> Tensor:
        """Mean squared error."""
        images, maps = self.draw(chosen, random)
        made = network(*(image.to(device) for image in images))
        return nn.functional.mse_loss(made.float(), maps.to(device))

    def start_linear(self, network: PaperNetwork, scenes: int = 6000) -> None:
        """Begin a network by regression on its own features of some scenes."""
        random = torch.Generator().manual_seed(2)
        some = torch.randperm(self.scenes, generator=random)[:scenes]
        network.train()  # normalises as in training
        features, goals = [], []
        with torch.no_grad():
            for chosen in some.split(128):
                images, maps = self.draw(chosen, random)
                features.append(network.features(*images))
                goals.append(maps.flatten(1))
        network.start_linear(torch.cat(features), torch.cat(goals))

    def examine(self, network: nn.Module, device: str) -> dict[str, float]:
        """Correlation of the filtered images with the truth, by number of contacts."""
        self._measure_statistics(network, device)
        tested = torch.arange(self.scenes, len(self._maps))
        icc = []
        for chosen in tested.split(128):
            made = network(*(images[chosen].to(device) for images in self._images))
            sigma = (0, FILTER_SIGMA, FILTER_SIGMA)
            filtered = torch.as_tensor(gaussian_filter(made.cpu().float().numpy(), sigma))
            icc.append(correlations(filtered, self._maps[chosen]))
        return by_contacts("noise-free", torch.cat(icc), self._contacts[tested])

    def _measure_statistics(self, network: nn.Module, device: str, scenes: int = 2048) -> None:
        """Take the statistics that an averaged network normalises by anew, from its own weights.

        Averaged over those of its past weights, as its weights are, they fit none of them: its
        error is then two and a half times as large after one epoch, and more with two channels.
        """
        for module in network.modules():
            if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
                module.reset_running_stats()
                module.momentum = None  # the mean of all batches
        network.train()
        random = torch.Generator().manual_seed(3)
        for chosen in torch.randperm(self.scenes, generator=random)[:scenes].split(128):
            images, _ = self.draw(chosen, random)
            network(*(image.to(device) for image in images))
        network.eval()


def linear_images(batches: SceneBatches, scale: float, scenes: int = 8000) -> np.ndarray[Any, Any]:
    """Best linear estimates of map and pressed shape from filtered data, by ridge regression.

    Returns:
        (2, rows, columns, K), for `FusionNetwork.start_linear`.
    """
    random = torch.Generator().manual_seed(2)
    some = torch.tensor(batches.trained)[:: max(1, len(batches.trained) // scenes)]
    drawn = [batches.draw(chosen, random) for chosen in some.split(512)]
    inputs = torch.cat([batch.inputs for batch in drawn]).double()
    goals = torch.cat([_goals(batch, scale) for batch in drawn]).double()
    ridge = 1e-3 * len(inputs) * torch.eye(inputs.shape[1], dtype=torch.float64)
    weights = torch.linalg.solve(inputs.T @ inputs + ridge, inputs.T @ goals)
    rows, columns = batches.nodes
    return np.asarray(weights.T.reshape(2, rows, columns, -1))


def _goals(batch: Batch, scale: float) -> Tensor:
    return torch.cat([batch.map.flatten(1) / scale, batch.pressed.flatten(1)], dim=1)
