"""The networks, in PyTorch: the paper's two, and ours.

All give images of the map's size. What goes in front of them and what follows is the same in
training and at run time: `prefilter` and `trained_networks` of `tactomo_models.methods`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tactomo_models.arrays import FloatArray
from torch import Tensor, nn
from torch.nn import functional as fn


class FusionNetwork(nn.Module):
    """Ours: from both channels' filtered voltages to the map, the pressed shape and a confidence.

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


# Convolutions of each of an extractor's five stages, and what their channels are multiples of the
# width. The paper says: sixteen blocks, five poolings, the last one averaging, 4096 numbers. That
# takes 1024 channels of 2 x 2, from maps of 51 x 51 halved five times and rounded up; how blocks
# and channels are spread over the stages it leaves open. Here only the last block is that wide.
_STAGES = (3, 3, 3, 3, 4)
_FEATURES = 4096
# Standard deviations above 0 that the blocks' values begin at, where an ELU is nearly linear.
# Through sixteen that are not, like images come out unlike: a regression on such features of 2,400
# scenes errs by 0.64 of the maps; begun at 1, by 0.58.
_START = 2.0


class PaperNetwork(nn.Module):
    """The paper's (section III-C): one extractor an input image, two fully connected blocks.

    Args:
        channels: 1, the magnitude image alone; 2, the structure image beside it.
        nodes: (rows, columns) of the map.
        width: channels of the first stage; doubled with every stage. 64 is the scale of VGG-19,
            which has as many blocks and poolings; the paper leaves it open.
        hidden: neurons between the two fully connected blocks; left open, too.
    """

    def __init__(
        self, channels: int, nodes: tuple[int, int], width: int = 64, hidden: int = 4096
    ) -> None:
        super().__init__()
        self.channels, self.nodes, self.width, self.hidden = channels, nodes, width, hidden
        last = _FEATURES // int(np.prod([_halved(n, len(_STAGES)) for n in nodes]))
        self.extractors = nn.ModuleList(_extractor(width, last) for _ in range(channels))
        self.connected = nn.Sequential(
            *_block(_FEATURES * channels, hidden), *_block(hidden, nodes[0] * nodes[1])
        )

    def forward(self, *images: Tensor) -> Tensor:
        """From pre-processed images (n, rows, columns) to a 0-1 normalised one."""
        made: Tensor = self.connected(self.features(*images)).view(-1, *self.nodes)
        return made

    def features(self, *images: Tensor) -> Tensor:
        """What the extractors make of images (n, rows, columns): (n, 4096) of each, joined."""
        made = zip(self.extractors, images, strict=True)
        return torch.cat([extract(image[:, None]).flatten(1) for extract, image in made], dim=1)

    def train(self, mode: bool = True) -> PaperNetwork:
        """As PyTorch's, but the last normalisation keeps the statistics that it began with.

        A node is pressed in few scenes of a batch: theirs would make its values noisy.
        """
        super().train(mode)
        self.connected[-2].eval()
        return self

    def start_linear(self, features: Tensor, goals: Tensor, ridge: float = 6.0) -> None:
        """Let the connected blocks begin as a ridge regression of maps on features.

        Begun at random, they settle on the mean of all maps and leave it slowly: most of a map
        is 0, where their last ReLU is silent.

        Args:
            features: (n, K) of the untrained extractors.
            goals: (n, nodes) 0-1 normalised maps.
            ridge: so many scenes' mean square of features is spread over all: few scenes tell less.
        """
        first, _, _, last, scale, _ = self.connected
        centre, mean = features.mean(0), goals.mean(0)
        apart = features - centre
        gram = apart @ apart.T
        damped = gram.double() + ridge * gram.trace() / len(gram) ** 2 * torch.eye(len(gram))
        dual = torch.linalg.solve(damped, (goals - mean).double()).float()
        # Each component takes two neurons, one for either sign: together they are linear.
        _, sizes, components = torch.svd_lowrank(gram @ dual, self.hidden // 2, niter=4)
        deviation = sizes / len(gram) ** 0.5
        weight = (apart.T @ (dual @ components)) / deviation
        back = components * deviation
        typical = float((gram @ dual).std())
        with torch.no_grad():
            first.weight.copy_(torch.cat([weight, -weight], dim=1).T)
            first.bias.copy_(-(first.weight @ centre))
            last.weight.copy_(torch.cat([back, -back], dim=1) / typical)
            last.bias.zero_()
            scale.weight.fill_(typical)
            scale.bias.copy_(mean)


def _halved(nodes: int, times: int) -> int:
    return nodes if times == 0 else _halved((nodes + 1) // 2, times - 1)


def _extractor(width: int, last: int) -> nn.Sequential:
    layers: list[Any] = []
    inputs = 1
    for stage, blocks in enumerate(_STAGES):
        end = stage == len(_STAGES) - 1
        for block in range(blocks):
            outputs = last if end and block == blocks - 1 else width * 2**stage
            normal = nn.BatchNorm2d(outputs)
            nn.init.constant_(normal.bias, _START)
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), normal, nn.ELU()]
            inputs = outputs
        pool = nn.AvgPool2d if end else nn.MaxPool2d
        layers.append(pool(2, ceil_mode=True))
    return nn.Sequential(*layers)


def _block(inputs: int, outputs: int) -> list[nn.Module]:
    return [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU()]
