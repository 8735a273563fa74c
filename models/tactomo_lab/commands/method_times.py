"""The methods of `tactomo bench`: what one frame costs by every method, on one thread.

Times are that thread's processor time, so that what else runs is not counted.

All get the same simulated scans, with the twin's noise. What they stand beside:

- *bare product*: a reconstruction matrix in float64 (nodes of the map x voltages, 2601 x 208 for
  the paper's sensor) times one scan. Its p50 is the unit in which the others are given.
- *pyEIT*: its one-step solver (a product for each channel) and its Gauss-Newton (one channel; each
  step solves and differentiates anew), on a mesh with as many unknowns and with the same relative
  voltage changes.

*Cold* is a frame with none before it, worked on until it is done; *still* is a scene that stays,
in its stride; in a *moving* one the first contact slides with every frame. The last two keep to the
budget of a live daemon. What keeps nothing between frames takes the same in *any*.
"""

from __future__ import annotations

import gc
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from tactomo.cli.bench.machine_speed import warned_if_busy
from tactomo.cli.output import table
from tactomo.memory import resident_bytes, return_freed_memory
from tactomo.twin import make_skin
from tactomo.twin.device import NOISE_SHARE
from tactomo_models import (
    ModelError,
    Press,
    Reconstructor,
    Reference,
    SensorDescription,
    available_methods,
    load_description,
    load_or_build_artifact,
)
from tactomo_models.arrays import FloatArray
from tactomo_models.batch import BUDGET_S
from tactomo_models.physics.mesh import mesh_sheet
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from rich.table import Table

Row = dict[str, Any]  # see `method_times`

SAME_IN_ANY: Final = ("tikhonov", "noser", "network", "pls-paper", "cnn-single", "cnn-multimodal")
ONE_CHANNEL: Final = ("auto", "tikhonov", "noser")  # what serves a sensor without structure
# Of contacts, in shares of half the sheet's size.
PLACES: Final = ((0.0, 0.1), (-0.45, -0.4), (0.5, 0.5), (0.45, -0.45))
REFERENCE_SCANS: Final = 20
SETTLE_FRAMES: Final = 10  # before those that are timed
FRAMES: Final = 40
PRODUCTS: Final = 200
SLIDE_M: Final = 2.5e-3  # of a moving contact from frame to frame
GAUSS_NEWTON_STEPS: Final = 3  # at most


def method_times(
    name: str, methods: Sequence[str], report: Callable[[str], None]
) -> tuple[list[Row], Table]:
    """Time methods and what they are compared with.

    Returns:
        A row for each method, number of contacts and state ("cold", "still", "moving", "any"): the
        number of frames, p50 and p99 of their times (ms), how many bare products these are worth,
        what memory the method has taken by then (MB, its models included; None where nobody says),
        and if they could not be measured (None) a note why. The rows as a table to print.

    Raises ModelError where there is no such sensor.
    """
    return_freed_memory()  # else a method is measured in what the one before it has left
    report("methods: the models, pyEIT")
    description = load_description(name)
    if not methods:
        methods = available_methods() if description.structure is not None else ONE_CHANNEL
    with threadpool_limits(1), warned_if_busy():
        scenes = _Scenes(description)
        rows = [_time_product(description), *_time_pyeit(scenes)]
        for method in methods:
            report(f"methods: {method}")
            rows += _time_method(method, scenes)
    unit_ms = rows[0]["p50_ms"]
    for row in rows:
        row["of_product"] = row["p50_ms"] and row["p50_ms"] / unit_ms
        row["p99_of_product"] = row["p99_ms"] and row["p99_ms"] / unit_ms
    return rows, _table_of(rows)


