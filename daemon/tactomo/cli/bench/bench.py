"""`tactomo bench`: how fast everything is on this machine.

*Live*: a twin and a daemon as processes of their own; what the daemon's status says of its latency,
its stages and its memory while the twin is pressed in four ways. *Chart* is the laboratory's, see
`tactomo.cli.laboratory`.
"""

from __future__ import annotations

import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from tactomo.cli import options
from tactomo.cli.laboratory import measurement
from tactomo.cli.output import print_json, table

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

SETTLE_S: Final = 1.5
STATUS_S: Final = 13.0  # at 20 dual scans a second: as far back as the times in a status go
STEP_S: Final = 0.05
START_S: Final = 60.0
PLACES: Final = ((0.0, 0.1), (-0.45, -0.4), (0.5, -0.35))  # in shares of half the sheet's size
SCENES: Final = {
    "nothing pressed": 0,
    "one contact, still": 1,
    "one contact, sliding": 1,
    "three contacts, still": 3,
}
"""How many contacts each has."""
TOLD: Final = ("frames", "rates", "latency_ms", "stage_ms", "dropped_scans", "process")
"""What of a status is printed as JSON."""
LIVE, CHART = "Live", "Speed against accuracy"


app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo bench",
        "tactomo bench --seconds 20 --ports 1",
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
            min=1.0, rich_help_panel=LIVE, help="Seconds of each of the four live scenes."
        ),
    ] = STATUS_S,
    ports: Annotated[
        int | None,
        typer.Option(min=1, max=2, rich_help_panel=LIVE, help="Lines of the twin. [one a channel]"),
    ] = None,
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
        typer.Option(min=1, rich_help_panel=CHART, help="Still scenes each of 1 to 4 contacts."),
    ] = 10,
    method: Annotated[
        list[str] | None, options.methods_option(" [every installed one]", rich_help_panel=CHART)
    ] = None,
    as_json: options.JsonOutput = False,
) -> None:
    """Measure latency and rate on this machine, or the accuracy of methods over their time.

    Starts a twin and a daemon on free addresses, presses the twin in four ways and reads the
    daemon's status after each. A running demo is not disturbed, but shares the processor. Takes
    about a minute.

    With `--chart`, every method reconstructs simulated presses of mixed kinds on hand-made skins
    (reporting seeds): still scenes at 40, 20 and 10 dB, each from a cold start, and moving scenes,
    under budgets of 1 to 50 ms, still ones also of 2 s. Takes about a quarter of an hour, longer
    when the scenes must be simulated first.
    """
    if method and chart is None:
        raise typer.BadParameter("--method goes with --chart")
    about = {"machine": machine(), "description": description}
    if chart is not None:
        rows = measurement("chart")(description, chart, count, about["machine"], method or [])
        if as_json:
            print_json({**about, "chart": rows})
        return
    from tactomo.cli.console import Console

    with Console(stderr=True).status("starting") as line:
        live = _measure_twin(description, ports, rate, seconds, line.update)
    if as_json:
        told = {scene: {name: status[name] for name in TOLD} for scene, status in live.items()}
        print_json({**about, "live": told})
    else:
        _print(about, live)


def _measure_twin(
    description: str, ports: int | None, rate: float, seconds: float, report: Callable[[str], None]
) -> dict[str, Mapping[str, Any]]:
    """Return the daemon's status at the end of each of the scenes."""
    from tactomo_client import request
    from tactomo_models import load_description

    from tactomo.cli.children import new_family

    with tempfile.TemporaryDirectory(prefix="tactomo-") as folder, new_family() as family:
        twin, control = f"ipc://{folder}/twin", f"ipc://{folder}/control"
        sheet = load_description(description)
        described = ("--description", description)
        family.start("models build", "models", "build", *described).wait_done()
        skin = family.start(
            *("twin", "twin", *described, "--rate", str(rate)),
            *("--twin-control", twin, "--announce"),
            *([] if ports is None else ["--ports", str(ports)]),
        ).wait_ready()
        lines = [word for path in skin["ports"] for word in ("--port", path)]
        family.start(
            *("daemon", "daemon", *described, *lines),
            *("--stream", f"ipc://{folder}/stream", "--control", control),
        ).wait_ready()
        end_s = time.monotonic() + START_S
        while request("status", control)["reference"] is None and time.monotonic() < end_s:
            time.sleep(STEP_S)

        def press(number: int, place: tuple[float, float]) -> None:
            x_mm, y_mm = _spot(sheet, place)
            request("press", twin, id=str(number), x_mm=x_mm, y_mm=y_mm)

        live: dict[str, Mapping[str, Any]] = {}
        for scene, count in SCENES.items():
            report(f"live: {scene}")
            request("clear", twin)
            for number, place in enumerate(PLACES[:count]):
                press(number, place)
            begin_s, whole_s = time.monotonic(), SETTLE_S + seconds
            while (passed_s := time.monotonic() - begin_s) < whole_s:
                if "sliding" in scene:
                    press(0, (1.2 * passed_s / whole_s - 0.6, 0.2))
                time.sleep(STEP_S)
            live[scene] = request("status", control)
    return live


def _spot(description: SensorDescription, place: tuple[float, float]) -> tuple[float, float]:
    """Return the millimetres of a place that is given in shares of half the sheet's size."""
    return place[0] * description.width_m * 500.0, place[1] * description.height_m * 500.0


def _print(about: Mapping[str, str], live: Mapping[str, Mapping[str, Any]]) -> None:
    from tactomo.cli.console import page

    console = page()
    console.print(f"{about['machine']}, sensor {about['description']}")
    shown = table("p50 / p99, ms", *live, title="last byte read to publication, and its stages")
    whole = {scene: {"latency": status["latency_ms"]} for scene, status in live.items()}
    times = {scene: {**whole[scene], **status["stage_ms"]} for scene, status in live.items()}
    for stage in dict.fromkeys(stage for each in times.values() for stage in each):
        cells = (each.get(stage) for each in times.values())
        shown.add_row(stage, *(f"{t['p50']:.1f} / {t['p99']:.1f}" if t else "-" for t in cells))
    console.print(shown)
    for scene, status in live.items():
        memory_mb = (status["process"]["memory_bytes"] or 0) / 1e6
        rate_hz = status["rates"]["frames_hz"]
        console.print(f"{scene}: {rate_hz:.1f} frames/s, the daemon holds {memory_mb:.0f} MB")
    console.print(f"dual scans dropped: {status['dropped_scans']}")


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
