"""Operations on points, voxels and boxes: plain torch tensors, on CPU and GPU, vectorised and deterministic."""

from lidarfw.ops.boxes import (
    box_corners,
    giou_3d,
    iou_3d,
    iou_bev,
    nearest_bev_iou,
    paired_giou_3d,
    paired_iou_3d,
    paired_iou_bev,
    points_in_boxes,
    points_in_boxes_mask,
)
from lidarfw.ops.cells import (
    CellAssignment,
    assign_cells,
    group_points,
    scatter_max,
    scatter_mean,
    scatter_sum,
    voxelize_mean,
)
from lidarfw.ops.nms import nms_circle, nms_rotated
from lidarfw.ops.sparse_conv import (
    SparseAvgPool3d,
    SparseConv3d,
    SparseInverseConv3d,
    SparseMaxPool3d,
    SparseSequential,
    SubmanifoldConv3d,
    from_dense,
    to_dense,
)

__all__ = [
    "CellAssignment",
    "SparseAvgPool3d",
    "SparseConv3d",
    "SparseInverseConv3d",
    "SparseMaxPool3d",
    "SparseSequential",
    "SubmanifoldConv3d",
    "assign_cells",
    "box_corners",
    "from_dense",
    "giou_3d",
    "group_points",
    "iou_3d",
    "iou_bev",
    "nearest_bev_iou",
    "nms_circle",
    "nms_rotated",
    "paired_giou_3d",
    "paired_iou_3d",
    "paired_iou_bev",
    "points_in_boxes",
    "points_in_boxes_mask",
    "scatter_max",
    "scatter_mean",
    "scatter_sum",
    "to_dense",
    "voxelize_mean",
]
