"""`lidarfw predict`: run a checkpoint on scans or pictures, write results and pictures, print a short table."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from lidarfw.files import require_checkpoint

if TYPE_CHECKING:
    from lidarfw.model import PerceptionModel
    from lidarfw.predict import FrameReader
    from lidarfw.types import Frame, FrameResult

T = TypeVar("T")
_UNREAD = {  # options that need another source
    "a sequence": ("split", "poses", "map", "calib", "image", "columns", "intensity_max"),
    "a split": ("static_map", "calib", "image", "columns", "intensity_max", "repair"),
    "scans": ("static_map",),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw predict`."""
    parser.add_argument("checkpoint", metavar="CKPT", help="of `lidarfw train`; nothing else is needed")
    parser.add_argument(
        "scans",
        metavar="SCAN",
        nargs="*",
        help=".bin .pcd .ply .npy .npz .png .jpg, or a folder of them; or one sequence in SemanticKITTI's layout",
    )
    parser.add_argument(
        "--split", metavar="NAME", help="instead of scans: a split of the dataset it learned from, with the truth"
    )
    parser.add_argument("--poses", metavar="FILE", type=Path, help="true poses, 12 numbers a line and scan, to compare")
    parser.add_argument("--map", metavar="FILE", type=Path, help="points of the map, behind the trajectory")
    parser.add_argument("-o", "--output", metavar="DIR", default="predictions", help="folder to write to (%(default)s)")
    parser.add_argument(
        "--format", choices=("json", "npz", "kitti", "label"), help="of results (json; label for a sequence of labels)"
    )
    parser.add_argument("--static-map", metavar="FILE", type=Path, help="PLY of what does not move in a sequence")
    parser.add_argument("--calib", metavar="FILE", type=Path, help="KITTI calibration; in KITTI's layout it is found")
    parser.add_argument("--image", metavar="FILE", type=Path, help="picture; in KITTI's layout it is found")
    parser.add_argument(
        "--score", metavar="S", type=float, default=0.3, help="leave boxes below out (%(default)s; 0: benchmarks)"
    )
    parser.add_argument("--stream", action="store_true", help="the scans are one sequence: track, filter over time")
    parser.add_argument("--columns", metavar="N", type=int, help="values per point of .bin files (4; .pcd.bin 5)")
    parser.add_argument("--intensity-max", metavar="M", type=float, help="full scale of intensity (1)")
    parser.add_argument("--repair", action="store_true", help="drop points that are not finite instead of stopping")
    parser.add_argument("--no-pictures", action="store_true", help="write results only")


def run(args: argparse.Namespace) -> int:
    """Predict every scan, or a whole sequence."""
    require_checkpoint(args.checkpoint)
    from lidarfw.drive_prediction import is_sequence

    sequence = len(args.scans) == 1 and is_sequence(Path(args.scans[0]))
    _check(args, "a sequence" if sequence else "a split" if args.split else "scans")
    return _run_sequence(args) if sequence else _run_scans(args)


def _check(args: argparse.Namespace, source: str) -> None:
    """ConfigError for an option that would do nothing, or has a value that cannot be meant."""
    from lidarfw.errors import ConfigError

    for option in _UNREAD[source]:
        if getattr(args, option) is not None and getattr(args, option) is not False:
            raise ConfigError(f"--{option.replace('_', '-')} does nothing for {source}.\n  fix: leave it out")
    if not math.isfinite(args.score):
        raise ConfigError(f"--score must be a finite number, got {args.score}")
    if args.intensity_max is not None and not 0 < args.intensity_max < math.inf:
        raise ConfigError(f"--intensity-max must be above 0, got {args.intensity_max:g}\n  fix: 1, 255 or 65535")
    if args.columns is not None and args.columns < 3:
        raise ConfigError(f"--columns must be at least 3 (x, y, z), got {args.columns}")


def _run_scans(args: argparse.Namespace) -> int:
    import torch

    import lidarfw
    from lidarfw import draw, predict
    from lidarfw.io import read_points

    model = lidarfw.load(Path(args.checkpoint)).to("cuda" if torch.cuda.is_available() else "cpu")
    reader = predict.FrameReader(
        model, args.columns, args.repair, 1.0 if args.intensity_max is None else args.intensity_max
    )
    frames, count = _frames(args, model, reader)
    if model.plan.data.sweeps > 1 and not args.split:
        print(f"note: the model learned from {model.plan.data.sweeps} scans per frame, here each frame is one scan")
    truth = predict.read_poses(args.poses, count) if args.poses else None
    path = predict.Trajectory(None if args.map is None else torch.from_numpy(read_points(args.map).xyz))
    classes, extent, folder = model.plan.data.classes, predict.extent_of(model), Path(args.output)
    rows = []
    begin = time.perf_counter()
    for number, result in enumerate(predict.predict_frames(model, frames, args.stream)):
        seconds = time.perf_counter() - begin
        shown = predict.keep_scores(result, args.score)
        predict.save(shown, folder, args.format or "json", classes)
        if not args.no_pictures:
            predict.save_pictures(shown, folder, classes, extent)
        path.add(shown, None if truth is None else truth[number])
        rows.append(_row(shown, classes, seconds))
        begin = time.perf_counter()
    _print_table(rows, reader.left_out, folder)
    if len(path):
        print(path.summary())
        if not args.no_pictures:
            draw.write_png(folder / "trajectory.png", path.picture())
    return 0


