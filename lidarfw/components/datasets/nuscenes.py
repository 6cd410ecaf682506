"""nuScenes in its official layout: boxes with velocities and identities, and ten scans per frame.

Source: Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidarfw import nuscenes
from lidarfw._lazy import LazyModule
from lidarfw.components.datasets.drives import Array, Drive, DriveDataset, inverse, pose_of
from lidarfw.errors import ConfigError, DataError
from lidarfw.io import read_image, read_points
from lidarfw.nuscenes import CLASSES
from lidarfw.types import Boxes, Camera, DataSpec, Frame, FrameMeta, Image, Points, Poses, Spec, Targets, Tracks

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

_OWN = 1.0  # metres: past returns nearer than this along x and y are of the vehicle itself
_FULL = 255  # intensity that becomes 1
_CAMERA = Camera("pinhole", 1600, 900, (1266.4172, 1266.4172, 816.267, 491.5071))  # CAM_FRONT of a scene, for the spec
_MINI_VAL = (103, 916)
_VAL = (
    3, *range(12, 19), 35, 36, 38, 39, *range(92, 111), 221, *range(268, 279), *range(329, 333), *range(344, 347),
    *range(519, 525), *range(552, 566), 625, 626, 627, 629, 630, *range(632, 639), 770, 771, 775, 777, 778,
    *range(780, 785), *range(794, 801), 802, *range(904, 918), *range(919, 932), 962, 963, *range(966, 970), 971, 972,
    *range(1059, 1074),
)  # fmt: skip


class NuScenesDataset(DriveDataset):
    """nuScenes: ROOT/v1.0-trainval/*.json, ROOT/samples and ROOT/sweeps. Frames are the key frames, two a second.

    Points have one feature, the intensity 0..1. Targets are boxes of the ten detection classes with velocity (NaN
    where it is not known) and moving state, the same boxes as tracks, and the LiDAR's pose in the global frame of the
    log's map. Boxes without a LiDAR or radar point are ignored targets, as in the benchmark.
    """

    camera: Camera = _CAMERA  # for the spec

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        version: str = "v1.0-trainval",
        classes: tuple[str, ...] = CLASSES,
        sweeps: int = 10,
        pose: bool = False,
        image: str = "",
    ) -> None:
        """Options.

        root: folder that holds the version, samples/ and sweeps/. split: train, val (of v1.0-mini: mini_train,
        mini_val), all, or scenes such as scene-0061; joined by +. version: v1.0-trainval, v1.0-mini or v1.0-test,
        which has no labels. classes: of the detection benchmark. sweeps: scans per frame, 20 a second, the past ones
        moved into the frame of the current one. pose: also give the LiDAR's pose, as the input `pose`. image: a camera
        such as CAM_FRONT, whose picture is also given, as the input `image`; none where empty.
        """
        unknown = [name for name in classes if name not in nuscenes.CLASSES]
        if unknown:
            known = ", ".join(nuscenes.CLASSES)
            raise ConfigError(f"dataset 'nuscenes' has no class '{unknown[0]}'. Classes: {known}")
        if sweeps < 1:
            raise ConfigError(f"dataset.nuscenes.sweeps must be at least 1, got {sweeps}")
        self.root, self.split, self.version = root, split, version
        self.classes, self.sweeps, self.pose, self.image = tuple(classes), sweeps, pose, image
        self.labelled = not version.endswith("test")
        inputs = {"points": Spec(Points, channels=1)} | ({"pose": Spec(Poses)} if pose else {})
        inputs |= {"image": Spec(Image, channels=3, geometry=self.camera)} if image else {}
        targets = frozenset({Boxes, Tracks, Poses} if self.labelled else {Poses})
        self.spec = DataSpec(inputs, targets, self.classes, sweeps)

    @property
    def folder(self) -> Path:
        """ROOT/VERSION, the folder of the tables."""
        if not self.root:
            raise DataError("dataset.nuscenes.root is not set.\n  fix: dataset.nuscenes.root=/path/to/nuscenes")
        folder = Path(self.root) / self.version
        if not folder.is_dir():
            raise DataError(
                f"{folder}: no such folder.\n  fix: dataset.nuscenes.root must hold {self.version}, samples and sweeps;"
                f" or dataset.nuscenes.version=v1.0-mini"
            )
        return folder

    @property
    def named(self) -> list[str]:
        """The scenes of the split, but for `all`."""
        val = {f"scene-{n:04d}" for n in (_MINI_VAL if self.version.endswith("mini") else _VAL)}
        names: list[str] = []
        for part in self.split.split("+"):
            if part in ("train", "val"):
                names += [name for name in self.present() if (name in val) == (part == "val")]
            elif part != "all":
                names.append(part)
        return names

    def present(self) -> list[str]:
        return nuscenes.scene_names(self.folder)

    @functools.cached_property
    def scenes(self) -> dict[str, nuscenes.Scene]:
        """The scenes of the split, by name."""
        names = [*self.named, *(self.present() if "all" in self.split.split("+") else [])]
        return nuscenes.read_scenes(self.folder, names)

    def open(self, sequence: str) -> Drive:
        """The key frames of a scene."""
        scene, root = self.scenes[sequence], Path(self.root)
        files = [root / scene.sweeps.files[key] for key in scene.keys]
        return Drive(sequence, files, scene.sweeps.times[scene.keys], scene.sweeps.poses[scene.keys])

    def prepare(self, workers: int = 0) -> None:
        """Check that every scan of the split is there, the past ones that it needs too."""
        for drive in self.drives:
            whole = self._whole(drive.name)
            needed = {past for key in self.scenes[drive.name].keys for past in self.recent(key)}
            missing = [whole.scans[place] for place in sorted(needed) if not whole.scans[place].is_file()]
            if missing:
                raise DataError(
                    f"{missing[0]}: no such file, nor {len(missing) - 1} other scans of {drive.name}.\n"
                    f"  fix: unpack all parts of {self.version}, name the scenes that are there as the split, "
                    f"or sweeps=1 without the sweeps"
                )

    def meta(self, index: int) -> FrameMeta:
        """Id, time, files and cameras of a frame."""
        drive, place = self.find(index)
        meta = super().meta(index)
        meta.id = f"{drive.name}/{place:02d}"
        pictures = self.scenes[drive.name].pictures[place]
        meta.images = {name: str(Path(self.root) / picture.file) for name, picture in pictures.items()}
        lidar = self.scenes[drive.name].sweeps.poses[self.scenes[drive.name].keys[place]]
        meta.cameras = {name: _camera(picture, lidar) for name, picture in pictures.items()}
        return meta

    def __getitem__(self, index: int) -> Frame:
        drive, place = self.find(index)
        scene, pose = self.scenes[drive.name], pose_of(drive, place)
        points = self.points(self._whole(drive.name), scene.keys[place])
        inputs: dict[str, Points | Poses | Image | None] = {"points": points} | ({"pose": pose} if self.pose else {})
        meta = self.meta(index)
        if self.image:
            inputs["image"] = self._picture(meta)
        lidar = scene.sweeps.poses[scene.keys[place]]
        targets = self._targets(scene.objects[place], lidar) if self.labelled else Targets()
        return Frame(inputs, targets.replace(poses=pose), meta)

    def _picture(self, meta: FrameMeta) -> Image:
        if self.image not in meta.images:
            there = ", ".join(meta.images) or "none"
            raise DataError(
                f"frame {meta.id} has no picture of {self.image}; of: {there}\n  fix: dataset.nuscenes.image= (none)"
            )
        picture, camera = read_image(meta.images[self.image]), meta.cameras[self.image]
        if picture.shape[:2] != (camera.height, camera.width):
            raise DataError(
                f"{meta.images[self.image]}: expected {camera.width} x {camera.height} pixels, "
                f"found {picture.shape[1]} x {picture.shape[0]}"
            )
        return Image(torch.tensor(picture.transpose(2, 0, 1)[None]).float() / 255, (camera,))

    def scans(self, drive: Drive, place: int) -> list[Points]:
        """The scans of a frame; past ones without the vehicle, which else would leave a trail."""
        current, *past = super().scans(drive, place)
        return [current, *(scan[(scan.xyz[:, :2].abs() >= _OWN).any(1)] for scan in past)]

    def scan(self, drive: Drive, place: int) -> Points:
        """One scan in our convention, with its intensity 0..1; the ring is left out."""
        path = drive.scans[place]
        read = read_points(path, columns=5)
        intensity = read.features[:, :1] / _FULL
        low, high = float(intensity.min()), float(intensity.max())
        if low < 0 or high > 1:
            raise DataError(f"{path}: intensity: expected 0..{_FULL}, found {low * _FULL:g}..{high * _FULL:g}")
        xyz = np.stack([read.xyz[:, 1], -read.xyz[:, 0], read.xyz[:, 2]], 1)
        return Points.from_scan(torch.tensor(xyz), torch.tensor(intensity))

    def _whole(self, name: str) -> Drive:
        """All scans of a scene."""
        sweeps = self.scenes[name].sweeps
        return Drive(name, [Path(self.root) / file for file in sweeps.files], sweeps.times, sweeps.poses)

    def _targets(self, objects: nuscenes.Objects, lidar: Array) -> Targets:
        """Objects in the LiDAR's frame, given its pose (4, 4)."""
        names = [nuscenes.CATEGORIES.get(category, "") for category in objects.category]
        label = np.array([self.classes.index(n) if n in self.classes else -1 for n in names], dtype=np.int64)
        inverted = inverse(lidar)
        center = objects.center @ inverted[:3, :3].T + inverted[:3, 3]
        heading, velocity = (vector @ inverted[:3, :3].T for vector in (objects.heading, objects.velocity))
        table = np.column_stack([center, objects.size, np.arctan2(heading[:, 1], heading[:, 0])])
        every = Boxes.from_tensor(torch.tensor(table, dtype=torch.float32), torch.from_numpy(label)).replace(
            velocity=torch.tensor(velocity[:, :2], dtype=torch.float32), moving=torch.from_numpy(objects.moving)
        )
        known, seen = torch.from_numpy(label >= 0), torch.from_numpy(objects.points > 0)
        boxes = every[known & seen]
        tracks = Tracks(boxes, torch.from_numpy(objects.track)[known & seen])
        return Targets(boxes=boxes, ignored=every[known & ~seen], tracks=tracks)


def _camera(picture: nuscenes.Picture, lidar: Array) -> Camera:
    """The camera at the time of its picture, seen from the LiDAR at the time of its scan."""
    matrix = inverse(picture.pose) @ lidar
    rows = tuple(tuple(float(value) for value in row) for row in matrix)
    return Camera("pinhole", *picture.size, picture.intrinsics, (), rows)
