"""Whether methods say so where they fail: cases of every regime, reconstructed and judged.

A map is bad where its ICC with the truth is below `BAD_ICC`. What counts is what a user is told: a
bad map with no flag of `DISTRUST` is a silent failure, a good one with such a flag a false alarm.
Other flags, such as a lead that was left out, are counted apart: the map claims to stand on the
rest of the data.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.batch import BUDGET_S
from tactomo_models.physics.artifact import Artifact, load_or_build_artifact
from tactomo_models.physics.mesh import SheetMesh
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.plausibility import DISTRUST
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo_lab.evaluation.faults import with_lead
from tactomo_lab.evaluation.regimes import REGIMES, Plan, draw_plan
from tactomo_lab.evaluation.trade_off import left_out
from tactomo_lab.scenes.measures import BAD_ICC, correlation, mean
from tactomo_lab.scenes.simulation import (
    SheetState,
    Truth,
    UnevenSkin,
    displaced,
    fine_mesh,
    truth_of,
    with_contrast,
    with_opposite_magnitude,
)
from tactomo_lab.scenes.still_scenes import (
    REFERENCE_SCANS,
    SIMULATION,
    SeedSet,
    SimulatedVolts,
    kept_volts,
    noise_std,
    require_both_channels,
    seed_of,
)


@dataclass(frozen=True)
class Case:
    """A case of a regime as it is measured."""

    regime: str  # its name
    name: str  # seed set and number
    plan: Plan  # what was simulated
    description: SensorDescription  # the sensor as the reconstructor is told
    reference: Reference  # the mean of noisy unpressed scans
    # scans of each frame, volts (M,); without the channels that are lost
    frames: tuple[dict[Channel, FloatArray], ...]
    truth: Truth  # of the last frame


def make_case(
    description: SensorDescription,
    regime: str,
    seed_set: SeedSet,
    number: int,
    *,
    snr_db: float | None = None,
) -> Case:
    """Draw, simulate and measure a case; the same one every time.

    Its noise is the plan's, or that of a ratio of the change.

    Raises DataError where the sensor has a single channel, or no room for what presses.
    """
    require_both_channels(description)
    description = REGIMES[regime].sensor_of(description)
    plan = draw_plan(description, regime, seed_set, number)
    planned = simulate_plan(description, plan, regime, seed_set, number)
    if snr_db is not None:
        plan = replace(plan, snr_db=snr_db, snr_of="change")
    rng = np.random.default_rng(seed_of(seed_set, f"stability {regime} noise", number))
    reference, frames = _measure(plan, planned.volts, description, rng)
    return Case(
        regime=regime,
        name=f"{seed_set} {number}",
        plan=plan,
        description=_regularised(planned.told, plan.regularisation),
        reference=reference,
        frames=frames,
        truth=truth_of(planned.true, plan.frames[-1]),
    )


def _regularised(told: SensorDescription, factor: float) -> SensorDescription:
    """The sensor with so many times its factor on what the linear methods choose."""
    weighted = {"regularisation": factor * told.instrument.regularisation}
    instrument = told.instrument.model_copy(update=weighted)
    return told.model_copy(update={"instrument": instrument})


@dataclass(frozen=True)
class Planned:
    """A plan on its skin, without noise."""

    told: SensorDescription  # the sensor as the reconstructor is told
    true: SensorDescription  # the sensor as it is
    volts: SimulatedVolts  # at the tare (M,) and in every frame (T, M)


def simulate_plan(
    description: SensorDescription, plan: Plan, regime: str, seed_set: SeedSet, number: int
) -> Planned:
    """Simulate a plan of a regime's case on that case's sheets, or read it from the cache."""
    true = with_opposite_magnitude(description) if plan.opposite else description
    told = true if plan.sign_told else with_opposite_magnitude(true)
    if true.structure is not None:
        true = with_contrast(true, plan.contrast)
    seed = seed_of(seed_set, f"stability {regime} sheet", number)
    what = f"{SIMULATION} {seed_set} {regime} {number} {plan!r} {true.model_dump_json()}"
    volts = kept_volts(what, lambda: _simulate(plan, true, _fine_mesh(description), seed))
    return Planned(told, true, volts)


@lru_cache(maxsize=1)
def _fine_mesh(description: SensorDescription) -> SheetMesh:
    return fine_mesh(description)


def _simulate(
    plan: Plan, sensor: SensorDescription, mesh: SheetMesh, seed: np.random.SeedSequence
) -> SimulatedVolts:
    """Noise-free voltages of each channel, at the tare (M,) and in every frame (T, M)."""
    warp = partial(_warped, plan=plan, sensor=sensor)
    skin = UnevenSkin(
        sensor,
        mesh,
        seed,
        unevenness=plan.unevenness,
        impedance_deviation=plan.impedance_deviation,
        warp=warp,
    )

    def states(state: SheetState) -> dict[Channel, SheetState]:
        return dict.fromkeys(plan.at_fault, state)

    *before, last = plan.frames
    known = {presses: skin.voltages(presses, states(plan.tared)) for presses in set(before)}
    scans = [*(known[presses] for presses in before), skin.voltages(last, states(plan.later))]
    pressed = {name: np.array([scan[name] for scan in scans]) for name in sensor.channels}
    return SimulatedVolts(skin.voltages([], states(plan.tared)), pressed)


def _warped(mesh: SheetMesh, plan: Plan, sensor: SensorDescription) -> SheetMesh:
    """Where the nodes are on a skin that is stretched or has electrodes off their places."""
    if plan.displaced_m:
        mesh = displaced(mesh, sensor, np.array(plan.displaced_m))
    return SheetMesh(mesh.mesh.scaled((1 + plan.stretch, 1.0)), mesh.electrode_facets)


def _measure(
    plan: Plan, volts: SimulatedVolts, description: SensorDescription, rng: np.random.Generator
) -> tuple[Reference, tuple[dict[Channel, FloatArray], ...]]:
    """What the device makes of voltages: noise, a lead that opens, scans late or lost."""
    rest: dict[Channel, FloatArray] = {}
    scans: dict[Channel, FloatArray] = {}
    for name in description.channels:
        std = noise_std(volts, name, plan.snr_db, plan.snr_of)
        clean, pressed = volts.rest[name], volts.pressed[name].copy()
        rest[name] = clean + std * rng.standard_normal((REFERENCE_SCANS, len(clean)))
        if plan.lead and name in plan.at_fault:
            floats_v = plan.lead.level * float(np.sqrt(np.mean(clean**2)))
            electrode, current = plan.lead.electrode, plan.lead.current
            pressed[-1] = with_lead(
                description, pressed[-1], electrode, current, lambda *_, v=floats_v: v
            )
        scans[name] = pressed + std * rng.standard_normal(pressed.shape)
    if plan.behind:
        scans[Channel.STRUCTURE][-1] = scans[Channel.STRUCTURE][-1 - plan.behind]
    count = len(plan.frames)
    frames = tuple(
        {
            name: scans[name][index]
            for name in description.channels
            if name == Channel.MAGNITUDE or index < count - plan.lost
        }
        for index in range(count)
    )
    return Reference.from_scans(rest[Channel.MAGNITUDE], rest.get(Channel.STRUCTURE)), frames


@dataclass(frozen=True)
class CaseScore:
    """How one case came out."""

    # regime, case, method: which
    regime: str
    case: str
    method: str
    # contacts, found: how many press, and were reported
    contacts: int
    found: int
    # of the magnitude map; of the pressed shape where nothing presses hard enough to show in it;
    # where nothing presses at all, 1 if nothing was reported and else 0
    icc: float
    warned: bool  # whether a flag of `DISTRUST`, or the lack of a map, told not to trust it
    flags: tuple[str, ...]  # names of all that were raised
    # tier, reason, misfit, confidence: as reported
    tier: str
    reason: str
    misfit: float
    confidence: float

    @property
    def bad(self) -> bool:
        """Whether the map shows something else than what presses."""
        return self.icc < BAD_ICC

    def as_json(self) -> dict[str, Any]:
        """All of it as numbers and names."""
        return {**asdict(self), "bad": self.bad}


@dataclass(frozen=True)
class Outcome:
    """A case, what a method made of it, and how right that is."""

    case: Case
    frame: Reconstruction
    score: CaseScore


def reconstruct_case(case: Case, *methods: str, artifact: Artifact | None = None) -> list[Outcome]:
    """Reconstruct a case by one method after the other, on one thread; the last frame is judged.

    One frame alone is run to its end, as a file's are; several have the daemon's budget.

    Raises ModelError where a method's network is not there.
    """
    artifact = artifact or _artifact(case.description)
    budget_s = BUDGET_S if len(case.frames) == 1 else None
    reconstructor = Reconstructor(case.description, artifact, budget_s=budget_s)
    outcomes = []
    with threadpool_limits(1):
        reconstructor.set_reference(case.reference)  # costs more than many a method
        for method in methods:
            reconstructor.method = method
            reconstructor.reset()
            for scans in case.frames:
                frame = reconstructor.reconstruct(
                    scans.get(Channel.MAGNITUDE), scans.get(Channel.STRUCTURE)
                )
            outcomes.append(Outcome(case, frame, _score(case, method, frame)))
    return outcomes


@lru_cache(maxsize=2)  # one serves both signs
def _artifact(description: SensorDescription) -> Artifact:
    return load_or_build_artifact(description)


def _score(case: Case, method: str, frame: Reconstruction) -> CaseScore:
    truth = case.truth
    shown, true = frame.map, truth.map
    if not truth.map.any():
        shown, true = frame.structure, truth.pressed
    pressed = bool(truth.pressed.any())
    return CaseScore(
        regime=case.regime,
        case=case.name,
        method=method,
        contacts=len(truth.contacts),
        found=len(frame.contacts),
        icc=correlation(shown, true) if pressed else float(not frame.contacts),
        warned=bool(frame.flags & DISTRUST) or shown is None,
        flags=tuple(frame.flags.names()),
        tier=frame.tier,
        reason=frame.reason,
        misfit=frame.misfit,
        confidence=frame.confidence,
    )


def evaluate_regimes(
    description: SensorDescription,
    regimes: Iterable[str],
    methods: Sequence[str],
    seed_set: SeedSet,
    count: int,
    *,
    jobs: int = 1,
) -> Iterator[list[Outcome]]:
    """Reconstruct cases of some regimes by some methods.

    Yields:
        Each case's outcomes, of the methods that its sensor has; in the order of regimes and
        numbers whatever `jobs`.

    Raises DataError where the sensor has a single channel, or no room for what presses.
    """
    require_both_channels(description)
    _artifact(description)  # built once, by this process
    work = partial(_evaluate_case, description, tuple(methods), seed_set)
    which = [(regime, number) for regime in regimes for number in range(count)]
    if jobs == 1:
        yield from map(work, which)
        return
    # Not forked: what runs threads does not survive that.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(work, which)


def _evaluate_case(
    description: SensorDescription,
    methods: tuple[str, ...],
    seed_set: SeedSet,
    which: tuple[str, int],
) -> list[Outcome]:
    case = make_case(description, which[0], seed_set, which[1])
    missing = left_out(case.description, methods)  # a regime may have a sensor of its own
    return reconstruct_case(case, *(method for method in methods if method not in missing))


@dataclass(frozen=True)
class Trust:
    """Whether flags told bad maps from good ones."""

    maps: int  # how many
    icc: float  # mean
    bad: int  # how many have an ICC below `BAD_ICC`
    bad_unwarned: int  # of those, how many had no flag of `DISTRUST`
    bad_unflagged: int  # of those, how many had no flag at all
    good_warned: int  # good maps that were flagged as not to be trusted
    good_flagged: int  # good maps with any flag


def trust(scores: Iterable[CaseScore]) -> Trust:
    """Count bad maps and warnings."""
    known = list(scores)
    bad = [score for score in known if score.bad]
    good = [score for score in known if not score.bad]
    return Trust(
        maps=len(known),
        icc=mean(score.icc for score in known),
        bad=len(bad),
        bad_unwarned=sum(not score.warned for score in bad),
        bad_unflagged=sum(not (score.warned or score.flags) for score in bad),
        good_warned=sum(score.warned for score in good),
        good_flagged=sum(score.warned or bool(score.flags) for score in good),
    )


def trust_by_regime(scores: Iterable[CaseScore]) -> dict[str, dict[str, Trust]]:
    """Counts of every regime, and of all of them under "all", by method."""
    known = list(scores)
    methods = dict.fromkeys(score.method for score in known)

    def by_method(chosen: list[CaseScore]) -> dict[str, Trust]:
        return {m: trust(score for score in chosen if score.method == m) for m in methods}

    regimes = dict.fromkeys(score.regime for score in known)
    rows = {r: by_method([score for score in known if score.regime == r]) for r in regimes}
    return {**rows, "all": by_method(known)}