class _Scenes:
    """Simulated scans of a sensor, the same ones for all methods: (n, M) volts of each channel."""

    def __init__(self, description: SensorDescription) -> None:
        self.description = description
        self._skin = make_skin(description)
        self._noise = np.random.default_rng(0)
        empty = self.still(0, REFERENCE_SCANS)
        self.reference = Reference.from_scans(empty.get("magnitude"), empty.get("structure"))
        self.rest = {channel: scans.mean(axis=0) for channel, scans in empty.items()}

    def still(self, contacts: int, frames: int) -> dict[str, FloatArray]:
        """Scans of contacts that stay."""
        return self._noisy([self._skin.voltages(self._presses(contacts))] * frames)

    def moving(self, contacts: int, frames: int) -> dict[str, FloatArray]:
        """Scans of contacts of which the first one slides, after a while at its start."""
        steps = np.maximum(np.arange(frames) - SETTLE_FRAMES, 0)
        start, *others = self._presses(contacts)
        # Back and forth across the middle third of the sheet, so that it never leaves it.
        third = self.description.width_m / 3
        offsets = third / 2 - np.abs(SLIDE_M * steps % (2 * third) - third)
        scenes = [(replace(start, x_m=start.x_m + x), *others) for x in offsets]
        return self._noisy([self._skin.voltages(presses) for presses in scenes])

    def _presses(self, contacts: int) -> list[Press]:
        x_m, y_m = self.description.width_m / 2, self.description.height_m / 2
        return [Press(x * x_m, y * y_m, 180.0, 0.2 * x_m) for x, y in PLACES[:contacts]]

    def _noisy(self, scans: Sequence[Mapping[Any, FloatArray]]) -> dict[str, FloatArray]:
        noisy: dict[str, FloatArray] = {}
        for channel in self.description.channels:
            volts = np.array([each[channel] for each in scans])
            size = NOISE_SHARE * np.abs(volts).max(axis=1, keepdims=True)
            noisy[channel] = volts + size * self._noise.standard_normal(volts.shape)
        return noisy


def _time_product(description: SensorDescription) -> Row:
    random = np.random.default_rng(1)
    nodes = description.map.nodes_x * description.map.nodes_y
    matrix = random.standard_normal((nodes, description.measurements))
    scan = random.standard_normal(description.measurements)
    return _row("bare product", 0, "any", _seconds(lambda: matrix @ scan, PRODUCTS))


def _time_method(method: str, scenes: _Scenes) -> Iterator[Row]:
    """Time a method on each scene; a frame in which nothing presses is the same by any method."""
    gc.collect()  # what the method before it has left is not this one's
    before = resident_bytes()

    def row(contacts: int, state: str, seconds: Sequence[float]) -> Row:
        now = resident_bytes()
        memory_mb = None if now is None or before is None else (now - before) / 1e6
        return {**_row(method, contacts, state, seconds), "memory_mb": memory_mb}

    try:
        reconstructor = Reconstructor(scenes.description, method=method)
        reconstructor.set_reference(scenes.reference)
        if method == "auto":
            yield row(0, "any", _frames(reconstructor, scenes.still(0, FRAMES)))
        for contacts in (1, 2, len(PLACES)):
            same = method in SAME_IN_ANY
            reconstructor.budget_s = BUDGET_S
            _frames(reconstructor, scenes.still(contacts, 1))  # makes what is kept
            seconds = _frames(reconstructor, scenes.still(contacts, FRAMES), cold=True)
            yield row(contacts, "any" if same else "cold", seconds)
            reconstructor.budget_s = None
            if contacts == len(PLACES):  # only of as many as may land at once
                return
            for state, draw in (("still", scenes.still), ("moving", scenes.moving)):
                if not same:
                    reconstructor.reset()
                    seconds = _frames(reconstructor, draw(contacts, SETTLE_FRAMES + FRAMES))
                    yield row(contacts, state, seconds[SETTLE_FRAMES:])
    except ModelError as error:  # such as a network that nobody trained for this sensor
        yield _row(method, 1, "any", note=str(error))


def _frames(
    reconstructor: Reconstructor, scans: Mapping[str, FloatArray], *, cold: bool = False
) -> list[float]:
    """Reconstruct one scan after the other, and return the seconds of each.

    Raises ModelError where a method of the user's own failed.
    """
    seconds = []
    for number in range(len(next(iter(scans.values())))):
        pair = [scans[c][number] if c in scans else None for c in ("magnitude", "structure")]
        if cold:
            reconstructor.reset()
        begin_s = time.thread_time()
        frame = reconstructor.reconstruct(*pair)
        seconds.append(time.thread_time() - begin_s)
        if frame.failure:
            raise ModelError(frame.failure)
    return seconds


