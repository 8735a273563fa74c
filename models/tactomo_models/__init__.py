"""The sensor's physics and the reconstruction methods: from scans to pressure maps and contacts.

    description = load_description("paper_square")
    reconstructor = Reconstructor(description)
    reconstructor.set_reference(Reference.from_scans(magnitude_scans, structure_scans))
    frame = reconstructor.reconstruct(magnitude, structure)

Nothing here opens a port or a socket; what the daemon does live and what a researcher does
offline run this same code. Its modules, in the order in which each builds on those before:

===============  =================================================================================
a skin           pattern, sheet, response, section, description, description_file, symmetry
its physics      mesh, condensation, greens, bare_sheet, forward, artifact, visibility
a scan           plausibility, signs, reference, changes
linear images    tikhonov
networks         prefilter, network
shapes           shape_fit, outlines, levelset, search, following, objects, paper_level_set
contacts         areas, magnitudes, pressure, contacts, drawing, redrawing
a frame          tier, reconstruct, batch, machine_speed
drift            drift, press_memory, channel_baseline, baseline
health           lead_order, examination, findings, diagnosis
pressure         calibration, odd_readings, calibration_file, load_cell
simulated skins  scene, simulator, skin_drift
apart            evaluation, training: what is measured and learnt on scenes whose truth is known
for all          errors, archive, toml_file
===============  =================================================================================
"""

from tactomo_models.artifact import (
    Artifact,
    build_artifact,
    default_path,
    load_artifact,
    load_or_build_artifact,
    save_artifact,
)
from tactomo_models.baseline import BaselineTracker
from tactomo_models.contacts import Contact
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.description_file import load_description, shipped_descriptions
from tactomo_models.errors import (
    ArtifactError,
    CalibrationError,
    DataError,
    DescriptionError,
    ModelError,
)
from tactomo_models.plausibility import Flag
from tactomo_models.pressure import PressureCurve, PressureRange
from tactomo_models.reconstruct import Reconstruction, Reconstructor
from tactomo_models.reference import Reference
from tactomo_models.scene import Press
from tactomo_models.simulator import SkinSimulator
from tactomo_models.tier import METHODS, Tier

__all__ = [
    "METHODS",
    "Artifact",
    "ArtifactError",
    "BaselineTracker",
    "CalibrationError",
    "Contact",
    "DataError",
    "DescriptionError",
    "Flag",
    "Modality",
    "ModelError",
    "Press",
    "PressureCurve",
    "PressureRange",
    "Reconstruction",
    "Reconstructor",
    "Reference",
    "SensorDescription",
    "SkinSimulator",
    "Tier",
    "build_artifact",
    "default_path",
    "load_artifact",
    "load_description",
    "load_or_build_artifact",
    "save_artifact",
    "shipped_descriptions",
]
