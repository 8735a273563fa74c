"""Measures of a reconstruction against the truth, one scene's and many scenes'.

RIE = |p - g| / |g| and ICC = Pearson correlation of the two images, g the true one. Contacts are
matched to the true ones by the assignment that moves them least; one that is left over, or farther
than `MATCH_M`, is a miss or a false one. Magnitude errors are shares of the sensor's range, the
change at `FULL_RANGE_KPA`, as the paper's are, which normalises by it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.plausibility import DISTRUST
from tactomo_models.scene.contacts import Contact
from tactomo_models.scene.press import Press
from tactomo_models.scene.pressure import PressureRange, described_curve
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.scenes.case import Case, Frame
from tactomo_lab.scenes.drawing import PRESSURE_KPA, gap_m
from tactomo_lab.scenes.simulation import TrueContact

Key = TypeVar("Key")

MATCH_M = 0.012  # centres farther apart belong to different contacts
BAD_ICC = 0.7  # one that correlates less should have been flagged
RIGHT_PEAK = 0.10  # largest relative error of a peak pressure that is right
SURE_SIGMAS = 3.0  # standard uncertainties that an error exceeds in one of 370 honest reports
TWO_SIDED_95 = 1.96  # standard uncertainties that 95 % of a normal distribution lie within
FULL_RANGE_KPA = PRESSURE_KPA[1]


def correlation(image: NDArray[Any] | None, truth: FloatArray) -> float:
    """ICC of an image with the truth, where the image is known; 0 without an image or contrast."""
    if image is None:
        return 0.0
    on = np.isfinite(image)
    shown, true = image[on], truth[on]
    if not shown.size or not np.ptp(shown) > 0 or not np.ptp(true) > 0:
        return 0.0
    return float(np.corrcoef(shown, true)[0, 1])


def relative_error(image: NDArray[Any] | None, truth: FloatArray) -> float:
    """RIE of an image; 1 where there is none: as of an empty one."""
    if image is None:
        return 1.0
    on = np.isfinite(image)
    return float(np.linalg.norm(image[on] - truth[on]) / np.linalg.norm(truth))


def match(found: Sequence[Contact], true: Sequence[TrueContact]) -> list[tuple[int, int]]:
    """Pairs of positions in both that are one contact, by least total distance."""
    if not found or not true:
        return []
    here, there = (np.array([(c.x_m, c.y_m) for c in contacts]) for contacts in (found, true))
    distance = cdist(here, there)
    # Too far costs alike: such a pair is made only where nothing better is left, and dropped.
    pairs = zip(*linear_sum_assignment(np.minimum(distance, MATCH_M)), strict=True)
    return [(int(i), int(j)) for i, j in pairs if distance[i, j] < MATCH_M]


@dataclass(frozen=True)
class ContactScore:
    """How one true contact was found."""

    shape: str  #: of the indenter
    area_mm2: float  #: true area
    pressure_kpa: float  #: true pressure
    magnitude: float  #: true |relative conductivity change|
    #: distance of the centroids; NaN if missed, as everything below
    centre_error_mm: float = float("nan")
    magnitude_error: float = float("nan")  #: found minus true, as a share of the range
    #: its standard uncertainty as reported, as a share of the range
    magnitude_sigma: float = float("nan")
    #: relative error of the peak pressure, or of the pressure where no peak was reported; NaN, too,
    #: where neither was
    peak_error: float = float("nan")
    #: x_error_sigmas, y_error_sigmas, area_error_sigmas, peak_error_sigmas: errors of place, area
    #: and peak over their standard uncertainties; NaN, too, where none was reported
    x_error_sigmas: float = float("nan")
    y_error_sigmas: float = float("nan")
    area_error_sigmas: float = float("nan")
    peak_error_sigmas: float = float("nan")
    beyond: bool = False  #: whether its true peak lies above the response table's end
    above: bool = False  #: whether its pressure was reported as above the range
    #: whether nothing finite was claimed of its peak: above the range or without an upper bound,
    #: and without an uncertainty
    unbounded: bool = False

    @property
    def missed(self) -> bool:
        """Whether nothing was found there."""
        return bool(np.isnan(self.centre_error_mm))

    @property
    def peak_right(self) -> bool:
        """Whether it was found with its peak pressure to `RIGHT_PEAK`; unbounded, if beyond."""
        return self.unbounded if self.beyond else abs(self.peak_error) <= RIGHT_PEAK

    @property
    def denied(self) -> bool:
        """Whether it lies beyond the table and the 95 % interval of its peak does not reach it."""
        return self.beyond and self.peak_error_sigmas < -TWO_SIDED_95

    @property
    def surely_wrong(self) -> bool | None:
        """Whether its peak is off by more than it may be, and by more than was said.

        That is by more than `RIGHT_PEAK` and `SURE_SIGMAS` standard uncertainties; or it is
        reported above the range's top and lies below that by more than `RIGHT_PEAK`. None where
        nothing was claimed: missed, below the range or unknown, or without an uncertainty.
        """
        if self.above:
            return self.peak_error > RIGHT_PEAK
        if not np.isfinite(self.peak_error_sigmas):
            return None
        return abs(self.peak_error) > RIGHT_PEAK and abs(self.peak_error_sigmas) > SURE_SIGMAS


@dataclass(frozen=True)
class Score:
    """How one frame was reconstructed.

    Where nothing presses hard enough to show in the map, or a scan was lost and there is no map,
    the map's measures are NaN; likewise the shape's.
    """

    scene: str  #: the case's name, e.g. "tuning 3/17"
    phase: str  #: of a moving scene
    contacts: tuple[ContactScore, ...]  #: one for each true contact that touches no other
    found: int  #: contacts reported
    groups: int  #: how many press, those that touch counted as one
    countable: bool  #: whether that number is clear, and no scan was lost
    switches: int  #: contacts that another identity was given to than they had
    #: rie, icc: of the magnitude map
    rie: float
    icc: float
    icc_structure: float  #: of the pressed shape
    flags: tuple[str, ...]  #: names of what was flagged
    has_map: bool  #: whether any was made
    tier: str  #: what made it
    #: reason, misfit, confidence: as reported
    reason: str
    misfit: float
    confidence: float
    seconds: float  #: that it took
    #: shape, contrast, snr_db: of the case
    shape: str
    contrast: float
    snr_db: float
    #: relative error of the force of all contacts together; NaN where none was reported
    force_error: float = float("nan")

    @property
    def count_right(self) -> bool | None:
        """Whether as many contacts were reported as there are; None where that is not clear."""
        return self.found == self.groups if self.countable else None

    @property
    def bad(self) -> bool:
        """Whether its map should have been flagged."""
        return self.likeness < BAD_ICC

    @property
    def likeness(self) -> float:
        """Its ICC where presses show in the map; else that of the pressed shape.

        Where nothing presses, 1 if nothing was reported, else 0.
        """
        if not self.groups:
            return float(not self.found)
        known = [icc for icc in (self.icc, self.icc_structure) if np.isfinite(icc)]
        return known[0] if known else 0.0

    @property
    def warned(self) -> bool:
        """Whether a flag of `DISTRUST`, or the lack of a map, told not to trust it."""
        return not self.has_map or not set(self.flags).isdisjoint(DISTRUST.names())

    def as_json(self) -> dict[str, Any]:
        """All of it as numbers and names."""
        derived = ("count_right", "likeness", "warned")
        return {**asdict(self), **{name: getattr(self, name) for name in derived}}


def score(
    case: Case,
    frame: Frame,
    made: Reconstruction,
    seconds: float,
    identities: dict[str, int],  # last given to each true contact; brought up to date
) -> Score:
    """Compare a reconstruction of a case's frame with the truth."""
    truth = case.truth_of(frame)
    lost = set(case.description.channels) - frame.scans.keys()
    groups = touching(frame.presses)
    contacts = dict(zip(frame.presses, truth.contacts, strict=True))
    alone = {group[0]: contacts[group[0]] for group in groups if len(group) == 1}
    of_contacts = list(alone.values())
    taken = {there: made.contacts[here] for here, there in match(made.contacts, of_contacts)}
    of_map = _likeness(made.map, truth.map, bool(lost))
    has_structure = case.description.structure is not None
    of_shape = _likeness(made.structure, truth.pressed, bool(lost) or not has_structure)
    # Without a magnitude channel the shape is the map.
    (rie, icc), (_, icc_structure) = of_map if case.description.magnitude else of_shape, of_shape
    return Score(
        scene=case.name,
        phase=frame.phase,
        contacts=tuple(
            score_contact(case.description, each, taken.get(index))
            for index, each in enumerate(of_contacts)
        ),
        found=len(made.contacts),
        groups=len(groups),
        countable=frame.countable and not lost,
        switches=_switches(alone, made, identities),
        rie=rie,
        icc=icc,
        icc_structure=icc_structure,
        flags=tuple(made.flags.names()),
        has_map=made.map is not None or made.structure is not None,
        tier=made.tier,
        reason=made.reason,
        misfit=made.misfit,
        confidence=made.confidence,
        seconds=seconds,
        shape=case.shape,
        contrast=case.plan.contrast,
        snr_db=case.plan.snr_db,
        force_error=made.force_n / truth.force_n - 1 if truth.force_n else float("nan"),
    )


