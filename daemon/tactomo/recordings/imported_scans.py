"""Scans from files of other programs, as volts in the order of a sensor description.

Three layouts are read, told apart by their arrays: *batch* and *plain* are those of docs/files.md;
*single-ended* is what impedance tomography instruments save, as in Sciospec's .eit files: `volts`
(T, injections, electrodes), complex or real, each electrode against ground; `injection`
(injections, 2), source and sink, numbered from 0 or from 1. `t` (T,) seconds may be in each, and a
frame that is all NaN is a scan that did not arrive.

A single-ended scan becomes differences V(m) - V(m + offset), and of complex volts the *real part*
is taken. The field's own unit is the volt in phase with the current; in a mostly resistive body the
quadrature part comes from stray capacitance and adds noise but no contrast, and a modulus would
lose the sign. Where it is large the phase was never calibrated: all volts are turned by the one
angle that leaves least of it. The share that is left out is told.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tactomo_models import Reference, SensorDescription
from tactomo_models.archive import read_arrays
from tactomo_models.array_files import bounded
from tactomo_models.arrays import FloatArray
from tactomo_models.batch import all_nan, checked, companions_of, scans_of
from tactomo_models.sensor.named_pattern import NamedPattern, fitting_patterns
from tactomo_models.sensor.pattern import rim_signs, touching
from tactomo_protocol import Channel, CompanionReading, Hello, Scan, ScanFlag

from tactomo.errors import TactomoError, os_errors_as
from tactomo.protocols.interface import hello_of, oriented
from tactomo.recordings.eit_files import SUFFIX, eit_files, read_eit_files
from tactomo.scans import MAX_QUADRATURE

# Of times and electrodes' numbers: seconds since 1970 until 2096.
MAX_TIME_S = 4e9
SLOWEST_HZ, FASTEST_HZ = 1e-3, 1e6  # what a hello can say
SIGN_SCANS = 4096  # of a longer file, so many tell the signs
TURNED_ROUND = 0.9  # share of voltages of the wrong sign; under an object few change theirs
AT_REST = ("reference", "baseline", "rest", "empty", "vh")  # vh: homogeneous, in EIDORS' tutorials


@dataclass(frozen=True)
class Scans:
    """Scans of one sensor."""

    volts: Mapping[Channel, FloatArray]  # (T, M) in the description's order
    time_s: FloatArray | None  # (T,) rising, from 0; None where the file does not say
    # (M,) or (n, M) volts of each channel whose unloaded scans the file holds
    reference: Mapping[Channel, FloatArray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # what a user should know about how the file was read
    turned_rad: float | None = None  # the angle that complex volts were turned by
    # (T,) readings by name, NaN where there was none; and those with nothing on the skin
    companions: Mapping[str, FloatArray] = field(default_factory=dict)
    companions_at_rest: Mapping[str, float] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of dual scans, T."""
        return len(next(iter(self.volts.values())))

    def times(self, rate_hz: float | None) -> FloatArray:
        """Return (T,) seconds from 0, by rate or the file's own; else raise TactomoError."""
        if rate_hz is not None:
            if not SLOWEST_HZ <= rate_hz <= FASTEST_HZ:
                raise TactomoError(
                    f"{rate_hz:g} scans a second are no device's",
                    f"give --rate from {SLOWEST_HZ:g} to {FASTEST_HZ:.0f}",
                )
            return np.arange(self.count) / rate_hz
        if self.time_s is None:
            raise TactomoError("the file does not say when its scans were taken", "give --rate")
        return self.time_s

    def reference_of(self, frames: slice | None) -> Reference | None:
        """Return the mean of `frames` as the reference, or else the file's own, or None."""
        if frames is not None:
            chosen = {channel: self._chosen(channel, frames) for channel in Channel}
            rest = {name: each[frames] for name, each in self.companions.items()}
            read = {name: each[np.isfinite(each)] for name, each in rest.items()}
            means = tuple((name, float(np.mean(each))) for name, each in read.items() if len(each))
            return replace(Reference.from_scans(**chosen), companions=means or None)
        if not self.reference:
            return None
        magnitude, structure = map(self.reference.get, (Channel.MAGNITUDE, Channel.STRUCTURE))
        at_rest = tuple(self.companions_at_rest.items()) or None
        return replace(Reference.at_rest(magnitude, structure), companions=at_rest)

    def _chosen(self, channel: Channel, frames: slice) -> FloatArray | None:
        volts = self.volts.get(channel)
        if volts is None:
            return None
        if not len(volts[frames]):
            raise TactomoError(
                f"the reference frames are none of the {len(volts)} scans",
                "name some that are there, such as --reference-frames 0:20",
            )
        return volts[frames]

    def packets(
        self, times_s: FloatArray, description: SensorDescription
    ) -> Iterator[tuple[float, Scan | CompanionReading]]:
        """Yield readings and scans with their times in seconds, as the device would have."""
        for counter, time_s in enumerate(times_s):
            device_us = round(float(time_s) * 1e6)
            for index, name in description.companion_indices.items():
                value = float(self.companions[name][counter]) if name in self.companions else np.nan
                if np.isfinite(value):
                    yield float(time_s), CompanionReading(index, ScanFlag(0), device_us, value)
            for channel, volts in self.volts.items():
                if not np.all(np.isnan(volts[counter])):
                    yield (
                        float(time_s),
                        Scan(
                            channel=channel,
                            counter=counter,
                            device_us=device_us,
                            flags=ScanFlag(0),
                            samples=volts[counter].astype(np.float32),
                        ),
                    )

    def hello(self, description: SensorDescription, rate_hz: float) -> Hello:
        """Return what the device that took these scans would have said of itself."""
        channels = tuple(sorted(self.volts))
        return hello_of(description, channels, "import", "tactomo import", rate_hz)


