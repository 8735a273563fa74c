"""How likely an account of a frame is: the evidence of a fitted field, by Laplace's method.

    log Z = log L(chi^2) - |(p - p0) / prior|^2 / 2 + log det(prior precision) / 2 - log det(H) / 2
          + log K!

A parameter pays for the share of its prior range that the data leave (Occam factor), a contact for
the number of places where it might as well be: no account has a price of its own. Any number K of
contacts is as likely as another; numbered otherwise they are the same contacts, so that each of K!
orders is a maximum of its own. Three things are known of a residual's errors, and L goes by them:

- Model errors go together, some voltages at a time, so that each such voltage tells less than an
  independent one (`Changes.variance_inflation`): `chi_squared` counts it for less.
- Nobody knows how large errors are altogether. Their variance has an inverse-gamma prior around
  what was told, as sure as the data are many; integrated over it, a normal likelihood is Student's.
- H is the Hessian of half of the cost at the minimum, by Gauss and Newton, on the same scale.

Source: MacKay, "Bayesian interpolation", Neural Computation 4 (1992), equations 2.4 to 2.6; the
variance and the orders: Gelman et al., "Bayesian Data Analysis" (2013), sections 3.2 and 22.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri, gammaln
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.scans.changes import Changes
from tactomo_models.scans.companion_forces import SheetsAndCompanions

ROUNDING = 1e-12  # of a Hessian's diagonal: where one parameter stands for another, it is no less
FALSE_ALARM = 1e-3  # chance that data which an account explains are taken for unexplained


@dataclass(frozen=True)
class Likelihood:
    """Of one frame's weighted residuals."""

    deflation: FloatArray  # (sum M,) inverse roots of the variance inflation; 0 where invalid
    count: float  # how many independent data these are

    @classmethod
    def of(cls, measured: Mapping[Channel, Changes]) -> Likelihood:
        """The likelihood of what residuals of these changes are."""
        inverse = [(each.weight > 0) / each.variance_inflation for each in measured.values()]
        if isinstance(measured, SheetsAndCompanions):
            inverse.append(np.full(len(measured.companions), 1 / measured.inflation))
        together = np.concatenate(inverse)
        return cls(np.sqrt(together), max(float(together.sum()), 1.0))

    def chi_squared(self, residual: FloatArray) -> float:
        """Sum of squares of a weighted residual (sum M,), as so many independent data have it."""
        own = self.deflation * residual
        return float(own @ own)

    def log(self, chi_squared: float) -> float:
        """Logarithm of the likelihood, of whitened data: comparable with that of more of them."""
        return float(self._log_scale - self.count * np.log(self.count + chi_squared))

    @cached_property
    def _log_scale(self) -> float:
        n = self.count
        return float(gammaln(n) - gammaln(n / 2) + n / 2 * np.log(n / np.pi))

    def precision(self, chi_squared: float) -> float:
        """Factor on the errors' inverse variance that is likely where this much is left."""
        return 2 * self.count / (self.count + chi_squared)

    def unit(self, chi_squared: float) -> float:
        """What one unit of cost, which counts all voltages alike, is of chi-squared here."""
        valid = int(np.count_nonzero(self.deflation))
        return self.precision(chi_squared) * self.count / max(valid, 1)

    def explains(self, chi_squared: float) -> bool:
        """Whether errors of the size that was told may leave so much."""
        return chi_squared < float(chdtri(self.count, FALSE_ALARM))

    def information(self, jacobian: FloatArray, chi_squared: float) -> FloatArray:
        """What data tell of parameters (N, N), from the weighted residual's derivative by them."""
        own = self.deflation[:, None] * jacobian
        return np.asarray(self.precision(chi_squared) * (own.T @ own))


def log_occam(precision: FloatArray, hessian: FloatArray) -> float:
    """Logarithm of the share of its prior range (N,) that the data leave of each parameter."""
    scale = np.sqrt(np.diag(hessian))
    of_unit = hessian / np.outer(scale, scale) + ROUNDING * np.eye(len(scale))
    root = scale * np.diag(np.linalg.cholesky(of_unit))
    return float(np.log(precision).sum() / 2 - np.log(root).sum())