def _likeness(
    image: NDArray[Any] | None, truth: FloatArray, is_excused: bool
) -> tuple[float, float]:
    """RIE and ICC of an image; NaN where there is nothing to show, or no scan to make it of."""
    if not truth.any() or (image is None and is_excused):
        return float("nan"), float("nan")
    return relative_error(image, truth), correlation(image, truth)


def touching(presses: Mapping[str, Press]) -> list[list[str]]:
    """Names of the contacts, in groups that touch each other."""
    groups: list[list[str]] = []
    for name, press in presses.items():
        met = [g for g in groups if any(gap_m(press, presses[other]) == 0 for other in g)]
        groups = [group for group in groups if group not in met]
        groups.append([name, *(other for group in met for other in group)])
    return groups


def _switches(
    contacts: Mapping[str, TrueContact], made: Reconstruction, known: dict[str, int]
) -> int:
    """Contacts that are given another identity now; one that merged or lifted starts anew."""
    names, switched = list(contacts), 0
    for name in known.keys() - contacts.keys():
        del known[name]
    for here, there in match(made.contacts, list(contacts.values())):
        given = made.contacts[here].id
        switched += known.get(names[there], given) != given
        known[names[there]] = given
    return switched


def score_contact(
    description: SensorDescription, true: TrueContact, found: Contact | None
) -> ContactScore:
    """Compare a contact with the true one that it is taken for; None where there is none."""
    curve = described_curve(description)
    known = ContactScore(
        shape=true.shape,
        area_mm2=true.area_m2 * 1e6,
        pressure_kpa=true.pressure_kpa,
        magnitude=true.magnitude,
        beyond=curve is not None and true.pressure_kpa > curve.range_kpa[1],
    )
    if found is None:
        return known
    full = full_range(description)
    is_above = found.pressure_range is PressureRange.ABOVE
    is_bare = not np.isfinite(found.peak_sigma_kpa)
    peak_kpa = found.peak_kpa if np.isfinite(found.peak_kpa) else found.pressure_kpa
    return replace(
        known,
        centre_error_mm=1e3 * float(np.hypot(found.x_m - true.x_m, found.y_m - true.y_m)),
        magnitude_error=(found.magnitude - true.magnitude) / full,
        magnitude_sigma=found.magnitude_sigma / full,
        peak_error=peak_kpa / true.pressure_kpa - 1,
        x_error_sigmas=_sigmas(found.x_m - true.x_m, found.x_sigma_m),
        y_error_sigmas=_sigmas(found.y_m - true.y_m, found.y_sigma_m),
        area_error_sigmas=_sigmas(found.area_m2 - true.area_m2, found.area_sigma_m2),
        peak_error_sigmas=_sigmas(found.peak_kpa - true.pressure_kpa, found.peak_sigma_kpa),
        above=is_above,
        unbounded=is_bare and (is_above or bool(np.isposinf(found.max_kpa))),
    )


