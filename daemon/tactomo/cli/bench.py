"""`tactomo bench`: how fast all this is on the machine at hand.

Three measurements. *Live*: a twin and a daemon as processes of their own, and this process as the
subscriber; latency is from the moment at which the daemon has read the last byte of a dual scan to
the arrival of its contacts here, by the clock that both processes share. *Methods*: the time that
one reconstruction takes by every method, beside what it is compared with (`bench_methods`).
*Chart*: that time against how right the reconstruction is (`bench_chart`), instead of the others.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli.app import BUILD, DEFAULT_DESCRIPTION, Description, JsonOutput, app, examples

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from tactomo_models import SensorDescription

    from tactomo.cli.bench_methods import MethodTime
    from tactomo.cli.children import Family

SENSOR = "bench"
PAGE_WIDTH = 150
SETTLE_S = 1.5
STATUS_S = 13.0  # at 20 dual scans a second: as far back as the stage times in a status go
START_S = 60.0
LIVE, CHART, SPEED = "Live and methods", "Speed against accuracy", "Machine speed"


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


@dataclass
class Results:
    """Everything that was measured, and on what."""

    machine: str
    description: str
    source: str
    live: list[Phase] = field(default_factory=list)
    late_scans: int | None = None
    dropped_scans: int | None = None
    methods: list[MethodTime] = field(default_factory=list)
    chart: list[dict[str, Any]] = field(default_factory=list)


@app.command(
    rich_help_panel=BUILD,
    epilog=examples(
        "tactomo bench",
        "tactomo bench --seconds 20 --ports 1",
        "tactomo bench --replay grasp.mcap",
        "tactomo bench --no-live --json > times.json",
        "tactomo bench --chart speed_accuracy.png --count 25",
        "tactomo bench --machine-speed",
        "tactomo bench --machine-speed --show",
    ),
)
def bench(
    description: Description = DEFAULT_DESCRIPTION,
    seconds: Annotated[
        float,
        typer.Option(min=1.0, rich_help_panel=LIVE, help="Time of each of the four live scenes."),
    ] = STATUS_S,
    ports: Annotated[
        int, typer.Option(min=1, max=2, rich_help_panel=LIVE, help="Lines of the twin.")
    ] = 2,
    rate: Annotated[
        float, typer.Option(rich_help_panel=LIVE, help="Dual scans a second of the twin.")
    ] = 20.0,
    replay: Annotated[
        Path | None,
        typer.Option(rich_help_panel=LIVE, help="Measure on this recording instead of a twin."),
    ] = None,
    live: Annotated[
        bool, typer.Option(rich_help_panel=LIVE, help="Measure latency from port to subscriber.")
    ] = True,
    methods: Annotated[
        bool, typer.Option(rich_help_panel=LIVE, help="Measure the time of each method.")
    ] = True,
    chart: Annotated[
        Path | None,
        typer.Option(
            rich_help_panel=CHART,
            help="Instead of all else, draw every method's accuracy over its time: .png, .svg or "
            ".pdf, and a .csv beside it. Needs matplotlib.",
        ),
    ] = None,
    count: Annotated[
        int,
        typer.Option(min=1, rich_help_panel=CHART, help="Still scenes each of 1 to 4 contacts."),
    ] = 10,
    machine_speed: Annotated[
        bool,
        typer.Option(
            "--machine-speed",
            rich_help_panel=SPEED,
            help="Instead of all else, measure what a budget of time buys here, and keep it for "
            "daemons that start from now on.",
        ),
    ] = False,
    show: Annotated[
        bool,
        typer.Option(
            "--show",
            rich_help_panel=SPEED,
            help="With --machine-speed: only show what such a daemon would go by.",
        ),
    ] = False,
    as_json: JsonOutput = False,
) -> None:
    """Measure latency, rate and time per frame on this machine.

    Starts a twin and a daemon of its own on free addresses, so a running demo is not disturbed
    (but shares the processor). The methods are set beside a bare matrix-vector product, the
    paper's own level set and pyEIT's Gauss-Newton (`pip install 'tactomo[compare]'`), ratios first.
    Takes about two minutes.

    With `--chart`, every method reconstructs simulated scenes of the reporting seeds: still ones
    at 40, 20 and 10 dB, each from a cold start, and moving ones under a daemon's budgets. Takes
    about ten minutes, the first time some more to simulate them.

    With `--machine-speed`, methods follow one moving scene (tuning seeds) and what they took is
    kept in the cache, beside the sensor's models: daemons then keep to a budget of time as this
    machine does, and `auto` takes the method that is most accurate within it. Takes some three
    minutes; leave the machine alone meanwhile. A service has a cache of its own: set
    CACHE_DIRECTORY to it.
    """
    if show and not machine_speed:
        raise typer.BadParameter("--show goes with --machine-speed")
    if machine_speed and chart is not None:
        raise typer.BadParameter("--machine-speed and --chart are two runs")
    results = Results(machine(), description, "a twin" if replay is None else replay.name)
    if chart is not None:
        _chart(results, chart, count, as_json)
        return
    if machine_speed:
        _machine_speed(results, show, as_json)
        return
    from rich.console import Console

    with Console(stderr=True).status("starting") as shown:
        if live and replay is not None:
            _measure_replay(results, replay, shown.update)
        elif live:
            _measure_twin(results, ports, rate, seconds, shown.update)
        if methods:
            from tactomo.cli.bench_methods import measure_methods

            results.methods = measure_methods(description, shown.update)
    if as_json:
        typer.echo(json.dumps(asdict(results), indent=2))
    else:
        _print(results)


def _chart(results: Results, picture: Path, count: int, as_json: bool) -> None:
    """Measure, draw and tell speed against accuracy."""
    from tactomo.cli import bench_chart
    from tactomo.cli.bench_chart_picture import draw_chart
    from tactomo.cli.plot import save_figure

    bench_chart.prepare_chart(picture)
    points = bench_chart.measure_chart(results.description, count)
    results.chart = bench_chart.rows_of(points)
    bench_chart.write_table(results.chart, results.machine, bench_chart.table_path(picture))
    sequences = bench_chart.sequences(count)
    title = (
        f"Simulated, not measured on hardware: sensor {results.description}, reporting seeds; "
        f"{count} still scenes each of 1 to 4 contacts, {sequences} moving "
        f"scene{'s' * (sequences > 1)}\none thread of {results.machine}; figures at points: "
        "budget of modelled work; pale: something else is both faster and better"
    )
    save_figure(draw_chart(points, title), picture)
    if as_json:
        typer.echo(json.dumps(asdict(results), indent=2))
    else:
        _console(results).print(bench_chart.table_of(points))
    typer.echo(f"wrote {picture} and {bench_chart.table_path(picture)}", err=True)


def _machine_speed(results: Results, show: bool, as_json: bool) -> None:
    """Measure what a time buys on this machine, or show what was measured."""
    from tactomo.cli import bench_machine_speed

    name = results.description
    made = bench_machine_speed.in_force(name) if show else bench_machine_speed.measure(name)
    if as_json:
        typer.echo(made.model_dump_json(indent=2))
        return
    console = _console(results)
    for table in bench_machine_speed.tables_of(made):
        console.print(table)
    console.print(
        f"This machine's speed: {made.source}. A frame takes {made.overhead_s * 1e3:.1f} ms and "
        f"{made.speed:.2f} times its modelled budget (p99)."
    )


def _measure_twin(
    results: Results, ports: int, rate: float, seconds: float, tell: Callable[[str], None]
) -> None:
    """Press a twin in several ways and measure each."""
    from tactomo_client import request
    from tactomo_models import load_description

    from tactomo.cli.bench_methods import PLACES

    with _sockets() as at, _family() as family:
        size = load_description(results.description)
        spots = [_spot(size, place) for place in PLACES[:3]]
        options = ("--description", results.description)
        family.start("models build", "models", "build", *options).wait_done()
        skin = family.start(
            *("twin", "twin", *options, "--ports", str(ports), "--rate", str(rate)),
            *("--control", at("twin"), "--announce"),
        ).wait_ready()
        lines = [word for path in skin["ports"] for word in ("--port", path)]
        _start_daemon(family, at, *options, *lines)

        def press(count: int) -> None:
            request("clear", skin["control"])
            for number, (x_mm, y_mm) in enumerate(spots[:count]):
                request("press", skin["control"], id=str(number), x_mm=x_mm, y_mm=y_mm)

        def slide(share: float) -> None:
            x_mm, y_mm = _spot(size, (1.2 * share - 0.6, 0.2))
            request("press", skin["control"], id="0", x_mm=x_mm, y_mm=y_mm)

        with _Stream(at("stream")) as stream:
            stream.wait_for_reference()
            for scene, count, moves in (
                ("nothing pressed", 0, None),
                ("one contact, still", 1, None),
                ("one contact, sliding", 1, slide),
                ("three contacts, still", 3, None),
            ):
                tell(f"live: {scene}")
                press(count)
                stream.skip(SETTLE_S)
                results.live.append(stream.measure(scene, seconds, at("control"), moves))
        results.late_scans = request("status", skin["control"])["late_scans"]
        results.dropped_scans = request("status", at("control"))["dropped_scans"]


def _measure_replay(results: Results, recording: Path, tell: Callable[[str], None]) -> None:
    """Measure a recording at its own speed."""
    from tactomo.recording import open_recording

    summary = open_recording(recording).summary
    results.description = summary.origin.description
    with _sockets() as at, _family() as family:
        tell(f"live: replaying {summary.duration_s:.0f} s of {recording.name}")
        options = ("--stream", at("stream"), "--control", at("control"), "--sensor", SENSOR)
        family.start("replay", "replay", str(recording), "--stay", *options).wait_ready()
        with _Stream(at("stream")) as stream:
            wait_s = max(1.0, summary.duration_s - 0.5)
            results.live.append(stream.measure(recording.name, wait_s, at("control"), None))


def _start_daemon(family: Family, at: Callable[[str], str], *options: str) -> None:
    family.start(
        *("daemon", "daemon", "--sensor", SENSOR, *options),
        *("--stream", at("stream"), "--control", at("control")),
    ).wait_ready()


class _Stream:
    """A subscriber to contacts that takes the time of every message."""

    def __init__(self, address: str) -> None:
        from tactomo_client import subscribe

        self._frames = subscribe(SENSOR, address=address, kind="contacts", timeout_s=START_S)

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self._frames.close()

    def wait_for_reference(self) -> None:
        """Wait for the first frame that has something to be measured against."""
        for frame in self._frames:
            if "no_reference" not in frame.flags:
                return

    def skip(self, seconds: float) -> None:
        """Let frames pass."""
        for _ in self._during(seconds):
            pass

    def measure(
        self, scene: str, seconds: float, control: str, moves: Callable[[float], None] | None
    ) -> Phase:
        """Measure for `seconds`; `moves` is told after each frame what share has passed."""
        import numpy as np
        from tactomo_client import request

        ages_ms: list[float] = []
        tiers: dict[str, int] = {}
        begin_s = time.monotonic()
        for frame in self._during(seconds):
            ages_ms.append(frame.age_s * 1e3 - (frame.delay_ns or 0) * 1e-6)
            tiers[str(frame.tier)] = tiers.get(str(frame.tier), 0) + 1
            if moves is not None:
                moves(min(1.0, (time.monotonic() - begin_s) / seconds))
        passed_s = time.monotonic() - begin_s
        p50, p99 = np.percentile(ages_ms, (50, 99)).tolist()
        stages = request("status", control)["stage_ms"]
        return Phase(scene, len(ages_ms), len(ages_ms) / passed_s, p50, p99, stages, tiers)

    def _during(self, seconds: float) -> Iterator[Any]:
        end_s = time.monotonic() + seconds
        for frame in self._frames:
            yield frame
            if time.monotonic() >= end_s:
                return


def _spot(description: SensorDescription, place: tuple[float, float]) -> tuple[float, float]:
    """Return the millimetres of a place that is given in shares of half the sheet's size."""
    return place[0] * description.width_m * 500.0, place[1] * description.height_m * 500.0


