"""From scans to range images, residual images and distance maps, on a worker of the loader.

Source: Tang, Zhu and Sun, Remote Sensing 2025, 17(2), 195, equations 1-3 and 13-18. Augmentations come before these
transforms in the list: they move the points of all scans of a frame alike, so that past and current scan stay
comparable.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError
from lidarfw.interfaces.data import Transform
from lidarfw.types import Boxes, DataSpec, Frame, PointLabels, Points, RangeImage, RangeView, Spec, Tracks

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")

IMAGE = "range"  # name of the input that `range_projection` adds
FOV_POLICIES = ("clip", "drop")
_STRIDE = 16  # of the coarsest map of the paper's network


class DropFeatures(Transform):
    """Points without their features (remission, intensity): for networks that meet sensors other than their own.

    What a surface sends back differs from sensor to sensor and from a simulation to the world far more than where it
    is. Stands before `range_projection`, which then makes an image of the range alone.
    """

    def __init__(self) -> None:
        pass

    def spec(self, data: DataSpec) -> DataSpec:
        """With points that have no features. ConfigError without points."""
        _points_spec(data, "drop_features")
        return DataSpec({**data.inputs, "points": Spec(Points, 0)}, data.targets, data.classes, data.sweeps)

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with points (N, 0 features)."""
        points: Points = frame.inputs["points"]
        return frame.replace(inputs={**frame.inputs, "points": points.replace(features=points.features[:, :0])})


