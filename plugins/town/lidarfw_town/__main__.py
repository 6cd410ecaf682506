"""`python -m lidarfw_town`: write a simulated town in the layout of a public dataset, or draw a picture of it."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from lidarfw.errors import LidarfwError

from lidarfw_town.generate import Job, generate
from lidarfw_town.layouts import LAYOUTS
from lidarfw_town.light import WEATHER
from lidarfw_town.sensors import LIDARS


def parser() -> argparse.ArgumentParser:
    """The arguments of the command."""
    made = argparse.ArgumentParser(prog="python -m lidarfw_town", description=__doc__)
    made.add_argument("--layout", choices=[*LAYOUTS], default="kitti", help="whose files to write (default: kitti)")
    made.add_argument("--out", required=True, help="the folder; with --picture, the PNG")
    made.add_argument("--seed", type=int, default=1, help="another seed is another town (default: 1)")
    made.add_argument("--frames", type=int, default=100, help="how many frames (default: 100)")
    made.add_argument("--sensor", choices=[*LIDARS], default="hdl64", help="the LiDAR (default: hdl64)")
    made.add_argument("--split", default="train", help="of the layout; others are other towns or traversals")
    made.add_argument("--length", type=int, default=0, help="frames of one drive (default: the layout's)")
    made.add_argument("--stride", type=int, default=0, help="steps of 0.1 s between frames (default: the layout's)")
    made.add_argument("--traversal", type=int, default=0, help="another drive through the same town")
    made.add_argument("--weather", choices=[*WEATHER], default="clear")
    made.add_argument("--picture-width", type=int, default=1242, help="pixels, 0 for no pictures (default: 1242)")
    made.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: one a core)")
    made.add_argument("--picture", action="store_true", help="draw the first of the towns instead: map, pictures, scan")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; its exit code."""
    given = parser().parse_args(arguments)
    values = {key: value for key, value in vars(given).items() if key not in ("out", "workers", "picture")}
    try:
        job = Job(root=given.out, **values)
        if given.picture:
            from lidarfw_town.picture import write_picture

            job.check()
            seed, traversal = job.town(0)
            write_picture(given.out, seed, LIDARS[given.sensor], traversal, given.weather)
        else:
            generate(job, given.workers)
    except LidarfwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
