"""Tikhonov regularisation: one matrix, made once, that turns voltages into an image.

    minimise |N^(-1/2) (J x - d)|^2 + lambda |x|^2          the paper, equations 3 and 4, L = I

d are relative voltage changes and N their variances, so that small and noisy voltages do not
spoil the image. lambda is chosen by a rule, not by eye: the noise figure is 1, that is, the image
is as noisy, relative to its signal, as the data are.

Source of the rule: Adler & Guardo, "Electrical impedance tomography: regularized imaging and
contrast detection", IEEE Trans. Med. Imaging 15 (1996).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

FloatArray = NDArray[np.float64]


def tikhonov_matrix(J: FloatArray, noise: FloatArray, weight: float) -> FloatArray:
    """Reconstruction matrix (P, M).

    Args:
        J: (M, P) derivative of the relative voltage changes by the nodes' conductivity.
        noise: (M,) standard deviations of the relative voltage changes.
        weight: the regularisation parameter lambda.
    """
    # (J'N⁻¹J + λ)⁻¹J'N⁻¹ = J'(JJ' + λN)⁻¹, which inverts M x M instead of P x P.
    data_space = J @ J.T + np.diag(weight * noise**2)
    return np.asarray(np.linalg.solve(data_space, J).T)


def noise_figure_weight(J: FloatArray, noise: FloatArray, target: FloatArray) -> float:
    """Regularisation parameter at which the noise figure of a small central target is 1.

    Args:
        J: (M, P) Jacobian of the relative voltage changes.
        noise: (M,) their standard deviations.
        target: (P,) conductivity change of the target.
    """
    whitened = J / noise[:, None]
    left, singular, right = np.linalg.svd(whitened, full_matrices=False)
    signal = whitened @ target
    scale = float(np.mean(singular**2))

    def log_figure(log_weight: float) -> float:
        gain = singular / (singular**2 + scale * np.exp(log_weight))
        image = right.T @ (gain * (left.T @ signal))
        image_noise = np.sqrt(np.mean(gain**2 @ right**2))
        figure = np.mean(np.abs(signal)) / (np.mean(np.abs(image)) / image_noise)
        return float(np.log(figure))

    # Within these bounds the figure falls steadily; where even the ends miss 1, take the nearer.
    low, high = np.log(1e-6), np.log(10.0)
    if log_figure(low) < 0:
        return float(scale * np.exp(low))
    if log_figure(high) > 0:
        return float(scale * np.exp(high))
    return float(scale * np.exp(brentq(log_figure, low, high, xtol=1e-3)))
