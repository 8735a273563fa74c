"""A method of one's own: Tikhonov that expects change where the structure channel answers.

Run, in this folder, to reconstruct a file, or to draw the method on the chart beside others:
    tactomo reconstruct scans.npz maps.npz --method own_method:StructurePrior
    tactomo bench --chart chart.png --method own_method:StructurePrior --method tikhonov --count 2
"""

import numpy as np
from tactomo_models import Channel, Estimate, Measurement, Skin, UnsolvableError

TYPICAL_CHANGE = 0.3  # of the magnitude channel's conductivity, where structure answers
BACKGROUND = 1e-6  # share of the prior variance that the rest of the sheet keeps


class StructurePrior:
    """One linear solve for the magnitude map; a linear image of the structure is its prior."""

    def prepare(self, skin: Skin) -> None:
        """Keep what frames will need; called at each tare."""
        self.skin = skin
        self.jacobian = skin.artifact.jacobian  # (voltages, nodes) of relative changes
        self.node_weight = skin.forward.node_areas_m2 / skin.forward.node_areas_m2.mean()
        self.sign = skin.description.sign(Channel.MAGNITUDE)  # -1 where pressing insulates

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Weight the voltages by their noise, the nodes by the prior, and solve (M, M)."""
        changes = measurement.changes.get(Channel.MAGNITUDE)
        if changes is None:
            raise UnsolvableError("the magnitude channel is missing")
        guide = measurement.changes.get(Channel.STRUCTURE, changes)
        image = np.abs(self.skin.artifact.tikhonov @ guide.change)  # (nodes,)
        share = np.clip(2 * image / image.max(), 0, 1) ** 4 + BACKGROUND
        variance = TYPICAL_CHANGE**2 * share / self.node_weight
        weighted = changes.weight[:, None] * self.jacobian
        system = (weighted * variance) @ weighted.T + np.eye(len(weighted))
        data = self.sign * changes.weight * changes.change
        nodes = variance * (weighted.T @ np.linalg.solve(system, data))
        return Estimate(map=self.skin.areas.on_map(np.maximum(nodes, 0)), reason="one solve")
