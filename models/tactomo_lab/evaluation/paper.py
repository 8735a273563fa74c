"""The paper's evaluation, repeated on simulated skins (Chen et al., sections IV and V).

Its simulation study (Fig. 5) is repeated as it is described: one to four ellipses that conduct
worse than an even sheet, a contrast of 100 in the structure channel, white Gaussian noise. "SNR of
the data" is read as that of the voltage *changes*, which are the data of its equations.

Its experiments (Figs. 8 to 12) were made with hardware: round indenters on a real skin. Here they
are made with simulated ones, `Rig`: sheets uneven by 5 %, contact impedances by 20 %, conductivity
that rises under pressure, noise of equal size on every voltage, one scan a press after one tare.
The paper has one sensor; here several sheets tell what is chance.

Nothing that inverts knows the mesh that simulates; see `simulation`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any, Final

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.contacts import Contact
from tactomo_models.scene.press import Press
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.evaluation.play import Outcome, Player, Variant
from tactomo_lab.scenes.case import (
    CONTACT_NAMES,
    REFERENCE_SCANS,
    Case,
    Plan,
    Simulated,
    as_described,
    noise_std,
    simulate,
)
from tactomo_lab.scenes.case import Frame as CaseFrame
from tactomo_lab.scenes.drawing import BOTH_CHANNELS, SeedSet, require_channels, seed_of
from tactomo_lab.scenes.measures import Summary, correlation, full_range, summarise
from tactomo_lab.scenes.presets import PAPER_CONTACTS, PAPER_CONTRAST, paper_presses
from tactomo_lab.scenes.simulation import Truth, Volts
from tactomo_lab.scenes.still_scenes import still_case

# The paper's three, then ours.
PAPER_METHODS: Final = ("tikhonov", "cnn-single", "cnn-multimodal")
DEFAULT_METHODS: Final = (*PAPER_METHODS, "network", "auto")

SNR_DB: Final = (float("inf"), 40.0, 20.0, 10.0)  # of Fig. 5
COUNTS: Final = tuple(range(1, PAPER_CONTACTS + 1))
SCENES: Final = 100  # of each number of contacts, likewise

PAPER_WIDTH_MM: Final = 150.0  # places and sizes are shares of it on another sensor
RIG_SNR_DB: Final = 60.0  # of the voltages at rest: a tank that was measured had 58
CASE_KPA: Final = (140.0, 160.0, 180.0, 200.0)  # of Figs. 8 and 9
TOP_SHARE: Final = 0.75  # of an image's maximum, above which values are averaged (V-C-2)
GRID_MM: Final = 18.0  # of the holes that indenters are held by

# What the paper prints, measured on hardware. Figs. 8 and 9: the magnitude error, and the pressure
# at which the error was that large, kPa. Fig. 10: mean and standard deviation, mm.
PAPER_MAGNITUDE_ERROR: Final = {
    "tikhonov": (0.76, 200.0),
    "cnn-single": (0.57, 160.0),
    "cnn-multimodal": (0.21, 180.0),
}
PAPER_LOCALISATION_MM: Final = {
    "tikhonov": (7.7, 6.6),
    "cnn-single": (7.6, 5.8),
    "cnn-multimodal": (6.4, 5.5),
}


# ------------------------------------------------------------------ Fig. 5: simulation study


def paper_scenes(
    description: SensorDescription,
    seed_set: SeedSet,
    count: int = SCENES,
    *,
    contacts: Iterable[int] = COUNTS,
    snr_db: float = 40.0,
) -> Iterator[Case]:
    """Test scenes of Fig. 5, drawn as the paper's training scenes are but from other seeds.

    Raises DataError where the sensor has a single channel, or no room for that many contacts.
    """
    require_channels(description, *Channel)
    assert description.magnitude is not None
    opposite = description.magnitude.response.sign > 0  # the paper's conductivity falls
    for contact_count in contacts:
        for number in range(count):
            rng = np.random.default_rng(seed_of(seed_set, "paper", contact_count, number))
            presses = paper_presses(description, rng, contact_count)
            plan = Plan(
                *((presses,), PAPER_CONTRAST, opposite, "ellipse"),
                unevenness=0.0,
                impedance_deviation=0.0,
            )
            yield still_case(description, plan, seed_set, number, snr_db)


@dataclass(frozen=True)
class Cell:
    """One point of Fig. 5: a method's measures over the scenes of one count and ratio."""

    method: str
    snr_db: float
    contacts: int
    summary: Summary


