"""The paper's evaluation, repeated on simulated skins (Chen et al., sections IV and V).

Its simulation study (Fig. 5) is repeated as it is described: one to four ellipses that conduct
worse than an even sheet, a contrast of 100 in the structure channel, white Gaussian noise. "SNR of
the data" is read as that of the voltage *changes*, which are the data of its equations.

Its experiments (Figs. 8 to 10) were made with hardware: a round indenter on a real skin. Here they
are made with simulated ones: sheets uneven by 5 %, contact impedances by 20 %, conductivity
that rises under pressure, noise of equal size on every voltage, one scan a press after one tare.
The paper has one sensor; here several sheets tell what is chance. Its Figs. 11 and 12 have several
indenters and no numbers to compare with.

Nothing that inverts knows the mesh that simulates; see `simulation`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.contacts import Contact
from tactomo_models.scene.press import Press
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.simulation.simulator import noisy
from tactomo_protocol import Channel

from tactomo_lab.evaluation.play import Outcome
from tactomo_lab.scenes.case import (
    REFERENCE_SCANS,
    Case,
    Frame,
    Plan,
    Simulated,
    as_described,
    noise_stds,
    simulate,
    still_case,
)
from tactomo_lab.scenes.drawing import SeedSet, require_channels, seed_of
from tactomo_lab.scenes.measures import Summary, full_range, summarise_by
from tactomo_lab.scenes.presets import PAPER_CONTACTS, PAPER_CONTRAST, paper_presses
from tactomo_lab.scenes.simulation import Volts

# The paper's three, then ours.
DEFAULT_METHODS: Final = ("tikhonov", "cnn-single", "cnn-multimodal", "network", "auto")

SNR_DB: Final = (float("inf"), 40.0, 20.0, 10.0)  # of Fig. 5
COUNTS: Final = tuple(range(1, PAPER_CONTACTS + 1))

PAPER_WIDTH_MM: Final = 150.0  # places and sizes are shares of it on another sensor
PRESSED_SNR_DB: Final = 60.0  # of the voltages at rest: a tank that was measured had 58
CASE_KPA: Final = (140.0, 160.0, 180.0, 200.0)  # of Figs. 8 and 9
TOP_SHARE: Final = 0.75  # of an image's maximum, above which values are averaged (V-C-2)
GRID_MM: Final = 18.0  # of the holes that indenters are held by

# What the paper prints, measured on hardware. Figs. 8 and 9: the magnitude error, and the pressure
# at which the error was that large, kPa. Fig. 10: mean and standard deviation, mm.
PAPER_MAGNITUDE_ERROR: Final = {
    "tikhonov": {"error": 0.76, "pressure_kpa": 200.0},
    "cnn-single": {"error": 0.57, "pressure_kpa": 160.0},
    "cnn-multimodal": {"error": 0.21, "pressure_kpa": 180.0},
}
PAPER_LOCALISATION_MM: Final = {
    "tikhonov": {"mean_mm": 7.7, "std_mm": 6.6},
    "cnn-single": {"mean_mm": 7.6, "std_mm": 5.8},
    "cnn-multimodal": {"mean_mm": 6.4, "std_mm": 5.5},
}


# ------------------------------------------------------------------ Fig. 5: simulation study


def paper_scenes(
    description: SensorDescription, seed_set: SeedSet, count: int, snr_db: float
) -> Iterator[Case]:
    """Test scenes of Fig. 5, drawn as the paper's training scenes are but from other seeds.

    There are `count` of each number of contacts.

    Raises DataError where the sensor has a single channel, or no room for that many contacts.
    """
    require_channels(description, *Channel)
    assert description.magnitude is not None
    opposite = description.magnitude.response.sign > 0  # the paper's conductivity falls
    for contacts, number in product(COUNTS, range(count)):
        rng = np.random.default_rng(seed_of(seed_set, "paper", contacts, number))
        presses = paper_presses(description, rng, contacts)
        plan = Plan(
            *((presses,), PAPER_CONTRAST, opposite, "ellipse"),
            unevenness=0.0,
            impedance_deviation=0.0,
        )
        yield still_case(description, plan, seed_set, number, snr_db)


def points_of(outcomes: Iterable[Outcome]) -> dict[tuple[str, float, int], Summary]:
    """Points of Fig. 5 by method, ratio and count; the outcomes need not be kept."""
    return summarise_by(
        ((each.method, each.score.snr_db, len(each.score.contacts)), each.score)
        for each in outcomes
    )


# ------------------------------------------------------------------ Figs. 8 to 10: experiments


def single_areas(description: SensorDescription) -> list[Press]:
    """What presses in cases 1 to 4 (Figs. 8 and 9), each with `CASE_KPA`."""
    places = ((0, 0, 30), (36, 36, 30), (0, 0, 40), (36, 36, 40))  # x, y, diameter in mm
    return [_indenter(description, *place, kpa) for place, kpa in product(places, CASE_KPA)]


def places(description: SensorDescription) -> list[Press]:
    """What presses in Fig. 10: one area in turn in 25 places."""
    along_mm = [GRID_MM * step for step in range(-2, 3)]
    return [_indenter(description, x, y, 30, CASE_KPA[-1]) for y, x in product(along_mm, along_mm)]


def _indenter(
    description: SensorDescription, x_mm: float, y_mm: float, diameter_mm: float, kpa: float
) -> Press:
    millimetre_m = description.width_m / PAPER_WIDTH_MM
    return Press(x_mm * millimetre_m, y_mm * millimetre_m, kpa, diameter_mm / 2 * millimetre_m)


def pressed_in_turn(
    description: SensorDescription,
    seed_set: SeedSet,
    sheet: int,  # its number: each is uneven in its own way
    presses: Iterable[Press],
) -> Iterator[Case]:
    """One scan under each press, after the one tare of a sensor: the paper's rig (Fig. 6).

    Raises DataError where the sensor has a single channel.
    """
    require_channels(description, *Channel)

    def simulated(*presses: Press) -> Simulated:
        plan = as_described(description, presses)
        return simulate(description, plan, seed_of(seed_set, "paper sheet", sheet))

    bare = simulated()
    noise_v = noise_stds(bare.volts, PRESSED_SNR_DB, "voltage")

    def scans(made: Simulated, count: int) -> Volts:
        (presses,) = made.plan.frames
        rng = np.random.default_rng(seed_of(seed_set, f"paper noise {presses}", sheet))
        return noisy(made.volts.pressed, noise_v, rng, count)

    tare = Reference.from_scans(*scans(bare, REFERENCE_SCANS).values())
    for press in presses:
        made = simulated(press)
        frame = Frame({"A": press}, {name: volts[0] for name, volts in scans(made, 1).items()})
        yield Case(seed_set, sheet, made.plan, made.told, made.true, tare, [frame])


def image_of(outcome: Outcome) -> FloatArray:
    """The magnitude map; zeros where none was made."""
    shown = outcome.made.map
    return np.zeros_like(outcome.case.truth.map) if shown is None else shown.astype(np.float64)


def magnitude_estimate(values: FloatArray, method: str) -> float:
    """One number for how hard an image says is pressed (the paper, V-C-2).

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
    # `magnitude_estimate` of each case by each of `CASE_KPA`
    estimates: list[list[float]]
    # largest minus smallest estimate over the cases at one pressure, at the pressure where that is
    # largest, estimates divided by the largest of them all (0-1 normalisation); the paper's
    # definition
    error: float
    pressure_kpa: float  # that pressure
    of_range: float  # the same in shares of the sensor's range, the change at 200 kPa
    # likewise of the magnitudes that the contacts are reported with instead of the image's; NaN
    # where a case has none
    of_contacts: float


