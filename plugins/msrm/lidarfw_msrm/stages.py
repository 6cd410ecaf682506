"""What each stage makes of the boxes: `python -m lidarfw_msrm.stages CKPT [OVERRIDE ...]`.

The network runs once over the test split; its proposals, every stage and the vote go through the same suppression and
are measured: average precision at 0.7 for cars and 0.5 for others, at 0.5 and 0.25, and overlap and errors of the boxes
that match an object; differences between them with the middle 90 % of a bootstrap over frames.

`--regions 8 16 32` measures the vote of the best 8, 16 and 32 proposals too: regions do not see each other, so that
these are what a model with fewer regions gives. `--pictures DIR` draws objects of every frame, stage by stage.
Overrides are those of `lidarfw eval`: `dataset=kitti dataset.kitti.root=/data/kitti splits.test=val`.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import json
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from lidarfw import checkpoint
from lidarfw.cli import answered
from lidarfw.components.metrics.box_ap import BoxAP
from lidarfw.components.postprocessors.nms import NMS
from lidarfw.data import evaluation_data
from lidarfw.errors import ConfigError
from lidarfw.evaluation import evaluation_config
from lidarfw.files import atomic_path, require_checkpoint, write_text
from lidarfw.interfaces import Dataset, Metric, Transform
from lidarfw.model import PerceptionModel
from lidarfw.ops import box_corners, iou_3d
from lidarfw.resampling import blocks, draws, interval
from lidarfw.types import Boxes, FrameMeta, Points, Spec, Targets, collate
from rich.progress import track

from lidarfw_msrm.heads.msrm import MSRMHead, MSRMOutput
from lidarfw_msrm.metrics.box_quality import BoxQuality
from lidarfw_msrm.postprocessors.box_voting import BoxVoting

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COMPARED = {
    "mean_3d_ap": "AP",
    "loose_mean_3d_ap": "AP loose",
    "match_mean_iou": "IoU",
    "match_mean_center": "centre (m)",
    "match_mean_yaw": "yaw (rad)",
}
LOOSE = {"Car": 0.5, "Pedestrian": 0.25, "Cyclist": 0.25}
FINAL = 0.1  # IoU of the suppression
SHOWN = 3  # objects of a frame in a picture
AROUND = 4.0  # metres around an object
GROUND = 0.25  # metres over the foot of an object
TRUTH, FOUND = "#0072B2", "#D55E00"


Metrics = dict[str, Metric]  # by the prefix of their figures


@dataclass
class Seen:
    """One frame: the boxes of all stages, and what is true."""

    meta: FrameMeta
    stages: Boxes
    points: Points
    targets: Targets


def ways(stages: int) -> dict[str, tuple[int, ...]]:
    """What may vote, by name."""
    single = {f"stage {n}": (n,) for n in range(1, stages + 1)}
    return {"proposals": (0,), **single, "vote": ()}


def detections(stages: Boxes, chosen: tuple[int, ...], regions: int | None = None) -> Boxes:
    """The boxes of the chosen stages, of the best regions, after suppression."""
    spec = Spec(Boxes)
    voted: Boxes = BoxVoting(spec, stages=chosen, regions=regions)(stages)
    kept: Boxes = NMS(spec, iou_threshold=FINAL)(voted)
    return kept


def run(model: PerceptionModel, dataset: Dataset, transforms: Sequence[Transform]) -> Iterator[Seen]:
    """The frames of a dataset that is ready, one by one."""
    head = next((module for module in model.modules() if isinstance(module, MSRMHead)), None)
    if head is None:
        raise ConfigError("the checkpoint has no head 'msrm'.\n  fix: one of experiment=msrm_town")
    for number in track(range(len(dataset)), "frames", disable=not sys.stderr.isatty()):
        frame = dataset[number]
        for change in transforms:
            frame = change(frame, np.random.default_rng(0))
        with torch.no_grad():
            outputs = model(collate([frame]))
        output = next(value for value in outputs.values() if isinstance(value, MSRMOutput))
        yield Seen(frame.meta, head.decode(output), frame.inputs["points"], frame.targets)


def measured(
    seen: Sequence[Seen], classes: tuple[str, ...], chosen: tuple[int, ...], regions: int | None = None
) -> list[Metrics]:
    """The metrics of one way on every frame, by the prefix of their figures."""
    spec = Spec(Boxes, classes=classes)
    loose = {name: value for name, value in LOOSE.items() if name in classes}
    found = []
    for one in seen:
        metrics = {"": BoxAP(spec), "loose_": BoxAP(spec, iou=loose, default_iou=0.25), "match_": BoxQuality(spec)}
        for metric in metrics.values():
            metric.update(detections(one.stages, chosen, regions), one.targets)
        found.append(metrics)
    return found


def joined(parts: Sequence[Metrics]) -> Metrics:
    """The metrics of several frames as those of all of them."""
    whole = {prefix: copy.deepcopy(metric) for prefix, metric in parts[0].items()}
    for prefix, metric in whole.items():
        metric.reset()
        for part in parts:
            metric.merge_state(part[prefix])
    return whole


def figures(metrics: Metrics) -> dict[str, float]:
    """By name."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torchmetrics: compute before update
        computed = {prefix: metric.compute() for prefix, metric in metrics.items()}
    return {f"{prefix}{key}": value for prefix, one in computed.items() for key, value in one.items()}