def _run_sequence(args: argparse.Namespace) -> int:
    """A sequence in order of time: results of every frame, one strip of pictures, the map of what stands still."""
    import torch

    import lidarfw
    from lidarfw import draw, drive_prediction, predict
    from lidarfw.types import PointLabels

    model = lidarfw.load(Path(args.checkpoint)).to("cuda" if torch.cuda.is_available() else "cpu")
    frames = drive_prediction.SequenceFrames(model, Path(args.scans[0]), args.repair)
    classes, folder = model.plan.data.classes, Path(args.output)
    strip = drive_prediction.Strip(len(frames), classes)
    still = drive_prediction.StaticMap(classes=classes) if args.static_map else None
    rows = []
    begin = time.perf_counter()
    for result in predict.predict_frames(model, (frames[i] for i in _with_progress(range(len(frames)))), stream=True):
        seconds = time.perf_counter() - begin
        shown = predict.keep_scores(result, args.score)
        labelled = any(isinstance(value, PointLabels) for value in shown.predictions.values())
        predict.save(shown, folder, args.format or ("label" if labelled else "json"), classes)
        if not args.no_pictures:
            strip.add(shown)
        if still is not None:
            still.add(shown)
        rows.append(_row(shown, classes, seconds))
        begin = time.perf_counter()
    _print_table(rows, (), folder)
    if strip.pictures:
        draw.write_png(folder / "strip.png", strip.picture())
    if still is not None:
        still.write(args.static_map)
        print(f"static map of {len(still.cells)} points: {args.static_map}")
    return 0


def _frames(args: argparse.Namespace, model: PerceptionModel, reader: FrameReader) -> tuple[Iterator[Frame], int]:
    """What to predict, as it is needed, and how many that are."""
    from lidarfw import predict
    from lidarfw.errors import ConfigError

    if bool(args.scans) == bool(args.split):
        raise ConfigError(
            "predict takes scans or --split, one of them\n"
            "  fix: lidarfw predict model.ckpt scans/, or lidarfw predict model.ckpt --split val"
        )
    if args.split:
        split = predict.SplitFrames(model, args.split)
        return (split[index] for index in _with_progress(range(len(split)))), len(split)
    sources = predict.find_sources(args.scans, reader.lidar, args.calib, args.image)
    return predict.read_frames(reader, _with_progress(sources), args.stream), len(sources)


def _with_progress(items: Sequence[T]) -> Iterator[T]:
    """The items, with a progress bar on the terminal where they are many."""
    if len(items) < 3:
        yield from items
        return
    from rich.console import Console
    from rich.progress import track

    yield from track(items, "predict", console=Console(stderr=True), transient=True)


def _row(result: FrameResult, classes: Sequence[str], seconds: float) -> list[str]:
    from lidarfw.types import Boxes, PointLabels, Points

    points = sum(len(value) for value in result.inputs.values() if isinstance(value, Points))
    boxes = [value for value in result.predictions.values() if isinstance(value, Boxes)]
    found = [classes[label] for value in boxes for label in value.label.tolist()]
    counts = ", ".join(f"{found.count(name)} {name}" for name in classes if name in found)
    best = max((float(value.score.max()) for value in boxes if len(value)), default=None)
    moving = [
        f"{int((v.label == classes.index('moving')).sum())} moving points"
        for v in result.predictions.values()
        if isinstance(v, PointLabels) and "moving" in classes
    ]
    others = ", ".join(f"{type(v).__name__}" for v in result.predictions.values() if not isinstance(v, Boxes))
    tracks = f"{len(result.tracks.id)} tracks" if result.tracks is not None else ""
    what = "; ".join(text for text in (counts or ("no boxes" if boxes else ""), tracks, *moving, others) if text)
    return [result.meta.id, str(points), what, "-" if best is None else f"{best:.2f}", f"{seconds:.2f}"]


def _print_table(rows: list[list[str]], left_out: Iterable[str], folder: Path, most: int = 30) -> None:
    shown = [["frame", "points", "found", "best", "seconds"], *rows[:most]]
    widths = [max(len(row[column]) for row in shown) for column in range(5)]
    for row in shown:
        cells = [row[0].ljust(widths[0]), row[1].rjust(widths[1]), row[2].ljust(widths[2]), row[3].rjust(widths[3])]
        print("  ".join([*cells, row[4].rjust(widths[4])]))
    if len(rows) > most:
        print(f"... and {len(rows) - most} more")
    if names := ", ".join(left_out):
        print(f"features of the scans that the model does not know were left out: {names}")
    print(f"{len(rows)} frames written to {folder}")
