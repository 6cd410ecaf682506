"""Whole sets of frames: planned, made in parallel, and resumed where a run was interrupted."""

from __future__ import annotations

import functools
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import write_text
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lidarfw_town.drive import Drive
from lidarfw_town.layouts import LAYOUTS, Layout, Place
from lidarfw_town.light import WEATHER
from lidarfw_town.sensors import LIDARS
from lidarfw_town.version import VERSION
from lidarfw_town.world import World

_LEAD = 10  # steps before the first frame


@dataclass(frozen=True)
class Job:
    """What to write.

    `layout`, `sensor` and `weather` are names; `split` is one of the dataset's; `length`: frames of one drive, 0 for
    the layout's own; `stride`: steps of 0.1 s between frames, 0 for the layout's own; `picture_width` in pixels, 0 for
    no pictures.
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
        least = {"frames": 1, "seed": 0, "length": 0, "stride": 0, "picture_width": 0, "traversal": 0}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ConfigError(f"{name}: expected {value} or more, found {getattr(self, name)}")
        LAYOUTS[self.layout].check(self.split, self.drives)

    @property
    def per_drive(self) -> int:
        """Frames of one drive."""
        return min(self.length or LAYOUTS[self.layout].length, self.frames)

    @property
    def drives(self) -> int:
        """How many drives there are."""
        return math.ceil(self.frames / self.per_drive)

    @property
    def step(self) -> int:
        """Steps of 0.1 s between frames."""
        return self.stride or LAYOUTS[self.layout].stride

    def places(self) -> list[Place]:
        """All frames."""
        return [Place(n // self.per_drive, n % self.per_drive, n) for n in range(self.frames)]

    def town(self, drive: int) -> tuple[int, int]:
        """The seed of the town of a drive, and the number of the traversal."""
        layout, seed = LAYOUTS[self.layout], self.seed * 1000
        if layout.one_town:
            return seed, self.traversal + layout.traversal(self.split, drive)
        # the towns of the splits and of neighbouring seeds differ
        return seed + drive + (500 if self.split != "train" else 0), self.traversal

    def writer(self) -> Layout:
        """The layout at its folder."""
        return LAYOUTS[self.layout](Path(self.root), self.picture_width, self.split)

    def part(self, place: Place) -> Path:
        """The file that says that a frame is done, and holds what its layout keeps of it."""
        return self._notes / f"{place.number:06d}.json"

    @property
    def _notes(self) -> Path:
        return Path(self.root) / ".town" / self.split

    def claim(self) -> None:
        """Note the settings in the folder; DataError where it holds frames of other settings."""
        wanted = {key: value for key, value in asdict(self).items() if key != "root"} | {"version": VERSION}
        own = self._notes / "settings.json"
        for path in sorted(Path(self.root).glob(".town/*/settings.json")):
            free = () if path == own else ("split", "frames", "length")  # another split may be longer
            found = json.loads(path.read_text(encoding="utf-8"))
            other = [key for key in wanted if found.get(key) != wanted[key] and key not in free]
            if other:
                text = ", ".join(f"{key}: {found.get(key)} there, {wanted[key]} now" for key in other)
                raise DataError(
                    f"{self.root} holds a town of other settings ({text}).\n  fix: another folder, or delete it"
                )
        if not own.is_file():
            write_text(own, json.dumps(wanted, indent=1) + "\n")

    @property
    def complete(self) -> bool:
        """Whether everything stands."""
        return (self._notes / "done").is_file()

    def finish(self) -> None:
        """Write what needs all frames, and note that everything stands."""
        parts: list[list[dict[str, Any]]] = [[] for _ in range(self.drives)]
        for place in self.places():
            parts[place.drive].append(json.loads(self.part(place).read_text(encoding="utf-8")))
        self.writer().finish(parts)
        write_text(self._notes / "done", "")


def generate(job: Job, workers: int = 1, *, quiet: bool = False) -> None:
    """Write a whole set with so many processes. Frames that stand already are kept.

    Another process that writes into the same folder is waited for.
    """
    job.check()
    with _locked(Path(job.root) / ".town"):
        job.claim()
        if not job.complete:
            _make(job, workers, quiet)
            job.finish()


def _locked(folder: Path) -> AbstractContextManager[object]:
    """The folder, made and for this process alone; DataError where that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return FileLock(folder / "lock").acquire()
    except OSError as error:
        raise DataError(
            f"cannot write {folder}: {error.strerror or error}.\n"
            f"  fix: another folder (--out, or dataset.NAME.cache), or permission to write there"
        ) from error


