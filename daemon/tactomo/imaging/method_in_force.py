"""The method and the budget that were requested, and those that frames get.

A budget is milliseconds of modelled work (`field_fit.Budget`), less of it where others take the
processor. Recordings hold what was effective, so that a replay gives the same on any machine. For
use by the pipeline thread; others may read.
"""

from __future__ import annotations

from typing import NamedTuple

from tactomo_models import Reconstructor
from tactomo_models.reconstruct import DEFAULT_BUDGET_S

from tactomo.errors import CommandError


class Effort(NamedTuple):
    """How much model a frame gets."""

    method: str
    budget_ms: float | None  # of modelled work; None for the method's own


class MethodInForce:
    """Tells the reconstructor its method and budget."""

    def __init__(self, reconstructor: Reconstructor) -> None:
        self.share = 1.0  # of the work that was asked for, what frames get
        self._reconstructor = reconstructor
        budget_s = reconstructor.budget_s
        # what was asked for; what frames get
        self.requested = self.effective = Effort(
            reconstructor.method, None if budget_s is None else budget_s * 1e3
        )
        self._request(self.requested)

    def request_method(self, method: str) -> None:
        """Have frames made by another method.

        Raises CommandError where it cannot be set up; what was in force stays so.
        """
        try:
            self._request(self.requested._replace(method=method))
        except Exception as error:  # somebody else's method: anything may go wrong in it
            raise CommandError(
                f"the method {method} cannot be set up: {type(error).__name__}: {error}",
                "ask for another method",
                "no_network",
            ) from error

    def request_budget(self, budget_ms: float | None) -> None:
        """Have frames take as much work; None for the method's own."""
        self._request(self.requested._replace(budget_ms=budget_ms))

    def give_share(self, share: float) -> None:
        """Have frames take that share of the work that was asked for, or of the method's own."""
        self.share = share
        self._request(self.requested)

    def obey(self, recorded: Effort) -> None:
        """Give frames what was effective when they were recorded."""
        if recorded != self.effective:
            self.put_in_force(recorded)
            self.requested = recorded

    def _request(self, requested: Effort) -> None:
        budget_ms = requested.budget_ms
        if self.share < 1:
            budget_ms = self.share * (budget_ms or DEFAULT_BUDGET_S * 1e3)
        self.put_in_force(Effort(requested.method, budget_ms))
        self.requested = requested

    def lengthen(self, budget_ms: float) -> None:
        """Give frames at least so much modelled work, until `put_in_force` is called."""
        effective = self.effective
        if effective.budget_ms is None or effective.budget_ms < budget_ms:
            self.put_in_force(effective._replace(budget_ms=budget_ms))

    def put_in_force(self, effective: Effort) -> None:
        """Give frames this method and this much modelled work."""
        # Milliseconds are what is recorded: live and replay must come to the same seconds.
        budget_ms = effective.budget_ms
        self._reconstructor.method = effective.method
        self._reconstructor.budget_s = None if budget_ms is None else budget_ms * 1e-3
        self.effective = effective
