"""Intersection over union of point labels: all classes, or moving against static.

Source: Behley et al., "SemanticKITTI: a dataset for semantic scene understanding of LiDAR sequences", ICCV 2019,
section 4 (mIoU); Chen et al., "Moving object segmentation in 3D LiDAR data", RA-L 2021, section IV-A (IoU of moving).
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from lidarfw.components.per_class import check_names
from lidarfw.errors import DataError
from lidarfw.interfaces import Metric
from lidarfw.types import PointLabels, Spec, Targets


def confusion(truth: Tensor, label: Tensor, classes: int) -> Tensor:
    """(K, K + 1) int64: how many points of each true class got each class; the last column is none (-1).

    `truth`, `label` (N,) int64; points without a true class (-1) are left out.
    """
    known = truth >= 0
    label = torch.where(label < 0, classes, label)
    cells = truth[known] * (classes + 1) + label[known]
    return cells.bincount(minlength=classes * (classes + 1)).view(classes, classes + 1)


class _Confusion(Metric):
    """Counts the points of each true class that got each class."""

    higher_is_better = True
    full_state_update = False
    counts: Tensor  # (K, K + 1) int64

    def __init__(self, labels: Spec) -> None:
        super().__init__()
        self.classes = labels.classes
        size = len(labels.classes)
        self.add_state("counts", default=torch.zeros(size, size + 1, dtype=torch.long), dist_reduce_fx="sum")

    def update(self, labels: PointLabels, targets: Targets) -> None:
        """Count the points of one frame, or of a batch of frames, in."""
        if targets.points is None:
            return
        if len(labels) != len(targets.points):
            raise DataError(
                f"{len(labels)} points are predicted, {len(targets.points)} labelled.\n"
                f"  fix: a head that labels every point of the scan, or a transform that drops points and labels alike"
            )
        self.counts += confusion(targets.points.label, labels.label, len(self.classes)).to(self.counts.device)

    def _parts(self) -> tuple[Tensor, Tensor, Tensor]:
        """Points (K,) of each class that are right, labelled so, and predicted so; float64."""
        counts = self.counts.double()
        return counts.diagonal(), counts.sum(1), counts[:, : len(self.classes)].sum(0)


class MeanIoU(_Confusion):
    """Semantic segmentation: IoU of every class, and their mean, over all points of all frames together.

    IoU = right / (labelled + predicted - right). Points without a label (-1) do not count, whatever is predicted; a
    labelled point that is predicted as no class is missed. `compute` gives `{class}_iou` of the classes that occur in
    labels or predictions, `mean_iou` over those (SemanticKITTI's server counts a class that never occurs as 0; all
    of its classes occur in the benchmark), and `accuracy`, the share of points that are right; all 0..1.
    """

    monitor: ClassVar[str] = "mean_iou"

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        right, labelled, predicted = self._parts()
        union = labelled + predicted - right
        values = (right / union.clamp(min=1)).tolist()
        found = {
            f"{name.lower().replace(' ', '_')}_iou": value
            for name, value, size in zip(self.classes, values, union.tolist(), strict=True)
            if size > 0
        }
        accuracy = float(right.sum() / labelled.sum().clamp(min=1))
        return {**found, "mean_iou": sum(found.values()) / max(len(found), 1), "accuracy": accuracy}


class MosIoU(_Confusion):
    """Moving-object segmentation: IoU, precision and recall of the class `moving`, over all points of all frames.

    IoU = right / (labelled moving + predicted moving - right), the figure of the SemanticKITTI-MOS benchmark; points
    without a label do not count. `moving` names the class. `compute` gives `iou`, `precision`, `recall`, 0..1, and 0
    where nothing moves. Raises ConfigError where the data does not have the class.
    """

    monitor: ClassVar[str] = "iou"
    example: ClassVar[dict[str, Any]] = {"moving": "Car"}

    def __init__(self, labels: Spec, *, moving: str = "moving") -> None:
        super().__init__(labels)
        check_names(labels.classes, [moving], "metric.mos_iou.moving")
        self.moving = labels.classes.index(moving)

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        right, labelled, predicted = (float(part[self.moving]) for part in self._parts())
        return {
            "iou": right / max(labelled + predicted - right, 1),
            "precision": right / max(predicted, 1),
            "recall": right / max(labelled, 1),
        }
