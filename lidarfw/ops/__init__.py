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
    points_per_box,
)
from lidarfw.ops.cells import (
    CellAssignment,
    assign_cells,
    find_voxels,
    group_points,
    scatter_max,
    scatter_mean,
    scatter_sum,
    voxelize_mean,
)
from lidarfw.ops.neighbors import ball_query, farthest_points, knn, three_interpolate
from lidarfw.ops.nms import nms_circle, nms_rotated
from lidarfw.ops.pose import kabsch, ransac_pose, transform
from lidarfw.ops.range_image import range_knn, range_knn_mean, range_match, range_project, residual_images
from lidarfw.ops.sparse_conv import SparseConv3d, SparseInverseConv3d, SparseModule, SubmanifoldConv3d
from lidarfw.ops.sparse_layers import SparseAvgPool3d, SparseMaxPool3d, SparseSequential, from_dense, fuse, to_dense

__all__ = [
    "CellAssignment",
    "SparseAvgPool3d",
    "SparseConv3d",
    "SparseInverseConv3d",
    "SparseMaxPool3d",
    "SparseModule",
    "SparseSequential",
    "SubmanifoldConv3d",
    "assign_cells",
    "ball_query",
    "box_corners",
    "farthest_points",
    "find_voxels",
    "from_dense",
    "fuse",
    "giou_3d",
    "group_points",
    "iou_3d",
    "iou_bev",
    "kabsch",
    "knn",
    "nearest_bev_iou",
    "nms_circle",
    "nms_rotated",
    "paired_giou_3d",
    "paired_iou_3d",
    "paired_iou_bev",
    "points_in_boxes",
    "points_in_boxes_mask",
    "points_per_box",
    "range_knn",
    "range_knn_mean",
    "range_match",
    "range_project",
    "ransac_pose",
    "residual_images",
    "scatter_max",
    "scatter_mean",
    "scatter_sum",
    "three_interpolate",
    "to_dense",
    "transform",
    "voxelize_mean",
]
