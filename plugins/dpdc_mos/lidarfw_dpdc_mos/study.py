"""What the filter does to a trained network: `python -m lidarfw_dpdc_mos.study CKPT OVERRIDE...`.

The network runs once over a split; every setting of the filter goes over the same predictions. Beside each stands
the unfiltered network at the threshold that its prior amounts to, since a prior below 0.5 moves the threshold and
that alone changes the figures (see `matched_threshold`).
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lidarfw
import numpy as np
import torch
from lidarfw.checkpoint import config_of, description, read
from lidarfw.cli import answered
from lidarfw.components.datasets.semantic_kitti import SemanticKittiDataset
from lidarfw.data import evaluation_data
from lidarfw.errors import DataError
from lidarfw.evaluation import evaluation_config
from lidarfw.files import write_text
from lidarfw.ops import range_match, range_project
from lidarfw.types import FrameResult, PointLabels, Points, Poses, RangeImage, RangeView, collate
from torch import Tensor

from lidarfw_dpdc_mos.bayes import BayesFilter

NEAR = 30.0  # metres; the paper reports both sides
_SAME = 0.3  # metres within which a point is the same as one of the frame before
MOVABLE = (
    "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist",
)  # fmt: skip


def matched_threshold(prior: float, window: int) -> float:
    """Probability of one frame at which `window` equal frames reach 0.5 under that prior.

    l = l_0 + N (logit xi - l_0) > 0 where logit xi > l_0 (N - 1) / N: 0.366 for the paper's prior 0.25 and N = 2.
    """
    logit = np.log(prior / (1 - prior)) * (window - 1) / window
    return float(1 / (1 + np.exp(-logit)))


@dataclass
class Seen:
    """One frame: what the network says, and what is true."""

    result: FrameResult
    points: Points
    labels: PointLabels
    truth: Tensor  # (N,) int64: 1 moving, 0 static, -1 unknown
    pose: Poses | None
    counts: bool = True  # in figures; the filter sees every frame


@dataclass
class Figures:
    """Points counted over all frames; rates of them."""

    right: int = 0  # moving and found
    wrong: int = 0  # found and static
    missed: int = 0
    near: list[int] = field(default_factory=lambda: [0, 0])  # right, and right + wrong + missed, up to NEAR
    far: list[int] = field(default_factory=lambda: [0, 0])
    flips: list[int] = field(default_factory=lambda: [0, 0])  # changed, and compared, from one frame to the next

    def add(self, seen: Seen, moving: Tensor) -> None:
        """Count a frame in; `moving` (N,) bool."""
        true, known = seen.truth == 1, seen.truth >= 0
        right, union = moving & true, (moving | true) & known
        self.right += int(right.sum())
        self.wrong += int((moving & (seen.truth == 0)).sum())
        self.missed += int((true & ~moving).sum())
        close = seen.points.xyz.norm(dim=1) <= NEAR
        for side, rows in ((self.near, close), (self.far, ~close)):
            side[0] += int((right & rows).sum())
            side[1] += int((union & rows).sum())

    def to_plain(self) -> dict[str, float]:
        """IoU, precision, recall, IoU near and far, and the share of points whose label flips; NaN where undefined."""
        ratios = {
            "iou": (self.right, self.right + self.wrong + self.missed),
            "precision": (self.right, self.right + self.wrong),
            "recall": (self.right, self.right + self.missed),
            "near_iou": (self.near[0], self.near[1]),
            "far_iou": (self.far[0], self.far[1]),
            "flicker": (self.flips[0], self.flips[1]),
        }
        return {name: part / whole if whole else float("nan") for name, (part, whole) in ratios.items()}


def predictions(checkpoint: Path, overrides: Sequence[str], past: int = 0) -> Iterator[Seen]:
    """The unfiltered predictions of a checkpoint on the test split of its config, changed by `overrides`.

    Frames with fewer than `past` scans of the sequence before them do not count.
    """
    about = description(read(checkpoint), checkpoint)
    config = evaluation_config(config_of(about, checkpoint), list(overrides))
    model = lidarfw.load(checkpoint)
    dataset, transforms = evaluation_data(config, config.splits.test)
    for place, index in itertools.chain.from_iterable(map(enumerate, dataset.sequences())):
        frame = dataset[index]
        for change in transforms:
            frame = change(frame, np.random.default_rng(0))
        with torch.no_grad():
            result = model.predict(collate([frame]))[0]
        labelled = frame.targets.points
        if labelled is None:
            raise DataError(f"frame {frame.meta.id} has no labels")
        pose = next((v for v in frame.inputs.values() if isinstance(v, Poses)), None)
        yield Seen(result, frame.inputs["points"], result.of(PointLabels), labelled.label, pose, place >= past)


def filtered(frames: Sequence[Seen], part: BayesFilter) -> list[Tensor]:
    """Probability of moving (N,) of every frame after the filter, which starts anew with every sequence."""
    found: dict[str, Tensor] = {}
    state, last = part.start(), ""
    for seen in frames:
        out: list[FrameResult] = []
        if seen.result.meta.sequence != last:
            out += part.flush(state)
            state, last = part.start(), seen.result.meta.sequence
        out += part.step(state, seen.result, seen.labels, seen.points, seen.pose)
        found |= {done.meta.id: done.of(PointLabels).probability[:, part.moving] for done in out}
    found |= {done.meta.id: done.of(PointLabels).probability[:, part.moving] for done in part.flush(state)}
    return [found[seen.result.meta.id] for seen in frames]


def figures(frames: Sequence[Seen], moving: Sequence[Tensor]) -> dict[str, float]:
    """All rates for labels (N,) bool of every frame, in order of time."""
    total = Figures()
    for number, (seen, label) in enumerate(zip(frames, moving, strict=True)):
        if not seen.counts:
            continue
        total.add(seen, label)
        if number and frames[number - 1].result.meta.sequence == seen.result.meta.sequence:
            _count_flips(total, frames[number - 1], moving[number - 1], seen, label)
    return total.to_plain()


def _count_flips(total: Figures, before: Seen, then: Tensor, seen: Seen, now: Tensor) -> None:
    """Points that are there in both frames and whose truth stays: how many have changed their label?"""
    view = next((v.view for v in seen.result.inputs.values() if isinstance(v, RangeImage)), None)
    if before.pose is None or seen.pose is None or view is None:
        return
    old, same = _carried(before, then, seen, view)
    compared = same & (old >= 0)
    total.flips[0] += int((compared & ((old == 1) != now)).sum())
    total.flips[1] += int(compared.sum())


def _carried(before: Seen, then: Tensor, seen: Seen, view: RangeView) -> tuple[Tensor, Tensor]:
    """Label (N,) of the frame before at each point, -1 for none, and whether the truth is known and the same."""
    if before.pose is None or seen.pose is None:
        raise ValueError("both frames need a pose")
    change = torch.linalg.inv(seen.pose.matrix[0].double()) @ before.pose.matrix[0].double()
    moved = (before.points.xyz.double() @ change[:3, :3].T + change[:3, 3]).float()
    content = torch.stack([then.float(), before.truth.float()], 1)
    image = range_project(Points.from_scan(moved, content), view)
    pixel = range_match(image, seen.points.xyz, _SAME, window=3)
    table = image.features[0, 1:].flatten(1)[:, pixel.clamp(min=0)]
    same = (table[1] == seen.truth) & (seen.truth >= 0) & (pixel >= 0)
    return torch.where(pixel >= 0, table[0].long(), -1), same


def fit_prior(frames: Sequence[Seen], rounds: int = 20) -> tuple[float, float, float]:
    """Coefficients (a, b, c) of the option `adaptive`: logistic regression of "moves" on ln(range) and height.

    By Newton's method on all labelled points. Fit it on training data, not on what is then evaluated.
    """
    rows, truth = [], []
    for seen in frames:
        known = seen.truth >= 0
        xyz = seen.points.xyz[known].double()
        rows.append(torch.stack([torch.ones(len(xyz)), xyz.norm(dim=1).clamp(min=1e-3).log(), xyz[:, 2]], 1))
        truth.append((seen.truth[known] == 1).double())
    x, y = torch.cat(rows).double(), torch.cat(truth)
    weight = torch.zeros(3, dtype=torch.float64)
    for _ in range(rounds):
        p = torch.sigmoid(x @ weight)
        curvature = x.T @ (x * (p * (1 - p))[:, None]) + 1e-6 * torch.eye(3, dtype=torch.float64)
        weight = weight + torch.linalg.solve(curvature, x.T @ (y - p))
    a, b, c = weight.tolist()
    return a, b, c


def settings(adaptive: tuple[float, ...]) -> Iterator[dict[str, Any]]:
    """The settings of the filter that the study goes through."""
    yield from ({"window": n, "prior": p} for n in (2, 5) for p in (0.25, 0.5))
    yield from ({"window": 2, "transport": "voxel"}, {"window": 5, "transport": "voxel"})
    yield from ({"window": 2, "max_speed": 0.0}, {"window": 3, "delay": 1}, {"window": 5, "tempering": 0.5})
    if adaptive:
        yield {"window": 2, "adaptive": adaptive}


def study(frames: Sequence[Seen], adaptive: tuple[float, ...] = ()) -> dict[str, dict[str, float]]:
    """Figures by setting: the network alone, the filter, and the network alone at the filter's threshold."""
    raw = [seen.labels.probability[:, 1] for seen in frames]
    table = {"no filter": figures(frames, [p > 0.5 for p in raw])}
    for options in settings(adaptive):
        part = make_filter(frames[0], options)
        name = ", ".join(f"{key} {_short(value)}" for key, value in options.items())
        table[name] = figures(frames, [p > 0.5 for p in filtered(frames, part)])
        threshold = matched_threshold(options.get("prior", 0.25), options.get("window", 2))
        alone = f"no filter, threshold {threshold:.3f}"
        table.setdefault(alone, figures(frames, [p > threshold for p in raw]))
    return table


