"""The operations as one would write them first: the yardstick of `lidarfw bench ops`, and an oracle for tests."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from lidarfw.ops.boxes import iou_bev
from lidarfw.ops.pose import kabsch
from lidarfw.ops.rulebook import Rulebook
from lidarfw.types import Grid, Points, RangeImage, RangeView


def convolve(
    features: Tensor, weight: Tensor, book: Rulebook, bias: Tensor | None = None, rectify: bool = False
) -> Tensor:
    """Sparse convolution element by element: gather, multiply, `index_add_`."""
    output = features.new_zeros(book.num_outputs, weight.shape[2])
    for element, (inputs, outputs) in book.by_element().items():
        output.index_add_(0, outputs.long(), features[inputs.long()] @ weight[element])
    output = output + features @ weight[book.volume // 2] if book.symmetric else output
    output = output if bias is None else output + bias
    return output.relu() if rectify else output


def voxelize_mean(points: Points, grid: Grid) -> tuple[Tensor, Tensor]:
    """Cells (V, 4) b, z, y, x and means (V, 3 + C) by `torch.unique` over rows and `index_add_`."""
    cell, inside = grid.index(points.xyz)
    index = torch.cat([points.batch[:, None], cell], 1)[inside]
    unique, inverse, counts = torch.unique(index, dim=0, return_inverse=True, return_counts=True)
    features = torch.cat([points.xyz, points.features], 1)[inside]
    return unique, features.new_zeros(len(unique), features.shape[1]).index_add_(0, inverse, features) / counts[:, None]


def nms(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Greedy suppression, one box after another, from all overlaps."""
    order = torch.argsort(scores, descending=True, stable=True)
    overlaps, dropped, kept = iou_bev(boxes[order], boxes[order]), torch.zeros(len(order), dtype=torch.bool), []
    for row in range(len(order)):
        if not dropped[row]:
            kept.append(row)
            dropped |= overlaps[row] > threshold
    return order[kept]


def range_project(xyz: NDArray[np.float32], features: NDArray[np.float32], view: RangeView) -> NDArray[np.float32]:
    """(H, W, 4 + C) range, x, y, z and features by sorting all points from far to near, in numpy."""
    distance = np.linalg.norm(xyz, axis=1)
    elevation, azimuth = np.arctan2(xyz[:, 2], np.linalg.norm(xyz[:, :2], axis=1)), np.arctan2(xyz[:, 1], xyz[:, 0])
    row = np.floor((view.up - elevation) / (view.up - view.down) * view.height)
    column = np.floor((1 - azimuth / np.pi) * (view.width / 2)) % view.width
    inside = (row >= 0) & (row < view.height) & (distance > 0)
    order = np.argsort(distance, kind="stable")[::-1]
    order = order[inside[order]]
    values = np.concatenate([distance[:, None], xyz, features], 1)
    image = np.zeros((view.height, view.width, values.shape[1]), np.float32)
    image[row[order].astype(int), column[order].astype(int)] = values[order]
    return image


def range_knn(image: RangeImage, labels: Tensor, distance: Tensor, window: int = 5, neighbors: int = 5) -> Tensor:
    """The label vote of `lidarfw.ops.range_knn` with `unfold` and `topk` over all pixels; one sample, sigma 1 m."""
    margin = window // 2
    offset = torch.arange(window) - margin
    bell = torch.exp(-(offset[:, None] ** 2 + offset**2) / 2).flatten()
    weight = 1 - bell / bell.sum()
    ranges = torch.where(image.mask, image.xyz.square().sum(1).sqrt(), torch.inf)
    ranges, labels_ = (F.pad(t.float()[:, None], (margin, margin, 0, 0), "circular") for t in (ranges, labels))
    ranges, labels_ = F.pad(ranges, (0, 0, margin, margin), value=torch.inf), F.pad(labels_, (0, 0, margin, margin))
    points = image.pixel >= 0
    pixel = image.pixel[points]
    apart = (F.unfold(ranges, window)[0][:, pixel] - distance[points]).abs() * weight[:, None]
    apart[window * window // 2] = 0
    apart, nearest = apart.topk(neighbors, dim=0, largest=False)
    near = F.unfold(labels_, window)[0][:, pixel].gather(0, nearest).long()
    classes = int(labels.max()) + 1
    near[apart > 1.0] = classes
    votes = torch.zeros(classes + 1, near.shape[1]).scatter_add_(0, near, torch.ones_like(apart))
    result = torch.full_like(image.pixel, -1)
    result[points] = votes[:classes].argmax(0)
    return result


def farthest_points(xyz: Tensor, count: int) -> Tensor:
    """(count,) rows of one sample, distances to all chosen points anew at each step."""
    chosen = [0]
    while len(chosen) < count:
        chosen.append(int(torch.cdist(xyz, xyz[chosen]).amin(1).argmax()))
    return torch.tensor(chosen)


def nearest(query: Tensor, reference: Tensor, count: int) -> Tensor:
    """(Q, count) rows of the nearest reference points, from all distances."""
    return torch.cdist(query, reference).topk(count, largest=False).indices


def best_pose(source: Tensor, world: Tensor, triples: Tensor, threshold: float) -> Tensor:
    """(4, 4) best by MSAC score of the poses fitted to the triples (H, 3), one hypothesis after another."""
    best, lowest = torch.eye(4), torch.inf
    for triple in triples:
        matrix = kabsch(source[triple], world[triple])
        apart = (source @ matrix[:3, :3].T + matrix[:3, 3] - world).square().sum(1)
        score = float(apart.clamp(max=threshold**2).sum())
        best, lowest = (matrix, score) if score < lowest else (best, lowest)
    return best
