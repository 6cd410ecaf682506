"""Range images: projection, residuals of past scans, labels from pixels back to points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product

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


def residual_images(
    current: RangeImage,
    past: Sequence[Points],
    *,
    nearest: float = 0.0,
    farthest: float = float("inf"),
    signed: bool = False,
    search: int = 0,
) -> Tensor:
    """(B, len(past), H, W) relative change of range `abs(r - r_past) / r`; 0 where a pixel has no point in one of both.

    Chen et al., "Moving Object Segmentation in 3D LiDAR Data" (RA-L 2021), equation 1. The past scans stand in
    the current sensor frame already. Only ranges between `nearest` and `farthest` metres count, on both sides.
    `signed` gives `(r_past - r) / r`: positive where something has come in front of what was seen before. r_past is
    the one nearest to r within `search` pixels on every side: beams of two scans never meet the same point, and beside
    an edge, in leaves or at a grazing angle that alone changes the range from pixel to pixel.
    """
    now = _range_of(current)[:, None]
    before = torch.stack([_nearest_range(points, current.view) for points in past], 1)
    before = _closest(before, now, search)
    both = current.mask[:, None] & torch.isfinite(before)
    both &= (now > nearest) & (now < farthest) & (before > nearest) & (before < farthest)
    change = (before - now) / now.clamp(min=1e-6)
    return torch.where(both, change if signed else change.abs(), 0)


def _closest(ranges: Tensor, wanted: Tensor, search: int) -> Tensor:
    """(B, n, H, W) of the ranges around, the one nearest to the wanted (B, 1, H, W); columns go round."""
    height, width = ranges.shape[2:]
    around = _surround(ranges, search, torch.inf)
    best, least = ranges, (ranges - wanted).abs()
    for row, column in product(range(2 * search + 1), repeat=2):
        other = around[..., row : row + height, column : column + width]
        apart = (other - wanted).abs()
        best, least = torch.where(apart < least, other, best), torch.minimum(apart, least)
    return best


def _nearest_range(points: Points, view: RangeView) -> Tensor:
    """(B, H, W) range of the nearest point in each pixel, inf where there is none."""
    pixel, distance = _project(points, view)
    pixels = points.batch_size * view.height * view.width
    nearest = distance.new_full((pixels + 1,), torch.inf)
    nearest.scatter_reduce_(0, torch.where(pixel < 0, pixels, pixel), distance, "amin")
    return nearest[:pixels].view(points.batch_size, view.height, view.width)


def _range_of(image: RangeImage) -> Tensor:
    """(B, H, W) metres; on a CPU several times as fast as `norm`, which does not vectorise over planes."""
    return image.xyz.square().sum(1).sqrt_()


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
    result = torch.full_like(image.pixel, -1)
    votes = _surround(labels, window // 2, 0).flatten()
    for rows, place, apart in _neighbors(image, distance, window, neighbors, sigma):
        found = votes.index_select(0, place.view(-1)).view(place.shape)
        result.index_copy_(0, rows, _majority(found, apart <= cutoff))
    return result


def range_knn_mean(
    image: RangeImage,
    values: Tensor,
    distance: Tensor,
    *,
    window: int = 5,
    neighbors: int = 5,
    cutoff: float = 1.0,
    sigma: float = 1.0,
) -> Tensor:
    """Mean (N, C) of the values (B, C, H, W) of the pixels that `range_knn` lets vote on each point.

    Probabilities of classes stay probabilities. The pixel of the point itself always counts; points outside the view
    get 0. Arguments as of `range_knn`.
    """
    margin = window // 2
    table = _surround(values.movedim(1, 0), margin, 0.0).flatten(1)  # (C, pixels)
    result = values.new_zeros(len(image.pixel), values.shape[1])
    for rows, place, apart in _neighbors(image, distance, window, neighbors, sigma):
        near = (apart <= cutoff).to(values.dtype)
        total = near.sum(0)
        means = [(row.index_select(0, place.view(-1)).view(place.shape) * near).sum(0) / total for row in table]
        result.index_copy_(0, rows, torch.stack(means, 1))
    return result


def range_match(image: RangeImage, xyz: Tensor, reach: float, *, window: int = 5) -> Tensor:
    """Flat pixel (N,) int64 of `image` whose range is nearest to that of each point (N, 3) of one sample, -1 for none.

    Searched is the window round the pixel that the point falls into, going round the left and right border; of
    equally near ranges the pixel nearest to the middle wins. Ranges more than `reach` metres apart do not match.
    """
    view = image.view
    pixel, distance = _project(Points.from_scan(xyz, xyz[:, :0]), view)
    asked = RangeImage(image.features, image.xyz, image.mask, pixel, view)
    result = torch.full_like(pixel, -1)
    margin, width = window // 2, view.width + window // 2 * 2
    for rows, place, apart in _neighbors(asked, distance, window, 1, 0.0):
        row, column = torch.div(place[0], width, rounding_mode="floor") - margin, place[0] % width - margin
        flat = row * view.width + column % view.width
        result.index_copy_(0, rows, torch.where(apart[0] <= reach, flat, -1).long())
    return result


def _neighbors(
    image: RangeImage, distance: Tensor, window: int, count: int, sigma: float
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """In chunks of points inside the view: their rows (n,), and of the `count` pixels of the window nearest in range
    their places (count, n) in the surrounded picture and weighted distances (count, n), inf for empty ones.

    With `sigma` 0 distances in the picture have no weight and the pixel of the point is one like the others.
    """
    if window not in range(1, 16, 2):
        raise ValueError(f"range_knn: window must be odd and at most 15, got {window}")
    _, height, columns = image.mask.shape
    margin, width = window // 2, columns + window // 2 * 2
    ranges = _surround(torch.where(image.mask, _range_of(image), torch.inf), margin, torch.inf).flatten()
    line = torch.arange(window, dtype=torch.int32, device=ranges.device)
    offsets = (line[:, None] * width + line).flatten()
    weights = [1.0] * window**2
    if sigma:
        weights = (1 - _gaussian(window, sigma, distance)).tolist()
        weights[window * window // 2] = 0.0  # the point itself counts as lying in its pixel
    else:
        middle = line - margin
        order = (middle[:, None] ** 2 + middle**2).flatten().argsort(stable=True)
        offsets = offsets[order]
    inside = (image.pixel >= 0).nonzero().squeeze(1)
    corners = _corners(image.pixel[inside], height, columns, margin)
    for rows, corner in zip(inside.split(_CHUNK), corners.split(_CHUNK), strict=True):  # type: ignore[no-untyped-call]
        near, apart = _nearest(ranges, corner, offsets.tolist(), distance[rows], weights, count)
        yield rows, corner + offsets[near], apart


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
    votes = counts.to(torch.uint8)
    for one, other in combinations(range(len(labels)), 2):
        same = (labels[one] == labels[other]) & counts[one] & counts[other]
        votes[one] += same
        votes[other] += same
    order = (votes.long() << 32) - labels  # one maximum finds the most votes and the lowest label
    return -order.amax(0) & 0xFFFFFFFF
