"""The network, in PyTorch, and what it is trained on: how wrong its answer is.

What goes in front of it is the same in training and at run time: `prefilter` and
`trained_networks` of `tactomo_models.methods`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tactomo_models.arrays import FloatArray
from torch import Tensor, nn
from torch.nn import functional as fn

from tactomo_lab.training.batches import Batch, SceneBatches


class FusionNetwork(nn.Module):
    """From both channels' filtered voltages to the map, the pressed shape and a confidence.

    One linear layer makes a coarse image of the voltages, as a reconstruction matrix does; a small
    perceptron sees what is not linear in them as a whole; a U-Net of two levels draws the edges.

    Args:
        inputs: K numbers of the prefilters.
        nodes: (rows, columns) of the map.
        width: channels at half of the map's resolution; twice that at a quarter.
        scale: relative conductivity change that counts as 1 inside.
    """

    def __init__(self, inputs: int, nodes: tuple[int, int], width: int, scale: float) -> None:
        super().__init__()
        self.inputs, self.nodes, self.width, self.scale = inputs, nodes, width, scale
        self.half = ((nodes[0] + 1) // 2, (nodes[1] + 1) // 2)
        self.quarter = ((self.half[0] + 1) // 2, (self.half[1] + 1) // 2)
        wide = 2 * width
        self.image = nn.Linear(inputs, width // 3 * self.half[0] * self.half[1])
        self.whole = nn.Sequential(
            nn.Linear(inputs, 16 * width),
            nn.GELU(),
            nn.Linear(16 * width, 16 * width),
            nn.GELU(),
            nn.Linear(16 * width, width * self.quarter[0] * self.quarter[1]),
        )
        self.fine = nn.Sequential(_Conv(width // 3, width), _Residual(width))
        self.down = _Conv(width, wide, stride=2)
        self.coarse = nn.Sequential(_Conv(wide + width, wide), _Residual(wide), _Residual(wide))
        self.up = nn.Sequential(nn.Conv2d(wide, 4 * width, 1), nn.PixelShuffle(2))
        self.join = nn.Sequential(_Conv(2 * width, width), _Residual(width))
        self.draw = nn.Sequential(
            nn.Conv2d(width, 4 * (width // 2), 3, padding=1),
            nn.PixelShuffle(2),
            nn.ReLU(),
        )
        self.last = nn.Conv2d(width // 2, 3, 3, padding=1)
        with torch.no_grad():  # begin with nothing pressed, as most of a map is
            assert self.last.bias is not None
            self.last.bias.copy_(torch.tensor([-3.0, -3.0, 0.0]))
        self.trust = nn.Sequential(nn.Linear(2 * wide + inputs, 64), nn.GELU(), nn.Linear(64, 1))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """From filtered data (n, K) to map and pressed shape (n, rows, columns), confidence (n,).

        The map is |relative conductivity change|, the shape 0 to 1, the confidence the expected
        correlation of the map with the truth.
        """
        size, shape, trust = self.raw(x)
        return size * self.scale, torch.sigmoid(shape), torch.sigmoid(trust)

    def raw(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The map over the scale, and the logarithmic odds of shape and confidence."""
        image = self.image(x).view(-1, self.width // 3, *self.half)
        fine = self.fine(image)
        whole = self.whole(x).view(-1, self.width, *self.quarter)
        coarse = self.coarse(torch.cat([self.down(fine), whole], dim=1))
        up = self.up(coarse)[..., : self.half[0], : self.half[1]]
        drawn = self.last(self.draw(self.join(torch.cat([up, fine], dim=1))))
        shape, edge, size = drawn[..., : self.nodes[0], : self.nodes[1]].unbind(1)
        size = torch.sigmoid(edge) * fn.softplus(size)
        pooled = torch.cat([coarse.mean((2, 3)), coarse.amax((2, 3)), x], dim=1).detach()
        trust = self.trust(pooled).squeeze(1)
        return size, shape, trust

    def start_linear(self, images: FloatArray) -> None:
        """Let the first image channels begin as the best linear estimates (2, rows, columns, K)."""
        rows, columns = self.half
        with torch.no_grad():
            weight = self.image.weight.view(self.width // 3, rows, columns, self.inputs)
            weight[: len(images)] = torch.as_tensor(images[:, ::2, ::2], dtype=weight.dtype)
            self.image.bias.zero_()


class _Conv(nn.Sequential):
    """A 3 x 3 convolution, batch normalisation, ReLU."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(),
        )


class _Residual(nn.Module):
    """Two convolutions whose outcome is added to what went in."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.change = nn.Sequential(
            _Conv(width, width),
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
        )

    def forward(self, x: Tensor) -> Tensor:
        return fn.relu(x + self.change(x))


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
