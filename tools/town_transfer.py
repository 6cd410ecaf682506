#!/usr/bin/env python3
"""How detectors that learned from the town alone find the cars of real scans: a table and a figure.

python tools/town_transfer.py KITTI NAME=CKPT [NAME=CKPT ...] --out FIGURE.png [--split all] [--pictures DIR]

KITTI: a folder in the layout of KITTI object detection. For every checkpoint: recall and precision of `box_recall`
(unoccluded cars within 30 m, bird's-eye IoU 0.5) at scores from 0.1 to 0.8, the recall of those nearer than 10 to 50 m
at score 0.3, and the average precision of all cars by `box_ap` at IoU 0.5. `--pictures` writes every frame from above
and, where there are pictures, as the camera sees it, predicted and true boxes in it, of the first checkpoint.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.progress import track as progress

from lidarfw import checkpoint
from lidarfw.assembly import make_transforms
from lidarfw.components.datasets.kitti import KittiDataset
from lidarfw.components.metrics.box_ap import BoxAP
from lidarfw.components.metrics.box_recall import BoxRecall
from lidarfw.errors import ConfigError, LidarfwError
from lidarfw.files import atomic_path
from lidarfw.predict import extent_of, keep_scores, predict_frames, save_pictures
from lidarfw.types import Boxes, Frame, FrameResult, Spec, Targets

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from matplotlib.axes import Axes

    from lidarfw.model import PerceptionModel

SCORES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
USUAL = 0.3  # score of the recall by distance
RANGES = (10, 15, 20, 25, 30, 35, 40, 45, 50)  # metres
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#111111")


@dataclass(frozen=True)
class Curves:
    """Recall and precision by SCORES, recall by RANGES, the average precision and the number of cars within 30 m."""

    recall: tuple[float, ...]
    precision: tuple[float, ...]
    by_range: tuple[float, ...]
    average: float
    cars: int


def frames_of(model: PerceptionModel, dataset: KittiDataset) -> Iterator[Frame]:
    """The frames as the model takes them."""
    transforms = make_transforms(model.plan.config, training=False)
    for number in range(len(dataset)):
        frame = dataset[number]
        for change in transforms:
            frame = change(frame, np.random.default_rng(0))
        yield frame


def run(path: str, root: str, split: str) -> tuple[PerceptionModel, list[FrameResult]]:
    """What a checkpoint finds in the frames of a folder."""
    model = checkpoint.load(path).eval()
    dataset = KittiDataset(root=root, split=split, classes=model.plan.data.classes)
    dataset.prepare()
    frames = predict_frames(model, frames_of(model, dataset))
    return model, list(progress(frames, total=len(dataset), description=path, disable=not sys.stderr.isatty()))


def found_in(result: FrameResult) -> tuple[Boxes, Targets]:
    """The boxes of a result and the truth."""
    boxes = next((value for value in result.predictions.values() if isinstance(value, Boxes)), None)
    if boxes is None or result.targets is None:
        raise ConfigError(f"frame {result.meta.id}: a detector and labelled frames are needed")
    return boxes, result.targets


def measure(results: Sequence[FrameResult], classes: tuple[str, ...]) -> Curves:
    """The curves of one checkpoint."""
    spec, pairs = Spec(Boxes, classes=classes), [found_in(result) for result in results]

    def figures(metric: BoxAP) -> dict[str, float]:
        for boxes, targets in pairs:
            metric.update(boxes, targets)
        return metric.compute()

    scored = [figures(BoxRecall(spec, min_score=score)) for score in SCORES]
    ranged = [figures(BoxRecall(spec, min_score=USUAL, max_range=float(far))) for far in RANGES]
    recall, precision = (tuple(one.get(f"car_bev_{k}", 0.0) for one in scored) for k in ("recall", "precision"))
    by_range = tuple(one.get("car_bev_recall", float("nan")) for one in ranged)
    average = figures(BoxAP(spec, iou={"Car": 0.5})).get("car_bev_ap", 0.0)
    return Curves(recall, precision, by_range, average, int(scored[0].get("car_objects", 0)))


def draw(path: str | Path, curves: dict[str, Curves]) -> None:
    """Both panels as one PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((11, 4.6), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for (name, one), colour in zip(curves.items(), COLOURS):
        left.plot(one.recall, one.precision, "o-", color=colour, label=f"{name}: AP of all cars {one.average:.2f}")
        right.plot(RANGES, one.by_range, "o-", color=colour, label=name)
        usual = SCORES.index(USUAL)
        left.annotate(f"score {USUAL}", (one.recall[usual], one.precision[usual]), (6, 6), textcoords="offset points")
    cars = next(iter(curves.values())).cars
    _finish(left, f"{cars} unoccluded cars within 30 m", "recall", "precision")
    _finish(right, f"unoccluded cars, score {USUAL}", "nearer than (m)", "recall")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _finish(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y, ylim=(-0.02, 1.05))
    axes.set_title(title, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, loc="lower left")


def main(arguments: list[str] | None = None) -> int:
    """Run the command; its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti", metavar="KITTI", help="folder that holds training/")
    parser.add_argument("checkpoints", metavar="NAME=CKPT", nargs="+")
    parser.add_argument("--out", required=True, metavar="PNG", help="the figure")
    parser.add_argument("--split", default="all", help="of KITTI (default: all)")
    parser.add_argument("--pictures", metavar="DIR", help="write the frames with boxes too")
    given = parser.parse_args(arguments)
    curves: dict[str, Curves] = {}
    try:
        for entry in given.checkpoints:
            name, _, path = entry.rpartition("=")
            model, results = run(path, given.kitti, given.split)
            classes = model.plan.data.classes
            if given.pictures and not curves:
                for result in results:
                    save_pictures(keep_scores(result, USUAL), Path(given.pictures), classes, extent_of(model))
            curves[name or Path(path).stem] = measure(results, classes)
    except LidarfwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("| | cars within 30 m | recall | precision | AP of all cars |")
    usual = SCORES.index(USUAL)
    for name, one in curves.items():
        print(f"| {name} | {one.cars} | {one.recall[usual]:.3f} | {one.precision[usual]:.3f} | {one.average:.3f} |")
    draw(given.out, curves)
    return 0


if __name__ == "__main__":
    sys.exit(main())