def _sigmas(error: float, sigma: float) -> float:
    return error / sigma if sigma > 0 else float("nan")


def full_range(description: SensorDescription) -> float:
    """Size of the relative change at the end of the measuring range; NaN where there is none."""
    if description.magnitude is None:
        return float("nan")
    return float(np.abs(description.magnitude.response.change(np.array(FULL_RANGE_KPA))))


@dataclass(frozen=True)
class Summary:
    """Many frames' measures. Means, where nothing else is said; NaN where nothing was measured.

    Shares of contacts are of the true ones; errors of the magnitude are shares of the range.
    """

    frames: int  #: of a scene one each where scenes are still
    #: icc, rie: of the magnitude map
    icc: float
    icc_worst: float  #: that 95 % exceed
    rie: float
    icc_structure: float  #: of the pressed shape
    count_right: float
    missed: float
    false: float  #: contacts too many in a frame
    #: centre_mm, centre_mm_95: median and 95th percentile, of matched contacts
    centre_mm: float
    centre_mm_95: float
    magnitude_error: float  #: its size
    #: within_sigma, place_within_sigma, area_within_sigma, peak_within_sigma: errors of magnitude,
    #: of x and y, of area and peak within one reported standard uncertainty
    within_sigma: float
    place_within_sigma: float
    area_within_sigma: float
    peak_within_sigma: float
    #: `ContactScore.peak_right`, of those that the magnitude channel answers to
    peak_right: float
    #: `ContactScore.surely_wrong`, of those told with an uncertainty or as above the range
    peak_surely_wrong: float
    #: overload_right, overload_wrong: `ContactScore.unbounded` and `denied`, of contacts beyond the
    #: response table
    overload_right: float
    overload_wrong: float
    #: force_error, force_error_several: its size, where one contact presses and where several do
    force_error: float
    force_error_several: float
    #: warned, bad_unflagged, good_flagged: `Score.warned`, of all; bad maps without; good ones with
    warned: float
    bad_unflagged: float
    good_flagged: float
    #: seconds, seconds_99: of processor time, median and 99th percentile
    seconds: float
    seconds_99: float


