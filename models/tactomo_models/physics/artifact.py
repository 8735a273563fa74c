"""Built artifacts: what is computed once for a sensor and kept in a file.

An artifact holds the solved bare sheet, its Jacobian and the Tikhonov matrix, with the hash of
the description it was built for and of its own content. One that was built for another sensor, or
holds other numbers than were built, is refused.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from platformdirs import user_cache_path

from tactomo_models.archive import check_replaceable, map_array, read_arrays, write_whole
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import ArtifactError, DataError, os_errors_as
from tactomo_models.physics.bare_sheet import BareSheet, solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.greens import PackedGreensFunction
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.physics.tikhonov import even_scale, prior_weight, tikhonov_matrix
from tactomo_models.sensor.description import SensorDescription

Progress = Callable[[str], None]

FORMAT = 7  # of the file; rises when what is in it changes
NOMINAL_SNR_DB = 60.0  # of the voltages' root mean square; until a tare has seen the real noise
MODEL_ERROR = 0.003  # relative error of any voltage that no noise accounts for
GREEN_DTYPE = np.float32  # seven digits of what is known to three
INVERSE_REFINEMENTS = 2  # of the mesh: one less than the one that simulates
TYPICAL_CHANGE = 0.3  # of conductivity, by which presses change the magnitude channel
TARGET_SHARE = 0.1  # radius of the noise figure's target over the smaller half side


@dataclass(frozen=True)
class Artifact:
    """All that is precomputed for one sensor."""

    sensor: str  #: name of the description it was built for
    sha256: str  #: that description's hash
    bare: BareSheet  #: the solved bare sheet
    jacobian: FloatArray  #: (M, P) derivative of relative voltage changes by relative conductivity
    tikhonov: FloatArray  #: (P, M) reconstruction matrix for the nominal noise
    regularisation: float  #: its lambda, for changes of a typical size


def nominal_noise(bare_voltages: FloatArray) -> FloatArray:
    """Relative noise (M,) of a converter with the same noise in volts on every measurement."""
    return np.asarray(np.hypot(nominal_noise_v(bare_voltages) / np.abs(bare_voltages), MODEL_ERROR))


def nominal_noise_v(voltages: FloatArray) -> FloatArray:
    """Noise (M,) in volts of that converter; voltages that are no numbers count for nothing."""
    finite = voltages[np.isfinite(voltages)]
    largest = float(np.abs(finite).max(initial=0.0)) or 1.0
    rms = largest * np.sqrt(np.mean((finite / largest) ** 2)) if len(finite) else 0.0
    return np.full(voltages.shape, rms * 10 ** (-NOMINAL_SNR_DB / 20))


def build_artifact(description: SensorDescription, progress: Progress | None = None) -> Artifact:
    """Mesh, solve and invert: a few seconds.

    Args:
        description: the sensor to build for.
        progress: called with a short text at the start of each step.
    """
    say = progress or (lambda _: None)
    say("meshing the sheet")
    sheet = mesh_sheet(description, refinements=INVERSE_REFINEMENTS)
    say("solving the bare sheet")
    bare = solve_bare_sheet(description, sheet, green_dtype=GREEN_DTYPE)
    say("differentiating")
    forward = ForwardModel(description, bare)
    jacobian = forward.bare_jacobian() / np.abs(forward.bare_voltages)[:, None]
    say("choosing the regularisation")
    noise = nominal_noise(forward.bare_voltages)
    prior_scale = even_scale(forward.node_areas_m2)
    weight = prior_weight(TYPICAL_CHANGE, prior_scale)
    return Artifact(
        sensor=description.name,
        sha256=description.sha256,
        bare=bare,
        jacobian=jacobian,
        tikhonov=tikhonov_matrix(jacobian, noise, weight, prior_scale),
        regularisation=weight,
    )


def central_target(description: SensorDescription, bare: BareSheet) -> FloatArray:
    """Conductivity change (P,) of the noise figure's target: a small disc as far inside as can be.

    Of places that are as far from the rim, the one nearest to the centre.
    """
    radius = TARGET_SHARE * min(description.width_m, description.height_m)
    x, y = bare.points[:, bare.pressable]
    depth = description.sheet.outline.depth(x, y)
    deepest = np.flatnonzero(depth > depth.max() - radius / 4)
    at = deepest[np.hypot(x[deepest], y[deepest]).argmin()]
    return np.asarray((np.hypot(x - x[at], y - y[at]) < radius).astype(float))


def cache_folder() -> Path:
    """Where things are kept that can be computed again: the user's cache.

    A service finds its own folder in $CACHE_DIRECTORY, which systemd sets.
    """
    return Path(os.environ.get("CACHE_DIRECTORY") or user_cache_path("tactomo"))


def default_path(description: SensorDescription) -> Path:
    """Where an artifact is kept by default."""
    return cache_folder() / f"{description.name}-{description.sha256[:12]}.npz"


def save_artifact(artifact: Artifact, path: Path) -> None:
    """Write an artifact; a half-written one is never left under that name.

    Raises ArtifactError where the file cannot be written.
    """
    weights = artifact.bare.map_weights.tocsr()
    assert isinstance(artifact.bare.green, PackedGreensFunction)
    arrays = {
        "greens": artifact.bare.green.lower,  # by its name and place at a multiple of 4 bytes
        "format": FORMAT,
        "sensor": artifact.sensor,
        "sha256": artifact.sha256,
        "jacobian": artifact.jacobian,
        "tikhonov": artifact.tikhonov,
        "regularisation": artifact.regularisation,
        "weights_data": weights.data,
        "weights_indices": weights.indices,
        "weights_indptr": weights.indptr,
    }
    for name in _BARE_ARRAYS:
        arrays[name] = getattr(artifact.bare, name)
    if artifact.bare.stretch is not None:
        arrays["stretch"] = artifact.bare.stretch
    arrays["content_sha256"] = _sha256_of(arrays)
    next_step = "free some space or name another path"
    with os_errors_as(ArtifactError, f"cannot write {path}", next_step):
        check_replaceable(path)
        write_whole(path, lambda file: np.savez(file, **arrays))


def _sha256_of(arrays: Mapping[str, object]) -> str:
    """Hash of every array's name, type, shape and numbers, but for the hash itself."""
    content = hashlib.sha256()
    for name in sorted(arrays.keys() - {"content_sha256"}):
        array = np.ascontiguousarray(arrays[name])
        content.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        content.update(array.data)
    return content.hexdigest()


