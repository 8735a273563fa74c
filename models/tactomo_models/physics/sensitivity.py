"""Where a sensor sees well: what a small press does to its voltages, against their noise.

To first order, of the bare sheet, with the noise of a usual converter: enough to compare places on
a sheet, and drawings of sheets, before one is made. What saturates a channel is seen far better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from tactomo_models.arrays import FloatArray
from tactomo_models.physics.artifact import TARGET_SHARE, Artifact, nominal_noise
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.sensor.description import SensorDescription

CHANGE = 0.1  # of conductivity, a ratio: of a press that is felt, but only just measured


@dataclass(frozen=True)
class Visibility:
    """How well a press is seen, by where it is; NaN where none fits on what can be pressed."""

    diameter_m: float  # of the press
    # (nodes_y, nodes_x) how large its signal is, in standard deviations of the noise
    signal: FloatArray
    # (nodes_y, nodes_x) standard uncertainty of its centre, its strength unknown
    place_m: FloatArray


def find_visibility(description: SensorDescription, artifact: Artifact) -> Visibility:
    """Return how well a round press is seen at every map node.

    It changes the conductivity by a tenth; its radius is a tenth of the sheet's shorter side.
    """
    radius_m = TARGET_SHARE * min(description.width_m, description.height_m)
    forward = ForwardModel(description, artifact.bare)
    signals = _signals(description, artifact, forward, radius_m)
    x, y = np.meshgrid(description.map_x_m, description.map_y_m)
    margin_m = description.sheet.frame_width_m + radius_m
    fits = description.on_sheet(x, y, margin_m)
    images = signals.reshape(-1, *x.shape)
    along_x = np.asarray(np.gradient(images, description.map_x_m, axis=2)).reshape(signals.shape)
    along_y = np.asarray(np.gradient(images, description.map_y_m, axis=1)).reshape(signals.shape)
    slopes = np.stack([signals / CHANGE, along_x, along_y])
    information = np.einsum("imp,jmp->pij", slopes, slopes)
    covariance = np.linalg.pinv(information, hermitian=True)
    place_m = np.sqrt(covariance[:, 1, 1] + covariance[:, 2, 2]).reshape(x.shape)
    strength = np.linalg.norm(signals, axis=0).reshape(x.shape)
    return Visibility(
        2 * radius_m, np.where(fits, strength, np.nan), np.where(fits, place_m, np.nan)
    )


def _signals(
    description: SensorDescription, artifact: Artifact, forward: ForwardModel, radius_m: float
) -> FloatArray:
    """Changes of the voltages by a press at each map node, (M, nodes), in units of their noise."""
    bare = artifact.bare
    x, y = np.meshgrid(description.map_x_m, description.map_y_m)
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    mesh_m = description.spacing_m
    reach_m = radius_m + mesh_m  # a press between two nodes is a share of both
    near = cKDTree(places).sparse_distance_matrix(
        cKDTree(bare.points[:, bare.pressable].T), reach_m, output_type="coo_matrix"
    )
    near.data = np.clip((reach_m - near.data) / mesh_m, 0, 1)
    cover = near.tocsr()
    area = np.maximum(cover @ forward.node_areas_m2, 1e-12)
    cover = cover.multiply((np.pi * radius_m**2 / area)[:, None]).tocsr()
    whitened = artifact.jacobian / nominal_noise(forward.bare_voltages)[:, None]
    return np.asarray(CHANGE * (cover @ whitened.T).T)
