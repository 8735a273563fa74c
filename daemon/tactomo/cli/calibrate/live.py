"""The guided session of `tactomo calibrate live`, and what `tactomo calibrate fit` fits.

Live, each reading is appended to a CSV file as soon as it is taken, which is also how a session
that was interrupted goes on: nothing is kept in memory alone.
"""

from __future__ import annotations

import csv
import math
import statistics
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from tactomo_client import Frame, Status
from tactomo_client.recording import open_recording
from tactomo_models import CalibrationError, SensorDescription, load_description
from tactomo_models.calibration import load_cell
from tactomo_models.calibration.calibration_file import (
    SUFFIX,
    PressureCalibration,
    Subject,
    subject_of,
)
from tactomo_models.calibration.curve import (
    MAX_KPA,
    Fit,
    Reading,
    directions_of,
    fit_curve,
    still_wanted,
)
from tactomo_models.calibration.outliers import find_outliers
from tactomo_models.foreign_file import open_regular
from tactomo_models.scans.plausibility import DISTRUST
from tactomo_models.scene.pressure import PressureCurve, Response, described_curve

from tactomo.cli.console import Console
from tactomo.cli.files.recorded_frames import recorded_frames
from tactomo.cli.options import DEFAULT_DESCRIPTION
from tactomo.cli.output import say
from tactomo.cli.steer.watch import View
from tactomo.errors import TactomoError, os_errors_as
from tactomo.recordings.recording import open_recording as open_bytes

STILL_S: Final = 1.0  # for how long a press is to be held still, and is averaged
MIN_FRAMES: Final = 5
STILL_MM: Final = 1.0
STILL_SHARE: Final = 0.03
"""Of the magnitude, by which it may change from the first half to the second."""
OTHER_UNIT: Final = 4.0  # times the described pressures: psi for kPa are 1/7, N/cm² 1/10
SHARES: Final = (-0.3, -0.05, 0.1, 0.25, 0.4, 0.6, 0.8, 1.0)
"""Of the way from the onset to the top, that are suggested going up; and down again."""


class Held(NamedTuple):
    """A press that was still for a while: means of some frames."""

    magnitude: float
    magnitude_sigma: float
    contact_mm2: float
    x_mm: float
    y_mm: float
    frames: int  # how many were averaged
    realtime_s: float  # of the last one


def guided(
    status: Status,
    stream: str,
    keys: Path | None,
    area_mm2: float | None,
    path: Path,
) -> PressureCalibration:
    """Take readings together with the user, and fit them; `status` is the daemon's.

    Raises TactomoError without a magnitude channel, CalibrationError where readings are too few.
    """
    console = Console(highlight=False, soft_wrap=True)
    log = path.with_name(path.name.removesuffix(SUFFIX) + ".readings.csv")
    subject = _subject(status)
    view = View(status.sensor, stream, keys)
    try:
        session = _Session(view, console, status, area_mm2, log)
        session.run()
    finally:
        view.close()
    return PressureCalibration.of_readings(subject, session.readings)


def distrusted(frame: Frame) -> frozenset[str]:
    """Return those flags of a frame that make it untrustworthy."""
    return frame.flags & frozenset(DISTRUST.names())


def _subject(status: Status) -> Subject:
    """Return what is calibrated; TactomoError for a sensor that measures no magnitude."""
    description = status.description
    if description is None or "magnitude" not in description.modalities:
        raise TactomoError(
            f"{status.sensor} has no magnitude channel",
            "its structure channel shows places, but no pressure",
        )
    devices = {port.device.device_id for port in status.ports if port.device is not None}
    return Subject(
        sensor=status.sensor,
        description=description.model,
        sha256=description.sha256,
        device_ids=tuple(sorted(devices)),
    )


def suggestions_kpa(response: Response) -> list[float]:
    """Pressures to take, up and down again, by the response that the daemon has now."""
    kpa, change = response.pressure_kpa, response.relative_change
    onset = max((p for p, c in zip(kpa, change, strict=True) if c == 0), default=kpa[0])
    up = [onset + share * (kpa[-1] - onset) for share in SHARES]
    up = [max(p, 0.05 * kpa[-1]) for p in up]
    return [*up, *reversed(up[:-1])]


