"""Datasets of the town: the core's loaders of real layouts, over files that are made on first use."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from lidarfw.components.datasets.kitti import KittiDataset
from lidarfw.errors import DataError

from lidarfw_town.version import VERSION

VALIDATION_SHARE = 4  # a town of validation frames for four of training


class TownKitti(KittiDataset):
    """Frames of a simulated town in the layout of KITTI object detection, read by the loader for the real ones.

    Splits are `train` and `val`, from different towns. The files go to a cache folder named by the options, so they
    are made once: about four frames a second with the LiDAR `small`.
    """

    example: ClassVar[dict[str, object]] = {"frames": 2, "picture_width": 310}

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
        workers: int = 1,
    ) -> None:
        """Options.

        split: train or val. classes, camera_view, image: as in `kitti`. frames: of the split train; val has a quarter.
        sensor: hdl64, hdl32, ouster32 or small. seed: another seed is another town. picture_width: pixels.
        weather: clear, rain or fog. cache: folder for the files; empty: $XDG_CACHE_HOME or ~/.cache, lidarfw/town.
        workers: processes that make the files; more than one needs a guarded main module.
        """
        super().__init__(split=split, classes=classes, camera_view=camera_view, image=image)
        self.frames, self.sensor, self.seed, self.picture_width = frames, sensor, seed, picture_width
        self.weather, self.cache, self.workers = weather, cache, workers
        self.root = str(self._folder())

    def prepare(self) -> None:
        """Make the files of the split, unless they stand."""
        from lidarfw_town.generate import Job, generate

        if self.split not in ("train", "val"):
            raise DataError(f"town_kitti has the splits train and val, not {self.split!r}.\n  fix: splits.test=val")
        width, weather = self.picture_width, self.weather
        job = Job("kitti", self.root, self.seed, self.frames, self.sensor, picture_width=width, weather=weather)
        if self.split == "val":
            job = replace(job, frames=max(self.frames // VALIDATION_SHARE, 1), split="val")
        generate(job, self.workers)
        super().prepare()

    def _folder(self) -> Path:
        options = {"frames": self.frames, "sensor": self.sensor, "seed": self.seed}
        options |= {"picture_width": self.picture_width, "weather": self.weather}
        mark = hashlib.sha256(json.dumps([options, VERSION]).encode()).hexdigest()[:8]
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        base = Path(self.cache) if self.cache else Path(home) / "lidarfw" / "town"
        return base / f"kitti-{self.sensor}-{self.frames}-seed{self.seed}-{mark}"
