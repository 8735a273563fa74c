"""The network, in PyTorch.

What goes in front of it is the same in training and at run time: `prefilter` and
`trained_networks` of `tactomo_models.methods`.
"""

from __future__ import annotations

import torch
from tactomo_models.arrays import FloatArray
from torch import Tensor, nn
from torch.nn import functional as fn


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