class _Session:
    """Asks, waits, averages, and keeps."""

    def __init__(
        self,
        view: View,
        console: Console,
        status: Status,
        area_mm2: float | None,
        log: Path,
    ) -> None:
        self._view, self._console, self._log = view, console, log
        self._area_mm2 = area_mm2 or math.nan  # of the indenter; asked for first where unknown
        assert status.description is not None
        response = status.description.magnitude_response
        assert response is not None
        self._suggested = suggestions_kpa(response)
        self._curve = PressureCurve.of_response(response)
        self.readings: list[Reading] = _read_log(log)

    def run(self) -> None:
        """Take readings until the user has enough; Ctrl-C ends it, too."""
        try:
            self._welcome()
            while self._take_one():
                self._print_progress()
        except (KeyboardInterrupt, EOFError):
            self._console.print("\nstopped")
        self._console.print(f"{len(self.readings)} readings are kept in {self._log}")

    def _welcome(self) -> None:
        say = self._console.print
        say(f"Calibrating {self._view.sensor} against a load cell.")
        say(
            "Press with one flat indenter, well inside the skin, and go from load to load without "
            "lifting it.\nAt each: hold still, press Enter, and type the load cell's reading in "
            "newtons. undo drops\nthe last reading, done or Ctrl-C ends. Each "
            "reading is kept at once."
        )
        if math.isnan(self._area_mm2):
            diameter_mm = self._asked("Diameter of the indenter in mm: ", least=1.0, most=1e3)
            self._area_mm2 = math.pi / 4 * diameter_mm**2
        if self.readings:
            kept = f"{len(self.readings)} readings in {self._log}"
            say(f"Going on with {kept}; delete the file to begin anew.")
            self._print_progress()

    def _take_one(self) -> bool:
        """Take one reading, or undo one; returns whether to go on."""
        word = self._console.input(f"\n{self._what_to_press()}\nEnter when it is held: ").strip()
        if word in ("done", "q", "quit"):
            return False
        if word == "undo":
            self._undo()
            return True
        held = self._wait_still()
        self._console.print(
            f"still: |Δσ|/σ₀ {held.magnitude:.4f} ± {held.magnitude_sigma:.4f} at "
            f"({held.x_mm:.1f}, {held.y_mm:.1f}) mm, {held.frames} frames"
        )
        # What no skin bears: a slip beyond that would spoil the fit of all others.
        largest_n = MAX_KPA * 1e-3 * self._area_mm2
        force_n = self._asked("Load cell in N: ", least=0.0, most=largest_n)
        self._keep(held, force_n)
        return True

    def _what_to_press(self) -> str:
        number = len(self.readings)
        kpa = self._suggested[number % len(self._suggested)]
        force_n = kpa * 1e-3 * self._area_mm2
        rises = number == 0 or kpa > self._suggested[(number - 1) % len(self._suggested)]
        way = "up" if rises else "down"
        return f"Reading {number + 1}, going {way}: about {force_n:.0f} N ({kpa:.0f} kPa)."

    def _asked(self, question: str, least: float, most: float) -> float:
        while True:
            try:
                value = float(self._console.input(question).strip().removesuffix("N"))
            except ValueError:
                value = math.nan
            if least <= value <= most:
                return value
            self._console.print(f"a number from {least:g} to {most:.0f}, please")

    def _wait_still(self) -> Held:
        """Wait until one contact has been still for a while; says meanwhile what it waits for."""
        frames: deque[Frame] = deque()
        begin_s = time.monotonic()
        with self._console.status("") as line:
            while True:
                frame = self._view.frame if self._view.update(0.1) else None
                # What was acquired before, and waited to be read, may be of another force.
                if frame is not None and frame.age_s <= time.monotonic() - begin_s:
                    frames.append(frame)
                while len(frames) > MIN_FRAMES and _span_s(frames) > STILL_S:
                    frames.popleft()
                why = self._why_not(frames)
                if not why:
                    return _mean_of(frames)
                line.update(why)

    def _why_not(self, frames: Sequence[Frame]) -> str:
        """Why these frames are no reading; empty where they are one."""
        if self._view.is_gone or (frames and frames[-1].is_stale):
            return "no data: does the daemon run, and is the skin plugged in?"
        if not frames:
            return "waiting for a frame"
        flags = distrusted(frames[-1])
        if flags:
            return f"not to be trusted: {', '.join(sorted(flags))}; `tactomo tare` unpressed"
        count = len(frames[-1].contacts)
        if count != 1:
            return "no contact: press" if not count else f"{count} contacts: press one place only"
        if frames[-1].contacts[0].magnitude is None:
            return "the magnitude channel is missing"
        return "" if _are_still(frames) else "moving: hold it still"

    def _keep(self, held: Held, force_n: float) -> None:
        kpa = 1e3 * force_n / self._area_mm2
        before = [reading.pressure_kpa for reading in self.readings]
        row = {
            "realtime_s": f"{held.realtime_s:.3f}",
            "pressure_kpa": f"{kpa:.6g}",
            "force_n": f"{force_n:g}",
            "area_mm2": f"{self._area_mm2:.6g}",
            "magnitude": f"{held.magnitude:.6g}",
            "magnitude_sigma": f"{held.magnitude_sigma:.6g}",
            "direction": directions_of([*before, kpa])[-1],
            "x_mm": f"{held.x_mm:.2f}",
            "y_mm": f"{held.y_mm:.2f}",
            "contact_mm2": f"{held.contact_mm2:.6g}",
        }
        _append(self._log, row)
        self.readings = _read_log(self._log)  # each says more of the area of all
        self._console.print(f"{kpa:.0f} kPa, taken")

    def _undo(self) -> None:
        if not self.readings:
            self._console.print("there is nothing to undo")
            return
        dropped = self.readings[-1]
        lines = self._log.read_text("utf-8").splitlines(keepends=True)
        self._log.write_text("".join(lines[:-1]), "utf-8")
        self.readings = _read_log(self._log)
        self._console.print(f"dropped the reading at {dropped.pressure_kpa:.0f} kPa")

    def _print_progress(self) -> None:
        if not self.readings:
            return
        fit = _fit_so_far(self.readings)
        wanted = still_wanted(self.readings)
        if len(self.readings) - 1 in find_outliers(self.readings):
            self._console.print(
                "The other readings contradict this reading: undo drops it.", style="red"
            )
        if doubt := _doubt_of_unit(self.readings, self._curve, "the daemon"):
            question = "is the load cell's reading in newtons, and the indenter's size right?"
            self._console.print(f"{doubt}: {question}", style="red")
        if fit is not None:
            sigma_kpa = statistics.median(fit.curve.sigma_kpa.tolist())
            self._console.print(f"curve: ± {sigma_kpa:.1f} kPa (median of the range)")
        self._console.print(
            f"Still wanted: {'; '.join(wanted)}."
            if wanted
            else "That is enough: type done, or continue for a better curve."
        )