def make_filter(seen: Seen, options: dict[str, Any]) -> BayesFilter:
    """The filter with these options, for frames such as this one."""
    from lidarfw.types import DataSpec, Spec

    image = next((v for v in seen.result.inputs.values() if isinstance(v, RangeImage)), None)
    inputs = {} if image is None else {"range": Spec(RangeImage, image.features.shape[1], 1, image.view)}
    labels = Spec(PointLabels, classes=("static", "moving"))
    pose = Spec(Poses) if seen.pose is not None else None
    return BayesFilter(labels, Spec(Points, 1), pose, None, DataSpec(inputs), **options)


def _short(value: Any) -> str:
    return "(" + " ".join(f"{v:.2f}" for v in value) + ")" if isinstance(value, tuple) else str(value)


def movable_points(frames: Sequence[Seen], root: str, split: str) -> list[Tensor]:
    """(N,) bool of every frame: points of classes that can move, by the true classes."""
    dataset = SemanticKittiDataset(root=root, split=split, task="semantics")
    movable = torch.tensor([name in MOVABLE for name in dataset.spec.classes] + [False])
    found = {}
    for index in range(len(dataset)):
        frame = dataset[index]
        if frame.targets.points is not None:
            found[frame.meta.id] = movable[frame.targets.points.label]
    return [found[seen.result.meta.id] for seen in frames]