def _make(job: Job, workers: int, quiet: bool) -> None:
    _tidy(Path(job.root))
    missing = _missing(job, job.places())
    columns = (TextColumn(f"{job.layout} {job.split} {job.sensor}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn(), disable=quiet, console=Console(stderr=True)) as progress:
        task = progress.add_task("frames", total=job.frames, completed=job.frames - len(missing))
        for _ in _made(job, missing, workers):
            progress.advance(task)


def _missing(job: Job, places: Sequence[Place]) -> list[Place]:
    return [place for place in places if not job.part(place).is_file()]


def _tidy(root: Path) -> None:
    """Remove what a killed run left half-written, which loaders would take for scans."""
    for path in root.rglob(".*"):
        if re.fullmatch(r"\.[0-9a-f]{32}", path.stem):
            path.unlink(missing_ok=True)


def _made(job: Job, places: list[Place], workers: int) -> Iterator[None]:
    """Make the frames, and yield whenever one stands."""
    if workers <= 1 or len(places) < 2:
        for place in places:
            make_frame(job, place)
            yield
        return
    read, write = os.pipe()
    started = [_start(job, chunk, write) for chunk in _chunks(places, workers)]
    os.close(write)
    try:
        with os.fdopen(read) as lines:
            for _ in lines:  # one for a frame, until the last process has ended
                yield
    finally:
        for process in started:
            process.terminate()
        codes = [process.wait() for process in started]
    if any(codes):
        raise DataError(f"a process that made frames ended with {next(filter(None, codes))}; it says why above")


def _start(job: Job, places: Sequence[Place], output: int) -> subprocess.Popen[bytes]:
    """A process of its own, so that scripts need no guard around their main part as multiprocessing does."""
    # numpy must not start threads of its own in every worker
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    first, last = places[0].number, places[-1].number
    words = [sys.executable, "-m", "lidarfw_town.generate", json.dumps(asdict(job)), str(first), str(last)]
    return subprocess.Popen(words, stdout=output, env=environment)


def _work(words: Sequence[str]) -> None:
    """What a worker does: make the missing frames of a job from one number to another, and tell of each."""
    job, first, last = Job(**json.loads(words[0])), int(words[1]), int(words[2])
    for place in _missing(job, job.places()[first : last + 1]):
        make_frame(job, place)
        print(flush=True)


def _chunks(places: list[Place], workers: int) -> list[list[Place]]:
    """The frames of a worker each: one after another, so that it builds few towns, and equally many."""
    size = math.ceil(len(places) / workers)
    return [places[start : start + size] for start in range(0, len(places), size)]


def drive_of(job: Job, number: int) -> Drive:
    """The drive of that number of a set."""
    layout, steps = LAYOUTS[job.layout], _LEAD + job.per_drive * job.step
    return _drive(*job.town(number), steps, job.sensor, job.weather, layout.compensated, layout.one_town)


@functools.lru_cache(maxsize=1)
def _drive(seed: int, traversal: int, steps: int, sensor: str, weather: str, compensated: bool, circuit: bool) -> Drive:
    """Made once for all of its frames, whatever their layout."""
    return Drive(
        seed, steps, LIDARS[sensor], traversal=traversal, compensated=compensated, weather=weather, circuit=circuit,
        world=_world(seed),
    )  # fmt: skip


@functools.lru_cache(maxsize=1)
def _world(seed: int) -> World:
    return World(seed)


def make_frame(job: Job, place: Place) -> None:
    """Make one frame and write its files; its note comes last, so that an interrupted frame is made again."""
    drive = drive_of(job, place.drive)
    frame = drive.frame(_LEAD + place.index * job.step)
    part = job.writer().write(frame, drive, place)
    write_text(job.part(place), json.dumps(part))


if __name__ == "__main__":
    _work(sys.argv[1:])
