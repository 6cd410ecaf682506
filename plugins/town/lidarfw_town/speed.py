"""`python -m lidarfw_town.speed`: how long the town takes, part by part, and how many frames two processes make."""

from __future__ import annotations

import argparse
import cProfile
import pstats
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from lidarfw_town.beams import Body
from lidarfw_town.camera import fisheye_cameras, kitti_camera, rays_of
from lidarfw_town.drive import Drive
from lidarfw_town.generate import Job, generate
from lidarfw_town.light import WEATHER
from lidarfw_town.render import photograph
from lidarfw_town.sensors import LIDARS, first_hits, receive
from lidarfw_town.traffic import Traffic
from lidarfw_town.world import World

T = TypeVar("T")

_STEPS = 510  # of the drive: 50 frames a second apart
_PARTS: dict[str, tuple[Callable[..., object], ...]] = {
    "directions of the rays": (Drive._rays,),
    "where objects are": (Drive._bodies,),
    "rays through the town": (first_hits,),
    "rays to objects": (Body.window, Body.meet),
    "the sensor": (receive,),
    "boxes": (Drive._objects,),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; its exit code."""
    made = argparse.ArgumentParser(prog="python -m lidarfw_town.speed", description=__doc__)
    made.add_argument("--sensor", choices=[*LIDARS], default="hdl64")
    made.add_argument("--frames", type=int, default=50)
    made.add_argument("--weather", choices=[*WEATHER], default="clear")
    made.add_argument("--workers", type=int, default=2)
    given = made.parse_args(arguments)
    print("| processor time | s |\n|---|---|")
    drive = _beginnings(given.sensor, given.weather)
    _frames(drive, given.frames)
    _pictures(drive, given.frames // 5)
    _files(given.sensor, given.frames, given.workers)
    return 0


def _beginnings(sensor: str, weather: str) -> Drive:
    """What is done once for each drive."""
    world = _timed("a town", lambda: World(1000))
    _timed("its traffic, 51 s", lambda: Traffic(world, 0, _STEPS))
    drive = Drive(1000, _STEPS, LIDARS[sensor], weather=weather, world=world)
    _timed(f"made ready for rays: {len(world.mesh):,} triangles", lambda: drive.still)
    drive.frame(10)
    return drive


def _frames(drive: Drive, count: int) -> None:
    """The time of a frame, and the shares of its parts."""
    profile = cProfile.Profile(time.process_time)
    steps = [10 + 10 * number for number in range(count)]
    begin = time.process_time()
    for step in steps:
        drive.frame(step)
    whole = (time.process_time() - begin) / count
    print(f"| a frame: {drive.lidar.name}, labels, boxes, tracks | {whole:.3f} |")
    for step in steps:
        profile.runcall(drive.frame, step)
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    by_code = {key: value[3] for key, value in stats.items()}
    total = by_code[_key(Drive.frame)]
    for name, functions in _PARTS.items():
        print(f"| - {name} | {sum(by_code[_key(function)] for function in functions) / total:.0%} |")


def _key(function: Callable[..., object]) -> tuple[str, int, str]:
    code = function.__code__
    return code.co_filename, code.co_firstlineno, code.co_name


def _pictures(drive: Drive, count: int) -> None:
    frames = [drive.frame(10 + 50 * number) for number in range(count)]
    for name, camera in (("pinhole", kitti_camera()), ("fisheye", fisheye_cameras(700)["image_02"])):
        rays_of(camera)
        begin = time.process_time()
        for frame in frames:
            photograph(drive, frame, camera)
        seconds = (time.process_time() - begin) / count
        print(f"| a picture: {name}, {camera.width} x {camera.height} | {seconds:.3f} |")


def _files(sensor: str, count: int, workers: int) -> None:
    """Whole frames on disk, by the clock."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        generate(Job("kitti", folder, frames=count, sensor=sensor, picture_width=0), workers, quiet=True)
        seconds = time.perf_counter() - begin
    print(f"\n{count} frames of the layout kitti without pictures, {workers} processes, by the clock: {seconds:.1f} s")


def _timed(name: str, make: Callable[[], T]) -> T:
    begin = time.process_time()
    made = make()
    print(f"| {name} | {time.process_time() - begin:.2f} |")
    return made


if __name__ == "__main__":
    raise SystemExit(main())
