"""A case: what presses frame after frame, on which skin, and what a device makes of its voltages.

A `Plan` is drawn from a seed. It is simulated without noise, which takes half a second a frame and
is kept in the user's cache; noise is added afterwards, so that one simulation serves every
signal-to-noise ratio. The `Case` is what is reconstructed (`evaluation.play`).
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Literal

import numpy as np
from tactomo_models.archive import read_arrays, write_whole
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.physics.artifact import cache_folder
from tactomo_models.physics.mesh import SheetMesh
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.press import Press
from tactomo_models.sensor.companion import Companion
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.scenes.drawing import (
    BOTH_CHANNELS,
    GAP_M,
    SHAPES,
    SeedSet,
    can_be_opposite,
    draw_contrast,
    draw_indenter,
    placed_apart,
    seed_of,
)
from tactomo_lab.scenes.simulation import (
    AS_MADE,
    IMPEDANCE_DEVIATION,
    UNEVENNESS,
    SheetState,
    Truth,
    UnevenSkin,
    Volts,
    displaced,
    fine_mesh,
    truth_of,
    with_contrast,
    with_opposite_magnitude,
)

SnrOf = Literal["voltage", "change"]
Reading = Callable[[int, float], float]

SIMULATION = 4  # raise it when `simulation` changes: what it stored before is not read
REFERENCE_SCANS = 20  # as a tare takes
LOAD_CELL_N = 0.05  # noise of a load cell, 1/4000 of a cell for 200 N: a 24-bit bridge's
CONTACT_NAMES = "ABCDEFGHIJ"  # of a plan's presses, by their order


@dataclass(frozen=True)
class BadLead:
    """A lead that opens before the last frame."""

    electrode: int  # whose it is
    level: float  # what its input floats to, times the root mean square of the channel's voltages
    current: float = 1e-3  # share of the current that still passes


@dataclass(frozen=True)
class Plan:
    """A case before it is simulated: what is not a default is what makes it hard."""

    frames: tuple[tuple[Press, ...], ...]  # what presses in each
    contrast: float  # true one of the structure channel
    opposite: bool  # whether the magnitude channel changes against the description's sign
    shape: str = ""  # of all indenters, or "mixed"; what they are, where empty
    sign_told: bool = True  # whether the reconstructor knows of `opposite`
    snr_db: float = 40.0  # signal-to-noise ratio, and `snr_of` what; see `noise_stds`
    snr_of: SnrOf = "change"
    # the sheets that `tared`, `later` and `lead` are about
    at_fault: tuple[Channel, ...] = BOTH_CHANNELS
    tared: SheetState = AS_MADE  # their state at the tare
    later: SheetState = AS_MADE  # their state in the last frame
    lead: BadLead | None = None  # a lead of theirs that opens before the last frame
    unevenness: float = UNEVENNESS  # standard deviation of each sheet's smooth conductivity error
    # standard deviation of the logarithm of the contact impedances
    impedance_deviation: float = IMPEDANCE_DEVIATION
    # (L,) by how much electrodes sit off along the rim; in place where empty
    displaced_m: tuple[float, ...] = ()
    stretch: float = 0.0  # relative elongation along x, electrodes and all
    behind: int = 0  # by how many scans the structure channel is late in the last frame
    lost: int = 0  # how many structure scans are missing at the end


def as_described(description: SensorDescription, *frames: Sequence[Press]) -> Plan:
    """A plan on sheets that answer to pressure as the description says."""
    ratio = description.structure.saturated_ratio if description.structure else 1.0
    return Plan(tuple(tuple(presses) for presses in frames), max(ratio, 1 / ratio), opposite=False)


@dataclass(frozen=True)
class Frame:
    """One frame of a case."""

    presses: Mapping[str, Press]  # what presses, by the name of each contact
    scans: Mapping[Channel, FloatArray]  # volts (M,); without the channels whose scan is lost
    phase: str = ""  # of a moving scene
    tare: Reference | None = None  # the reference that is taken anew before it
    time_s: float = 0.0  # since the case's tare; told where the daemon's reference follows the skin
    # False where contacts are so near each other that either number of them would do
    countable: bool = True
    # names and readings; None where nobody reads any
    companions: Sequence[tuple[str, float]] | None = None


@dataclass(frozen=True)
class Case:
    """Frames as they are measured after one tare, and what is true of them."""

    seed_set: str  # which of the two sets of seeds
    number: int  # in it
    plan: Plan  # what was simulated
    description: SensorDescription  # the sensor as the reconstructor is told
    true_description: SensorDescription  # the sensor as it is
    tare: Reference
    frames: Sequence[Frame]
    is_followed: bool = False  # whether the daemon's reference follows the skin

    @property
    def is_still(self) -> bool:
        """Whether it is one frame, which is run to its end as a file's are."""
        return len(self.frames) == 1

    @property
    def name(self) -> str:
        """Seed set, contacts in the last frame, and number: "tuning 3/17"."""
        return f"{self.seed_set} {len(self.plan.frames[-1])}/{self.number}"

    @property
    def shape(self) -> str:
        """Of all indenters in the last frame, or "mixed"."""
        shapes = {press.shape for press in self.plan.frames[-1]}
        return self.plan.shape or (shapes.pop() if len(shapes) == 1 else "mixed")

    @cached_property
    def truth(self) -> Truth:
        """What a perfect reconstruction of the last frame would show."""
        return self.truth_of(self.frames[-1])

    def truth_of(self, frame: Frame) -> Truth:
        """What a perfect reconstruction of a frame would show."""
        return truth_of(self.true_description, list(frame.presses.values()))


