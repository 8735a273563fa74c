"""`tactomo bench --machine-speed`: how much modelled work a time buys on this machine."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import numpy as np
from rich.progress import Progress
from tactomo_models import (
    Press,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
    load_description,
    load_or_build_artifact,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.methods.machine_speed import (
    MachineSpeed,
    machine_speed_path,
    save_machine_speed,
)
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo.cli.console import Console
from tactomo.cli.output import say, table

if TYPE_CHECKING:
    from rich.table import Table

BUDGETS_S: Final = (0.002, 0.005, 0.01, 0.02, 0.05)  # of modelled work, that are timed
TIMES_MS: Final = (1, 2, 5, 10, 20, 50, 100)  # for which the table shows what they buy
Scan = tuple[FloatArray | None, ...]  # volts (M,) of each channel, or None
FRAMES: Final = 120
PRESSURE_KPA: Final = 170.0
FRAMES_A_SLIDE: Final = 20  # then both contacts jump, which is what takes longest
REFERENCE_SCANS: Final = 20
NOISE: Final = 0.1  # of the changes (root mean square); with less, budgets are not used up
BUSY: Final = 0.8  # share of a core below which times are those of whatever else ran


def measure(name: str) -> MachineSpeed:
    """Time a sensor's frames on this machine and keep what came out, with a progress bar.

    Raises ModelError where the models cannot be built, or the file cannot be written.
    """
    sensor = load_description(name)
    artifact = load_or_build_artifact(sensor)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        reference, scans = _moving_scene(sensor, progress)
        p99_s = {}
        with warned_if_busy(), threadpool_limits(1):
            for budget_s in BUDGETS_S:
                reconstructor = Reconstructor(sensor, artifact, budget_s=budget_s)
                reconstructor.set_reference(reference)
                frames = progress.track(scans, description=f"measuring {budget_s * 1e3:g} ms")
                p99_s[budget_s] = float(np.percentile(_seconds(reconstructor, frames), 99))
    speed = MachineSpeed.of_times(sensor, datetime.now(UTC).date().isoformat(), p99_s)
    save_machine_speed(speed, machine_speed_path(sensor))
    return speed


def _seconds(reconstructor: Reconstructor, scans: Iterable[Scan]) -> list[float]:
    """Processor time of each frame: other programs are not counted."""
    seconds = []
    for scan in scans:
        begin_s = time.thread_time()
        reconstructor.reconstruct(*scan)
        seconds.append(time.thread_time() - begin_s)
    return seconds


def _moving_scene(sensor: SensorDescription, progress: Progress) -> tuple[Reference, list[Scan]]:
    """Two contacts that slide around the middle, opposite each other, and jump; and their tare."""
    skin, rng = SkinSimulator(sensor), np.random.default_rng(0)
    radius_m, pressed = sensor.width_m / 15, []
    for frame in progress.track(range(FRAMES), description="simulating two contacts"):
        slide, step = divmod(frame, FRAMES_A_SLIDE)
        angle_rad = 2.4 * slide + step / FRAMES_A_SLIDE
        x_m = sensor.width_m / 4 * np.cos(angle_rad)
        y_m = sensor.height_m / 4 * np.sin(angle_rad)
        presses = [Press(side * x_m, side * y_m, PRESSURE_KPA, radius_m) for side in (1, -1)]
        pressed.append(skin.voltages(presses))
    tare: dict[Channel, FloatArray | None] = dict.fromkeys(Channel)
    scans: dict[Channel, list[FloatArray | None]] = dict.fromkeys(Channel, [None] * FRAMES)
    for channel, rest in skin.voltages([]).items():
        volts = np.array([frame[channel] for frame in pressed])
        noise_v = NOISE * np.sqrt(np.mean((volts - rest) ** 2))
        tare[channel] = rest + noise_v * rng.standard_normal((REFERENCE_SCANS, len(rest)))
        scans[channel] = list(volts + noise_v * rng.standard_normal(volts.shape))
    return Reference.from_scans(*tare.values()), list(zip(*scans.values(), strict=True))


@contextmanager
def warned_if_busy() -> Iterator[list[str]]:
    """Say on standard error if this process had to wait for others while it measured times.

    The list that the block gets holds the same words at its end, for what else shows the times.
    """
    wall_s, own_s = time.perf_counter(), time.process_time()
    warnings: list[str] = []
    yield warnings
    share = (time.process_time() - own_s) / (time.perf_counter() - wall_s)
    if share < BUSY:
        busy = (
            f"the machine was busy: this process had {share:.0%} of a core, so its times are "
            "too long"
        )
        warnings.append(busy)
        say(f"{busy}; run it again when nothing else runs", err=True)


def table_of(speed: MachineSpeed) -> Table:
    """Lay out what each time buys."""
    bought = table("within ms", "modelled budget ms", title="what a time buys")
    for time_ms in TIMES_MS:
        bought.add_row(str(time_ms), f"{speed.budget_s(time_ms * 1e-3) * 1e3:.1f}")
    return bought
