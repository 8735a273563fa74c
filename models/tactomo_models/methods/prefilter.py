"""The filter in front of a network: what the data of one channel most likely are without noise.

Relative voltage changes of training scenes have a covariance S = B B'. With noise of covariance N
on them, B z with z = (I + B' N^-1 B)^-1 B' N^-1 d is the linear estimate of least mean square
error (Wiener). A network that is given z need not learn what noise looks like, and serves any
noise, of any voltage: one that is missing has N = infinity and is filled in from the others.
Reciprocity leaves half of the voltages independent, and so half as many numbers in z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactomo_models.arrays import FloatArray

BANDS = 8  # of components, whose known share the network is told


def signal_basis(changes: FloatArray, components: int) -> FloatArray:
    """Basis B (M, components) of a channel's noise-free changes (scenes, M).

    Columns are orthogonal, scaled so that the coefficients of the scenes have unit mean square.
    """
    min_variance = 1e-7  # of a component, as a share of the largest one: below, it is rounding
    covariance = changes.T @ changes / len(changes)
    variance, directions = np.linalg.eigh(covariance)
    strongest = np.argsort(variance)[::-1][:components]
    floor = min_variance * variance[strongest[0]]
    return np.asarray(directions[:, strongest] * np.sqrt(np.maximum(variance[strongest], floor)))


@dataclass(frozen=True)
class Prefilter:
    """The filter for one level of noise.

    Attributes:
        matrix: (K, M) takes relative changes to the K components z.
        known: (BANDS,) share of each band of components that the data tell, 0 to 1.
    """

    matrix: FloatArray
    known: FloatArray


def prefilter(basis: FloatArray, weight: FloatArray) -> Prefilter:
    """Filter for data of given noise.

    Args:
        basis: (M, K), see `signal_basis`.
        weight: (M,) inverse variances of the relative changes; 0 where there is no voltage.
    """
    weighted = basis * weight[:, None]
    precision = np.eye(basis.shape[1]) + basis.T @ weighted
    covariance = np.linalg.inv(precision)
    matrix, known = covariance @ weighted.T, 1 - np.diag(covariance)
    bands = np.array([band.mean() for band in np.array_split(known, BANDS)])
    return Prefilter(np.asarray(matrix, np.float64), bands)