def read_scans(
    path: Path | Sequence[Path],
    description: SensorDescription,
    channel: Channel | None,  # of a file of one channel; None for the sensor's only one
    *,
    array: str | None = None,  # of plain scans; None for the only one that fits
    pattern: NamedPattern | None = None,  # of plain scans in another order than the sensor's
    turn_rad: float | None = None,  # to turn complex volts by; None for their own angle
) -> Scans:
    """Read the scans of a measurement, the file or files of `load_arrays`.

    Raises TactomoError or DataError where it cannot be read, is of no layout, or does not fit
    the sensor.
    """
    arrays = load_arrays(path)
    path = path if isinstance(path, Path) else path[0]
    if array is None and any(name in arrays for name in Channel):
        scans = _batch(path, arrays, description)
    else:
        scans = _of_channel(path, arrays, description, channel, array, pattern, turn_rad)
    readings, at_rest = companions_of(path, arrays, description, scans.count)
    scans = replace(scans, companions=readings, companions_at_rest=at_rest)
    return _turned_round(scans, description)


def _of_channel(
    path: Path,
    arrays: dict[str, NDArray[Any]],
    description: SensorDescription,
    channel: Channel | None,
    array: str | None,
    pattern: NamedPattern | None,
    turn_rad: float | None,
) -> Scans:
    rest: NDArray[Any] | None = None
    if array is None and is_single_ended(arrays):
        raw, time_s = _differences(path, arrays, description)
    else:
        raw, rest, time_s = _plain(path, arrays, description, array, pattern)
    channel = channel or _only_channel(description)
    volts, notes, turned_rad = _in_phase(path, raw, turn_rad)
    reference = {} if rest is None else {channel: _in_phase(path, rest, turned_rad)[0]}
    return Scans({channel: volts}, time_s, reference, notes, turned_rad)


