"""Whole drives through a model: scans with poses in, label files, a strip of pictures and a map of what stands still
out. What `lidarfw predict CKPT SEQUENCE_DIR` does, for use from Python too."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lidarfw import draw
from lidarfw.assembly import make_transforms
from lidarfw.components.datasets.drives import merge_scans, pose_of, read_scan
from lidarfw.components.datasets.semantic_kitti import label_ids, read_sequence
from lidarfw.errors import DataError
from lidarfw.files import atomic_path
from lidarfw.io import usable_points
from lidarfw.model import PerceptionModel
from lidarfw.ops import transform
from lidarfw.predict import needed_inputs
from lidarfw.types import Frame, FrameMeta, FrameResult, Image, PointLabels, Points, Poses, RangeImage, Targets

_EXTENT = (-50.0, 50.0, -40.0, 40.0)  # metres, of the pictures of a strip
_FAR = 2**20  # makes cell numbers of a map positive


class SequenceFrames(Sequence[Frame]):
    """The frames of a folder in SemanticKITTI's layout: velodyne/, poses.txt, calib.txt, times.txt; no labels needed.

    Each frame has the scans and inputs that the model learned from, past scans moved into its frame by the poses, and
    went through the model's transforms. A scan is read once for all frames that follow each other; `repair` drops its
    points that are not finite.
    """

    def __init__(self, model: PerceptionModel, folder: Path, repair: bool = False) -> None:
        self.drive = read_sequence(folder.absolute())
        self.data = model.plan.data
        pictures = [n for n in needed_inputs(model) if self.data.inputs[n].kind is Image]
        if pictures:
            raise DataError(f"the model also needs {pictures[0]} (Image), which is not read from a sequence of scans")
        self.transforms = make_transforms(model.plan.config, training=False)
        self._scan = functools.lru_cache(maxsize=self.data.sweeps)(functools.partial(read_scan, repair=repair))

    def __len__(self) -> int:
        return len(self.drive.scans)

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]
        place = range(len(self))[index]
        path = self.drive.scans[place]
        meta = FrameMeta(path.stem, self.drive.name, place, float(self.drive.times[place]), path=str(path))
        inputs: dict[str, Any] = {}
        for name, spec in self.data.inputs.items():
            if spec.kind is Points:
                inputs[name] = self._points(place)
            elif spec.kind is Poses:
                inputs[name] = pose_of(self.drive, place)
        frame = Frame(inputs, Targets(), meta)
        for change in self.transforms:
            frame = change(frame, np.random.default_rng(0))
        return frame

    def _points(self, place: int) -> Points:
        places = list(range(place, max(-1, place - self.data.sweeps), -1))
        scans = [self._scan(self.drive.scans[number]) for number in places]
        return scans[0] if self.data.sweeps == 1 else merge_scans(scans, self.drive, places)


def is_sequence(path: Path) -> bool:
    """Whether a folder holds a sequence in SemanticKITTI's layout."""
    return (path / "velodyne").is_dir()


def labels_of(result: FrameResult) -> PointLabels:
    """The point labels of a result; DataError where it has none or several."""
    try:
        return result.of(PointLabels)
    except LookupError as error:
        raise DataError(f"{error}\n  fix: --format json") from None


def save_labels(result: FrameResult, folder: Path, classes: Sequence[str]) -> Path:
    """Write FOLDER/sequences/SEQUENCE/predictions/ID.label, as the evaluation of SemanticKITTI takes it.

    One uint32 per point of the scan; a moving point is 251 and a static one 9, one that was dropped as broken 0.
    """
    ids = _of_the_file(label_ids(classes)[labels_of(result).label.numpy()], result.meta.path)
    path = folder / "sequences" / result.meta.sequence / "predictions" / f"{result.meta.id}.label"
    with atomic_path(path) as temporary:
        ids.tofile(temporary)
    return path


def _of_the_file(ids: npt.NDArray[np.uint32], scan: str) -> npt.NDArray[np.uint32]:
    """The ids of the points of a scan file, 0 for those that `repair` has dropped."""
    kept = usable_points(scan) if scan else np.ones(len(ids), dtype=bool)
    if kept.all() or kept.sum() != len(ids):
        return ids
    spread = np.zeros(len(kept), dtype=ids.dtype)
    spread[kept] = ids
    return spread


class Strip:
    """Pictures of up to `most` frames, evenly spaced in a sequence of `count`: range image above bird's-eye view."""

    def __init__(self, count: int, classes: Sequence[str], most: int = 6) -> None:
        self.wanted = set(np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist())
        self.classes = classes
        self.pictures: list[draw.Picture] = []

    def add(self, result: FrameResult) -> None:
        """Draw the frame, if it is one of those wanted and has labels of points."""
        labels = next((v for v in result.predictions.values() if isinstance(v, PointLabels)), None)
        points = next((v for v in result.inputs.values() if isinstance(v, Points)), None)
        if result.meta.index not in self.wanted or labels is None or points is None:
            return
        title = f"{result.meta.sequence} {result.meta.id}"
        above = draw.birds_eye(points, classes=self.classes, labels=labels, extent=_EXTENT, title=title)
        parts = [above]
        image = next((v for v in result.inputs.values() if isinstance(v, RangeImage)), None)
        if image is not None:
            scale = max(1, image.mask.shape[2] // (8 * image.mask.shape[1]))
            parts.insert(0, draw.range_labels(image, points, labels, self.classes, scale))
        self.pictures.append(draw.side_by_side(parts, 1, 900))

    def picture(self) -> draw.Picture:
        """All of them, three in a row."""
        return draw.side_by_side(self.pictures, min(3, len(self.pictures)), 900)


class StaticMap:
    """The points of a drive that do not move, in the map frame: one for each cell of side `cell` metres."""

    def __init__(
        self, cell: float = 0.1, moving: str = "moving", classes: Sequence[str] = ("static", "moving")
    ) -> None:
        if moving not in classes:
            raise DataError(f"a static map leaves out the class '{moving}', and the model knows {', '.join(classes)}")
        self.cell, self.moving = cell, list(classes).index(moving)
        self.cells = torch.zeros(0, dtype=torch.long)

    def add(self, result: FrameResult) -> None:
        """Take in the points of a frame that do not move. DataError for a frame without a pose."""
        pose = next((v for v in result.inputs.values() if isinstance(v, Poses)), None)
        points = next((v for v in result.inputs.values() if isinstance(v, Points)), None)
        if pose is None or points is None:
            raise DataError(f"frame {result.meta.id}: a static map needs the pose of every scan")
        still = points.xyz[labels_of(result).label != self.moving]
        place = (transform(pose.matrix[0].double(), still.double()) / self.cell).floor().long() + _FAR
        key = (place[:, 0] << 42) | (place[:, 1] << 21) | place[:, 2]
        self.cells = torch.unique(torch.cat([self.cells, key]))

    def points(self) -> Tensor:
        """(N, 3) centres of the cells, metres."""
        mask = 2 * _FAR - 1
        index = torch.stack([self.cells >> 42, (self.cells >> 21) & mask, self.cells & mask], 1)
        return ((index - _FAR + 0.5) * self.cell).float()

    def write(self, path: Path) -> None:
        """Write a binary PLY file."""
        xyz = self.points().numpy().astype("<f4")
        properties = "".join(f"property float {axis}\n" for axis in "xyz")
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{properties}end_header\n"
        with atomic_path(path) as temporary:
            temporary.write_bytes(header.encode() + xyz.tobytes())


__all__ = ["SequenceFrames", "StaticMap", "Strip", "is_sequence", "labels_of", "save_labels"]
