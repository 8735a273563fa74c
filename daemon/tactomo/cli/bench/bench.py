"""`tactomo bench`: how fast all this is on the machine at hand.

*Live*: a twin and a daemon as processes of their own, and this process as the subscriber; latency
is from the moment at which the daemon has read the last byte of a dual scan to the arrival of its
contacts here, by the clock that both processes share. *Chart* is the laboratory's, see
`tactomo.cli.commands`.
"""

from __future__ import annotations

import os
import platform
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table
from tactomo_client import Frame, Subscription, request, subscribe

from tactomo.cli import options
from tactomo.cli.children import new_group
from tactomo.cli.commands import measurement
from tactomo.cli.console import Console, page
from tactomo.cli.output import print_json, table

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

SENSOR = "bench"
SETTLE_S = 1.5
STATUS_S = 13.0  # at 20 dual scans a second: as far back as the stage times in a status go
START_S = 60.0
PLACES = ((0.0, 0.1), (-0.45, -0.4), (0.5, -0.35))  # in shares of half the sheet's size
LIVE, CHART = "Live", "Speed against accuracy"


@dataclass(frozen=True)
class Phase:
    """What was measured live while one thing was pressed."""

    scene: str
    frames: int
    frames_per_s: float
    latency_p50_ms: float
    latency_p99_ms: float
    stage_ms: dict[str, dict[str, float]]
    tiers: dict[str, int]
    memory_mb: float | None


@dataclass
class Results:
    """Everything that was measured, and on what."""

    machine: str
    description: str
    live: list[Phase] = field(default_factory=list)
    late_scans: int | None = None
    dropped_scans: int | None = None
    chart: list[dict[str, Any]] = field(default_factory=list)


