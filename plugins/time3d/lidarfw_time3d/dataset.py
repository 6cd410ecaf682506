"""Detections of KITTI tracking as a dataset: boxes in, tracks as targets, so that a tracker trains without images."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from lidarfw import kitti
from lidarfw._lazy import LazyModule
from lidarfw.detections import Detections, read_kitti, upright
from lidarfw.errors import DataError
from lidarfw.interfaces.data import Dataset
from lidarfw.types import Boxes, DataSpec, Frame, FrameMeta, Poses, Spec, Targets, Tracks

from lidarfw_time3d.confidence import check_calibration

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

_VAL = (1, 6, 8, 10, 12, 13, 14, 15, 16, 18, 19)


class KittiDetections(Dataset):
    """Boxes that a detector found in KITTI tracking, with the labelled tracks: ROOT/label_02, ROOT/calib, and so on.

    The sensor frame is the rectified camera with its axes renamed, as in `lidarfw track`. Scores become probabilities
    by `calibration`, scale and offset of their log-odds by class name; without it they must be probabilities.
    """

    splits: ClassVar = {
        "train": tuple(f"{n:04d}" for n in range(21) if n not in _VAL),
        "val": tuple(f"{n:04d}" for n in _VAL),
    }

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        detections: str = "det_pointrcnn",
        poses: str = "pose_orbslam3",
        classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"),
        calibration: dict[str, list[float]] | None = None,
    ) -> None:
        """Options.

        root: folder of the training sequences. split: train, val, or sequences such as 0000, joined by +.
        detections: folder CLASS/SEQUENCE.txt in root, or anywhere. poses: folder of 3 x 4 camera poses, likewise.
        classes: class folders to read.
        """
        self.root, self.split, self.classes = root, split, tuple(classes)
        self.detections, self.poses, self.calibration = detections, poses, calibration
        if calibration is not None:
            check_calibration(self.classes, calibration, "dataset.kitti_detections.calibration")
        self.spec = DataSpec(
            {"boxes": Spec(Boxes, classes=self.classes), "pose": Spec(Poses)}, frozenset({Boxes, Tracks}), self.classes
        )

    @functools.cached_property
    def _frames(self) -> list[tuple[Detections, Targets]]:
        if not self.root:
            raise DataError("dataset.kitti_detections.root is not set.\n  fix: root=/path/to/kitti_tracking/training")
        root = Path(self.root)
        names = [name for part in self.split.split("+") for name in self.splits.get(part, (part,))]
        missing = [name for name in names if not (root / "label_02" / f"{name}.txt").exists()]
        if missing:
            raise DataError(
                f"{root / 'label_02'}: has no {missing[0]}.txt.\n  fix: split=SEQUENCE+SEQUENCE of those there"
            )
        return [frame for name in names for frame in self._sequence(root, name)]

    def _sequence(self, root: Path, name: str) -> list[tuple[Detections, Targets]]:
        sequence = read_kitti(root / self.detections, name, self.classes, root / self.poses, root / "calib")
        calibration = upright(kitti.read_calibration(root / "calib" / f"{name}.txt"))
        lines: dict[int, list[kitti.TrackLabel]] = {}
        for line in kitti.read_tracks(root / "label_02" / f"{name}.txt"):
            lines.setdefault(line.frame, []).append(kitti.as_object(line))
        return [(frame, self._targets(lines.get(frame.meta.index, []), calibration)) for frame in sequence.frames]

    def _targets(self, lines: list[kitti.TrackLabel], calibration: kitti.Calibration) -> Targets:
        boxes, ignored = kitti.boxes_from_labels([line.label for line in lines], calibration, self.classes)
        ids = torch.tensor([line.id for line in lines], dtype=torch.long)
        assert boxes.row is not None
        return Targets(boxes=boxes, ignored=ignored, tracks=Tracks(boxes, ids[boxes.row]))

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        found, targets = self._frames[index]
        boxes = found.boxes.replace(score=self._probability(found.boxes))
        assert found.pose is not None
        inputs = {"boxes": boxes.map(_single), "pose": found.pose.map(_single)}
        return Frame(inputs, targets, found.meta)

    def _probability(self, boxes: Boxes) -> torch.Tensor:
        if self.calibration is None:
            return boxes.score
        lines = np.array([self.calibration.get(name, (1.0, 0.0)) for name in self.classes])
        scale, offset = torch.from_numpy(lines)[boxes.label].unbind(1)
        return torch.sigmoid(scale * boxes.score + offset)

    def meta(self, index: int) -> FrameMeta:
        """Sequence and place of a frame."""
        return self._frames[index][0].meta

    def sequences(self) -> list[Sequence[int]]:
        """The frames of each drive."""
        runs: dict[str, list[int]] = {}
        for place, (frame, _) in enumerate(self._frames):
            runs.setdefault(frame.meta.sequence, []).append(place)
        return list(runs.values())


def _single(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.float() if tensor.dtype == torch.float64 else tensor