@dataclass(frozen=True)
class SimulatedVolts:
    """Noise-free volts of a sensor's channels: (M,) at rest and (T, M) in each frame."""

    rest: Volts
    pressed: Volts


@dataclass(frozen=True)
class Simulated:
    """A plan on its skin, without noise."""

    plan: Plan
    told: SensorDescription  # the sensor as the reconstructor is told
    true: SensorDescription  # the sensor as it is
    volts: SimulatedVolts


def simulate(description: SensorDescription, plan: Plan, skin: np.random.SeedSequence) -> Simulated:
    """Simulate a plan on a skin of this seed, or read it from the cache."""
    true = with_opposite_magnitude(description) if plan.opposite else description
    told = true if plan.sign_told else with_opposite_magnitude(true)
    if true.structure is not None:
        true = with_contrast(true, plan.contrast)
    what = f"{SIMULATION} {plan!r} {skin.entropy} {true.model_dump_json()}"
    volts = _kept(what, lambda: _simulate(plan, true, fine_mesh(description), skin))
    return Simulated(plan, told, true, volts)


def _simulate(
    plan: Plan, sensor: SensorDescription, mesh: SheetMesh, seed: np.random.SeedSequence
) -> SimulatedVolts:
    skin = UnevenSkin(
        sensor,
        mesh,
        seed,
        unevenness=plan.unevenness,
        impedance_deviation=plan.impedance_deviation,
        warp=partial(_warped, plan=plan, sensor=sensor),
    )

    @cache
    def solve(presses: tuple[Press, ...], state: SheetState) -> Volts:
        return skin.voltages(presses, dict.fromkeys(plan.at_fault, state))

    *before, last = plan.frames
    scans = [*(solve(presses, plan.tared) for presses in before), solve(last, plan.later)]
    pressed = {name: np.array([scan[name] for scan in scans]) for name in sensor.channels}
    return SimulatedVolts(solve((), plan.tared), pressed)


def _warped(mesh: SheetMesh, plan: Plan, sensor: SensorDescription) -> SheetMesh:
    """Where the nodes are on a skin that is stretched or has electrodes off their places."""
    if plan.displaced_m:
        mesh = displaced(mesh, sensor, np.array(plan.displaced_m))
    return replace(mesh, mesh=mesh.mesh.scaled((1 + plan.stretch, 1.0)))


