"""A tank's forward model, its readings made independent and of unit noise, and images of them.

Any node's conductivity may change, so that a solve is one of the whole mesh, unlike a skin's
(`tactomo_models.physics.forward`). A reading is linear in the transfer resistances Z between the
electrodes, whatever currents are driven and whichever electrodes are lost:

    v = m^T Z c        c the currents into the electrodes, m the weights of their potentials

Readings are therefore reduced to as many numbers as are independent, weighted by their noise, and
what no object does is projected out: the water's conductivity and the electrodes' contacts change
between the empty tank and the full one.

The linear images are posterior means of a smooth change of conductivity, from hardly any freedom to
more than the noise bears. What they smear a network has learned to undo, from simulated tanks alone
(docs/measured.md). Its images are in each pixel the probabilities of nothing, of an object that
conducts worse, and of one that conducts better.

Sources: Kolehmainen, Vauhkonen, Karjalainen & Kaipio, "Assessment of errors in static electrical
impedance tomography with adjacent and trigonometric current patterns", Physiol. Meas. 18 (1997),
for what unmodelled contacts do. Denker, Kereta, Singh, Freudenberg, Kluth, Maass & Arridge,
"Data-driven approaches for electrical impedance tomography image segmentation from partial boundary
data", Applied Mathematics for Modern Challenges 2 (2024): a network after five linear
reconstructions won the challenge.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
import onnxruntime as ort
import scipy.linalg
import scipy.sparse as sp
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.distance import cdist
from tactomo_models.arrays import BoolArray, FloatArray
from tactomo_models.physics.bare_sheet import assemble_sheet, electrode_fields
from tactomo_models.physics.mesh import hat_gradients, mesh_sheet
from tactomo_models.sensor.description import SensorDescription

# Noise of a reading's change: of the root mean square of all reference readings, and of its own.
# In four measured tanks of the Kuopio challenge truth leaves 0.3 to 0.6 % and 0.5 to 1 %; half or
# twice as much moves the score on simulated ones by less than 0.005.
NOISE_OF_ALL, NOISE_OF_OWN = 0.006, 0.007
WATER = 0.08  # deviation of the water's conductivity; those tanks: up to 8 %
CONTACT = 0.022  # of an electrode's contact resistance, relative to the sheet's; up to 0.01
BLOCK = 512  # triangles whose derivatives are made at once: all at once take 60 MB
INDEPENDENT = 1e-9  # of the largest eigenvalue, below which readings repeat each other


class TankModel:
    """The complete electrode model of a tank, and its derivative by each triangle's conductivity.

    Args:
        description: the tank; its conductivity is 1 here.
        rings: of nodes between centre and rim.

    Attributes:
        empty: (P,) transfer resistances of the empty tank.
    """

    def __init__(self, description: SensorDescription, rings: int = 22) -> None:
        sheet = mesh_sheet(description, description.width_m / 2 / rings, refinements=1)
        mesh = sheet.mesh
        self.description = description
        self.points = mesh.p.T / (description.width_m / 2)  # (N, 2) nodes, over the tank's radius
        self.triangles = mesh.t.T  # (T, 3) nodes of each triangle
        # (2, P) electrodes i <= j, whose transfer resistances are all there are
        self.pairs = np.array(np.triu_indices(description.electrode_count))
        slopes, self._area = hat_gradients(mesh.p[:, mesh.t])
        count, nodes = len(self.triangles), len(self.points)
        at = np.repeat(np.arange(count), 3), self.triangles.ravel()
        shape = count, nodes
        self._slope = [sp.csr_matrix((slope.T.ravel(), at), shape) for slope in slopes]
        # (T, N) mean of the corners
        self.nodes = sp.csr_matrix((np.full(3 * count, 1 / 3), at), shape)
        self._system = assemble_sheet(description, sheet, np.ones(count))
        self.empty, self._fields = self.solve(np.ones(count))

    def solve(self, conductivity: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Transfer resistances (P,) and nodes' potentials (N, L) for conductivities (T,)."""
        added = sp.diags(self._area * (conductivity - 1))
        law = sum(slope.T @ added @ slope for slope in self._slope)
        law.resize(self._system.shape)
        fields = electrode_fields(self.description, (self._system + law).tocsc())
        nodes, electrodes = len(self.points), self.description.electrode_count
        padded = np.zeros((nodes + electrodes, electrodes))  # the last electrode's potential is 0
        padded[:-1, :-1] = fields
        return padded[nodes:][tuple(self.pairs)], padded[:nodes]

    def readings_of_empty(self, currents: FloatArray, weights: FloatArray) -> FloatArray:
        """Readings (n,) of the empty tank by currents and weights (n, L), see `Readings`."""
        transfer = np.zeros((currents.shape[1],) * 2)
        transfer[tuple(self.pairs)] = transfer[tuple(self.pairs[::-1])] = self.empty
        return np.asarray(((currents @ transfer) * weights).sum(axis=1))

    def derivative(
        self,
        by_pair: FloatArray,  # (r, P) how numbers follow from the transfer resistances
        fields: FloatArray | None = None,  # (N, L) of the tank that is differentiated
    ) -> FloatArray:
        """Derivative (r, T) by the triangles' conductivities; of the empty tank if no fields."""
        fields = self._fields if fields is None else fields
        one, other = self.pairs
        gradients = [np.ascontiguousarray((slope @ fields).T) for slope in self._slope]
        derivative = np.empty((len(by_pair), len(self.triangles)))
        for begin in range(0, derivative.shape[1], BLOCK):
            some = np.s_[begin : begin + BLOCK]
            products = sum(each[one, some] * each[other, some] for each in gradients)
            derivative[:, some] = -(by_pair @ products) * self._area[some]
        return derivative


class Readings:
    """Readings of one tank, as independent numbers of unit noise."""

    def __init__(
        self,
        model: TankModel,  # the tank
        currents: FloatArray,  # (n, L) into the electrodes at each reading; a row's sum is 0
        weights: FloatArray,  # (n, L) of the electrodes' potentials; a row's sum is 0
        reference: FloatArray,  # (n,) readings of the empty tank, in the model's unit
    ) -> None:
        one, other = model.pairs
        to_readings = currents[:, one] * weights[:, other] + currents[:, other] * weights[:, one]
        to_readings[:, one == other] /= 2
        noise = np.hypot(NOISE_OF_ALL * np.sqrt(np.mean(reference**2)), NOISE_OF_OWN * reference)
        weighted = to_readings / noise[:, None]
        size, axes = np.linalg.eigh(weighted.T @ weighted)
        kept = size > INDEPENDENT * size[-1]
        length, axes = np.sqrt(size[kept]), axes[:, kept]
        away = np.diag(CONTACT * (one == other))[:, one == other]
        away = length[:, None] * (axes.T @ np.column_stack([away, WATER * model.empty]))
        root = np.linalg.cholesky(np.eye(len(length)) + away @ away.T)
        # (r, P) the numbers by the transfer resistances
        self.by_pair = scipy.linalg.solve_triangular(root, length[:, None] * axes.T, lower=True)
        reduce = (weighted @ axes / length / noise[:, None]).T
        self._reduce = scipy.linalg.solve_triangular(root, reduce, lower=True)

    def reduced(self, changes: FloatArray) -> FloatArray:
        """Numbers (..., r) of readings' changes (..., n), full minus empty, in the model's unit."""
        return np.asarray(changes @ self._reduce.T)


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

    def __init__(self, model: TankModel, readings: Readings) -> None:
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