def _fit_so_far(readings: Sequence[Reading]) -> Fit | None:
    try:
        return fit_curve(readings)
    except CalibrationError:
        return None


def _are_still(frames: Sequence[Frame]) -> bool:
    """Whether these frames show one contact that neither moves nor changes for long enough."""
    if len(frames) < MIN_FRAMES or _span_s(frames) < 0.8 * STILL_S:
        return False
    if any(len(f.contacts) != 1 or f.contacts[0].magnitude is None for f in frames):
        return False
    # The means of both halves: single frames are as noisy as they are.
    half = len(frames) // 2
    before, after = _mean_of(list(frames)[:half]), _mean_of(list(frames)[half:])
    allowed = max(STILL_SHARE * after.magnitude, after.magnitude_sigma)
    moved_mm = math.hypot(after.x_mm - before.x_mm, after.y_mm - before.y_mm)
    return abs(after.magnitude - before.magnitude) <= allowed and moved_mm <= STILL_MM


def _span_s(frames: Sequence[Frame]) -> float:
    return (frames[-1].acquired_monotonic_ns - frames[0].acquired_monotonic_ns) * 1e-9


def _mean_of(frames: Sequence[Frame]) -> Held:
    contacts = [frame.contacts[0] for frame in frames]
    return Held(
        # Errors of the model do not average out: the uncertainty stays one frame's.
        magnitude=statistics.fmean(c.magnitude or 0.0 for c in contacts),
        magnitude_sigma=statistics.fmean(c.magnitude_sigma or 0.0 for c in contacts),
        contact_mm2=statistics.fmean(c.area_mm2 for c in contacts),
        x_mm=statistics.fmean(c.x_mm for c in contacts),
        y_mm=statistics.fmean(c.y_mm for c in contacts),
        frames=len(frames),
        realtime_s=frames[-1].acquired_realtime_ns * 1e-9,
    )


def _read_log(log: Path) -> list[Reading]:
    if not log.exists() or _is_begun(log):
        return []
    return list(load_cell.direct_readings(load_cell.read_load_cell(log)).readings)


def _is_begun(log: Path) -> bool:
    """Whether a log has its line of names and nothing else."""
    with open_regular(log) as file:
        return not any(line.strip() for line in islice(file, 1, 3))