def resampled(frames: Sequence[Metrics], meta: Sequence[FrameMeta], samples: int, block: int) -> list[dict[str, float]]:
    """Figures of bootstrap samples of blocks of frames, the same ones for every way."""
    parts = [joined([frames[row] for row in rows]) for rows in blocks(meta, block)]
    return [figures(joined([parts[place] for place in drawn])) for drawn in draws(len(parts), samples)]


def differences(found: dict[str, dict[str, float]], drawn: dict[str, list[dict[str, float]]]) -> str:
    """As Markdown: what each way gains over the proposals and over the way before it, with the middle 90 %."""
    names, lines = list(drawn), ["| | " + " | ".join(COMPARED.values()) + " |", "|---" * (len(COMPARED) + 1) + "|"]
    pairs = [(name, names[0]) for name in names[1:]]
    pairs += [(late, early) for early, late in itertools.pairwise(names[1:])]
    for name, other in pairs:
        cells = []
        for key in COMPARED:
            apart = [
                one.get(key, math.nan) - two.get(key, math.nan)
                for one, two in zip(drawn[name], drawn[other], strict=True)
            ]
            low, high = interval(apart)
            cells.append(
                f"{found[name].get(key, math.nan) - found[other].get(key, math.nan):+.3f} [{low:+.3f}, {high:+.3f}]"
            )
        lines.append(f"| {name} - {other} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def table(found: dict[str, dict[str, float]], classes: Sequence[str]) -> str:
    """As Markdown: AP and loose AP of every class, IoU, centre and yaw of matched boxes in the mean over classes."""
    keys = [name.lower() for name in classes if f"{name.lower()}_3d_ap" in next(iter(found.values()))]
    heads = [*(f"{k} AP" for k in keys), *(f"{k} AP loose" for k in keys), "IoU", "centre (m)", "yaw (rad)", "recall"]
    lines = ["| | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for name, one in found.items():
        cells = [one[f"{prefix}{k}_3d_ap"] for prefix in ("", "loose_") for k in keys]
        cells += [one.get(f"match_mean_{what}", math.nan) for what in ("iou", "center", "yaw", "recall")]
        lines.append(f"| {name} | " + " | ".join(f"{cell:.3f}" for cell in cells) + " |")
    return "\n".join(lines)


def draw(path: Path, one: Seen, stages: int) -> bool:
    """The objects that the vote overlaps most, a row each, the ways a column each; False where nothing matches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    truth = one.targets.boxes
    found = {name: detections(one.stages, chosen) for name, chosen in ways(stages).items()}
    if truth is None or len(truth) == 0 or len(found["vote"]) == 0:
        return False
    same = truth.label[:, None] == found["vote"].label
    overlap = torch.where(same, iou_3d(truth.tensor, found["vote"].tensor), 0.0).amax(1)
    rows = [row for row in overlap.argsort(descending=True).tolist() if overlap[row] > 0][:SHOWN]
    if not rows:
        return False
    figure = Figure((2.3 * len(found), 2.5 * len(rows) + 0.7), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(rows), len(found), squeeze=False)
    for line, row in zip(panels, rows, strict=True):
        for axes, (name, boxes) in zip(line, found.items(), strict=True):
            _panel(axes, one.points, truth[row : row + 1], boxes, name)
    figure.suptitle(f"{one.meta.id}, from above, {2 * AROUND:.0f} m wide; grey: points on the ground", fontsize=9)
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")
    return True


def _panel(axes: Axes, points: Points, truth: Boxes, boxes: Boxes, name: str) -> None:
    """One object from above: points, truth, the box of its class that overlaps it most."""
    boxes = boxes[boxes.label == truth.label]
    x, y = truth.center[0, :2].tolist()
    near = (points.xyz[:, :2] - truth.center[:, :2]).abs().amax(1) <= AROUND
    ground = float(truth.center[0, 2] - truth.size[0, 2] / 2) + GROUND
    for above, colour in ((False, "#C8C8C8"), (True, "#303030")):
        shown = points.xyz[near & ((points.xyz[:, 2] > ground) == above)]
        axes.scatter(shown[:, 0], shown[:, 1], s=3, c=colour, linewidths=0, label="points" if above else None)
    axes.set(xlim=(x - AROUND, x + AROUND), ylim=(y - AROUND, y + AROUND), aspect="equal", xticks=[], yticks=[])
    axes.plot(*_outline(truth.tensor), color=TRUTH, linewidth=1.6, linestyle="--", label="labelled")
    overlap = iou_3d(truth.tensor, boxes.tensor)[0] if len(boxes) else truth.yaw.new_zeros(1)
    best = int(overlap.argmax())
    if overlap[best] > 0:
        axes.plot(*_outline(boxes.tensor[best : best + 1]), color=FOUND, linewidth=1.8, label="found")
    axes.set_title(f"{name}: IoU {float(overlap[best]):.2f}", fontsize=9)


def _outline(box: torch.Tensor) -> tuple[list[float], list[float]]:
    corners = box_corners(box)[0, [0, 1, 2, 3, 0], :2]
    return corners[:, 0].tolist(), corners[:, 1].tolist()


@answered
def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", metavar="CKPT")
    parser.add_argument("overrides", metavar="OVERRIDE", nargs="*", help="of `lidarfw eval`")
    parser.add_argument("--regions", type=int, nargs="+", default=[], metavar="N", help="the vote of so many regions")
    parser.add_argument("--resamples", type=int, default=200, metavar="N", help="bootstrap samples (%(default)s)")
    parser.add_argument("--block", type=int, default=5, metavar="N", help="frames drawn together (%(default)s)")
    parser.add_argument("--pictures", type=Path, metavar="DIR")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    given = parser.parse_args(arguments)
    require_checkpoint(given.checkpoint)
    model = checkpoint.load(given.checkpoint).eval()
    classes, stages = model.plan.data.classes, _stages(model)
    seen = list(run(model, *data_of(given.checkpoint, given.overrides)))
    frames = {name: measured(seen, classes, chosen) for name, chosen in ways(stages).items()}
    found = {name: figures(joined(parts)) for name, parts in frames.items()}
    few = {f"vote, {n} regions": figures(joined(measured(seen, classes, (), n))) for n in given.regions}
    print(table(found | few, classes))
    if given.resamples:
        meta = [one.meta for one in seen]
        drawn = {name: resampled(parts, meta, given.resamples, given.block) for name, parts in frames.items()}
        print(f"\n{differences(found, drawn)}")
    if given.json:
        write_text(given.json, json.dumps(found | few, indent=1) + "\n")
    if given.pictures:
        for one in seen:
            draw(given.pictures / f"{one.meta.id.replace('/', '_')}_stages.png", one, stages)


def _stages(model: PerceptionModel) -> int:
    return next((len(module.encoders) for module in model.modules() if isinstance(module, MSRMHead)), 0)


def data_of(path: str, overrides: Sequence[str]) -> tuple[Dataset, list[Transform]]:
    """Test split and transforms of a checkpoint's config with overrides, ready to be read."""
    about = checkpoint.description(checkpoint.read(path), path)
    config = evaluation_config(checkpoint.config_of(about, path), overrides)
    return evaluation_data(config, config.splits.test)


if __name__ == "__main__":
    sys.exit(main())
