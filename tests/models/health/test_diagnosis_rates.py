"""How often each fault is found, and a healthy skin taken for ill: the table of the decisions.

Uneven sheets (5 %) with uneven contacts, noise of 60 and 40 dB of the voltages, a random electrode;
all simulated. Print it with `pytest -m long -s tests/models/health/test_diagnosis_rates.py`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from faulty_skin import BAD_LEADS, BadLead, rewired, shorted, touches
from noisy_skin import rms
from tactomo_lab.scenes.faults import with_lead
from tactomo_models import Artifact, Press, SensorDescription, SkinSimulator
from tactomo_models.arrays import FloatArray
from tactomo_models.health.diagnosis import diagnose
from tactomo_protocol import Channel

Make = Callable[[SkinSimulator, float, np.random.Generator, int], FloatArray]

SEEDS = range(900, 908)  # not those that the thresholds were tuned on
SCANS = 60
PERIOD_S = 0.05

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]


def rest(skin: SkinSimulator, *presses: Press) -> FloatArray:
    return skin.voltages(presses)[Channel.STRUCTURE]


def scans(volts: FloatArray, size: float, rng: np.random.Generator) -> FloatArray:
    made: FloatArray = volts + size * rng.standard_normal((SCANS, len(volts)))
    return made


def noisy(change: Callable[[SkinSimulator, int], FloatArray]) -> Make:
    """Scans of voltages that a skin has throughout."""
    return lambda skin, noise, rng, e: scans(change(skin, e), noise * rms(rest(skin)), rng)


def swapped(skin: SkinSimulator, first: int, second: int) -> FloatArray:
    order = list(range(16))
    order[first], order[second] = second, first
    return rest(rewired(skin, order))


class Rates:
    """Counts what was found in all skins of one kind."""

    def __init__(self, paper: SensorDescription, artifact: Artifact) -> None:
        self.paper, self.even = paper, artifact.bare
        self.skins = [
            SkinSimulator(paper, unevenness=0.05, impedance_spread=0.2, seed=seed) for seed in SEEDS
        ]

    def count(
        self,
        name: str,
        make: Make,
        bad: Callable[[int], set[int]] = lambda _: set(),
        noises: tuple[float, ...] = (1e-3, 1e-2),
    ) -> Counter[str]:
        seen: Counter[str] = Counter()
        for skin in self.skins:
            for noise in noises:
                for repeat in range(2):
                    rng = np.random.default_rng([repeat, int(noise * 1e4)])
                    electrode = int(rng.integers(16))
                    found = diagnose(
                        self.paper,
                        make(skin, noise, rng, electrode),
                        even=self.even,
                        times_s=np.arange(SCANS) * np.float64(PERIOD_S),
                    )
                    named = {n for n, state in enumerate(found.electrodes) if state != "good"}
                    seen["n"] += 1
                    seen["healthy"] += found.level in ("ok", "advice")
                    seen["broken"] += found.level == "broken"
                    seen["exact"] += named == bad(electrode)
        shares = (f"{seen[key] / seen['n']:8.0%}" for key in ("healthy", "broken", "exact"))
        print(f"{name:40s} {seen['n']:4d}", *shares)
        return seen


def test_rates(paper: SensorDescription, artifact: Artifact) -> None:
    rates = Rates(paper, artifact)
    print(f"\n{'':40s}    n  healthy   broken    exact")
    well = rates.count("healthy", noisy(lambda skin, _: rest(skin)))
    assert well["healthy"] == well["exact"] == well["n"]

    for name, broken in BAD_LEADS.items():

        def change(skin: SkinSimulator, electrode: int, broken: BadLead = broken) -> FloatArray:
            return broken(paper, rest(skin), electrode)

        seen = rates.count(f"lead {name}", noisy(change), lambda e: {e})
        assert seen["healthy"] == seen["broken"] == 0
        assert seen["exact"] == seen["n"]

    def ten_times(
        skin: SkinSimulator, noise: float, rng: np.random.Generator, electrode: int
    ) -> FloatArray:
        much = np.where(touches(paper, electrode), 10.0, 1.0)
        return scans(rest(skin), noise * rms(rest(skin)) * much, rng)  # type: ignore[arg-type]

    def opens(
        skin: SkinSimulator, noise: float, rng: np.random.Generator, electrode: int
    ) -> FloatArray:
        made = scans(rest(skin), noise * rms(rest(skin)), rng)
        opened = BAD_LEADS["open, reads 0 V"](paper, rest(skin), electrode)
        made[rng.choice(SCANS, 4, replace=False)] += opened - rest(skin)
        return made

    def fades(
        skin: SkinSimulator, noise: float, rng: np.random.Generator, electrode: int
    ) -> FloatArray:
        made = scans(rest(skin), noise * rms(rest(skin)), rng)
        poor = with_lead(paper, rest(skin), electrode, 0.7, lambda _, p: 0.7 * p)
        some = rng.choice(SCANS, SCANS // 4, replace=False)
        made[some] += np.outer(rng.random(len(some)), poor - rest(skin))
        return made

    loose: list[tuple[str, Make, float]] = [
        ("an electrode ten times as noisy", ten_times, 1.0),
        ("open in 4 of 60 scans", opens, 1.0),
        ("loses up to 30 % in a quarter of the scans", fades, 0.4),
    ]
    for name, make, least in loose:
        seen = rates.count(name, make, lambda e: {e})
        assert seen["healthy"] == 0
        assert seen["exact"] >= least * seen["n"]

    for apart in (1, 5):
        seen = rates.count(
            f"two leads exchanged, {apart} apart",
            noisy(lambda skin, e, apart=apart: swapped(skin, e, (e + apart) % 16)),  # type: ignore[misc]
            lambda e, apart=apart: {e, (e + apart) % 16},  # type: ignore[misc]
        )
        assert seen["exact"] == seen["n"]

    kinds: dict[str, Make] = {
        "all leads on by one": noisy(lambda skin, _: rest(rewired(skin, [*range(1, 16), 0]))),
        "clipped": lambda *of: np.maximum(
            noisy(lambda skin, _: rest(skin))(*of), -1.7 * rms(rest(of[0]))
        ),
        "drift of 8 % a minute": lambda *of: (
            noisy(lambda skin, _: rest(skin))(*of)
            * (1 + 0.08 / 60 * PERIOD_S * np.arange(SCANS)[:, None])
        ),
    }
    for name, make in kinds.items():
        assert rates.count(name, make)["healthy"] == 0
    seen = rates.count(
        "two neighbours shorted", noisy(lambda skin, e: rest(shorted(skin, e, (e + 1) % 16)))
    )
    assert seen["healthy"] == 0
    for decibels, kind in ((30, "healthy"), (10, "broken")):
        noise = 10 ** (-decibels / 20)
        seen = rates.count(
            f"noise at {decibels} dB", noisy(lambda skin, _: rest(skin)), noises=(noise,)
        )
        assert seen[kind] == (seen["n"] if kind == "broken" else 0)
