"""Datasets of the town: the core's loaders of real layouts, over files that are made on first use."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from lidarfw.components.datasets.drives import DriveDataset
from lidarfw.components.datasets.kitti import CAMERA, PICTURE, KittiDataset
from lidarfw.components.datasets.kitti_360 import Kitti360Dataset
from lidarfw.components.datasets.kitti_tracking import KittiTrackingDataset
from lidarfw.components.datasets.nuscenes import NuScenesDataset
from lidarfw.components.datasets.oxford import OxfordDataset
from lidarfw.components.datasets.semantic_kitti import SemanticKittiDataset
from lidarfw.errors import DataError
from lidarfw.interfaces.data import Dataset
from lidarfw.nuscenes import CLASSES
from lidarfw.types import Camera, DataSpec, Frame, Image, Spec, Tracks

from lidarfw_town.version import VERSION

if TYPE_CHECKING:
    from lidarfw_town.generate import Job

_TILE = 32  # pixels: pictures as inputs are padded to whole ones, for networks of that stride
VALIDATION_SHARE = 4  # of single frames: one of validation for four of training


class TownDataset(Dataset):
    """What the datasets of the town share: files that are made on first use, in a folder named by the options.

    `layout` is that of the files; `made` says which of its splits each split of the dataset reads. Options that all
    have: sensor (hdl64, hdl32, ouster32 or small); seed (another one is another town); picture_width in pixels, 0 for
    no pictures; weather (clear, rain, fog or night); cache, the folder of folders (empty: lidarfw/town in
    $XDG_CACHE_HOME or ~/.cache); workers, the processes that make the files (0: one a core).
    """

    layout: ClassVar[str]
    made: ClassVar[Mapping[str, str]] = {"train": "train", "val": "val"}

    def _settle(self, split: str, frames: Mapping[str, int], cache: str, workers: int, **settings: str | int) -> str:
        """Take the options that say what to make, `frames` by split of the layout; the folder of the files."""
        if split not in self.made:
            raise DataError(
                f"the datasets of the town in the layout {self.layout} have the splits {', '.join(self.made)}, not "
                f"{split!r}.\n  fix: splits.test={list(self.made)[-1]}"
            )
        self._frames, self._settings, self._workers = dict(frames), {"layout": self.layout, **settings}, workers
        self._make = self.made[split]
        mark = hashlib.sha256(json.dumps([self._settings, self._frames, VERSION]).encode()).hexdigest()[:8]
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        base = Path(cache) if cache else Path(home) / "lidarfw" / "town"
        self._folder = base / f"{self.layout}-{settings['sensor']}-{frames['train']}-seed{settings['seed']}-{mark}"
        return str(self._folder)

    @property
    def job(self) -> Job:
        """What to make for the split."""
        from lidarfw_town.generate import Job  # imports the ray caster, which a spec does not need

        return Job(root=str(self._folder), split=self._make, frames=self._frames[self._make], **self._settings)  # type: ignore[arg-type]

    def prepare(self, workers: int = 0) -> None:
        """Make the files of the split, unless they stand."""
        from lidarfw_town.generate import generate

        generate(self.job, workers or self._workers or os.cpu_count() or 1)
        super().prepare(workers)


class TownDrives(TownDataset, DriveDataset):
    """Datasets of whole drives. Options that all have: `drives` of training, and of each the frames `length`, which
    are `stride` steps of 0.1 s apart. There are half as many of the other split, one at least and `most` at most.
    """

    most: ClassVar[int]  # drives that the loader knows in the split that is not for training

    def _settle_drives(
        self, split: str, drives: int, length: int, cache: str, workers: int, **settings: str | int
    ) -> str:
        held_out = next(name for name in self.made.values() if name != "train")
        self._drives = {"train": drives, held_out: min(max(drives // 2, 1), self.most)}
        frames = {name: count * length for name, count in self._drives.items()}
        return self._settle(split, frames, cache, workers, length=length, **settings)

    @property
    def named(self) -> list[str]:
        """Those of the split's drives that are made."""
        return super().named[: self._drives[self._make]]


