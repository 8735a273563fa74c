"""A method of one's own: Gauss-Newton with a Laplace prior on the sensor's mesh.

Run, in this folder:
    tactomo evaluate field --rows graded --method laplace_prior:LaplacePrior,tikhonov --count 3
"""

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import splu
from tactomo_models import Channel, Estimate, Measurement, Skin


class LaplacePrior:
    """Minimise |weight (data - V(x))|² + ∫(|∇x|² + (x / 50 mm)²) dA / 0.3² by the changes x."""

    def prepare(self, skin: Skin) -> None:
        """Solve the prior (P, P) for the Jacobian's rows; called at each tare."""
        self.skin, self.sign = skin, skin.description.sign(Channel.MAGNITUDE)
        prior = skin.mesh.smoothness() + diags(skin.mesh.areas_m2 / 0.05**2)
        self.precision = (prior / 0.3**2).tocsc()
        self.by_row = splu(self.precision).solve(skin.artifact.jacobian.T)  # (P, M)

    def solve(self, scan: Measurement, previous: Estimate | None, budget_s: float) -> Estimate:
        """One step for all nodes, then two for those that are pressed, where V bends."""
        data, forward = scan.changes[Channel.MAGNITUDE], self.skin.forward
        weight, scale = data.weight, data.weight / np.abs(forward.bare_voltages)
        rows = weight[:, None] * self.skin.artifact.jacobian
        system = rows @ (self.by_row * weight) + np.eye(len(rows))
        x = self.sign * self.by_row @ (weight * np.linalg.solve(system, weight * data.change))
        pressed = np.flatnonzero(x > 0.3 * x.max())
        x[x <= 0.3 * x.max()] = 0
        prior = self.precision[pressed][:, pressed].toarray()
        for _ in range(2):
            now = forward.solve(self.sign * x * forward.at_rest)
            slope = forward.jacobian(now, pressed) * forward.at_rest[pressed]
            slope *= self.sign * scale[:, None]
            left = weight * data.change - scale * (now.voltages - forward.bare_voltages)
            step = np.linalg.solve(slope.T @ slope + prior, slope.T @ left - prior @ x[pressed])
            x[pressed] = np.clip(x[pressed] + step, 1e-3, 0.9 if self.sign < 0 else 100)
        return Estimate(map=self.skin.areas.on_map(x), reason="three steps")