def _print(results: Results) -> None:
    console = _console(results)
    if results.live:
        console.print(_live_table(results))
        console.print(_stage_table(results.live))
        if results.late_scans is not None:
            console.print(
                f"late scans of the twin: {results.late_scans}; "
                f"dual scans dropped by the daemon: {results.dropped_scans}"
            )
    if results.methods:
        from tactomo.cli.bench_methods import table_of

        console.print(table_of(results.methods))


def _console(results: Results) -> Console:
    """Return where to print, and say there on what everything was measured."""
    from rich.console import Console

    console = Console()
    if not console.is_terminal:  # a file has no width of its own, and the table needs one
        console = Console(width=PAGE_WIDTH)
    console.print(f"[bold]{results.machine}[/], sensor {results.description}")
    return console


def _live_table(results: Results) -> Table:
    from rich.table import Table

    table = Table(
        title=f"live, of {results.source}: last byte read to contacts in another process",
        min_width=80,
    )
    for name in ("scene", "frames/s", "p50 ms", "p99 ms", "frames by tier"):
        table.add_column(name, justify="left" if name in ("scene", "frames by tier") else "right")
    for phase in results.live:
        table.add_row(
            phase.scene,
            f"{phase.frames_per_s:.1f}",
            f"{phase.latency_p50_ms:.1f}",
            f"{phase.latency_p99_ms:.1f}",
            ", ".join(f"{tier} {count}" for tier, count in phase.tiers.items()),
        )
    return table


