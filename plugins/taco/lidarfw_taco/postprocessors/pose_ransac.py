"""From scene coordinates to the pose of the scan."""

from __future__ import annotations

from lidarfw.interfaces import PostProcessor
from lidarfw.ops import ransac_pose
from lidarfw.types import Poses, SceneCoords, Spec


class PoseRansac(PostProcessor):
    """The pose that the most pairs of sensor and map coordinates agree on (TACO, section 4: RANSAC).

    `lidarfw.ops.ransac_pose` with values for scene coordinates on a lattice of 1.6 m: a pair is right within
    `threshold` metres, about three quarters of the pitch, and the sides of a triple are longer than `shortest_edge`.
    `confidence` is the share of right pairs; with fewer than `minimum_inliers` of them, or 1 %, `ok` is False.
    """

    def __init__(
        self,
        scene_coords: Spec,
        *,
        threshold: float = 1.2,
        hypotheses: int = 512,
        shortest_edge: float = 2.0,
        minimum_inliers: int = 6,
    ) -> None:
        super().__init__()
        self.options = {
            "threshold": threshold,
            "hypotheses": hypotheses,
            "shortest_edge": shortest_edge,
            "minimum_inliers": minimum_inliers,
        }
        self.provides = Spec(Poses)

    def forward(self, scene_coords: SceneCoords) -> Poses:
        """One pose per frame; it does not depend on the other frames of the batch."""
        pairs = scene_coords.map(lambda tensor: tensor.float() if tensor.is_floating_point() else tensor)
        return ransac_pose(pairs, **self.options)  # type: ignore[arg-type]
