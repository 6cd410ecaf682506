"""Checks of datasets and transforms."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from lidarfw import registry
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Transform
from lidarfw.testing.checks.compare import copied, difference
from lidarfw.testing.checks.subject import FailedError, SkippedError, Subject, check, require
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import Boxes, DataSpec, Frame, Image, Points, RangeImage, Spec, collate

SEEDS = range(5)


def _make(subject: Subject) -> Any:
    return subject.cls(**subject.options)


def _with_files(subject: Subject) -> Any:
    dataset = _make(subject)
    try:
        dataset.prepare()
        len(dataset)
    except DataError as error:
        raise SkippedError(f"its files are not here: {str(error).splitlines()[0]}") from error
    return dataset


@check("dataset")
def spec_needs_no_files(subject: Subject) -> None:
    """The data spec is known from the options alone, and survives as plain values."""
    spec = _make(subject).spec
    require(isinstance(spec, DataSpec) and spec.inputs, f"spec must be a DataSpec with inputs, found {spec!r}")
    require(DataSpec.from_plain(spec.to_plain()) == spec, "spec changes on the way through plain values")


@check("dataset")
def frames_match_the_spec(subject: Subject) -> None:
    """Inputs, channels, targets and labels of the first frames are those of the spec."""
    dataset = _with_files(subject)
    for index in range(min(3, len(dataset))):
        frame = dataset[index]
        text = frame_mismatch(dataset.spec, frame)
        require(not text, f"frame {index}: {text}")
        meta = dataset.meta(index)
        same = (meta.id, meta.sequence, meta.index) == (frame.meta.id, frame.meta.sequence, frame.meta.index)
        require(same, f"meta({index}) and the frame disagree: {meta} and {frame.meta}")


@check("dataset")
def frames_can_be_read_anywhere(subject: Subject) -> None:
    """A frame is the same when read twice, and from a copy of the dataset in a worker process."""
    dataset = _with_files(subject)
    first = dataset[0]
    dataset[len(dataset) - 1]
    for what, again in (("again", dataset[0]), ("in a worker", pickle.loads(pickle.dumps(dataset))[0])):
        text = difference(first, again)
        require(not text, f"frame 0 read {what} differs: {text}")


@check("dataset")
def frames_make_batches(subject: Subject) -> None:
    """One frame and three frames collate."""
    dataset = _with_files(subject)
    for count in (1, 3):
        batch = collate([dataset[index % len(dataset)] for index in range(count)])
        require(len(batch) == count, f"a batch of {count} frames has {len(batch)}")


@check("dataset")
def sequences_hold_every_frame_once(subject: Subject) -> None:
    """`sequences` lists each frame once, in order of time, under the names that `meta` gives."""
    dataset = _with_files(subject)
    sequences = [list(s) for s in dataset.sequences()]
    require(sorted(i for s in sequences for i in s) == list(range(len(dataset))), "not every frame once")
    for sequence in sequences:
        metas = [dataset.meta(i) for i in sequence]
        require(
            len({m.sequence for m in metas}) == 1, f"one sequence has the names {sorted({m.sequence for m in metas})}"
        )
        require([m.time for m in metas] == sorted(m.time for m in metas), "a sequence is not in order of time")
    ids = [dataset.meta(i).id for i in range(len(dataset))]
    require(len(set(ids)) == len(ids), "two frames have the same id")


def frame_mismatch(spec: DataSpec, frame: Frame) -> str:
    """How a frame departs from a data spec, in words; "" where it does not."""
    if set(frame.inputs) != set(spec.inputs):
        return f"inputs {sorted(frame.inputs)}, expected {sorted(spec.inputs)}"
    texts = (_input_mismatch(spec.inputs[name], value) for name, value in frame.inputs.items())
    wrong = [f"input {name!r}: {text}" for name, text in zip(frame.inputs, texts, strict=True) if text]
    for kind in spec.targets:
        if frame.targets.of(kind) is None:
            wrong.append(f"spec says that {kind.__name__} are labelled, the frame has none")
    boxes = frame.targets.boxes
    if boxes is not None and len(boxes) and int(boxes.label.max()) >= len(spec.classes):
        wrong.append(f"label {int(boxes.label.max())} for the {len(spec.classes)} classes {spec.classes}")
    return wrong[0] if wrong else ""


def _input_mismatch(spec: Spec, value: Any) -> str:
    if not isinstance(value, spec.kind):
        return f"a {type(value).__name__}, expected {spec.kind.__name__}"
    if isinstance(value, Points) and value.features.shape[1] != spec.channels:
        return f"{value.features.shape[1]} channels, expected {spec.channels}"
    if isinstance(value, (Image, RangeImage)) and value.features.shape[1] != spec.channels:
        return f"{value.features.shape[1]} channels, expected {spec.channels}"
    return "" if not isinstance(value, Points) or bool(value.xyz.isfinite().all()) else "points that are not finite"


# transforms


class _Prepared(SyntheticDataset):
    """Synthetic frames behind the transforms that the one under test follows."""

    def __init__(self, before: Sequence[Transform]) -> None:
        super().__init__(frames=len(SEEDS), points=4096, sweeps=3 if before else 1, image=True)
        self.before = before
        for transform in before:
            self.spec = transform.spec(self.spec)

    def __getitem__(self, index: int) -> Frame:
        frame = super().__getitem__(index)
        for transform in self.before:
            frame = transform(frame, np.random.default_rng(index))
        return frame


def _attached(subject: Subject) -> tuple[Any, SyntheticDataset]:
    transform = _make(subject)
    dataset = _Prepared([registry.load("transform", name)() for name in transform.follows])
    try:
        transform.attach(dataset)
    except (DataError, ConfigError) as error:
        raise SkippedError(f"it needs files that are not here: {str(error).splitlines()[0]}") from error
    return transform, dataset


@check("transform")
def transformed_frames_match_the_spec(subject: Subject) -> None:
    """A transformed frame looks as `spec` says, and frames of several calls make one batch."""
    transform, dataset = _attached(subject)
    out = [transform(dataset[i], np.random.default_rng(i)) for i in SEEDS]
    for frame in out:
        text = frame_mismatch(transform.spec(dataset.spec), frame)
        require(not text, text)
    collate(out)


@check("transform")
def randomness_comes_from_rng(subject: Subject) -> None:
    """The same generator gives the same frame, whatever the global state; the frame given is left alone."""
    transform, dataset = _attached(subject)
    for seed in SEEDS:
        frame = dataset[0]
        before = copied(frame)
        first = transform(frame, np.random.default_rng(seed))
        text = difference(before, frame)
        require(not text, f"it changed the frame it was given: {text}")
        torch.rand(1), np.random.rand(1)  # noqa: NPY002
        text = difference(first, transform(dataset[0], np.random.default_rng(seed)))
        require(not text, f"two calls with the same generator differ: {text}")


@check("transform")
def points_stay_in_their_boxes(subject: Subject) -> None:
    """Points, their labels and boxes move together: an object's points are inside its box before and after."""
    from lidarfw.ops import points_in_boxes

    transform, dataset = _attached(subject)
    for seed in SEEDS:
        frame = transform(dataset[seed], np.random.default_rng(seed))
        points, labels, boxes = frame.inputs.get("points"), frame.targets.points, frame.targets.boxes
        if points is None or labels is None or boxes is None:
            raise SkippedError("it leaves no points, labels or boxes to compare")
        require(len(points) == len(labels), f"{len(points)} points have {len(labels)} labels")
        inside = points_in_boxes(points.xyz, _grown(boxes).tensor)
        own = labels.label >= 0
        filled = torch.isin(torch.arange(len(boxes)), inside[own])
        text = f"seed {seed}: only {int(filled.sum())} of {len(boxes)} boxes still hold points of their object"
        require(2 * int(filled.sum()) >= len(boxes), text)
        strays = own & (inside < 0) & _of_kept(labels, inside)
        require(
            int(strays.sum()) == 0, f"seed {seed}: {int(strays.sum())} of {int(own.sum())} object points left their box"
        )


def _grown(boxes: Boxes) -> Boxes:
    return dataclasses.replace(boxes, size=boxes.size * 1.02 + 0.2)  # the scanner's noise


def _of_kept(labels: Any, inside: torch.Tensor) -> torch.Tensor:
    """Points of the objects that still have a box: most of their points are in one."""
    instance = labels.instance.clamp(min=0)
    total = torch.bincount(instance)
    held = torch.bincount(instance, weights=(inside >= 0).double(), minlength=len(total))
    return (held >= 0.5 * total)[instance]


__all__ = ["FailedError", "frame_mismatch"]
