"""Still scenes, each reconstructed from a cold start and run to its end, as a file's frames are."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from tactomo_models.batch import BUDGET_S
from tactomo_models.errors import MethodError
from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription
from threadpoolctl import threadpool_limits

from tactomo_lab.scenes.measures import SceneScore, score
from tactomo_lab.scenes.still_scenes import EvaluationScene


@dataclass(frozen=True)
class Variant:
    """A method and the compute time that it may take for a frame."""

    method: str  # its name
    # by a model of the work (`field_fit.Budget`); None leaves it to what plays the frames
    budget_s: float | None = None

    def __str__(self) -> str:
        return f"{self.method}, {self.budget_name}" if self.budget_name else str(self.method)

    @property
    def budget_name(self) -> str:
        """The budget in words, "20 ms"; nothing where there is none."""
        if self.budget_s is None:
            return ""
        return f"{self.budget_s * 1e3:g} ms" if self.budget_s < 1 else f"{self.budget_s:g} s"


@dataclass(frozen=True)
class Outcome:
    """A scene, what a variant of a method made of it, and how right that is."""

    variant: Variant
    scene: EvaluationScene
    frame: Reconstruction
    score: SceneScore

    @property
    def method(self) -> str:
        """The method's name."""
        return self.variant.method


def reconstruct_scenes(
    scenes: Iterable[EvaluationScene], *methods: str | Variant
) -> Iterator[Outcome]:
    """Reconstruct each scene by itself, by one method after the other, on one thread.

    Args:
        scenes: of one sensor, whatever its sign.
        *methods: of reconstruction, as `tactomo reconstruct` has them, or variants of such; what
            has no budget is run to its end.

    Raises:
        ModelError: a method is not to be had for this sensor, or is the user's own and failed.
    """
    variants = [Variant(m) if isinstance(m, str) else m for m in methods]
    reconstructors: dict[SensorDescription, Reconstructor] = {}
    for scene in scenes:
        sensor = scene.description
        is_new = sensor not in reconstructors
        if is_new:
            reconstructors[sensor] = Reconstructor(sensor, load_or_build_artifact(sensor))
        reconstructor = reconstructors[sensor]
        with threadpool_limits(1):
            reconstructor.set_reference(scene.reference)  # costs more than many a method
            if is_new:  # what a method makes once is no part of a frame's time
                for variant in variants:
                    _reconstruct(reconstructor, scene, variant)
        for variant in variants:
            with threadpool_limits(1):
                frame, seconds = _reconstruct(reconstructor, scene, variant)
            yield Outcome(variant, scene, frame, score(scene, frame, seconds))


def _reconstruct(
    reconstructor: Reconstructor, scene: EvaluationScene, variant: Variant
) -> tuple[Reconstruction, float]:
    """A frame from a cold start, and the processor time (s) that it took."""
    reconstructor.method = variant.method
    reconstructor.budget_s = BUDGET_S if variant.budget_s is None else variant.budget_s
    reconstructor.reset()
    begin_s = time.thread_time()
    frame = reconstructor.reconstruct(scene.magnitude, scene.structure)
    seconds = time.thread_time() - begin_s
    if frame.failure:  # the frame is another method's
        raise MethodError(frame.failure)
    return frame, seconds