def _turned_round(scans: Scans, description: SensorDescription) -> Scans:
    """The scans with plus and minus exchanged in each channel whose voltages have wrong signs."""
    if description.instrument.voltages != "signed":
        return scans
    signs = rim_signs(description.pairs, description.rim_order)
    wrong = []
    for channel, volts in scans.volts.items():
        known = volts[:: 1 + len(volts) // SIGN_SCANS, signs != 0] * signs[signs != 0]
        known = known[np.isfinite(known)]
        if known.size and (known < 0).mean() > TURNED_ROUND:
            wrong.append(channel)
    if not wrong:
        return scans
    which = "" if len(scans.volts) == 1 else f" of {' and '.join(wrong)}"
    note = f"all voltages{which} turned round, as if plus and minus were exchanged"
    turned = [
        {name: -each if name in wrong else each for name, each in arrays.items()}
        for arrays in (scans.volts, scans.reference)
    ]
    return replace(scans, volts=turned[0], reference=turned[1], notes=(*scans.notes, note))


def load_arrays(path: Path | Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name, or those that .eit files or a folder of them amount to.

    Numbers that no instrument reads are none, see `bounded`.

    Raises TactomoError where it cannot be read, DataError without numbers.
    """
    given = [path] if isinstance(path, Path) else path
    files = [file for each in given for file in (eit_files(each) if each.is_dir() else [each])]
    if all(file.suffix.lower() == SUFFIX for file in files):
        return read_eit_files(files)
    if len(files) > 1:
        raise TactomoError(
            f"{len(files)} files were given, not all of them {SUFFIX}", "give one at a time"
        )
    [one] = files
    step = f"give the path of a file such as .npz, {SUFFIX}, .mat or .csv"
    with os_errors_as(TactomoError, f"cannot read {one}", step):
        return {name: bounded(array) for name, array in read_arrays(one).items()}


def is_single_ended(arrays: Mapping[str, Any]) -> bool:
    """Tell whether a file's arrays are of the single-ended layout."""
    return "volts" in arrays and "injection" in arrays


def _only_channel(description: SensorDescription) -> Channel:
    if len(description.channels) != 1:
        raise TactomoError(
            f"{description.name} has two channels and the file does not say which this is",
            "give --channel magnitude or --channel structure",
        )
    return description.channels[0]


def _batch(path: Path, arrays: dict[str, NDArray[Any]], description: SensorDescription) -> Scans:
    foreign = sorted(arrays.keys() & set(Channel) - set(description.channels))
    if any(not all_nan(arrays[name]) for name in foreign):
        raise TactomoError(
            f"{path} holds a channel that {description.name} does not have: {', '.join(foreign)}",
            "give another description with --description",
        )
    scans, references = scans_of(path, arrays, description)
    volts = {Channel(name): channel for name, channel in scans.items()}
    reference = {Channel(name): channel for name, channel in references.items()}
    return Scans(volts, _times(path, arrays, len(next(iter(volts.values())))), reference)


def _differences(
    path: Path, arrays: dict[str, NDArray[Any]], description: SensorDescription
) -> tuple[NDArray[Any], FloatArray | None]:
    injection, raw = _single_ended_arrays(path, arrays, description)
    rows, signs = _injection_rows(path, injection - injection.min(), description)
    plus, minus = description.pairs.measure.T
    with np.errstate(invalid="ignore"):  # of two infinite readings
        differences = signs * (raw[:, rows, plus] - raw[:, rows, minus])
    return differences, _times(path, arrays, len(raw))


def _in_phase(
    path: Path, raw: NDArray[Any], turn_rad: float | None
) -> tuple[FloatArray, tuple[str, ...], float | None]:
    """Return the volts in phase with the current, notes, and the angle they were turned by."""
    if raw.dtype.kind != "c":
        return np.asarray(raw, np.float64), (), None
    notes: tuple[str, ...] = ()
    if turn_rad is None:
        # Squares have a phase in common, whatever the sign of each: twice that of the volts.
        phase_rad = float(np.angle(np.nansum(raw**2))) / 2
        turn_rad = -phase_rad if _quadrature(raw) > MAX_QUADRATURE else 0.0
    if turn_rad:
        notes = (f"turned by {np.degrees(turn_rad):.0f} degrees, into phase with the current",)
        raw = raw * np.exp(1j * turn_rad)
    quadrature = _quadrature(raw)
    if quadrature > MAX_QUADRATURE:
        raise TactomoError(
            f"{path}: the voltages have no common phase: {quadrature:.0%} of the signal stays "
            "out of phase with the current at the best rotation",
            "calibrate the instrument by a resistor, and measure again",
        )
    notes += (f"real part taken; {quadrature:.0%} is quadrature",)
    return np.asarray(raw.real, dtype=np.float64), notes, turn_rad


def _quadrature(volts: NDArray[Any]) -> float:
    """Return the share of the signal that is out of phase with the current."""
    known = volts[np.isfinite(volts)]
    return float(np.linalg.norm(known.imag) / max(np.linalg.norm(known), np.finfo(float).tiny))


def _plain(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    description: SensorDescription,
    name: str | None,
    pattern: NamedPattern | None,
) -> tuple[NDArray[Any], NDArray[Any] | None, FloatArray | None]:
    """Return scans (T, M), a reference (M,) if there is one, and times if there are."""
    numbers = {key: each for key, each in arrays.items() if each.dtype.kind in "fiuc"}
    if name is not None and name not in numbers:
        raise _unlike(path, arrays, f"no numbers called {name!r}", "name one of these by --array")
    frames = {key: _frames(each, description, pattern) for key, each in numbers.items()}
    fitting = {key: each for key, each in frames.items() if each is not None}
    scans = [name] if name else [key for key in fitting if key not in AT_REST] or list(fitting)
    if len(scans) > 1:
        raise _unlike(path, arrays, "several arrays of scans", "name one of them by --array")
    if not scans or scans[0] not in fitting:
        raise _unlike(path, arrays, *_misfit(numbers, name, description))
    volts, time_s = fitting[scans[0]]
    rest = [each[0].mean(axis=0) for key, each in fitting.items() if key in AT_REST and key != name]
    if time_s is None:
        time_s = _times(path, arrays, len(volts))
    return volts, rest[0] if rest and len(fitting) > 1 else None, time_s


def _frames(
    array: NDArray[Any], description: SensorDescription, pattern: NamedPattern | None
) -> tuple[NDArray[Any], FloatArray | None] | None:
    """Return an array as frames (T, M) in the sensor's order, and times, or None if none fit."""
    drive, measure = description.drive_pairs, description.measure_pairs
    every = np.repeat(drive, len(measure), axis=0), np.tile(measure, (len(drive), 1))
    order = None if pattern is None else pattern.order
    orders = {len(every[0]): np.flatnonzero(~touching(*every)), description.measurements: order}
    array = np.atleast_2d(array)
    if array.ndim > 2 or not array.size:
        return None
    for frames in (array, array.T):
        width = frames.shape[1]
        if width in orders:
            at = orders[width]
            return (frames if at is None else frames[:, at]), None
        times = frames[:, 0].real
        if width - 1 in orders and len(frames) > 1 and (np.diff(times) > 0).all():
            at = orders[width - 1]
            return (frames[:, 1:] if at is None else frames[:, 1 + at]), times - times[0]
    return None


def _misfit(
    numbers: Mapping[str, NDArray[Any]], name: str | None, description: SensorDescription
) -> tuple[str, str]:
    """Say that no array has the sensor's voltages, and which patterns they would fit."""
    said = f"no scans of {description.measurements} voltages, as of {description.name}"
    tables = [np.atleast_2d(a) for key, a in numbers.items() if name in (key, None) and a.size]
    for scans in (turned for table in tables if table.ndim == 2 for turned in (table, table.T)):
        if found := fitting_patterns(np.abs(scans) if scans.dtype.kind == "c" else scans):
            names = " or ".join(map(str, found[:3]))
            next_step = f"reconstruct with --pattern {found[0]}, or give another --description"
            return f"{said}, but {scans.shape[1]} numbers a frame, which fit {names}", next_step
    return said, (
        "save one frame a row or a column; `magnitude` and/or `structure` (T, M); or `volts` (T, "
        "injections, electrodes) and `injection` (injections, 2)"
    )


def _unlike(
    path: Path, arrays: Mapping[str, NDArray[Any]], cause: str, next_step: str
) -> TactomoError:
    held = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
    return TactomoError(f"{path} holds {held or 'nothing'}: {cause}", next_step)


def _single_ended_arrays(
    path: Path, arrays: dict[str, NDArray[Any]], description: SensorDescription
) -> tuple[NDArray[np.int_], NDArray[Any]]:
    injection = _checked(path, "injection", arrays["injection"], (None, 2)).astype(int)
    raw, electrodes = arrays["volts"], description.electrode_count
    fits = raw.shape[1:] == (len(injection), electrodes) and raw.size > 0
    if not fits or raw.dtype.kind not in "fciu":
        raise TactomoError(
            f"{path}: volts is {raw.dtype} {raw.shape}",
            f"it must be numbers (T, {len(injection)}, {electrodes})",
        )
    return injection, raw.astype(np.result_type(raw, np.float64))


def _injection_rows(
    path: Path, injection: NDArray[np.int_], description: SensorDescription
) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Return, for each voltage, its row in the file and the sign of the current there."""
    where = oriented(injection)
    wanted = [tuple(pair) for pair in description.pairs.drive.tolist()]
    missing = sorted(set(wanted) - where.keys())
    if missing:
        raise TactomoError(
            f"{path} has no injection {missing[0]}, which the sensor's pattern needs",
            "give the description of the sensor that was measured",
        )
    rows, signs = np.array([where[pair] for pair in wanted]).T
    return rows, signs


def _times(path: Path, arrays: Mapping[str, NDArray[Any]], count: int) -> FloatArray | None:
    if "t" not in arrays:
        return None
    time_s = _checked(path, "t", arrays["t"], (count,))
    if np.any(np.diff(time_s) < 0):
        raise TactomoError(
            f"{path}: t does not rise", "sort the frames by it, or leave it out and give --rate"
        )
    return np.asarray(time_s - time_s[0])


def _checked(
    path: Path, name: str, array: NDArray[Any], shape: tuple[int | None, ...]
) -> FloatArray:
    numbers = checked(path, name, array, shape)
    if not numbers.size or not np.all(np.abs(numbers) <= MAX_TIME_S):
        raise TactomoError(f"{path}: {name} holds what is out of range", "correct it")
    return numbers
