"""Range images: projection, residuals of past scans, labels from pixels back to points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarfw.types import Points, RangeImage, RangeView

_CHUNK = 2**16  # points at a time: enough for several threads, few enough for the cache


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
    values = F.pad(torch.cat([points.xyz.t(), distance.to(points.xyz)[None], points.features.t()]), (0, 1))
    image = values.index_select(1, torch.where(mask, nearest & 0xFFFFFFFF, len(pixel)))  # the last column is 0
    shape = (points.batch_size, view.height, view.width)
    image = image.view(-1, *shape).transpose(0, 1).contiguous()
    return RangeImage(image[:, 3:], image[:, :3], mask.view(shape), pixel, view)


def residual_images(current: RangeImage, past: Sequence[Points]) -> Tensor:
    """(B, len(past), H, W) relative change of range `abs(r - r_past) / r`; 0 where a pixel has no point in one of both.

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
    margin, width = window // 2, labels.shape[2] + window // 2 * 2
    ranges = _surround(torch.where(image.mask, image.xyz.norm(dim=1), torch.inf), margin, torch.inf).flatten()
    votes = _surround(labels, margin, 0).flatten()
    line = torch.arange(window, dtype=torch.int32, device=labels.device)
    offsets = (line[:, None] * width + line).flatten()
    weights = (1 - _gaussian(window, sigma, distance)).tolist()
    weights[window * window // 2] = 0.0  # the point itself counts as lying in its pixel
    result = torch.full_like(image.pixel, -1)
    inside = (image.pixel >= 0).nonzero().squeeze(1)
    corners = _corners(image.pixel[inside], labels.shape[1], labels.shape[2], margin)
    for rows, corner in zip(inside.split(_CHUNK), corners.split(_CHUNK), strict=True):  # type: ignore[no-untyped-call]
        near, apart = _nearest(ranges, corner, offsets.tolist(), distance[rows], weights, neighbors)
        place = corner + offsets[near]
        found = votes.index_select(0, place.view(-1)).view(place.shape)
        result.index_copy_(0, rows, _majority(found, apart <= cutoff))
    return result


def _corners(pixel: Tensor, height: int, width: int, margin: int) -> Tensor:
    """(N,) int32 place, in the surrounded picture, of the first pixel of the window round each pixel."""
    row = torch.div(pixel, width, rounding_mode="floor")  # b * H + row
    padded = row + torch.div(row, height, rounding_mode="floor") * 2 * margin
    return (padded * (width + 2 * margin) + pixel - row * width).int()


def _nearest(
    ranges: Tensor, corner: Tensor, offsets: list[int], distance: Tensor, weights: list[float], count: int
) -> tuple[Tensor, Tensor]:
    """Number in the window (count, N) int64 and weighted distance (count, N) of the nearest pixels.

    The bits of a distance above its number in one integer, so a minimum carries both; each pixel of the window
    sinks into a sorted list of `count`. On a CPU that is several times as fast as `topk` over short columns.
    """
    best: list[Tensor] = []
    for number, (offset, weight) in enumerate(zip(offsets, weights, strict=True)):
        apart = ranges.index_select(0, corner + offset).sub_(distance).abs_()
        apart = apart.mul_(weight) if weight else apart.zero_()  # no 0 * inf
        key = apart.float().view(torch.int32).long().bitwise_left_shift_(8).bitwise_or_(number)
        for place, other in enumerate(best):
            best[place], key = torch.minimum(other, key), torch.maximum(other, key)
        best = [*best, key] if len(best) < count else best
    keys = torch.stack(best)
    return keys & 0xFF, (keys >> 8).int().view(torch.float32)


def _gaussian(window: int, sigma: float, like: Tensor) -> Tensor:
    """(window^2,) gaussian of sum 1, row by row."""
    offset = torch.arange(window, device=like.device, dtype=like.dtype) - window // 2
    bell = torch.exp(-(offset[:, None] ** 2 + offset**2) / (2 * sigma**2))
    return (bell / bell.sum()).flatten()


def _surround(image: Tensor, margin: int, value: float) -> Tensor:
    """(B, H + 2 margin, W + 2 margin): columns go round, rows beyond the picture hold `value`."""
    turned = torch.cat([image[..., image.shape[-1] - margin :], image, image[..., :margin]], -1)
    return F.pad(turned, (0, 0, margin, margin), value=value)


def _majority(labels: Tensor, counts: Tensor) -> Tensor:
    """(N,) most frequent of the labels (K, N) where `counts` (K, N) is True; the lowest of equally frequent ones."""
    votes = ((labels[:, None] == labels) & counts).sum(1) * counts
    order = (votes << 32) - labels
    return labels.gather(0, order.argmax(0, keepdim=True))[0]