def _append(log: Path, row: dict[str, str]) -> None:
    """Add a line; raise TactomoError where that cannot be done."""
    step = "give --output in a folder that you may write"
    with os_errors_as(TactomoError, f"cannot write {log}", step):
        log.parent.mkdir(parents=True, exist_ok=True)
        is_new = not log.exists()
        with log.open("a", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if is_new:
                writer.writeheader()
            writer.writerow(row)


def fitted(
    sensor: str,
    readings: Path,
    recording: Path | None,
    area_mm2: float | None,
    offset_s: float,
    description: str | None,
    device_ids: tuple[str, ...],
) -> tuple[PressureCalibration, list[str]]:
    """Fit what a load cell says, with the magnitudes in it or in a recording; and its odd lines."""
    cell = load_cell.read_load_cell(readings, area_mm2)
    if recording is None:
        _need(cell, readings, "magnitude")
        known = load_description(description or DEFAULT_DESCRIPTION)
        subject, joined = subject_of(sensor, known), load_cell.direct_readings(cell)
    else:
        _need(cell, readings, "time")
        known, subject, joined = _with_recording(sensor, cell, recording, offset_s, description)
    if device_ids:
        subject = subject.model_copy(update={"device_ids": device_ids})
    odd = _odd_lines(joined)
    disagree = (f"{line} disagrees with the others" for line in odd)
    for note in (*joined.notes, *disagree):
        say(note, err=True)
    curve = described_curve(known)
    assert curve is not None
    if doubt := _doubt_of_unit(joined.readings, curve, known.name):
        say(f"{doubt}: is the column pressure_kpa in kPa, or force_n in N?", err=True)
    return PressureCalibration.of_readings(subject, joined.readings), odd


def _doubt_of_unit(readings: Sequence[Reading], curve: PressureCurve, whose: str) -> str:
    """Say where pressures are so far from a curve's that they may be of another unit."""
    low, high = curve.magnitude[[0, -1]]
    read = [each for each in readings if low < each.magnitude < high]
    shares = [each.pressure_kpa / float(curve.pressure(np.array(each.magnitude))) for each in read]
    share = statistics.median(shares) if shares else 1.0
    if 1 / OTHER_UNIT < share < OTHER_UNIT:
        return ""
    return f"pressures are {share:.2g} times those of {whose}'s table at the same magnitudes"


def _odd_lines(joined: load_cell.Joined) -> list[str]:
    odd = [(joined.lines[i], joined.readings[i]) for i in find_outliers(joined.readings)]
    return [
        f"line {line} ({reading.pressure_kpa:.0f} kPa, |Δσ|/σ₀ {reading.magnitude:.3f})"
        for line, reading in odd
    ]


def _need(cell: load_cell.LoadCell, path: Path, what: str) -> None:
    if what == "magnitude" and not (cell.magnitude >= 0).any():
        raise CalibrationError(
            f"{path} tells times and no magnitude; give the recording of that time by --recording"
        )
    if what == "time" and not cell.clock:
        raise CalibrationError(
            f"{path} has no column time_s or realtime_s, by which to find its lines in the "
            "recording; leave --recording out if its magnitudes are to be taken"
        )


def _with_recording(
    sensor: str, cell: load_cell.LoadCell, path: Path, offset_s: float, description: str | None
) -> tuple[SensorDescription, Subject, load_cell.Joined]:
    recorded = open_recording(path).sensor
    if recorded and recorded != sensor:
        raise CalibrationError(
            f"{path} is a recording of {recorded}, not of {sensor}; give --sensor {recorded}"
        )
    with recorded_frames(path, description) as frames:
        if frames.description is None:
            raise CalibrationError(
                f"the sensor description that {path} was recorded with is not in it; give it by "
                "--description"
            )
        subject = subject_of(sensor, frames.description, _devices_in(path))
        moments = frames.with_progress(frames.moments("contacts"), "reading contacts")
        by_start = cell.clock == "time_s"
        seen = seen_of(
            [
                (m.time_s if by_start else m.frame.acquired_realtime_ns * 1e-9, m.frame)
                for m in moments
            ]
        )
    joined = load_cell.joined_readings(replace(cell, times_s=cell.times_s + offset_s), seen)
    return frames.description, subject, joined


def _devices_in(path: Path) -> tuple[str, ...]:
    (first, *_) = open_recording(path).files
    hellos = open_bytes(first).summary.hellos
    return tuple(sorted({hello.device_id for hello in hellos}))


def seen_of(frames: Sequence[tuple[float, Frame]]) -> load_cell.Seen:
    """What a sensor showed in frames with their times; untrustworthy ones are left out.

    Raises CalibrationError where there is none to be trusted.
    """
    trusted = [(time_s, frame) for time_s, frame in frames if not distrusted(frame)]
    if not trusted:
        raise CalibrationError(
            f"none of the {len(frames)} frames can be trusted; `tactomo doctor` says why"
        )
    single = [frame.contacts[0] if len(frame.contacts) == 1 else None for _, frame in trusted]
    return load_cell.Seen(
        times_s=np.array([time_s for time_s, _ in trusted]),
        magnitude=np.array([c and c.magnitude for c in single], float),  # None becomes NaN
        magnitude_sigma=np.array([c and c.magnitude_sigma for c in single], float),
        contact_mm2=np.array([c and c.area_mm2 for c in single], float),
        contacts=np.array([len(frame.contacts) for _, frame in trusted]),
    )
