"""One line: weighted fit, covariance, change of frame, comparison and fusion.

A line in polar form is x cos(alpha) + y sin(alpha) = rho, its covariance is kept in the order
(alpha, rho). Sources: Pfister, Roumeliotis, Burdick, "Weighted line fitting algorithms for
mobile robot map building and efficient data representation" (ICRA 2003), and Iles, Seder,
Petrovic, "Improvement of Map Building during the Exploration of Polygonal Environments using
the Range Data". Two corrections to the printed equations: the covariance is centred on the
weighted mean position along the line (without that it is too small off-centre), and the fit
steps in rho and alpha jointly (alternating converges linearly, slowly for side walls).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

TWO_PI = 2.0 * math.pi


@njit(cache=True)
def wrap(angle: float) -> float:
    """The angle in (-pi, pi], rad."""
    angle = (angle + math.pi) % TWO_PI - math.pi
    return math.pi if angle <= -math.pi else angle


@njit(cache=True)
def normal_variance(x: float, y: float, ca: float, sa: float, var_range: float, var_angle: float) -> float:
    """Variance of a point normal to the line of normal (ca, sa), m2: P_k of Pfister et al."""
    dc = x * ca + y * sa
    psi = x * sa - y * ca
    return var_range * dc * dc / (x * x + y * y) + var_angle * psi * psi


@njit(cache=True)
def direction(x: np.ndarray, y: np.ndarray, index: np.ndarray) -> float:
    """Angle of the normal of the total least squares line through points `index`, rad."""
    n = index.size
    mx = my = 0.0
    for k in index:
        mx += x[k]
        my += y[k]
    mx /= n
    my /= n
    sxx = sxy = syy = 0.0
    for k in index:
        dx, dy = x[k] - mx, y[k] - my
        sxx += dx * dx
        sxy += dx * dy
        syy += dy * dy
    return 0.5 * math.atan2(2.0 * sxy, sxx - syy) + 0.5 * math.pi


@njit(cache=True)
def fit(
    x: np.ndarray, y: np.ndarray, index: np.ndarray, var_range: float, var_angle: float, accuracy: float = 1e-6
) -> tuple[float, float, float, float, float, float]:
    """Weighted line fit to the points `index` (at least 2) of a scan seen from the origin.

    Gauss-Newton in (rho, alpha) with the weights 1 / P_k frozen within an iteration, until a step is
    smaller than `accuracy` standard deviations of alpha. Returns
    rho (>= 0), alpha, var_alpha, cov_alpha_rho, var_rho (m, rad) and the chi-square of the
    residuals (n - 2 degrees of freedom).
    """
    alpha = direction(x, y, index)
    rho = psi_bar = s0 = spp = chi2 = 0.0
    for _ in range(12):
        ca, sa = math.cos(alpha), math.sin(alpha)
        s0 = s1 = s2 = r1 = r2 = q = 0.0
        for k in index:
            dc = x[k] * ca + y[k] * sa
            psi = x[k] * sa - y[k] * ca
            # 1 / P_k, with d^2 = dc^2 + psi^2
            d2 = dc * dc + psi * psi
            w = d2 / (var_range * dc * dc + var_angle * psi * psi * d2)
            s0 += w
            s1 += w * psi
            s2 += w * psi * psi
            r1 += w * dc
            r2 += w * dc * psi
            q += w * dc * dc
        psi_bar = s1 / s0
        rho = r1 / s0
        spp = max(s2 - s1 * psi_bar, 1e-12 * s2 + 1e-300)
        chi2 = max(q - r1 * rho, 0.0)
        step = (r2 - r1 * psi_bar) / spp
        step = min(max(step, -0.3), 0.3)
        if step * step * spp < accuracy * accuracy:
            break
        alpha += step
    var_alpha = 1.0 / spp
    cov = -psi_bar * var_alpha
    var_rho = 1.0 / s0 + psi_bar * psi_bar * var_alpha
    if rho < 0.0:
        rho, alpha, cov = -rho, alpha + math.pi, -cov
    return rho, wrap(alpha), var_alpha, cov, var_rho, chi2


@njit(cache=True)
def to_map(
    rho: float, alpha: float, covariance: np.ndarray, pose: np.ndarray, pose_covariance: np.ndarray
) -> tuple[float, float, np.ndarray]:
    """The line in the map frame, its normal still pointing away from the robot (rho may be negative).

    P0 = H P_L H' + K P_g K' with H = [[1, 0], [dpsi, 1]], K = [[0, 0, 1], [cos, sin, dpsi]].
    """
    alpha0 = wrap(alpha + pose[2])
    c, s = math.cos(alpha0), math.sin(alpha0)
    rho0 = rho + pose[0] * c + pose[1] * s
    dpsi = pose[1] * c - pose[0] * s
    out = np.empty((2, 2))
    paa, par, prr = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    g = pose_covariance
    row0, row1, row2 = (
        c * g[0, 0] + s * g[1, 0] + dpsi * g[2, 0],
        c * g[0, 1] + s * g[1, 1] + dpsi * g[2, 1],
        c * g[0, 2] + s * g[1, 2] + dpsi * g[2, 2],
    )
    out[0, 0] = paa + g[2, 2]
    out[0, 1] = out[1, 0] = dpsi * paa + par + row2
    out[1, 1] = dpsi * dpsi * paa + 2.0 * dpsi * par + prr + row0 * c + row1 * s + row2 * dpsi
    return rho0, alpha0, out


@njit(cache=True)
def shift(
    rho: float, alpha: float, paa: float, par: float, prr: float, x: float, y: float
) -> tuple[float, float, float]:
    """Offset, and its covariances with alpha and itself, of a line in a frame moved to (x, y)."""
    c, s = math.cos(alpha), math.sin(alpha)
    h = x * s - y * c
    return rho - x * c - y * s, par + h * paa, prr + 2.0 * h * par + h * h * paa


@njit(cache=True)
def distance2(
    rho1: float, alpha1: float, p1: np.ndarray, rho2: float, alpha2: float, p2: np.ndarray, x: float, y: float
) -> float:
    """Squared Mahalanobis distance of two lines, normals pointing the same way, compared at (x, y)."""
    o1, b1, c1 = shift(rho1, alpha1, p1[0, 0], p1[0, 1], p1[1, 1], x, y)
    o2, b2, c2 = shift(rho2, alpha2, p2[0, 0], p2[0, 1], p2[1, 1], x, y)
    a, b, c = p1[0, 0] + p2[0, 0], b1 + b2, c1 + c2
    da, do = wrap(alpha1 - alpha2), o1 - o2
    det = a * c - b * b
    if det <= 0.0:
        return math.inf
    return (c * da * da - 2.0 * b * da * do + a * do * do) / det


@njit(cache=True)
def fuse(
    rho1: float, alpha1: float, p1: np.ndarray, rho2: float, alpha2: float, p2: np.ndarray, x: float, y: float
) -> tuple[float, float, np.ndarray]:
    """Information-form mean of two independent estimates of one line, worked out at (x, y).

    P = (P1^-1 + P2^-1)^-1, L = P (P1^-1 L1 + P2^-1 L2) = L1 + P1 (P1 + P2)^-1 (L2 - L1).
    """
    o1, b1, c1 = shift(rho1, alpha1, p1[0, 0], p1[0, 1], p1[1, 1], x, y)
    o2, b2, c2 = shift(rho2, alpha2, p2[0, 0], p2[0, 1], p2[1, 1], x, y)
    a1, a2 = p1[0, 0], p2[0, 0]
    a, b, c = a1 + a2, b1 + b2, c1 + c2
    det = a * c - b * b
    # gain P1 (P1 + P2)^-1
    g00, g01 = (a1 * c - b1 * b) / det, (b1 * a - a1 * b) / det
    g10, g11 = (b1 * c - c1 * b) / det, (c1 * a - b1 * b) / det
    da, do = wrap(alpha2 - alpha1), o2 - o1
    alpha = alpha1 + g00 * da + g01 * do
    offset = o1 + g10 * da + g11 * do
    # P = gain P2, symmetrised
    paa = g00 * a2 + g01 * b2
    par = 0.5 * (g00 * b2 + g01 * c2 + g10 * a2 + g11 * b2)
    prr = g10 * b2 + g11 * c2
    # back to the frame's own origin
    rho, par0, prr0 = shift(offset, alpha, paa, par, prr, -x, -y)
    out = np.empty((2, 2))
    out[0, 0] = paa
    out[0, 1] = out[1, 0] = par0
    out[1, 1] = prr0
    return rho, wrap(alpha), out
