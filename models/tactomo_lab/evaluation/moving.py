"""A moving scene: contacts that slide, land, lift, jump, merge and split; lost scans; a tare.

One choreography in eleven phases at 20 frames a second, played on a sheet of its own with
indenters, place, contrast and sign drawn from its seed, under the budget that the daemon has.
What is asked: how well each phase is followed, how soon a warm start recovers from what kills it,
whether contacts keep their identity, and whether a wrong frame says so.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.drift.baseline import BaselineTracker
from tactomo_models.errors import MethodError
from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.plausibility import DISTRUST, Flag
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.press import Press
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo_lab.scenes.measures import (
    WRONG_ICC,
    FrameScore,
    Summary,
    correlation,
    match,
    percentile,
    relative_error,
    score_contacts,
    summarise,
)
from tactomo_lab.scenes.simulation import (
    TrueContact,
    Truth,
    UnevenSkin,
    fine_mesh,
    truth_of,
    with_contrast,
    with_opposite_magnitude,
)
from tactomo_lab.scenes.still_scenes import (
    BOTH_CHANNELS,
    CONTRAST,
    GAP_M,
    REFERENCE_SCANS,
    SIMULATION,
    SeedSet,
    SimulatedVolts,
    SnrOf,
    gap_m,
    kept_volts,
    noise_std,
    require_both_channels,
    seed_of,
)

Presses = dict[str, Press]

TOUCHDOWN_KPA = 100.0  # of the first frame of a landing: the magnitude channel sees nothing yet
LOST = DISTRUST | Flag.STRUCTURE_MISSING | Flag.MAGNITUDE_MISSING  # flags that excuse a frame


@dataclass(frozen=True)
class Step:
    """One frame of the choreography."""

    phase: str  # its name
    presses: Presses  # what presses, by the name of each contact
    lost: tuple[Channel, ...] = ()  # channels whose scan is lost
    tare: bool = False  # whether the reference is taken anew before it


def choreography(
    indenters: Presses,  # by the names in `INDENTERS`, radii up to 12 mm; places are given here
    millimetre_m: float,  # a millimetre on the paper's sensor, on this one
) -> list[Step]:
    """All frames."""

    def at(name: str, x_mm: float, y_mm: float) -> Press:
        return replace(indenters[name], x_m=x_mm * millimetre_m, y_m=y_mm * millimetre_m)

    def path(
        name: str, start: tuple[float, float], end: tuple[float, float], frames: int
    ) -> list[Press]:
        share = np.arange(1, frames + 1)[:, None] / frames
        places = (1 - share) * np.array(start) + share * np.array(end)
        return [at(name, x_mm, y_mm) for x_mm, y_mm in places.tolist()]

    def lands(phase: str, name: str, press: Press, frames: int, **others: Press) -> list[Step]:
        light = replace(press, pressure_kpa=TOUCHDOWN_KPA)
        return [
            Step(phase, {**others, name: light}),
            *[Step(phase, {**others, name: press})] * (frames - 1),
        ]

    here, jumped, beside = at("B", 40, 30), at("A", 10, -40), at("C", -35, -40)
    towards, away = path("C", (-35, -40), (-2, -40), 12), path("C", (-2, -40), (-35, -40), 12)
    both: tuple[Channel, ...] = (Channel.MAGNITUDE, Channel.STRUCTURE)
    lost: dict[int, tuple[Channel, ...]] = {
        4: both,
        8: (Channel.STRUCTURE,),
        9: (Channel.STRUCTURE,),
        12: (Channel.MAGNITUDE,),
    }
    crowd = {
        "E": at("E", -35, 35),
        "F": at("F", 35, 32),
        "G": at("G", 33, -35),
        "H": at("H", -32, -30),
    }
    opposite_ways = zip(
        path("A", (35, -4), (-38, -4), 16), path("B", (-25, 30), (40, 30), 16), strict=True
    )
    return [
        *[Step("rest", {})] * 4,
        *lands("land", "A", at("A", -38, -38), 8),
        *[Step("slide", {"A": p}) for p in path("A", (-38, -38), (35, -4), 18)],
        *lands("second lands", "B", at("B", -25, 30), 8, A=at("A", 35, -4)),
        *[Step("pass", {"A": p, "B": q}) for p, q in opposite_ways],
        *[Step("still", {"A": at("A", -38, -4), "B": here})] * 10,
        *[Step("jump", {"A again": jumped, "B": here})] * 8,
        *[Step("lift", {"A again": jumped})] * 6,
        *lands("third lands", "C", beside, 6, **{"A again": jumped}),
        *[Step("merge", {"A again": jumped, "C": p}) for p in [*towards, *[towards[-1]] * 3]],
        *[Step("split", {"A again": jumped, "C": p}) for p in away],
        *[
            Step("lost scans", {"A again": p, "C": beside}, lost.get(index, ()))
            for index, p in enumerate(path("A", (10, -40), (10, 30), 16))
        ],
        *[Step("tare", {})] * 2,
        Step("tare", {}, tare=True),
        *[Step("tare", {"D": at("D", 5, 0)})] * 6,
        *[Step("four land", crowd)] * 10,
    ]


INDENTERS = "ABCDEFGH"


@dataclass(frozen=True)
class Sequence:
    """A moving scene as it is measured."""

    name: str  # seed set and number
    # the sensor as the reconstructor is told; see `scenes.EvaluationScene`
    description: SensorDescription
    true_description: SensorDescription  # the sensor as it is, with its true contrast
    steps: tuple[Step, ...]  # the frames
    volts: SimulatedVolts  # noise-free voltages, pressed (T, M)
    snr_db: float  # signal-to-noise ratio
    noise: dict[Channel, FloatArray]  # (T,) standard deviation of each channel's noise, volts
    rest_noise: dict[Channel, float]  # likewise of the unpressed scans
    seed: np.random.SeedSequence  # of the noise
    # seconds between frames, in which the daemon's reference follows the skin; it stays if None
    period_s: float | None = None


def draw_sequence(
    description: SensorDescription,
    seed_set: SeedSet,
    number: int,
    *,
    snr_db: float = 40.0,
    snr_of: SnrOf = "change",
) -> Sequence:
    """Draw and simulate a moving scene: about a minute, or read from the cache.

    Raises DataError where the sensor has a single channel.
    """
    require_both_channels(description)
    rng = np.random.default_rng(seed_of(seed_set, "moving", number))
    contrast = float(np.exp(rng.uniform(*np.log(CONTRAST))))
    sensor = with_opposite_magnitude(description) if rng.integers(2) else description
    quarters, mirrored = int(rng.integers(4)), bool(rng.integers(2))
    millimetre_m = description.width_m / 150
    steps = tuple(
        replace(
            step,
            presses={
                name: _turned(press, quarters, mirrored) for name, press in step.presses.items()
            },
        )
        for step in choreography(_draw_indenters(rng, millimetre_m), millimetre_m)
    )
    true_sensor = with_contrast(sensor, contrast)

    what = f"{SIMULATION} {seed_set} {number} {steps!r} {true_sensor.model_dump_json()}"
    sheet_seed = seed_of(seed_set, "moving sheet", number)
    volts = kept_volts(what, lambda: _simulate(true_sensor, steps, sheet_seed))
    under_load = np.array([bool(step.presses) for step in steps])
    loaded = replace(volts, pressed={n: scans[under_load] for n, scans in volts.pressed.items()})
    noise = {name: noise_std(loaded, name, snr_db, snr_of) for name in BOTH_CHANNELS}
    return Sequence(
        name=f"{seed_set} {number}",
        description=sensor,
        true_description=true_sensor,
        steps=steps,
        volts=volts,
        snr_db=snr_db,
        noise={name: np.full(len(steps), std) for name, std in noise.items()},
        rest_noise=noise,
        seed=seed_of(seed_set, "moving noise", number),
    )


def _simulate(
    sensor: SensorDescription, steps: tuple[Step, ...], seed: np.random.SeedSequence
) -> SimulatedVolts:
    """Voltages of each channel at rest (M,) and in every step (T, M); each scene is solved once."""
    skin = UnevenSkin(sensor, fine_mesh(sensor), seed)
    scenes = [tuple(step.presses.values()) for step in steps]
    known = {presses: skin.voltages(presses) for presses in dict.fromkeys(scenes)}
    frames = {name: [known[presses][name] for presses in scenes] for name in BOTH_CHANNELS}
    pressed = {name: np.array(volts) for name, volts in frames.items()}
    return SimulatedVolts(skin.voltages([]), pressed)


def _draw_indenters(rng: np.random.Generator, millimetre_m: float) -> Presses:
    return {
        name: Press(
            x_m=0.0,
            y_m=0.0,
            pressure_kpa=rng.uniform(150, 195),
            radius_m=rng.uniform(8, 12) * millimetre_m,
            radius_y_m=rng.uniform(8, 12) * millimetre_m,
            angle_rad=rng.uniform(0, np.pi),
        )
        for name in INDENTERS
    }


def _turned(press: Press, quarters: int, mirrored: bool) -> Press:
    """The same on a sheet turned by quarters of a turn, then mirrored about the y axis."""
    x, y, angle = press.x_m, press.y_m, press.angle_rad + quarters * np.pi / 2
    for _ in range(quarters):
        x, y = -y, x
    if mirrored:
        x, angle = -x, -angle
    return replace(press, x_m=x, y_m=y, angle_rad=angle)


@dataclass(frozen=True)
class StepScore(FrameScore):
    """How one frame came out; `contacts` has those alone that touch no other.

    Its measures of the map are NaN where nothing presses hard enough to show, or no map was made;
    that of the shape where nothing presses, or no shape was made.
    """

    phase: str  # of the choreography
    groups: int  # how many contacts press, those that touch counted as one
    # False where contacts are so near each other that either number would do, and where a scan is
    # lost
    countable: bool
    switches: int  # contacts that another identity was given to than they had

    @property
    def count_right(self) -> bool | None:
        """See `FrameScore`."""
        return self.found == self.groups if self.countable else None

    @property
    def confidently_wrong(self) -> bool:
        """Whether it shows something else than what presses, and no flag says so."""
        low = self.icc < WRONG_ICC or self.icc_structure < WRONG_ICC  # what is NaN is not
        return (low or self.count_right is False) and not self.distrusted


def play(
    sequence: Sequence, method: str = "auto", budget_s: float | None = None
) -> Iterator[StepScore]:
    """Reconstruct a moving scene on one thread; no `budget_s` means the daemon's own."""
    sensor = sequence.description
    rng = np.random.default_rng(sequence.seed)
    reconstructor = Reconstructor(
        sensor, load_or_build_artifact(sensor), method=method, budget_s=budget_s
    )
    identities = _Identities()
    tracker = None if sequence.period_s is None else BaselineTracker(reconstructor)
    begin = reconstructor.set_reference if tracker is None else tracker.begin
    begin(_reference(sequence, rng))
    for index, step in enumerate(sequence.steps):
        if step.tare:
            begin(_reference(sequence, rng))
        scans = {
            name: sequence.volts.pressed[name][index]
            + sequence.noise[name][index] * rng.standard_normal(len(sequence.volts.rest[name]))
            for name in BOTH_CHANNELS
        }
        for name in step.lost:
            del scans[name]
        with threadpool_limits(1):
            begin_s = time.thread_time()
            volts = scans.get(Channel.MAGNITUDE), scans.get(Channel.STRUCTURE)
            if tracker is None or sequence.period_s is None:
                frame = reconstructor.reconstruct(*volts)
            else:
                frame = tracker.reconstruct(index * sequence.period_s, *volts)
            seconds = time.thread_time() - begin_s
        if frame.failure:  # the frame is another method's
            raise MethodError(frame.failure)
        truth = truth_of(sequence.true_description, list(step.presses.values()))
        yield _score(sensor, step, truth, frame, identities, seconds)