class TownKitti(TownDataset, KittiDataset):
    """Frames of a simulated town in the layout of KITTI object detection, read by the loader for the real ones.

    Splits are `train` and `val`, from different towns.
    """

    example: ClassVar[dict[str, object]] = {"frames": 2, "picture_width": 310, "workers": 1}
    layout = "kitti"

    def __init__(
        self,
        *,
        split: str = "train",
        classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"),
        camera_view: bool = True,
        image: bool = False,
        frames: int = 200,
        sensor: str = "small",
        seed: int = 1,
        picture_width: int = 621,
        weather: str = "clear",
        cache: str = "",
        workers: int = 0,
    ) -> None:
        """Options.

        split: train or val. classes, camera_view, image: as in `kitti`. frames: of the split train; val has a quarter.
        The others: see `TownDataset`.
        """
        count = {"train": frames, "val": max(frames // VALIDATION_SHARE, 1)}
        root = self._settle(
            split, count, cache, workers, sensor=sensor, seed=seed, picture_width=picture_width, weather=weather
        )
        super().__init__(root=root, split=split, classes=classes, camera_view=camera_view, image=image)


class TownTracking(TownDrives, KittiTrackingDataset):
    """Drives through simulated towns in the layout of KITTI tracking: boxes with identities, ten scans a second.

    Splits are `train` and `val`, every drive in another town.
    """

    example: ClassVar[dict[str, object]] = {"drives": 1, "length": 3, "workers": 1}
    layout, most = "kitti_tracking", 11

    def __init__(
        self,
        *,
        split: str = "train",
        classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"),
        camera_view: bool = True,
        poses: str = "oxts",
        sweeps: int = 1,
        pose: bool = False,
        image: bool = False,
        drives: int = 4,
        length: int = 60,
        sensor: str = "small",
        seed: int = 1,
        picture_width: int = 0,
        weather: str = "clear",
        cache: str = "",
        workers: int = 0,
    ) -> None:
        """Options.

        split: train or val. classes, camera_view, poses, sweeps, pose, image: as in `kitti_tracking`. drives, length:
        see `TownDrives`. The others: see `TownDataset`.
        """
        root = self._settle_drives(
            split, drives, length, cache, workers, sensor=sensor, seed=seed, picture_width=picture_width,
            weather=weather,
        )  # fmt: skip
        if picture_width:
            whole = replace(CAMERA, width=PICTURE[0], height=PICTURE[1]).scaled(picture_width / PICTURE[0])
            self.camera = whole.cropped(0, 0, *(-(-side // _TILE) * _TILE for side in (whole.width, whole.height)))
        super().__init__(
            root=root, split=split, classes=classes, camera_view=camera_view, poses=poses, sweeps=sweeps, pose=pose,
            image=image,
        )  # fmt: skip


class TownMos(TownDrives, SemanticKittiDataset):
    """Drives through simulated towns in the layout of SemanticKITTI, for the segmentation of moving objects.

    Splits are `train` and `val`, every drive in another town; `val` is one drive, as there. Ten scans a second.
    """

    example: ClassVar[dict[str, object]] = {"drives": 1, "length": 3, "workers": 1}
    layout, most = "semantic_kitti", 1

    def __init__(
        self,
        *,
        split: str = "train",
        task: str = "moving",
        sweeps: int = 1,
        pose: bool = False,
        drives: int = 4,
        length: int = 60,
        sensor: str = "small",
        seed: int = 1,
        picture_width: int = 0,
        weather: str = "clear",
        cache: str = "",
        workers: int = 0,
    ) -> None:
        """Options.

        split: train or val. task, sweeps, pose: as in `semantic_kitti`; task=semantics for the other one. drives,
        length: see `TownDrives`. The others: see `TownDataset`.
        """
        root = self._settle_drives(
            split, drives, length, cache, workers, sensor=sensor, seed=seed, picture_width=picture_width,
            weather=weather,
        )  # fmt: skip
        super().__init__(root=root, split=split, task=task, sweeps=sweeps, pose=pose)


class TownOxford(TownDrives, OxfordDataset):
    """Traversals of one circuit of a simulated town in the layout of Oxford Radar RobotCar, with poses and boxes.

    Splits are `train`, and `val` and `test`, which are other traversals of the same circuit. Every second traversal
    goes the other way; parked vehicles, traffic and light are others each time.
    """

    example: ClassVar[dict[str, object]] = {"drives": 2, "length": 2, "workers": 1}
    layout, most = "oxford", 4
    made: ClassVar[Mapping[str, str]] = {"train": "train", "val": "test", "test": "test"}

    def __init__(
        self,
        *,
        split: str = "train",
        boxes: bool = True,
        classes: tuple[str, ...] = ("Vehicle", "Pedestrian", "Cyclist"),
        sweeps: int = 1,
        pose: bool = False,
        drives: int = 4,
        length: int = 120,
        stride: int = 8,
        sensor: str = "small",
        seed: int = 1,
        weather: str = "clear",
        cache: str = "",
        workers: int = 0,
    ) -> None:
        """Options.

        split: train, val or test. boxes, classes, sweeps, pose: as in `oxford`. drives, length, stride: see
        `TownDrives`; the usual values go once round the circuit. The others: see `TownDataset`.
        """
        root = self._settle_drives(
            split, drives, length, cache, workers, stride=stride, sensor=sensor, seed=seed, picture_width=0,
            weather=weather,
        )  # fmt: skip
        super().__init__(root=root, split=split, boxes=boxes, classes=classes, sweeps=sweeps, pose=pose)
        if boxes:  # every object of the town has an identity
            self.spec = replace(self.spec, targets=self.spec.targets | {Tracks})


class Town360(TownDrives, Kitti360Dataset):
    """Traversals of one circuit of a simulated town in the layout of KITTI-360: scans, two fisheyes, poses.

    Splits are `train`, and `val` and `test`, which are other traversals of the same circuit. Every second traversal
    goes the other way; parked vehicles, traffic and light are others each time. The truth of a camera CAMERA may be
    given as inputs of one channel: CAMERA_depth in metres (0 where nothing is; z of a perspective picture, the
    distance from a fisheye) and CAMERA_semantics, the ids of KITTI-360.
    """

    example: ClassVar[dict[str, object]] = {
        "drives": 1, "length": 2, "picture_width": 100, "images": ("image_02",), "depth": True, "workers": 1,
    }  # fmt: skip
    layout, most = "kitti_360", 2
    made: ClassVar[Mapping[str, str]] = {"train": "train", "val": "test", "test": "test"}

    def __init__(
        self,
        *,
        split: str = "train",
        images: tuple[str, ...] = ("image_02", "image_03"),
        image_scale: float = 1.0,
        depth: bool = False,
        semantics: bool = False,
        sweeps: int = 1,
        pose: bool = False,
        drives: int = 2,
        length: int = 120,
        stride: int = 8,
        sensor: str = "small",
        seed: int = 1,
        picture_width: int = 350,
        weather: str = "clear",
        cache: str = "",
        workers: int = 0,
    ) -> None:
        """Options.

        split: train, val or test. images, image_scale, sweeps, pose: as in `kitti_360`. depth, semantics: also give
        the truth of the images. drives, length, stride: see `TownDrives`; the usual values go once round the circuit.
        picture_width: of the fisheyes. The others: see `TownDataset`.
        """
        root = self._settle_drives(
            split, drives, length, cache, workers, stride=stride, sensor=sensor, seed=seed,
            picture_width=picture_width, weather=weather,
        )  # fmt: skip
        super().__init__(root=root, split=split, images=images, image_scale=image_scale, sweeps=sweeps, pose=pose)
        self._truth = [kind for kind, wanted in (("depth", depth), ("semantics", semantics)) if wanted]
        self.spec = self._sized(picture_width)

    def _sized(self, width: int) -> DataSpec:
        """The spec with the cameras of the town, and with the truth of their pictures."""
        from lidarfw_town.layouts.kitti_360 import rig  # imports the ray caster

        cameras = {name: rig(width)[name].scaled(self.image_scale) for name in self.images}
        inputs = {name: replace(spec, geometry=cameras.get(name)) for name, spec in self.spec.inputs.items()}
        for name, kind in itertools.product(self.images, self._truth):
            inputs[f"{name}_{kind}"] = Spec(Image, channels=1, geometry=cameras[name])
        return replace(self.spec, inputs=inputs)

    def __getitem__(self, index: int) -> Frame:
        frame, (drive, place) = super().__getitem__(index), self.find(index)
        folders = {"depth": "data_2d_depth/{}/{}", "semantics": "data_2d_semantics/train/{}/{}/semantic"}
        for name, kind in itertools.product(self.images, self._truth):
            path = Path(self.root) / folders[kind].format(drive.name, name) / f"{drive.scans[place].stem}.png"
            frame.inputs[f"{name}_{kind}"] = _values(path, frame.inputs[name].cameras[0], 256 if kind == "depth" else 1)
        return frame


def _values(path: Path, camera: Camera, units: int) -> Image:
    """A picture of one number a pixel, as large as the camera's; of several pixels the one in the middle is taken."""
    import cv2
    import torch

    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise DataError(f"{path}: cannot be read as a picture.\n  fix: delete the folder, it is made again")
    sized = cv2.resize(stored, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
    return Image(torch.tensor(sized.astype(np.float32) / units)[None, None], (camera,))


class TownNuScenes(TownDrives, NuScenesDataset):
    """Scenes of simulated towns in the layout of nuScenes: boxes with velocities and identities, and past scans.

    Splits are `train` and `val`, every scene in another town. There are ten scans a second, and two key frames.
    """

    example: ClassVar[dict[str, object]] = {"drives": 1, "length": 6, "sensor": "small", "workers": 1}
    layout, most = "nuscenes", 12

    def __init__(
        self,
        *,
        split: str = "train",
        classes: tuple[str, ...] = CLASSES,
        sweeps: int = 5,
        pose: bool = False,
        image: str = "",
        drives: int = 4,
        length: int = 100,
        sensor: str = "hdl32",
        seed: int = 1,
        picture_width: int = 0,
        weather: str = "clear",
        cache: str = "",
        workers: int = 0,
    ) -> None:
        """Options.

        split: train or val. classes, sweeps, pose, image: as in `nuscenes`; sweeps=5 is the half second that ten scans
        are there. drives, length: see `TownDrives`; length counts scans, of which every fifth is a frame.
        picture_width: of the six pictures of a key frame. The others: see `TownDataset`.
        """
        root = self._settle_drives(
            split, drives, length, cache, workers, sensor=sensor, seed=seed, picture_width=picture_width,
            weather=weather,
        )  # fmt: skip
        if picture_width:
            self.camera = self.camera.scaled(picture_width / self.camera.width)
        super().__init__(root=root, split=split, classes=classes, sweeps=sweeps, pose=pose, image=image)
