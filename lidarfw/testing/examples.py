"""Made-up features, predictions and targets of any Spec, all of the same few synthetic frames.

The content of a frame depends on the frame alone, never on its batch mates.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lidarfw.testing.synthetic import CAMERA, SyntheticDataset
from lidarfw.types import (
    BEV,
    Boxes,
    Camera,
    Descriptors,
    Frame,
    FrameMeta,
    Grid,
    Image,
    Matches,
    PointLabels,
    Points,
    Poses,
    RangeImage,
    RangeView,
    SceneCoords,
    Spec,
    Targets,
    Tracks,
    Voxels,
    collate,
)

GRID = Grid((0.0, -16.0, -3.0), (32.0, 16.0, 1.0), (0.5, 0.5, 0.5))
OBLONG_GRID = Grid((2.0, -24.0, -2.0), (42.0, 12.0, 1.0), (0.5, 0.75, 0.25))  # x, y and z all differ; odd sizes
VIEW = RangeView(16, 128, math.radians(4), math.radians(-26))
CLASSES = ("Car", "Pedestrian", "Cyclist")


@dataclass(frozen=True)
class Variation:
    """Numbers that a component must take from its Specs."""

    name: str = "base"
    channels: int = 8
    stride: int = 2
    grid: Grid = GRID


VARIATIONS = (
    Variation(),
    Variation("wider features", channels=12),
    Variation("other stride", stride=4),
    Variation("other grid", grid=OBLONG_GRID),
)


def spec_of(kind: type, variation: Variation = VARIATIONS[0], *, level: int = 0) -> Spec:
    """A small Spec of any kind; each `level` has twice the stride and channels of the one before."""
    channels, stride = variation.channels << level, variation.stride << level
    if kind is Voxels:
        return Spec(Voxels, channels, stride, variation.grid, depth=variation.grid.shape(stride)[0])
    if kind is BEV:
        return Spec(BEV, channels, stride, variation.grid)
    if kind is Image:
        return Spec(Image, channels, stride, CAMERA)
    if kind is RangeImage:
        return Spec(RangeImage, channels, 1, VIEW)
    if kind in (Points, Descriptors):
        return Spec(kind, channels)
    return Spec(kind, classes=CLASSES if kind in (Boxes, PointLabels, Tracks) else ())


def street(length: int = 4) -> tuple[Frame, ...]:
    """A short, small synthetic sequence; a fresh copy, so that nobody can spoil it for the next."""
    return tuple(frame.map(torch.clone) for frame in _street(length))


@functools.cache
def _street(length: int) -> tuple[Frame, ...]:
    dataset = SyntheticDataset(frames=length, sequence_length=length, points=2048, image=True, pose=True)
    return tuple(dataset[index] for index in range(length))


def empty(frame: Frame) -> Frame:
    """The frame without points and objects."""
    return thinned(frame, 0)


def thinned(frame: Frame, count: int) -> Frame:
    """The frame with its first `count` points and no objects."""
    targets, none = frame.targets, slice(0, 0)
    tracks = Tracks(targets.tracks.boxes[none], targets.tracks.id[none])  # type: ignore[union-attr]
    few: dict[str, Any] = {name: getattr(targets, name)[none] for name in ("boxes", "ignored")}
    labels = targets.points[slice(0, count)]  # type: ignore[index]
    inputs = {**frame.inputs, "points": frame.inputs["points"][slice(0, count)]}
    meta = dataclasses.replace(frame.meta, id=f"{frame.meta.id}_{count}")
    return Frame(inputs, targets.replace(**few, points=labels, tracks=tracks), meta)


def example(spec: Spec, frames: Sequence[Frame], name: str = "") -> Any:
    """A batched record of that Spec for the frames, random where the scene does not say; differs by `name`."""
    return join([_one(spec, frame, name) for frame in frames])


def targets(frames: Sequence[Frame]) -> Targets:
    """Batched ground truth of the frames."""
    return collate(frames).targets


def join(records: Sequence[Any]) -> Any:
    """One batch of records that hold one sample each."""
    first = records[0]
    if isinstance(first, Voxels):
        index = [r.index + r.index.new_tensor([number, 0, 0, 0]) for number, r in enumerate(records)]
        features = torch.cat([r.features for r in records])
        return Voxels(features, torch.cat(index), first.grid, first.shape, first.strides, len(records))
    if isinstance(first, Descriptors):
        return Descriptors(torch.cat([r.vector for r in records]), sum((r.modality for r in records), ()))
    if isinstance(first, Matches):
        return Matches(torch.cat([r.index for r in records]), torch.cat([r.distance for r in records]))
    return collate([Frame({"value": record}, Targets(), FrameMeta("")) for record in records]).inputs["value"]


def _one(spec: Spec, frame: Frame, name: str) -> Any:
    seed = zlib.crc32(f"{frame.meta.id} {spec} {name}".encode())
    return _MAKERS[spec.kind](spec, frame, torch.Generator().manual_seed(seed))


def _noise(generator: torch.Generator, *size: int) -> Tensor:
    return torch.randn(*size, generator=generator)


def _points(spec: Spec, frame: Frame, generator: torch.Generator) -> Points:
    points: Points = frame.inputs["points"]
    time = -0.1 * torch.arange(len(points)).remainder(2)
    return points.replace(features=_noise(generator, len(points), spec.channels), time=time)


def _voxels(spec: Spec, frame: Frame, generator: torch.Generator) -> Voxels:
    grid = spec.grid
    depth = grid.shape()[0]
    strides = (next((s for s in range(1, depth + 1) if -(-depth // s) == spec.depth), depth), spec.stride, spec.stride)
    cell, inside = grid.index(frame.inputs["points"].xyz)
    cells = torch.unique(cell[inside] // cell.new_tensor(strides), dim=0)  # sorted by z, y, x
    index = torch.cat([torch.zeros_like(cells[:, :1]), cells], 1)
    return Voxels(_noise(generator, len(index), spec.channels), index, grid, grid.shape(strides), strides)


def _bev(spec: Spec, frame: Frame, generator: torch.Generator) -> BEV:
    return BEV(_noise(generator, 1, spec.channels, *spec.grid.shape(spec.stride)[1:]), spec.grid, spec.stride)


def _image(spec: Spec, frame: Frame, generator: torch.Generator) -> Image:
    camera = spec.geometry
    if not isinstance(camera, Camera):
        raise TypeError(f"{spec} has no Camera")
    height, width = -(-camera.height // spec.stride), -(-camera.width // spec.stride)
    return Image(_noise(generator, 1, spec.channels, height, width), (camera,), spec.stride)


def _range_image(spec: Spec, frame: Frame, generator: torch.Generator) -> RangeImage:
    view = spec.geometry
    if not isinstance(view, RangeView):
        raise TypeError(f"{spec} has no RangeView")
    points: Points = frame.inputs["points"]
    row, column, _, inside = view.project(points.xyz)
    pixel = torch.where(inside, row * view.width + column, -1)
    xyz = torch.zeros(view.height * view.width, 3).index_copy(0, pixel[inside], points.xyz[inside])
    xyz = xyz.T.reshape(1, 3, view.height, view.width)
    mask = (xyz != 0).any(1)
    features = _noise(generator, 1, spec.channels, view.height, view.width) * mask
    return RangeImage(features, xyz, mask, pixel, view)


def _boxes(spec: Spec, frame: Frame, generator: torch.Generator) -> Boxes:
    """Two noisy copies of every object, as a detector might give; sorted by falling score."""
    known = frame.targets.boxes
    boxes = Boxes.cat([known, known])  # type: ignore[list-item]
    tensor = boxes.tensor + 0.1 * _noise(generator, len(boxes), 7)
    score = torch.rand(len(boxes), generator=generator).sort(descending=True).values
    label = boxes.label.clamp(max=max(0, len(spec.classes) - 1))
    return Boxes.from_tensor(tensor, label, score).replace(velocity=boxes.velocity)


def _point_labels(spec: Spec, frame: Frame, generator: torch.Generator) -> PointLabels:
    points: Points = frame.inputs["points"]
    logits = _noise(generator, len(points), max(1, len(spec.classes)))
    return PointLabels(logits.softmax(1), points.batch)


def _scene_coords(spec: Spec, frame: Frame, generator: torch.Generator) -> SceneCoords:
    points, pose = frame.inputs["points"], frame.inputs["pose"].matrix[0]
    world = points.xyz @ pose[:3, :3].T + pose[:3, 3] + 0.05 * _noise(generator, len(points), 3)
    return SceneCoords(points.xyz, world, torch.rand(len(points), generator=generator), points.batch)


def _poses(spec: Spec, frame: Frame, generator: torch.Generator) -> Poses:
    poses: Poses = frame.inputs["pose"]
    return poses


def _descriptors(spec: Spec, frame: Frame, generator: torch.Generator) -> Descriptors:
    vector = torch.nn.functional.normalize(_noise(generator, 1, spec.channels), dim=1)
    return Descriptors(vector, ("lidar",))


def _tracks(spec: Spec, frame: Frame, generator: torch.Generator) -> Tracks:
    tracks = frame.targets.tracks
    if tracks is None:
        raise TypeError(f"frame {frame.meta.id} has no tracks")
    return tracks


def _matches(spec: Spec, frame: Frame, generator: torch.Generator) -> Matches:
    distance = torch.rand(1, 5, generator=generator).sort(1).values
    return Matches(torch.randperm(5, generator=generator)[None], distance)


_MAKERS: dict[type, Any] = {
    Points: _points, Voxels: _voxels, BEV: _bev, Image: _image, RangeImage: _range_image, Boxes: _boxes,
    PointLabels: _point_labels, SceneCoords: _scene_coords, Poses: _poses, Descriptors: _descriptors,
    Tracks: _tracks, Matches: _matches,
}  # fmt: skip