app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo bench",
        "tactomo bench --seconds 20",
        "tactomo bench --json > times.json",
        "tactomo bench --chart speed_accuracy.png --count 25",
        "tactomo bench --chart mine.png --method my_module:MyMethod --method auto",
    )
)
def bench(
    description: options.Description = options.DEFAULT_DESCRIPTION,
    seconds: Annotated[
        float,
        typer.Option(
            min=1.0,
            max=3600.0,
            rich_help_panel=LIVE,
            help="Seconds of each of the four live scenes.",
        ),
    ] = STATUS_S,
    rate: Annotated[
        float, typer.Option(rich_help_panel=LIVE, help="Dual scans a second of the twin.")
    ] = 20.0,
    chart: Annotated[
        Path | None,
        typer.Option(
            rich_help_panel=CHART,
            help="Instead, draw every method's accuracy over its time: .png, .svg or .pdf. "
            "Needs matplotlib.",
        ),
    ] = None,
    count: Annotated[
        int,
        typer.Option(
            min=1, max=1000, rich_help_panel=CHART, help="Still scenes each of 1 to 4 contacts."
        ),
    ] = 10,
    method: Annotated[
        list[str] | None, options.methods_option(" [every installed one]", rich_help_panel=CHART)
    ] = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Measure latency and rate on this machine, or the accuracy of methods over their time.

    Starts a twin and a daemon on free addresses, presses the twin in four ways and measures each. A
    running demo is not disturbed, but shares the processor. Takes about a minute.

    With `--chart`, every method reconstructs simulated presses of mixed kinds on hand-made skins
    (reporting seeds): still scenes at 40, 20 and 10 dB, each from a cold start, and moving scenes,
    under budgets of 1 to 50 ms, still ones also of 2 s. Takes about a quarter of an hour, longer
    when the scenes must be simulated first.
    """
    if method and chart is None:
        raise typer.BadParameter("--method goes with --chart")
    results = Results(machine(), description)
    if chart is not None:
        measure = measurement("chart")
        results.chart = measure(description, chart, count, results.machine, method or [])
    else:
        with Console(stderr=True).status("starting") as line:
            _measure_twin(results, rate, seconds, line.update)
    if as_json:
        print_json(asdict(results))
    elif chart is None:
        _print(results)


def _measure_twin(
    results: Results, rate: float, seconds: float, report: Callable[[str], None]
) -> None:
    from tactomo_models import load_description

    with tempfile.TemporaryDirectory(prefix="tactomo-") as folder, new_group() as group:

        def at(name: str) -> str:
            return f"ipc://{folder}/{name}"

        size = load_description(results.description)
        spots = [_spot(size, place) for place in PLACES]
        described = ("--description", results.description)
        group.start("models build", "models", "build", *described).wait_done()
        skin = group.start(
            *("twin", "twin", *described, "--rate", str(rate)),
            *("--twin-control", at("twin"), "--announce"),
        ).wait_ready()
        lines = [word for path in skin["ports"] for word in ("--port", path)]
        group.start(
            *("daemon", "daemon", "--sensor", SENSOR, *described, *lines),
            *("--stream", at("stream"), "--control", at("control")),
        ).wait_ready()

        def press(count: int) -> None:
            request("clear", skin["control"])
            for number, (x_mm, y_mm) in enumerate(spots[:count]):
                request("press", skin["control"], id=str(number), x_mm=x_mm, y_mm=y_mm)

        def slide(share: float) -> None:
            x_mm, y_mm = _spot(size, (1.2 * share - 0.6, 0.2))
            request("press", skin["control"], id="0", x_mm=x_mm, y_mm=y_mm)

        with subscribe(SENSOR, address=at("stream"), kind="contacts", timeout_s=START_S) as frames:
            next(frame for frame in frames if "no_reference" not in frame.flags)
            for scene, count, moves in (
                ("nothing pressed", 0, None),
                ("one contact, still", 1, None),
                ("one contact, sliding", 1, slide),
                ("three contacts, still", 3, None),
            ):
                report(f"live: {scene}")
                press(count)
                deque(_during(frames, SETTLE_S), maxlen=0)
                results.live.append(_measure(frames, scene, seconds, at("control"), moves))
        results.late_scans = request("status", skin["control"])["late_scans"]
        results.dropped_scans = request("status", at("control"))["dropped_scans"]


def _measure(
    frames: Subscription[Frame],
    scene: str,
    seconds: float,
    control: str,
    moves: Callable[[float], None] | None,  # gets the share of the time that has passed
) -> Phase:
    import numpy as np

    ages_ms: list[float] = []
    tiers: Counter[str] = Counter()
    begin_s = time.monotonic()
    for frame in _during(frames, seconds):
        ages_ms.append(frame.age_s * 1e3 - (frame.delay_ns or 0) * 1e-6)
        tiers[str(frame.tier)] += 1
        if moves is not None:
            moves(min(1.0, (time.monotonic() - begin_s) / seconds))
    passed_s = time.monotonic() - begin_s
    p50, p99 = np.percentile(ages_ms, (50, 99)).tolist()
    status = request("status", control)
    memory_bytes = status["process"]["memory_bytes"]
    return Phase(
        scene=scene,
        frames=len(ages_ms),
        frames_per_s=len(ages_ms) / passed_s,
        latency_p50_ms=p50,
        latency_p99_ms=p99,
        stage_ms=status["stage_ms"],
        tiers=dict(tiers),
        memory_mb=memory_bytes and memory_bytes / 1e6,
    )


def _during(frames: Subscription[Frame], seconds: float) -> Iterator[Frame]:
    end_s = time.monotonic() + seconds
    for frame in frames:
        yield frame
        if time.monotonic() >= end_s:
            return


def _spot(description: SensorDescription, place: tuple[float, float]) -> tuple[float, float]:
    """Return the millimetres of a place that is given in shares of half the sheet's size."""
    return place[0] * description.width_m * 500.0, place[1] * description.height_m * 500.0


def _print(results: Results) -> None:
    """Print on what everything was measured, and what came out."""
    console = page()
    console.print(f"{results.machine}, sensor {results.description}")
    console.print(_live_table(results))
    console.print(_stage_table(results.live))
    console.print(
        f"late scans of the twin: {results.late_scans}; "
        f"dual scans dropped by the daemon: {results.dropped_scans}"
    )


def _live_table(results: Results) -> Table:
    methods = "frames by method"
    shown = table(
        *("scene", "frames/s", "p50 ms", "p99 ms", "daemon MB", methods),
        left=(methods,),
        title="live: last byte read to contacts in another process",
    )
    for phase in results.live:
        shown.add_row(
            phase.scene,
            f"{phase.frames_per_s:.1f}",
            f"{phase.latency_p50_ms:.1f}",
            f"{phase.latency_p99_ms:.1f}",
            f"{phase.memory_mb:.0f}" if phase.memory_mb else "-",
            ", ".join(f"{tier} {count}" for tier, count in phase.tiers.items()),
        )
    return shown


def _stage_table(phases: list[Phase]) -> Table:
    """Return the daemon's own account of its newest 256 frames at the end of each scene."""
    scenes = (phase.scene for phase in phases)
    shown = table("stage", *scenes, title="stages of the daemon, p50 / p99 ms")
    for stage in dict.fromkeys(stage for phase in phases for stage in phase.stage_ms):
        times = (phase.stage_ms.get(stage) for phase in phases)
        cells = (f"{t['p50']:.1f} / {t['p99']:.1f}" if t else "-" for t in times)
        shown.add_row(stage, *cells)
    return shown


def machine() -> str:
    """Return the processor, its cores that we may use, and the versions that matter."""
    import numpy as np

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{_processor()}, {cores} cores, Python {platform.python_version()}, NumPy {np.__version__}"
    )


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(": ")[2]
    return platform.processor() or platform.machine()
