"""Which objects move: from their velocities, or from where they are a little earlier and later."""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
from lidarfw._lazy import LazyModule
from lidarfw.components.transforms.object_database import describe
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import atomic_path
from lidarfw.interfaces.data import Dataset, Transform
from lidarfw.types import Boxes, DataSpec, Frame, Targets

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

Array = npt.NDArray[np.float64]
State = npt.NDArray[np.int8]  # 1 moving, 0 static, -1 unknown
SHORTEST = 0.2  # seconds between two sightings below which they tell no speed
GATE, FASTEST = 3.0, 15.0  # metres, and metres per second, that an object may be from where it was seen before


class MotionState(Transform):
    """Set `Boxes.moving` of the labelled objects: 1 faster than `speed` (m/s), 0 not, -1 unknown (TACO, section 4).

    The speed of an object is, in this order: its labelled velocity; the distance over ground between its sightings
    `reach` seconds before and after, by its track id; the same for boxes without ids, which are matched from frame to
    frame within their class, by distance over ground in the plane (the assignment of least total distance, up to
    3 m + 15 m/s). Where a track begins or ends, one side alone counts; where frames are farther apart than `reach`, the
    next ones do. An object seen for less than 0.2 s is unknown.

    One second of sightings and not two consecutive scans, since labels jitter: 0.05 m are 1.4 m/s at 20 Hz, and parked
    cars would move. Comes before transforms that drop boxes. Needs poses, unless the boxes have velocities.

    The first frame of a sequence that is asked for reads the whole sequence. For large datasets name a `file`:
    `lidarfw prepare`, or the training itself, then works all states out once and keeps them in FILE_SPLIT_*.npz. With
    `overwrite` false, a state that the dataset knows (not -1) stays. `shuffle` is a control: the states are dealt
    out anew among the objects of each frame, so that nothing which learns from them can gain.
    """

    example: ClassVar[dict[str, Any]] = {}

    def __init__(
        self, *, speed: float = 0.5, reach: float = 0.25, overwrite: bool = True, file: str = "", shuffle: bool = False
    ) -> None:
        if speed < 0 or reach <= 0:
            raise ConfigError(f"motion_state: need speed >= 0 and reach > 0, got {speed} and {reach}")
        self.speed, self.reach, self.overwrite, self.file = speed, reach, overwrite, file
        self.shuffle = shuffle
        self._dataset: Dataset | None = None
        self._places: dict[str, tuple[int, int]] = {}  # frame id -> sequence, place in it
        self._states: dict[int, list[State]] = {}  # by sequence, then frame
        self._times: dict[int, Sequence[int]] = {}

    def spec(self, data: DataSpec) -> DataSpec:
        """Unchanged; ConfigError without boxes."""
        if Boxes not in data.targets:
            raise ConfigError("motion_state needs a dataset with labelled boxes")
        return data

    def prepare(self, dataset: Dataset, workers: int = 1) -> None:
        """Write the file, unless it is that of this dataset already."""
        if not self.file or self._read(dataset) is not None:
            return
        from rich.progress import track

        sequences = dataset.sequences()
        found = [
            self._label(dataset, s) for s in track(sequences, "working out what moves", disable=len(sequences) < 2)
        ]
        arrays = {f"{place}": np.concatenate([*states, np.zeros(0, np.int8)]) for place, states in enumerate(found)}
        counts = {f"count_{place}": np.array([len(s) for s in states]) for place, states in enumerate(found)}
        with atomic_path(self._path(dataset)) as temporary:
            np.savez(temporary, settings=np.array(self._settings(dataset)), **arrays, **counts)  # type: ignore[arg-type]

    def attach(self, dataset: Dataset) -> None:
        """Look at the sequences of the dataset; read the file where there is one."""
        self._dataset, self._states = dataset, {}
        self._times = dict(enumerate(dataset.sequences()))
        self._places = {
            dataset.meta(index).id: (number, place)
            for number, sequence in self._times.items()
            for place, index in enumerate(sequence)
        }
        if self.file:
            found = self._read(dataset)
            if found is None:
                raise DataError(
                    f"{self._path(dataset)} does not hold the motion states of this dataset.\n"
                    "  fix: lidarfw prepare OVERRIDES, with the overrides of the training"
                )
            self._states = found

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with the states of its boxes."""
        boxes = frame.targets.boxes
        if boxes is None or self._dataset is None:
            return frame
        number, place = self._places[frame.meta.id]
        if number not in self._states:
            self._states[number] = self._label(self._dataset, self._times[number])
        state = self._states[number][place]
        if len(state) != len(boxes):
            raise DataError(
                f"frame {frame.meta.id} has {len(boxes)} boxes, {len(state)} were labelled.\n"
                "  fix: motion_state must come before transforms that drop or add boxes"
            )
        moving = torch.from_numpy(rng.permutation(state) if self.shuffle else state.copy())
        if boxes.moving is not None and not self.overwrite:
            moving = torch.where(boxes.moving >= 0, boxes.moving, moving)
        targets: Targets = frame.targets.replace(boxes=boxes.replace(moving=moving))
        return frame.replace(targets=targets)

    def _label(self, dataset: Dataset, sequence: Sequence[int]) -> list[State]:
        """States of the boxes of all frames of a sequence."""
        sightings = [_sighting(dataset[index]) for index in sequence]
        by_velocity = [_by_speed(np.linalg.norm(s.velocity, axis=1), self.speed) for s in sightings]
        if not any((state < 0).any() for state in by_velocity):
            return by_velocity
        lost = next((s.id for s in sightings if s.pose is None), None)
        if lost is not None:
            raise DataError(
                f"motion_state: frame {lost} has boxes of unknown velocity and no pose.\n"
                "  fix: a dataset with poses, or with velocities of all boxes"
            )
        tracks = [s.track for s in sightings] if all(s.tracked for s in sightings) else chained(sightings)
        time = np.repeat([s.time for s in sightings], [len(s.xy) for s in sightings])
        place = np.concatenate([s.over_ground() for s in sightings])
        speed = speeds(place, time, np.concatenate(tracks), self.reach)
        ends = np.cumsum([len(s.xy) for s in sightings])[:-1]
        followed = np.split(_by_speed(speed, self.speed), ends)
        return [np.where(v >= 0, v, f).astype(np.int8) for v, f in zip(by_velocity, followed, strict=True)]

    def _settings(self, dataset: Dataset) -> str:
        return json.dumps({**describe(dataset), "speed": self.speed, "reach": self.reach}, sort_keys=True, default=str)

    def _path(self, dataset: Dataset) -> Path:
        """The file of these very frames: not every dataset's `split` tells which of its frames it takes."""
        path, digest = Path(self.file), hashlib.blake2b(digest_size=4)
        for index in range(len(dataset)):
            digest.update(dataset.meta(index).id.encode() + b"\n")
        return path.with_name(f"{path.stem}_{dataset.split}_{digest.hexdigest()}.npz")

    def _read(self, dataset: Dataset) -> dict[int, list[State]] | None:
        """The states in the file, or None where it is broken, or not one of this dataset with these options."""
        try:
            with np.load(self._path(dataset), allow_pickle=False) as file:
                if str(file["settings"]) != self._settings(dataset):
                    return None
                return {
                    place: np.split(file[f"{place}"], np.cumsum(file[f"count_{place}"])[:-1])
                    for place in range(len(dataset.sequences()))
                }
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None


