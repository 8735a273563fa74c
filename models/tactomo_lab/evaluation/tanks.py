"""Round tanks with objects in them, and how alike images and truth are.

Measured sets often hold no more than each voltage's change, on some common scale, and the truth
as a picture. The reference is then the model's own empty tank, and the scale is an unknown of
the whole set. What the readings leave open of it stays open: the method `network`, that of
`tactomo_lab.tanks`, is averaged over all likely scales, and half of it is the level set that starts
there, with a scale of its own. Other methods are the daemon's.

An image's likeness is its Pearson correlation with the truth over the pixels of the disc, of the
signed `structure` map: 1 in what conducts better than the saline, -1 in what conducts worse; a
linear method's map is in proportion to the conductivity's change.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from tactomo_models.arrays import FloatArray, Image
from tactomo_models.errors import DataError
from tactomo_models.physics.artifact import Artifact, load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.reference import Reference, noise_of_reciprocity
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription

from tactomo_lab.evaluation.measured_sets import check_pictures, read_set
from tactomo_lab.scenes.measures import correlation
from tactomo_lab.tanks.fit import TankFit
from tactomo_lab.tanks.model import Readings, TankModel, pixel_grid, probabilities, signed_image

BUDGET_S = 20.0  # a file has no deadline
EXACT = 10**6  # scans that a reference without noise is the mean of
# Likely scales, as shares of the one at which some voltage would have fallen to nothing: in sets of
# 11 simulated tanks 0.71 to 0.92 (5 and 95 %), and less where metal keeps away from electrodes.
SHARES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
MIDDLE_SHARE = 0.7  # for methods that need one
KNOWN_SIGMA = 0.05  # deviation of a known scale's logarithm: as of the challenge's water


@dataclass(frozen=True)
class Tanks:
    """Scans of tanks with objects, and what stood in them."""

    names: tuple[str, ...]  # of the n tanks
    changes: FloatArray  # (n, M) by how much each voltage's size grew, on one common scale
    # (n, rows, columns) 1 in what conducts better, -1 worse; row 0 is the top, and the disc fills
    # the picture
    truth: FloatArray


@dataclass(frozen=True)
class TankOutcome:
    """What one method made of one tank.

    `image` (rows, columns) is on the truth's pixels. `misfit` is of the daemon's methods,
    `confidence`, the correlation with the truth that is to be expected, of the network; what a
    method does not have is not a number.
    """

    name: str
    method: str
    correlation: float
    misfit: float
    confidence: float
    seconds: float
    image: FloatArray


def read_tanks(path: Path, description: SensorDescription) -> Tanks:
    """Read `dv` (n, M), `truth` (n, rows, columns) and, if it is there, `name` (n,).

    Raises DataError where the file cannot be read or holds something else.
    """
    arrays = read_set(path, "tanks", "dv", "truth")
    changes, truth = arrays["dv"], arrays["truth"]
    check_pictures(path, truth)
    names = np.atleast_1d(arrays.get("name", np.arange(len(truth))))
    wanted = (len(names), description.measurements)
    if changes.shape != wanted or len(truth) != len(names):
        raise DataError(
            f"{path}: dv is {changes.shape}, truth is {truth.shape}; {wanted} and "
            f"({len(names)}, rows, columns) are needed"
        )
    if not np.isfinite(changes).all():
        raise DataError(f"{path}: dv holds voltages that are not numbers; leave those tanks out")
    if not (changes < 0).any():
        raise DataError(
            f"{path}: dv never falls, and how far it falls is its scale; give V - V_empty"
        )
    return Tanks(tuple(str(name) for name in names), changes, truth)


class TankImager:
    """Reconstructs voltage changes against the model's own empty tank."""

    def __init__(self, description: SensorDescription, artifact: Artifact | None = None) -> None:
        self.description = description
        self._artifact = artifact or load_or_build_artifact(description)
        self._empty = ForwardModel(description, self._artifact.bare).bare_voltages
        self._reconstructors: dict[str, Reconstructor] = {}

    def largest_scale(self, changes: FloatArray) -> float:
        """Scale at which some voltage would have fallen to nothing."""
        return float(1 / np.max(-changes / np.abs(self._empty)))

    @cached_property
    def _fit(self) -> tuple[Readings, TankFit]:
        model, pairs = TankModel(self.description), self.description.pairs
        unit = np.eye(self.description.electrode_count)
        drive, measure = (unit[p[:, 0]] - unit[p[:, 1]] for p in (pairs.drive, pairs.measure))
        readings = Readings(model, drive, measure, model.readings_of_empty(drive, measure))
        return readings, TankFit(model, readings)

    def probabilities(self, change: FloatArray, scales: Sequence[float]) -> FloatArray:
        """Probabilities of nothing, worse and better, half the network's and half the fit's.

        The network's are averaged over scales, the fit has its own: where the two disagree,
        neither is sure.

        Args:
            change: (M,) by how much each voltage's size grew.
            scales: each as likely, in units of the model's voltages.

        Returns:
            (3, PIXELS, PIXELS).
        """
        readings, fit = self._fit
        signed = np.sign(self._empty) * change
        inputs = fit.images.inputs(readings.reduced(np.outer(scales, signed)))
        network = np.mean([probabilities(each[None])[0] for each in inputs], axis=0)
        sigma = max(float(np.std(np.log(scales))), KNOWN_SIGMA)
        found = fit.find(float(np.median(scales)) * signed, sigma)
        return np.asarray(network + fit.likely(found)) / 2

    def reconstruct(self, change: FloatArray, method: str) -> Reconstruction:
        """Reconstruct one tank.

        Args:
            change: (M,) by how much each voltage's size grew, in units of the model's voltages.
            method: of reconstruction.
        """
        if method not in self._reconstructors:
            self._reconstructors[method] = Reconstructor(
                self.description, self._artifact, method=method, budget_s=BUDGET_S
            )
        reconstructor = self._reconstructors[method]
        scan = self._empty + np.sign(self._empty) * change
        noise = noise_of_reciprocity(self.description, scan - self._empty)
        reconstructor.set_reference(
            Reference(None, self._empty, structure_noise=noise, scans=EXACT)
        )
        return reconstructor.reconstruct(None, scan)


