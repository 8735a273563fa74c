"""Outlines: shapes of few parameters, one closed curve for each contact.

Of order 0 and 1 it is a circle (3 parameters), of order 2 an ellipse (5), of order 4 an ellipse
whose radius is modulated around its edge, which makes it an egg or a rounded rectangle (9). One
round contact does not need 81 kernels; what no order explains is left to the level set.

    u = B (x - x0),  B = exp(-s) expm(-E),  E = [[e1, e2], [e2, -e1]]     the unit circle of u
    log q = log |u| - sum_k (a_k cos k psi + b_k sin k psi),  psi = angle of u,  k = 3, 4
    phi = -log q |u|^2 / |B u|          distance inside the outline, to first order of it;
                                        held at its maximum where q < 1 / e
    h = H((phi + offset) / w)           H of compact support, 2 w wide
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.shape_fit import heaviside, heaviside_slope

UNIT_M = 0.01  # positions are counted in this, so that all parameters are of order 1
X, Y, SIZE, E1, E2, HARMONIC = 0, 1, 2, 3, 4, 5  # columns of a contact's parameters
PARAMETERS = {0: 3, 1: 3, 2: 5, 4: 9}  # of one contact, by order
MAX_PARAMETERS = PARAMETERS[4]
WAVES = np.array([3, 4])
TYPICAL_SIZE = float(np.log(0.012))  # s is the logarithm of the mean radius in metres
SIZE_LIMITS = (float(np.log(0.003)), float(np.log(0.06)))
LARGEST_CIRCLE = float(np.log(0.025))
MAX_BULGE = 0.25
PRIOR_SIGMA = np.array([5.0, 5.0, 0.6, 0.3, 0.3, 0.05, 0.05, 0.07, 0.07])
NOWHERE = 1e-6  # distance from a contact's centre, over its size, that has no direction


@dataclass(frozen=True)
class Outlines:
    """Contacts of one order on a sheet: a family of shapes.

    Attributes:
        x_m: (P,) nodes.
        y_m: (P,) nodes.
        half_width_m: half the width over which h falls from 1 to 0.
        offset_m: how far outwards of its parameters an outline is drawn on the nodes.
        order: 0, 1, 2 or 4.
        count: K contacts, each with `PARAMETERS[order]` parameters.
    """

    x_m: FloatArray = field(repr=False)
    y_m: FloatArray = field(repr=False)
    half_width_m: float
    offset_m: float
    order: int = 0
    count: int = 0

    def of(self, order: int, count: int) -> Outlines:
        """Outlines of another order and number on the same sheet."""
        return replace(self, order=order, count=count)

    def split(self, parameters: FloatArray) -> FloatArray:
        """(K, 9) parameters of each contact; those beyond the order are 0."""
        each = np.zeros((self.count, MAX_PARAMETERS))
        used = PARAMETERS[self.order]
        each[:, :used] = parameters.reshape(self.count, used)
        return each

    def join(self, each: FloatArray) -> FloatArray:
        """Parameters of all contacts in one vector, from `split`'s form."""
        return np.ascontiguousarray(each[:, : PARAMETERS[self.order]]).ravel()

    @property
    def prior_mean(self) -> FloatArray:
        """Contacts are circles of a fingertip's size, anywhere."""
        mean = np.zeros((self.count, MAX_PARAMETERS))
        mean[:, SIZE] = TYPICAL_SIZE
        return self.join(mean)

    @property
    def prior_precision(self) -> FloatArray:
        """Inverse variances of that."""
        return self.join(np.tile(PRIOR_SIGMA**-2.0, (self.count, 1)))

    @property
    def ratio_freedom(self) -> float:
        """Order 0 keeps to the likely ratio: else the first of several grows over them all."""
        firm_ratio = 0.02  # share of the log ratio's uncertainty that circles of order 0 have
        return firm_ratio if self.order == 0 else 1.0

    def bounded(self, parameters: FloatArray) -> FloatArray:
        """Keep centres on the sheet, and sizes and forms to those of contacts."""
        max_elongated = 0.9  # half the logarithm of the ratio of an ellipse's axes
        each = self.split(parameters)
        for column, nodes in ((X, self.x_m), (Y, self.y_m)):
            each[:, column] = np.clip(each[:, column], nodes.min() / UNIT_M, nodes.max() / UNIT_M)
        largest = LARGEST_CIRCLE if self.order < 2 else SIZE_LIMITS[1]
        each[:, SIZE] = np.clip(each[:, SIZE], SIZE_LIMITS[0], largest)
        elongation = np.maximum(np.hypot(each[:, E1], each[:, E2]), 1e-12)
        each[:, E1:HARMONIC] *= np.minimum(1, max_elongated / elongation)[:, None]
        each[:, HARMONIC:] = np.clip(each[:, HARMONIC:], -MAX_BULGE, MAX_BULGE)
        return self.join(each)

    def render(self, parameters: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(P,) h of all contacts together, and where it is not 0."""
        each = self.split(parameters)
        near = self._near(each)
        drawn = _Drawing(self, each, near)
        pressed, moving = np.zeros(len(self.x_m)), np.zeros(len(self.x_m), bool)
        pressed[near] = 1 - np.prod(1 - heaviside(drawn.t), axis=0)
        moving[near] = (drawn.t > -1).any(axis=0)
        return pressed, moving

    def _near(self, each: FloatArray) -> IntArray:
        """Nodes that any contact can reach: what is farther away need not be drawn."""
        longest = np.exp(
            each[:, SIZE]
            + np.hypot(each[:, E1], each[:, E2])
            + np.abs(each[:, HARMONIC:]).sum(axis=1)
        )
        reach = longest + 2 * (self.half_width_m + self.offset_m)
        apart = np.hypot(self.x_m - UNIT_M * each[:, X, None], self.y_m - UNIT_M * each[:, Y, None])
        return np.flatnonzero((apart < reach[:, None]).any(axis=0))

    def coverage(self, parameters: FloatArray) -> FloatArray:
        """(P,) share pressed, by the outlines themselves and not as the mesh needs them drawn."""
        return replace(self, offset_m=0.0).render(parameters)[0]

    def inner_coverage(self, parameters: FloatArray) -> FloatArray:
        """(P,) share within outlines of half the size: where a ring has its hole."""
        each = self.split(parameters)
        each[:, SIZE] -= np.log(2)
        return self.coverage(self.join(each))

    def slope(self, parameters: FloatArray, nodes: IntArray) -> FloatArray:
        """Derivative (n, parameters) of h at n nodes."""
        drawn = _Drawing(self, self.split(parameters), nodes)
        gap = 1 - heaviside(drawn.t)
        # h = 1 - prod_k (1 - h_k): each contact's slope counts where no other one presses.
        others = [np.prod(np.delete(gap, k, axis=0), axis=0) for k in range(self.count)]
        by_t = np.reshape(others, gap.shape) * heaviside_slope(drawn.t)
        by_parameter = by_t[:, None] * drawn.slope()
        return np.asarray(by_parameter.reshape(-1, len(nodes)).T)


class _Drawing:
    """K outlines on n nodes: t = (phi + offset) / w and what its derivatives need."""

    def __init__(self, outlines: Outlines, each: FloatArray, nodes: slice | IntArray) -> None:
        self.outlines = outlines
        dx = outlines.x_m[nodes] - UNIT_M * each[:, X, None]
        dy = outlines.y_m[nodes] - UNIT_M * each[:, Y, None]
        self.r = np.stack([dx, dy], axis=1)  # (K, 2, n)
        self.B, self.dB = _axes(each)
        self.u = self.B @ self.r
        self.u[:, 0] += NOWHERE * (np.abs(self.u).max(axis=1) < NOWHERE)  # any direction will do
        self.v = self.B @ self.u
        self.square = (self.u**2).sum(axis=1)
        self.length = np.sqrt((self.v**2).sum(axis=1))
        self.scale = self.square / self.length
        self.log_q = 0.5 * np.log(self.square)
        self.turn: FloatArray | None = None
        if outlines.order == 4:
            psi = np.arctan2(self.u[:, 1], self.u[:, 0])[:, None]
            cos, sin = np.cos(WAVES[:, None] * psi), np.sin(WAVES[:, None] * psi)  # (K, 2, n)
            a, b = each[:, HARMONIC::2, None], each[:, HARMONIC + 1 :: 2, None]
            self.waves = np.stack([cos, sin], axis=2).reshape(len(each), 4, -1)
            self.turn = (WAVES[:, None] * (b * cos - a * sin)).sum(axis=1)
            self.log_q -= (a * cos + b * sin).sum(axis=1)
        # The first order holds near the outline, and would fall to 0 again at the centre.
        inner = np.exp(np.maximum(-1 - self.log_q, 0.0))
        self.depth = np.where(self.log_q > -1, -self.log_q, inner)
        self.depth_slope = -inner
        self.t = (outlines.offset_m + self.depth * self.scale) / outlines.half_width_m

    def slope(self) -> FloatArray:
        """Derivative (K, parameters, n) of t; each parameter moves u by du and B by dB."""
        B, u, v = self.B, self.u, self.v
        K, _, n = self.r.shape
        forms = min(PARAMETERS[self.outlines.order], HARMONIC)
        du = np.empty((K, forms, 2, n))
        du[:, X] = -UNIT_M * B[:, :, 0, None]
        du[:, Y] = -UNIT_M * B[:, :, 1, None]
        du[:, SIZE:] = self.dB[:, : forms - SIZE] @ self.r[:, None]
        dv = B[:, None] @ du
        dv[:, SIZE:] += self.dB[:, : forms - SIZE] @ u[:, None]
        radial = np.einsum("kip,knip->knp", u, du)
        along = np.einsum("kip,knip->knp", v, dv)
        by_log_q = radial
        if self.turn is not None:
            across = u[:, None, 0] * du[:, :, 1] - u[:, None, 1] * du[:, :, 0]
            by_log_q = radial - self.turn[:, None] * across
        by_log_q = by_log_q / self.square[:, None]
        by_scale = self.scale[:, None] * (
            2 * radial / self.square[:, None] - along / (self.length**2)[:, None]
        )
        by_depth = self.depth_slope * self.scale
        by_phi = by_log_q * by_depth[:, None] + self.depth[:, None] * by_scale
        if self.turn is not None:
            by_phi = np.concatenate([by_phi, -self.waves * by_depth[:, None]], axis=1)
        return np.asarray(by_phi / self.outlines.half_width_m)


def _axes(each: FloatArray) -> tuple[FloatArray, FloatArray]:
    """B (K, 2, 2), and its derivatives (K, 3, 2, 2) by size, e1 and e2."""
    e1, e2, size = (each[:, k, None, None] for k in (E1, E2, SIZE))
    e = np.maximum(np.hypot(e1, e2), 1e-6)
    ratio = np.sinh(e) / e
    bend = np.where(e < 1e-3, 1 / 3, (np.cosh(e) - ratio) / e**2)  # (d ratio / d e) / e
    unit = np.eye(2)
    first, second = np.array([[1.0, 0.0], [0.0, -1.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])
    shrink = np.exp(-size)
    E = e1 * first + e2 * second
    B = shrink * (np.cosh(e) * unit - ratio * E)

    def by(ei: FloatArray, direction: FloatArray) -> FloatArray:
        return np.asarray(shrink * (ei * (ratio * unit - bend * E) - ratio * direction))

    return B, np.stack([-B, by(e1, first), by(e2, second)], axis=1)


def outlines_on(forward: ForwardModel) -> Outlines:
    """Outlines on the nodes of a forward model.

    A mesh of linear triangles shows the voltages a little less than what is drawn on it, so an
    outline is drawn a tenth of the nodes' distance outwards. With that, radii of 6, 12 and 18 mm
    come out 0.2, 0.0 and -0.1 mm wrong on an even sheet, for contrasts of 10 to 100 and 0.1 to
    0.03 alike.
    """
    offset = 0.1  # see `outlines_on`
    x, y = forward.bare.points[:, forward.bare.pressable]
    description = forward.description
    spacing = description.width_m / (description.map.nodes_x - 1)
    return Outlines(x, y, spacing, offset * spacing)


def ellipses_of(images: FloatArray, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
    """Parameters (K, MAX_PARAMETERS) of ellipses of the same centre, area and second moments.

    Args:
        images: (K, rows, columns) share pressed by each contact, nowhere all 0.
        x_m: (rows, columns) places, evenly spaced.
        y_m: (rows, columns) places.
    """
    cell_m2 = float((x_m[0, 1] - x_m[0, 0]) * (y_m[1, 0] - y_m[0, 0]))
    each = np.zeros((len(images), MAX_PARAMETERS))
    for contact, image in zip(each, images, strict=True):
        share = image / image.sum()
        x, y = float((share * x_m).sum()), float((share * y_m).sum())
        dx, dy = x_m - x, y_m - y
        # A cell is no point: it has moments of its own.
        xx, yy = ((share * d**2).sum() + cell_m2 / 12 for d in (dx, dy))
        xy = (share * dx * dy).sum()
        apart = np.hypot(xx - yy, 2 * xy) / 2
        long, short = (xx + yy) / 2 + apart, max((xx + yy) / 2 - apart, cell_m2 / 12)
        elongation, angle = np.log(long / short) / 4, np.arctan2(2 * xy, xx - yy)
        contact[[X, Y, SIZE]] = (x / UNIT_M, y / UNIT_M, np.log(image.sum() * cell_m2 / np.pi) / 2)
        contact[[E1, E2]] = elongation * np.cos(angle), elongation * np.sin(angle)
    return each
