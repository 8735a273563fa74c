"""A recording's frames as a LeRobot dataset, beside a robot's own steps or at a rate of their own.

Each step has the newest frame that had been *published* by then: what the robot could have known.

docs/lerobot.md has the format of a robot's log.
"""

from __future__ import annotations

import csv
import io
import itertools
import logging
import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from tactomo_client.touch import CONTACT_COLUMNS, Touch
from tactomo_models.arrays import FloatArray
from tactomo_models.foreign_file import open_regular

from tactomo.cli.files.recorded_frames import Gaps, TimedFrame
from tactomo.errors import TactomoError, needs

CLOCKS: Final = ("monotonic_s", "realtime_s")
ACTION: Final = "action."
EPISODE: Final = "episode"
MAX_LINE: Final = 1 << 20  # characters


@dataclass(frozen=True)
class RobotLog:
    """A robot's steps."""

    clock: str  # which of the clocks `times_s` is read from
    times_s: FloatArray  # (R,) rising within an episode
    episodes: FloatArray  # (R,) which episode each step is of; equal ones are together
    columns: tuple[str, ...]  # names of the numbers, the clock and the episode left out
    numbers: FloatArray  # (R, len(columns))

    @property
    def parts(self) -> dict[str, list[int]]:
        """Which columns are of what the robot did, and which of what it measured; none is empty."""
        is_action = [name.startswith(ACTION) for name in self.columns]
        parts = {"action": True, "observation.state": False}
        of = {part: np.flatnonzero(np.equal(is_action, kind)) for part, kind in parts.items()}
        return {part: numbers.tolist() for part, numbers in of.items() if len(numbers)}

    @property
    def first_of_episode(self) -> list[bool]:
        """Whether each step begins an episode."""
        return [True, *(np.diff(self.episodes) != 0).tolist()]

    @property
    def period_s(self) -> float:
        """Median time from step to step; NaN where there is one step."""
        steps_s = np.diff(self.times_s)[~np.array(self.first_of_episode[1:], bool)]
        return float(np.median(steps_s)) if len(steps_s) else math.nan

    def missing(self, fps: int) -> int:
        """Return how many steps the log lacks within episodes, at a rate that should be steady."""
        steps_s = np.diff(self.times_s)[~np.array(self.first_of_episode[1:], bool)]
        return int(np.maximum(np.round(steps_s * fps) - 1, 0).sum())


def read_robot_log(path: Path) -> RobotLog:
    """Read a robot's log; raise TactomoError, which names the line that is wrong."""
    numbers = array("d")
    try:
        with open_regular(path) as binary, io.TextIOWrapper(binary, "utf-8", newline="") as file:
            lines = csv.reader(iter(lambda: file.readline(MAX_LINE), ""), strict=True)
            names = [name.strip() for name in next(lines, [])]
            for number, line in enumerate(lines, 2):
                numbers.extend(_numbers(path, number, names, line))
    except (OSError, csv.Error, UnicodeDecodeError) as error:
        raise TactomoError(
            f"cannot read {path}: {getattr(error, 'strerror', None) or error}",
            "give a CSV file with a line of names",
        ) from error
    clock = next((name for name in CLOCKS if name in names), None)
    if clock is None or len(set(names)) < len(names) or not numbers:
        raise TactomoError(
            f"{path} has no column {' or '.join(CLOCKS)}, one name twice, or no steps",
            "write time.monotonic() or time.time() of each of the robot's steps into it",
        )
    rows = np.frombuffer(numbers).reshape(-1, len(names))
    times_s = rows[:, names.index(clock)]
    episodes = rows[:, names.index(EPISODE)] if EPISODE in names else np.zeros(len(rows))
    back = np.flatnonzero(np.diff(times_s) <= 0)
    if len(back):
        raise TactomoError(
            f"{path}, line {back[0] + 3}: {clock} is not later than in the line before",
            "give the steps in the order of their times; monotonic_s never jumps",
        )
    rest = [i for i, name in enumerate(names) if name not in (*CLOCKS, EPISODE)]
    return RobotLog(clock, times_s, episodes, tuple(names[i] for i in rest), rows[:, rest])


