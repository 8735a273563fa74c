"""Training the network of `tactomo_lab.tanks.images` on simulated tanks.

It sees each tank as the challenge does, with none to twelve electrodes lost, as sixteen electrodes
do, and as every other one of thirty-two does that were taken for sixteen wider ones; turned and
mirrored at random, and with noise anew each time. A small U-Net at half of the image's resolution:
pixels are folded into channels at either end.

Source: Ronneberger, Fischer & Brox, "U-Net", MICCAI 2015.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tactomo_models.archive import read_arrays
from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.sensor.description_file import load_description
from tactomo_models.sensor.pattern import scan_pairs
from torch import Tensor, nn
from torch.nn import functional

from tactomo_lab.tanks.challenge import challenge_pattern, kept_readings
from tactomo_lab.tanks.images import INPUTS, PIXELS, LinearImages
from tactomo_lab.tanks.model import Readings, TankModel
from tactomo_lab.training.export import export
from tactomo_lab.training.tank_scenes import TANKS

WIDTHS = (40, 64, 80)
BATCH = 20
RATE = 2e-3
NOISE = 0.08  # of the change itself: what the model gets wrong; see `tactomo_lab.tanks.model`
NOISE_RANGE = (0.6, 1.6)  # factors on all noise
BAD_CONTACT = 0.07  # contact resistance by which one electrode in three tanks has changed
SCALE = {True: 0.05, False: 0.25}  # deviation of the logarithm, where units are known and not


@dataclass(frozen=True)
class View:
    """One way to read a tank.

    Attributes:
        tank: whose transfer resistances are read.
        images: of these readings.
        by_pair: (r, P) numbers by the transfer resistances of that tank.
        contacts: (r, L) numbers by contact resistances.
        turned: (turns, 2, P) which pairs' resistances are whose when all is turned and mirrored.
        scaled: whether voltages come in a known unit.
    """

    tank: str
    images: LinearImages
    by_pair: FloatArray
    contacts: FloatArray
    turned: IntArray
    scaled: bool


def views() -> list[View]:
    """Every way to read a tank that the network is to know."""
    found = []
    wide = TankModel(load_description("tank_ktc2023"))
    currents, weights = challenge_pattern()
    for level in range(1, 8):
        kept = kept_readings(currents, weights, range(2 * level - 2))
        readings = _readings(wide, currents[kept], weights[kept])
        found.append(_view("tank_ktc2023", wide, wide, readings, readings.by_pair, True))
    narrow = TankModel(load_description("tank_uef2017"))
    pairs, eye = scan_pairs(16), np.eye(16)
    drive, measure = (eye[pair[:, 0]] - eye[pair[:, 1]] for pair in (pairs.drive, pairs.measure))
    readings = _readings(narrow, drive, measure)
    found.append(_view("tank_uef2017", narrow, narrow, readings, readings.by_pair, False))
    every_other = (16 + 2 * np.arange(16)) % 32  # from the bottom, where the other tank begins
    lookup = np.zeros((32, 32), int)
    lookup[tuple(wide.pairs)] = lookup[tuple(wide.pairs[::-1])] = np.arange(len(wide.pairs[0]))
    by_pair = np.zeros((len(readings.by_pair), len(wide.pairs[0])))
    by_pair[:, lookup[tuple(every_other[narrow.pairs])]] = readings.by_pair
    found.append(_view("tank_ktc2023", wide, narrow, readings, by_pair, False))
    return found


def _readings(model: TankModel, currents: FloatArray, weights: FloatArray) -> Readings:
    return Readings(model, currents, weights, model.readings_of_empty(currents, weights))


def _view(
    tank: str,
    model: TankModel,
    assumed: TankModel,
    readings: Readings,
    by_pair: FloatArray,
    scaled: bool,
) -> View:
    one, other = model.pairs
    electrodes = model.description.electrode_count
    lookup = np.zeros((electrodes, electrodes), int)
    lookup[one, other] = lookup[other, one] = np.arange(len(one))
    turned = np.zeros((electrodes, 2, len(one)), int)
    for turn in range(electrodes):
        for mirrored in (0, 1):
            # Electrode i of the turned tank is at the place of this one of the drawn tank.
            place = (np.arange(electrodes) - turn) * (-1 if mirrored else 1) % electrodes
            turned[turn, mirrored] = lookup[place[one], place[other]]
    images = LinearImages(assumed, readings)
    return View(tank, images, by_pair, by_pair[:, one == other], turned, scaled)


class TankScenes:
    """Scenes of a folder as batches.

    Args:
        folder: of shards by `tank_scenes.simulate_shard`.
        seed: of the choice, the turns and the noise.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        shards = [read_arrays(path) for path in sorted(folder.glob("tanks-*.npz"))]
        self._solved = {name: np.concatenate([shard[name] for shard in shards]) for name in TANKS}
        change = torch.tensor(np.concatenate([shard["change"] for shard in shards]).astype("f4"))
        worse, better = (-change).clamp(min=0), change.clamp(min=0)
        self._truth = torch.stack([1 - worse - better, worse, better], dim=1)
        self._views = views()
        self._rng = np.random.default_rng(seed)

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        """Inputs (count, INPUTS, PIXELS, PIXELS), and shares of the three kinds, likewise."""
        rng = self._rng
        view = self._views[rng.integers(len(self._views))]
        chosen = rng.integers(len(self._truth), size=count)
        turns, mirrored = rng.integers(len(view.turned), size=count), rng.integers(2, size=count)
        solved = np.take_along_axis(
            self._solved[view.tank][chosen], view.turned[turns, mirrored], 1
        )
        numbers = solved @ view.by_pair.T * np.exp(SCALE[view.scaled] * rng.normal(size=(count, 1)))
        rms = np.sqrt(np.mean(numbers**2, axis=1, keepdims=True))
        noise = rng.uniform(*NOISE_RANGE, (count, 1)) * np.hypot(1, NOISE * rms)
        bad = rng.integers(3 * view.contacts.shape[1], size=count)
        contacts = np.column_stack([view.contacts, np.zeros((len(view.contacts), bad.max() + 1))])
        numbers += BAD_CONTACT * contacts.T[bad] * rng.normal(size=(count, 1))
        numbers += noise * rng.standard_normal(numbers.shape)
        truth = functional.grid_sample(
            self._truth[chosen],
            _turned_grid(turns * 2 * np.pi / len(view.turned), mirrored),
            align_corners=False,
        )
        return torch.tensor(view.images.inputs(numbers)), truth


