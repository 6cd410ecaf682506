#!/usr/bin/env python3
"""Scans of the simulated town as a folder of one's own, most of them without labels: to try pseudo-labels on.

python tools/town_folder.py FOLDER [--frames N] [--labelled N] [--sensor NAME] [--seed N]

Writes float32 .npy scans (x, y, z, reflectance) of a front view, in the layout of `dataset=folder`: FOLDER/street with
`--frames` scans of which the `--labelled` first have boxes, and FOLDER/held_out with a quarter as many, all with boxes,
from another town; train.txt and val.txt list them. The labels that were left out lie in FOLDER/left_out, to compare.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.progress import track

from lidarfw.errors import LidarfwError
from lidarfw.files import atomic_path, write_text
from lidarfw.pseudo_labels import box_lines

if TYPE_CHECKING:
    from lidarfw_town.datasets import TownKitti

    from lidarfw.types import Frame

CLASSES = ("Car", "Pedestrian", "Cyclist")


def write(frame: Frame, sequence: Path, name: str, labels: Path) -> None:
    """The scan, and boxes and ignored boxes in the folder `labels`."""
    points, targets = frame.inputs["points"], frame.targets
    with atomic_path(sequence / "points" / f"{name}.npy") as temporary:
        np.save(temporary, np.concatenate([points.xyz.numpy(), points.features[:, :1].numpy()], 1))
    for kind, boxes in (("boxes", targets.boxes), ("ignored", targets.ignored)):
        if boxes is not None:
            known = boxes[(boxes.label >= 0) & (boxes.size > 0).all(1)]
            write_text(labels / kind / f"{name}.txt", box_lines(known, CLASSES))


def write_split(dataset: TownKitti, root: Path, sequence: str, labelled: int) -> None:
    """All frames of a split as a sequence."""
    dataset.prepare()
    for number in track(range(len(dataset)), sequence, disable=not sys.stderr.isatty()):
        place = root / sequence
        write(dataset[number], place, f"{number:06d}", place if number < labelled else root / "left_out" / sequence)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; its exit code."""
    from lidarfw_town.datasets import TownKitti

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", metavar="FOLDER", type=Path)
    parser.add_argument("--frames", type=int, default=160, metavar="N", help="of training (default: %(default)s)")
    parser.add_argument("--labelled", type=int, default=24, metavar="N", help="of these (default: %(default)s)")
    parser.add_argument("--sensor", default="ouster32", help="of the town (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the town (default: %(default)s)")
    given = parser.parse_args(arguments)
    made = {"frames": given.frames, "sensor": given.sensor, "seed": given.seed, "picture_width": 0}
    try:
        for split, sequence, labelled in (("train", "street", given.labelled), ("val", "held_out", given.frames)):
            write_split(TownKitti(split=split, classes=CLASSES, **made), given.folder, sequence, labelled)
            write_text(given.folder / f"{split}.txt", f"{sequence}\n")
    except LidarfwError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
