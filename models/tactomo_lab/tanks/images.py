"""Linear images of a tank under five priors, and the network that makes objects of them.

The images are posterior means of a smooth change of conductivity, from hardly any freedom to more
than the noise bears. What they smear the network has learned to undo, from simulated tanks alone
(docs/measured.md). Its images are in each pixel the probabilities of nothing, of an
object that conducts worse, and of one that conducts better.

Source: Denker, Kereta, Singh, Freudenberg, Kluth, Maass & Arridge, "Data-driven approaches for
electrical impedance tomography image segmentation from partial boundary data", Applied Mathematics
for Modern Challenges 2 (2024): a network after five linear reconstructions won the challenge.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
import onnxruntime as ort
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.distance import cdist
from tactomo_models.arrays import BoolArray, FloatArray

from tactomo_lab.tanks.model import Readings, TankModel

PIXELS = 64
PRIORS = (3e-5, 3e-4, 3e-3, 3e-2, 3e-1)  # variances of the relative change
LENGTH = 0.17  # correlation length over the radius: the smallest objects' diameter
SPACING = 0.9  # of the Gaussians that make the prior, over their standard deviation
INPUTS = len(PRIORS) + 3


def pixel_grid(rows: int, columns: int | None = None) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Centres x, y (rows, columns) over the radius, row 0 at the top; which are in the tank.

    Of a square picture where no columns are given.
    """
    down, across = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (rows, columns or rows))
    x, y = np.meshgrid(across, -down)
    return x, y, np.hypot(x, y) < 1


def gaussian_grid(step: float, reach: float) -> FloatArray:
    """Centres (K, 2) of Gaussians on a square grid, those within so much of the middle."""
    grid = np.arange(-np.ceil(1 / step), np.ceil(1 / step) + 1) * step
    centres = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    return np.asarray(centres[np.hypot(*centres.T) < reach])


def signed_image(likely: FloatArray) -> RegularGridInterpolator:
    """Probability of better minus that of worse, to be asked at y, x over the radius."""
    axis = pixel_grid(likely.shape[-1])[0][0]
    return RegularGridInterpolator(
        (axis, axis), (likely[2] - likely[1])[::-1], bounds_error=False, fill_value=None
    )


class LinearImages:
    """What the network is shown of one way to read a tank."""

    def __init__(
        self,
        model: TankModel,  # the tank
        readings: Readings,  # that there are
    ) -> None:
        x, y, self.inside = pixel_grid(PIXELS)
        width = LENGTH / np.sqrt(2)  # whose square's autocorrelation has that length
        step = SPACING * width
        centres = gaussian_grid(step, 1 + step)
        share = step / width / np.sqrt(np.pi)  # for a variance of 1

        def gaussians(points: FloatArray) -> FloatArray:
            squares = cdist(points, centres, "sqeuclidean")
            return np.asarray(share * np.exp(squares / (-2 * width**2)))

        jacobian = model.derivative(readings.by_pair) @ model.nodes @ gaussians(model.points)
        size, axes = np.linalg.eigh(jacobian @ jacobian.T)
        seen = gaussians(np.stack([x, y], axis=-1)[self.inside])
        back = seen @ jacobian.T @ axes
        shrinks = [prior / (prior * size + 1) for prior in PRIORS]
        self._images = np.concatenate(
            [((back * shrink) @ axes.T).astype(np.float32) for shrink in shrinks]
        )
        known = (back**2 * shrinks[2]).sum(axis=1) / (seen**2).sum(axis=1)
        self._unknown = 1 - known  # share of the middle prior's variance that is left

    def inputs(self, reduced: FloatArray) -> FloatArray:
        """What the network takes (n, INPUTS, PIXELS, PIXELS) of readings (n, r)."""
        made = np.zeros((len(reduced), INPUTS, PIXELS, PIXELS), np.float32)
        images = (reduced.astype(np.float32) @ self._images.T).reshape(len(made), len(PRIORS), -1)
        made[:, : len(PRIORS), self.inside] = np.arcsinh(images)
        made[:, -3, self.inside] = self._unknown
        made[:, -2] = self.inside
        rms = np.sqrt(np.mean(reduced**2, axis=1)) + 1e-3
        made[:, -1] = np.log10(rms)[:, None, None]
        return np.asarray(made)


def probabilities(inputs: FloatArray) -> FloatArray:
    """Of nothing, worse, better: (n, 3, PIXELS, PIXELS)."""
    logits = _network().run(None, {"inputs": inputs})[0]
    likely = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(likely / likely.sum(axis=1, keepdims=True))


@cache
def _network() -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    stored = resources.files("tactomo_lab.tanks").joinpath("networks/tank.onnx").read_bytes()
    return ort.InferenceSession(stored, options, providers=["CPUExecutionProvider"])
