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
simulators       the skin in MuJoCo
===============  =================================================================================

Below the last two, `reconstruct` turns scans into frames, which `frames` makes of estimates, and
`batch` does so for a file.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # `as` tells type checkers that a name is for users
    from tactomo_protocol import Channel as Channel

    from tactomo_models.drift.baseline import BaselineTracker as BaselineTracker
    from tactomo_models.errors import ArtifactError as ArtifactError
    from tactomo_models.errors import CalibrationError as CalibrationError
    from tactomo_models.errors import DataError as DataError
    from tactomo_models.errors import DescriptionError as DescriptionError
    from tactomo_models.errors import MethodError as MethodError
    from tactomo_models.errors import ModelError as ModelError
    from tactomo_models.methods.method import Estimate as Estimate
    from tactomo_models.methods.method import Method as Method
    from tactomo_models.methods.method import Skin as Skin
    from tactomo_models.methods.method import UnsolvableError as UnsolvableError
    from tactomo_models.methods.registry import METHODS as METHODS
    from tactomo_models.methods.registry import available_methods as available_methods
    from tactomo_models.physics.artifact import Artifact as Artifact
    from tactomo_models.physics.artifact import build_artifact as build_artifact
    from tactomo_models.physics.artifact import default_path as default_path
    from tactomo_models.physics.artifact import load_artifact as load_artifact
    from tactomo_models.physics.artifact import load_or_build_artifact as load_or_build_artifact
    from tactomo_models.physics.artifact import save_artifact as save_artifact
    from tactomo_models.reconstruct import Reconstructor as Reconstructor
    from tactomo_models.scans.measurement import Measurement as Measurement
    from tactomo_models.scans.plausibility import Flag as Flag
    from tactomo_models.scans.reference import Reference as Reference
    from tactomo_models.scene.contacts import Contact as Contact
    from tactomo_models.scene.press import Press as Press
    from tactomo_models.scene.pressure import PressureCurve as PressureCurve
    from tactomo_models.scene.pressure import PressureRange as PressureRange
    from tactomo_models.scene.reconstruction import Reconstruction as Reconstruction
    from tactomo_models.sensor.description import SensorDescription as SensorDescription
    from tactomo_models.sensor.description_file import load_description as load_description
    from tactomo_models.sensor.description_file import shipped_descriptions as shipped_descriptions
    from tactomo_models.simulation.simulator import SkinSimulator as SkinSimulator

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
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import what is asked for: all of it, SciPy and the solvers, takes seconds."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value
