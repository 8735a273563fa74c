"""The scenes that a pressure field has to explain, in rows: soft, graded, mixed, crowded, moving.

Still scenes, each reconstructed from a cold start and run to its end, moving ones, and days of a
skin that drifts. The rows of ordinary scenes, rectangles and rings are `still_scenes`'; each of the
others is the regime of that name, of which the last frame counts. What counts is what a user is
told: a bad map with no flag of `DISTRUST` is a silent failure, a good one with such a flag a false
alarm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count as count_from
from itertools import islice
from math import ceil
from typing import Any, Final

from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.evaluation.drifting import draw_day
from tactomo_lab.evaluation.moving import (
    COMING,
    NOISE_DB,
    draw_sequence,
    mixed_sequence,
    palm_sequence,
)
from tactomo_lab.evaluation.play import Outcome, play
from tactomo_lab.evaluation.regimes import REGIMES, make_case
from tactomo_lab.scenes.case import (
    SCENE_SHAPES,
    Case,
    SceneShape,
    draw_still,
    still_case,
    with_companion,
)
from tactomo_lab.scenes.drawing import SeedSet

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
    "crowded-soft",
    "crowded-mixed",
    "mixed",
    "overload",
)
STILL_ROWS: Final = ("ordinary", "rectangles-rings", *REGIME_ROWS)
MOVING_ROWS: Final = ("moving", "mixed-moving", "palm")
ROWS: Final = (*STILL_ROWS, *MOVING_ROWS)
DAYS: Final = "day"  # takes minutes: only where it is asked for
SCENES_A_SEQUENCE = 10  # a moving scene has some 100 frames and takes a minute to simulate


def frames_of_row(
    description: SensorDescription,
    row: str,
    method: str,
    seed_set: SeedSet,
    count: int,
    companion: float | None = None,
) -> dict[str, Iterator[Outcome]]:
    """Frames of one of `ROWS`, of days or of a regime as a method has them, by their line's name.

    Without those whose scan is lost, for a map of half a measurement is another question, and those
    in which a palm is still to come; of a regime's case the last frame. `count` is as
    `cases_of_row` has it. `companion` is the relative error of a load cell under the sheet; None
    for none.

    Raises:
        DataError: the row cannot happen to the sensor, or has no room on it.
        ModelError: the method is not to be had for this sensor, or is the user's own and failed.
    """

    def counts(outcome: Outcome) -> bool:
        frame, case = outcome.frame, outcome.case
        if row in REGIMES and row not in MOVING_ROWS:
            return frame is case.frames[-1]
        return frame.scans.keys() >= set(case.description.channels) and frame.phase != COMING

    return {
        line: filter(
            counts,
            play(
                cases if companion is None else (with_companion(case, companion) for case in cases),
                method,
            ),
        )
        for line, cases in cases_of_row(description, row, seed_set, count).items()
    }


def cases_of_row(
    description: SensorDescription, row: str, seed_set: SeedSet, count: int
) -> dict[str, Iterator[Case]]:
    """Cases of one of `ROWS`, `DAYS` or `REGIMES`, by their line's name; the same ones every time.

    `count` is of the scenes of each line, palms too; of other moving ones and of days there is one
    for `SCENES_A_SEQUENCE`.

    Raises DataError where the row cannot happen to the sensor, or has no room on it.
    """
    numbers = range(ceil(count / SCENES_A_SEQUENCE))

    def still(shapes: tuple[SceneShape, ...], snr_db: float) -> Iterator[Case]:
        """Scenes of some shapes, of one to `MAX_CONTACTS` contacts in turns."""
        drawn = (
            (draw_still(description, seed_set, contacts, number), number)
            for number in count_from()
            for contacts in range(1, MAX_CONTACTS + 1)
        )
        fitting = islice((each for each in drawn if each[0].shape in shapes), count)
        return (still_case(description, plan, seed_set, n, snr_db) for plan, n in fitting)

    def lasting(draw: Callable[..., Case], **options: Any) -> Iterator[Case]:
        return (draw(description, seed_set, number, **options) for number in numbers)

    if row == "ordinary":
        return {f"{row} {snr_db:g} dB": still(SCENE_SHAPES, snr_db) for snr_db in ORDINARY_DB}
    if row == "rectangles-rings":
        return {row: still(("rectangle", "ring"), SHAPES_DB)}
    if row == "palm":
        return {row: (palm_sequence(description, seed_set, number) for number in range(count))}
    if row == DAYS:
        kinds = {"reference follows": True, "one tare": False}
        return {f"{row}, {kind}": lasting(draw_day, is_followed=k) for kind, k in kinds.items()}
    if row == "moving":
        return {row: lasting(draw_sequence)}
    if row == "mixed-moving":
        return {f"{row}, noise of {of}": lasting(mixed_sequence, noise_of=of) for of in NOISE_DB}
    return {row: (make_case(description, row, seed_set, number) for number in range(count))}
