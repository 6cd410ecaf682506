"""A database of labelled objects cut out of the scans of a dataset, for ground-truth sampling."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import shutil
import zipfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarfw._lazy import LazyModule
from lidarfw.errors import DataError
from lidarfw.files import atomic_path, write_text
from lidarfw.interfaces.data import Dataset
from lidarfw.types import Boxes, Points

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")

Arrays = dict[str, np.ndarray]

_KEPT = ("velocity", "moving", "occlusion", "truncation")  # what stays true when an object is put elsewhere
_OBJECTS, _POINTS = "objects.npz", "points.npy"
_worker_dataset: Dataset


@dataclass(frozen=True)
class ObjectDatabase:
    """Objects and the points inside their boxes. The points stay on disk and are mapped into memory."""

    boxes: Boxes  # (M,) in the frame of the scan they come from
    starts: np.ndarray  # (M + 1,) object i has the points starts[i] .. starts[i + 1]
    points: np.ndarray  # (P, 3 + C (+ 1)) x, y, z, features (, time), memory-mapped
    timed: bool  # the last column is time
    classes: tuple[str, ...]
    split: str

    @classmethod
    def load(cls, folder: str | Path) -> ObjectDatabase:
        """The database in a folder. DataError where there is none or it is broken."""
        folder = Path(folder)
        if not (folder / _OBJECTS).is_file():
            raise DataError(
                f"no database of objects in {folder}.\n"
                f"  fix: build it, with the overrides of the training: lidarfw prepare OVERRIDES"
            )
        try:
            with np.load(folder / _OBJECTS, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            points = np.load(folder / _POINTS, mmap_mode="r", allow_pickle=False)
            settings = json.loads(str(arrays["settings"]))
            if len(points) != arrays["starts"][-1]:
                raise ValueError(f"expected {arrays['starts'][-1]} points, found {len(points)}")
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise DataError(
                f"the database of objects in {folder} is broken: {error}.\n"
                f"  fix: remove the folder, then: lidarfw prepare OVERRIDES"
            ) from error
        return cls(
            _boxes(arrays),
            arrays["starts"],
            points,
            bool(arrays["timed"]),
            tuple(settings["classes"]),
            settings["split"],
        )

    def points_of(self, objects: np.ndarray) -> tuple[Points, Tensor]:
        """The points (P) of the objects, and the place (P,) in `objects` that each belongs to."""
        spans = [self.points[self.starts[i] : self.starts[i + 1]] for i in objects]
        owner = np.repeat(np.arange(len(objects)), [len(span) for span in spans])
        table = torch.from_numpy(np.concatenate([*spans, self.points[:0]]))
        features, time = (table[:, 3:-1], table[:, -1]) if self.timed else (table[:, 3:], None)
        return Points.from_scan(table[:, :3].clone(), features, time), torch.from_numpy(owner)


def _boxes(arrays: Arrays) -> Boxes:
    optional = {name: torch.from_numpy(arrays[name]) for name in _KEPT if name in arrays}
    boxes = Boxes.from_tensor(torch.from_numpy(arrays["boxes"]), torch.from_numpy(arrays["label"]))
    return boxes.replace(**optional)


def describe(dataset: Dataset) -> dict[str, Any]:
    """What decides the content of a database: the class of the dataset, its options, and where its files lie.

    A dataset that makes its files names their folder itself, perhaps by its version too.
    """
    options = {name: value for name, value in dataset.given_options().items() if name != "workers"}  # only for speed
    return {
        "dataset": type(dataset).__name__,
        "classes": list(dataset.spec.classes),
        "split": dataset.split,
        "frames": len(dataset),
        "root": getattr(dataset, "root", None),
        "options": options,
    }


def build(dataset: Dataset, folder: str | Path, workers: int = 1) -> Path:
    """Cut out the objects of every frame; the path of the database.

    One part per frame is written as it is done, so a build that was interrupted goes on where it stopped, and one
    that is complete for the same dataset and options is left as it is. DataError names the frame that is broken.
    """
    folder = Path(folder)
    settings = json.dumps(describe(dataset), sort_keys=True, default=str)
    if _is_complete(folder, settings):
        return folder
    parts = folder / f"parts-{hashlib.sha256(settings.encode()).hexdigest()[:16]}"
    write_text(parts / "settings.json", settings)
    missing = [index for index in range(len(dataset)) if not _is_whole(parts / f"{index}.npz")]
    for _ in _progress(_cut_all(dataset, missing, parts, workers), len(missing)):
        pass
    _merge([parts / f"{index}.npz" for index in range(len(dataset))], folder, settings)
    for leftover in folder.glob("parts-*"):
        shutil.rmtree(leftover)
    return folder


def _is_complete(folder: Path, settings: str) -> bool:
    try:
        with np.load(folder / _OBJECTS, allow_pickle=False) as file:
            return (
                str(file["settings"]) == settings
                and len(np.load(folder / _POINTS, mmap_mode="r")) == file["starts"][-1]
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return False


def _is_whole(part: Path) -> bool:
    return part.is_file() and zipfile.is_zipfile(part)


def _progress(done: Iterator[None], total: int) -> Iterator[None]:
    from rich.progress import track

    yield from track(done, "cutting out objects", total=total, disable=total == 0)


def _cut_all(dataset: Dataset, missing: list[int], parts: Path, workers: int) -> Iterator[None]:
    if workers <= 1 or len(missing) <= 1:
        for index in missing:
            _cut(dataset, index, parts)
            yield
        return
    context = multiprocessing.get_context("spawn")  # a forked torch may hang
    with ProcessPoolExecutor(workers, context, _start_worker, (dataset,)) as pool:
        try:
            yield from pool.map(_cut_in_worker, missing, [parts] * len(missing), chunksize=4)
        except BrokenProcessPool as error:
            raise DataError(
                "a worker of the object database died, perhaps for lack of memory.\n"
                "  fix: run the command again with fewer --workers; it goes on where it stopped"
            ) from error


def _start_worker(dataset: Dataset) -> None:
    global _worker_dataset
    torch.set_num_threads(1)
    _worker_dataset = dataset


def _cut_in_worker(index: int, parts: Path) -> None:
    _cut(_worker_dataset, index, parts)


def _cut(dataset: Dataset, index: int, parts: Path) -> None:
    """Write the objects of one frame."""
    from lidarfw.ops import points_in_boxes_mask

    frame = dataset[index]
    points, boxes = frame.inputs["points"], frame.targets.boxes
    boxes = Boxes.empty() if boxes is None else boxes
    inside = points_in_boxes_mask(points.xyz, boxes.tensor)
    rows = inside.T.nonzero()[:, 1]  # of the first object, then of the second, ...
    arrays: Arrays = {
        "boxes": boxes.tensor.numpy(),
        "label": boxes.label.numpy(),
        "count": inside.sum(0).numpy(),
        "points": _columns(points)[rows.numpy()],
        "timed": np.array(points.time is not None),
    }
    arrays |= {name: value.numpy() for name in _KEPT if (value := getattr(boxes, name)) is not None}
    with atomic_path(parts / f"{index}.npz") as temporary:
        np.savez(temporary, **arrays)  # type: ignore[arg-type]


def _columns(points: Points) -> np.ndarray:
    time = [] if points.time is None else [points.time[:, None]]
    return torch.cat([points.xyz, points.features, *time], 1).numpy()


def _merge(parts: list[Path], folder: Path, settings: str) -> None:
    """One file of points and one of objects. The old objects go first: a stop in between leaves no mixed pair."""
    tables = [_load(part, ("boxes", "label", "count", "timed", *_KEPT)) for part in parts]
    labelled = [table for table in tables if len(table["boxes"])]
    if not labelled:
        raise DataError(f"there is no labelled object to cut out of {settings}")
    starts = np.cumsum([0, *np.concatenate([table["count"] for table in labelled])])
    (folder / _OBJECTS).unlink(missing_ok=True)
    with atomic_path(folder / _POINTS) as temporary:
        _write_points(temporary, parts, int(starts[-1]))
    shared = [name for name in ("boxes", "label", *_KEPT) if all(name in table for table in labelled)]
    arrays = {name: np.concatenate([table[name] for table in labelled]) for name in shared}
    arrays |= {"starts": starts, "timed": labelled[0]["timed"], "settings": np.array(settings)}
    with atomic_path(folder / _OBJECTS) as temporary:
        np.savez(temporary, **arrays)  # type: ignore[arg-type]


def _load(part: Path, names: tuple[str, ...]) -> Arrays:
    with np.load(part, allow_pickle=False) as file:
        return {name: file[name] for name in names if name in file.files}


def _write_points(path: Path, parts: list[Path], count: int) -> None:
    """The points of all parts, one part in memory at a time."""
    width = _load(parts[0], ("points",))["points"].shape[1]
    whole = np.lib.format.open_memmap(path, "w+", np.float32, (count, width))  # type: ignore[no-untyped-call]
    end = 0
    for part in parts:
        points = _load(part, ("points",))["points"]
        whole[end : end + len(points)] = points
        end += len(points)
    whole.flush()
