"""The paper's evaluation, repeated on simulated skins (Chen et al., sections IV and V).

Its simulation study (Fig. 5) is repeated as it is described: one to four ellipses that conduct
worse than an even sheet, a contrast of 100 in the structure channel, white Gaussian noise. "SNR of
the data" is read as that of the voltage *changes*, which are the data of its equations.

Its experiments (Figs. 8 to 10) were made with hardware: round indenters on a real skin. Here they
are made with simulated ones, `Rig`: sheets uneven by 5 %, contact impedances by 20 %, conductivity
that rises under pressure, noise of equal size on every voltage, one scan a press after one tare.
The paper has one sensor; here several sheets tell what is chance.

Nothing that inverts knows the mesh that simulates; see `simulation`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
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
from tactomo_lab.scenes.measures import Summary, full_range, summarise
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


# ------------------------------------------------------------------ Figs. 8 to 10: experiments


@dataclass(frozen=True)
class Indentation:
    """A round indenter in one place, on the paper's sensor of 150 mm, pressed in turn."""

    number: int  # the paper's; 0 of Fig. 10, whose places have none
    x_mm: float
    y_mm: float
    diameter_mm: float = 30.0
    pressures_kpa: tuple[float, ...] = CASE_KPA

    def press(self, description: SensorDescription, pressure_kpa: float) -> Press:
        """Press another sensor in the place, and on the area, of the same share of its width."""
        millimetre_m = description.width_m / PAPER_WIDTH_MM
        return Press(
            self.x_mm * millimetre_m,
            self.y_mm * millimetre_m,
            pressure_kpa,
            self.diameter_mm / 2 * millimetre_m,
        )


SINGLE: Final = (
    Indentation(1, 0, 0),
    Indentation(2, 36, 36),
    Indentation(3, 0, 0, 40),
    Indentation(4, 36, 36, 40),
)
LOCALISATION: Final = tuple(
    Indentation(0, float(x_mm), float(y_mm), pressures_kpa=CASE_KPA[-1:])
    for y_mm, x_mm in product(GRID_MM * np.arange(-2, 3), repeat=2)
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

    case: Indentation
    pressure_kpa: float
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
    rigs: Iterable[Rig], cases: Sequence[Indentation], methods: Sequence[str]
) -> Iterator[Frame]:
    """Press each sensor in each case and reconstruct it from a cold start by each method."""
    for rig, case in product(rigs, cases):
        player = Player(rig.description)
        for pressure_kpa in case.pressures_kpa:
            pressed = rig.press((case.press(rig.description, pressure_kpa),))
            for method in methods:
                (played,) = player.play(pressed, Variant(method))
                yield Frame(case, pressure_kpa, rig.sheet, method, played.made, pressed.truth)


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