_BARE_ARRAYS = ("points", "triangles", "pressable", "support", "potentials", "transfer")


def load_artifact(path: Path, description: SensorDescription) -> Artifact:
    """Read an artifact and make sure that it belongs to this sensor.

    Raises:
        ArtifactError: it is missing, damaged, of another format, or built for another sensor.
    """
    rebuild = f"run: tactomo models build --description {description.name}"
    try:
        arrays = read_arrays(path)
        version, sha256 = int(arrays["format"]), str(arrays["sha256"])
        if version != FORMAT:
            raise ArtifactError(
                f"{path} has format {version}, this version reads {FORMAT}; {rebuild}"
            )
        if sha256 != description.sha256:
            raise ArtifactError(
                f"{path} was built for sensor {str(arrays['sensor'])!r} ({sha256[:12]}), not for "
                f"{description.name!r} ({description.sha256[:12]}); {rebuild}"
            )
        if str(arrays["content_sha256"]) != _sha256_of(arrays):
            raise ValueError("its numbers are not those that were built")
        # Presses are solved on the sheets as they are: of the even one's 14 MB little is read.
        arrays["greens"] = map_array(path, "greens")
        return _from_arrays(arrays, description)
    except FileNotFoundError as error:
        raise ArtifactError(f"no artifact at {path}; {rebuild}") from error
    except (OSError, KeyError, ValueError, TypeError, DataError) as error:
        raise ArtifactError(f"{path} is damaged or no artifact ({error}); {rebuild}") from error


def _from_arrays(arrays: dict[str, FloatArray], description: SensorDescription) -> Artifact:
    pressable = len(arrays["pressable"])
    shape = (description.map.nodes_y * description.map.nodes_x, pressable)
    weights = sp.csr_matrix(
        (arrays["weights_data"], arrays["weights_indices"], arrays["weights_indptr"]), shape
    )
    artifact = Artifact(
        sensor=str(arrays["sensor"]),
        sha256=str(arrays["sha256"]),
        bare=BareSheet(
            map_weights=weights,
            green=PackedGreensFunction(arrays["greens"]),
            **{name: arrays[name] for name in _BARE_ARRAYS},  # type: ignore[arg-type]
            stretch=arrays.get("stretch"),
        ),
        jacobian=arrays["jacobian"],
        tikhonov=arrays["tikhonov"],
        regularisation=float(arrays["regularisation"]),
    )
    if artifact.jacobian.shape != (description.measurements, pressable):
        raise ValueError(f"jacobian has shape {artifact.jacobian.shape}")
    return artifact


def load_or_build_artifact(
    description: SensorDescription, progress: Progress | None = None
) -> Artifact:
    """Read the sensor's artifact from the user's cache, or build and keep it there.

    Args:
        description: the sensor.
        progress: called with a short text at the start of each step of a build, and before it with
            why a file in the cache is not used.
    """
    path = default_path(description)
    try:
        return load_artifact(path, description)
    except ArtifactError as error:
        if progress is not None and path.exists():
            progress(f"{error}: it is built anew")
    artifact = build_artifact(description, progress)
    try:
        save_artifact(artifact, path)
        return load_artifact(path, description)  # what is large stays in the file
    except ArtifactError:
        return artifact  # the cache is a convenience