@dataclass
class Sighting:
    """The labelled objects of one frame."""

    id: str  # of the frame
    time: float
    pose: Array | None  # (4, 4) sensor -> map
    xy: Array  # (M, 3) centres in the sensor frame
    label: npt.NDArray[np.int64]
    velocity: Array  # (M, 2), NaN where it is not known
    track: npt.NDArray[np.int64]  # -1 where it is not known
    tracked: bool  # whether all objects have an id

    def over_ground(self) -> Array:
        """Centres (M, 2) in the map."""
        pose = np.eye(4) if self.pose is None else self.pose
        return np.asarray((self.xy @ pose[:3, :3].T + pose[:3, 3])[:, :2], dtype=np.float64)


def _sighting(frame: Frame) -> Sighting:
    boxes, tracks, poses = frame.targets.boxes, frame.targets.tracks, frame.targets.poses
    boxes = Boxes.empty() if boxes is None else boxes
    none = torch.full((len(boxes), 2), math.nan)
    ids = tracks.id if tracks is not None and len(tracks.id) == len(boxes) else torch.full_like(boxes.label, -1)
    known = poses is not None and bool(poses.ok.all())
    return Sighting(
        frame.meta.id,
        frame.meta.time,
        poses.matrix[0].double().numpy() if poses is not None and known else None,
        boxes.center.double().numpy(),
        boxes.label.numpy(),
        (none if boxes.velocity is None else boxes.velocity).double().numpy(),
        ids.numpy(),
        bool((ids >= 0).all()),
    )


