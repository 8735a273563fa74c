"""One linear step, made once into a matrix that turns voltages into an image.

    minimise |N^(-1/2) (J x - d)|^2 + lambda |x / s|^2      the paper, equations 3 and 4

d are relative voltage changes and N their variances, so that small and noisy voltages do not
spoil the image. s says how large a change is expected at each node:

- Tikhonov (the paper, L = I): s = 1 everywhere.
- NOSER: s^-2 = diag(J' N^-1 J)^p with p = 1/2, a Gauss-Newton step from the bare sheet whose
  prior evens out part of the sensitivity; p = 0 is Tikhonov and drives noise to the rim, p = 1 is
  the authors' own and drives it to the middle.

lambda is chosen by a rule, not by eye: the noise figure is 1, that is, the image is as noisy,
relative to its signal, as the data are.

Sources: Adler & Guardo, "Electrical impedance tomography: regularized imaging and contrast
detection", IEEE Trans. Med. Imaging 15 (1996), the rule; Cheney et al., "NOSER: an algorithm for
solving the inverse conductivity problem", Int. J. Imaging Syst. Technol. 2 (1990); Adler, Dai &
Lionheart, "Temporal image reconstruction in electrical impedance tomography", Physiol. Meas. 28
(2007), the power.
"""

from typing import Final

import numpy as np

from tactomo_models.arrays import FloatArray

EVEN: Final = np.ones(1)  # s of Tikhonov


def even_scale(
    areas_m2: FloatArray,  # (P,) that each node stands for
) -> FloatArray:
    """Expected size of each node's change (P,), up to a factor, of an image that is white noise.

    A node that stands for a smaller area varies more: without that the image follows the mesh.
    """
    return np.asarray(np.sqrt(areas_m2.mean() / areas_m2))


def noser_scale(
    J: FloatArray,  # (M, P) Jacobian of the relative voltage changes
    noise: FloatArray,  # (M,) their standard deviations
) -> FloatArray:
    """Expected size of each node's change (P,), up to a factor, by the NOSER prior."""
    sensitivity = np.einsum("mp,mp,m->p", J, J, noise**-2)
    # A node that no voltage sees is no reason to divide by zero.
    floor = 1e-12 * float(sensitivity.max())
    return np.asarray(np.maximum(sensitivity, floor) ** -0.25)  # p = 1/2


def tikhonov_matrix(
    J: FloatArray,  # (M, P) derivative of the relative voltage changes by the nodes' conductivity
    noise: FloatArray,  # (M,) standard deviations of the relative voltage changes
    weight: float,  # the regularisation parameter lambda
    prior_scale: FloatArray = EVEN,  # (P,) expected size of each node's change, up to a factor
) -> FloatArray:
    """Reconstruction matrix (P, M)."""
    # (J'N⁻¹J + λS⁻²)⁻¹J'N⁻¹ = S²J'(JS²J' + λN)⁻¹, which inverts M x M instead of P x P.
    scaled = J * prior_scale**2
    data_space = scaled @ J.T + np.diag(weight * noise**2)
    return np.asarray(np.linalg.solve(data_space, scaled).T)


def prior_weight(
    size: float,  # expected size of a node's change, root mean square over the nodes
    prior_scale: FloatArray,  # (P,) of `tikhonov_matrix`
) -> float:
    """Regularisation parameter by Bayes: noise and changes are both what is expected of them."""
    return float(np.mean(prior_scale**2)) / size**2


def noise_figure_weight(
    J: FloatArray,  # (M, P) Jacobian of the relative voltage changes
    noise: FloatArray,  # (M,) their standard deviations
    target: FloatArray,  # (P,) conductivity change of the target
    prior_scale: FloatArray = EVEN,  # (P,) expected size of each node's change, up to a factor
) -> float:
    """Regularisation parameter at which the noise figure of a small central target is 1."""
    from scipy.optimize import brentq  # 10 MB, and only `noser` asks for it

    signal = J @ target / noise
    left, singular, right = np.linalg.svd(J / noise[:, None] * prior_scale, full_matrices=False)
    scale = float(np.mean(singular**2))
    signal_modes = left.T @ signal
    modes = right * prior_scale  # of the image, each by the data's mode of the same place
    noise_modes = np.vecdot(modes, modes) / modes.shape[1]

    def log_figure(log_weight: float) -> float:
        gain = singular / (singular**2 + scale * np.exp(log_weight))
        image = (gain * signal_modes) @ modes
        image_noise = np.sqrt(gain**2 @ noise_modes)
        figure = np.mean(np.abs(signal)) / (np.mean(np.abs(image)) / image_noise)
        return float(np.log(figure))

    # Within these bounds the figure falls steadily; where even the ends miss 1, take the nearer.
    low, high = np.log(1e-6), np.log(10.0)
    if log_figure(low) < 0:
        return float(scale * np.exp(low))
    if log_figure(high) > 0:
        return float(scale * np.exp(high))
    return float(scale * np.exp(brentq(log_figure, low, high, xtol=1e-3)))
