"""`tactomo evaluate solves`: what one solve of the forward model costs, and what the cost goes by.

Three series, each beside a sparse factorisation of the whole sheet. *area*: contacts of growing
size on the sensor's own mesh. *mesh*: one contact on finer and finer meshes. *sheet*: the same
contact and mesh on larger and larger sheets. In the last two only the inner quarter of the sheet
can be pressed, so that its Green's function fits into memory.

Times are this thread's processor time, the median of several runs, BLAS on one thread.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from tactomo.cli.options import DEFAULT_DESCRIPTION, Description, JsonOutput, examples, typer_app
from tactomo.cli.output import print_json, table

if TYPE_CHECKING:
    from tactomo_models import SensorDescription

RADII = (0.04, 0.08, 0.13, 0.2, 0.27, 0.4, 0.53)  # of a contact, over half the sheet's smaller side
RADIUS = 0.2  # where the mesh or the sheet grows
FINER = (0.75, 1.0, 1.2, 1.5, 2.0)  # nodes along a side, over the shipped mesh's
LARGER = (1.0, 1.4, 2.0, 2.8)  # over the sensor's own sheet
PARAMETERS = 7  # of one elliptic contact and the ratio: what a Jacobian is taken by
ENOUGH_S = 0.2
RUNS = (5, 51)


@dataclass(frozen=True)
class Row:
    """What solving for one contact costs; `sparse_ms` leaves the whole sheet's assembly out."""

    series: str
    sheet_mm: float
    spacing_mm: float
    sheet_nodes: int
    pressed_mm2: float
    rim_nodes: int
    solve_ms: float
    jacobian_ms: float
    sparse_ms: float


app = typer_app()


@app.command(
    epilog=examples("tactomo evaluate solves", "tactomo evaluate solves --json > solves.json")
)
def solves(
    description: Description = DEFAULT_DESCRIPTION,
    as_json: JsonOutput = False,
) -> None:
    """Measure one forward solve against pressed area, mesh and sheet size. Takes about a minute."""
    from tactomo.cli.bench.bench import machine
    from tactomo.cli.console import Console
    from tactomo_models import load_description
    from threadpoolctl import threadpool_limits

    sensor = load_description(description)
    with Console(stderr=True).status("solving"), threadpool_limits(1):
        rows = list(_rows(sensor))
    if as_json:
        told = {"machine": machine(), "description": description}
        print_json({**told, "rows": [asdict(row) for row in rows]})
        return
    numbered = (name.replace("_", " ") for name in asdict(rows[0]) if "_" in name)
    title = f"one forward solve, {description}, one thread of {machine()}"
    shown = table("series", "sparse / solve", *numbered, title=title)
    for row in rows:
        numbers = [value for value in asdict(row).values() if not isinstance(value, str)]
        ratio = f"{row.sparse_ms / row.solve_ms:.1f}"
        shown.add_row(row.series, ratio, *(f"{number:.3g}" for number in numbers))
    Console().print(shown)


def _rows(sensor: SensorDescription) -> Iterator[Row]:
    spacing_m = sensor.width_m / (sensor.map.nodes_x - 1)  # as shipped
    measure = _on_sheet("area", sensor, spacing_m)
    yield from map(measure, RADII)
    for finer in FINER:
        yield _on_sheet("mesh", _pressable_in_the_middle(sensor), spacing_m / finer)(RADIUS)
    for larger in LARGER:
        sheet = _pressable_in_the_middle(sensor, larger)
        yield _on_sheet("sheet", sheet, spacing_m)(RADIUS / larger)


def _pressable_in_the_middle(sensor: SensorDescription, larger: float = 1.0) -> SensorDescription:
    """Return a sensor on a larger sheet, its frame as wide as a description allows."""
    from tactomo_models import SensorDescription

    raw = sensor.model_dump(by_alias=True, exclude_none=True)
    for key in ("width_m", "height_m"):
        if key in raw["sheet"]:
            raw["sheet"][key] *= larger
    if "pitch_m" in raw["electrodes"]:
        raw["electrodes"]["pitch_m"] = [larger * pitch for pitch in sensor.electrodes.pitches_m]
    raw["sheet"]["frame_width_m"] = 0.249 * larger * min(sensor.width_m, sensor.height_m)
    return SensorDescription.model_validate(raw)


def _on_sheet(series: str, sensor: SensorDescription, spacing_m: float) -> Callable[[float], Row]:
    """Mesh and solve a bare sheet; return what measures a contact in its middle.

    A contact's radius is a share of half of the sheet's smaller side.
    """
    import numpy as np
    from tactomo_models import Press
    from tactomo_models.physics.artifact import INVERSE_REFINEMENTS
    from tactomo_models.physics.bare_sheet import (
        assemble_sheet,
        solve_bare_sheet,
        transfer_resistances,
    )
    from tactomo_models.physics.forward import ForwardModel
    from tactomo_models.physics.mesh import mesh_sheet

    sheet = mesh_sheet(sensor, spacing_m, INVERSE_REFINEMENTS)
    forward = ForwardModel(sensor, solve_bare_sheet(sensor, sheet))
    bare = forward.bare
    x, y = bare.points[:, bare.pressable]
    contrast = sensor.structure.saturated_ratio if sensor.structure else 100.0

    def measure(radius: float) -> Row:
        press = Press(0.0, 0.0, 1.0, radius * min(sensor.width_m, sensor.height_m) / 2)
        change = contrast ** press.coverage(x, y, spacing_m) - 1
        elsewhere = np.eye(1, len(x))[0]  # what is known of the last area helps with that one only
        solution = forward.solve(change)
        where = np.flatnonzero(change)
        onto = np.random.default_rng(0).standard_normal((len(where), PARAMETERS))
        nodal = np.ones(bare.points.shape[1])
        nodal[bare.pressable] += change
        by_triangle = nodal[bare.triangles].mean(axis=0)
        whole_ms = _time_ms(lambda: transfer_resistances(sensor, sheet, by_triangle))
        assembly_ms = _time_ms(lambda: assemble_sheet(sensor, sheet, by_triangle))
        return Row(
            series=series,
            sheet_mm=sensor.width_m * 1e3,
            spacing_mm=spacing_m * 1e3,
            sheet_nodes=bare.points.shape[1],
            pressed_mm2=np.pi * press.radius_m**2 * 1e6,
            rim_nodes=len(solution.rim),
            solve_ms=_time_ms(lambda: forward.solve(change), lambda: forward.solve(elsewhere)),
            jacobian_ms=_time_ms(lambda: forward.jacobian(solution, where, onto)),
            sparse_ms=whole_ms - assembly_ms,
        )

    return measure


def _time_ms(what: Callable[[], Any], before: Callable[[], Any] = lambda: None) -> float:
    """Return the median time of a call; what comes before each is not counted."""
    times: list[float] = []
    fewest, most = RUNS
    while len(times) < fewest or (sum(times) < ENOUGH_S and len(times) < most):
        before()
        begin_s = time.thread_time()
        what()
        times.append(time.thread_time() - begin_s)
    return statistics.median(times) * 1e3
