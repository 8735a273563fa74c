"""A sheet as `inner_loop.c` solves and differentiates it; the theory: `forward`, `condensation`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping

import numpy as np

from tactomo_models.arrays import BoolArray, FloatArray, IntArray
from tactomo_models.inner_loop import LIBRARY, at
from tactomo_models.physics.bare_sheet import BareSheet

_COUNTS = (
    *("triangles", "support", "pressable", "fields", "pairs", "products", "voltages"),
    *("most_around", "most_near"),
)
_ARRAYS = (
    *("corner_support", "corner_pressable", "triangles_of", "neighbours", "triangle_count"),
    *("closed", "gradient", "stiffness", "area", "conductivity", "transfer", "electrodes"),
    *("pair", "product", "product_of", "sign"),
)


class _Sheet(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in _COUNTS),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


class _Areas(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("triangles", "nodes", "layers", "rim", "near")),
        *((name, ctypes.c_void_p) for name in ("triangle", "corner", "node", "start", "depth")),
        ("layer", ctypes.c_void_p),
    )


class CompiledAreas:
    """Areas that are pressed: what a solve needs of them, however strongly they are.

    Attributes:
        where: (p,) pressable nodes that they are around.
        found: the same for C.
        nodes: (n,) positions of their nodes in `BareSheet.support`.
        rim: (r,) positions of those on rims.
        both: (r, r + L - 1) Green's function and the bare sheet's potentials on the rims.
        bare_both: (r + L - 1, r) what the bare areas' stiffness makes of both, transposed.
    """

    def __init__(self, sheet: _Sheet, bare: BareSheet, where: IntArray) -> None:
        assert LIBRARY is not None
        self.where = where
        most = min(sheet.triangles, len(where) * sheet.most_around)
        nodes = min(sheet.support, 3 * most)
        sizes = np.array([most, 3 * most, nodes, nodes + 1, nodes, nodes])
        self._kept = np.empty(sizes.sum(), np.int64)
        starts = (sizes.cumsum() - sizes).tolist()
        address = self._kept.ctypes.data
        self.found = _Areas(0, 0, 0, 0, 0, *(address + 8 * start for start in starts))
        of, found = ctypes.byref(sheet), ctypes.byref(self.found)
        _check(LIBRARY.find_areas(of, len(where), at(where), found))
        count = self.found.nodes
        self.nodes = self._kept[starts[2] : starts[2] + count]
        depth = self._kept[starts[4] : starts[4] + count]
        near = self.nodes[depth <= 1]
        self.rim = self.nodes[depth == 0]
        both = np.concatenate([bare.green.between(near, self.rim), bare.potentials[near]], axis=1)
        self.bare_both = np.empty((both.shape[1], len(self.rim)))
        _check(LIBRARY.apply_rim_law(of, found, both.shape[1], at(both), at(self.bare_both)))
        self.both = both[depth[depth <= 1] == 0]


class CompiledSheet:
    """Solves and differentiates a sheet.

    Args:
        bare: the sheet.
        arrays: what is known of its triangles, nodes and electrode pairs, as in `inner_loop.c`.
    """

    def __init__(
        self, bare: BareSheet, arrays: Mapping[str, FloatArray | IntArray | BoolArray]
    ) -> None:
        self._bare = bare
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
        self._sheet = _Sheet(**counts, **{name: at(self._kept[name]) for name in _ARRAYS})
        self._last: CompiledAreas | None = None

    def areas(self, where: IntArray) -> CompiledAreas:
        """Areas around pressable nodes; those of the last call where these are the very same."""
        if self._last is None or (
            self._last.where is not where and not np.array_equal(self._last.where, where)
        ):
            self._last = CompiledAreas(self._sheet, self._bare, where)
        return self._last

    def solve(
        self, areas: CompiledAreas, change: FloatArray, mix_resistivities: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Voltages (M,), potentials (n, L - 1) and injected currents (r, L - 1).

        Raises:
            numpy.linalg.LinAlgError: a conductivity is not above 0.
        """
        assert LIBRARY is not None
        change = np.ascontiguousarray(change, np.float64)
        voltages = np.empty(self._sheet.voltages)
        potentials = np.empty((len(areas.nodes), self._sheet.fields))
        injected = np.empty((self._sheet.fields, len(areas.rim)))
        made = LIBRARY.solve(
            ctypes.byref(self._sheet),
            ctypes.byref(areas.found),
            int(mix_resistivities),
            *(at(each) for each in (change, areas.both, areas.bare_both)),
            *(at(each) for each in (voltages, potentials, injected)),
        )
        _check(made)
        return voltages, potentials, injected.T

    def jacobian(
        self,
        areas: CompiledAreas,
        potentials: FloatArray,
        mixed: FloatArray | None,
        onto: FloatArray,
    ) -> FloatArray:
        """Derivative (M, K) of the voltages by parameters; see `ForwardModel.jacobian`."""
        assert LIBRARY is not None
        onto = np.ascontiguousarray(onto, np.float64)
        place = np.full(self._sheet.pressable, -1)
        place[areas.where] = np.arange(len(areas.where))
        jacobian = np.empty((self._sheet.voltages, onto.shape[1]))
        made = LIBRARY.differentiate(
            ctypes.byref(self._sheet),
            ctypes.byref(areas.found),
            *(at(each) for each in (potentials, mixed, place)),
            onto.shape[1],
            *(at(each) for each in (onto, jacobian)),
        )
        _check(made)
        return jacobian


def _check(made: int) -> None:
    """Raise what a call into C has to say."""
    if made < 0:
        raise MemoryError
    if made > 0:
        raise np.linalg.LinAlgError("a conductivity of zero or less has no solution")
