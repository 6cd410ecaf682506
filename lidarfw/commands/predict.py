"""`lidarfw predict`: run a checkpoint on scans or pictures, write results and pictures, print a short table."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lidarfw.predict import Source
    from lidarfw.types import FrameResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw predict`."""
    parser.add_argument("checkpoint", metavar="CKPT", help="of `lidarfw train`; nothing else is needed")
    parser.add_argument("scans", metavar="SCAN", nargs="+", help=".bin .pcd .ply .npy .npz .png .jpg, or a folder")
    parser.add_argument("-o", "--output", metavar="DIR", default="predictions", help="folder to write to (%(default)s)")
    parser.add_argument("--format", choices=("json", "npz", "kitti"), default="json", help="of results (%(default)s)")
    parser.add_argument("--calib", metavar="FILE", type=Path, help="KITTI calibration; in KITTI's layout it is found")
    parser.add_argument("--image", metavar="FILE", type=Path, help="picture; in KITTI's layout it is found")
    parser.add_argument(
        "--score", metavar="S", type=float, default=0.3, help="leave boxes below out (%(default)s; 0: benchmarks)"
    )
    parser.add_argument("--stream", action="store_true", help="the scans are one sequence: track, filter over time")
    parser.add_argument("--columns", metavar="N", type=int, help="values per point of .bin files (4; .pcd.bin 5)")
    parser.add_argument("--intensity-max", metavar="M", type=float, default=1.0, help="full scale of intensity (1)")
    parser.add_argument("--repair", action="store_true", help="drop points that are not finite instead of stopping")
    parser.add_argument("--no-pictures", action="store_true", help="write results only")


def run(args: argparse.Namespace) -> int:
    """Predict every scan."""
    import torch

    import lidarfw
    from lidarfw import predict

    model = lidarfw.load(Path(args.checkpoint)).to("cuda" if torch.cuda.is_available() else "cpu")
    reader = predict.FrameReader(model, args.columns, args.repair, args.intensity_max)
    sources = predict.find_sources(args.scans, reader.lidar, args.calib, args.image)
    if model.plan.data.sweeps > 1:
        print(f"note: the model learned from {model.plan.data.sweeps} scans per frame, here each frame is one scan")
    classes, extent, folder = model.plan.data.classes, predict.extent_of(model), Path(args.output)
    rows = []
    begin = time.perf_counter()
    for result in predict.predict(model, reader, _with_progress(sources), args.stream):
        seconds = time.perf_counter() - begin
        shown = predict.keep_scores(result, args.score)
        predict.save(shown, folder, args.format, classes)
        if not args.no_pictures:
            predict.save_pictures(shown, folder, classes, extent)
        rows.append(_row(shown, classes, seconds))
        begin = time.perf_counter()
    _print_table(rows, reader.left_out, folder)
    return 0


def _with_progress(sources: Sequence[Source]) -> Iterator[Source]:
    """The sources, with a progress bar on the terminal where they are many."""
    if len(sources) < 3:
        yield from sources
        return
    from rich.console import Console
    from rich.progress import track

    yield from track(sources, "predict", console=Console(stderr=True), transient=True)


def _row(result: FrameResult, classes: Sequence[str], seconds: float) -> list[str]:
    from lidarfw.types import Boxes, Points

    points = sum(len(value) for value in result.inputs.values() if isinstance(value, Points))
    boxes = [value for value in result.predictions.values() if isinstance(value, Boxes)]
    found = [classes[label] for value in boxes for label in value.label.tolist()]
    counts = ", ".join(f"{found.count(name)} {name}" for name in classes if name in found)
    best = max((float(value.score.max()) for value in boxes if len(value)), default=None)
    others = ", ".join(f"{type(v).__name__}" for v in result.predictions.values() if not isinstance(v, Boxes))
    tracks = f"{len(result.tracks.id)} tracks" if result.tracks is not None else ""
    what = "; ".join(text for text in (counts or ("no boxes" if boxes else ""), tracks, others) if text)
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