def _turned_grid(angle: FloatArray, mirrored: IntArray) -> Tensor:
    """Where (n, PIXELS, PIXELS, 2) the pixels of turned images come from; y points down."""
    cos, sin, sign = np.cos(angle), np.sin(angle), 1.0 - 2 * mirrored
    zero = np.zeros_like(cos)
    affine = np.stack([sign * cos, -sign * sin, zero, sin, cos, zero], axis=1).reshape(-1, 2, 3)
    shape = [len(angle), 3, PIXELS, PIXELS]
    return functional.affine_grid(torch.tensor(affine.astype("f4")), shape, align_corners=False)


class TankNetwork(nn.Module):
    """Logits of nothing, worse and better in each pixel."""

    def __init__(self) -> None:
        super().__init__()
        wide, middle, narrow = WIDTHS
        self.wide = _two(4 * INPUTS, wide)
        self.middle = _two(wide, middle)
        self.narrow = _two(middle, narrow)
        self.middle_up = _two(narrow + middle, middle)
        self.wide_up = _two(middle + wide, wide)
        self.last = nn.Conv2d(wide, 12, 3, padding=1)

    def forward(self, inputs: Tensor) -> Tensor:
        """Logits (n, 3, PIXELS, PIXELS) of inputs (n, INPUTS, PIXELS, PIXELS)."""
        wide = self.wide(functional.pixel_unshuffle(inputs, 2))
        middle = self.middle(functional.avg_pool2d(wide, 2))
        narrow = self.narrow(functional.avg_pool2d(middle, 2))
        middle = self.middle_up(torch.cat([_doubled(narrow), middle], dim=1))
        wide = self.wide_up(torch.cat([_doubled(middle), wide], dim=1))
        return functional.pixel_shuffle(self.last(wide), 2)


def _two(inputs: int, outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in (inputs, outputs):
        layers += [nn.Conv2d(width, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


def _doubled(image: Tensor) -> Tensor:
    return functional.interpolate(image, scale_factor=2.0, mode="bilinear", align_corners=False)


def train(folder: Path, steps: int, output: Path, seed: int = 0) -> Iterator[float]:
    """Train on a folder's scenes and write the network after each hundredth of the way.

    Yields:
        After each step the mean cross entropy of a pixel, smoothed over a hundred steps.
    """
    torch.manual_seed(seed)
    scenes, network, mean = TankScenes(folder, seed), TankNetwork(), 0.0
    network.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, RATE / 100)
    for step in range(1, steps + 1):
        inputs, truth = scenes.draw(BATCH)
        network.train()
        inside = inputs[:, -2] > 0
        logits = network(inputs.to(memory_format=torch.channels_last))
        loss = -(torch.log_softmax(logits, dim=1) * truth).sum(dim=1)[inside].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        mean += (loss.item() - mean) / min(step, 100)
        if step % max(1, steps // 20) == 0 or step == steps:
            example = {"inputs": torch.zeros(1, INPUTS, PIXELS, PIXELS)}
            export(network, example, ("logits",), {"trained": f"{step} steps"}, output)
        yield mean