def _kept(what: str, make: Callable[[], SimulatedVolts]) -> SimulatedVolts:
    """Voltages from an earlier call, or simulated and kept in the user's cache.

    `what` has all that they depend on. A file that cannot be read or written costs time and nothing
    else.
    """
    path = cache_folder() / "scenes" / f"{hashlib.sha256(what.encode()).hexdigest()[:32]}.npz"
    parts = ("rest", "pressed")
    with suppress(OSError, DataError):
        kept = read_arrays(path)
        channels = [name for name in BOTH_CHANNELS if f"{name}_rest" in kept]
        return SimulatedVolts(*({n: kept[f"{n}_{part}"] for n in channels} for part in parts))
    volts = make()
    arrays = {f"{n}_{part}": v for part in parts for n, v in getattr(volts, part).items()}
    with suppress(OSError):
        write_whole(path, lambda file: np.savez(file, **arrays))
    return volts


def with_companion(case: Case, relative_error: float) -> Case:
    """The same with a load cell under the whole sheet, in newtons, wrong by such a share."""
    cell = Companion(gain_n_per_unit=1.0, noise_n=LOAD_CELL_N, relative_error=relative_error)
    told = case.description.model_copy(update={"companion": {"load_cell": cell}})
    rng = np.random.default_rng([zlib.crc32(case.name.encode()), case.number])

    def read(frame: Frame) -> Frame:
        force_n = case.truth_of(frame).force_n
        reading = force_n * (1 + relative_error * rng.standard_normal())
        reading += LOAD_CELL_N * rng.standard_normal()
        return replace(frame, companions=[("load_cell", float(reading))])

    return replace(case, description=told, frames=[read(frame) for frame in case.frames])


def noise_stds(volts: SimulatedVolts, snr_db: float, snr_of: SnrOf) -> dict[Channel, float]:
    """Standard deviation in volts of the noise on every voltage of each channel.

    It is the same on each, as a converter's is. A ratio of 20 dB is a tenth, in amplitude, of

    - "change": the root mean square of the channel's voltage changes, as the paper has it, which
      adds noise to data that are changes.
    - "voltage": the root mean square of the channel's voltages at rest, as a converter's data
      sheet has it. Changes are some 5 to 30 % of that in the structure channel and 0.2 to 4 % in
      the magnitude channel, so that the same number of decibels is far more noise.
    """
    signals = {
        name: volts.pressed[name] - rest if snr_of == "change" else rest
        for name, rest in volts.rest.items()
    }
    share = 10 ** (-snr_db / 20)
    return {name: float(np.sqrt(np.mean(s**2)) * share) for name, s in signals.items()}


def measure(
    simulated: Simulated,
    seed_set: str,
    number: int,
    noise: np.random.SeedSequence,
    snr_db: float | None = None,  # of the change; the plan's ratio if None
    *,
    is_tare_drawn_first: bool = True,
) -> Case:
    """What the device makes of voltages: noise, a lead that opens, scans late or lost.

    The draws are the same at every signal-to-noise ratio, scaled. Published still scenes have
    those of the scan before those of the `REFERENCE_SCANS` that the tare averages.
    """
    plan, volts, rng = simulated.plan, simulated.volts, np.random.default_rng(noise)
    if snr_db is not None:
        plan = replace(plan, snr_db=snr_db, snr_of="change")
    count = len(plan.frames)
    rest, scans, stds = {}, {}, noise_stds(volts, plan.snr_db, plan.snr_of)
    for name in simulated.told.channels:
        clean, pressed = volts.rest[name], volts.pressed[name].copy()
        if plan.lead and name in plan.at_fault:
            floats_v = plan.lead.level * float(np.sqrt(np.mean(clean**2)))
            electrode, current = plan.lead.electrode, plan.lead.current
            pressed[-1] = with_lead(
                simulated.told, pressed[-1], electrode, current, lambda *_, v=floats_v: v
            )
        draws = stds[name] * rng.standard_normal((REFERENCE_SCANS + count, len(clean)))
        parts = np.split(draws, [REFERENCE_SCANS if is_tare_drawn_first else count])
        of_tare, of_scans = parts if is_tare_drawn_first else parts[::-1]
        rest[name], scans[name] = clean + of_tare, pressed + of_scans
    if plan.behind:
        scans[Channel.STRUCTURE][-1] = scans[Channel.STRUCTURE][-1 - plan.behind]
    frames = [
        Frame(
            dict(zip(CONTACT_NAMES, presses, strict=False)),
            {
                name: volts_of[index]
                for name, volts_of in scans.items()
                if name == Channel.MAGNITUDE or index < count - plan.lost
            },
        )
        for index, presses in enumerate(plan.frames)
    ]
    tare = Reference.from_scans(*map(rest.get, Channel))
    return Case(seed_set, number, plan, simulated.told, simulated.true, tare, frames)


