"""Whole sets of frames: planned, made in parallel, and resumed where a run was interrupted."""

from __future__ import annotations

import functools
import json
import math
import multiprocessing
import os
import queue
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lidarfw.errors import ConfigError, DataError
from lidarfw.files import write_text
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lidarfw_town.camera import kitti_camera
from lidarfw_town.drive import WEATHER, Drive
from lidarfw_town.layouts import LAYOUTS, Layout, Place
from lidarfw_town.sensors import LIDARS
from lidarfw_town.version import VERSION

_LEAD = 10  # steps before the first frame


@dataclass(frozen=True)
class Job:
    """What to write.

    `layout`, `sensor` and `weather` are names; `split` is the list of ImageSets that the frames of the layout kitti
    are named in; `length`: frames of one drive, 0 for the layout's own; `stride`: steps of 0.1 s between frames,
    0 for the layout's own; `picture_width` in pixels, 0 for no pictures.
    """

    layout: str
    root: str
    seed: int = 1
    frames: int = 100
    sensor: str = "hdl64"
    split: str = "train"
    length: int = 0
    stride: int = 0
    picture_width: int = 1242
    weather: str = "clear"
    traversal: int = 0

    def check(self) -> None:
        """ConfigError where a value cannot be."""
        for name, known in (("layout", LAYOUTS), ("sensor", LIDARS), ("weather", WEATHER)):
            if getattr(self, name) not in known:
                raise ConfigError(f"{name}: expected one of {', '.join(known)}, found {getattr(self, name)!r}")
        for name, least in (("frames", 1), ("seed", 0), ("length", 0), ("stride", 0), ("picture_width", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name}: expected {least} or more, found {getattr(self, name)}")

    @property
    def per_drive(self) -> int:
        """Frames of one drive."""
        return min(self.length or LAYOUTS[self.layout].length, self.frames)

    @property
    def step(self) -> int:
        """Steps of 0.1 s between frames."""
        return self.stride or LAYOUTS[self.layout].stride

    def places(self) -> list[Place]:
        """All frames."""
        return [Place(n // self.per_drive, n % self.per_drive, n) for n in range(self.frames)]

    def writer(self) -> Layout:
        """The layout at its folder."""
        camera = kitti_camera(self.picture_width) if self.picture_width else None
        return LAYOUTS[self.layout](Path(self.root), camera, self.split)

    def part(self, place: Place) -> Path:
        """The file that says that a frame is done, and holds what its layout keeps of it."""
        return self._notes / f"{place.number:06d}.json"

    @property
    def _notes(self) -> Path:
        return Path(self.root) / ".town" / self.split

    def claim(self) -> None:
        """Note the settings in the folder; DataError where it holds frames of other settings."""
        wanted = {key: value for key, value in asdict(self).items() if key != "root"} | {"version": VERSION}
        path = self._notes / "settings.json"
        if not path.is_file():
            write_text(path, json.dumps(wanted, indent=1) + "\n")
            return
        found = json.loads(path.read_text(encoding="utf-8"))
        if found != wanted:
            other = ", ".join(
                f"{key}: {found.get(key)} there, {wanted[key]} now" for key in wanted if found.get(key) != wanted[key]
            )
            raise DataError(
                f"{self.root} holds a town of other settings ({other}).\n  fix: another folder, or delete it"
            )

    @property
    def complete(self) -> bool:
        """Whether everything stands."""
        return (self._notes / "done").is_file()

    def finish(self) -> None:
        """Write what needs all frames, and note that everything stands."""
        parts: list[list[dict[str, Any]]] = [[] for _ in range(math.ceil(self.frames / self.per_drive))]
        for place in self.places():
            parts[place.drive].append(json.loads(self.part(place).read_text(encoding="utf-8")))
        self.writer().finish(parts)
        write_text(self._notes / "done", "")


def generate(job: Job, workers: int = 1, *, quiet: bool = False) -> None:
    """Write a whole set. Frames that stand already are kept; with more than one worker, processes are spawned."""
    job.check()
    job.claim()
    if job.complete:
        return
    missing = [place for place in job.places() if not job.part(place).is_file()]
    columns = (TextColumn(f"{job.layout} {job.sensor}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, disable=quiet) as progress:
        task = progress.add_task("frames", total=job.frames, completed=job.frames - len(missing))
        for _ in _made(job, missing, workers):
            progress.advance(task)
    job.finish()


def _made(job: Job, places: list[Place], workers: int) -> Iterator[Place]:
    """Make the frames, and name each when it stands."""
    if workers <= 1 or len(places) < 2:
        for place in places:
            make_frame(job, place)
            yield place
        return
    # numpy must not start threads of its own in every worker
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    done: Any = context.Queue()
    with ProcessPoolExecutor(workers, context, _take_queue, (done,)) as pool:
        futures = [pool.submit(_make_chunk, job, chunk) for chunk in _chunks(places, workers)]
        for _ in places:
            yield _next(done, futures)


def _next(done: Any, futures: list[Future[None]]) -> Place:
    while True:
        try:
            place: Place = done.get(timeout=1.0)
            return place
        except queue.Empty:
            for future in futures:
                if future.done():
                    future.result()  # raises what went wrong there


def _chunks(places: list[Place], workers: int) -> list[list[Place]]:
    """Frames of one drive together, since a worker builds its town once; as many as workers at least."""
    drives: dict[int, list[Place]] = {}
    for place in places:
        drives.setdefault(place.drive, []).append(place)
    parts = math.ceil(workers / len(drives))
    return [drive[n::parts] for drive in drives.values() for n in range(parts) if drive[n::parts]]


_queue: Any = None


def _take_queue(done: Any) -> None:
    global _queue
    _queue = done


def _make_chunk(job: Job, places: list[Place]) -> None:
    for place in places:
        make_frame(job, place)
        _queue.put(place)


@functools.lru_cache(maxsize=1)
def drive_of(job: Job, number: int) -> Drive:
    """The drive of that number of a set."""
    # towns of the splits and of neighbouring seeds differ
    seed = job.seed * 1000 + number + (500 if job.split != "train" else 0)
    steps = _LEAD + job.per_drive * job.step
    layout = LAYOUTS[job.layout]
    return Drive(
        seed, steps, LIDARS[job.sensor], traversal=job.traversal, compensated=layout.compensated, weather=job.weather
    )


def make_frame(job: Job, place: Place) -> None:
    """Make one frame and write its files; its note comes last, so that an interrupted frame is made again."""
    drive = drive_of(replace(job, root=""), place.drive)  # where the files go does not change the town
    frame = drive.frame(_LEAD + place.index * job.step)
    part = job.writer().write(frame, drive, place)
    write_text(job.part(place), json.dumps(part))