def markdown(table: dict[str, dict[str, float]]) -> str:
    """The table as text."""
    names = list(next(iter(table.values())))
    lines = ["| setting | " + " | ".join(names) + " |", "|---|" + "---:|" * len(names)]
    for setting, row in table.items():
        lines.append(f"| {setting} | " + " | ".join(f"{100 * row[name]:.1f}" for name in names) + " |")
    return "\n".join(lines)


@answered
def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m lidarfw_dpdc_mos.study", description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("overrides", nargs="*", help="as for lidarfw eval, e.g. splits.test=val")
    parser.add_argument("--prior-split", help="split of the same data that the adaptive prior is fitted on")
    parser.add_argument("--past", type=int, default=0, help="count frames with so many scans before them (%(default)s)")
    parser.add_argument(
        "--semantics", nargs=2, metavar=("ROOT", "SPLIT"), help="SemanticKITTI: baseline of true classes"
    )
    parser.add_argument("--json", type=Path, help="write the table too")
    args = parser.parse_args(arguments)
    adaptive: tuple[float, ...] = ()
    if args.prior_split:
        adaptive = fit_prior(list(predictions(args.checkpoint, [*args.overrides, f"splits.test={args.prior_split}"])))
    frames = [_light(seen) for seen in predictions(args.checkpoint, args.overrides, args.past)]
    table = study(frames, adaptive)
    if args.semantics:
        movable = movable_points(frames, *args.semantics)
        table["all that can move moves (true classes)"] = figures(frames, movable)
    print(markdown(table))
    if args.json:
        write_text(args.json, json.dumps(table, indent=1) + "\n")


def _light(seen: Seen) -> Seen:
    """Without the ground truth in the result, which the filter does not need."""
    return dataclasses.replace(seen, result=dataclasses.replace(seen.result, targets=None))


if __name__ == "__main__":
    sys.exit(main())
