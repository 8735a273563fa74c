"""Batch reconstruction: scans from an .npz file to maps and contacts in another."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo_models.archive import read_arrays, write_whole
from tactomo_models.array_files import bounded
from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.taught_skin import TaughtSkin
from tactomo_models.errors import CalibrationError, DataError, os_errors_as
from tactomo_models.growing_arrays import growing_arrays
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.reference import Reference
from tactomo_models.scans.repeats import Repeats
from tactomo_models.scene.contacts import Contact
from tactomo_models.scene.pressure import PressureCurve
from tactomo_models.sensor.description import SensorDescription

Progress = Callable[[int, int], None]

IMAGES = ("map", "pressure_kpa", "structure")
NUMBERS = ("misfit", "confidence", "force_n", "force_sigma_n")


def _contact_row(frame: int, contact: Contact) -> dict[str, Any]:
    renamed = {"magnitude_sigma": "sigma", "frame": "mount_frame"}  # contact_frame is the frame's
    own = {
        f"contact_{renamed.get(name, name)}": value
        for name, value in contact.in_mm().items()
        if name != "id"
    }
    return {"contact_frame": frame, **own}


def _dtype(value: Any) -> Any:
    if isinstance(value, str):
        return "U7" if value else "U63"  # a range, a link
    return np.float64 if isinstance(value, tuple) else type(value)


CONTACT_TYPES = {
    name: _dtype(value) for name, value in _contact_row(0, Contact(0, 0.0, 0.0, 0.0)).items()
}
VECTORS = dict.fromkeys(("contact_position_m", "contact_normal"), (3,))
TYPES = {
    **dict.fromkeys(IMAGES, np.float32),
    **dict.fromkeys((*NUMBERS, "seconds"), np.float64),
    "flags": np.uint32,
    **CONTACT_TYPES,
}
"""Of the arrays of docs/files.md; a map that is absent is NaN throughout."""
BUDGET_S = 2.0  # a file has no deadline: enough for any scene to converge within its frame


class Reconstructed(NamedTuple):
    """What became of a file of scans."""

    frames: int
    failed: int  # frames of another method than the one asked for
    failure: str  # of the first of these: why
    repeated: int  # scans that were left out: earlier ones over again, where scans at rest differ


class ReferencedScans(NamedTuple):
    """Scans, and what they are measured against."""

    scans: Mapping[str, FloatArray]  # (T, M) volts of each channel
    reference: Reference
    companions: Mapping[str, FloatArray]  # (T,) readings of each companion; NaN where there is none


def reconstruct_file(
    source: Path,
    target: Path,
    *,
    description: SensorDescription,
    method: str = "auto",
    curve: PressureCurve | None = None,
    taught: TaughtSkin | None = None,
    progress: Progress | None = None,
    read: ReferencedScans | None = None,
) -> Reconstructed:
    """Reconstruct every frame of `source` into `target`, one at a time.

    Args:
        source: .npz with `magnitude` (T, M), `structure` (T, M), `magnitude_reference` (M,) or
            (n, M) and `structure_reference` likewise, volts on any common scale. A channel that is
            missing or all NaN is taken as absent, as is a scan that repeats an earlier one though
            scans at rest had noise: of a frozen converter, or a frame that was doubled.
        target: .npz that is written; docs/files.md says what is in it.
        description: the sensor.
        method: its name, see `methods.registry`.
        curve: of a pressure calibration; the description's if None.
        taught: what the skin was taught; None where nothing.
        progress: called with frames done and frames in all.
        read: what `source` holds, of another layout; None to read it here.

    Raises:
        DataError: the input cannot be read, has the wrong shape, or no channel of the sensor;
            or the output cannot be written.
        CalibrationError: another skin was taught.
        ModelError: the method is unknown, or lacks what it needs.
    """
    if not target.parent.is_dir():
        raise DataError(f"cannot write {target}: there is no folder {target.parent}; make it first")
    scans, reference, readings = read or read_scans(source, description)
    if taught is not None and (why := taught.changed(reference)):
        raise CalibrationError(f"what was taught does not fit this skin: {why}; teach it anew")
    shapes = {
        **VECTORS,
        **dict.fromkeys(IMAGES, (description.map.nodes_y, description.map.nodes_x)),
    }
    failed, failure, repeated = 0, "", 0
    repeats = Repeats(description.pairs)
    total = max(len(channel) for channel in scans.values())
    next_step = "name a file in a folder that you may write"
    with (
        os_errors_as(DataError, f"cannot write {target}", next_step),
        growing_arrays(TYPES, shapes, _folder_of(target)) as arrays,
        threadpool_limits(1),  # as the daemon runs: `seconds` are what a robot would see
    ):
        reconstructor = Reconstructor(
            description, method=method, budget_s=BUDGET_S, curve=curve, taught=taught
        )
        reconstructor.set_reference(reference)
        for index in range(total):
            taken = {name: _scan(scans, name, index) for name in Channel}
            for name, scan in taken.items():
                found = None if scan is None else repeats.find(name, scan, reference)
                if scan is not None and found is not None:
                    taken[name] = found.without(scan)
                    repeated += taken[name] is None
            start = time.perf_counter()
            companions = [(name, float(each[index])) for name, each in readings.items()]
            compared = reconstructor.compare(*taken.values(), companions=companions)
            frame = reconstructor.solve(compared)
            row = {"seconds": time.perf_counter() - start, "flags": int(frame.flags)}
            arrays.append(row | {name: getattr(frame, name) for name in (*IMAGES, *NUMBERS)})
            for contact in frame.contacts:
                arrays.append(_contact_row(index, contact))
            failed += bool(frame.failure)
            failure = failure or frame.failure
            if progress:
                progress(index + 1, total)
        write_whole(target, arrays.write)
    return Reconstructed(total, failed, failure, repeated)


def _folder_of(target: Path) -> Path:
    """Return where files can be that grow into a file; what is no file, as /dev/null, has none."""
    is_device = target.exists() and not target.is_file()
    return Path(tempfile.gettempdir()) if is_device else target.resolve().parent


def _scan(scans: Mapping[str, FloatArray], name: str, index: int) -> FloatArray | None:
    """One scan; None where it is missing: an all-NaN row is a scan that was not taken."""
    channel = scans.get(name)
    if channel is None or np.isnan(channel[index]).all():
        return None
    return np.asarray(channel[index])


def read_scans(source: Path, description: SensorDescription) -> ReferencedScans:
    """Read the scans of each channel and the readings of each companion that is there.

    Raises:
        DataError: the file cannot be read or does not fit the sensor.
    """
    with os_errors_as(DataError, f"cannot read {source}", "give an .npz file of scans"):
        arrays = read_arrays(source)
    scans, references = scans_of(source, arrays, description)
    count = len(next(iter(scans.values())))
    readings, at_rest = companions_of(source, arrays, description, count)
    reference = reference_at_rest(source, scans, references, description, at_rest.items())
    return ReferencedScans(scans, reference, readings)


def companions_of(
    source: Path, arrays: Mapping[str, Any], description: SensorDescription, frames: int
) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """Return the readings (T,) of the companions that a file has, and their means at rest.

    Raises:
        DataError: readings are not as many as frames, or of a companion that is not described.
    """
    keys = [f"companion_{name}" for name in description.companion]
    known = {*keys, *(f"{key}_reference" for key in keys)}
    unknown = [key for key in arrays if key.startswith("companion_") and key not in known]
    if known and unknown:
        raise DataError(
            f"{source}: the sensor description has no companion for {', '.join(unknown)}; rename "
            f"or leave out: its companions are {', '.join(description.companion)}"
        )
    readings, at_rest = {}, {}
    for name in description.companion:
        key = f"companion_{name}"
        if key in arrays:
            readings[name] = checked(source, key, arrays[key], (None,))
            if len(readings[name]) != frames:
                raise DataError(
                    f"{source}: {key} holds {len(readings[name])} readings of {frames} frames; "
                    "give one a frame, NaN where there was none"
                )
        if f"{key}_reference" in arrays:
            rest = np.atleast_1d(arrays[f"{key}_reference"])
            read = checked(source, f"{key}_reference", rest, (None,))
            usable = [each for each in read if description.companion[name].may_read(each)]
            if not usable:
                raise DataError(
                    f"{source}: {key}_reference holds no number within its limits; give readings "
                    "with nothing on the skin, or leave it out for the description's offset"
                )
            at_rest[name] = float(np.mean(usable))
    return readings, at_rest


def reference_at_rest(
    source: Path,
    scans: Mapping[str, FloatArray],
    references: Mapping[str, FloatArray],
    description: SensorDescription,
    companions: Collection[tuple[str, float]],
) -> Reference:
    """Return the reference of scans (T, M), with what companions read at rest.

    Several scans at rest (n, M) tell the noise; of a single one, or a mean (M,), the scans do.

    Raises:
        DataError: a channel has none, or one without a voltage.
    """
    for name in scans:
        if name not in references:
            raise DataError(
                f"{source} has {name} but no {name}_reference: add the unpressed scan, or give "
                "--reference-frames FIRST:END, or --reference FILE"
            )
        if not np.any(np.nan_to_num(references[name])):
            raise DataError(
                f"{source}: {name}_reference holds no voltage; take the unpressed scan again"
            )
    rest = Reference.at_rest(references.get("magnitude"), references.get("structure"))
    rest = replace(rest, companions=tuple(companions))
    if not rest.lacks_noise:
        return rest
    # The file does not say how noisy the scans are, nor of how many the reference is the mean.
    return rest.with_noise_of(description, scans.get("magnitude"), scans.get("structure"))


def scans_of(
    source: Path, arrays: Mapping[str, Any], description: SensorDescription
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return the scans (T, M) of each channel of a file, and what references there are.

    A reference is one scan (M,), or several (n, M) at rest.

    Args:
        source: where they are from, for errors.
        arrays: `magnitude`, `structure` and their references; a channel may be all NaN.
        description: the sensor.

    Raises:
        DataError: they do not fit the sensor, or each other.
    """
    scans: dict[str, FloatArray] = {}
    references: dict[str, FloatArray] = {}
    for name in description.channels:
        if name in arrays and not all_nan(arrays[name]):
            scans[name] = checked(source, name, arrays[name], (None, description.measurements))
            key = f"{name}_reference"
            if key in arrays:
                references[name] = _at_rest(source, key, arrays[key], description.measurements)
    if not scans:
        raise DataError(
            f"{source} holds voltages of none of the channels of {description.name!r}: "
            f"{' and '.join(description.channels)}, missing or NaN throughout; it holds: "
            f"{', '.join(arrays) or 'nothing'}"
        )
    lengths = {name: len(channel) for name, channel in scans.items()}
    if len(set(lengths.values())) > 1:
        each = ", ".join(f"{count} of {name}" for name, count in lengths.items())
        raise DataError(f"{source}: channels differ in length: {each}; give as many scans of each")
    return scans, references