def magnitude_errors(
    outcomes: Iterable[Outcome], description: SensorDescription
) -> list[MagnitudeError]:
    """The magnitude error of each method on each sensor, over what `single_areas` press."""
    groups: dict[tuple[str, int], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault((outcome.method, outcome.case.number), []).append(outcome)
    return [_magnitude_error(*key, group, description) for key, group in groups.items()]


def _magnitude_error(
    method: str, sheet: int, outcomes: Sequence[Outcome], description: SensorDescription
) -> MagnitudeError:
    full, grid = full_range(description), (-1, len(CASE_KPA))  # outcomes come in that order
    image = np.array([magnitude_estimate(image_of(o), method) for o in outcomes]).reshape(grid)
    contacts = [largest_contact(outcome.made.contacts) for outcome in outcomes]
    contact = np.array([c.magnitude if c else np.nan for c in contacts]).reshape(grid)
    spread = np.ptp(image, axis=0)
    worst = int(spread.argmax())
    return MagnitudeError(
        method=method,
        sheet=sheet,
        estimates=image.tolist(),
        error=float(spread[worst]) / (float(image.max()) or 1.0),
        pressure_kpa=CASE_KPA[worst],
        of_range=float(spread[worst]) / full,
        of_contacts=float(np.ptp(contact, axis=0).max()) / full,
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
    contacts: int  # how many were reported
    # distances from the indenter of the image's mass, and of the largest contact reported; NaN
    # where there was none
    mass_error_mm: float
    contact_error_mm: float


def locate(outcome: Outcome) -> Localisation:
    """Where one of `places` is said to be pressed."""
    (true,) = outcome.case.truth.contacts
    contact = largest_contact(outcome.made.contacts)
    mass_m = image_mass(image_of(outcome), outcome.case.description)
    contact_m = (contact.x_m, contact.y_m) if contact else (float("nan"), float("nan"))
    errors_mm = (1e3 * float(np.hypot(x - true.x_m, y - true.y_m)) for x, y in (mass_m, contact_m))
    return Localisation(
        *(outcome.method, outcome.case.number, true.x_m, true.y_m),
        len(outcome.made.contacts),
        *errors_mm,
    )
