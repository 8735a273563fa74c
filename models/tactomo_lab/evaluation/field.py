"""The scenes that a pressure field has to explain, in rows: soft, graded, mixed, crowded, moving.

Still scenes, each reconstructed from a cold start and run to its end, and moving ones. The rows of
ordinary scenes, rectangles and rings are `still_scenes`'; each of the others is the regime of that
name.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count as count_from
from itertools import islice
from math import ceil
from typing import Final

from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.evaluation.moving import Sequence as MovingScene
from tactomo_lab.evaluation.moving import draw_sequence, play
from tactomo_lab.evaluation.sequences import (
    COMING,
    NOISE_DB,
    NoiseOf,
    mixed_sequence,
    palm_sequence,
)
from tactomo_lab.evaluation.stability import Case, make_case
from tactomo_lab.evaluation.still import Outcome, reconstruct_scenes
from tactomo_lab.scenes.measures import FrameScore
from tactomo_lab.scenes.still_scenes import (
    SCENE_SHAPES,
    EvaluationScene,
    Layout,
    SceneShape,
    SeedSet,
    Simulation,
    draw_layout,
    measure,
    require_both_channels,
)

MAX_CONTACTS = 4  # of a scene that is not crowded
ORDINARY_DB = (40.0, 20.0, 10.0)  # of the change, as the paper tests
SHAPES_DB = 40.0
REGIME_ROWS: Final = (
    "hand-made",
    "soft",
    "soft-hand-made",
    "graded",
    "crowded",
    "many",
    "mixed",
    "overload",
)
STILL_ROWS: Final = ("ordinary", "rectangles-rings", *REGIME_ROWS)
MOVING_ROWS: Final = ("moving", "mixed-moving", "palm")
ROWS: Final = (*STILL_ROWS, *MOVING_ROWS)
SCENES_A_SEQUENCE = 10  # a moving scene has some 100 frames and takes a minute to simulate


def scores_of_row(
    description: SensorDescription, row: str, method: str, seed_set: SeedSet, count: int
) -> dict[str, Iterator[FrameScore]]:
    """Frames of one of `ROWS` as a method reconstructs them, by the name of their line.

    `count` is of the scenes of each line, palms too; of other moving ones there is one for
    `SCENES_A_SEQUENCE`.

    Raises:
        DataError: the sensor has a single channel, or no room for what presses.
        ModelError: the method is not to be had for this sensor, or is the user's own and failed.
    """
    if row in MOVING_ROWS:
        sequences = sequences_of_row(description, row, seed_set, count)
        return {line: _played(scenes, method) for line, scenes in sequences.items()}
    lines = scenes_of_row(description, row, seed_set, count)
    return {
        line: (outcome.score for outcome in reconstruct_scenes(scenes, method))
        for line, scenes in lines.items()
    }


def sequences_of_row(
    description: SensorDescription, row: str, seed_set: SeedSet, count: int
) -> dict[str, Iterator[MovingScene]]:
    """Moving scenes of one of `MOVING_ROWS`, by the line's name; the same ones every time.

    Arguments and errors are those of `scores_of_row`.
    """
    require_both_channels(description)
    if row == "palm":
        return {row: (palm_sequence(description, seed_set, number) for number in range(count))}
    numbers = range(ceil(count / SCENES_A_SEQUENCE))
    if row == "moving":
        return {row: (draw_sequence(description, seed_set, number) for number in numbers)}

    def mixed(noise_of: NoiseOf) -> Iterator[MovingScene]:
        for number in numbers:
            yield mixed_sequence(description, seed_set, number, noise_of)

    return {f"{row}, noise of {noise_of}": mixed(noise_of) for noise_of in NOISE_DB}


def _played(sequences: Iterator[MovingScene], method: str) -> Iterator[FrameScore]:
    """Frames in which no scan is lost, for a map of half a measurement is another question.

    Without those in which a palm is still to come.
    """
    for sequence in sequences:
        for step, score in zip(sequence.steps, play(sequence, method), strict=True):
            if not step.lost and step.phase != COMING:
                yield score


def scenes_of_row(
    description: SensorDescription, row: str, seed_set: SeedSet, count: int
) -> dict[str, Iterator[EvaluationScene]]:
    """Scenes of one of `STILL_ROWS`, by the line's name; the same ones every time.

    Arguments and errors are those of `scores_of_row`.
    """
    require_both_channels(description)
    if row in REGIME_ROWS:
        return {row: scenes_of_regime(description, row, seed_set, count)}
    simulation = Simulation(description)

    def still(shapes: tuple[SceneShape, ...], snr_db: float) -> Iterator[EvaluationScene]:
        for layout in islice(_layouts(description, seed_set, shapes), count):
            yield measure(simulation.voltages(layout), layout, description, snr_db, "change")

    if row == "ordinary":
        return {f"{row} {snr_db:g} dB": still(SCENE_SHAPES, snr_db) for snr_db in ORDINARY_DB}
    return {row: still(("rectangle", "ring"), SHAPES_DB)}


def middle_press(
    description: SensorDescription, method: str, seed_set: SeedSet, count: int
) -> Outcome:
    """One soft contact as a method has it: the scene whose ICC is the middle."""
    soft = scenes_of_row(description, "soft", seed_set, count)["soft"]
    single = (scene for scene in soft if len(scene.layout.presses) == 1)
    outcomes = sorted(reconstruct_scenes(single, method), key=lambda outcome: outcome.score.icc)
    return outcomes[len(outcomes) // 2]


def _layouts(
    description: SensorDescription, seed_set: SeedSet, shapes: tuple[SceneShape, ...]
) -> Iterator[Layout]:
    """Those of some shapes, of one to `MAX_CONTACTS` contacts in turns."""
    for number in count_from():
        for contacts in range(1, MAX_CONTACTS + 1):
            layout = draw_layout(description, seed_set, contacts, number)
            if layout.shape in shapes:
                yield layout


def scenes_of_regime(
    description: SensorDescription,
    regime: str,
    seed_set: SeedSet,
    count: int,
    *,
    snr_db: float | None = None,
) -> Iterator[EvaluationScene]:
    """Cases of a regime of single frames, with its own noise or of so many dB of the change.

    Raises DataError where the sensor has a single channel, or no room for what presses.
    """
    for number in range(count):
        yield _of_case(
            make_case(description, regime, seed_set, number, snr_db=snr_db), seed_set, number
        )


def _of_case(case: Case, seed_set: SeedSet, number: int) -> EvaluationScene:
    plan, (scans,) = case.plan, case.frames
    (presses,) = plan.frames
    shapes = {press.shape for press in presses}
    shape: SceneShape = "mixed" if len(shapes) > 1 else shapes.pop()
    return EvaluationScene(
        layout=Layout(seed_set, number, presses, shape, plan.contrast, plan.opposite),
        description=case.description,
        snr_db=plan.snr_db,
        snr_of=plan.snr_of,
        reference=case.reference,
        magnitude=scans[Channel.MAGNITUDE],
        structure=scans.get(Channel.STRUCTURE),
    )
