"""`lidarfw track`: run a tracker on files of detections and write tracks in the official formats."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarfw.detections import DetectedSequence, Detections
    from lidarfw.interfaces import Tracker
    from lidarfw.types import Tracks

    Frames = list[tuple[Detections, Tracks]]

_EXAMPLE = """example:
  lidarfw track det --format kitti --calib calib --poses poses -o results --tracker ab3dmot_kitti
  det/{Car,Pedestrian,Cyclist}/0000.txt -> results/0000.txt
"""
_EXPECTED = {
    "kitti": "a folder DETECTIONS/CLASS/SEQUENCE.txt, for example det/Car/0000.txt",
    "nuscenes": "a detection submission, one JSON file",
    "json": "a folder of what lidarfw predict wrote",
}
_OPTIONS = {"kitti": ("calib", "poses", "sequences", "images"), "nuscenes": ("root",)}  # what no other format reads


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw track`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EXAMPLE
    parser.add_argument("detections", metavar="DETECTIONS", type=Path, help="folder (kitti, json) or file (nuscenes)")
    parser.add_argument(
        "--tracker", metavar="NAME", nargs="+", default=["greedy"],
        help="tracker or preset, and overrides as for train: tracker.NAME.OPTION=VALUE (greedy)",
    )  # fmt: skip
    parser.add_argument("--format", choices=("kitti", "nuscenes", "json"), default="kitti", help="(%(default)s)")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, default=Path("tracks"), help="(%(default)s)")
    parser.add_argument("--calib", metavar="DIR", type=Path, help="kitti: calibrations SEQUENCE.txt")
    parser.add_argument("--poses", metavar="DIR", type=Path, help="kitti: 3 x 4 poses of camera 0, SEQUENCE.txt")
    parser.add_argument("--root", metavar="DIR", type=Path, help="nuscenes: folder of the tables (ROOT/v1.0-trainval)")
    parser.add_argument("--sequences", metavar="NAME", nargs="+", help="kitti: only these (all)")
    parser.add_argument("--config-dir", metavar="DIR", help="folder with configs of your own")
    parser.add_argument("--pictures", action="store_true", help="also write a page to look through each sequence")
    parser.add_argument("--images", metavar="DIR", type=Path, help="kitti: pictures SEQUENCE/000000.png for the pages")


def run(args: argparse.Namespace) -> int:
    """Track every sequence."""
    from lidarfw import detections

    sequences, classes, meta = _read(args)
    own = [f"--config-dir={args.config_dir}"] if args.config_dir else []
    posed = all(frame.pose is not None for sequence in sequences for frame in sequence.frames)
    tracker = detections.make_tracker([*own, f"tracker={args.tracker[0]}", *args.tracker[1:]], classes)
    if not posed:
        print("note: no poses: the tracker works in the frame of the sensor, and its motion is not taken out")
    begin = time.perf_counter()
    done = [_track(tracker, sequence) for sequence in _with_progress(sequences)]
    seconds = time.perf_counter() - begin
    _write(args, sequences, done, classes, meta)
    frames = sum(len(rows) for rows in done)
    boxes = sum(len(tracks.id) for rows in done for _, tracks in rows)
    print(f"{frames} frames of {len(done)} sequences: {boxes} boxes, {frames / seconds:.0f} frames/s -> {args.output}")
    return 0


def _read(args: argparse.Namespace) -> tuple[list[DetectedSequence], tuple[str, ...], dict[str, Any]]:
    from lidarfw import detections
    from lidarfw.errors import DataError

    _check(args)
    if args.format == "json":
        sequence, classes = detections.read_json(args.detections)
        return [sequence], classes, {}
    if args.format == "nuscenes":
        if args.root is None:
            raise DataError("nuScenes results need the tables for order and poses.\n  fix: --root ROOT/v1.0-trainval")
        return detections.read_nuscenes(args.detections, args.root)
    if args.images and not args.pictures:
        raise DataError("--images is for the pages of --pictures.\n  fix: add --pictures")
    if args.calib is None:
        raise DataError(
            "KITTI results hold 2D boxes, which need the calibrations.\n  fix: --calib DIR (with SEQUENCE.txt)"
        )
    classes = detections.kitti_classes(args.detections)
    names = args.sequences or detections.kitti_sequences(args.detections)
    read = (detections.read_kitti(args.detections, name, classes, args.poses, args.calib) for name in names)
    return list(read), classes, {}


def _check(args: argparse.Namespace) -> None:
    from lidarfw.errors import ConfigError, DataError

    expected = f"{args.format}: {_EXPECTED[args.format]}"
    if not args.detections.exists():
        raise DataError(f"there are no detections {args.detections}.\n  {expected}")
    if args.detections.is_file() != (args.format == "nuscenes"):
        kind = "file" if args.detections.is_file() else "folder"
        raise DataError(f"{args.detections} is a {kind}.\n  {expected}\n  fix: give that, or another --format")
    for form, options in _OPTIONS.items():
        strange = [option for option in options if getattr(args, option) is not None]
        if strange and form != args.format:
            raise ConfigError(
                f"--{strange[0]} is for --format {form}, not {args.format}.\n  fix: leave it out, or change --format"
            )


def _with_progress(sequences: list[DetectedSequence]) -> Any:
    from rich.console import Console
    from rich.progress import track

    return track(sequences, "track", console=Console(stderr=True), transient=True)


def _track(tracker: Tracker, sequence: DetectedSequence) -> Frames:
    from lidarfw import detections

    return list(detections.run(tracker, sequence))


def _write(
    args: argparse.Namespace,
    sequences: list[DetectedSequence],
    done: list[Frames],
    classes: tuple[str, ...],
    meta: dict[str, Any],
) -> None:
    from lidarfw import detections

    if args.format == "nuscenes":
        detections.write_nuscenes(args.output / "tracking_result.json", done, meta)
    for sequence, rows in zip(sequences, done, strict=True):
        frames = [(frame.meta, tracks) for frame, tracks in rows]
        if args.format == "kitti":
            detections.write_kitti(args.output / f"{sequence.name}.txt", frames, classes)
        if args.format == "json":
            detections.write_json(args.output, frames, classes)
        if args.pictures:
            from lidarfw import track_page

            images = args.images / sequence.name if args.images else None
            track_page.write_page(args.output / f"{sequence.name}.html", sequence.name, rows, classes, images)