def _reference(sequence: Sequence, rng: np.random.Generator) -> Reference:
    """Mean of `REFERENCE_SCANS` scans; where those have no noise, one, as `batch` takes it.

    A file's single reference does not tell how noisy the scans are: they tell it themselves.
    """
    volts = sequence.volts
    if not any(sequence.rest_noise.values()):
        seen = [
            volts.pressed[name]
            + sequence.noise[name][:, None] * rng.standard_normal(volts.pressed[name].shape)
            for name in BOTH_CHANNELS
        ]
        rest = Reference(volts.rest[Channel.MAGNITUDE], volts.rest[Channel.STRUCTURE])
        return rest.with_noise_of(sequence.description, *seen)
    scans = [
        rest + sequence.rest_noise[name] * rng.standard_normal((REFERENCE_SCANS, len(rest)))
        for name, rest in volts.rest.items()
    ]
    return Reference.from_scans(*scans)


def _score(
    sensor: SensorDescription,
    step: Step,
    truth: Truth,
    frame: Reconstruction,
    identities: _Identities,
    seconds: float,
) -> StepScore:
    apart, clear = _groups(step.presses)
    contacts = dict(zip(step.presses, truth.contacts, strict=True))
    alone = {group[0]: contacts[group[0]] for group in apart if len(group) == 1}
    shows = frame.map is not None and truth.map.any()
    return StepScore(
        contacts=score_contacts(sensor, list(alone.values()), frame.contacts),
        found=len(frame.contacts),
        rie=relative_error(frame.map, truth.map) if shows else float("nan"),
        icc=correlation(frame.map, truth.map) if shows else float("nan"),
        icc_structure=(
            correlation(frame.structure, truth.pressed)
            if frame.structure is not None and truth.pressed.any()
            else float("nan")
        ),
        distrusted=bool(frame.flags & LOST),
        seconds=seconds,
        phase=step.phase,
        groups=len(apart),
        countable=clear and not step.lost,
        switches=identities.switches(alone, frame),
    )


