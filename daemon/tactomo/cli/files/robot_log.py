"""A robot's own log: when each of its steps was, and what it measured and did.

A CSV file with a line of names: `monotonic_s` or `realtime_s`, Python's `time.monotonic()` or
`time.time()` on the daemon's computer; `episode`, a number that changes with each; columns named
`action.` and something; and any others, which are the robot's state. All are numbers.
"""

from __future__ import annotations

import csv
import io
import math
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.foreign_file import open_regular

from tactomo.errors import TactomoError

CLOCKS: Final = ("monotonic_s", "realtime_s")
ACTION: Final = "action."
EPISODE: Final = "episode"
MOST_LINE: Final = 1 << 20  # characters


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
            lines = csv.reader(iter(lambda: file.readline(MOST_LINE), ""), strict=True)
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
