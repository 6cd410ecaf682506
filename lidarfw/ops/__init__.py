"""Operations on points, voxels and boxes: plain torch tensors, on CPU and GPU, vectorised and deterministic."""

from lidarfw.ops.cells import (
    CellAssignment,
    assign_cells,
    group_points,
    scatter_max,
    scatter_mean,
    scatter_sum,
    voxelize_mean,
)
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
    "from_dense",
    "group_points",
    "scatter_max",
    "scatter_mean",
    "scatter_sum",
    "to_dense",
    "voxelize_mean",
]
