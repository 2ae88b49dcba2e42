"""Writes bop_points.csv and bop_errors.csv: pose errors as the BOP toolkit computes them.

Usage: python make_bop_errors.py PATH_OF_BOP_TOOLKIT     (see README.md for versions)
"""

import csv
import pathlib
import sys

import numpy as np
import scipy

sys.path.insert(0, sys.argv[1])
from bop_toolkit_lib import pose_error  # noqa: E402

HERE = pathlib.Path(__file__).parent
rng = np.random.default_rng(20230618)


def rotation(axis, angle):
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def models():
    """Points of three objects, metres: a can (symmetric), the faces of a box, and a blob without symmetry."""
    turn, height = np.meshgrid(np.arange(24) * np.pi / 12, np.linspace(-0.05, 0.05, 9))
    can = np.stack([0.033 * np.cos(turn), 0.033 * np.sin(turn), height], -1).reshape(-1, 3)
    face = rng.uniform(-1, 1, (150, 3))
    face[np.arange(150), rng.integers(0, 3, 150)] = rng.choice([-1, 1], 150)
    box = face * [0.08, 0.03, 0.105]
    blob = rng.normal(0, 0.04, (120, 3)) + [0.02, -0.01, 0.005]
    return [np.round(points, 6) for points in (can, box, blob)]


def main():
    objects = models()
    with open(HERE / "bop_points.csv", "w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["object", "x", "y", "z"])
        for i, points in enumerate(objects):
            out.writerows([i, *point] for point in points.tolist())

    names = [f"{kind}_{name}" for kind in ("est", "gt") for name in
             [f"r{i}{j}" for i in range(3) for j in range(3)] + ["tx", "ty", "tz"]]
    with open(HERE / "bop_errors.csv", "w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["object", *names, "add_m", "adi_m", "re_deg", "te_m"])
        for i, points in enumerate(objects):
            for case in range(30):
                gt_r = rotation(rng.normal(size=3), rng.uniform(0.1, 3.0))
                gt_t = rng.uniform([-0.3, -0.2, 0.4], [0.3, 0.2, 1.5])
                # A third each: a good tracker's errors, a bad one's, and a pose that has nothing to do with it.
                angle, shift = [(0.02, 0.003), (0.4, 0.03), (3.0, 0.5)][case % 3]
                est_r = gt_r @ rotation(rng.normal(size=3), angle * rng.uniform(0.5, 1.0))
                est_t = gt_t + rng.normal(size=3) * shift
                pair = (est_r, est_t.reshape(3, 1), gt_r, gt_t.reshape(3, 1))
                out.writerow([i, *est_r.ravel().tolist(), *est_t.tolist(), *gt_r.ravel().tolist(), *gt_t.tolist(),
                              float(pose_error.add(*pair, points)), float(pose_error.adi(*pair, points)),
                              pose_error.re(est_r, gt_r), float(pose_error.te(pair[1], pair[3]))])
    print("numpy", np.__version__, "scipy", scipy.__version__)


main()
