"""The guided session of `tactomo teach live`: press by press, at the terminal.

The file of presses is written whole after each one, which is also how a session that was
interrupted goes on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from tactomo_client import Keys
from tactomo_client.keys import as_keys
from tactomo_models.archive import read_arrays, write_arrays
from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.calibration_file import Subject
from tactomo_models.calibration.taught_skin import are_forces
from tactomo_models.scans.plausibility import Flag
from tactomo_models.sensor.description import SensorDescription

from tactomo.cli.console import Console
from tactomo.cli.doctor.evidence import Evidence, of_daemon
from tactomo.errors import TactomoError, os_errors_as

REST_S: Final = 2.0
HOLD_S: Final = 1.0  # for how long a press is to be held still
STILL_SHARE: Final = 0.05
"""Of the press's change, by which it may differ from the first half to the second."""
DISTURBED: Final = Flag.NOISE_HIGH | Flag.CHANNELS_SWAPPED | Flag.CHANNELS_SKEWED
"""What makes scans worthless; what the physics explains badly is what is to be taught."""
INSIDE: Final = 0.85
"""Share of the sensing area's width that places are suggested in: an indenter has a width, too."""
TRIES: Final = 40  # for each of the places, some of which are off the sheet
GOLDEN: Final = 1.32471795724475
"""Root of x³ = x + 1: its powers spread points evenly over a square, however many there are
(Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018)."""


def guided(
    sensor: str, stream: str, keys: Path | None, description: str | None, file: Path
) -> tuple[SensorDescription, Subject]:
    """Take presses together with the user into a file; of which sensor they are.

    Raises TactomoError where no daemon answers, or the file is of other presses.
    """
    console = Console(highlight=False, soft_wrap=True)
    return _Session(sensor, stream, as_keys(keys), description, file, console).run()