class RangeProjection(Transform):
    """Adds the input `range`: the current scan as a range image of the range and the features of the points (eq. 1).

    The nearest point of a pixel counts. The paper prints the row with + f_up; the row here is the one that its code
    base and all others use, measured from f_up downwards. Of a frame of several scans only the current one is
    projected; the points of the past ones have no pixel (-1).
    """

    def __init__(
        self,
        *,
        height: int = 64,
        width: int = 2048,
        up_degrees: float = 3.0,
        down_degrees: float = -25.0,
        fov_policy: str = "clip",
    ) -> None:
        """Options: pixels, elevation of the upper and lower edge; what becomes of points above and below them: clip
        (into the first and last row) or drop (no pixel)."""
        if fov_policy not in FOV_POLICIES:
            raise ConfigError(f"range_projection.fov_policy is {fov_policy!r}.\n  there are: {', '.join(FOV_POLICIES)}")
        up, down = math.radians(up_degrees), math.radians(down_degrees)
        self.view = RangeView(height, width, up, down, clip=fov_policy == "clip")

    def spec(self, data: DataSpec) -> DataSpec:
        """With the range image."""
        image = Spec(RangeImage, 1 + _points_spec(data, "range_projection").channels, 1, self.view)
        return DataSpec({**data.inputs, IMAGE: image}, data.targets, data.classes, data.sweeps)

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with its range image."""
        from lidarfw.ops import range_project

        points: Points = frame.inputs["points"]
        current = _current(points)
        image = range_project(points[current], self.view)
        pixel = torch.full_like(points.batch, -1).index_copy(0, current.nonzero()[:, 0], image.pixel)
        return frame.replace(inputs={**frame.inputs, IMAGE: image.replace(pixel=pixel)})


class ResidualImages(Transform):
    """Appends to the range image how the range of each pixel changed since past scans (eq. 2, 3), most recent first.

    d = |r - r_past| / r where both ranges lie between `min_range` and `max_range`, else 0, and at most `limit`. The
    dataset's `sweeps` give the past scans, in the current frame. Where a sequence has no scan so long ago, or a gap
    longer than `max_gap` lies before it, the residual is 0. Afterwards the frame has the current scan only, in its
    points and their labels too.
    """

    follows = ("range_projection",)

    def __init__(
        self,
        *,
        count: int = 2,
        stride: int = 1,
        min_range: float = 2.0,
        max_range: float = 50.0,
        limit: float = 5.0,
        signed: bool = False,
        search: int = 0,
        max_gap: float = 0.5,
    ) -> None:
        """Options: how many residual images, and every how manieth past scan they compare with; ranges in metres;
        signed: (r_past - r) / r instead, which tells what appeared from what went away; search: r_past is the nearest
        to r of the pixels so far around (0: the paper's, the same pixel); max_gap in seconds."""
        if count < 0 or stride < 1 or search < 0:
            raise ConfigError(
                f"residual_images: expected count >= 0, stride >= 1 and search >= 0, found {count}, {stride}, {search}"
            )
        if not 0 <= min_range < max_range:
            raise ConfigError(f"residual_images: expected 0 <= min_range < max_range, found {min_range}, {max_range}")
        self.count, self.stride, self.limit, self.signed, self.max_gap = count, stride, limit, signed, max_gap
        self.min_range, self.max_range, self.search = min_range, max_range, search

    def spec(self, data: DataSpec) -> DataSpec:
        """With `count` more features. ConfigError without a range image, or with too few scans per frame."""
        if IMAGE not in data.inputs:
            raise ConfigError(
                "residual_images needs the range image of range_projection.\n"
                "  fix: transform=[...,range_projection,residual_images], in this order"
            )
        if data.sweeps < self.count * self.stride + 1:
            raise ConfigError(
                f"residual_images: {self.count} residual images, {self.stride} scans apart, need "
                f"{self.count * self.stride + 1} scans per frame, the dataset gives {data.sweeps}.\n"
                f"  fix: dataset.NAME.sweeps={self.count * self.stride + 1}"
            )
        image = data.inputs[IMAGE]
        grown = Spec(RangeImage, image.channels + self.count, 1, image.geometry)
        return DataSpec({**data.inputs, IMAGE: grown}, data.targets, data.classes, data.sweeps)

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with residuals, and without the points of past scans."""
        points: Points = frame.inputs["points"]
        image: RangeImage = frame.inputs[IMAGE]
        features = torch.cat([image.features, self.residuals(image, points)], 1)
        current = _current(points)
        kept = image.replace(features=features, pixel=image.pixel[current])
        labels: PointLabels | None = frame.targets.points
        targets = frame.targets.replace(points=None if labels is None else labels[current])
        return frame.replace(inputs={**frame.inputs, "points": points[current], IMAGE: kept}, targets=targets)

    def residuals(self, image: RangeImage, points: Points) -> Tensor:
        """(1, count, H, W) of the past scans among the points."""
        from lidarfw.ops import residual_images

        height, width = image.mask.shape[1:]
        result = image.features.new_zeros(1, self.count, height, width)
        past = self._past(points)
        if past:
            found = residual_images(
                image, past, nearest=self.min_range, farthest=self.max_range, signed=self.signed, search=self.search
            )
            result[:, : len(past)] = found.clamp(-self.limit, self.limit)
        return result

    def _past(self, points: Points) -> list[Points]:
        """The past scans that there are, `stride` apart, most recent first."""
        if points.time is None:
            return []
        times = torch.unique(torch.unique_consecutive(points.time)).flip(0)  # scan after scan: much faster
        joined = (-times.diff() <= self.max_gap).cumprod(0)
        reach = 1 + int(joined.sum())
        chosen = times[: min(reach, self.count * self.stride + 1) : self.stride][1:]
        return [points[points.time == time] for time in chosen]


class EdgeDistance(Transform):
    """Adds what the edge term of `edge_aware` learns from: signed distances to the edge of each labelled class.

    In pixels of the range image, negative inside, round the full turn (see `distance.signed_distance`): of the second
    class where there are two (static, moving), else of every class. Made here, after augmentation, so that the
    loader's workers do it beside the training. `row` and `column` are the size of a pixel in the unit of the distance
    (1 and 1: pixels; 0.4375 and 0.1758: degrees of a 64 x 2048 image of 28 degrees).
    """

    train_only = True
    follows = ("range_projection", "residual_images")

    def __init__(self, *, row: float = 1.0, column: float = 1.0) -> None:
        if not (row > 0 and column > 0):
            raise ConfigError(f"edge_distance: the size of a pixel must be positive, found {row} x {column}")
        self.row, self.column = row, column

    def spec(self, data: DataSpec) -> DataSpec:
        """Unchanged. ConfigError without a range image, or after which points of past scans are still there."""
        if IMAGE not in data.inputs:
            raise ConfigError(
                "edge_distance needs the range image of range_projection.\n"
                "  fix: transform=[...,range_projection,residual_images,edge_distance], in this order"
            )
        return data

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with distance maps (1, K, H, W) among its targets, where its points are labelled."""
        from lidarfw_dpdc_mos.distance import distance_maps, on_pixels

        labels = frame.targets.points
        if labels is None:
            return frame
        image: RangeImage = frame.inputs[IMAGE]
        label = on_pixels(labels.label, image, frame.inputs["points"], empty=-1)
        maps = distance_maps(label, labels.probability.shape[1], (self.row, self.column))
        return frame.replace(targets=frame.targets.replace(pixels=image.replace(features=maps)))


class RangeCrop(Transform):
    """In training, a sector of `columns` columns of the range image with its points, labels and distance maps.

    Little of a scan moves: with the share `moving` the sector holds a random point of a class other than the first,
    where there is one; else it lies anywhere. Networks that fit a sector fit the full turn, so that evaluation sees
    all of it. Of an image that is not wider than the sector all columns are kept. Boxes
    are left out: most would be empty.
    """

    train_only = True
    follows = ("range_projection", "residual_images", "edge_distance")

    def __init__(self, *, columns: int = 256, moving: float = 0.75) -> None:
        if columns < 1 or columns % _STRIDE:
            raise ConfigError(f"range_crop.columns must be a multiple of {_STRIDE}, for networks that halve the width")
        if not 0 <= moving <= 1:
            raise ConfigError(f"range_crop.moving is a share, expected 0..1, found {moving}")
        self.columns, self.moving = columns, moving

    def spec(self, data: DataSpec) -> DataSpec:
        """Without boxes. ConfigError without a range image."""
        view = data.inputs[IMAGE].geometry if IMAGE in data.inputs else None
        if not isinstance(view, RangeView):
            raise ConfigError("range_crop needs the range image.\n  fix: transform=[...,range_projection,range_crop]")
        return DataSpec(data.inputs, data.targets - {Boxes, Tracks}, data.classes, data.sweeps)

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with a narrower range image, and the points in it."""
        image: RangeImage = frame.inputs[IMAGE]
        width = image.mask.shape[2]
        columns = min(self.columns, width)
        first = self._first(frame, width, rng)
        place = (image.pixel % width - first) % width
        kept = (image.pixel >= 0) & (place < columns)
        pixel = image.pixel[kept] // width * columns + place[kept]
        chosen = (torch.arange(columns) + first) % width
        values = {name: getattr(image, name)[..., chosen] for name in ("features", "xyz", "mask")}
        labels, maps = frame.targets.points, frame.targets.pixels
        targets = frame.targets.replace(
            points=None if labels is None else labels[kept],
            pixels=None if maps is None else maps.replace(features=maps.features[..., chosen]),
            boxes=None,
            ignored=None,
            tracks=None,
        )
        inputs = {**frame.inputs, "points": frame.inputs["points"][kept], IMAGE: image.replace(**values, pixel=pixel)}
        return frame.replace(inputs=inputs, targets=targets)

    def _first(self, frame: Frame, width: int, rng: np.random.Generator) -> int:
        """The leftmost column."""
        labels = frame.targets.points
        pixel = frame.inputs[IMAGE].pixel
        wanted = pixel[:0] if labels is None else pixel[(labels.label > 0) & (pixel >= 0)]
        if len(wanted) == 0 or rng.random() >= self.moving:
            return int(rng.integers(width))
        middle = int(wanted[int(rng.integers(len(wanted)))]) % width
        return (middle - int(rng.integers(self.columns))) % width


def _current(points: Points) -> Tensor:
    """(N,) bool: points of the current scan."""
    return torch.ones_like(points.batch, dtype=torch.bool) if points.time is None else points.time >= 0


def _points_spec(data: DataSpec, asking: str) -> Spec:
    spec = data.inputs.get("points")
    if spec is None or spec.kind is not Points:
        there = ", ".join(data.inputs) or "none"
        raise ConfigError(f"{asking} needs the input `points`.\n  inputs of the data: {there}")
    return spec


__all__ = ["DropFeatures", "EdgeDistance", "RangeCrop", "RangeProjection", "ResidualImages"]
