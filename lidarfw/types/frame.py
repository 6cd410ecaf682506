"""A frame (one sample), a batch of frames, their targets, and the finished result of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

from lidarfw._lazy import LazyModule
from lidarfw.types.features import BEV, Image, RangeImage
from lidarfw.types.geometry import Camera
from lidarfw.types.predictions import Boxes, Descriptors, PointLabels, Poses, Tracks
from lidarfw.types.record import Record, Rows

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

T = TypeVar("T")


@dataclass
class FrameMeta:
    """Where a frame comes from; no component of a network may depend on it."""

    id: str  # unique within the dataset, names the sample in messages and result files
    sequence: str = ""
    index: int = 0  # position in the sequence
    time: float = 0.0  # seconds
    cameras: dict[str, Camera] = field(default_factory=dict)  # calibration by input name
    path: str = ""  # file of the main sensor
    images: dict[str, str] = field(default_factory=dict)  # picture files by camera name, for drawing
    modality: str = ""  # "camera" or "lidar", where a frame shows a place by one of the two


@dataclass
class Targets(Record):
    """Ground truth of a frame or batch; None where a kind is not labelled."""

    boxes: Boxes | None = None
    ignored: Boxes | None = None  # neither right nor wrong for the class `label`; label -1 = for any class
    points: PointLabels | None = None
    poses: Poses | None = None
    tracks: Tracks | None = None
    pixels: RangeImage | None = None  # what a loss learns from at the pixels of a range image: distance maps, say

    def of(self, kind: type) -> Any:
        """The target of a kind (`Boxes`, `PointLabels`, `Poses`, `Tracks`), or None."""
        names = {Boxes: "boxes", PointLabels: "points", Poses: "poses", Tracks: "tracks"}
        return getattr(self, names[kind]) if kind in names else None


@dataclass
class Frame(Record):
    """One sample: named inputs as batches of one, targets where known."""

    inputs: dict[str, Any]  # "points": Points, "image": Image, ...
    targets: Targets
    meta: FrameMeta


@dataclass
class Batch(Record):
    """Several frames; every record in it has `batch_size` samples."""

    inputs: dict[str, Any]
    targets: Targets
    meta: list[FrameMeta]

    def __len__(self) -> int:
        return len(self.meta)


@dataclass
class FrameResult:
    """What is known of one frame when the model, filters and tracker are done with it."""

    meta: FrameMeta
    predictions: dict[str, Any] = field(default_factory=dict)  # by the component that made it: "head.center": Boxes
    tracks: Tracks | None = None
    targets: Targets | None = None  # ground truth of the frame in evaluation, for metrics; None at inference
    inputs: dict[str, Any] = field(default_factory=dict)  # what the model saw: "points": Points, ...
    taps: dict[str, BEV] = field(default_factory=dict)  # by head, where a metric asks for Tap(kind)
    replaced: dict[str, Any] = field(default_factory=dict)  # of heads that a later one replaced, where a metric asks

    def of(self, kind: type[T]) -> T:
        """The only prediction of a kind; LookupError where there is none or more than one."""
        found = {name: value for name, value in self.predictions.items() if isinstance(value, kind)}
        if len(found) != 1:
            there = ", ".join(f"{n}: {type(v).__name__}" for n, v in self.predictions.items()) or "nothing"
            raise LookupError(f"frame {self.meta.id} has {len(found)} {kind.__name__}, expected one; it has {there}")
        return next(iter(found.values()))

    def with_prediction(self, old: Any, new: Any) -> FrameResult:
        """A copy in which the prediction object `old` is replaced by `new`."""
        return replace(self, predictions={n: new if v is old else v for n, v in self.predictions.items()})


def take(record: Any, number: int) -> Any:
    """Sample `number` of a batched input, prediction or target, as a batch of one; None stays None."""
    if record is None:
        return None
    if isinstance(record, Rows):
        return record.sample(number)
    if isinstance(record, Image):
        return Image(record.features[number : number + 1], record.cameras[number : number + 1], record.stride)
    if isinstance(record, Targets):
        return Targets(**{f.name: take(getattr(record, f.name), number) for f in fields(Targets)})
    if isinstance(record, Tracks):
        rows = record.boxes.batch == number
        return Tracks(
            record.boxes.sample(number), record.id[rows], None if record.moving is None else record.moving[rows]
        )
    if isinstance(record, RangeImage):
        return _take_range_image(record, number)
    if isinstance(record, Descriptors):
        return Descriptors(record.vector[number : number + 1], record.modality[number : number + 1])
    return record.map(lambda tensor: tensor[number : number + 1])


def _take_range_image(record: RangeImage, number: int) -> RangeImage:
    size = record.mask[0].numel()  # a sector of the view has fewer pixels
    # a point outside the view has no sample: only points inside are kept
    pixel = record.pixel[(record.pixel >= number * size) & (record.pixel < (number + 1) * size)] - number * size
    one = slice(number, number + 1)
    return RangeImage(record.features[one], record.xyz[one], record.mask[one], pixel, record.view)


def _collate_records(records: Sequence[Any]) -> Any:
    first = records[0]
    if isinstance(first, Rows):
        return type(first).cat(records, as_batch=True)
    if isinstance(first, Image):
        return Image(torch.cat([r.features for r in records]), sum((r.cameras for r in records), ()), first.stride)
    if isinstance(first, BEV):
        return BEV(torch.cat([r.features for r in records]), first.grid, first.stride)
    if isinstance(first, Poses):
        return Poses(*(torch.cat([getattr(r, f.name) for r in records]) for f in fields(Poses)))
    if isinstance(first, Tracks):
        return Tracks(Boxes.cat([r.boxes for r in records], as_batch=True), torch.cat([r.id for r in records]))
    if isinstance(first, RangeImage):
        return _collate_range_images(records)
    raise TypeError(f"{type(first).__name__} is no type that a frame may hold")


def _collate_range_images(records: Sequence[RangeImage]) -> RangeImage:
    size = records[0].mask[0].numel()
    starts = [size * sum(r.batch_size for r in records[:i]) for i in range(len(records))]
    pixel = torch.cat([torch.where(r.pixel < 0, -1, r.pixel + s) for r, s in zip(records, starts, strict=True)])
    features, xyz, mask = (torch.cat([getattr(r, n) for r in records]) for n in ("features", "xyz", "mask"))
    return RangeImage(features, xyz, mask, pixel, records[0].view)


def collate(frames: Sequence[Frame]) -> Batch:
    """A batch of the frames, in their order. A target that one of them lacks is dropped."""
    inputs = {name: _collate_records([f.inputs[name] for f in frames]) for name in frames[0].inputs}
    targets = {}
    for entry in fields(Targets):
        values = [getattr(f.targets, entry.name) for f in frames]
        targets[entry.name] = None if any(v is None for v in values) else _collate_records(values)
    return Batch(inputs, Targets(**targets), [f.meta for f in frames])