def _numbers(path: Path, number: int, names: list[str], line: list[str]) -> list[float]:
    try:
        found = [float(cell) for cell in line]
    except ValueError:
        found = []
    if len(found) != len(names) or not all(math.isfinite(each) for each in found):
        raise TactomoError(
            f"{path}, line {number}: not {len(names)} numbers, one for each name",
            "mend or remove that line",
        )
    return found


DEFAULT_FPS: Final = 30  # as LeRobot's own programs have it
STALE_S: Final = 0.5
"""A step without a younger frame has none: from then on `Frame.is_stale`, by default."""

RESOLUTION_S: Final = 1e-6  # of seconds since 1970 in 64 bits: 2.4e-7


class Step(NamedTuple):
    """A time, the frame that the dataset has there, and how old that is; 0 where there is none."""

    time_s: float
    moment: TimedFrame | None
    age_s: float


class Alignment:
    """Gives each time its frame, and counts what does not fit."""

    def __init__(self, acquired_s: Callable[[TimedFrame], float]) -> None:
        self._acquired_s = acquired_s
        self._without = self._repeated = self._passed_over = 0

    def steps(
        self, moments: Iterator[TimedFrame], times_s: Iterable[float], *, is_endless: bool
    ) -> Iterator[Step]:
        """Yield a step for each time; of endless times, for those within the recording."""
        newest: TimedFrame | None = None
        shown: TimedFrame | None = None
        coming = next(moments, None)
        for time_s in times_s:
            while coming is not None and self.published_s(coming) <= time_s + RESOLUTION_S:
                self._passed_over += newest is not shown
                newest, coming = coming, next(moments, None)
            if is_endless and coming is None and newest is shown:
                return
            age_s = math.inf if newest is None else time_s - self._acquired_s(newest)
            if newest is None or age_s > STALE_S:
                self._without += 1
                yield Step(time_s, None, 0.0)
                continue
            self._repeated += newest is shown
            shown = newest
            yield Step(time_s, newest, age_s)

    def published_s(self, moment: TimedFrame) -> float:
        """Return when a frame was there for others; made frames, when it was acquired."""
        return self._acquired_s(moment) + (moment.age_s or 0.0)

    def lines(self) -> list[str]:
        """Return what did not fit, a sentence each."""
        sentences = {
            f"steps have no frame younger than {STALE_S:g} s: zeros, `has_frame` 0": self._without,
            "steps repeat the frame of the step before": self._repeated,
            "frames are in no step, because newer frames replaced them": self._passed_over,
        }
        return [f"{count} {sentence}" for sentence, count in sentences.items() if count]


def need_lerobot() -> None:
    """Make sure that LeRobot is there; raise TactomoError where it is not installed."""
    logging.getLogger("lerobot").setLevel(logging.ERROR)  # it misses decoders of videos: no matter
    with needs("a dataset", "pip install 'lerobot[dataset]', in Python 3.12 or newer"):
        import datasets
        import lerobot.datasets  # noqa: F401
    datasets.disable_progress_bars()


