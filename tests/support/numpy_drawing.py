"""A pressure field drawn on points in NumPy: what `inner_loop.c` is held to."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from tactomo_models.arrays import FloatArray
from tactomo_models.scene.drawing import GRADED_WIDTH, Slopes, heaviside, heaviside_slope
from tactomo_models.scene.parameters import (
    COLUMNS,
    E1,
    E2,
    EDGE,
    HARMONIC,
    HOLE,
    PEAK,
    SIZE,
    UNIT_M,
    X,
    Y,
)
from tactomo_models.scene.pressure_field import PressureField

WAVES = np.array([3, 4])
NOWHERE = 1e-6  # distance from a contact's centre, over its size, that has no direction
MOST_BLURRED = 0.4  # 1 - k^2 at most: what is smaller than two nodes is drawn as well as they can
RIM = 0.1  # of the nodes' distance: how far inside its edge a falling pressure is averaged


class Contacts:
    """K contacts at n points: what is pressed, with what pressure, and the derivatives."""

    def __init__(
        self,
        of: PressureField,
        each: FloatArray,
        x_m: FloatArray,
        y_m: FloatArray,
        *,
        is_sharp: bool = False,
    ) -> None:
        self._of = of
        # What the blur takes from k^2, and how the logarithm of k goes by that of r and by gamma.
        moment = 2 * (each[:, EDGE] + 2)
        blur = moment * of.blur_m2 * np.exp(-2 * each[:, SIZE])
        held = np.tanh(blur / MOST_BLURRED)
        left = 1 - MOST_BLURRED * held
        self._by_size = (blur * (1 - held**2) / left)[:, None]
        self._by_edge = -self._by_size / moment[:, None]
        smaller = each.copy()
        smaller[:, SIZE] += np.log(left) / 2
        self._as_is = _Pressed(of, each, x_m, y_m, is_sharp)
        self._drawn = _Pressed(of, smaller, x_m, y_m, is_sharp)
        self.wide = self._as_is.outline.t + of.offset_m / of.half_width_m
        self._wide = self._as_is.whole if is_sharp else heaviside(self.wide)
        self.enclosed = 1 - np.prod(1 - self._wide, axis=0)
        self._within = self._wide * self._as_is.left
        self._all_within = np.maximum(self._within.sum(axis=0), 1e-12)
        self.enclosed_kpa = (self._within * self._as_is.pressures).sum(axis=0) / self._all_within
        self._once = 1 - np.prod(1 - self._drawn.shares, axis=0)
        self._strengths = np.ones_like(self._wide) / left[:, None]
        self._strength = self._drawn.mean(self._strengths)
        self.share = self._strength * self._once
        self.pressure_kpa = self._drawn.mean(self._drawn.pressures)

    def slopes(self) -> Slopes:
        """Derivatives (K, COLUMNS, n) of what a `Drawing` has."""
        forms = self._of.forms
        _, pressures = self._as_is.slopes()
        wide = np.zeros_like(pressures)
        wide[:, :forms] = heaviside_slope(self.wide)[:, None] * self._as_is.outline.slopes[0]
        within = wide * self._as_is.left[:, None]
        within += self._wide[:, None] * self._as_is.slopes_of_left()
        enclosed_kpa = within * (self._as_is.pressures - self.enclosed_kpa)[:, None]
        enclosed_kpa = (enclosed_kpa + self._within[:, None] * pressures) / self._all_within
        shares, pressures = self._drawn.slopes()
        for slopes in (shares, pressures):  # so far by the size that is drawn
            slopes[:, EDGE] += self._by_edge * slopes[:, SIZE]
            slopes[:, SIZE] += self._by_size * slopes[:, SIZE]
        strengths = np.zeros_like(shares)
        strengths[:, SIZE] = -2 * self._by_size * self._strengths
        strengths[:, EDGE] = -2 * self._by_edge * self._strengths
        strength = self._drawn.slopes_of_mean(shares, strengths, self._strengths)
        # What is pressed twice is pressed once.
        share = self._strength * _once(shares, self._drawn.shares) + self._once * strength
        pressure = self._drawn.slopes_of_mean(shares, pressures, self._drawn.pressures)
        return _once(wide, self._wide), enclosed_kpa, share, pressure


class _Pressed:
    """What each of K contacts, drawn as large as it is said to be, presses at n points."""

    def __init__(
        self, of: PressureField, each: FloatArray, x_m: FloatArray, y_m: FloatArray, is_sharp: bool
    ) -> None:
        self._of, self._each = of, each
        self.outline = _Outlines(of, each, x_m, y_m)
        step = _linear_step if is_sharp else heaviside
        self.whole = step(self.outline.t / GRADED_WIDTH)
        self._hole, self._inner = each[:, HOLE, None], None
        if self._hole.any():
            self._inner = self._inner_outlines()
            self.left = 1 - self._hole * step(self._inner.t)
        else:
            self.left = np.ones_like(self.whole)
        self.shares = self.whole * self.left
        # Pressure is averaged over the rim's width: a node is a cell.
        self._rim = RIM * of.half_width_m * np.exp(-each[:, SIZE, None])
        self._fall = 1 - np.exp(2 * np.minimum(self.outline.log_q, 1.0))
        self._root = np.sqrt(self._fall**2 + 4 * self._rim**2)
        self._depth = 0.5 * (self._fall + self._root)
        self._profile = self._depth ** each[:, EDGE, None]
        self.pressures = of.unit_kpa * each[:, PEAK, None] * self._profile
        self._sum = np.maximum(self.shares.sum(axis=0), 1e-12)

    def mean(self, values: FloatArray) -> FloatArray:
        """Mean (n,) of the contacts' values (K, n) by their shares."""
        return np.asarray((self.shares * values).sum(axis=0) / self._sum)

    def slopes_of_mean(
        self, shares: FloatArray, slopes: FloatArray, values: FloatArray
    ) -> FloatArray:
        """Derivatives of a mean, by those of the shares and of the values, (K, COLUMNS, n) all."""
        apart = (values - self.mean(values)) / self._sum
        return np.asarray(shares * apart[:, None] + slopes * (self.shares / self._sum)[:, None])

    def _inner_outlines(self) -> _Outlines:
        """Outlines of half the size: where a ring has its hole."""
        inner = self._each.copy()
        inner[:, SIZE] -= np.log(2)
        return _Outlines(self._of, inner, self.outline.x_m, self.outline.y_m)

    def slopes_of_left(self) -> FloatArray:
        """Derivatives (K, COLUMNS, n) of the share that holes leave."""
        left = np.zeros((len(self._each), COLUMNS, self.shares.shape[1]))
        if self._inner is not None or self._of.free[:, HOLE].any():
            inner = self._inner or self._inner_outlines()
            left[:, HOLE] = -heaviside(inner.t)
            if self._inner is not None:
                away = self._hole * heaviside_slope(inner.t)
                left[:, : self._of.forms] = -away[:, None] * inner.slopes[0]
        return left

    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives (K, COLUMNS, n) of each contact's share and pressure."""
        of, each, forms = self._of, self._each, self._of.forms
        by_t, by_log_q = self.outline.slopes
        shares, pressures = np.zeros((2, len(each), COLUMNS, self.shares.shape[1]))
        shares[:, :forms] = (
            heaviside_slope(self.outline.t / GRADED_WIDTH) / GRADED_WIDTH * self.left
        )[:, None] * by_t
        if self._inner is not None or of.free[:, HOLE].any():
            inner = self._inner or self._inner_outlines()
            shares[:, HOLE] = -self.whole * heaviside(inner.t)
            if self._inner is not None:
                away = self._hole * self.whole * heaviside_slope(inner.t)
                shares[:, :forms] -= away[:, None] * inner.slopes[0]
        peak, edge = of.unit_kpa * each[:, PEAK, None], each[:, EDGE, None]
        pressures[:, PEAK] = of.unit_kpa * self._profile
        pressures[:, EDGE] = self.pressures * np.log(self._depth)
        if edge.any():
            by_fall = 0.5 * (1 + self._fall / self._root)
            by_depth = peak * edge * self._profile / self._depth
            log_q = self.outline.log_q
            by_q = np.where(log_q < 1.0, by_depth * by_fall * -2 * (1 - self._fall), 0.0)
            pressures[:, :forms] = by_q[:, None] * by_log_q
            pressures[:, SIZE] -= by_depth * 2 * self._rim**2 / self._root
        return shares, pressures


