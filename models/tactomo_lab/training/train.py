"""Training a network epoch after epoch, from its checkpoint if there is one."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tactomo_models.archive import write_whole
from tactomo_models.errors import ModelError
from torch import Tensor, nn

from tactomo_lab.training.networks import FusionObjective

AVERAGED = 0.998  # of the averaged weights that each step keeps


@dataclass(frozen=True)
class Epoch:
    """What one epoch came to."""

    loss: float  # mean over its batches
    # correlation of the maps of scenes that are not trained on, by noise in dB and number of
    # contacts
    held_out: dict[str, float]


@dataclass(frozen=True)
class Settings:
    """How long and how fast."""

    epochs: int  # passes over the scenes
    batch: int = 128  # scenes in a step
    # highest learning rate; it rises over a twentieth of the steps and falls by a cosine
    rate: float = 2e-3
    weight_decay: float = 1e-2
    seed: int = 0  # of the order, the noise and the turns
    half: bool = True  # compute products in bfloat16, twice as fast where the processor has it
    device: str = "cpu"


@dataclass
class Training:
    """A network in training, as its checkpoint keeps it.

    Attributes:
        network: as trained.
        averaged: its weights averaged over the last steps: what is exported.
        optimiser, random: their states go on, too.
        history: one for each epoch that is done.
    """

    network: nn.Module
    averaged: nn.Module
    optimiser: torch.optim.Optimizer
    random: torch.Generator
    history: list[Epoch] = field(default_factory=list)


def use(device: str, threads: int | None = None) -> None:
    """Prepare this process for a device, and for so many threads; PyTorch's choice if None.

    Raises ModelError where there is no such device.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise ModelError("PyTorch finds no GPU here; leave out --device, or use cpu")
    if threads is not None:
        torch.set_num_threads(threads)


def begin(network: nn.Module, settings: Settings) -> Training:
    """A training before its first step."""
    network = network.to(settings.device)
    network = network.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=settings.rate, weight_decay=settings.weight_decay
    )
    random = torch.Generator().manual_seed(settings.seed)
    return Training(network, copy.deepcopy(network), optimiser, random)


def train(
    training: Training,
    objective: FusionObjective,
    settings: Settings,
    checkpoint: Path | None = None,
    report: Callable[[int, int, float], None] = lambda step, steps, loss: None,
) -> Iterator[Epoch]:
    """Train until all epochs are done, with a checkpoint after each; with no file there is none.

    `report` is given the number of a step, how many the epoch has, and the loss.

    Yields:
        Each epoch's outcome.

    Raises ModelError where a checkpoint cannot be written, or the loss is no number.
    """
    steps = max(1, objective.scenes // settings.batch)
    for epoch in range(len(training.history), settings.epochs):
        order = torch.randperm(objective.scenes, generator=training.random)
        training.network.train()
        total = 0.0
        for step, chosen in enumerate(order[: steps * settings.batch].split(settings.batch)):
            done = (epoch * steps + step) / (settings.epochs * steps)
            loss = _step(training, objective, chosen, settings, _rate(settings.rate, done))
            total += loss
            report(step + 1, steps, loss)
        if not np.isfinite(total):
            raise ModelError(
                f"the loss is no number any more in epoch {epoch + 1}: train with a lower rate"
            )
        training.averaged.eval()
        with torch.inference_mode():
            outcome = Epoch(total / steps, objective.examine(training.averaged, settings.device))
        training.history.append(outcome)
        if checkpoint is not None:
            save_checkpoint(training, settings, checkpoint)
        yield outcome


def _step(
    training: Training, objective: FusionObjective, chosen: Tensor, settings: Settings, rate: float
) -> float:
    for group in training.optimiser.param_groups:
        group["lr"] = rate
    training.optimiser.zero_grad(set_to_none=True)
    with torch.autocast(settings.device, dtype=torch.bfloat16, enabled=settings.half):
        loss = objective.loss(training.network, chosen, training.random, settings.device)
    loss.backward()
    nn.utils.clip_grad_norm_(training.network.parameters(), 1.0)
    training.optimiser.step()
    # The average starts with what there is, not with the untrained weights.
    done = training.optimiser.state[training.optimiser.param_groups[0]["params"][0]]["step"]
    kept = min(AVERAGED, float(done) / (float(done) + 10))
    new = training.network.state_dict()
    for name, value in training.averaged.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(new[name], 1 - kept)
        else:
            value.copy_(new[name])
    return float(loss.detach())


def _rate(highest: float, done: float) -> float:
    """Learning rate after a share of all steps."""
    rise = 0.05
    if done < rise:
        return highest * (done / rise + 0.02)
    return highest * (0.01 + 0.99 * 0.5 * (1 + float(np.cos(np.pi * (done - rise) / (1 - rise)))))


def save_checkpoint(training: Training, settings: Settings, path: Path) -> None:
    """Keep a training; a half-written file never takes the place of a whole one.

    Raises ModelError where the file cannot be written.
    """
    state = {
        "settings": asdict(settings),
        "network": training.network.state_dict(),
        "averaged": training.averaged.state_dict(),
        "optimiser": training.optimiser.state_dict(),
        "random": training.random.get_state(),
        "history": [asdict(epoch) for epoch in training.history],
    }
    try:
        write_whole(path, lambda file: torch.save(state, file))
    except (OSError, RuntimeError) as error:  # torch reports a full disk as a RuntimeError
        raise ModelError(
            f"cannot write {path}: {error}; free some space or name another file, then go on "
            "from the last checkpoint"
        ) from error


def _damaged(path: Path) -> str:
    return f"{path} is no checkpoint, or a damaged one: name another, or delete it to begin anew"


def load_checkpoint(training: Training, settings: Settings, path: Path) -> None:
    """Go on from a checkpoint.

    Raises ModelError where it is damaged, or of other settings or another network.
    """
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror}; name another file") from error
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise ModelError(_damaged(path)) from error
    try:
        before = Settings(**state["settings"])
        history = [Epoch(**epoch) for epoch in state["history"]]
        states = [state[name] for name in ("network", "averaged", "optimiser", "random")]
    except (KeyError, TypeError) as error:
        raise ModelError(_damaged(path)) from error
    for name, old, new in (
        (name, getattr(before, name), getattr(settings, name))
        for name in ("epochs", "batch", "rate", "weight_decay", "seed")
    ):
        if old != new:
            raise ModelError(
                f"{path} was begun with {name} {old}, not {new}: name another file, or go on as "
                "it was begun"
            )
    try:
        training.network.load_state_dict(states[0])
        training.averaged.load_state_dict(states[1])
        training.optimiser.load_state_dict(states[2])
    except (RuntimeError, ValueError) as error:
        raise ModelError(f"{path} is of another network: name another file") from error
    training.random.set_state(states[3])
    training.history = history