def cells(outcomes: Iterable[Outcome]) -> list[Cell]:
    """Points of Fig. 5 from what became of its scenes, which need not be kept."""
    scores: dict[tuple[str, float, int], list[Any]] = {}
    for outcome in outcomes:
        score = outcome.score
        scores.setdefault((outcome.method, score.snr_db, len(score.contacts)), []).append(score)
    return [Cell(*key, summarise(of_cell)) for key, of_cell in scores.items()]


# ------------------------------------------------------------------ Figs. 8 to 12: experiments


@dataclass(frozen=True)
class Area:
    """A round indenter, on the paper's sensor of 150 mm."""

    x_mm: float
    y_mm: float
    diameter_mm: float = 30.0


@dataclass(frozen=True)
class Arrangement:
    """One arrangement of indenters, pressed in one or more ways."""

    number: int  # the paper's
    areas: tuple[Area, ...]  # A1, A2, ...
    pressures_kpa: tuple[tuple[float, ...], ...]  # of each area, for each way
    # whether the arrangement is ours: the paper shows its own in a picture alone
    ours: bool = False


def _single(number: int, x_mm: float, y_mm: float, diameter_mm: float) -> Arrangement:
    return Arrangement(number, (Area(x_mm, y_mm, diameter_mm),), tuple((kpa,) for kpa in CASE_KPA))


LOW, HIGH = CASE_KPA[0], CASE_KPA[-1]
BOTH_WAYS: Final = tuple(product((LOW, HIGH), repeat=2))
SINGLE: Final = (
    _single(1, 0, 0, 30),
    _single(2, 36, 36, 30),
    _single(3, 0, 0, 40),
    _single(4, 36, 36, 40),
)
TWO: Final = (
    Arrangement(5, (Area(0, 0), Area(36, 36)), BOTH_WAYS),
    Arrangement(6, (Area(-36, -36, 40), Area(36, 36)), BOTH_WAYS),
)
MORE: Final = (
    Arrangement(7, (Area(-36, -36), Area(36, -36), Area(0, 36)), ((HIGH, LOW, HIGH),), ours=True),
    Arrangement(8, (Area(-36, 36, 40), Area(36, 36), Area(0, -36)), ((LOW, HIGH, LOW),), ours=True),
    Arrangement(
        9,
        (Area(-36, -36), Area(36, -36), Area(36, 36), Area(-36, 36)),
        ((HIGH, LOW, LOW, HIGH),),
        ours=True,
    ),
    Arrangement(
        10,
        (Area(-36, -36, 40), Area(36, -36), Area(36, 36), Area(-36, 36, 40)),
        ((HIGH, LOW, HIGH, LOW),),
        ours=True,
    ),
)
# Fig. 10 is one area pressed in turn in 25 places, which have no number of their own.
PLACES_MM: Final = tuple(product(GRID_MM * np.arange(-2, 3), repeat=2))
LOCALISATION: Final = tuple(
    Arrangement(0, (Area(float(x_mm), float(y_mm)),), ((HIGH,),)) for y_mm, x_mm in PLACES_MM
)


def presses_of(
    description: SensorDescription, case: Arrangement, pressures_kpa: Sequence[float]
) -> tuple[Press, ...]:
    """A case's indenters on a sensor, of the same share of its width as on the paper's."""
    millimetre_m = description.width_m / PAPER_WIDTH_MM
    return tuple(
        Press(
            area.x_mm * millimetre_m,
            area.y_mm * millimetre_m,
            kpa,
            area.diameter_mm / 2 * millimetre_m,
        )
        for area, kpa in zip(case.areas, pressures_kpa, strict=True)
    )


class Rig:
    """The paper's experiment platform (Fig. 6), simulated: a tared sensor, pressed and measured.

    Each `sheet` is uneven in its own way; `snr_db` is of the voltages at rest.

    Raises DataError where the sensor has a single channel.
    """

    def __init__(
        self,
        description: SensorDescription,
        seed_set: SeedSet,
        sheet: int,
        *,
        snr_db: float = RIG_SNR_DB,
    ) -> None:
        require_channels(description, *Channel)
        self.description = description
        self.sheet = sheet
        self._seed_set = seed_set
        rest = self._simulated(()).volts
        self._noise = {name: noise_std(rest, name, snr_db, "voltage") for name in BOTH_CHANNELS}
        self.tare = Reference.from_scans(*self._scans((), REFERENCE_SCANS).values())

    def _simulated(self, presses: tuple[Press, ...]) -> Simulated:
        plan = as_described(self.description, presses)
        return simulate(self.description, plan, seed_of(self._seed_set, "paper sheet", self.sheet))

    def _scans(self, presses: tuple[Press, ...], count: int) -> Volts:
        """So many scans (count, M) of each channel, volts, with noise."""
        rng = np.random.default_rng(seed_of(self._seed_set, f"paper noise {presses}", self.sheet))
        clean = self._simulated(presses).volts.pressed
        return {
            name: volts + self._noise[name] * rng.standard_normal((count, volts.shape[-1]))
            for name, volts in clean.items()
        }

    def press(self, presses: tuple[Press, ...]) -> Case:
        """One scan under these presses, after the tare."""
        simulated = self._simulated(presses)
        scans = {name: volts[0] for name, volts in self._scans(presses, 1).items()}
        frame = CaseFrame(dict(zip(CONTACT_NAMES, presses, strict=False)), scans)
        return Case(
            *(self._seed_set, self.sheet, simulated.plan, simulated.told, simulated.true),
            *(self.tare, [frame]),
        )


