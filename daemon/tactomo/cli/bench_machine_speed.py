"""`tactomo bench --machine-speed`: how much work, and which method, a time buys on this machine.

Measured on moving scenes of tuning seeds, as a daemon has them: what is chosen by accuracy must
not be chosen on the scenes that report it.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.progress import Progress
from tactomo_models import METHODS, Tier, load_description
from tactomo_models.evaluation.moving import draw_sequence
from tactomo_models.evaluation.trade_off import BUDGETED, BUDGETS_S, Point, variants
from tactomo_models.machine_speed import (
    MachineSpeed,
    Row,
    machine_speed_for,
    machine_speed_path,
    save_machine_speed,
)

from tactomo.cli.bench_chart import follow, to_be_had, told_if_busy

if TYPE_CHECKING:
    from rich.table import Table

SEEDS: Final = "tuning"
SNR_DB: Final = (40.0, 20.0)  # the same moving scene at each
CANDIDATES: Final = tuple(m for m in METHODS if m is Tier.AUTO or m not in BUDGETED)
LEAST_S: Final = 0.002
TIMES_MS: Final = (1, 2, 5, 10, 20, 50, 100)  # of which the table tells what they buy


def measure(name: str) -> MachineSpeed:
    """Measure a sensor's methods on this machine and keep what came out, with a progress bar.

    Raises:
        ModelError: there are no scenes for such a sensor, or the file cannot be written.
    """
    sensor = load_description(name)
    methods = to_be_had(sensor, CANDIDATES)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        ratios = progress.track(SNR_DB, description="simulating a moving scene")
        moving = [draw_sequence(sensor, SEEDS, 0, snr_db=snr_db) for snr_db in ratios]
        with told_if_busy():
            points = follow(moving, variants(methods, (LEAST_S, *BUDGETS_S)), progress)
    today = datetime.now(UTC).date().isoformat()
    speed = MachineSpeed.of_rows(sensor, today, [_row(point) for point in points])
    save_machine_speed(speed, machine_speed_path(sensor))
    return speed


def _row(point: Point) -> Row:
    return Row(
        method=point.variant.method,
        budget_s=point.variant.budget_s,
        p50_s=point.p50_s,
        p99_s=point.p99_s,
        icc=point.icc,
    )


def in_force(name: str) -> MachineSpeed:
    """Return what a daemon would use, and say on standard error why, if need be."""
    console = Console(stderr=True)
    return machine_speed_for(load_description(name), lambda why: console.print(why, soft_wrap=True))


def tables_of(speed: MachineSpeed) -> Sequence[Table]:
    """Lay out what was measured, and what each time buys."""
    from rich.table import Table

    measured = Table(title="one frame of moving scenes (simulated, tuning seeds)")
    for heading in ("method", "modelled budget ms", "p50 ms", "p99 ms", "ICC"):
        measured.add_column(heading, justify="left" if heading == "method" else "right")
    for row in speed.rows:
        measured.add_row(
            row.method,
            "" if row.budget_s is None else f"{row.budget_s * 1e3:g}",
            f"{row.p50_s * 1e3:.1f}",
            f"{row.p99_s * 1e3:.1f}",
            f"{row.icc:.3f}",
        )
    bought = Table(title="what auto does within a time")
    for heading in ("within ms", "method", "modelled budget ms"):
        bought.add_column(heading, justify="left" if heading == "method" else "right")
    for time_ms in TIMES_MS:
        plan = speed.plan(Tier.AUTO, time_ms * 1e-3)
        budget = f"{plan.budget_s * 1e3:.1f}" if plan.tier in BUDGETED and plan.budget_s else ""
        bought.add_row(str(time_ms), str(plan.tier), budget)
    return [measured, bought] if speed.rows else [bought]