def _once(slopes: FloatArray, shares: FloatArray) -> FloatArray:
    """Slopes (K, COLUMNS, n) of 1 - prod (1 - share), by those of each contact's share (K, n)."""
    if len(shares) == 1:
        return slopes
    others = [np.prod(1 - np.delete(shares, k, axis=0), axis=0) for k in range(len(shares))]
    return slopes * np.reshape(others, (len(shares), 1, shares.shape[1]))


class _Outlines:
    """K outlines at n points: t = phi / w, log q, and their derivatives."""

    def __init__(
        self, of: PressureField, each: FloatArray, x_m: FloatArray, y_m: FloatArray
    ) -> None:
        self._of, self._each, self.x_m, self.y_m = of, each, x_m, y_m
        dx = x_m - UNIT_M * each[:, X, None]
        dy = y_m - UNIT_M * each[:, Y, None]
        self._r = np.stack([dx, dy], axis=1)  # (K, 2, n)
        self._B = _axes(each)
        self._u = self._B @ self._r
        self._u[:, 0] += NOWHERE * (np.abs(self._u).max(axis=1) < NOWHERE)  # any direction will do
        self._v = self._B @ self._u
        self._square = (self._u**2).sum(axis=1)
        self._length = np.sqrt((self._v**2).sum(axis=1))
        self._scale = self._square / self._length
        self.log_q = 0.5 * np.log(self._square)
        self._turn: FloatArray | None = None
        if of.forms == PEAK:
            psi = np.arctan2(self._u[:, 1], self._u[:, 0])[:, None]
            cos, sin = np.cos(WAVES[:, None] * psi), np.sin(WAVES[:, None] * psi)  # (K, 2, n)
            a, b = each[:, HARMONIC:PEAK:2, None], each[:, HARMONIC + 1 : PEAK : 2, None]
            self._waves = np.stack([cos, sin], axis=2).reshape(len(each), 4, -1)
            self._turn = (WAVES[:, None] * (b * cos - a * sin)).sum(axis=1)
            self.log_q = self.log_q - (a * cos + b * sin).sum(axis=1)
        # The first order holds near the outline, and would fall to 0 again at the centre.
        inner = np.exp(np.maximum(-1 - self.log_q, 0.0))
        self._depth = np.where(self.log_q > -1, -self.log_q, inner)
        self._depth_slope = -inner
        self.t = self._depth * self._scale / of.half_width_m

    @cached_property
    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives (K, forms, n) of t and of log q; each parameter moves u by du and B by dB."""
        B, u, v = self._B, self._u, self._v
        dB = _slopes_of_axes(self._each)
        K, _, n = self._r.shape
        forms = min(self._of.forms, HARMONIC)
        du = np.empty((K, forms, 2, n))
        du[:, X] = -UNIT_M * B[:, :, 0, None]
        du[:, Y] = -UNIT_M * B[:, :, 1, None]
        du[:, SIZE:] = dB[:, : forms - SIZE] @ self._r[:, None]
        dv = B[:, None] @ du
        dv[:, SIZE:] += dB[:, : forms - SIZE] @ u[:, None]
        radial = np.einsum("kip,knip->knp", u, du)
        along = np.einsum("kip,knip->knp", v, dv)
        by_log_q = radial
        if self._turn is not None:
            across = u[:, None, 0] * du[:, :, 1] - u[:, None, 1] * du[:, :, 0]
            by_log_q = radial - self._turn[:, None] * across
        by_log_q = by_log_q / self._square[:, None]
        by_scale = self._scale[:, None] * (
            2 * radial / self._square[:, None] - along / (self._length**2)[:, None]
        )
        by_depth = self._depth_slope * self._scale
        by_phi = by_log_q * by_depth[:, None] + self._depth[:, None] * by_scale
        if self._turn is not None:
            by_phi = np.concatenate([by_phi, -self._waves * by_depth[:, None]], axis=1)
            by_log_q = np.concatenate([by_log_q, -self._waves], axis=1)
        return by_phi / self._of.half_width_m, by_log_q


FIRST, SECOND = np.array([[1.0, 0.0], [0.0, -1.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])  # of E


def _axes(each: FloatArray) -> FloatArray:
    """B (K, 2, 2)."""
    e1, e2, size = each[:, [E1, E2, SIZE]].T[:, :, None, None]
    e = np.maximum(np.hypot(e1, e2), 1e-6)
    E = e1 * FIRST + e2 * SECOND
    return np.asarray(np.exp(-size) * (np.cosh(e) * np.eye(2) - np.sinh(e) / e * E))


def _slopes_of_axes(each: FloatArray) -> FloatArray:
    """Derivatives (K, 3, 2, 2) of B by size, e1 and e2."""
    e1, e2, size = each[:, [E1, E2, SIZE]].T[:, :, None, None]
    e = np.maximum(np.hypot(e1, e2), 1e-6)
    ratio = np.sinh(e) / e
    bend = np.where(e < 1e-3, 1 / 3, (np.cosh(e) - ratio) / e**2)  # (d ratio / d e) / e
    common = ratio * np.eye(2) - bend * (e1 * FIRST + e2 * SECOND)
    shrink = np.exp(-size)
    by_e = (shrink * (ei * common - ratio * of) for ei, of in ((e1, FIRST), (e2, SECOND)))
    return np.stack([-_axes(each), *by_e], axis=1)


def _linear_step(t: FloatArray) -> FloatArray:
    """Share of a cell of unit width that lies inside an outline at a distance t."""
    return np.clip(0.5 + t, 0.0, 1.0)
