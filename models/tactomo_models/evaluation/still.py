"""Still scenes, each reconstructed from a cold start and run to its end, as a file's frames are."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from tactomo_models.artifact import load_or_build_artifact
from tactomo_models.batch import BUDGET_S
from tactomo_models.description import SensorDescription
from tactomo_models.evaluation.measures import SceneScore, score
from tactomo_models.evaluation.scenes import EvaluationScene
from tactomo_models.reconstruct import Reconstruction, Reconstructor, Tier


@dataclass(frozen=True)
class Outcome:
    """A scene, what a method made of it, and how right that is."""

    method: str
    scene: EvaluationScene
    frame: Reconstruction
    score: SceneScore


def reconstruct_scenes(scenes: Iterable[EvaluationScene], *methods: str) -> Iterator[Outcome]:
    """Reconstruct each scene by itself, by one method after the other, on one thread.

    Args:
        scenes: of one sensor, whatever its sign.
        *methods: of reconstruction, as `tactomo reconstruct` has them.
    """
    reconstructors: dict[SensorDescription, Reconstructor] = {}
    for scene in scenes:
        sensor = scene.description
        if sensor not in reconstructors:
            artifact = load_or_build_artifact(sensor)
            reconstructors[sensor] = Reconstructor(sensor, artifact, budget_s=BUDGET_S)
        reconstructor = reconstructors[sensor]
        with threadpool_limits(1):
            reconstructor.set_reference(scene.reference)  # costs more than many a method
        for method in methods:
            reconstructor.tier = Tier(method)
            reconstructor.reset()
            with threadpool_limits(1):
                begin_s = time.perf_counter()
                frame = reconstructor.reconstruct(scene.magnitude, scene.structure)
                seconds = time.perf_counter() - begin_s
            yield Outcome(method, scene, frame, score(scene, frame, seconds))