@dataclass(frozen=True)
class Frame:
    """What a method made of one press of one case."""

    case: Arrangement
    pressures_kpa: tuple[float, ...]
    sheet: int
    method: str
    made: Reconstruction
    truth: Truth

    @property
    def image(self) -> FloatArray:
        """The magnitude map; zeros where none was made."""
        blank = np.zeros_like(self.truth.map)
        return blank if self.made.map is None else self.made.map.astype(np.float64)

    @property
    def estimate(self) -> float:
        """How hard the whole image says is pressed, see `magnitude_estimate`."""
        return magnitude_estimate(self.image, self.method)


def image_cases(
    rigs: Iterable[Rig], arrangements: Sequence[Arrangement], methods: Sequence[str]
) -> Iterator[Frame]:
    """Press each arrangement on each sensor and reconstruct it from a cold start by each method."""
    for rig in rigs:
        player = Player(rig.description)
        for arrangement in arrangements:
            for pressures_kpa in arrangement.pressures_kpa:
                case = rig.press(presses_of(rig.description, arrangement, pressures_kpa))
                for method in methods:
                    (played,) = player.play(case, Variant(method))
                    yield Frame(
                        arrangement, pressures_kpa, rig.sheet, method, played.made, case.truth
                    )


def magnitude_estimate(values: FloatArray, method: str) -> float:
    """One number for how hard an image, or a part of it, says is pressed (the paper, V-C-2).

    The maximum of a linear image, which is smooth; else the mean of what exceeds 75 % of it.
    """
    peak = float(values.max(initial=0.0))
    if method in ("tikhonov", "noser") or peak == 0:
        return peak
    return float(values[values > TOP_SHARE * peak].mean())


@dataclass(frozen=True)
class MagnitudeError:
    """Figs. 8 and 9 in one number, of one method on one sensor."""

    method: str  # of reconstruction
    sheet: int  # number of the sensor
    # largest minus smallest estimate over the cases at one pressure, at the pressure where that is
    # largest, estimates divided by the largest of them all (0-1 normalisation); the paper's
    # definition
    error: float
    pressure_kpa: float  # that pressure
    of_range: float  # the same in shares of the sensor's range, the change at 200 kPa
    # likewise of the magnitudes that the contacts are reported with instead of the image's; NaN
    # where a case has none
    of_contacts: float
    rises: float  # share of the cases in which the estimate rises with every step of pressure


def magnitude_errors(
    frames: Iterable[Frame], description: SensorDescription
) -> list[MagnitudeError]:
    """The magnitude error of each method on each sensor, over cases 1 to 4."""
    groups: dict[tuple[str, int], list[Frame]] = {}
    for frame in frames:
        groups.setdefault((frame.method, frame.sheet), []).append(frame)
    return [_magnitude_error(*key, group, description) for key, group in groups.items()]


def _magnitude_error(
    method: str, sheet: int, frames: Sequence[Frame], description: SensorDescription
) -> MagnitudeError:
    full, grid = full_range(description), (len(SINGLE), len(CASE_KPA))  # frames come in that order
    image = np.array([frame.estimate for frame in frames]).reshape(grid)
    contacts = [largest_contact(frame.made.contacts) for frame in frames]
    contact = np.array([c.magnitude if c else np.nan for c in contacts]).reshape(grid)
    spread = np.ptp(image, axis=0)
    worst = int(spread.argmax())
    largest = float(image.max()) or 1.0
    return MagnitudeError(
        method=method,
        sheet=sheet,
        error=float(spread[worst]) / largest,
        pressure_kpa=CASE_KPA[worst],
        of_range=float(spread[worst]) / full,
        of_contacts=float(np.ptp(contact, axis=0).max()) / full,
        rises=float(np.mean((np.diff(image, axis=1) > 0).all(axis=1))),
    )


