"""The mesh that a method of one's own works on: the nodes whose conductivity pressing changes."""

from __future__ import annotations

from dataclasses import dataclass, field

import scipy.sparse as sp

from tactomo_models.arrays import FloatArray, IntArray
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import assembled


@dataclass(frozen=True)
class NodeMesh:
    """P nodes of a sheet, in the order of the Jacobian's columns, and the triangles of them.

    Attributes:
        nodes_m: (P, 2) x and y.
        triangles: (T, 3) nodes of each triangle whose three corners are among the P.
        areas_m2: (P,) share of the sheet's area that belongs to each node.
        electrodes_m: (L, 2) middle of each electrode, in the order of the electrodes' numbers.
    """

    nodes_m: FloatArray
    triangles: IntArray
    areas_m2: FloatArray
    electrodes_m: FloatArray
    _smoothness: sp.csr_matrix = field(repr=False)

    @classmethod
    def of(cls, forward: ForwardModel) -> NodeMesh:
        """Take the nodes that can be pressed from a sheet's model."""
        bare = forward.bare
        triangles, stiffness = forward.pressable_triangles
        return cls(
            nodes_m=bare.points[:, bare.pressable].T,
            triangles=triangles,
            areas_m2=forward.node_areas_m2,
            electrodes_m=forward.description.electrode_centres_m,
            _smoothness=assembled(stiffness, triangles, len(bare.pressable)),
        )

    def smoothness(self) -> sp.csr_matrix:
        """Return the matrix K (P, P) of x'Kx = ∫|∇x|² dA, for x (P,) linear on each triangle.

        K is the stiffness matrix of the Laplace operator with a free rim: symmetric, without a unit
        for relative changes, and 0 for what is constant.
        """
        return self._smoothness
