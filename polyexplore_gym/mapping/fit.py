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
def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a b; for matrices of two and three rows quicker than BLAS."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            if a[i, k] != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += a[i, k] * b[k, j]
    return out


@njit(cache=True)
def by_pose(alpha: float, pose: np.ndarray) -> np.ndarray:
    """K of `to_map`: (2, 3) derivatives of a line (alpha, rho) in the map frame by the pose that it was seen from."""
    out = np.zeros((2, 3))
    c, s = math.cos(alpha), math.sin(alpha)
    out[0, 2], out[1, 0], out[1, 1], out[1, 2] = 1.0, c, s, pose[1] * c - pose[0] * s
    return out


@njit(cache=True)
def lever(alpha: float, x: float, y: float) -> np.ndarray:
    """(2, 2) from the errors (alpha, rho) of a line to those of (alpha, offset) in a frame moved to (x, y)."""
    out = np.eye(2)
    out[1, 0] = x * math.sin(alpha) - y * math.cos(alpha)
    return out


@njit(cache=True)
def difference(
    alpha1: float, p1: np.ndarray, alpha2: float, p2: np.ndarray, shared: np.ndarray, x: float, y: float
) -> np.ndarray:
    """Covariance of the difference of two lines at (x, y): P1 + P2 - X - X' with X = E[e1 e2']."""
    t1, t2 = lever(alpha1, x, y), lever(alpha2, x, y)
    cross = product(product(t1, shared), t2.T)
    return product(product(t1, p1), t1.T) + product(product(t2, p2), t2.T) - cross - cross.T


@njit(cache=True)
def distance2_shared(
    rho1: float, alpha1: float, p1: np.ndarray, rho2: float, alpha2: float, p2: np.ndarray, shared: np.ndarray,
    x: float, y: float,
) -> float:  # fmt: skip
    """As `distance2`, for lines whose errors have the covariance `shared` = E[e1 e2'] (2, 2)."""
    s = difference(alpha1, p1, alpha2, p2, shared, x, y)
    det = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
    if not (det > 0.0 and s[0, 0] > 0.0):
        return math.inf
    da = wrap(alpha1 - alpha2)
    do = rho1 - x * math.cos(alpha1) - y * math.sin(alpha1) - rho2 + x * math.cos(alpha2) + y * math.sin(alpha2)
    return (s[1, 1] * da * da - 2.0 * s[0, 1] * da * do + s[0, 0] * do * do) / det


@njit(cache=True)
def fuse(
    rho1: float, alpha1: float, p1: np.ndarray, rho2: float, alpha2: float, p2: np.ndarray, shared: np.ndarray,
    x: float, y: float,
) -> tuple[float, float, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """The mean of two estimates of one line with the least variance, worked out at (x, y).

    With X = E[e1 e2'] = `shared` (2, 2), S = P1 + P2 - X - X' and the gain G = (P1 - X) S^-1:
    L = L1 + G (L2 - L1), P = (I - G) P1 (I - G)' + G P2 G' + (I - G) X G' + G X' (I - G)'. Without X that is the
    information form P = (P1^-1 + P2^-1)^-1, L = P (P1^-1 L1 + P2^-1 L2).

    Returns rho, alpha, P, and what the error of the mean is made of: e = A e1 + B e2.
    """
    t1, t2 = lever(alpha1, x, y), lever(alpha2, x, y)
    q1, q2 = product(product(t1, p1), t1.T), product(product(t2, p2), t2.T)
    cross = product(product(t1, shared), t2.T)
    s = q1 + q2 - cross - cross.T
    det = s[0, 0] * s[1, 1] - s[0, 1] * s[1, 0]
    inverse = np.empty((2, 2))
    inverse[0, 0], inverse[0, 1], inverse[1, 0], inverse[1, 1] = s[1, 1], -s[0, 1], -s[1, 0], s[0, 0]
    gain = product(q1 - cross, inverse) / det
    da = wrap(alpha2 - alpha1)
    o1 = rho1 - x * math.cos(alpha1) - y * math.sin(alpha1)
    do = rho2 - x * math.cos(alpha2) - y * math.sin(alpha2) - o1
    alpha = alpha1 + gain[0, 0] * da + gain[0, 1] * do
    rho = o1 + gain[1, 0] * da + gain[1, 1] * do + x * math.cos(alpha) + y * math.sin(alpha)
    # back to the frame's own origin
    back = lever(alpha, x, y)
    back[1, 0] = -back[1, 0]
    a, b = product(back, product(np.eye(2) - gain, t1)), product(back, product(gain, t2))
    half = product(product(a, shared), b.T)
    p = product(product(a, p1), a.T) + product(product(b, p2), b.T) + half + half.T
    p[0, 1] = p[1, 0] = 0.5 * (p[0, 1] + p[1, 0])
    return rho, wrap(alpha), p, a, b
