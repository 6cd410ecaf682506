#!/usr/bin/env python3
"""Moving objects by geometry alone: what a learned method of moving-object segmentation has to beat.

python tools/mos_baseline.py --tune TOWN --test REAL [--past 4] [--search 1]

TOWN, REAL: folders in SemanticKITTI's layout. A point counts as moving where at least `agreeing` of the `past` last
scans, moved into the frame of the current one, look further than it does by more than a share of its range: something
stands where the beams went through before. That is the signed residual of Chen et al., "Moving object segmentation in
3D LiDAR data", RA-L 2021, equation 1, and a threshold. `agreeing` and the threshold are those of the highest IoU on
TOWN; REAL is only measured. With `--search` N the range of a past scan is that within N pixels which is nearest to
the current one. Beside it: the figures of calling all points of movable classes moving, which needs the
labels.

Scans that have fewer than `past` scans before them, and points without a label, do not count.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from math import radians
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import track as progress

from lidarfw.components.datasets.semantic_kitti import SemanticKittiDataset
from lidarfw.errors import DataError, LidarfwError
from lidarfw.ops import range_project, residual_images
from lidarfw.types import Frame, RangeView

Counts = npt.NDArray[np.int64]

VIEW = RangeView(64, 2048, radians(3), radians(-25), clip=True)  # HDL-64E
MOVABLE = ("car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist")
EDGES = np.concatenate([[-np.inf], np.linspace(0.01, 1.0, 100), [np.inf]])  # thresholds between the two ends
SAME = 0.5  # metres behind the nearest point of its pixel to which a point shares its verdict
FARTHEST = 60.0  # metres


@dataclass(frozen=True)
class Figures:
    """IoU, precision and recall of the class moving, 0..1."""

    iou: float
    precision: float
    recall: float

    @classmethod
    def of(cls, right: int, predicted: int, moving: int) -> Figures:
        """From numbers of points; 0 where there is none."""
        union = predicted + moving - right
        return cls(right / max(union, 1), right / max(predicted, 1), right / max(moving, 1))


@dataclass(eq=False)
class Tally:
    """Labelled points by their residual: (past, bins) of static and of moving ones; row m: `m + 1` scans agree.

    `movable`: points of movable classes and how many of them move.
    """

    past: int
    static: Counts = field(init=False)
    moving: Counts = field(init=False)
    movable: tuple[int, int] = (0, 0)
    scans: int = 0

    def __post_init__(self) -> None:
        self.static = np.zeros((self.past, len(EDGES) - 1), np.int64)
        self.moving = np.zeros_like(self.static)

    def add(self, residual: npt.NDArray[np.float32], label: Counts, movable: npt.NDArray[np.bool_]) -> None:
        """Count a scan: residuals (past, N), label (N,) 1 moving, 0 static, -1 none, movable (N,)."""
        ranked = -np.sort(-residual, axis=0)  # row m: the largest residual that m + 1 scans reach
        for table, which in ((self.static, 0), (self.moving, 1)):
            table += np.stack([np.histogram(row[label == which], EDGES)[0] for row in ranked])
        hit = movable & (label >= 0)
        self.movable = self.movable[0] + int(hit.sum()), self.movable[1] + int((label[hit] == 1).sum())
        self.scans += 1

    def figures(self, agreeing: int, threshold: int) -> Figures:
        """Of the rule that `agreeing` scans exceed EDGES[threshold]."""
        right = int(self.moving[agreeing - 1, threshold:].sum())
        wrong = int(self.static[agreeing - 1, threshold:].sum())
        return Figures.of(right, right + wrong, int(self.moving[0].sum()))

    def best(self) -> tuple[int, int]:
        """`agreeing` and the number of the threshold with the highest IoU; the first of equal ones."""
        choices = [(m, t) for m in range(1, self.past + 1) for t in range(1, len(EDGES) - 1)]
        return max(choices, key=lambda choice: self.figures(*choice).iou)

    @property
    def all_movable(self) -> Figures:
        """Of calling every movable point moving."""
        return Figures.of(self.movable[1], self.movable[0], int(self.moving[0].sum()))


def residuals(frame: Frame, past: int, search: int = 0) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Signed residuals (past, N) of the points of the current scan, and which points of the frame those are."""
    points = frame.inputs["points"]
    if points.time is None:
        raise DataError(f"frame {frame.meta.id}: the points have no times, so past scans cannot be told apart")
    times = points.time.unique().flip(0)  # the current scan first
    current = points.time == times[0]
    image = range_project(points[current], VIEW)
    earlier = [points[points.time == time] for time in times[1 : past + 1]]
    change = residual_images(image, earlier, farthest=FARTHEST, signed=True, search=search)[0].flatten(1)
    pixel = image.pixel.clamp(min=0)
    depth = points[current].xyz.norm(dim=1) - image.features[0, 0].flatten()[pixel]
    seen = (image.pixel >= 0) & (depth < SAME)
    return torch.where(seen, change[:, pixel], 0).numpy(), current.numpy()


