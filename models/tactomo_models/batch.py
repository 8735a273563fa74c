"""Batch reconstruction: scans from an .npz file to maps and contacts in another."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from tactomo_models.archive import read_arrays, write_arrays
from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.taught_skin import TaughtSkin
from tactomo_models.errors import CalibrationError, DataError
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.contacts import Contact
from tactomo_models.scene.pressure import PressureCurve
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription

Progress = Callable[[int, int], None]

CONTACT_TYPES = {
    name: "U7" if isinstance(value, str) else type(value)
    for name, value in Contact(0, 0.0, 0.0, 0.0).in_mm().items()
    if name != "id"
}
BUDGET_S = 2.0  # a file has no deadline: enough for any scene to converge within its frame


def reconstruct_file(
    source: Path,
    target: Path,
    *,
    description: SensorDescription,
    method: str = "auto",
    curve: PressureCurve | None = None,
    taught: TaughtSkin | None = None,
    progress: Progress | None = None,
    read: tuple[Mapping[str, FloatArray], Reference] | None = None,
) -> list[Reconstruction]:
    """Reconstruct every frame of `source` into `target`, and return the frames.

    Args:
        source: .npz with `magnitude` (T, M), `structure` (T, M), `magnitude_reference` (M,) or
            (n, M) and `structure_reference` likewise, volts on any common scale. A channel that is
            missing or all NaN is taken as absent.
        target: .npz that is written; docs/files.md says what is in it.
        description: the sensor.
        method: its name, see `methods.registry`.
        curve: of a pressure calibration; the description's if None.
        taught: what the skin was taught; None where nothing.
        progress: called with frames done and frames in all.
        read: scans and reference of `source`, of another layout; None to read them here.

    Raises:
        DataError: the input cannot be read, has the wrong shape, or no channel of the sensor;
            or the output cannot be written.
        CalibrationError: another skin was taught.
        ModelError: the method is unknown, or lacks what it needs.
    """
    if not target.parent.is_dir():
        raise DataError(f"cannot write {target}: there is no folder {target.parent}; make it first")
    scans, reference = read or read_scans(source, description)
    total = max(len(channel) for channel in scans.values())
    frames: list[Reconstruction] = []
    seconds = np.zeros(total)
    if taught is not None and (why := taught.changed(reference)):
        raise CalibrationError(f"what was taught does not fit this skin: {why}; teach it anew")
    with threadpool_limits(1):  # as the daemon runs, so that `seconds` are what a robot would see
        reconstructor = Reconstructor(
            description,
            method=method,
            budget_s=BUDGET_S,
            curve=curve,
            taught=taught,
        )
        reconstructor.set_reference(reference)
        for index in range(total):
            magnitude, structure = (_scan(scans, n, index) for n in ("magnitude", "structure"))
            start = time.perf_counter()
            frames.append(reconstructor.reconstruct(magnitude, structure))
            seconds[index] = time.perf_counter() - start
            if progress:
                progress(index + 1, total)
    arrays: dict[str, Any] = {"seconds": seconds, **frame_arrays(frames, description)}
    try:
        write_arrays(target, arrays)
    except OSError as error:
        raise DataError(
            f"cannot write {target}: {error.strerror}; name a file in a folder that you may write"
        ) from error
    return frames


def _scan(scans: Mapping[str, FloatArray], name: str, index: int) -> FloatArray | None:
    """One scan; None where it is missing: an all-NaN row is a scan that was not taken."""
    channel = scans.get(name)
    if channel is None or np.isnan(channel[index]).all():
        return None
    return np.asarray(channel[index])


def read_scans(
    source: Path, description: SensorDescription
) -> tuple[dict[str, FloatArray], Reference]:
    """Read the scans (T, M) of each channel that is there, and their reference.

    Raises:
        DataError: the file cannot be read or does not fit the sensor.
    """
    try:
        arrays = read_arrays(source)
    except OSError as error:
        raise DataError(
            f"cannot read {source}: {error.strerror}; give an .npz file of scans"
        ) from error
    scans, references = scans_of(source, arrays, description)
    return scans, reference_at_rest(source, scans, references, description)


def reference_at_rest(
    source: Path,
    scans: Mapping[str, FloatArray],
    references: Mapping[str, FloatArray],
    description: SensorDescription,
) -> Reference:
    """Return the reference of scans (T, M).

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
            f"{source} holds none of the channels of {description.name!r} "
            f"({', '.join(description.channels)}); it holds: {', '.join(arrays) or 'nothing'}"
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
    """Return real numbers of a shape, of any length where None; DataError where they are not."""
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
    return np.asarray(array, dtype=np.float64)


def frame_arrays(
    frames: list[Reconstruction], description: SensorDescription
) -> dict[str, NDArray[Any]]:
    """Stack frames into the arrays of docs/files.md; a map that is absent is NaN throughout."""
    shape = (description.map.nodes_y, description.map.nodes_x)
    absent = np.full(shape, np.nan, np.float32)
    contacts = [
        (i, contact.in_mm()) for i, frame in enumerate(frames) for contact in frame.contacts
    ]

    def column(values: list[float]) -> FloatArray:
        return np.array(values, dtype=np.float64)

    return {
        "map": np.array([absent if f.map is None else f.map for f in frames]),
        "pressure_kpa": np.array(
            [absent if f.pressure_kpa is None else f.pressure_kpa for f in frames]
        ),
        "structure": np.array([absent if f.structure is None else f.structure for f in frames]),
        "misfit": column([f.misfit for f in frames]),
        "confidence": column([f.confidence for f in frames]),
        "force_n": column([f.force_n for f in frames]),
        "force_sigma_n": column([f.force_sigma_n for f in frames]),
        "flags": np.array([int(f.flags) for f in frames], dtype=np.uint32),
        "contact_frame": np.array([i for i, _ in contacts], dtype=np.int64),
        **{
            "contact_sigma" if name == "magnitude_sigma" else f"contact_{name}": np.array(
                [contact[name] for _, contact in contacts], dtype
            )
            for name, dtype in CONTACT_TYPES.items()
        },
    }