def with_lead(
    description: SensorDescription,  # the sensor
    volts: FloatArray,  # (M,) what a good device reads
    electrode: int,  # whose lead it is
    current: float,  # share of the current that still passes
    reading: Reading,  # from the drive and the potential there, in volts, to what is read
) -> FloatArray:
    """Voltages (M,) of a skin with a bad lead; adjacent patterns only.

    A device drives a current of limited voltage and reads each electrode against its ground, so a
    lead that is open carries no current and reads whatever the input floats to: contact impedance
    alone changes little in four-wire voltages.
    """
    drive, measure = description.pairs.drive, description.pairs.measure
    volts = np.where((drive == electrode).any(axis=1), current * volts, volts)
    count = description.electrode_count
    per_drive = count - 3
    made = volts.copy()
    for k in range(count):
        rows = np.flatnonzero(drive[:, 0] == k)
        rows = rows[np.argsort((measure[rows, 0] - k) % count)]  # along the rim, from k + 2 on
        at = (k + 2 + np.arange(per_drive + 1)) % count
        potential = -np.concatenate([[0.0], np.cumsum(volts[rows])])
        potential -= potential.mean()  # the amplifiers hold the skin at their ground
        read = np.array(
            [
                reading(k, p) if e == electrode else p
                for e, p in zip(at.tolist(), potential.tolist(), strict=True)
            ]
        )
        made[rows] = read[:-1] - read[1:]
    return made


SceneShape = Literal["ellipse", "rectangle", "ring", "mixed"]

SCENE_SHAPES: tuple[SceneShape, ...] = ("ellipse", "rectangle", "ring", "mixed")
TRIES = 30  # of a contact, before all are drawn anew


def still_case(
    description: SensorDescription,
    plan: Plan,
    seed_set: SeedSet,
    number: int,
    snr_db: float,
) -> Case:
    """Simulate a plan of one frame and measure it with noise of this ratio of the change."""
    numbers = len(plan.frames[-1]), number
    simulated = simulate(description, plan, seed_of(seed_set, "sheet", *numbers))
    noise = seed_of(seed_set, "noise", *numbers)
    return measure(simulated, seed_set, number, noise, snr_db, is_tare_drawn_first=False)


def draw_still(
    description: SensorDescription, seed_set: SeedSet, contacts: int, number: int
) -> Plan:
    """Draw what presses and on what.

    Outlines lie inside the sensing area, up to its edge, and at least `GAP_M` apart: an indenter
    that finds no room is drawn anew, so that many contacts are smaller ones on average.

    Raises DataError where there is no room for so many.
    """
    rng = np.random.default_rng(seed_of(seed_set, "layout", contacts, number))
    shape = SCENE_SHAPES[rng.integers(4 if contacts > 1 else 3)]
    contrast, opposite = draw_contrast(rng), bool(rng.integers(2))
    opposite = opposite and can_be_opposite(description)

    def one() -> Press:
        return draw_indenter(
            description, rng, SHAPES[rng.integers(3)] if shape == "mixed" else shape
        )

    presses = placed_apart(description, contacts, GAP_M, one, tries=TRIES)
    return Plan((presses,), contrast, opposite, shape)