def _stage_table(phases: list[Phase]) -> Table:
    """Return the daemon's own account of its newest 256 frames at the end of each scene."""
    from rich.table import Table

    table = Table(title="stages of the daemon, p50 / p99 ms", min_width=80)
    table.add_column("stage")
    for phase in phases:
        table.add_column(phase.scene, justify="right")
    for stage in dict.fromkeys(stage for phase in phases for stage in phase.stage_ms):
        times = (phase.stage_ms.get(stage) for phase in phases)
        cells = (f"{t['p50']:.1f} / {t['p99']:.1f}" if t else "-" for t in times)
        table.add_row(stage, *cells)
    return table


def machine() -> str:
    """Return the processor, its cores that we may use, and the versions that matter."""
    import numpy as np
    from tactomo_models.machine_speed import processor

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{processor()}, {cores} cores, Python {platform.python_version()}, NumPy {np.__version__}"
    )


class _sockets:  # noqa: N801 - reads as a statement
    """A folder for sockets: addresses that nobody else has."""

    def __enter__(self) -> Callable[[str], str]:
        import tempfile

        self._folder = tempfile.TemporaryDirectory(prefix="tactomo-")
        return lambda name: f"ipc://{self._folder.name}/{name}"

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()


def _family() -> Family:
    from tactomo.cli.children import Family, interrupt_on_sigterm

    interrupt_on_sigterm()
    return Family()