def _at_rest(source: Path, name: str, array: Any, count: int) -> FloatArray:
    """One scan (M,) or several (n, M) of `count` voltages; DataError where they are neither.

    A scan that is NaN throughout was not taken.
    """
    if array.ndim != 2 or 1 in array.shape or array.shape[1] != count:
        return checked(source, name, array, (count,))
    scans = checked(source, name, array, (None, count))
    return scans[~np.isnan(scans).all(axis=1)]


def all_nan(array: Any) -> bool:
    """Whether an array stands for a channel that is not there."""
    return array.dtype.kind == "f" and bool(np.isnan(array).all())


def checked(source: Path, name: str, array: Any, shape: tuple[int | None, ...]) -> FloatArray:
    """Return real numbers of a shape, of any length where None; infinite beyond `MAX_SIZE`.

    Raises DataError where they are not.
    """
    if array.ndim == 2 and len(shape) == 1 and 1 in array.shape:
        array = array.ravel()  # MATLAB has no vectors
    fits = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if array.dtype.kind not in "fiu" or not fits:
        wanted = " x ".join("T" if n is None else str(n) for n in shape)
        several = f", or n x {wanted}," if name.endswith("_reference") else ""
        raise DataError(
            f"{source}: {name} is {array.dtype} of shape {array.shape}; real numbers of shape "
            f"{wanted}{several} are needed"
        )
    return np.asarray(bounded(array), dtype=np.float64)