def summarise(scores: Sequence[Score]) -> Summary:
    """Measures of at least one frame."""
    contacts = [contact for one in scores for contact in one.contacts]
    matched = [contact for contact in contacts if not contact.missed]
    centre = np.array([contact.centre_error_mm for contact in matched])
    error = np.array([contact.magnitude_error for contact in matched])
    sigma = np.array([contact.magnitude_sigma for contact in matched])
    place = [e for contact in matched for e in (contact.x_error_sigmas, contact.y_error_sigmas)]
    seconds = [one.seconds for one in scores]
    icc = [one.icc for one in scores]
    return Summary(
        frames=len(scores),
        icc=mean(icc),
        icc_worst=percentile(icc, 5),
        rie=mean(one.rie for one in scores),
        icc_structure=mean(one.icc_structure for one in scores),
        count_right=mean(one.count_right for one in scores),
        missed=mean(contact.missed for contact in contacts),
        false=mean(one.found - sum(not c.missed for c in one.contacts) for one in scores),
        centre_mm=percentile(centre, 50),
        centre_mm_95=percentile(centre, 95),
        magnitude_error=mean(np.abs(error)),
        within_sigma=mean(np.where(np.isfinite(error), np.abs(error) <= sigma, np.nan)),
        place_within_sigma=_share_within_one(place),
        area_within_sigma=_share_within_one([contact.area_error_sigmas for contact in matched]),
        peak_within_sigma=_share_within_one([contact.peak_error_sigmas for contact in matched]),
        peak_right=mean(contact.peak_right for contact in contacts if contact.magnitude > 0),
        peak_surely_wrong=mean(
            wrong for contact in matched if (wrong := contact.surely_wrong) is not None
        ),
        overload_right=mean(contact.unbounded for contact in contacts if contact.beyond),
        overload_wrong=mean(contact.denied for contact in contacts if contact.beyond),
        force_error=mean(abs(one.force_error) for one in scores if one.groups == 1),
        force_error_several=mean(abs(one.force_error) for one in scores if one.groups > 1),
        warned=mean(one.warned for one in scores),
        bad_unflagged=mean(one.bad and not one.warned for one in scores),
        good_flagged=mean(one.warned for one in scores if not one.bad),
        seconds=percentile(seconds, 50),
        seconds_99=percentile(seconds, 99),
    )


def summarise_by(scores: Iterable[tuple[Key, Score]]) -> dict[Key, Summary]:
    """Sum up scores by the key of each, in the order in which keys come first."""
    of: dict[Key, list[Score]] = {}
    for key, one in scores:
        of.setdefault(key, []).append(one)
    return {key: summarise(own) for key, own in of.items()}


def _share_within_one(errors: Sequence[float]) -> float:
    return mean(abs(error) <= 1 for error in errors if np.isfinite(error))


def mean(values: Iterable[Any]) -> float:
    """Mean of the numbers among some values; NaN where there are none."""
    known = _known(values)
    return float(known.mean()) if len(known) else float("nan")


def percentile(values: Iterable[Any], percent: float) -> float:
    """Percentile of the numbers among some values; NaN where there are none."""
    known = _known(values)
    return float(np.percentile(known, percent)) if len(known) else float("nan")


def _known(values: Iterable[Any]) -> FloatArray:
    array = np.array(list(values), dtype=np.float64)
    return array[np.isfinite(array)]