def write_dataset(
    moments: Iterator[TimedFrame],  # the frames, in the order of their times
    folder: Path,  # the dataset, which must not be there yet
    sensor: str,  # the sensor's name
    gaps: Gaps,  # watches `moments`
    # a robot's steps; None for a step every 1 / fps from the first frame to the last
    log: RobotLog | None = None,
    fps: int | None = None,  # steps a second; None for the log's, or LeRobot's default
    task: str = "touch",  # what is done there, in words
) -> tuple[int, list[str]]:
    """Write a dataset; return how many steps there are, and what did not fit, a sentence each.

    LeRobot holds an episode in memory: some 40 kB for each step. Raises TactomoError where there is
    no map, the clock that is aligned by was set, or no rate is known.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    held = list(_up_to_first_map(moments))
    if not held:
        return 0, []
    touch = Touch(_image(held[-1]).shape)
    alignment = Alignment(_clock(log, gaps))
    rate = fps or _rate(log)
    start_s = alignment.published_s(held[0])
    times_s = (start_s + step / rate for step in itertools.count()) if log is None else log.times_s
    dataset: Any = None
    count = 0
    steps = alignment.steps(itertools.chain(held, moments), times_s, is_endless=log is None)
    for count, step in enumerate(steps, 1):
        begins = log.first_of_episode[count - 1] if log else count == 1
        values = _values(sensor, touch, step, log, count - 1)
        if dataset is None:
            dataset = LeRobotDataset.create(
                f"tactomo/{folder.name}",
                fps=rate,
                features=_features(values, log),
                root=folder,
                use_videos=False,
            )
        elif begins:
            dataset.save_episode()
        if begins:
            start_s = step.time_s
        values["observation.time_s"] = np.array([step.time_s - start_s])
        dataset.add_frame(values | {"task": task})
    dataset.save_episode()
    dataset.finalize()
    lines = alignment.lines()
    if log is not None and (lacking := log.missing(rate)):
        lines.append(
            f"{lacking} steps are missing in the robot's log at {rate} a second; LeRobot's "
            "`timestamp` does not know, `observation.time_s` does"
        )
    if touch.crowded:
        lines.append(f"{touch.crowded} contacts found no row: more than the dataset has")
    return count, lines


def _up_to_first_map(moments: Iterator[TimedFrame]) -> Iterator[TimedFrame]:
    for moment in moments:
        yield moment
        if _image(moment) is not None:
            return
    raise TactomoError(
        "no frame has a map, so the dataset's shape is unknown",
        "look at it with `tactomo info`; record with the skin tared, and with --maps",
    )


def _image(moment: TimedFrame) -> Any:
    images = (moment.frame.pressure_kpa, moment.frame.map, moment.frame.structure)
    return next((image for image in images if image is not None), None)


def _rate(log: RobotLog | None) -> int:
    if log is None:
        return DEFAULT_FPS
    if not math.isfinite(log.period_s) or round(1 / log.period_s) < 1:
        raise TactomoError("the robot's log has less than a step a second", "give --fps")
    return round(1 / log.period_s)


def _clock(log: RobotLog | None, gaps: Gaps) -> Callable[[TimedFrame], float]:
    """Return how to read from a moment when it was acquired, s, on the clock that rows have."""

    def by_clock(moment: TimedFrame) -> float:
        assert log is not None
        if log.clock == "monotonic_s":
            if moment.age_s is None:
                raise TactomoError(
                    "frames that were made of a recording have no monotonic time",
                    "align by realtime_s, or record with --maps",
                )
            return moment.frame.acquired_monotonic_ns * 1e-9
        if gaps.first_step_s:
            raise TactomoError(
                f"the wall clock was set by {gaps.first_step_s:+.3f} s within the recording, so "
                "that realtime_s is ambiguous",
                "log monotonic_s, or export before and after with --from and --to",
            )
        return moment.frame.acquired_realtime_ns * 1e-9

    return (lambda moment: moment.time_s) if log is None else by_clock


def _values(
    sensor: str, touch: Touch, step: Step, log: RobotLog | None, row: int
) -> dict[str, Any]:
    arrays = touch.arrays(step.moment and step.moment.frame)
    arrays["age_s"] = np.array([step.age_s], np.float32)
    values = {f"observation.tactile.{sensor}.{name}": array for name, array in arrays.items()}
    values["observation.time_s"] = np.zeros(1)
    if log is not None:
        for name, columns in log.parts.items():
            values[name] = log.numbers[row, columns].astype(np.float32)
    return values


def _features(values: Mapping[str, Any], log: RobotLog | None) -> dict[str, Any]:
    parts = {} if log is None else log.parts
    names = {part: [log.columns[n] for n in numbers] for part, numbers in parts.items() if log}
    columns = {"fields": list(CONTACT_COLUMNS)}
    return {
        name: {
            "dtype": str(array.dtype),
            "shape": array.shape,
            "names": columns if ".contacts" in name else names.get(name),
        }
        for name, array in values.items()
    }