def _by_speed(speed: Array, limit: float) -> State:
    with np.errstate(invalid="ignore"):
        return np.where(np.isnan(speed), -1, speed > limit).astype(np.int8)


def speeds(place: Array, time: Array, track: npt.NDArray[np.int64], reach: float) -> Array:
    """Speed (N,) over ground in m/s of every sighting: places (N, 2) in the map, seconds (N,), track ids (N,).

    The distance between the first and the last sighting of the track within `reach` seconds, but at least the ones
    next to it, over the time between them; NaN where that is less than SHORTEST.
    """
    if not len(time):
        return np.zeros(0)
    order = np.lexsort((time, track))
    _, number = np.unique(track[order], return_inverse=True)
    clock = time[order] - time.min()
    key = number * (2 * (clock.max() + reach) + 1) + clock  # tracks one after the other
    slack = 1e-6 + 1e-9 * key.max()
    own = np.arange(len(key))
    start, end = np.searchsorted(number, number, "left"), np.searchsorted(number, number, "right") - 1
    first = np.minimum(np.searchsorted(key, key - reach - slack, "left"), np.maximum(own - 1, start))
    last = np.maximum(np.searchsorted(key, key + reach + slack, "right") - 1, np.minimum(own + 1, end))
    span = clock[last] - clock[first]
    distance = np.linalg.norm(place[order][last] - place[order][first], axis=1)
    speed = np.full(len(time), math.nan)
    speed[order] = np.where(span >= SHORTEST - slack, distance / np.maximum(span, SHORTEST / 2), math.nan)
    return speed


def chained(sightings: Sequence[Sighting]) -> list[npt.NDArray[np.int64]]:
    """Track ids of the boxes of consecutive frames, matched from one to the next."""
    found: list[npt.NDArray[np.int64]] = []
    total = 0
    for place, now in enumerate(sightings):
        ids = np.full(len(now.xy), -1)
        if place:
            row, column = matched(sightings[place - 1], now)
            ids[column] = found[-1][row]
        fresh = ids < 0
        ids[fresh] = total + np.arange(fresh.sum())
        total += int(fresh.sum())
        found.append(ids)
    return found


def matched(before: Sighting, now: Sighting) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows of two frames that are the same object: of one class, within the gate, with the least total distance."""
    from scipy.optimize import linear_sum_assignment

    distance = np.linalg.norm(before.over_ground()[:, None] - now.over_ground()[None], axis=2)
    allowed = before.label[:, None] == now.label
    allowed &= distance <= GATE + FASTEST * abs(now.time - before.time)
    row, column = linear_sum_assignment(np.where(allowed, distance, 1e6))
    kept = allowed[row, column]
    return row[kept], column[kept]
