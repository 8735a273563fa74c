"""How often a healthy skin is called pressed, or distrusted: false alarms of the two limits.

Nothing presses: frames that are not quiet, their misfit, and what it would be in units of noise
alone once the sheet has drifted by 0.3 %. Something does: frames that say `misfit_high`, or any
flag. Over uneven sheets (5 %) with uneven contacts (20 %), tares of 20 scans, noise of 80, 60 and
40 dB of the voltages; all simulated. Print it with `pytest -m long -s
tests/models/scans/test_quiet_rates.py`.
"""

from __future__ import annotations

import numpy as np
import pytest
from noisy_skin import Skin
from tactomo_models import Artifact, Flag, Press, Reconstructor, SensorDescription, SkinSimulator
from tactomo_models.methods.magnitudes import BAD_MISFIT

SEEDS = range(7100, 7108)  # nothing was tuned on these
NOISES = (1e-4, 1e-3, 1e-2)
AT_REST = 2000  # frames of each skin and noise
SCENES = 5  # of each skin and noise, pressed
SETTLED = 4  # frames of each

pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]


def presses(rng: np.random.Generator, count: int) -> list[Press]:
    """Some that do not touch each other, firm enough for both channels."""
    corners = rng.permutation([(-1, -1), (-1, 1), (1, -1), (1, 1)])[:count]
    places = 0.03 * corners + rng.uniform(-0.012, 0.012, (count, 2))
    return [
        Press(float(x), float(y), rng.uniform(160, 195), rng.uniform(0.008, 0.014))
        for x, y in places
    ]


def test_rates(paper: SensorDescription, artifact: Artifact) -> None:
    simulators = [
        SkinSimulator(paper, unevenness=0.05, impedance_spread=0.2, seed=seed) for seed in SEEDS
    ]
    print(
        "\nnoise     at rest  pressed?  largest misfit  drifted, noise alone     pressed"
        "  misfit_high  any flag"
    )
    for noise in NOISES:
        quiet, misfits, drifted, flags = [], [], [], []
        for number, simulator in enumerate(simulators):
            skin = Skin(simulator, noise)
            reconstructor = Reconstructor(paper, artifact)
            reconstructor.set_reference(skin.reference())
            looks = [reconstructor.compare(**skin.scan()) for _ in range(AT_REST)]
            quiet += [look.is_quiet and not look.flags for look in looks]
            misfits += [reconstructor.solve(look).misfit for look in looks if look.is_quiet]
            warmer = {name: 1.003 * volts for name, volts in skin.scan().items()}
            drifted += [each.misfit for each in reconstructor.compare(**warmer).changes.values()]
            rng = np.random.default_rng(number)
            for scene in range(SCENES):
                on = presses(rng, 1 + scene % 4)
                reconstructor.reset()
                frames = [reconstructor.reconstruct(**skin.scan(*on)) for _ in range(SETTLED)]
                flags.append(frames[-1].flags)
        high, flagged = (
            np.mean([bool(each & sought) for each in flags])
            for sought in (Flag.MISFIT_HIGH, ~Flag(0))
        )
        print(
            f"{-20 * np.log10(noise):3.0f} dB {len(quiet):10d} {1 - np.mean(quiet):9.4%} "
            f"{max(misfits):15.2f} {max(drifted):21.1f} {len(flags):11d} "
            f"{high:12.1%} {flagged:9.1%}"
        )
        assert np.mean(quiet) > 1 - 1e-3
        assert max(misfits) < BAD_MISFIT
        assert high < 0.05
