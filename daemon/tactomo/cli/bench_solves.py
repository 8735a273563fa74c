"""`tactomo bench-solves`: what one solve of the forward model costs, and what it goes by.

Three series, each beside a sparse factorisation of the whole sheet in the same run. *area*:
contacts of growing size on the sensor's own mesh. *mesh*: one contact on finer and finer meshes.
*sheet*: the same contact and mesh on larger and larger sheets. In the last two only the inner
quarter of the sheet can be pressed, so that its Green's function fits into memory.

Times are this thread's processor time, the median of several runs, BLAS on one thread.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.cli.app import BUILD, DEFAULT_DESCRIPTION, Description, JsonOutput, app, examples
from tactomo.cli.plot import prepare_picture, save_figure

if TYPE_CHECKING:
    from rich.table import Table
    from tactomo_models import SensorDescription
    from tactomo_models.forward import ForwardModel
    from tactomo_models.mesh import SheetMesh

RADII = (0.04, 0.08, 0.13, 0.2, 0.27, 0.4, 0.53)  # of a contact, over half the sheet's smaller side
FOUR = ((-0.45, -0.45), (0.45, -0.45), (-0.45, 0.45), (0.45, 0.45))  # places, over half the sides
RADIUS = 0.2
FINER = (0.75, 1.0, 1.2, 1.5, 2.0)  # nodes along a side, over the shipped mesh's
LARGER = (1.0, 1.4, 2.0, 2.8)  # over the sensor's own sheet
PARAMETERS = 7  # of one elliptic contact and the ratio: what a Jacobian is taken by
ENOUGH_S = 0.2
RUNS = (5, 51)


@dataclass(frozen=True)
class Row:
    """What solving for one scene costs.

    Attributes:
        series: area, mesh or sheet.
        sheet_mm: width of the sheet.
        spacing_mm: distance of the mesh's nodes.
        sheet_nodes: nodes of the whole mesh.
        contacts: how many contacts are pressed.
        pressed_mm2: their area.
        changed_nodes: nodes of the triangles that changed.
        rim_nodes: unknowns of the dense system.
        solve_ms: one solve.
        again_ms: one solve more for the same area, pressed harder.
        jacobian_ms: the Jacobian by a few parameters, after a solve.
        sparse_ms: sparse factorisation and solution of the whole sheet, its assembly not counted.
        assembly_ms: that assembly.
    """

    series: str
    sheet_mm: float
    spacing_mm: float
    sheet_nodes: int
    contacts: int
    pressed_mm2: float
    changed_nodes: int
    rim_nodes: int
    solve_ms: float
    again_ms: float
    jacobian_ms: float
    sparse_ms: float
    assembly_ms: float


@dataclass
class Curves:
    """Everything that was measured, and on what."""

    machine: str
    description: str
    rows: list[Row] = field(default_factory=list)


@app.command(
    "bench-solves",
    rich_help_panel=BUILD,
    epilog=examples(
        "tactomo bench-solves",
        "tactomo bench-solves --picture solves.png",
        "tactomo bench-solves --json > solves.json",
    ),
)
def bench_solves(
    description: Description = DEFAULT_DESCRIPTION,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the curves, too: .png, .svg or .pdf.")
    ] = None,
    as_json: JsonOutput = False,
) -> None:
    """Measure one forward solve against pressed area, mesh and sheet size.

    Everything beside a sparse factorisation of the whole sheet. Takes about a minute. A picture
    needs matplotlib: `pip install 'tactomo[plot]'`.
    """
    from rich.console import Console
    from tactomo_models import load_description
    from threadpoolctl import threadpool_limits

    from tactomo.cli.bench import machine

    if picture is not None:
        prepare_picture(picture)
    sensor = load_description(description)
    curves = Curves(machine(), description)
    with Console(stderr=True).status("starting") as shown, threadpool_limits(1):
        for series in (_by_area, _by_mesh, _by_sheet):
            curves.rows += series(sensor, shown.update)
    if as_json:
        typer.echo(json.dumps(asdict(curves), indent=2))
    else:
        console = Console()
        console.print(f"[bold]{curves.machine}[/], sensor {curves.description}, one thread")
        console.print(_table(curves.rows))
    if picture is not None:
        _draw(curves, picture)


Tell = Callable[[str], None]


def _by_area(sensor: SensorDescription, tell: Tell) -> Iterator[Row]:
    tell("area: building the model")
    scene = _Scene.build("area", sensor, spacing_m=None)
    tell("area: solving")
    for radius in RADII:
        yield scene.measure(radius, ((0.0, 0.0),))
    for radius in (share for share in RADII if share < FOUR[-1][0]):
        yield scene.measure(radius, FOUR)


def _by_mesh(sensor: SensorDescription, tell: Tell) -> Iterator[Row]:
    shipped_m = sensor.width_m / (sensor.map.nodes_x - 1)
    for finer in FINER:
        tell(f"mesh: {shipped_m / finer * 1e3:.2g} mm")
        yield _Scene.build("mesh", _pressable_in_the_middle(sensor), shipped_m / finer).measure(
            RADIUS, ((0.0, 0.0),)
        )


def _by_sheet(sensor: SensorDescription, tell: Tell) -> Iterator[Row]:
    spacing_m = sensor.width_m / (sensor.map.nodes_x - 1)
    for larger in LARGER:
        tell(f"sheet: {larger:g} times as wide")
        sheet = _pressable_in_the_middle(sensor, larger)
        yield _Scene.build("sheet", sheet, spacing_m).measure(RADIUS / larger, ((0.0, 0.0),))


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


@dataclass(frozen=True)
class _Scene:
    """A meshed and solved sheet on which contacts are pressed."""

    series: str
    sensor: SensorDescription
    sheet: SheetMesh
    forward: ForwardModel
    spacing_m: float

    @classmethod
    def build(cls, series: str, sensor: SensorDescription, spacing_m: float | None) -> _Scene:
        from tactomo_models.artifact import INVERSE_REFINEMENTS
        from tactomo_models.bare_sheet import solve_bare_sheet
        from tactomo_models.forward import ForwardModel
        from tactomo_models.mesh import mesh_sheet

        sheet = mesh_sheet(sensor, spacing_m, INVERSE_REFINEMENTS)
        forward = ForwardModel(sensor, solve_bare_sheet(sensor, sheet))
        shipped_m = sensor.width_m / (sensor.map.nodes_x - 1)
        return cls(series, sensor, sheet, forward, spacing_m or shipped_m)

    def measure(self, radius: float, places: tuple[tuple[float, float], ...]) -> Row:
        import numpy as np
        from tactomo_models import Press
        from tactomo_models.bare_sheet import assemble_sheet, transfer_resistances

        forward, bare = self.forward, self.forward.bare
        half_m = np.array([self.sensor.width_m, self.sensor.height_m]) / 2
        x, y = bare.points[:, bare.pressable]
        radius_m = radius * half_m.min()
        pressed = np.zeros(len(x))
        for place_m in np.array(places) * half_m:
            press = Press(place_m[0], place_m[1], 1.0, radius_m)
            pressed = np.maximum(pressed, press.coverage(x, y, self.spacing_m))
        structure = self.sensor.structure
        change = (structure.saturated_ratio if structure else 100.0) ** pressed - 1
        elsewhere = np.eye(1, len(x))[0]  # what is known of the last area helps with that one only
        solution = forward.solve(change)
        where = np.flatnonzero(change)
        onto = np.random.default_rng(0).standard_normal((len(where), PARAMETERS))
        nodal = np.ones(bare.points.shape[1])
        nodal[bare.pressable] += change
        by_triangle = nodal[bare.triangles].mean(axis=0)
        assembly_ms = _time_ms(lambda: assemble_sheet(self.sensor, self.sheet, by_triangle))
        direct_ms = _time_ms(lambda: transfer_resistances(self.sensor, self.sheet, by_triangle))
        return Row(
            series=self.series,
            sheet_mm=self.sensor.width_m * 1e3,
            spacing_mm=self.spacing_m * 1e3,
            sheet_nodes=bare.points.shape[1],
            contacts=len(places),
            pressed_mm2=len(places) * np.pi * radius_m**2 * 1e6,
            changed_nodes=len(solution.nodes),
            rim_nodes=len(solution.rim),
            solve_ms=_time_ms(lambda: forward.solve(change), lambda: forward.solve(elsewhere)),
            again_ms=_time_ms(lambda: forward.solve(1.1 * change)),
            jacobian_ms=_time_ms(lambda: forward.jacobian(solution, where, onto)),
            sparse_ms=direct_ms - assembly_ms,
            assembly_ms=assembly_ms,
        )


def _time_ms(what: Callable[[], Any], before: Callable[[], Any] = lambda: None) -> float:
    """Return the median time of a call; what comes before each is not counted."""
    import statistics

    times: list[float] = []
    fewest, most = RUNS
    while len(times) < fewest or (sum(times) < ENOUGH_S and len(times) < most):
        before()
        begin_s = time.thread_time()
        what()
        times.append(time.thread_time() - begin_s)
    return statistics.median(times) * 1e3


def _table(rows: list[Row]) -> Table:
    from rich.table import Table

    table = Table(title="one forward solve against a sparse factorisation of the whole sheet")
    for name in (
        *(
            "series",
            "sparse / solve",
            "solve ms",
            "again ms",
            "Jacobian ms",
            "sparse ms",
            "assembly ms",
        ),
        *("contacts", "pressed mm²", "changed nodes", "rim nodes"),
        *("sheet mm", "spacing mm", "sheet nodes"),
    ):
        table.add_column(name, justify="left" if name == "series" else "right")
    before = rows[0].series
    for row in rows:
        if row.series != before:
            table.add_section()
        before = row.series
        times = (row.solve_ms, row.again_ms, row.jacobian_ms, row.sparse_ms, row.assembly_ms)
        table.add_row(
            row.series,
            f"{row.sparse_ms / row.solve_ms:.1f}",
            *(f"{ms:.2f}" for ms in times),
            str(row.contacts),
            f"{row.pressed_mm2:.0f}",
            str(row.changed_nodes),
            str(row.rim_nodes),
            f"{row.sheet_mm:.0f}",
            f"{row.spacing_mm:.2g}",
            str(row.sheet_nodes),
        )
    return table


def _draw(curves: Curves, output: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    figure.suptitle(f"one forward solve, {curves.description}, one thread of {curves.machine}")
    panels: Any = figure.subplots(1, 3, sharey=True)
    for axes, series, along, label in zip(
        panels,
        ("area", "mesh", "sheet"),
        ("pressed_mm2", "sheet_nodes", "sheet_nodes"),
        (
            "pressed area (mm²)",
            "nodes, one contact, finer mesh",
            "nodes, one contact, larger sheet",
        ),
        strict=True,
    ):
        rows = [row for row in curves.rows if row.series == series]
        for contacts in sorted({row.contacts for row in rows}):
            _draw_series(axes, [row for row in rows if row.contacts == contacts], along)
        axes.set(xlabel=label, xscale="log", yscale="log")
        axes.grid(visible=True, which="both", alpha=0.2)
    panels[0].set_ylabel("ms")
    panels[0].legend(fontsize=7)
    save_figure(figure, output)


def _draw_series(axes: Any, rows: list[Row], along: str) -> None:
    contacts = rows[0].contacts
    one = contacts == 1
    x = [getattr(row, along) for row in rows]
    solve = [row.solve_ms for row in rows]
    both = [row.solve_ms + row.jacobian_ms for row in rows]
    style = "-" if one else "--"
    of = "" if one else f", {contacts} contacts"
    axes.plot(x, solve, "o" + style, color="C0", markersize=3, label=f"solve{of}")
    axes.plot(x, both, "o" + style, color="C1", markersize=3, label=f"solve and Jacobian{of}")
    if one:
        sparse = [row.sparse_ms for row in rows]
        axes.plot(x, sparse, "s-", color="0.5", markersize=3, label="sparse factorisation")
