"""A sheet as `inner_loop.c` solves and differentiates it; the theory stands in `forward`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.inner_loop import LIBRARY, address, at
from tactomo_models.physics.bare_sheet import BareSheet
from tactomo_models.physics.greens import PackedGreensFunction

_COUNTS = (
    *("triangles", "support", "pressable", "fields", "pairs", "products", "voltages"),
    *("most_around", "most_near"),
)
_ARRAYS = (
    *("corner_support", "corner_pressable", "triangles_of", "neighbours", "triangle_count"),
    *("closed", "gradient", "stiffness", "area", "conductivity", "at_rest", "potentials"),
    *("transfer", "bare_voltages", "electrodes", "pair", "product", "product_of", "sign"),
)

_Fields = tuple[tuple[str, type], ...]


def _reals(*names: str) -> _Fields:
    return tuple((name, ctypes.c_double) for name in names)


def _integers(*names: str) -> _Fields:
    return tuple((name, ctypes.c_int64) for name in names)


def _addresses(*names: str) -> _Fields:
    return tuple((name, ctypes.c_void_p) for name in names)


class _Sheet(ctypes.Structure):
    _fields_ = (
        *_integers(*_COUNTS),
        *_addresses(*_ARRAYS, "green_single", "green_double"),
    )


class _Areas(ctypes.Structure):
    _fields_ = (
        *_integers("triangles", "nodes", "layers", "rim", "is_known"),
        *_addresses("triangle", "corner", "node", "start", "depth", "layer"),
        *_addresses("both", "rest"),
    )


class _Pressing(ctypes.Structure):
    _fields_ = (
        *_integers("count"),
        *_addresses("where", "share", "pressure"),
        *_reals("log_ratio", "exponent"),
        *_addresses("change", "voltages", "residual", "potentials", "injected"),
    )


class _Response(ctypes.Structure):
    _fields_ = (
        *_integers("saturates", "count"),
        *_addresses("pressure", "value"),
        *_reals("reflection"),
    )


class _Data(ctypes.Structure):
    _fields_ = (
        *_addresses("change", "weight"),
        *_integers("drifts"),
        *_addresses("along", "share"),
    )


class CompiledResponse:
    """What a pressure does to a sheet's conductivity.

    Args:
        pressure_kpa: (n,) of a table.
        value: (n,) relative change there; or share of the logarithm of the full change.
        saturates: which of the two. A table of no rows has all of the full change anywhere.
        reflected: by a typical contact's outline, from 0 to 1; see `reflection`.
    """

    def __init__(
        self, pressure_kpa: FloatArray, value: FloatArray, *, saturates: bool, reflected: float
    ) -> None:
        self._kept = [np.ascontiguousarray(each, np.float64) for each in (pressure_kpa, value)]
        where = map(address, self._kept)
        self._response = _Response(saturates, len(value), *where, reflected)
        self.address = ctypes.byref(self._response)  # for C

    def conductivity(
        self, share: FloatArray, pressure_kpa: FloatArray, log_ratio: float
    ) -> tuple[FloatArray, FloatArray]:
        """Conductivity ratio (n,), its derivatives (3, n) by share, pressure and log ratio."""
        share, pressure_kpa = np.broadcast_arrays(share, pressure_kpa)
        given = [np.ascontiguousarray(each, np.float64) for each in (share, pressure_kpa)]
        ratio, slopes = np.empty(len(share)), np.empty((3, len(share)))
        count, found = len(share), (at(ratio), at(slopes))
        LIBRARY.conduct(self.address, count, *map(at, given), log_ratio, *found)
        return ratio, slopes


class CompiledData:
    """Relative changes that were measured, and how they are weighted; see `Changes`."""

    def __init__(
        self,
        change: FloatArray,  # (M,)
        weight: FloatArray,  # (M,) inverse standard deviations
        # (M, K) directions and (K,) shares that are taken off along them; None without
        drift: tuple[FloatArray, FloatArray] | None,
    ) -> None:
        along, share = (np.zeros((len(change), 0)), np.zeros(0)) if drift is None else drift
        kept = [np.ascontiguousarray(each, np.float64) for each in (change, weight, along, share)]
        self._kept = kept
        where = list(map(address, kept))
        self._data = _Data(*where[:2], len(share), *where[2:])
        self.address = ctypes.byref(self._data)  # for C


@dataclass(frozen=True)
class Pressed:
    """What presses on a sheet, as that sheet sees it."""

    where: IntArray  # (n,) pressable nodes
    share: FloatArray  # (n,) of each that is pressed
    pressure_kpa: FloatArray  # (n,) on that share
    log_ratio: float  # logarithm of the structure sheet's ratio where it is saturated
    response: CompiledResponse
    exponent: float  # see `ForwardModel.solve`


class CompiledAreas:
    """Areas that are pressed: what a solve needs of them, however strongly they are."""

    def __init__(self, sheet: _Sheet, where: IntArray) -> None:
        self.where = where  # (p,) pressable nodes that they are around
        most = min(sheet.triangles, len(where) * sheet.most_around)
        nodes = min(sheet.support, 3 * most)
        sizes = (most, 3 * most, nodes, nodes + 1, nodes, nodes)
        *starts, end = accumulate(sizes, initial=0)
        self._kept = np.empty(end, np.int64)
        place = address(self._kept)
        # the same for C
        self.found = _Areas(0, 0, 0, 0, 0, *(place + 8 * start for start in starts))
        _check(
            LIBRARY.find_areas(ctypes.byref(sheet), len(where), at(where), ctypes.byref(self.found))
        )
        rim = self.found.rim
        count = self.found.nodes
        # (n,) positions of their nodes in `BareSheet.support`
        self.nodes = self._kept[starts[2] : starts[2] + count]
        # (r,) positions of those on rims
        self.rim = self.nodes[self._kept[starts[4] : starts[4] + count] == 0]
        width = rim + sheet.fields
        self._known = np.empty(rim * (width + rim))
        self.found.both = place = address(self._known)
        self.found.rest = place + 8 * rim * width


@dataclass(frozen=True)
class Solution:
    """Voltages of one pressed sheet, with what its potentials and derivatives follow from."""

    voltages: FloatArray  # (M,) in scan order, relative (multiply by `ForwardModel.volts_per_unit`)
    # (n,) positions in `BareSheet.support` of the corners of all triangles that changed
    nodes: IntArray
    potentials: FloatArray  # (n, L - 1) potentials there
    rim: IntArray  # (r,) positions in `BareSheet.support` of those that other triangles touch, too
    # (r, L - 1) currents that, injected there into the bare sheet, make the pressed sheet's
    # potentials on the rims and everywhere outside
    injected: FloatArray
    areas: CompiledAreas = field(repr=False)
    change: FloatArray = field(repr=False)  # (P,) at the pressable nodes
    exponent: float  # that it was solved with


class CompiledSheet:
    """Solves and differentiates a sheet; `ForwardModel` makes it of a sensor.

    Args:
        bare: the sheet.
        arrays: what is known of its triangles, nodes and electrode pairs, as in `inner_loop.c`.

    Raises ModelError where the compiled library is not there, or not of this machine.
    """

    def __init__(
        self, bare: BareSheet, arrays: Mapping[str, FloatArray | IntArray | BoolArray]
    ) -> None:
        LIBRARY.load()  # where it is not there, nobody should wait for the first press to know
        self.bare = bare
        self._kept = {name: np.ascontiguousarray(arrays[name]) for name in _ARRAYS}
        counts = {
            "triangles": len(arrays["area"]),
            "support": len(bare.support),
            "pressable": len(bare.pressable),
            "fields": bare.potentials.shape[1],
            "pairs": len(arrays["pair"]),
            "products": len(arrays["product"]),
            "voltages": len(arrays["sign"]),
            "most_around": arrays["triangles_of"].shape[1],
            "most_near": arrays["neighbours"].shape[1],
        }
        green = {}
        if isinstance(bare.green, PackedGreensFunction):
            is_single = bare.green.lower.dtype == np.float32
            name = "green_single" if is_single else "green_double"
            self._kept[name] = np.ascontiguousarray(
                bare.green.lower, np.float32 if is_single else np.float64
            )
            green[name] = address(self._kept[name])
        of_arrays = {name: address(self._kept[name]) for name in _ARRAYS}
        self._sheet = _Sheet(**counts, **of_arrays, **green)
        self._address = ctypes.byref(self._sheet)
        self._even = np.ones(self._sheet.voltages)
        self._last: CompiledAreas | None = None

    def _areas(self, where: IntArray) -> CompiledAreas:
        """Areas around pressable nodes; those of the last solve where these are the very same."""
        last = self._last
        if last is not None and np.array_equal(last.where, where):
            return last
        return CompiledAreas(self._sheet, np.ascontiguousarray(where, np.int64))

    def _green(self, areas: CompiledAreas) -> FloatArray | None:
        """Blocks of a Green's function that is in pieces, for C; None where C can look them up."""
        if isinstance(self.bare.green, PackedGreensFunction) or areas.found.is_known:
            return None
        return np.ascontiguousarray(self.bare.green.between(areas.rim, areas.rim))

    def solve(self, change: FloatArray, exponent: float = 1.0) -> Solution:
        """Solve for a pressed sheet.

        Args:
            change: (P,) conductivity minus the bare sheet's at the pressable nodes.
            exponent: of the power mean of its corners that a triangle has; 1 is the mean of
                conductivities, -1 that of resistivities, 0 that of logarithms. Below 0, triangles
                with a corner that conducts worse than at rest have it with the other sign. See
                `reflection`.

        Raises numpy.linalg.LinAlgError where a conductivity is not above 0.
        """
        where = np.flatnonzero(change)
        pressing = _Pressing(len(where), exponent=exponent)
        return self._solve(where, pressing, change=change)[0]

    def evaluate(self, pressed: Pressed, data: CompiledData) -> tuple[Solution, FloatArray]:
        """Solve for what is pressed and compare its relative voltage changes with data.

        Returns:
            The solution, and the weighted residual (M,) of the data.

        Raises numpy.linalg.LinAlgError where a conductivity is not above 0.
        """
        addresses = pressed.response.address, data.address
        return self._solve(pressed.where, _pressing(pressed), *addresses)

    def _solve(
        self,
        where: IntArray,  # (n,) pressable nodes that change
        pressing: _Pressing,
        response: Any = None,  # these two for C; None where nothing is compared
        data: Any = None,
        change: FloatArray | None = None,  # (P,) where no response tells it
    ) -> tuple[Solution, FloatArray]:
        areas = self._areas(where)
        found, sheet = areas.found, self._sheet
        sizes = (sheet.pressable, sheet.voltages, sheet.voltages, found.nodes * sheet.fields)
        ends = [*accumulate((*sizes, found.rim * sheet.fields))]
        kept = np.empty(ends[-1])
        place = address(kept)
        if change is not None:
            kept[: ends[0]] = change
        pressing.where, pressing.change = address(areas.where), place
        pressing.voltages, pressing.residual = place + 8 * ends[0], place + 8 * ends[1]
        pressing.potentials, pressing.injected = place + 8 * ends[2], place + 8 * ends[3]
        green = self._green(areas)
        made = LIBRARY.evaluate(
            self._address,
            ctypes.byref(found),
            None if green is None else at(green),
            response,
            data,
            ctypes.byref(pressing),
        )
        _check(made)
        self._last = areas
        solution = Solution(
            kept[ends[0] : ends[1]],
            areas.nodes,
            kept[ends[2] : ends[3]].reshape(-1, sheet.fields),
            areas.rim,
            kept[ends[3] :].reshape(sheet.fields, found.rim).T,
            areas,
            kept[: ends[0]],
            pressing.exponent,
        )
        return solution, kept[ends[1] : ends[2]]

    def slopes(
        self,
        solution: Solution,  # that of `evaluate`
        pressed: Pressed,  # what presses on p nodes
        data: CompiledData,  # what was measured
        by_share: FloatArray,  # (p, N) derivatives of the shares by N parameters
        by_pressure: FloatArray,  # (p, N) those of the pressures
    ) -> FloatArray:
        """Derivative (M, N + 1) of the weighted residual, by the parameters and the log ratio."""
        areas, potentials = self._around(solution, pressed.where)
        pressing = _pressing(pressed)
        pressing.where, pressing.exponent = address(areas.where), solution.exponent
        pressing.change, pressing.potentials = address(solution.change), address(potentials)
        jacobian = np.empty((self._sheet.voltages, by_share.shape[1] + 1))
        made = LIBRARY.evaluate_slopes(
            self._address,
            ctypes.byref(areas.found),
            pressed.response.address,
            data.address,
            ctypes.byref(pressing),
            by_share.shape[1],
            *map(at, (by_share, by_pressure, jacobian)),
        )
        _check(made)
        return jacobian

    def _around(self, solution: Solution, where: IntArray) -> tuple[CompiledAreas, FloatArray]:
        """Areas around pressable nodes, and a solution's potentials (n, L - 1) there."""
        areas = solution.areas
        if areas.where is where or np.array_equal(areas.where, where):
            return areas, solution.potentials
        areas = self._areas(where)
        return areas, self.potentials(solution, areas.nodes)

    def potentials(self, solution: Solution, nodes: IntArray) -> FloatArray:
        """Potentials (n, L - 1) of a pressed sheet at n positions in `BareSheet.support`."""
        position = positions(solution.nodes, len(self.bare.support))[nodes]
        outside = position < 0
        potentials = np.empty((len(nodes), self.bare.potentials.shape[1]))
        potentials[~outside] = solution.potentials[position[~outside]]
        others = nodes[outside]
        moved = self.bare.green.between(others, solution.rim) @ solution.injected
        potentials[outside] = self.bare.potentials[others] + moved
        return potentials

    def jacobian(
        self,
        solution: Solution,  # where to differentiate
        where: IntArray,  # (n,) pressable nodes
        # (n, K) derivative of these nodes' conductivities by K parameters: sooner done here than
        # with the (M, n) derivative by nodes
        onto: FloatArray | None = None,
    ) -> FloatArray:
        """Derivative of the voltages with respect to conductivity.

        Returns:
            (M, K), or (M, n) by the nodes' relative conductivity (the paper's equation 2).
        """
        areas, potentials = self._around(solution, where)
        onto = None if onto is None else np.ascontiguousarray(onto, np.float64)
        count = len(areas.where) if onto is None else onto.shape[1]
        jacobian = np.empty((self._sheet.voltages, count))
        made = LIBRARY.differentiate(
            self._address,
            ctypes.byref(areas.found),
            len(areas.where),
            *map(at, (areas.where, potentials)),
            solution.exponent,
            at(solution.change),
            count,
            *(at(each) for each in (onto, self._even, jacobian)),
        )
        _check(made)
        return jacobian


