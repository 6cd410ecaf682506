"""Sparse 3D features to a bird's-eye view by laying the z cells side by side in the channels.

Source: Yan et al., "SECOND: Sparsely Embedded Convolutional Detection", Sensors 2018, section 3.1.2.
"""

from __future__ import annotations

from lidarfw.interfaces import Neck
from lidarfw.ops import to_dense
from lidarfw.types import BEV, Spec, Voxels


class HeightCompression(Neck):
    """The z axis becomes channels (SECOND, Sensors 2018): Voxels with c channels, depth d -> BEV with c * d.

    Channel c * depth + z of the map is channel c of the voxel in cell z; empty cells are 0.
    """

    def __init__(self, voxels: Spec) -> None:
        super().__init__()
        self.provides = Spec(BEV, voxels.channels * voxels.depth, voxels.stride, voxels.geometry)

    def forward(self, voxels: Voxels) -> BEV:
        """The dense map (B, C * D, H, W)."""
        return BEV(to_dense(voxels).flatten(1, 2), voxels.grid, voxels.stride)