def labels(frame: Frame) -> Counts:
    """Class (N,) of every point, -1 for none."""
    if frame.targets.points is None:
        raise DataError(f"frame {frame.meta.id} has no labels")
    return np.asarray(frame.targets.points.label.numpy())


def tally(root: str, past: int, split: str = "all", search: int = 0) -> Tally:
    """Count all scans of a folder; DataError where no sequence is long enough."""
    options: dict[str, Any] = {"root": root, "split": split}
    moving = SemanticKittiDataset(**options, task="moving", sweeps=past + 1)
    semantics = SemanticKittiDataset(**options)
    moving.prepare()
    table = torch.tensor([name in MOVABLE for name in semantics.spec.classes])
    judged = [index for sequence in moving.sequences() for index in sequence[past:]]
    if not judged:
        raise DataError(f"{root}: no sequence has more than {past} scans.\n  fix: --past {max(past - 1, 1)}")
    whole = Tally(past)
    for index in progress(judged, description=root, disable=not sys.stderr.isatty()):
        residual, current = residuals(moving[index], past, search)
        label = labels(moving[index])[current]
        kind = torch.from_numpy(labels(semantics[index]))
        whole.add(residual, label, (table[kind.clamp(min=0)] & (kind >= 0)).numpy())
    return whole


def main(arguments: list[str] | None = None) -> int:
    """Run the command; its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tune", required=True, help="folder of the scans that the threshold is chosen on")
    parser.add_argument("--test", required=True, nargs="+", help="folders of the scans that are measured")
    parser.add_argument("--past", type=int, default=4, help="past scans (default: 4)")
    parser.add_argument("--search", type=int, default=0, help="pixels around, in past scans (default: 0)")
    given = parser.parse_args(arguments)
    try:
        tuned = tally(given.tune, given.past, search=given.search)
        agreeing, threshold = tuned.best()
        rows = [(given.tune, tuned), *((root, tally(root, given.past, search=given.search)) for root in given.test)]
    except LidarfwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{agreeing} of {given.past} past scans look further by more than {EDGES[threshold]:.2f} of the range")
    print("| scans | | moving % | geometry: IoU, precision, recall | all movable: IoU, precision, recall |")
    for root, one in rows:
        moving, static = int(one.moving[0].sum()), int(one.static[0].sum())
        share = f"{100 * moving / max(moving + static, 1):.2f}"
        print(
            f"| {root} | {one.scans} | {share} | {_row(one.figures(agreeing, threshold))} | {_row(one.all_movable)} |"
        )
    return 0


def _row(figures: Figures) -> str:
    return f"{figures.iou:.3f} {figures.precision:.3f} {figures.recall:.3f}"


if __name__ == "__main__":
    sys.exit(main())