@dataclass
class _Session:
    """Asks, listens, and keeps."""

    _sensor: str
    _stream: str
    _keys: Keys | None
    _given: str | None
    _file: Path
    _console: Console

    def __post_init__(self) -> None:
        self._arrays: dict[str, Any] = read_arrays(self._file) if self._file.exists() else {}

    def run(self) -> tuple[SensorDescription, Subject]:
        """Take presses until the user has enough; Ctrl-C ends it, too."""
        say = self._console.print
        say(f"Teaching {self._sensor} where it is pressed.")
        rest, description = self._rest()
        if self._count:
            say(f"Going on with {self._count} presses in {self._file}.")
        else:
            self._arrays = {f"{name}_reference": volts for name, volts in rest.items()}
        say(
            "Press one known place at a time and hold still: Enter takes it. Or type another "
            "place, such as 12.5 -30\n(mm from the middle, x to the right, y up), and "
            "behind it the force, if known: 12.5 -30 8.2 (N).\n"
            "undo drops the last one, done or Ctrl-C ends."
        )
        try:
            while self._take_one(description):
                say(f"presses kept in {self._file}: {self._count}")
        except (KeyboardInterrupt, EOFError):
            say("\nstopped")
        if not self._count:
            raise TactomoError("there are no presses", "take some with the skin pressed")
        return description, self._subject

    @property
    def _count(self) -> int:
        return len(self._arrays.get("xy_mm", ()))

    def _rest(self) -> tuple[dict[str, FloatArray], SensorDescription]:
        """The unpressed skin's voltages, and what the sensor is."""
        while True:
            self._console.input("Take everything off the skin, and press Enter: ")
            heard = self._heard(REST_S)
            if not heard.pressed:
                break
            self._console.print("something presses; if nothing does, run `tactomo tare`")
        if not isinstance(heard.layout, SensorDescription):
            raise TactomoError(
                "the daemon's sensor description is not on this computer", "give --description"
            )
        self._subject = Subject.of(self._sensor, heard.layout, heard.devices)
        return {name: each.volts.mean(axis=0) for name, each in heard.scans.items()}, heard.layout

    def _take_one(self, description: SensorDescription) -> bool:
        """Take one press, or undo one; returns whether to go on."""
        x_mm, y_mm = suggested_mm(description, self._count)
        word = self._console.input(f"\nPress ({x_mm:g}, {y_mm:g}) mm, hold, and Enter: ").strip()
        if word in ("done", "q", "quit"):
            return False
        if word == "undo":
            self._keep(slice(0, max(self._count - 1, 0)))
            return True
        force_n = np.nan
        if word:
            try:
                word = word.replace(", ", " ")
                # Mixed with blanks, a comma may be a decimal one.
                x_mm, y_mm, *rest = map(float, word.split("," if "," in word else None))
                (force_n,) = rest or [np.nan]
            except ValueError:
                self._console.print("two numbers, such as 12.5 -30, or three with newtons, please")
                return True
        # At the end, one slip would refuse all presses.
        if not description.on_sheet(1e-3 * np.array(x_mm), 1e-3 * np.array(y_mm)):
            self._console.print(f"not taken: ({x_mm:g}, {y_mm:g}) mm is off the skin")
            return True
        if not are_forces(np.array(force_n)):
            self._console.print(f"not taken: {force_n:g} N presses nothing")
            return True
        heard = self._heard(HOLD_S)
        if why := self._why_not(heard):
            self._console.print(f"not taken: {why}")
            return True
        # One scan, not their mean: what is learnt is to hold for scans as noisy as they come.
        last = {name: each.volts[-1] for name, each in heard.scans.items()}
        place = {"xy_mm": np.array([x_mm, y_mm]), "force_n": np.array(force_n)}
        self._keep(slice(None), {**last, **place})
        return True

    def _heard(self, seconds: float) -> Evidence:
        with self._console.status("listening"):
            return of_daemon(
                self._sensor, self._stream, seconds, self._given, self._keys, lambda _: None
            )

    def _why_not(self, heard: Evidence) -> str:
        """Why what was heard is no press; empty where it is one."""
        flags = sorted(heard.flags & set(DISTURBED.names()))
        if flags:
            return f"not to be trusted: {', '.join(flags)}; `tactomo tare` unpressed"
        if heard.pressed < heard.frames or not heard.frames:
            return "no contact was seen: press, then Enter, and hold for a second"
        for name, scans in ((name, each.volts) for name, each in heard.scans.items()):
            if f"{name}_reference" not in self._arrays:
                return f"the {name} channel was missing in the scans at rest; begin anew"
            before, after = np.array_split(scans, 2)
            change = np.linalg.norm(scans.mean(axis=0) - self._arrays[f"{name}_reference"])
            moved = np.linalg.norm(after.mean(axis=0) - before.mean(axis=0))
            noise = np.sqrt(2 * before.var(axis=0).sum() / max(len(before) - 1, 1))
            if moved > STILL_SHARE * change + 2 * noise:
                return "the contact moved: hold it still for a second"
        return ""

    def _keep(self, which: slice, press: dict[str, FloatArray] | None = None) -> None:
        """Keep these of the presses so far, and one more."""
        if self._count and "force_n" not in self._arrays:  # a file from before forces were asked
            self._arrays["force_n"] = np.full(self._count, np.nan)
        for name in ("magnitude", "structure", "xy_mm", "force_n"):
            rows = self._arrays.get(name)
            rows = None if rows is None else rows[which]
            if press is not None and name in press:
                row = press[name][None]
                rows = row if rows is None else np.concatenate([rows, row])
            if rows is not None:
                self._arrays[name] = rows
        step = "give --output in a folder that you may write"
        with os_errors_as(TactomoError, f"cannot write {self._file}", step):
            write_arrays(self._file, self._arrays)


def suggested_mm(description: SensorDescription, number: int) -> tuple[float, float]:
    """Where to press next: any first so many of these places are spread over the skin."""
    size_m = np.array([description.width_m, description.height_m])
    margin_m = description.sheet.frame_width_m + (1 - INSIDE) / 2 * float(size_m.min())
    step = 1 + np.arange(TRIES * (number + 1))
    x_m, y_m = size_m[:, None] * ((0.5 + np.outer((1 / GOLDEN, 1 / GOLDEN**2), step)) % 1 - 0.5)
    depth_m = description.sheet.outline.depth(x_m, y_m)
    inside = np.flatnonzero(depth_m > min(margin_m, depth_m.max() / 2))
    x_mm, y_mm = np.round(1e3 * np.array([x_m, y_m])[:, inside[number % len(inside)]]).tolist()
    return x_mm, y_mm
