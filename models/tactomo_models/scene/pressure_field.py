"""The pressure field: contacts that press on all sheets alike, each of few parameters.

A contact is a closed outline and the pressure inside it. Of order 0 and 1 the outline is a circle
(3 parameters), of order 2 an ellipse (5); an ellipse's radius may be modulated around its edge,
which makes it an egg or a rounded rectangle (9). The pressure is even, or falls towards the edge;
a ring presses with its rim alone.

    u = B (x - x0),  B = exp(-s) expm(-E),  E = [[e1, e2], [e2, -e1]]     the unit circle of u
    log q = log |u| - sum_k (a_k cos k psi + b_k sin k psi),  psi = angle of u,  k = 3, 4
    phi = -log q |u|^2 / |B u|          distance inside the outline, to first order of it;
                                        held at its maximum where q < 1 / e
    h = H(phi / w)                      share pressed; H of compact support, 2 w wide
    p = P (1 - q^2)^gamma               pressure; gamma 0 is flat, 1/2 is Hertz

Where contacts overlap, what is pressed is pressed once, with the mean of their pressures.

A mesh blurs what is drawn on its nodes. Of a blurred disc of radius r voltages see the area, and
along each axis a second moment of r^2 / 4 + b, b the variance of the blur: it looks larger and
fainter. On a graded sheet a contact is drawn smaller and stronger, of radius k r and with a share
of h / k^2, so that both are those of the contact:

    k^2 = 1 - 2 (gamma + 2) b / r^2     r^2 / (2 gamma + 4) is the moment of a pressure that falls
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import Structure, byref, c_double, c_int64
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import TypeAlias

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.inner_loop import LIBRARY, at
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.scene.sheet_response import GradedResponse

UNIT_M = 0.01  # positions are counted in this, so that all parameters are of order 1
# Columns of a contact's parameters: place, form, peak pressure in units of the field, edge, hole.
X, Y, SIZE, E1, E2, HARMONIC, PEAK, EDGE, HOLE, COLUMNS = 0, 1, 2, 3, 4, 5, 9, 10, 11, 12
FORM = {0: 3, 1: 3, 2: 5}  # columns of the form that every contact of an order has
WAVES = np.array([3, 4])
TYPICAL_SIZE = float(np.log(0.012))  # s is the logarithm of the mean radius in metres
SIZE_LIMITS = (float(np.log(0.003)), float(np.log(0.06)))
LARGEST_CIRCLE = float(np.log(0.025))
MAX_BULGE = 0.25
EDGE_LIMITS = (
    0.3,
    1.0,
)  # of one that is not flat: what falls less shows nothing but the sheet's errors
HERTZ = 0.5
# Place, size, elongation and bulges; the peak as wide as any table; edges as of balls and fingers,
# holes of what presses with its rim.
PRIOR_SIGMA = np.array([5.0, 5.0, 0.6, 0.3, 0.3, 0.05, 0.05, 0.07, 0.07, 1.0, 0.12, 0.5])
NOWHERE = 1e-6  # distance from a contact's centre, over its size, that has no direction
GRADED_WIDTH = 0.7
MOST_BLURRED = 0.4  # 1 - k^2 at most: what is smaller than two nodes is drawn as well as they can
RIM = 0.1  # of the nodes' distance: how far inside its edge a falling pressure is averaged


class _Field(Structure):
    """What C knows of a field: see `inner_loop.c`."""

    _fields_ = (
        *((name, c_double) for name in ("half_width_m", "offset_m", "unit_kpa", "blur_m2")),
        *((name, c_int64) for name in ("forms", "is_sharp")),
    )


Slopes: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Drawing:
    """A field on the nodes that it presses."""

    nodes: IntArray  # (n,) pressable nodes where something presses
    # (n,) share of each within outlines, 0 to 1 (-1 to 1 of `objects`): what a saturated sheet
    # shows, since a good conductor hides the hole of a ring
    enclosed: FloatArray
    enclosed_kpa: FloatArray  # (n,) pressure there
    # (n,) share of each that is pressed, as drawn on a graded sheet: without holes, and above 1 for
    # the mesh's blur
    share: FloatArray
    pressure_kpa: FloatArray  # (n,) pressure on that share
    slopes: Callable[[], Slopes]  # makes the derivatives (n, N) of the four by the parameters


@dataclass(frozen=True)
class PressureField:
    """Contacts on a sheet, and which of their parameters are fitted."""

    x_m: FloatArray = field(repr=False)  # (P,) nodes
    y_m: FloatArray = field(repr=False)  # (P,) nodes
    half_width_m: float  # half the width over which the share falls from 1 to 0
    offset_m: float  # how far outwards of its parameters an outline is drawn for a saturated sheet
    blur_m2: float  # variance of each axis by which the mesh blurs what is drawn; see above
    unit_kpa: float  # pressure that peaks are counted in: the end of the table
    peak_limits: tuple[float, float]  # least and largest peak, in that unit
    order: int = 0  # 0, 1 or 2
    # (K, COLUMNS) parameters of each contact, as far as they are not fitted
    fixed: FloatArray = field(default_factory=lambda: np.zeros((0, COLUMNS)))
    # (K, COLUMNS) which are fitted
    free: BoolArray = field(default_factory=lambda: np.zeros((0, COLUMNS), bool))

    @classmethod
    def on(cls, forward: ForwardModel, graded: GradedResponse | None) -> PressureField:
        """A field without contacts on the nodes of a forward model.

        A mesh of linear triangles shows the voltages of a saturated sheet a little less than what
        is drawn on it, so an outline is drawn a twentieth of the nodes' distance outwards there.
        With that, radii err by -0.10 to 0.11 mm in the median of ordinary, hand-made, crowded and
        angular scenes (-0.18 to -0.03 with a tenth), and magnitudes by -2 to 3 % (2 to 4 %). At a
        graded sheet's mild contrast outlines stand where they are drawn, but for the blur.

        Args:
            forward: the model of the sheet.
            graded: the magnitude sheet's response; None where there is none.
        """
        offset = 0.05  # see above
        # A triangle has the mean of its corners, which spreads what is on a node over its hexagon;
        # and then there is the step from 1 to 0. ICC of tuning scenes without and with it: 0.989,
        # 0.991 at 40 dB, 0.954, 0.960 at 20 dB, 0.979, 0.981 of one graded sheet.
        of_triangles, of_step = 5 / 18, 1 / 3 - 2 / np.pi**2
        least, beyond = 0.01, 1.3  # of the table's end, that a peak may come to
        x, y = np.ascontiguousarray(forward.bare.points[:, forward.bare.pressable])
        description = forward.description
        spacing = description.width_m / (description.map.nodes_x - 1)
        end_kpa = graded.end_kpa if graded else 300.0
        onset_kpa = graded.onset_kpa if graded else 0.0
        limits = (max(onset_kpa / end_kpa, least), beyond)
        node_m2 = float(forward.node_areas_m2.mean())
        blur_m2 = of_triangles * node_m2 + of_step * (GRADED_WIDTH * spacing) ** 2
        return cls(x, y, spacing, offset * spacing, blur_m2, end_kpa, limits)

    @property
    def count(self) -> int:
        """Number of contacts, K."""
        return len(self.fixed)

    @property
    def typical_peak(self) -> float:
        """Peak that a contact starts with, in the field's unit: the middle of the table."""
        return (self.peak_limits[0] + 1.0) / 2

    def of(self, each: FloatArray, order: int, *, fits_peaks: bool = True) -> PressureField:
        """A field of contacts (K, COLUMNS) whose form has an order.

        A contact whose outline is modulated has that fitted, one whose edge is above 0 its edge.
        """
        free = np.zeros(each.shape, bool)
        free[:, : FORM[order]] = True
        free[:, PEAK] = fits_peaks
        free[:, EDGE] = fits_peaks & (each[:, EDGE] > 0)
        fixed = each.copy()
        fixed[:, FORM[order] : HARMONIC] = 0.0
        modulated = np.asarray(fixed[:, HARMONIC:PEAK].any(axis=1))
        free[:, HARMONIC:PEAK] = modulated[:, None]
        return replace(self, order=order, fixed=fixed, free=free)

    def with_free(self, columns: slice) -> PressureField:
        """The same contacts with some parameters of each free as well."""
        free = self.free.copy()
        free[:, columns] = True
        return replace(self, free=free)

    def with_peaks_alone(self, parameters: FloatArray) -> PressureField:
        """Contacts of these parameters, of which nothing but the peaks is fitted any more."""
        free = np.zeros_like(self.free)
        free[:, PEAK] = True
        return replace(self, fixed=self.split(parameters), free=free)

    @property
    def index(self) -> IntArray:
        """(K, COLUMNS) where each parameter stands in the vector of all; -1 where it is fixed."""
        index = np.full(self.free.shape, -1)
        index[self.free] = np.arange(self.free.sum())
        return index

    @property
    def forms(self) -> int:
        """Columns of the form that any contact has."""
        waves = slice(HARMONIC, PEAK)
        modulated = bool(self.free[:, waves].any() or self.fixed[:, waves].any())
        return PEAK if modulated else FORM[self.order]

    def split(self, parameters: FloatArray) -> FloatArray:
        """(K, COLUMNS) parameters of each contact."""
        each = self.fixed.copy()
        each[self.free] = parameters
        return each

    def join(self, each: FloatArray) -> FloatArray:
        """Parameters (N,) that are fitted, of all contacts in one vector."""
        return each[self.free]

    @cached_property
    def prior_mean(self) -> FloatArray:
        """Contacts are circles of a fingertip's size, anywhere."""
        mean = np.zeros((self.count, COLUMNS))
        mean[:, SIZE], mean[:, PEAK] = TYPICAL_SIZE, self.typical_peak
        mean[:, EDGE] = np.where(self.fixed[:, EDGE] > 0, HERTZ, 0.0)
        mean[:, HOLE] = self.fixed[:, HOLE]
        return self.join(mean)

    @cached_property
    def prior_precision(self) -> FloatArray:
        """Inverse variances (N,) of that."""
        return self.join(np.tile(PRIOR_SIGMA**-2.0, (self.count, 1)))

    @property
    def ratio_freedom(self) -> float:
        """Order 0 keeps to the likely ratio: else the first of several grows over them all."""
        firm_ratio = 0.02  # share of the log ratio's uncertainty that circles of order 0 have
        return firm_ratio if self.order == 0 else 1.0

    def bounded(self, parameters: FloatArray) -> FloatArray:
        """Keep centres on the sheet, and sizes, forms and pressures to those of contacts."""
        max_elongated = 0.9  # half the logarithm of the ratio of an ellipse's axes
        each = self.split(parameters)
        for column, nodes in ((X, self.x_m), (Y, self.y_m)):
            _limit(each[:, column], nodes.min() / UNIT_M, nodes.max() / UNIT_M)
        _limit(each[:, SIZE], SIZE_LIMITS[0], LARGEST_CIRCLE if self.order < 2 else SIZE_LIMITS[1])
        elongation = np.maximum(np.hypot(each[:, E1], each[:, E2]), 1e-12)
        each[:, E1:HARMONIC] *= np.minimum(1, max_elongated / elongation)[:, None]
        _limit(each[:, HARMONIC:PEAK], -MAX_BULGE, MAX_BULGE)
        _limit(each[:, PEAK], *self.peak_limits)
        flat = each[:, EDGE] <= 0
        _limit(each[:, EDGE], *EDGE_LIMITS)
        each[flat, EDGE] = 0.0
        return self.join(each)

    def draw(self, parameters: FloatArray) -> Drawing:
        """Draw the field on the nodes."""
        each = self.split(parameters)
        if LIBRARY is not None:
            return self._compiled(each)
        near = self._near(each)
        drawn = _Contacts(self, each, self.x_m[near], self.y_m[near])
        there = np.flatnonzero((drawn.wide > -1).any(axis=0))

        @cache
        def slopes() -> Slopes:
            one, two, three, four = (of[self.free][:, there].T for of in drawn.slopes())
            return one, two, three, four

        return Drawing(
            nodes=near[there],
            enclosed=drawn.enclosed[there],
            enclosed_kpa=drawn.enclosed_kpa[there],
            share=drawn.share[there],
            pressure_kpa=drawn.pressure_kpa[there],
            slopes=slopes,
        )

    def _for_c(self, is_sharp: bool) -> _Field:
        of = self.half_width_m, self.offset_m, self.unit_kpa, self.blur_m2
        return _Field(*of, self.forms, is_sharp)

    def _compiled(self, each: FloatArray) -> Drawing:
        """The same as `draw`, by `inner_loop.c`."""
        assert LIBRARY is not None
        of = byref(self._for_c(False))
        nodes, found = np.empty(len(self.x_m), np.intp), np.empty((4, len(self.x_m)))
        points = len(self.x_m), at(self.x_m), at(self.y_m)
        count = LIBRARY.draw(of, len(each), at(each), *points, at(nodes), *map(at, found))
        nodes = nodes[:count].copy()

        @cache
        def slopes() -> Slopes:
            x_m, y_m = self.x_m[nodes], self.y_m[nodes]
            by = np.empty((4, count, int(self.free.sum())))
            points = count, at(x_m), at(y_m)
            LIBRARY.draw_slopes(
                of, len(each), at(each), *points, at(self.index), by.shape[2], *map(at, by)
            )
            return by[0], by[1], by[2], by[3]

        enclosed, enclosed_kpa, share, pressure = found[:, :count].copy()
        return Drawing(nodes, enclosed, enclosed_kpa, share, pressure, slopes)

    def sampled(
        self, each: FloatArray, x_m: FloatArray, y_m: FloatArray, step_m: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What is enclosed, share pressed and pressure in kPa at n points a step apart, (n,) each.

        Outlines are as sharp as the points can show them.
        """
        sharp = replace(self, half_width_m=step_m, blur_m2=0.0)
        if LIBRARY is not None:
            found = np.empty((4, len(x_m)))
            LIBRARY.draw(
                byref(sharp._for_c(True)),
                len(each),
                at(each),
                len(x_m),
                at(x_m),
                at(y_m),
                None,
                *map(at, found),
            )
            return found[0], found[2], found[3]
        drawn = _Contacts(sharp, each, x_m, y_m, is_sharp=True)
        return drawn.enclosed, drawn.share, drawn.pressure_kpa

    def _near(self, each: FloatArray) -> IntArray:
        """Nodes that any contact can reach: what is farther away need not be drawn."""
        longest = np.exp(
            each[:, SIZE]
            + np.hypot(each[:, E1], each[:, E2])
            + np.abs(each[:, HARMONIC:PEAK]).sum(axis=1)
        )
        reach = longest + 2 * (self.half_width_m + self.offset_m)
        dx, dy = self.x_m - UNIT_M * each[:, X, None], self.y_m - UNIT_M * each[:, Y, None]
        return np.flatnonzero((dx * dx + dy * dy < reach[:, None] ** 2).any(axis=0))


def _limit(values: FloatArray, least: float, most: float) -> None:
    """Bring values to limits in place: for a few values twice as fast as `np.clip`."""
    np.maximum(values, least, out=values)
    np.minimum(values, most, out=values)


class _Contacts:
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
        self.enclosed_kpa = self._as_is.mean(self._as_is.pressures)
        self._once = 1 - np.prod(1 - self._drawn.shares, axis=0)
        self._strengths = np.ones_like(self._wide) / left[:, None]
        self._strength = self._drawn.mean(self._strengths)
        self.share = self._strength * self._once
        self.pressure_kpa = self._drawn.mean(self._drawn.pressures)

    def slopes(self) -> Slopes:
        """Derivatives (K, COLUMNS, n) of what a `Drawing` has."""
        forms = self._of.forms
        as_is, pressures = self._as_is.slopes()
        wide = np.zeros_like(as_is)
        wide[:, :forms] = heaviside_slope(self.wide)[:, None] * self._as_is.outline.slopes[0]
        enclosed_kpa = self._as_is.slopes_of_mean(as_is, pressures, self._as_is.pressures)
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
            self._left = 1 - self._hole * step(self._inner.t)
        else:
            self._left = np.ones_like(self.whole)
        self.shares = self.whole * self._left
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

    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives (K, COLUMNS, n) of each contact's share and pressure."""
        of, each, forms = self._of, self._each, self._of.forms
        by_t, by_log_q = self.outline.slopes
        shares, pressures = np.zeros((2, len(each), COLUMNS, self.shares.shape[1]))
        shares[:, :forms] = (
            heaviside_slope(self.outline.t / GRADED_WIDTH) / GRADED_WIDTH * self._left
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


def heaviside(t: FloatArray) -> FloatArray:
    """Smoothed step of compact support: 0 below -1, 1 above 1."""
    t = np.clip(t, -1, 1)
    # Rounding must not leave a trace of 1e-17 outside the support: every such node would be solved.
    return np.where(t > -1, 0.5 * (1 + t + np.sin(np.pi * t) / np.pi), 0.0)


def heaviside_slope(t: FloatArray) -> FloatArray:
    """Derivative of `heaviside`."""
    return np.asarray((1 + np.cos(np.pi * np.clip(t, -1, 1))) / 2)


def _linear_step(t: FloatArray) -> FloatArray:
    """Share of a cell of unit width that lies inside an outline at a distance t."""
    return np.clip(0.5 + t, 0.0, 1.0)


def ellipses_of(
    images: FloatArray,  # (K, rows, columns) share pressed by each contact, nowhere all 0
    x_m: FloatArray,  # (rows, columns) places, evenly spaced
    y_m: FloatArray,  # (rows, columns) places
    typical_peak: float,  # peak that each starts with, in the field's unit
) -> FloatArray:
    """Parameters (K, COLUMNS) of ellipses of the same centre, area and second moments."""
    cell_m2 = float((x_m[0, 1] - x_m[0, 0]) * (y_m[1, 0] - y_m[0, 0]))
    each = np.zeros((len(images), COLUMNS))
    each[:, PEAK] = typical_peak
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
