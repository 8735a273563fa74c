"""What companions say of a frame: forces, and the rows that they add to the sheets' data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray
from tactomo_models.scans.changes import Changes

DISPUTED = 4.0  # standard uncertainties apart: by chance once in 16,000 independent readings


class CompanionReading(NamedTuple):
    """What one companion says of a frame; name and value alone do as well."""

    name: str
    value: float  #: in its own unit; NaN where it has none
    time_s: float = 0.0  #: of the frame, on any steady clock
    #: for how long before that the sheets must have been still for it to tell of the frame
    since_s: float = 0.0


@dataclass(frozen=True)
class CompanionForce:
    """What one companion reads of a frame."""

    reading: float  #: in its own unit
    force_n: float  #: since the tare
    sigma_n: float  #: its standard uncertainty
    #: (P,) what one kPa at each pressable node adds: the companion feels n_per_kpa @ pressure
    n_per_kpa: FloatArray
    #: in a `Reconstruction`: `fitted` beside the sheets; left out as `disputed`, or as `late`, of
    #: before the sheets last moved; `unused`, where nothing presses or the method takes none
    state: str = "unused"

    def agrees_with(self, force_n: float, sigma_n: float = 0.0) -> bool:
        """Whether a force of that standard uncertainty may be the same."""
        return abs(force_n - self.force_n) <= DISPUTED * float(np.hypot(self.sigma_n, sigma_n))


class SheetsAndCompanions(dict[Channel, Changes]):
    """The changes of each channel, with the forces of companions that are fitted beside them."""

    def __init__(
        self, changes: Mapping[Channel, Changes], companions: Mapping[str, CompanionForce]
    ) -> None:
        super().__init__(changes)
        self.companions = companions

    @cached_property
    def inflation(self) -> float:
        """The mean variance inflation of the voltages.

        The cost counts each voltage as independent, the evidence fewer of them. Companions are
        counted up by as much in the cost, so that they weigh the same beside the sheets in both.
        """
        independent = [(each.weight > 0) / each.variance_inflation for each in self.values()]
        valid = sum(np.count_nonzero(each.weight) for each in self.values())
        return valid / max(float(np.concatenate(independent).sum()), 1.0)

    @cached_property
    def rows(self) -> tuple[FloatArray, FloatArray]:
        """Weighted forces (K, P) of one kPa at each node, and weighted readings (K,)."""
        each = self.companions.values()
        weight = np.sqrt(self.inflation) / np.array([one.sigma_n for one in each])
        n_per_kpa = np.array([one.n_per_kpa for one in each])
        return weight[:, None] * n_per_kpa, weight * np.array([one.force_n for one in each])


def with_outline_errors(
    measured: Mapping[Channel, Changes], errors: Mapping[Channel, FloatArray | None]
) -> Mapping[Channel, Changes]:
    """The same, where such errors (M, K) of each sheet's outlines are allowed for."""
    each = {name: replace(one, outline_errors=errors[name]) for name, one in measured.items()}
    companions = companions_of(measured)
    return SheetsAndCompanions(each, companions) if companions else each


def companions_of(measured: Mapping[Channel, Changes]) -> Mapping[str, CompanionForce]:
    """The companions that are fitted beside the sheets."""
    return measured.companions if isinstance(measured, SheetsAndCompanions) else {}
