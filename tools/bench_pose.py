"""Errors and time of the robust pose fit on made-up scene coordinates, beside other ways to the same pose.

    python tools/bench_pose.py [--scenes 20] [--pairs 1000]

1000 pairs within 50 m, 0.4 m of noise per axis, outliers 15 m off. `align_vectors` is scipy's weighted Kabsch on the
true inliers, which nobody knows: a floor, not a rival. Open3D's correspondence RANSAC runs where open3d is installed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from lidarfw.components.metrics.pose_error import pose_errors
from lidarfw.ops import ransac_pose, transform
from lidarfw.types import SceneCoords

THRESHOLD, NOISE, OFF = 1.2, 0.4, 15.0  # metres
Solver = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]  # source, world, inlier -> (4, 4)


def ours(source: torch.Tensor, world: torch.Tensor, inlier: torch.Tensor) -> torch.Tensor:
    """pose_ransac with its defaults."""
    batch = torch.zeros(len(source), dtype=torch.long)
    pairs = SceneCoords(source, world, torch.ones(len(source)), batch)
    return ransac_pose(pairs, threshold=THRESHOLD, shortest_edge=2.0).matrix[0]


def align_vectors(source: torch.Tensor, world: torch.Tensor, inlier: torch.Tensor) -> torch.Tensor:
    """scipy's least squares on the true inliers."""
    a, b = source[inlier].double().numpy(), world[inlier].double().numpy()
    turn = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))[0].as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, b.mean(0) - turn @ a.mean(0)
    return torch.from_numpy(matrix)


def open3d(source: torch.Tensor, world: torch.Tensor, inlier: torch.Tensor) -> torch.Tensor:
    """Open3D, with SGLoc's settings: 3 points, edges 0.9, 100 000 iterations, confidence 0.999."""
    import open3d as o3d

    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p.double().numpy())) for p in (source, world)]
    rows = o3d.utility.Vector2iVector(np.arange(len(source), dtype=np.int32)[:, None].repeat(2, 1))
    registration = o3d.pipelines.registration
    found = registration.registration_ransac_based_on_correspondence(
        *clouds, rows, THRESHOLD, registration.TransformationEstimationPointToPoint(False), 3,
        [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9)],
        registration.RANSACConvergenceCriteria(100_000, 0.999),
    )  # fmt: skip
    return torch.from_numpy(np.array(found.transformation))


def scene(seed: int, pairs: int, share: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Source, world, which pairs are right, and the true pose."""
    rng = np.random.default_rng(seed)
    truth = torch.eye(4, dtype=torch.float64)
    truth[:3, :3] = torch.from_numpy(Rotation.from_euler("zyx", [rng.uniform(-3, 3), 0.02, -0.03]).as_matrix())
    truth[:3, 3] = torch.from_numpy(rng.uniform(-200, 200, 3))
    source = torch.from_numpy(rng.uniform([-50, -50, -2], [50, 50, 6], (pairs, 3)))
    right = torch.from_numpy(rng.random(pairs) >= share)
    off = np.where(right.numpy()[:, None], rng.normal(0, NOISE, (pairs, 3)), rng.normal(0, OFF, (pairs, 3)))
    return source.float(), (transform(truth, source) + torch.from_numpy(off)).float(), right, truth


def measure(solver: Solver, pairs: int, share: float, scenes: int) -> tuple[float, float, float]:
    """Median metres, degrees and milliseconds."""
    errors, seconds = [], []
    for seed in range(scenes):
        *given, truth = scene(seed, pairs, share)
        begin = time.process_time()
        matrix = solver(*given)
        seconds.append(time.process_time() - begin)
        errors.append(pose_errors(matrix[None], truth[None])[0])
    metres, degrees = torch.stack(errors).median(0).values.tolist()
    return metres, degrees, 1000 * float(np.median(seconds))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--pairs", type=int, default=1000)
    args = parser.parse_args()
    torch.set_num_threads(1)
    solvers: dict[str, Solver] = {"pose_ransac": ours, "align_vectors on the true inliers": align_vectors}
    solvers |= {"Open3D RANSAC": open3d} if find_spec("open3d") else {}
    print("| outliers | solver | m | degrees | ms of processor time |\n|---|---|---|---|---|")
    for share in (0.3, 0.5, 0.7, 0.85, 0.95):
        for name, solver in solvers.items():
            metres, degrees, milliseconds = measure(solver, args.pairs, share, args.scenes)
            print(f"| {share:.0%} | {name} | {metres:.3f} | {degrees:.3f} | {milliseconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