def _pressing(pressed: Pressed) -> _Pressing:
    """What presses, for C; which of the areas' nodes that is about is still to be said."""
    return _Pressing(
        len(pressed.where),
        0,
        address(pressed.share),
        address(pressed.pressure_kpa),
        pressed.log_ratio,
        pressed.exponent,
    )


def reflection(ratio: FloatArray | float) -> FloatArray:
    """How much of a field the outline of what conducts `ratio` times as well reflects.

    From 1 (what does not conduct) to -1 (what conducts perfectly), of the ratio's shape,
    k = (1 - c) / (1 + c). It is the exponent of the power mean by which the two conductivities mix
    where an outline is drawn over some width. There the share s of what is inside falls from 1 to
    0, evenly; currents along it gain Int sigma(s) ds - (1 + c) / 2, and those across it lose
    c^2 (Int ds / sigma(s) - (1 + 1 / c) / 2). With this exponent the two are equal, and what is
    drawn answers as with a sharp outline, to first order in the width.
    """
    return np.asarray((1 - np.asarray(ratio)) / (1 + np.asarray(ratio)))


def positions(members: IntArray, count: int) -> IntArray:
    """Where each number below `count` stands among `members`; -1 for those that do not."""
    position = np.full(count, -1)
    position[members] = np.arange(len(members))
    return position


def _check(made: int) -> None:
    """Raise what a call into C has to say."""
    if made < 0:
        raise MemoryError
    if made > 0:
        raise np.linalg.LinAlgError("a conductivity of zero or less has no solution")
