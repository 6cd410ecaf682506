"""Other libraries' operations for `lidarfw bench ops`: used where they are installed, never required."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor, nn

from lidarfw.ops.boxes import box_corners
from lidarfw.types import Grid, Voxels

Module = Any  # spconv and numba have no types


def installed(name: str) -> bool:
    return find_spec(name) is not None


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
    left, right = (shapely.polygons(box_corners(boxes.double())[:, :4, :2].numpy()) for boxes in (a, b))
    common = shapely.area(shapely.intersection(left[:, None], right[None]))
    return torch.from_numpy(common / (shapely.area(left)[:, None] + shapely.area(right) - common))


def numba_functions() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiled BEV IoU (N, M) with circle prefilter, and greedy NMS on it: polygon clipping, one pair at a time."""
    numba: Module = importlib.import_module("numba")
    numba.config.THREADING_LAYER = "workqueue"  # its OpenMP layer would change the number of threads of torch
    compiled: Callable[[Any], Any] = numba.njit
    parallel: Callable[[Any], Any] = numba.njit(parallel=True)

    @compiled
    def overlap(p: Any, q: Any) -> Any:
        points = np.empty((24, 2))
        clipped = np.empty((24, 2))
        points[:4] = p
        count = 4
        for edge in range(4):
            x0, y0 = q[edge, 0], q[edge, 1]
            dx, dy = q[(edge + 1) % 4, 0] - x0, q[(edge + 1) % 4, 1] - y0
            kept = 0
            for i in range(count):
                x, y = points[i, 0], points[i, 1]
                u, v = points[(i + 1) % count, 0], points[(i + 1) % count, 1]
                here, there = dx * (y - y0) - dy * (x - x0), dx * (v - y0) - dy * (u - x0)
                if here >= 0:
                    clipped[kept, 0], clipped[kept, 1] = x, y
                    kept += 1
                if here * there < 0:
                    t = here / (here - there)
                    clipped[kept, 0], clipped[kept, 1] = x + t * (u - x), y + t * (v - y)
                    kept += 1
            count = kept
            points[:count] = clipped[:count]
        area = 0.0
        for i in range(count):
            j = (i + 1) % count
            area += points[i, 0] * points[j, 1] - points[j, 0] * points[i, 1]
        return area / 2

    @compiled
    def iou(p: Any, q: Any, a: Any, b: Any, i: int, j: int) -> Any:
        reach = (np.sqrt(a[i, 3] ** 2 + a[i, 4] ** 2) + np.sqrt(b[j, 3] ** 2 + b[j, 4] ** 2)) / 2
        if (a[i, 0] - b[j, 0]) ** 2 + (a[i, 1] - b[j, 1]) ** 2 >= reach * reach:
            return 0.0
        common = overlap(p[i] - b[j, :2], q[j] - b[j, :2])
        return common / (a[i, 3] * a[i, 4] + b[j, 3] * b[j, 4] - common)

    @parallel
    def matrix(p: Any, q: Any, a: Any, b: Any) -> Any:
        result = np.zeros((len(a), len(b)))
        for i in numba.prange(len(a)):
            for j in range(len(b)):
                result[i, j] = iou(p, q, a, b, i, j)
        return result

    @compiled
    def nms(p: Any, a: Any, threshold: float) -> Any:
        dropped = np.zeros(len(a), np.bool_)
        for i in range(len(a)):
            for j in range(i + 1, len(a)):
                if not dropped[i] and not dropped[j] and iou(p, p, a, a, i, j) > threshold:
                    dropped[j] = True
        return ~dropped

    def corners(boxes: Tensor) -> Any:
        return box_corners(boxes.double())[:, :4, :2].numpy()

    def run_matrix(a: Tensor, b: Tensor) -> Any:
        numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
        return matrix(corners(a), corners(b), a.double().numpy(), b.double().numpy())

    def run_nms(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
        order = torch.argsort(scores, descending=True, stable=True)
        boxes = boxes[order]
        return order[torch.from_numpy(nms(corners(boxes), boxes.double().numpy(), threshold))]

    return run_matrix, run_nms
