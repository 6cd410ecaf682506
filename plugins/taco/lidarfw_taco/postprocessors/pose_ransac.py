"""From scene coordinates to the pose of the scan."""

from __future__ import annotations

import torch
from lidarfw.interfaces import PostProcessor
from lidarfw.ops import ransac_pose
from lidarfw.types import Grid, Points, Poses, SceneCoords, Spec

from lidarfw_taco.refinement import MapRefiner


class PoseRansac(PostProcessor):
    """The pose that the most pairs of sensor and map coordinates agree on (TACO, section 4: RANSAC).

    `lidarfw.ops.ransac_pose` with values for scene coordinates: a pair is right within `threshold` metres, by default
    three quarters of the pitch of the voxels (1.2 m for LiSA's 1.6 m, and where the pitch is not known), and the sides
    of a triple are longer than `shortest_edge`. `confidence` is the share of right pairs; with fewer than
    `minimum_inliers` of them, or 1 %, `ok` is False.

    With a `map`, a file of points in map coordinates, the scan is then registered to it (beyond the paper): both
    thinned to `map_cell` metres, points matched within `map_distance` metres. That needs `lidarfw-taco[refine]`.
    """

    def __init__(
        self,
        scene_coords: Spec,
        points: Spec,
        *,
        threshold: float | None = None,
        hypotheses: int = 512,
        shortest_edge: float = 2.0,
        minimum_inliers: int = 6,
        map: str = "",
        map_cell: float = 0.4,
        map_distance: float = 2.0,
    ) -> None:
        super().__init__()
        self.threshold = _usual(scene_coords) if threshold is None else threshold
        self.hypotheses = hypotheses
        self.shortest_edge, self.minimum_inliers = shortest_edge, minimum_inliers
        self.refiner = MapRefiner(map, map_cell, map_distance) if map else None
        self.provides = Spec(Poses)

    def forward(self, scene_coords: SceneCoords, points: Points) -> Poses:
        """One pose per frame; it does not depend on the other frames of the batch."""
        pairs = scene_coords.replace(source=scene_coords.source.float(), world=scene_coords.world.float())
        poses = ransac_pose(
            pairs,
            threshold=self.threshold,
            hypotheses=self.hypotheses,
            shortest_edge=self.shortest_edge,
            minimum_inliers=self.minimum_inliers,
        )
        return poses if self.refiner is None else self._refined(self.refiner, poses, points)

    def _refined(self, refiner: MapRefiner, poses: Poses, points: Points) -> Poses:
        matrix = poses.matrix.clone()
        for number in poses.ok.nonzero()[:, 0].tolist():
            scan = points.sample(number).xyz.detach().cpu().double().numpy()
            refined = refiner.refine(matrix[number].cpu().double().numpy(), scan)
            matrix[number] = torch.from_numpy(refined).to(matrix)
        return poses.replace(matrix=matrix)


def _usual(scene_coords: Spec) -> float:
    """Three quarters of the pitch of the cells that the pairs come from, metres."""
    if not isinstance(scene_coords.geometry, Grid):
        return 1.2
    return 0.75 * scene_coords.geometry.cell[0] * scene_coords.stride
