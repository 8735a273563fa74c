"""The reference: the unpressed scan that changes are measured against, and its noise."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.robust import robust_sigma
from tactomo_models.scans.frame_noise import is_noise
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.pattern import reciprocal_pairs

NOISE_SCANS = 4096  # of a longer file, so many tell the noise
TRUSTED_SCANS = 20  # a variance from as many is known to a third
MIN_TREND_SCANS = 10  # fewer may lie on a line by chance where gain noise moves all voltages alike


@dataclass(frozen=True)
class Reference:
    """Voltages of the unpressed skin; None for a channel that is not there."""

    magnitude: FloatArray | None  #: (M,) volts
    structure: FloatArray | None  #: (M,) volts
    #: (M,) standard deviation of one scan, volts; None where unknown
    magnitude_noise: FloatArray | None = None
    structure_noise: FloatArray | None = None  #: (M,) likewise
    scans: int = 1  #: how many were averaged
    #: (M,) logarithm of the factor by which each voltage has drifted since; None where nothing has
    #: been followed
    magnitude_drift: FloatArray | None = None
    structure_drift: FloatArray | None = None  #: (M,) likewise
    #: (M,) the part of that in which a touch may be hidden: creep, and what no drift explains
    magnitude_creep: FloatArray | None = None
    structure_creep: FloatArray | None = None  #: (M,) likewise

    #: names of companions and their mean readings at rest, in their own units
    companions: Collection[tuple[str, float]] | None = None
    #: whether scans at rest told the noise; else reciprocity did, and it is an upper bound
    is_noise_measured: bool = True

    @property
    def lacks_noise(self) -> bool:
        """Whether no channel's noise is known: the reference is a single scan, for all it says."""
        is_unknown = self.magnitude_noise is None and self.structure_noise is None
        return is_unknown and self.scans == 1

    def with_noise_of(
        self,
        description: SensorDescription,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
    ) -> Reference:
        """The same with the noise of scans (M,) or (n, M), pressed or not, by reciprocity.

        Of how many scans the reference is the mean follows, too; see `_noise_against`.
        """
        some = [s if s is None else s[:: 1 + len(s) // NOISE_SCANS] for s in (magnitude, structure)]
        pairs = zip((self.magnitude, self.structure), some, strict=True)
        seen = [
            None if v is None or s is None else _noise_against(description, v, s) for v, s in pairs
        ]
        return replace(
            self,
            magnitude_noise=seen[0][0] if seen[0] else None,
            structure_noise=seen[1][0] if seen[1] else None,
            scans=min((each[1] for each in seen if each), default=1),
            is_noise_measured=False,
        )

    def is_at_rest(self, scans: Mapping[Channel, FloatArray]) -> bool:
        """Whether noise alone explains how scans (M,) differ from this one; no drift, no model."""
        for channel, scan in scans.items():
            rest, noise = getattr(self, channel), getattr(self, f"{channel}_noise")
            if rest is None or noise is None:
                return False
            told = noise > 0
            squares = ((scan - rest)[told] / noise[told]) ** 2 / (1 + 1 / self.scans)
            if not is_noise(squares, freedom=max(1, self.scans - 1) * squares.size):
                return False
        return bool(scans)

    def is_followed_from(self, other: Reference) -> bool:
        """Whether this is another one's tare, drifted."""
        has_drift = self.magnitude_drift is not None or self.structure_drift is not None
        return has_drift and all(
            _same(getattr(self, name), getattr(other, name)) for name in _TAKEN
        )

    def taken_as_it_is(self) -> Reference:
        """The same voltages as a tare of its own, drift included."""
        return replace(
            self,
            magnitude=_drifted(self.magnitude, self.magnitude_drift),
            structure=_drifted(self.structure, self.structure_drift),
            magnitude_drift=None,
            structure_drift=None,
            magnitude_creep=None,
            structure_creep=None,
        )

    @classmethod
    def from_scans(cls, magnitude: FloatArray | None, structure: FloatArray | None) -> Reference:
        """Average scans (n, M) of an unpressed skin and estimate their noise.

        Raises DataError where there is no scan, or one of the voltages is not a number.
        """
        present = [scans for scans in (magnitude, structure) if scans is not None]
        if not present or any(len(scans) == 0 for scans in present):
            raise DataError("no scans to take a reference from; wait for data and tare again")
        if not all(np.isfinite(scans).all() for scans in present):
            raise DataError("the reference scans hold voltages that are not numbers; tare again")
        return cls(
            magnitude=None if magnitude is None else magnitude.mean(axis=0),
            structure=None if structure is None else structure.mean(axis=0),
            magnitude_noise=None if magnitude is None else noise_of_scans(magnitude),
            structure_noise=None if structure is None else noise_of_scans(structure),
            scans=min(len(scans) for scans in present),
        )

    @classmethod
    def at_rest(cls, magnitude: FloatArray | None, structure: FloatArray | None) -> Reference:
        """The reference of scans (M,) or (n, M) of each channel; several tell their noise.

        Where a voltage is no number, that voltage has no reference, and nothing tells the noise.
        """
        scans = [None if each is None else np.atleast_2d(each) for each in (magnitude, structure)]
        if all(each is None or np.isfinite(each).all() for each in scans):
            return cls.from_scans(*scans)
        one, other = (None if each is None else each.mean(axis=0) for each in scans)
        return cls(one, other)


_TAKEN = ("magnitude", "structure", "magnitude_noise", "structure_noise")


def _drifted(volts: FloatArray | None, drift: FloatArray | None) -> FloatArray | None:
    return volts if volts is None or drift is None else volts * np.exp(drift)


def _same(one: FloatArray | None, other: FloatArray | None) -> bool:
    if one is None or other is None:
        return one is other
    return one is other or np.array_equal(one, other)


def variance_about_line(scans: FloatArray) -> FloatArray:
    """Variance (M,) of scans (n, M), n > 2, about a straight line in time."""
    line = np.linspace(-1, 1, len(scans))
    line /= np.linalg.norm(line)
    rest = scans - scans.mean(axis=0)
    rest = rest - np.outer(line, line @ rest)
    return np.asarray((rest**2).sum(axis=0) / (len(scans) - 2))


def noise_of_scans(scans: FloatArray) -> FloatArray | None:
    """Standard deviation (M,) of one scan, from n scans (n, M) at rest; None from a single one.

    A converter's noise is much the same on every measurement while a few scans know each one
    poorly, so what is common counts as much as `TRUSTED_SCANS` scans of the measurement's own.
    The common variance is a median: a lead that picks up interference is not the others' noise.
    Where a straight line takes most of the variance, the skin creeps: that is no noise.
    """
    if len(scans) < 2:
        return None
    from scipy.special import chdtri  # a third of the start of `tactomo info`

    own, freedom = scans.var(axis=0, ddof=1), len(scans) - 1
    if len(scans) >= MIN_TREND_SCANS:
        about_line = variance_about_line(scans)
        if about_line.sum() < own.sum() / 2:
            own, freedom = about_line, freedom - 1
    common = float(np.median(own)) * freedom / chdtri(freedom, 0.5)
    share = len(scans) / (len(scans) + TRUSTED_SCANS)
    return np.asarray(np.sqrt(share * own + (1 - share) * common))


def noise_of_reciprocity(description: SensorDescription, scans: FloatArray) -> FloatArray | None:
    """Standard deviation (M,) of one scan, from scans (M,) or (n, M), pressed or not.

    V(k, m) = V(m, k) but for noise. Electrodes and an uneven sheet do not disturb it; the median
    keeps a few broken electrodes from doing so. None where the pattern has no reciprocal pairs.
    """
    i, j = reciprocal_pairs(description.pairs).T
    with np.errstate(over="ignore", invalid="ignore"):
        differences = scans[..., i] - scans[..., j]
        differences = differences[np.isfinite(differences)]
        if differences.size == 0:
            return None
        sigma = robust_sigma(differences) / np.sqrt(2)
    return np.full(description.measurements, float(sigma))


def _noise_against(
    description: SensorDescription, reference: FloatArray, scans: FloatArray
) -> tuple[FloatArray, int] | None:
    """Noise (M,) of one scan, and how many scans a reference (M,) is the mean of; None as above.

    A device breaks reciprocity by noise, and by a share that is the same in every scan: of s² and
    e², the reference, a mean of n, has s²/n + e², a scan s² + e², and their difference s² + s²/n,
    which leaves s² and n. Where e² is much the larger, the difference alone is to be trusted.
    """
    with np.errstate(all="ignore"):  # a scan may hold anything
        difference = scans - reference
    own, one, both = (
        noise_of_reciprocity(description, volts) for volts in (reference, scans, difference)
    )
    if own is None or one is None or both is None:
        return None
    with np.errstate(all="ignore"):
        share = (1 + (one - own) / both * ((one + own) / both)) / 2  # of s² in the difference
        share = np.clip(np.nan_to_num(share, nan=1.0), 0.5, 1 - 1e-6)
    return both * np.sqrt(share), round(float((share / (1 - share)).min()))
