"""How often bad input is found, and good input taken for bad: the table of the decisions.

Over uneven sheets (5 %) with uneven contacts, scenes of none to four presses, and noise of 60 and
40 dB; all simulated. Print it with `pytest -m long -s tests/models/scans/test_bad_input_rates.py`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from faulty_skin import BAD_LEADS, BadLead, rewired, shorted
from noisy_skin import Skin, rms
from tactomo_models import (
    Artifact,
    Flag,
    Press,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.arrays import FloatArray

Scans = dict[str, FloatArray]
Change = Callable[[Scans], Scans]

SEEDS = range(900, 902)  # not those that the thresholds were tuned on
SCENES = 5
NOISES = (1e-3, 1e-2)
NEW = (
    Flag.INVALID_VOLTAGE
    | Flag.REFERENCE_MISMATCH
    | Flag.ELECTRODE_FAULT
    | Flag.NOISE_HIGH
    | Flag.CHANNELS_SWAPPED
    | Flag.SATURATED
)
MISSING = Flag.MAGNITUDE_MISSING | Flag.STRUCTURE_MISSING

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]


def scenes(rng: np.random.Generator, least: int) -> list[list[Press]]:
    return [
        [
            Press(float(x), float(y), rng.uniform(60, 200), rng.uniform(0.008, 0.02))
            for x, y in rng.uniform(-0.055, 0.055, (least + k % (5 - least), 2))
        ]
        for k in range(SCENES)
    ]


def wrong(frame: Reconstruction, presses: list[Press]) -> bool:
    """Tell whether a map has a contact where nothing presses, or none where something does.

    Distances of a radius and a half are let pass: presses overlap, and the lightest are weak.
    """
    if frame.structure is None and frame.map is None:
        return False
    found = [(c.x_m, c.y_m) for c in frame.contacts]
    truth = [(p.x_m, p.y_m) for p in presses]

    def far(points: list[tuple[float, float]], others: list[tuple[float, float]]) -> bool:
        return any(all(math.dist(p, o) > 0.03 for o in others) for p in points)

    return far(found, truth) or far(truth, found)


class Rates:
    """Counts, over all skins and scenes, what became of one kind of bad input."""

    def __init__(self, paper: SensorDescription, artifact: Artifact) -> None:
        self.paper, self.artifact = paper, artifact

    def count(
        self,
        name: str,
        simulators: list[SkinSimulator],
        flag: Flag,
        *,
        at_tare: Change = lambda scans: scans,
        later: Change = lambda scans: scans,
        tared_on: list[SkinSimulator] | None = None,
        loaded: bool = False,
        least: int = 0,
    ) -> Counter[str]:
        """Share of frames with `flag`, with any flag, and of wrong ones that have none."""
        seen: Counter[str] = Counter()
        for number, simulator in enumerate(simulators):
            rng = np.random.default_rng(number)
            for noise in NOISES:
                skin = Skin(simulator, noise)
                rest = Skin(tared_on[number], noise) if tared_on else skin
                for presses in scenes(rng, least):
                    reconstructor = Reconstructor(self.paper, self.artifact)
                    on = presses if loaded else []
                    taken = [at_tare(rest.scan(*on)) for _ in range(20)]
                    reconstructor.set_reference(
                        Reference.from_scans(
                            np.array([scans["magnitude"] for scans in taken]),
                            np.array([scans["structure"] for scans in taken]),
                        )
                    )
                    pressed = [] if loaded else presses
                    for _ in range(2 if loaded else 4):
                        frame = reconstructor.reconstruct(**later(skin.scan(*pressed)))
                    seen["frames"] += 1
                    seen["flag"] += flag in frame.flags if flag else not frame.flags & NEW
                    seen["any"] += bool(frame.flags)
                    seen["confidently wrong"] += not frame.flags and wrong(frame, pressed)
        n = seen["frames"]
        print(
            f"{name:32s} {n:4d} {seen['flag'] / n:8.1%} {seen['any'] / n:8.1%} "
            f"{seen['confidently wrong'] / n:8.1%}"
        )
        return seen


def test_rates(paper: SensorDescription, artifact: Artifact) -> None:
    simulators = [
        SkinSimulator(paper, unevenness=0.05, impedance_spread=0.2, seed=seed) for seed in SEEDS
    ]
    rates = Rates(paper, artifact)
    print(f"\n{'':32s}    n  flagged any flag confidently wrong")
    clean = rates.count("nothing wrong (share unflagged)", simulators, Flag(0))
    found = {}
    leads: dict[str, BadLead] = {
        **BAD_LEADS,
        "of a pair of inputs, both dead": lambda d, v, e: np.where(
            (d.pairs.drive[:, 0] == e) | (d.pairs.measure[:, 0] == e), 1e-6 * v, v
        ),
    }
    for kind, broken in leads.items():
        name = f"lead {kind}"

        def change(scans: Scans, broken: BadLead = broken) -> Scans:
            return {**scans, "structure": broken(paper, scans["structure"], 6)}

        found[name] = rates.count(name, simulators, Flag.ELECTRODE_FAULT, later=change)
        both = f"{name}, at tare"
        found[both] = rates.count(
            both, simulators, Flag.ELECTRODE_FAULT, at_tare=change, later=change
        )
    for pair in ((5, 6), (2, 4), (1, 9)):
        shorts = [shorted(simulator, *pair) for simulator in simulators]
        name = f"short of {pair[0]} and {pair[1]}"
        found[name] = rates.count(name, shorts, Flag.ELECTRODE_FAULT, tared_on=simulators)
    orders = {
        "leads on by one": [*range(1, 16), 0],
        "two leads exchanged": [*range(6), 7, 6, *range(8, 16)],
    }
    for name, order in orders.items():
        wired = [rewired(simulator, order) for simulator in simulators]
        found[name] = rates.count(name, wired, Flag.REFERENCE_MISMATCH)

    def swap(scans: Scans) -> Scans:
        return {"magnitude": scans["structure"], "structure": scans["magnitude"]}

    found["channels swapped"] = rates.count(
        "channels swapped, pressed",
        simulators,
        Flag.CHANNELS_SWAPPED,
        at_tare=swap,
        later=swap,
        least=1,
    )

    def clip(scans: Scans) -> Scans:
        volts = scans["structure"]
        return {**scans, "structure": np.clip(volts, -1.7 * rms(volts), None)}

    found["clipped"] = rates.count("clipped", simulators, Flag.SATURATED, later=clip)
    found["tared under load"] = rates.count(
        "tared under load, then lifted", simulators, Flag.REFERENCE_MISMATCH, loaded=True, least=1
    )
    rng = np.random.default_rng(1)

    def interfere(scans: Scans) -> Scans:
        return {name: v + 0.3 * rms(v) * rng.standard_normal(len(v)) for name, v in scans.items()}

    found["interference"] = rates.count(
        "interference", simulators, Flag.NOISE_HIGH, later=interfere
    )
    assert clean["flag"] == clean["frames"]
    for name, seen in found.items():
        assert seen["confidently wrong"] == 0, name
        assert seen["any"] >= 0.9 * seen["frames"], name
