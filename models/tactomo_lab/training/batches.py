"""Batches for training: noise-free scenes, turned, made noisy and filtered anew each time.

Noise is drawn as evaluation has it: equal in volts on every voltage of a scan, with a reference
that averages twenty scans. Filters for its level are taken from a table, since one for each scene
would cost more than the network.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tactomo_models.arrays import BoolArray, FloatArray, Image
from tactomo_models.methods.prefilter import BANDS, prefilter, signal_basis
from tactomo_models.physics.artifact import MODEL_ERROR
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scans.plausibility import Wiring
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.symmetry import Symmetry, symmetries
from tactomo_protocol import Channel
from torch import Tensor

from tactomo_lab.scenes.case import REFERENCE_SCANS
from tactomo_lab.training.training_scenes import read_scenes

LEVELS = 36  # of the table of filters
NOISE_RANGE = (1e-6, 0.5)  # of the voltages' root mean square, from the first level to the last
SNR_DB = (6.0, 66.0)  # of the changes, drawn evenly
VOLTAGE_SNR_DB = (30.0, 80.0)  # of the voltages at rest, for the rest of the scenes
OF_VOLTAGE = 0.3  # share of scenes whose noise goes by the voltages, not by the changes
DEAD = 0.08  # share of scenes with an electrode that says nothing
MUTE = 0.25  # share of these in which a channel says nothing at all
MIN_REFERENCE = 0.5  # of a voltage's size, that a noisy reference is taken for at least
HELD_OUT = 0.04  # share of the scenes, the last ones, that training never sees


@dataclass(frozen=True)
class Batch:
    """Some scenes, ready for the network."""

    inputs: Tensor  # (n, K) filtered data
    map: Tensor  # (n, rows, columns) |relative conductivity change|
    pressed: Tensor  # (n, rows, columns) 0 to 1
    contacts: Tensor  # (n,) how many


class SceneBatches:
    """All scenes of a folder, as batches."""

    def __init__(
        self,
        folder: Path,
        description: SensorDescription,
        channels: tuple[Channel, ...],
        forward: ForwardModel,
    ) -> None:
        scenes = read_scenes(folder, description)
        assert description.magnitude is not None
        own = np.float32(description.magnitude.response.sign)
        same = np.ones(len(scenes["contacts"]), np.float32)
        direction = {
            Channel.MAGNITUDE: np.where(scenes["opposite"], -own, own),
            Channel.STRUCTURE: same,
        }
        self._symmetries = symmetries(description)
        self._channels = []
        for name in channels:
            change = scenes[f"{name}_change"] * direction[name][:, None]
            rest = np.abs(scenes[f"{name}_rest"])
            self._channels.append(_Channel(change, rest, description, forward, self._symmetries))
        self._map = torch.as_tensor(scenes["map"])
        self._pressed = torch.as_tensor(scenes["pressed"])
        self._contacts = torch.as_tensor(scenes["contacts"].astype(np.int64))
        self.nodes = (int(self._map.shape[1]), int(self._map.shape[2]))
        self.turns = len(self._symmetries)
        scenes_there = len(self._map)
        self.trained = range(min(int(scenes_there * (1 - HELD_OUT)), scenes_there - 1))
        self.held_out = range(len(self.trained), scenes_there)  # one at least

    @property
    def inputs(self) -> int:
        """Numbers that the network is given for a scene."""
        return sum(channel.components + BANDS for channel in self._channels)

    @property
    def bases(self) -> list[FloatArray]:
        """Signal basis (M, K) of each channel."""
        return [channel.basis for channel in self._channels]

    def draw(
        self,
        scenes: Tensor,  # their numbers
        random: torch.Generator,  # draws the noise
        *,
        # ratio of the root mean squares of the changes and of the noise; drawn if None
        snr_db: float | None = None,
        turn: int = 0,  # number of the symmetry that is applied
    ) -> Batch:
        """Make a batch of some scenes."""
        symmetry = self._symmetries[turn]
        count = len(scenes)
        of_change = (
            _uniform(SNR_DB, count, random) if snr_db is None else torch.full((count,), snr_db)
        )
        of_voltage = _uniform(VOLTAGE_SNR_DB, count, random)
        by_voltage = torch.rand(count, generator=random) < (OF_VOLTAGE if snr_db is None else 0.0)
        by_voltage |= self._contacts[scenes] == 0
        share = DEAD / len(self._channels) if snr_db is None else 0.0
        parts = []
        for channel in self._channels:
            strength = torch.where(
                by_voltage,
                channel.rest_rms[scenes] * 10 ** (-of_voltage / 20),
                channel.change_rms[scenes] * 10 ** (-of_change / 20),
            )
            dead = torch.rand(count, generator=random) < share
            parts.append(channel.filtered(scenes, strength, dead, symmetry, random))
        nodes = torch.as_tensor(symmetry.nodes)
        return Batch(
            inputs=torch.cat([numbers for part in parts for numbers in part], dim=1),
            map=self._map[scenes].float().flatten(1)[:, nodes].view(count, *self.nodes),
            pressed=self._pressed[scenes].float().flatten(1)[:, nodes].view(count, *self.nodes),
            contacts=self._contacts[scenes],
        )


class _Channel:
    """One channel's noise-free data, and the table of its filters."""

    def __init__(
        self,
        change: Image,
        rest: Image,
        description: SensorDescription,
        forward: ForwardModel,
        turns: list[Symmetry],
    ) -> None:
        volts = np.abs(forward.bare_voltages) * forward.volts_per_unit
        # Turned scenes are as likely: the basis must be the same for them all.
        seen = np.concatenate([change[:, turn.scan] * turn.sign for turn in turns])
        self.components = description.measurements // 2
        self.basis = signal_basis(seen.astype(np.float64), self.components)
        self._change, self._rest = torch.as_tensor(change), torch.as_tensor(rest)
        self.rest_rms = (self._rest**2).mean(1).sqrt()
        self.change_rms = ((self._change * self._rest) ** 2).mean(1).sqrt()
        rms = float(np.sqrt(np.mean(volts**2)))
        self._levels = torch.as_tensor(
            rms * np.geomspace(*NOISE_RANGE, LEVELS), dtype=torch.float32
        )
        none = np.zeros(len(volts), bool)
        silent = [none, *Wiring(description).electrodes, ~none]
        self._silent = torch.as_tensor(np.stack(silent))
        filters = [
            [self._filter(float(level), volts, missing) for level in self._levels]
            for missing in silent
        ]
        self._matrices = torch.stack([torch.stack([f[0] for f in row]) for row in filters])
        self._known = torch.stack([torch.stack([f[1] for f in row]) for row in filters])

    def _filter(self, level: float, volts: FloatArray, missing: BoolArray) -> tuple[Tensor, Tensor]:
        variance = (level / volts) ** 2 * (1 + 1 / REFERENCE_SCANS) + MODEL_ERROR**2
        made = prefilter(self.basis, np.where(missing, 0.0, 1 / variance))
        return torch.as_tensor(made.matrix).float(), torch.as_tensor(made.known).float()

    def filtered(
        self,
        scenes: Tensor,  # (n,) their numbers
        strength: Tensor,  # (n,) standard deviation of the noise, volts
        dead: Tensor,  # (n,) whether an electrode says nothing
        symmetry: Symmetry,  # that is applied
        random: torch.Generator,  # draws noise and electrodes
    ) -> tuple[Tensor, Tensor]:
        """Filtered data (n, K) and known shares (n, BANDS) of scenes with such noise."""
        order = torch.as_tensor(symmetry.scan)
        sign = torch.as_tensor(symmetry.sign, dtype=torch.float32)
        change = self._change[scenes][:, order] * sign
        rest = self._rest[scenes][:, order]
        noise = torch.randn(2, *change.shape, generator=random) * strength[:, None]
        taken = noise[1] / np.sqrt(REFERENCE_SCANS)
        reference = torch.maximum(rest + taken, MIN_REFERENCE * rest)
        data = (change * rest + noise[0] - taken) / reference
        level = (self._levels.log() - strength[:, None].clamp(min=1e-30).log()).abs().argmin(1)
        electrode = torch.randint(1, len(self._silent) - 1, (len(scenes),), generator=random)
        mute = torch.rand(len(scenes), generator=random) < MUTE
        electrode = torch.where(mute, len(self._silent) - 1, electrode)
        electrode = torch.where(dead, electrode, 0)
        data = data.masked_fill(self._silent[electrode], 0.0)
        matrix = self._matrices[electrode, level]
        return torch.bmm(matrix, data[:, :, None]).squeeze(2), self._known[electrode, level]


def _uniform(limits: tuple[float, float], count: int, random: torch.Generator) -> Tensor:
    low, high = limits
    return low + (high - low) * torch.rand(count, generator=random)