def _groups(presses: Presses) -> tuple[list[list[str]], bool]:
    """Names of the contacts that touch each other, and whether all others are clear of them."""
    groups: list[list[str]] = []
    clear = True
    for name, press in presses.items():
        gaps = {other: gap_m(press, presses[other]) for group in groups for other in group}
        clear &= all(gap == 0 or gap >= GAP_M for gap in gaps.values())
        touching = [group for group in groups if any(gaps[other] == 0 for other in group)]
        groups = [group for group in groups if group not in touching]
        groups.append([name, *(other for group in touching for other in group)])
    return groups, clear


class _Identities:
    """Remembers which identity each true contact was last given."""

    def __init__(self) -> None:
        self._known: dict[str, int] = {}

    def switches(self, contacts: dict[str, TrueContact], frame: Reconstruction) -> int:
        """Contacts that are given another identity now; one that merged or lifted starts anew."""
        names = list(contacts)
        self._known = {name: known for name, known in self._known.items() if name in contacts}
        switched = 0
        for here, there in match(frame.contacts, list(contacts.values())):
            given = frame.contacts[here].id
            switched += self._known.get(names[there], given) != given
            self._known[names[there]] = given
        return switched


@dataclass(frozen=True)
class PhaseSummary(Summary):
    """One phase over many sequences."""

    # longest run of frames in which the shape's ICC is below `WRONG_ICC`; median over the sequences
    recovery: float
    recovery_most: float  # of the slowest sequence
    switches: int  # identities lost, in all


