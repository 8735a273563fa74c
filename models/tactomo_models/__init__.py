"""The sensor's physics and the reconstruction methods: from scans to pressure maps and contacts.

::

    description = load_description("paper_square")
    reconstructor = Reconstructor(description)
    reconstructor.set_reference(Reference.from_scans(magnitude_scans, structure_scans))
    frame = reconstructor.reconstruct(magnitude, structure)

Nothing here opens a port or a socket; what the daemon does live and what a researcher does
offline run this same code. Its folders, in the order in which each builds on those before:

===============  =================================================================================
sensor           description of a skin and its file: pattern, sheet, response
imported         descriptions from drawings and from models of EIDORS and pyEIT
physics          mesh, forward model, artifacts, sensitivity, linear reconstruction matrices
scans            from voltages to changes: polarity, plausibility, reference
scene            shapes, areas, contacts and pressure of a scene
methods          reconstruction methods: a protocol, a registry, a file for each method
simulation       skins with known truth, and their drift
calibration      pressure curves from a load cell
health           faults of a skin or its leads
drift            a reference that follows the skin
commissioning    teaching one skin, and objects on that skin at a start
simulators       the skin in MuJoCo and Gymnasium
===============  =================================================================================

Below the last two, `reconstruct` turns scans into frames, and `batch` does so for a file.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tactomo_protocol import Channel

    from tactomo_models.drift.baseline import BaselineTracker
    from tactomo_models.errors import (
        ArtifactError,
        CalibrationError,
        DataError,
        DescriptionError,
        MethodError,
        ModelError,
    )
    from tactomo_models.methods.method import Estimate, Method, Skin, UnsolvableError
    from tactomo_models.methods.registry import METHODS, available_methods
    from tactomo_models.physics.artifact import (
        Artifact,
        build_artifact,
        default_path,
        load_artifact,
        load_or_build_artifact,
        save_artifact,
    )
    from tactomo_models.reconstruct import Reconstructor
    from tactomo_models.scans.measurement import Measurement
    from tactomo_models.scans.plausibility import Flag
    from tactomo_models.scans.reference import Reference
    from tactomo_models.scene.contacts import Contact
    from tactomo_models.scene.press import Press
    from tactomo_models.scene.pressure import PressureCurve, PressureRange
    from tactomo_models.scene.reconstruction import Reconstruction
    from tactomo_models.sensor.description import SensorDescription
    from tactomo_models.sensor.description_file import load_description, shipped_descriptions
    from tactomo_models.simulation.simulator import SkinSimulator

_NAMES = {
    "tactomo_protocol": "Channel",
    "tactomo_models.drift.baseline": "BaselineTracker",
    "tactomo_models.errors": (
        "ArtifactError CalibrationError DataError DescriptionError MethodError ModelError"
    ),
    "tactomo_models.methods.method": "Estimate Method Skin UnsolvableError",
    "tactomo_models.methods.registry": "METHODS available_methods",
    "tactomo_models.physics.artifact": (
        "Artifact build_artifact default_path load_artifact load_or_build_artifact save_artifact"
    ),
    "tactomo_models.reconstruct": "Reconstructor",
    "tactomo_models.scans.measurement": "Measurement",
    "tactomo_models.scans.plausibility": "Flag",
    "tactomo_models.scans.reference": "Reference",
    "tactomo_models.scene.contacts": "Contact",
    "tactomo_models.scene.press": "Press",
    "tactomo_models.scene.pressure": "PressureCurve PressureRange",
    "tactomo_models.scene.reconstruction": "Reconstruction",
    "tactomo_models.sensor.description": "SensorDescription",
    "tactomo_models.sensor.description_file": "load_description shipped_descriptions",
    "tactomo_models.simulation.simulator": "SkinSimulator",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Import what is asked for: all of it, SciPy and the solvers, takes seconds."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


__all__ = [
    "METHODS",
    "Artifact",
    "ArtifactError",
    "BaselineTracker",
    "CalibrationError",
    "Channel",
    "Contact",
    "DataError",
    "DescriptionError",
    "Estimate",
    "Flag",
    "Measurement",
    "Method",
    "MethodError",
    "ModelError",
    "Press",
    "PressureCurve",
    "PressureRange",
    "Reconstruction",
    "Reconstructor",
    "Reference",
    "SensorDescription",
    "Skin",
    "SkinSimulator",
    "UnsolvableError",
    "available_methods",
    "build_artifact",
    "default_path",
    "load_artifact",
    "load_description",
    "load_or_build_artifact",
    "save_artifact",
    "shipped_descriptions",
]
