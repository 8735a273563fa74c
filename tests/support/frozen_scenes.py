"""A dozen scenes of simulated skins, kept in a file: what changes in the simulator moves no floor.

Each is simulated on a skin of its own, on a finer mesh than the one that reconstructs. Skins made
by hand have electrodes a millimetre off, uneven contacts and an uneven sheet. To make them anew:
``python tests/support/frozen_scenes.py``, and set the floors of `test_scenes` by what is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from noisy_skin import Skin
from tactomo_lab.scenes.simulation import truth_of
from tactomo_models import Press, Reference, SensorDescription, SkinSimulator, load_description
from tactomo_models.arrays import FloatArray
from variants import variant

FILE = Path(__file__).parents[1] / "models" / "frozen_scenes.npz"
REFERENCE_SCANS = 20
RECTANGLE = Press(0.03, 0.03, 185.0, 0.014, 0.010, 0.4, shape="rectangle")
RING = Press(-0.03, 0.025, 190.0, 0.017, shape="ring")
DOME = Press(0.0, -0.03, 240.0, 0.017, profile="dome")
DISC = Press(-0.035, -0.03, 175.0, 0.011)
CROWD = tuple(
    Press(x, y, 160.0 + 10 * k, 0.009)
    for k, (x, y) in enumerate(
        ((-0.045, -0.045), (-0.04, 0.04), (0.0, 0.0), (0.04, -0.04), (0.045, 0.045))
    )
)
SLIDE = tuple((Press(-0.03 + 0.004 * k, 0.01, 180.0, 0.012), DISC) for k in range(10))


@dataclass(frozen=True)
class Scene:
    """What presses frame by frame, and on which skin."""

    frames: tuple[tuple[Press, ...], ...]
    skin: int = 0  # seed
    by_hand: bool = False
    noise: float = 1e-3  # of the voltages' root mean square
    sensor: str = "paper_square"


def still(*presses: Press, frames: int = 3) -> tuple[tuple[Press, ...], ...]:
    return frames * (presses,)


SCENES = {
    "ordinary": Scene(still(DISC, Press(0.03, 0.02, 190.0, 0.013))),
    "quiet, of three kinds": Scene(still(RING, DOME, RECTANGLE), noise=2e-4),
    "by hand, ring and disc": Scene(still(RING, DISC), skin=1, by_hand=True),
    "by hand, dome and rectangle": Scene(still(DOME, RECTANGLE), skin=2, by_hand=True),
    "by hand, alone": Scene(still(DISC), skin=3, by_hand=True, noise=4e-4),
    "soft": Scene(still(DOME, Press(0.035, 0.03, 220.0, 0.015, profile="dome"))),
    "crowd": Scene(still(*CROWD), noise=5e-4),
    "side by side": Scene(
        still(Press(-0.013, 0.0, 180.0, 0.009), Press(0.013, 0.002, 170.0, 0.010))
    ),
    "graded alone": Scene(still(DISC, Press(0.03, 0.02, 150.0, 0.013)), sensor="graded_square"),
    "palm": Scene(still(Press(0.0, 0.005, 170.0, 0.045, 0.035, 0.3))),
    "overload": Scene(still(Press(0.02, -0.02, 420.0, 0.013))),
    "moving": Scene(SLIDE),
}


@dataclass(frozen=True)
class Frozen:
    """Volts of one scene: (REFERENCE_SCANS, M) before it and (T, M) in it; the last frame's map."""

    reference: Reference
    scans: list[dict[str, FloatArray]]
    truth: FloatArray


def read(name: str) -> Frozen:
    """Read a scene of the file."""
    with np.load(FILE) as file:
        volts = {
            key.split("/")[1]: file[key].astype(float)
            for key in file.files
            if key.startswith(f"{name}/")
        }
    truth = volts.pop("truth")
    before = {channel: each[:REFERENCE_SCANS] for channel, each in volts.items()}
    frames = len(SCENES[name].frames)
    return Frozen(
        Reference.from_scans(before.get("magnitude"), before.get("structure")),
        [
            {channel: each[REFERENCE_SCANS + k] for channel, each in volts.items()}
            for k in range(frames)
        ],
        truth,
    )


def simulated(scene: Scene, sensor: SensorDescription) -> Skin:
    unevenness, impedance = (0.10, 0.30) if scene.by_hand else (0.03, 0.10)
    made = variant(sensor, electrodes={"pitch_m": 0.037}) if scene.by_hand else sensor
    simulator = SkinSimulator(
        made, unevenness=unevenness, impedance_spread=impedance, seed=scene.skin
    )
    return Skin(simulator, scene.noise)


def main() -> None:
    """Simulate every scene and write the file."""
    arrays = {}
    for name, scene in SCENES.items():
        sensor = load_description(scene.sensor)
        skin = simulated(scene, sensor)
        taken = [skin.scan(*each) for each in (REFERENCE_SCANS * ((),)) + scene.frames]
        for channel in taken[0]:
            arrays[f"{name}/{channel}"] = np.array([scan[channel] for scan in taken], np.float32)
        arrays[f"{name}/truth"] = truth_of(sensor, scene.frames[-1]).map.astype(np.float32)
    np.savez_compressed(FILE, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