def _time_pyeit(scenes: _Scenes) -> list[Row]:
    """Time pyEIT on a mesh with as many triangles as our inverse has nodes."""
    try:
        modules = ("eit.jac", "eit.protocol", "mesh.wrapper")
        jac, protocol, wrapper = (import_module(f"pyeit.{name}") for name in modules)
    except ImportError:
        return [_row("pyEIT", 1, "any", note="pip install 'tactomo[compare]'")]
    description, pattern = scenes.description, scenes.description.pattern
    nodes = load_or_build_artifact(description).tikhonov.shape[0]
    spacing_m = float(np.sqrt(2 * description.width_m * description.height_m / nodes))
    mesh = mesh_sheet(description, spacing_m, refinements=0).mesh
    (ax, ay), (bx, by), (cx, cy) = (mesh.p[:, corner] for corner in mesh.t)
    counter_clockwise = (bx - ax) * (cy - ay) > (by - ay) * (cx - ax)  # as pyEIT needs them
    triangles = np.where(counter_clockwise, mesh.t, mesh.t[[0, 2, 1]]).T
    rim = mesh.boundary_nodes()
    centres = description.electrode_ends_m.mean(axis=1)  # (L, 2)
    distance = np.linalg.norm(mesh.p[:, None, rim] - centres.T[:, :, None], axis=0)
    electrodes = rim[distance.argmin(axis=1)]
    solver = jac.JAC(
        wrapper.PyEITMesh(node=mesh.p.T, element=triangles, el_pos=electrodes),
        protocol.create(len(electrodes), pattern.drive_offset, pattern.measure_offset),
    )
    solver.setup(p=0.5, lamb=0.01, method="kotre", perm=1.0, jac_normalized=True)
    if len(solver.v0) != description.measurements:
        return [_row("pyEIT", 1, "any", note="pyEIT does not know this sensor's pattern")]
    scans = [(volts[0], scenes.rest[name]) for name, volts in scenes.still(1, 1).items()]
    step_s = _seconds(lambda: [solver.solve(*scan, normalize=True) for scan in scans], PRODUCTS)
    data, start = solver.v0 * scans[-1][0] / scans[-1][1], np.ones(len(triangles))
    with warnings.catch_warnings():  # of a model that a contrast of 100 drives far off
        warnings.simplefilter("ignore")
        newton_s = _seconds(lambda: solver.gn(data, x0=start, maxiter=GAUSS_NEWTON_STEPS), 1)
    return [
        _row("pyEIT, one step", 1, "any", step_s),
        _row("pyEIT, Gauss-Newton", 1, "any", newton_s),
    ]


def _seconds(work: Callable[[], object], times: int) -> list[float]:
    begin_s = [time.thread_time()]
    for _ in range(times):
        work()
        begin_s.append(time.thread_time())
    return np.diff(begin_s).tolist()


def _row(
    method: str, contacts: int, state: str, seconds: Sequence[float] = (), note: str = ""
) -> Row:
    row: Row = {"method": method, "contacts": contacts, "state": state, "frames": len(seconds)}
    p50, p99 = 1e3 * np.percentile(seconds, (50, 99)) if seconds else (None, None)
    times = {"p50_ms": p50 and float(p50), "p99_ms": p99 and float(p99)}
    return {**row, **times, "memory_mb": None, "note": note}


def _table_of(rows: Sequence[Row]) -> Table:
    made = table(
        *("method", "contacts", "scene", "p50 products", "p99 products", "p50 ms", "p99 ms", "MB"),
        *("frames", "note"),
        left=("scene", "note"),
        title="one frame, processor time of one thread; products: times the p50 of a bare product",
    )
    for row in rows:
        keys = ("of_product", "p99_of_product", "p50_ms", "p99_ms", "memory_mb")
        times = [row[key] for key in keys]
        # Three significant digits, thousands apart, and no power of ten.
        shown = ["" if t is None else f"{t:,.0f}" if t >= 100 else f"{t:.3g}" for t in times]
        what = (row["method"], str(row["contacts"]), row["state"])
        made.add_row(*what, *shown, str(row["frames"] or ""), row["note"])
    return made