def evaluate_tanks(
    imager: TankImager,  # of these tanks
    tanks: Tanks,  # measured or simulated
    methods: Iterable[str],  # `network`, or any of the daemon's
    # of the changes, in units of the model's voltages; not known if None
    scale: float | None = None,
) -> Iterator[TankOutcome]:
    """Reconstruct every tank by every method and compare with the truth."""
    largest = imager.largest_scale(tanks.changes)
    scales = [share * largest for share in SHARES] if scale is None else [scale]
    for name, change, truth in zip(tanks.names, tanks.changes, tanks.truth, strict=True):
        for method in methods:
            begin = time.perf_counter()
            if method == "network":
                likely = imager.probabilities(change, scales)
                misfit, sure = np.nan, expected_correlation(likely)
                image = _network_image(likely, truth.shape)
            else:
                made = imager.reconstruct((scale or MIDDLE_SHARE * largest) * change, method)
                assert made.structure is not None
                misfit, sure = made.misfit, np.nan
                image = on_pixels(imager.description, made.structure, truth.shape)
            seconds = time.perf_counter() - begin
            right = correlation(image, truth)
            yield TankOutcome(name, method, right, misfit, sure, seconds, image)


def expected_correlation(likely: FloatArray) -> float:
    """Of the expected image with the truth, where probabilities (3, rows, columns) hold.

    The expected image is probably better minus worse; the truth is 1, -1 or 0.
    """
    inside = likely[:, pixel_grid(likely.shape[-1])[2]]
    _, worse, better = inside
    return float(np.std(better - worse) / np.sqrt(np.mean(better + worse)))


def _network_image(likely: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Probability of better minus that of worse on a picture's pixels; NaN off the disc."""
    x, y, inside = pixel_grid(*shape)
    return np.where(inside, signed_image(likely)((y, x)), np.nan)


def on_pixels(description: SensorDescription, nodes: Image, shape: tuple[int, ...]) -> FloatArray:
    """A map (nodes_y, nodes_x) on the pixels of a picture; NaN off the disc."""
    radius_m = description.width_m / 2
    x, y, inside = pixel_grid(*shape)
    grid = (description.map_y_m, description.map_x_m)
    image = RegularGridInterpolator(grid, nodes)((radius_m * y, radius_m * x))
    return np.where(inside, image, np.nan)
