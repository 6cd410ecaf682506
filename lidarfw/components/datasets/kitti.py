"""The KITTI object detection benchmark in its official layout.

Source: Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidarfw import kitti
from lidarfw._lazy import LazyModule
from lidarfw.errors import DataError
from lidarfw.interfaces.data import Dataset
from lidarfw.io import read_image, read_points
from lidarfw.types import Boxes, Camera, DataSpec, Frame, FrameMeta, Image, Points, Spec, Targets

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

PICTURE = (1242, 375)  # usual width and height; assumed where no pictures were downloaded
CANVAS = (1248, 384)  # pictures differ by some pixels: as an input they are padded to this at the right and bottom
_SUFFIXES = (".png", ".jpg")
CAMERA = Camera("pinhole", *CANVAS, (721.5377, 721.5377, 609.5593, 172.854))  # of most recordings, for the spec


class KittiDataset(Dataset):
    """KITTI object detection: ROOT/training and ROOT/testing with velodyne, calib, label_2, image_2, planes.

    Splits are the files ROOT/ImageSets/SPLIT.txt, one frame id per line; `all` needs none, it is every scan of
    ROOT/training. `test` reads ROOT/testing, which has no labels. Frames are single: every one is its own sequence.
    Points have one feature, remission 0..1. Van is neutral for Car, Person_sitting for Pedestrian, DontCare for
    every class (see `lidarfw.kitti.boxes_from_labels`); labels of other types are left out unless `classes` names them.
    The frame's cameras are `image` (the left colour picture) and `rectified` (the frame of the labels).
    """

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"),
        camera_view: bool = True,
        image: bool = False,
    ) -> None:
        """Options.

        root: folder that holds training/. split: a name of ImageSets, or `all`. classes: types to learn.
        camera_view: keep only points in the picture, as the benchmark labels only what the camera sees.
        image: also give the picture, as the input `image`.
        """
        self.root, self.split, self.classes = root, split, tuple(classes)
        self.camera_view, self.image = camera_view, image
        inputs = {"points": Spec(Points, channels=1)}
        inputs |= {"image": Spec(Image, channels=3, geometry=CAMERA)} if image else {}
        self.spec = DataSpec(inputs, frozenset() if split == "test" else frozenset({Boxes}), self.classes)

    @property
    def folder(self) -> Path:
        """ROOT/training, or ROOT/testing for the split `test`."""
        if not self.root:
            raise DataError(
                "dataset.kitti.root is not set.\n  fix: dataset.kitti.root=/path/to/kitti (it holds training/)"
            )
        return Path(self.root) / ("testing" if self.split == "test" else "training")

    @functools.cached_property
    def ids(self) -> list[str]:
        """Frame ids of the split, in the order of its file."""
        listed = Path(self.root) / "ImageSets" / f"{self.split}.txt"
        if not self.folder.is_dir():
            raise DataError(
                f"{self.folder}: no such folder.\n  fix: dataset.kitti.root must hold training/velodyne ..."
            )
        if listed.is_file():
            ids = kitti.read_text(listed).split()
        elif self.split in ("all", "test"):
            ids = sorted(path.stem for path in (self.folder / "velodyne").glob("*.bin"))
        else:
            raise DataError(
                f"{listed}: no such file, and the split '{self.split}' is what it lists.\n"
                f"  fix: write it (one frame id per line), or take every frame: splits.train=all splits.val=all"
            )
        if not ids:
            raise DataError(
                f"the split '{self.split}' of {self.root} has no frames: {listed} is empty or no scans there"
            )
        return ids

    def prepare(self, workers: int = 0) -> None:
        """Check that every file of the split is there, so that a gap shows before training and not within."""
        needed: dict[str, tuple[str, ...]] = {"velodyne": (".bin",), "calib": (".txt",)}
        needed |= {} if self.split == "test" else {"label_2": (".txt",)}
        needed |= {"image_2": _SUFFIXES} if self.image else {}
        for folder, suffixes in needed.items():
            there = {p.stem for p in (self.folder / folder).glob("*") if p.suffix in suffixes}
            missing = [name for name in self.ids if name not in there]
            if missing:
                raise DataError(
                    f"{self.folder / folder}: {len(missing)} of the {len(self.ids)} frames of split '{self.split}' "
                    f"are missing, the first is {missing[0]}{suffixes[0]}.\n"
                    f"  fix: download them, or correct the split file"
                )

    def __len__(self) -> int:
        return len(self.ids)

    def meta(self, index: int) -> FrameMeta:
        """Id and files of a frame, without its cameras."""
        name = self.ids[index]
        scan, picture = self.folder / "velodyne" / f"{name}.bin", self._picture(name)
        return FrameMeta(name, name, path=str(scan), images={} if picture is None else {kitti.IMAGE: str(picture)})

    def sequences(self) -> list[Sequence[int]]:
        """Every frame by itself: they come from different drives."""
        return [[index] for index in range(len(self))]

    def __getitem__(self, index: int) -> Frame:
        meta = self.meta(index)
        calibration = kitti.read_calibration(self.folder / "calib" / f"{meta.id}.txt")
        meta.cameras = calibration.cameras(*self._picture_size(meta))
        inputs: dict[str, Points | Image] = {"points": self._points(meta)}
        if self.image:
            inputs["image"] = self._image(meta)
        return Frame(inputs, self._targets(meta.id, calibration), meta)

    def road_plane(self, name: str) -> kitti.Array:
        """The ground (4,) a, b, c, d with a x + b y + c z + d = 0 in the LiDAR frame, from training/planes/ID.txt.

        The normal (a, b, c) has length 1 and points up.
        """
        path = self.folder / "planes" / f"{name}.txt"
        lines = kitti.read_text(path).split("\n")
        try:
            plane = np.array([float(word) for word in lines[3].split()])
        except (IndexError, ValueError):
            plane = np.zeros(0)
        if plane.shape != (4,) or not np.isfinite(plane).all() or np.linalg.norm(plane[:3]) < 1e-6:
            raise DataError(
                f"{path}: line 4: expected the plane a b c d, found {lines[3:4]}. Download the planes again."
            )
        calibration = kitti.read_calibration(self.folder / "calib" / f"{name}.txt")
        level: kitti.Array = plane @ calibration.to_rectified
        level /= np.linalg.norm(level[:3])
        return level if level[2] > 0 else -level

    def _picture(self, name: str) -> Path | None:
        found = (self.folder / "image_2" / f"{name}{suffix}" for suffix in _SUFFIXES)
        return next((path for path in found if path.is_file()), None)

    def _picture_size(self, meta: FrameMeta) -> tuple[int, int]:
        """Width and height of the picture, from its header."""
        if kitti.IMAGE in meta.images:
            return picture_size(meta.images[kitti.IMAGE])
        width, height = PICTURE
        warnings.warn(
            f"{self.folder / 'image_2'} lacks pictures: the view is taken as {width} x {height}", stacklevel=2
        )
        return PICTURE

    def _points(self, meta: FrameMeta) -> Points:
        scan = read_points(meta.path, columns=4)
        low, high = float(scan.features.min()), float(scan.features.max())
        if low < 0 or high > 1:
            raise DataError(
                f"{meta.path}: remission: expected 0..1, found {low:g}..{high:g}.\n"
                f"  fix: a scan has 4 float32 columns x, y, z, remission; scale other intensities to 0..1"
            )
        points = Points.from_scan(torch.tensor(scan.xyz), torch.tensor(scan.features))
        if not self.camera_view:
            return points
        return points[meta.cameras[kitti.IMAGE].project(points.xyz)[2]]

    def _image(self, meta: FrameMeta) -> Image:
        if kitti.IMAGE not in meta.images:
            raise DataError(
                f"{self.folder / 'image_2'}: no picture {meta.id}.png.\n"
                f"  fix: download it, or dataset.kitti.image=false"
            )
        return padded_picture(meta.images[kitti.IMAGE], meta.cameras[kitti.IMAGE], CANVAS)

    def _targets(self, name: str, calibration: kitti.Calibration) -> Targets:
        if self.split == "test":
            return Targets()
        types = [*kitti.TYPES, *(c for c in self.classes if c not in kitti.TYPES)]
        labels = kitti.read_labels(self.folder / "label_2" / f"{name}.txt", types)
        boxes, ignored = kitti.boxes_from_labels(labels, calibration, self.classes)
        return Targets(boxes=boxes, ignored=ignored)


def padded_picture(path: str, camera: Camera, canvas: tuple[int, int]) -> Image:
    """A picture 0..1 as an input, padded with black at the right and bottom to `canvas` (width, height).

    DataError where it is larger.
    """
    picture = read_image(path)
    height, width = picture.shape[:2]
    if width > canvas[0] or height > canvas[1]:
        raise DataError(
            f"{path}: expected at most {canvas[0]} x {canvas[1]} pixels, "
            f"found {width} x {height}. KITTI's pictures are about {PICTURE[0]} x {PICTURE[1]}"
        )
    padded = np.zeros((3, canvas[1], canvas[0]), np.float32)
    padded[:, :height, :width] = picture.transpose(2, 0, 1) / 255
    return Image(torch.tensor(padded)[None], (camera.cropped(0, 0, *canvas),))


def picture_size(path: str) -> tuple[int, int]:
    """Width and height of a picture, from its header; DataError where it is none."""
    from PIL import Image as Picture

    try:
        with Picture.open(path) as picture:
            return picture.size
    except (OSError, ValueError, Picture.DecompressionBombError) as error:
        raise DataError(f"{path}: is not a readable picture: {error}.\n  fix: copy it again") from error
