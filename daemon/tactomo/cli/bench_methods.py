"""The methods part of `tactomo bench`: what one frame costs by every method, on one thread.

All get the same simulated scans of both channels, with the twin's noise. What they stand beside:

- *bare product*: a reconstruction matrix in double precision (nodes x voltages) times a scan, once
  for each channel. No method that makes an image of as many nodes can be much cheaper.
- *pls-paper*: the paper's own level set, cold, on this machine.
- *pyEIT*: its one-step solver (a product for each channel) and its Gauss-Newton, which solves and
  differentiates its model anew in each step, on a mesh with as many unknowns (its are triangles)
  and with the same relative voltage changes. Gauss-Newton images one channel only.

*Cold* is a frame with none before it, worked on until it is done; *warm* is a still scene in its
stride; in a *moving* one the first contact slides with every frame. The last two keep to the
budget of a live daemon. What keeps nothing between frames (linear methods, networks, pls-paper)
takes the same in *any*.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from tactomo_models import (
    METHODS,
    ModelError,
    Press,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
    Tier,
    load_description,
    load_or_build_artifact,
)
from tactomo_models.batch import BUDGET_S
from tactomo_models.evaluation.measures import DISTRUST
from tactomo_models.evaluation.trade_off import BUDGETED
from tactomo_models.mesh import mesh_sheet
from tactomo_models.tier import LINEAR
from threadpoolctl import threadpool_limits

from tactomo.twin import make_skin
from tactomo.twin.device import NOISE_SHARE

if TYPE_CHECKING:
    from rich.table import Table

FloatArray = NDArray[np.float64]
Scans = Mapping[str, FloatArray]  # (n, M) volts of each channel
Tell = Callable[[str], None]

PRODUCT: Final = "bare product"
PYEIT_STEP: Final = "pyEIT, one step"
PYEIT_GN: Final = "pyEIT, Gauss-Newton"
HOW_TO_GET_PYEIT: Final = "pip install 'tactomo[compare]'"

# Places in shares of half the sheet's size, all of them within a disc, too.
PLACES: Final = ((0.0, 0.1), (-0.45, -0.4), (0.5, -0.35), (0.1, 0.55))
CONTACTS: Final = (1, 2)
REFERENCE_SCANS: Final = 20
SETTLE_FRAMES: Final = 10
FRAMES: Final = 20
FAST_FRAMES: Final = 200  # of what takes less than
FAST_S: Final = 0.005
SLIDE_M: Final = 2.5e-3  # of a moving contact from frame to frame
GAUSS_NEWTON_STEPS: Final = 3  # at most


@dataclass(frozen=True)
class MethodTime:
    """What one method costs for a frame of one scene.

    Attributes:
        method: its name.
        contacts: how many press.
        state: "cold", "warm", "moving", or "any" where a method keeps nothing between frames.
        frames: how many were timed.
        p50_ms, p99_ms: of their times; None if it could not be measured.
        flagged: share of them whose image was flagged as not to be trusted.
        stage_ms: median time of each stage.
        of_product: how many bare products its p50 is worth.
        of_paper: how many times pls-paper's p50 is that of this one, same scene.
        of_pyeit: likewise of pyEIT's Gauss-Newton.
        note: why it could not be measured.
    """

    method: str
    contacts: int
    state: str
    frames: int = 0
    p50_ms: float | None = None
    p99_ms: float | None = None
    flagged: float | None = None
    stage_ms: dict[str, float] = field(default_factory=dict)
    of_product: float | None = None
    of_paper: float | None = None
    of_pyeit: float | None = None
    note: str = ""


def measure_methods(name: str, tell: Tell) -> list[MethodTime]:
    """Time every method and what it is compared with; `tell` hears what is going on."""
    tell("methods: building the models")
    description = load_description(name)
    with threadpool_limits(1):
        scenes = _Scenes(description)
        rows = [_time_product(description, scenes)]
        tell("methods: pyEIT")
        rows += _time_pyeit(description, scenes)
        rows += _time_ours(description, scenes, tell)
    return _with_ratios(rows)


class _Scenes:
    """Simulated scans, the same ones for all methods."""

    def __init__(self, description: SensorDescription) -> None:
        self._description = description
        self._skin: SkinSimulator = make_skin(description)
        self._noise = np.random.default_rng(0)
        empty = self._scans([()] * REFERENCE_SCANS)
        self.reference = Reference.from_scans(empty.get("magnitude"), empty.get("structure"))
        self.rest = {name: scans.mean(axis=0) for name, scans in empty.items()}

    def still(self, contacts: int, frames: int) -> Scans:
        """Scans of contacts that stay."""
        return self._scans([self._presses(contacts)] * frames)

    def moving(self, contacts: int, frames: int) -> Scans:
        """Scans of contacts of which the first one slides, after a while at its start."""
        steps = np.maximum(np.arange(frames) - SETTLE_FRAMES, 0)
        start, *others = self._presses(contacts)
        # Back and forth across the middle third of the sheet, so that it never leaves it.
        third = self._description.width_m / 3
        offsets = third / 2 - np.abs(SLIDE_M * steps % (2 * third) - third)
        return self._scans([(replace(start, x_m=start.x_m + x), *others) for x in offsets])

    def _presses(self, contacts: int) -> tuple[Press, ...]:
        half = np.array([self._description.width_m, self._description.height_m]) / 2
        radius_m = 0.1 * self._description.width_m
        spots = half * np.array(PLACES[:contacts]).reshape(-1, 2)
        return tuple(Press(float(x), float(y), 180.0, radius_m) for x, y in spots)

    def _scans(self, scenes: Sequence[tuple[Press, ...]]) -> Scans:
        clean = [self._skin.voltages(presses) for presses in scenes]
        return {
            name: np.array([self._noisy(volts[name]) for volts in clean])
            for name in self._description.modalities
        }

    def _noisy(self, volts: FloatArray) -> FloatArray:
        size = NOISE_SHARE * np.abs(volts).max()
        return np.asarray(volts + size * self._noise.standard_normal(len(volts)))


def _time_product(description: SensorDescription, scenes: _Scenes) -> MethodTime:
    shape = load_or_build_artifact(description).tikhonov.shape
    random = np.random.default_rng(1)
    matrices = [random.standard_normal(shape) for _ in description.modalities]
    scans = list(scenes.rest.values())

    def products(_: int) -> None:
        for matrix, scan in zip(matrices, scans, strict=True):
            matrix @ scan

    return _row(PRODUCT, 0, "any", [_seconds(products, n) for n in range(FAST_FRAMES)])


def _time_ours(description: SensorDescription, scenes: _Scenes, tell: Tell) -> Iterator[MethodTime]:
    reconstructor = Reconstructor(description)
    reconstructor.set_reference(scenes.reference)
    both = description.structure is not None
    for method in METHODS if both else (*LINEAR, Tier.AUTO):
        for contacts in (0, *CONTACTS) if method is Tier.AUTO else CONTACTS:
            tell(f"methods: {method}, {contacts} contact(s)")
            try:
                reconstructor.tier = method
                yield from _time_method(reconstructor, scenes, contacts)
            except ModelError as error:  # a network that nobody trained for this sensor
                yield MethodTime(str(method), contacts, "any", note=str(error))


def _time_method(
    reconstructor: Reconstructor, scenes: _Scenes, contacts: int
) -> Iterator[MethodTime]:
    if contacts and reconstructor.tier in BUDGETED:
        yield _time_cold(reconstructor, scenes, contacts)
        yield _time_on(reconstructor, "warm", contacts, scenes.still)
        yield _time_on(reconstructor, "moving", contacts, scenes.moving)
    else:
        yield from _time_any(reconstructor, scenes, contacts)


def _time_any(reconstructor: Reconstructor, scenes: _Scenes, contacts: int) -> Iterator[MethodTime]:
    """Time frames of what starts anew in each of them, and of linear methods the image alone."""
    method = reconstructor.tier
    ((first_s, _),) = _frames(reconstructor, scenes.still(contacts, 1))  # makes what is kept
    frames = FAST_FRAMES if first_s < FAST_S else FRAMES
    timed = list(_frames(reconstructor, scenes.still(contacts, frames), cold=True))
    yield _frames_row(method, contacts, "any", timed)
    if method in LINEAR:
        images = [frame.stage_s[method] for _, frame in timed]
        yield _row(f"{method}, image alone", contacts, "any", images)


def _time_cold(reconstructor: Reconstructor, scenes: _Scenes, contacts: int) -> MethodTime:
    reconstructor.budget_s = BUDGET_S
    timed = list(_frames(reconstructor, scenes.still(contacts, FRAMES), cold=True))
    reconstructor.budget_s = None
    return _frames_row(reconstructor.tier, contacts, "cold", timed)


def _time_on(
    reconstructor: Reconstructor, state: str, contacts: int, scans: Callable[[int, int], Scans]
) -> MethodTime:
    reconstructor.reset()
    timed = list(_frames(reconstructor, scans(contacts, SETTLE_FRAMES + FRAMES)))
    return _frames_row(reconstructor.tier, contacts, state, timed[SETTLE_FRAMES:])


def _frames(
    reconstructor: Reconstructor, scans: Scans, *, cold: bool = False
) -> Iterator[tuple[float, Reconstruction]]:
    """Reconstruct one scan after the other: seconds, and what came out."""
    for number in range(len(next(iter(scans.values())))):
        magnitude, structure = (
            scans[name][number] if name in scans else None for name in ("magnitude", "structure")
        )
        if cold:
            reconstructor.reset()
        begin_s = time.perf_counter()
        frame = reconstructor.reconstruct(magnitude, structure)
        yield time.perf_counter() - begin_s, frame


def _time_pyeit(description: SensorDescription, scenes: _Scenes) -> Iterator[MethodTime]:
    try:
        solver = _pyeit(description)
        known = len(solver.v0) == description.measurements
        note = "" if known else "pyEIT does not know this sensor's pattern"
    except ImportError:
        note = HOW_TO_GET_PYEIT
    for contacts in CONTACTS:
        if note:
            yield MethodTime(PYEIT_STEP, contacts, "any", note=note)
            yield MethodTime(PYEIT_GN, contacts, "any", note=note)
        else:
            yield from _time_pyeit_on(solver, scenes, contacts)


def _time_pyeit_on(solver: Any, scenes: _Scenes, contacts: int) -> Iterator[MethodTime]:
    scans = scenes.still(contacts, FAST_FRAMES)

    def step(number: int) -> None:
        for name, volts in scans.items():
            solver.solve(volts[number], scenes.rest[name], normalize=True)

    yield _row(PYEIT_STEP, contacts, "any", [_seconds(step, n) for n in range(FAST_FRAMES)])
    name, volts = list(scans.items())[-1]
    data = solver.v0 * volts[0] / scenes.rest[name]

    def gauss_newton(_: int) -> None:
        with warnings.catch_warnings():  # of a model that a contrast of 100 drives far off
            warnings.simplefilter("ignore")
            solver.gn(data, x0=np.ones(solver.mesh.n_elems), maxiter=GAUSS_NEWTON_STEPS)

    yield _row(PYEIT_GN, contacts, "any", [_seconds(gauss_newton, 0)])


def _pyeit(description: SensorDescription) -> Any:
    """Set pyEIT's solver up on a mesh with as many triangles as our inverse has nodes.

    Raises:
        ImportError: pyEIT is not installed.
    """
    jac = import_module("pyeit.eit.jac")
    protocol = import_module("pyeit.eit.protocol")
    wrapper = import_module("pyeit.mesh.wrapper")
    nodes = load_or_build_artifact(description).tikhonov.shape[0]
    spacing_m = float(np.sqrt(2 * description.width_m * description.height_m / nodes))
    mesh = mesh_sheet(description, spacing_m, refinements=0).mesh
    rim = mesh.boundary_nodes()
    centres = description.electrode_ends_m.mean(axis=1)  # (L, 2)
    distance = np.linalg.norm(mesh.p[:, None, rim] - centres.T[:, :, None], axis=0)
    solver = jac.JAC(
        wrapper.PyEITMesh(
            node=mesh.p.T,
            element=_counter_clockwise(mesh.p, mesh.t).T,
            el_pos=rim[distance.argmin(axis=1)],
        ),
        protocol.create(
            description.electrode_count,
            dist_exc=description.pattern.drive_offset,
            step_meas=description.pattern.measure_offset,
        ),
    )
    solver.setup(p=0.5, lamb=0.01, method="kotre", perm=1.0, jac_normalized=True)
    return solver


def _counter_clockwise(points: FloatArray, triangles: NDArray[np.intp]) -> NDArray[np.intp]:
    """Triangles (3, T) in the order of corners that pyEIT needs."""
    a, b, c = points[:, triangles[0]], points[:, triangles[1]], points[:, triangles[2]]
    (ux, uy), (vx, vy) = b - a, c - a
    return np.where(ux * vy > uy * vx, triangles, triangles[[0, 2, 1]])


def _seconds(work: Callable[[int], None], number: int) -> float:
    begin_s = time.perf_counter()
    work(number)
    return time.perf_counter() - begin_s


def _frames_row(
    method: str, contacts: int, state: str, timed: Sequence[tuple[float, Reconstruction]]
) -> MethodTime:
    stages = dict.fromkeys(stage for _, frame in timed for stage in frame.stage_s)
    spent = {s: [1e3 * frame.stage_s.get(s, 0.0) for _, frame in timed] for s in stages}
    return replace(
        _row(method, contacts, state, [seconds for seconds, _ in timed]),
        flagged=float(np.mean([bool(frame.flags & DISTRUST) for _, frame in timed])),
        stage_ms={str(s): float(np.median(times)) for s, times in spent.items()},
    )


def _row(method: str, contacts: int, state: str, seconds: Sequence[float]) -> MethodTime:
    p50, p99 = (1e3 * np.percentile(seconds, (50, 99))).tolist()
    return MethodTime(str(method), contacts, state, len(seconds), p50, p99)


def _with_ratios(rows: Sequence[MethodTime]) -> list[MethodTime]:
    def p50_ms(method: str, contacts: int) -> float | None:
        found = (r.p50_ms for r in rows if r.method == method and r.contacts in (contacts, 0))
        return next(found, None)

    return [
        replace(
            row,
            of_product=_ratio(row.p50_ms, p50_ms(PRODUCT, row.contacts)),
            of_paper=_ratio(p50_ms(Tier.PLS_PAPER, row.contacts), row.p50_ms),
            of_pyeit=_ratio(p50_ms(PYEIT_GN, row.contacts), row.p50_ms),
        )
        for method in dict.fromkeys(row.method for row in rows)
        for row in rows
        if row.method == method
    ]


def _ratio(over: float | None, under: float | None) -> float | None:
    return None if over is None or under is None else over / under


def table_of(rows: Sequence[MethodTime]) -> Table:
    """Lay the rows out, ratios first: of p50 to the product's, and of the others' p50 to it."""
    from rich.table import Table

    table = Table(title="one frame, one thread; ratios of p50")
    columns = (
        *("method", "contacts", "scene", "/ product", "pls-paper /", "pyEIT GN /"),
        *("p50 ms", "p99 ms", "frames", "flagged", "stages, p50 ms"),
    )
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number in (0, 2, 10) else "right")
    last: Any = None
    for row in rows:
        if last not in (None, row.method):
            table.add_section()
        last = row.method
        stages = ", ".join(f"{stage} {_short(ms)}" for stage, ms in row.stage_ms.items())
        ratios = (row.of_product, row.of_paper, row.of_pyeit)
        table.add_row(
            *(row.method, str(row.contacts), row.state),
            *("" if ratio is None else f"{_short(ratio)} x" for ratio in ratios),
            *("" if ms is None else _short(ms) for ms in (row.p50_ms, row.p99_ms)),
            str(row.frames) if row.frames else "",
            "" if row.flagged is None else f"{row.flagged:.0%}",
            stages or row.note,
        )
    return table


def _short(value: float) -> str:
    """Three significant digits, thousands apart, and no power of ten."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