def largest_contact(contacts: Sequence[Contact]) -> Contact | None:
    """The one that stands for all where a single one presses; None where there is none."""
    return max(contacts, key=lambda contact: contact.area_m2, default=None)


def image_mass(image: FloatArray, description: SensorDescription) -> tuple[float, float]:
    """Centroid (x, y) of all of an image, metres; NaN of an empty one.

    The paper locates by it (V-C-3, after its reference 2). Blur and noise anywhere on the sheet
    have a say in it, which draws it towards the middle.
    """
    mass = float(image.sum())
    if not mass > 0:
        return float("nan"), float("nan")
    x = image.sum(axis=0) @ description.map_x_m / mass
    y = image.sum(axis=1) @ description.map_y_m / mass
    return float(x), float(y)


@dataclass(frozen=True)
class Localisation:
    """One arrow of Fig. 10."""

    method: str  # of reconstruction
    sheet: int  # number of the sensor
    # x_m, y_m: where the indenter was
    x_m: float
    y_m: float
    mass_m: tuple[float, float]  # (x, y) of the image's mass
    # (x, y) of the largest contact reported; NaN where there was none
    contact_m: tuple[float, float]
    contacts: int  # how many were reported
    # mass_error_mm, contact_error_mm: distances of both from the indenter
    mass_error_mm: float
    contact_error_mm: float


def locate(frame: Frame, description: SensorDescription) -> Localisation:
    """Where a frame of `LOCALISATION` says that the indenter is."""
    (true,) = frame.truth.contacts
    contact = largest_contact(frame.made.contacts)
    mass_m = image_mass(frame.image, description)
    contact_m = (contact.x_m, contact.y_m) if contact else (float("nan"), float("nan"))
    errors_mm = (1e3 * float(np.hypot(x - true.x_m, y - true.y_m)) for x, y in (mass_m, contact_m))
    return Localisation(
        *(frame.method, frame.sheet, true.x_m, true.y_m, mass_m, contact_m),
        len(frame.made.contacts),
        *errors_mm,
    )


@dataclass(frozen=True)
class SeveralAreas:
    """How one frame of two to four areas came out, in numbers for Figs. 11 and 12."""

    case: int  # the paper's number
    pressures_kpa: tuple[float, ...]  # of its areas
    method: str  # of reconstruction
    sheet: int  # number of the sensor
    icc: float  # of the map
    # of each area, see `magnitude_estimate`, from the image within its outline
    estimates: tuple[float, ...]
    # whether, on the way between any two areas, the image falls below half of the paler one
    told_apart: bool
    counted: bool  # whether as many contacts were reported as press

    @property
    def ordered(self) -> tuple[bool, ...]:
        """Of each pair of areas under unlike pressures: whether the harder pressed reads higher."""
        return tuple((p - q) * (a - b) > 0 for (p, a), (q, b) in self._pairs() if p != q)

    @property
    def alike(self) -> tuple[float, ...]:
        """Of each pair of areas under one pressure: the paler reading over the other one."""
        return tuple(min(a, b) / (max(a, b) or 1.0) for (p, a), (q, b) in self._pairs() if p == q)

    def _pairs(self) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
        return combinations(zip(self.pressures_kpa, self.estimates, strict=True), 2)


def read_areas(frame: Frame, description: SensorDescription) -> SeveralAreas:
    """Measure a frame of several areas."""
    presses = presses_of(description, frame.case, frame.pressures_kpa)
    x, y = np.meshgrid(description.map_x_m, description.map_y_m)
    inside = [press.coverage(x, y, edge_m=1e-9) > 0.5 for press in presses]
    estimates = tuple(magnitude_estimate(frame.image[area], frame.method) for area in inside)
    return SeveralAreas(
        case=frame.case.number,
        pressures_kpa=frame.pressures_kpa,
        method=frame.method,
        sheet=frame.sheet,
        icc=correlation(frame.image, frame.truth.map),
        estimates=estimates,
        told_apart=_told_apart(frame.image, presses, estimates, description),
        counted=len(frame.made.contacts) == len(presses),
    )


def _told_apart(
    image: FloatArray,
    presses: Sequence[Press],
    estimates: Sequence[float],
    description: SensorDescription,
) -> bool:
    grid = (description.map_y_m, description.map_x_m)
    value = RegularGridInterpolator(grid, image)
    share = np.linspace(0, 1, 101)[:, None]
    for (one, high), (other, low) in combinations(zip(presses, estimates, strict=True), 2):
        ends = [np.array([press.y_m, press.x_m]) for press in (one, other)]
        between = value((1 - share) * ends[0] + share * ends[1])
        if not between.min() < 0.5 * min(high, low):
            return False
    return True
