"""What the network is trained on: how wrong its answer is, and how it does on other scenes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tactomo_lab.training.batches import Batch, SceneBatches

MIN_CHANGE = 0.4  # squared sum of a map below which scenes count less: 25 nodes of half a range
SHAPE_SHARE = 0.5  # of the loss that the pressed shape has, to one of the map's
MIN_PRESSED = 20.0  # nodes pressed, likewise
TRUST_SHARE = 0.05
REPORT_DB = (40.0, 20.0, 10.0)


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


def image_loss(
    made: tuple[Tensor, Tensor, Tensor],  # `FusionNetwork.raw` of n scenes
    true: Tensor,  # (n, rows, columns) maps over the network's scale
    pressed: Tensor,  # (n, rows, columns) shapes
) -> Tensor:
    """RIE squared of the map, cross entropy of the shape, and of the confidence."""
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