def summarise_phases(sequences: Iterable[Iterable[StepScore]]) -> dict[str, PhaseSummary]:
    """Measures of each phase, in order, and of all of them under "all"."""
    played = [list(scores) for scores in sequences]
    phases = dict.fromkeys(score.phase for scores in played for score in scores)
    parts = {
        phase: [[score for score in scores if score.phase == phase] for scores in played]
        for phase in phases
    }
    summaries = {name: _summarise(part) for name, part in parts.items()}
    return {**summaries, "all": _summarise([one for part in parts.values() for one in part])}


def _summarise(played: list[list[StepScore]]) -> PhaseSummary:
    scores = [score for part in played for score in part]
    recovery = [_recovery(part) for part in played]
    return PhaseSummary(
        **asdict(summarise(scores)),
        recovery=percentile(recovery, 50),
        recovery_most=percentile(recovery, 100),
        switches=sum(score.switches for score in scores),
    )


def _recovery(scores: list[StepScore]) -> float:
    """Longest run of frames whose shape is wrong; NaN where none of them is pressed."""
    icc = np.array([score.icc_structure for score in scores])
    wrong = icc[np.isfinite(icc)] < WRONG_ICC
    if len(wrong) == 0:
        return float("nan")
    return float(max(len(run) for run in "".join("x" if w else " " for w in wrong).split(" ")))
