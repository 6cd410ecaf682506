"""Range images: projection, residuals of past scans, labels from pixels back to points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarfw.types import Points, RangeImage, RangeView

_CHUNK = 8192  # points per chunk of range_knn: its vectors stay in the processor's cache


def _project(points: Points, view: RangeView) -> tuple[Tensor, Tensor]:
    """Flat pixel b*H*W + row*W + column (N,) int64, -1 outside the view, and range (N,) float32."""
    row, column, distance, inside = view.project(points.xyz.detach())
    pixel = (points.batch * view.height + row) * view.width + column
    return torch.where(inside, pixel, -1), distance.float()


def range_project(points: Points, view: RangeView) -> RangeImage:
    """Each pixel takes its nearest point; of equally near ones the first.

    The features (B, 1 + C, H, W) are the range in metres and the features of the point; 0 where there is none.

    One integer per point holds the bits of its range (positive floats sort as their bits do) above its number,
    so one scatter-minimum finds range and point together, in whatever order the points are visited.
    """
    pixel, distance = _project(points, view)
    pixels = points.batch_size * view.height * view.width
    key = (distance.view(torch.int32).long() << 32) | torch.arange(len(pixel), device=pixel.device)
    nearest = key.new_full((pixels + 1,), torch.iinfo(torch.int64).max)  # the last pixel takes what is outside
    nearest.scatter_reduce_(0, torch.where(pixel < 0, pixels, pixel), key, "amin")
    nearest = nearest[:pixels]
    mask = nearest != torch.iinfo(torch.int64).max
    values = torch.cat([points.xyz, points.xyz.norm(dim=1, keepdim=True), points.features], 1)
    image = values.new_zeros(pixels, values.shape[1])
    image = image.index_put((mask.nonzero().squeeze(1),), values[nearest[mask] & 0xFFFFFFFF])
    image = image.view(points.batch_size, view.height, view.width, -1).permute(0, 3, 1, 2)
    shape = (points.batch_size, view.height, view.width)
    return RangeImage(image[:, 3:].contiguous(), image[:, :3].contiguous(), mask.view(shape), pixel, view)


def residual_images(current: RangeImage, past: Sequence[Points]) -> Tensor:
    """(B, len(past), H, W) relative change of range |r - r_past| / r; 0 where a pixel has no point in one of both.

    Chen et al., "Moving Object Segmentation in 3D LiDAR Data" (RA-L 2021), equation 1. The past scans stand in
    the current sensor frame already.
    """
    now = current.xyz.norm(dim=1)
    before = torch.stack([_nearest_range(points, current.view) for points in past], 1)
    both = current.mask[:, None] & torch.isfinite(before)
    change = (now[:, None] - before).abs() / now[:, None].clamp(min=1e-6)
    return torch.where(both, change, 0)


def _nearest_range(points: Points, view: RangeView) -> Tensor:
    """(B, H, W) range of the nearest point in each pixel, inf where there is none."""
    pixel, distance = _project(points, view)
    pixels = points.batch_size * view.height * view.width
    nearest = distance.new_full((pixels + 1,), torch.inf)
    nearest.scatter_reduce_(0, torch.where(pixel < 0, pixels, pixel), distance, "amin")
    return nearest[:pixels].view(points.batch_size, view.height, view.width)


def range_knn(
    image: RangeImage,
    labels: Tensor,
    distance: Tensor,
    *,
    window: int = 5,
    neighbors: int = 5,
    cutoff: float = 1.0,
    sigma: float = 1.0,
) -> Tensor:
    """Label of every point (N,) int64 by a vote of the pixels around it, -1 outside the view.

    Milioto et al., "RangeNet++" (IROS 2019), section III-D: in a window round the point's pixel, the pixels
    whose range is nearest to that of the point, weighted against distance in the picture, vote; those farther
    than the cutoff do not. The window goes round the left and right border. Of classes with equally many votes
    the lowest wins.

    Args:
        labels: (B, H, W) int64 label of each pixel, >= 0.
        distance: (N,) range of each point in metres, in the order of `image.pixel`.
        window: odd width and height of the window in pixels, at most 15.
        cutoff: metres.
        sigma: of the weight 1 - gaussian(pixel offset), in pixels.
    """
    if window not in range(1, 16, 2):
        raise ValueError(f"range_knn: window must be odd and at most 15, got {window}")
    margin, (_, height, width) = window // 2, labels.shape
    weight = 1 - _gaussian(window, sigma, distance)
    weight[window * window // 2] = 0  # the point itself counts as lying in its pixel
    ranges = _surround(torch.where(image.mask, image.xyz.norm(dim=1), torch.inf), margin, torch.inf).flatten()
    votes = _surround(labels, margin, 0).flatten()
    line = torch.arange(window, device=labels.device)
    offsets = (line[:, None] * (width + 2 * margin) + line).flatten()
    result = torch.full_like(image.pixel, -1)
    inside = (image.pixel >= 0).nonzero().squeeze(1)
    row = torch.div(image.pixel, width, rounding_mode="floor")  # b * H + row
    corner = (row + torch.div(row, height, rounding_mode="floor") * 2 * margin) * (width + 2 * margin)
    corner = corner + image.pixel % width
    for chunk in inside.split(_CHUNK):  # type: ignore[no-untyped-call]
        place = corner[chunk] + offsets[:, None]
        apart = (ranges[place] - distance[chunk]).abs() * weight[:, None]
        apart[window * window // 2] = 0
        nearest = _smallest(apart, neighbors)
        result[chunk] = _majority(votes[place.gather(0, nearest)], apart.gather(0, nearest) <= cutoff)
    return result


def _gaussian(window: int, sigma: float, like: Tensor) -> Tensor:
    """(window^2,) gaussian of sum 1, row by row."""
    offset = torch.arange(window, device=like.device, dtype=like.dtype) - window // 2
    bell = torch.exp(-(offset[:, None] ** 2 + offset**2) / (2 * sigma**2))
    return (bell / bell.sum()).flatten()


def _surround(image: Tensor, margin: int, value: float) -> Tensor:
    """(B, H + 2 margin, W + 2 margin): columns go round, rows beyond the picture hold `value`."""
    turned = torch.cat([image[..., image.shape[-1] - margin :], image, image[..., :margin]], -1)
    return F.pad(turned, (0, 0, margin, margin), value=value)


def _smallest(values: Tensor, count: int) -> Tensor:
    """Rows (count, N) int64 of the smallest values >= 0 of every column of (K, N) float32, the first of equal ones.

    The bits of a float and its row in one integer: taking the minimum `count` times is many times as fast on
    a CPU as `topk` over short columns.
    """
    rows = torch.arange(len(values), device=values.device)[:, None]
    key = (values.float().contiguous().view(torch.int32).long() << 8) | rows
    best = []
    for _ in range(count):
        lowest = key.amin(0)
        best.append(lowest & 0xFF)
        key = torch.where(key == lowest, torch.iinfo(torch.int64).max, key)
    return torch.stack(best)


def _majority(labels: Tensor, counts: Tensor) -> Tensor:
    """(N,) most frequent of the labels (K, N) where `counts` (K, N) is True; the lowest of equally frequent ones."""
    votes = ((labels[:, None] == labels) & counts).sum(1) * counts
    order = (votes << 32) - labels
    return labels.gather(0, order.argmax(0, keepdim=True))[0]
