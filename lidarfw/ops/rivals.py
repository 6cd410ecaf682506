"""Other libraries' operations for `lidarfw bench ops`: used where they are installed, never required."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

from lidarfw.ops.boxes import box_corners
from lidarfw.types import Grid, Voxels

Module = Any  # the rivals have no types


def spconv_backbone(channels: tuple[int, ...], in_channels: int) -> nn.Module:
    """The layers of the `second` backbone in spconv; four stages of two submanifold layers, and the last fold."""
    spconv = importlib.import_module("spconv.pytorch")

    def block(layer: Module, width: int) -> list[nn.Module]:
        return [layer, nn.BatchNorm1d(width, eps=1e-3, momentum=0.01), nn.ReLU(inplace=True)]

    def stage(before: int, width: int, level: int) -> list[nn.Module]:
        layers = []
        if level:
            down = spconv.SparseConv3d(before, width, 3, 2, 1, bias=False, indice_key=f"down{level}")
            layers, before = block(down, width), width
        for _ in range(2):
            layers += block(spconv.SubMConv3d(before, width, 3, padding=1, bias=False, indice_key=f"at{level}"), width)
            before = width
        return layers

    widths = [in_channels, *channels]
    layers = [layer for level in range(4) for layer in stage(widths[level], widths[level + 1], level)]
    last = spconv.SparseConv3d(widths[4], widths[5], (3, 1, 1), (2, 1, 1), bias=False, indice_key="fold")
    return spconv.SparseSequential(*layers, *block(last, widths[5]))  # type: ignore[no-any-return]


def spconv_tensor(voxels: Voxels, features: Tensor | None = None) -> Module:
    spconv = importlib.import_module("spconv.pytorch")
    features = voxels.features if features is None else features
    return spconv.SparseConvTensor(features, voxels.index.int(), list(voxels.shape), voxels.batch_size)


@contextlib.contextmanager
def spconv_backward_on_cpu() -> Iterator[None]:
    """spconv asks for the current CUDA stream in its backward pass on a CPU too, and fails; here it gets none."""
    with mock.patch("torch.cuda.current_stream", return_value=mock.Mock(cuda_stream=0)):
        yield


def spconv_voxelizer(grid: Grid, points: Tensor, maximum: int = 5) -> Callable[[], Tensor]:
    """PointToVoxel of points (N, C) and the mean of the at most `maximum` points that it keeps of each voxel."""
    utils, bounds = importlib.import_module("spconv.pytorch.utils"), [*grid.lower, *grid.upper]
    voxelizer = utils.PointToVoxel(list(grid.cell), bounds, points.shape[1], len(points), maximum)

    def run() -> Tensor:
        voxels, _, counts = voxelizer(points)
        mean: Tensor = voxels.sum(1) / counts[:, None]
        return mean

    return run


def shapely_iou(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) exact BEV IoU."""
    shapely = importlib.import_module("shapely")
    left, right = (shapely.polygons(_corners(boxes)) for boxes in (a, b))
    common = shapely.area(shapely.intersection(left[:, None], right[None]))
    return torch.from_numpy(common / (shapely.area(left)[:, None] + shapely.area(right) - common))


def numba_iou(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) BEV IoU in float64, compiled."""
    boxes: Module = importlib.import_module("lidarfw.ops.numba_boxes")
    boxes.set_threads(torch.get_num_threads())
    return torch.from_numpy(boxes.matrix(_corners(a), _corners(b), a.double().numpy(), b.double().numpy()))


def numba_nms(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Rows that greedy suppression keeps, compiled."""
    order = torch.argsort(scores, descending=True, stable=True)
    boxes = boxes[order]
    keep = importlib.import_module("lidarfw.ops.numba_boxes").nms(_corners(boxes), boxes.double().numpy(), threshold)
    return order[torch.from_numpy(keep)]


def _corners(boxes: Tensor) -> Any:
    """(N, 4, 2) float64 corners in BEV, as an array."""
    return box_corners(boxes.double())[:, :4, :2].numpy()


def faiss_nearest(query: Tensor, reference: Tensor, count: int) -> Tensor:
    """(Q, count) rows of the nearest reference points by faiss, which compares all."""
    faiss: Module = importlib.import_module("faiss")
    faiss.omp_set_num_threads(torch.get_num_threads())
    index = faiss.IndexFlatL2(reference.shape[1])
    index.add(reference.numpy())
    return torch.from_numpy(index.search(query.numpy(), count)[1])
