"""Reads every frame of a dataset: what is wrong with which file, and what there is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidarfw.errors import LidarfwError
from lidarfw.interfaces import Dataset
from lidarfw.testing.checks.data import frame_mismatch
from lidarfw.types import Frame, Points


@dataclass
class Findings:
    """What the frames of a split hold."""

    frames: int = 0
    sequences: int = 0
    faults: list[tuple[str, str]] = field(default_factory=list)  # frame, reason
    points: list[int] = field(default_factory=list)  # of every frame
    reach: float = 0.0  # metres to the farthest point
    boxes: Counter[str] = field(default_factory=Counter)  # by class
    labels: Counter[str] = field(default_factory=Counter)  # points by class
    tracks: set[tuple[str, int]] = field(default_factory=set)

    def summary(self, verbose: bool = False) -> dict[str, str]:
        """Name and value of each figure; with `verbose` also the classes that never occur."""
        rows = {"frames": f"{self.frames} in {self.sequences} sequences", "faults": str(len(self.faults))}
        if self.points:
            least, middle, most = np.percentile(self.points, (0, 50, 100))
            rows["points a frame"] = f"{least:.0f} .. {most:.0f}, median {middle:.0f}; farthest {self.reach:.1f} m"
        rows |= {f"boxes: {name}": str(n) for name, n in self.boxes.items() if n or verbose}
        rows |= {"tracks": str(len(self.tracks))} if self.tracks else {}
        total = max(1, sum(self.labels.values()))
        return rows | {f"points: {k}": f"{n} ({n / total:.2%})" for k, n in self.labels.items() if n or verbose}


def check_dataset(dataset: Dataset, track: Callable[[range], Iterable[int]] = iter) -> Findings:
    """Every frame read once, in order; a frame that cannot be read, or is not as its spec says, is a fault."""
    found = Findings()
    try:
        dataset.prepare()
    except (LidarfwError, OSError, ValueError) as error:
        found.faults.append((f"split {dataset.split}", _reason(error)))
    try:
        found.frames, found.sequences = len(dataset), len(dataset.sequences())
    except (LidarfwError, OSError, ValueError) as error:
        found.faults = [(f"split {dataset.split}", _reason(error))]
        return found
    for index in track(range(found.frames)):
        _read(dataset, index, found)
    return found


def _read(dataset: Dataset, index: int, found: Findings) -> None:
    name = f"frame {index}"
    try:
        name = dataset.meta(index).id
        frame = dataset[index]
        text = frame_mismatch(dataset.spec, frame)
        found.faults += [(name, text)] if text else []
        _count(frame, dataset.spec.classes, found)
    except Exception as error:
        found.faults.append((name, _reason(error)))


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, LidarfwError) else f"{type(error).__name__}: {error}"


def _count(frame: Frame, classes: tuple[str, ...], found: Findings) -> None:
    points: Any = frame.inputs.get("points")
    if isinstance(points, Points):
        found.points.append(len(points))
        found.reach = max([found.reach, *points.xyz.norm(dim=1).max(dim=0, keepdim=True).values.tolist()])
    targets = frame.targets
    if targets.boxes is not None:
        found.boxes.update({name: int((targets.boxes.label == i).sum()) for i, name in enumerate(classes)})
    if targets.tracks is not None:
        found.tracks |= {(frame.meta.sequence, number) for number in targets.tracks.id.tolist()}
    if targets.points is not None:
        label = targets.points.label
        counts = {name: int((label == i).sum()) for i, name in enumerate(classes)}
        found.labels.update(counts | {"unlabelled": int((label < 0).sum())})
