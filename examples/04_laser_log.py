"""The line map of a laser log: a ROS bag, a CARMEN log, or arrays as here.

python examples/04_laser_log.py [LOG]
"""

import sys

import numpy as np

from polyexplore_gym.mapping import map_log, read_log, save_map

if len(sys.argv) > 1:
    log = read_log(sys.argv[1])
else:  # a wall at x = 4 m, seen while driving towards it
    angles = np.linspace(-np.pi / 2, np.pi / 2, 181)
    poses = np.array([[x, 0.0, 0.0] for x in (0.0, 0.5, 1.0)])
    rng = np.random.default_rng(0)
    ranges = np.array([(4.0 - x) / np.maximum(np.cos(angles), 1e-9) for x in poses[:, 0]])
    ranges += 0.01 * rng.standard_normal(ranges.shape)
    ranges[ranges > 10.0] = np.inf  # nothing met
    np.savez("wall.npz", angles=angles, ranges=ranges, poses=poses, max_range=10.0)
    log = read_log("wall.npz")

made = map_log(log)
print(f"{len(log)} scans, {len(made.points)} points, {made.rho.size} lines")
for k, (rho, alpha) in enumerate(zip(made.rho[:5], made.alpha[:5], strict=True)):
    deviation = np.sqrt(np.diag(made.covariance[k]))  # in the order alpha, rho
    print(f"  x cos({alpha:.4f}) + y sin({alpha:.4f}) = {rho:.3f} m, +- {deviation[0]:.4f} rad, {deviation[1]:.4f} m")
save_map(made, "walls.geojson")
