"""From scene coordinates to the pose of the scan."""

from __future__ import annotations

import torch
from lidarfw.interfaces import PostProcessor
from lidarfw.ops import ransac_pose
from lidarfw.types import Points, Poses, SceneCoords, Spec

from lidarfw_taco.refinement import MapRefiner


class PoseRansac(PostProcessor):
    """The pose that the most pairs of sensor and map coordinates agree on (TACO, section 4: RANSAC).

    `lidarfw.ops.ransac_pose` with values for scene coordinates on a lattice of 1.6 m: a pair is right within
    `threshold` metres, about three quarters of the pitch, and the sides of a triple are longer than `shortest_edge`.
    `confidence` is the share of right pairs; with fewer than `minimum_inliers` of them, or 1 %, `ok` is False.

    With a `map`, a file of points in map coordinates, the scan is then registered to it (beyond the paper): both
    thinned to `map_cell` metres, points matched within `map_distance` metres. That needs `lidarfw-taco[refine]`.
    """

    def __init__(
        self,
        scene_coords: Spec,
        points: Spec,
        *,
        threshold: float = 1.2,
        hypotheses: int = 512,
        shortest_edge: float = 2.0,
        minimum_inliers: int = 6,
        map: str = "",
        map_cell: float = 0.4,
        map_distance: float = 2.0,
    ) -> None:
        super().__init__()
        self.threshold, self.hypotheses = threshold, hypotheses
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
