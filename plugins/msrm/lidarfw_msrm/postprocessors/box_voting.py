"""Box voting: the boxes that several stages or models give for one object become one.

Source: the MSRM paper, section II-D, equation 8.
"""

from __future__ import annotations

import math

import torch
from lidarfw.errors import ConfigError
from lidarfw.interfaces import PostProcessor
from lidarfw.ops import iou_3d, nms_rotated, scatter_sum
from lidarfw.types import Boxes, Spec
from torch import Tensor

MODES, WEIGHTS = ("stage", "cluster"), ("confidence", "uniform")


class BoxVoting(PostProcessor):
    """The mean of boxes weighted by their confidence (MSRM, equation 8).

    mode stage: the boxes of the stages of a cascade, region by region (every stage gives its regions in the same
    order, `stage` says which is which). Mode cluster: the best box and all of its class that overlap it by a 3D IoU
    over `iou_threshold`, then the best of the rest; works after any detector or ensemble. The score is the mean of the
    scores. weights uniform: the plain mean. stages: those that vote; none named, all but stage 0, the proposals.
    regions: only the first so many of a sample vote, which are those of the best proposals; regions do not see each
    other, so this is what a head with fewer of them would give.

    Yaw is averaged on the circle after every box is turned to the side of the most confident one: boxes that
    stand for the same object may point in opposite ways. Other fields are those of the most confident box.
    """

    def __init__(
        self,
        boxes: Spec,
        *,
        mode: str = "stage",
        weights: str = "confidence",
        stages: tuple[int, ...] = (),
        regions: int | None = None,
        iou_threshold: float = 0.5,
    ) -> None:
        super().__init__()
        for name, value, known in (("mode", mode, MODES), ("weights", weights, WEIGHTS)):
            if value not in known:
                raise ConfigError(f"postprocessor 'box_voting': {name} is one of {', '.join(known)}, not {value!r}")
        if regions is not None and regions < 1:
            raise ConfigError(f"postprocessor 'box_voting': regions is at least 1 or null, which is all, not {regions}")
        self.mode, self.weights, self.iou_threshold = mode, weights, iou_threshold
        self.stages, self.regions = tuple(stages), regions
        self.provides = boxes

    def forward(self, boxes: Boxes) -> Boxes:
        """One box for each region or cluster."""
        if boxes.stage is not None and len(boxes):
            boxes = self._chosen(boxes, boxes.stage)
        if self.mode == "cluster":
            return self._vote(boxes, self._clusters(boxes))
        if boxes.stage is None or len(boxes) == 0:
            return boxes  # of one stage
        return self._vote(boxes, _regions(boxes, boxes.stage))

    def _chosen(self, boxes: Boxes, stage: Tensor) -> Boxes:
        missing = set(self.stages) - set(stage.tolist())
        if missing:
            raise ConfigError(
                f"postprocessor 'box_voting': stages {sorted(self.stages)} are to vote\n"
                f"  there are boxes of the stages {sorted(set(stage.tolist()))}\n"
                "  fix: postprocessor.box_voting.stages=[] for all but stage 0, the proposals"
            )
        chosen = torch.isin(stage, stage.new_tensor(self.stages)) if self.stages else stage > 0
        if self.regions is not None:
            chosen &= _places(boxes, stage)[0] < self.regions
        return boxes[chosen]

    def _clusters(self, boxes: Boxes) -> Tensor:
        """Cluster (N,) of each box, counted from 0."""
        group = boxes.label * boxes.batch_size + boxes.batch
        seeds = nms_rotated(boxes.tensor, boxes.score, self.iou_threshold, group, volume=True)
        if len(seeds) == 0:
            return group
        overlap = iou_3d(boxes.tensor[seeds], boxes.tensor) * (group[seeds, None] == group)
        overlap[:, seeds] = torch.eye(len(seeds), device=seeds.device, dtype=overlap.dtype)
        # seeds come by falling score: the first that overlaps a box enough took it
        near = overlap > self.iou_threshold
        return torch.where(near.any(0), near.float().argmax(0), overlap.argmax(0))

    def _vote(self, boxes: Boxes, voter: Tensor) -> Boxes:
        """Equation 8 over the boxes of each voter number (N,)."""
        count = int(voter.max()) + 1 if len(voter) else 0
        weight = boxes.score if self.weights == "confidence" else torch.ones_like(boxes.score)
        total = scatter_sum(weight[:, None], voter, count)
        weight = torch.where(total[voter, 0] < 1e-9, 1.0, weight)[:, None]  # no confidence at all: the plain mean
        share = weight / scatter_sum(weight, voter, count)[voter]
        best = _first_best(boxes.score, voter, count)
        yaw = boxes.yaw + math.pi * _opposite(boxes.yaw - boxes.yaw[best][voter])
        values = torch.cat([boxes.center, boxes.size, yaw.cos()[:, None], yaw.sin()[:, None]], 1)
        mean = scatter_sum(values * share, voter, count)
        number = voter.bincount(minlength=count).clamp(min=1)
        score = scatter_sum(boxes.score[:, None], voter, count)[:, 0] / number
        merged = boxes[best].replace(center=mean[:, :3], size=mean[:, 3:6], score=score, stage=None)
        return merged.replace(yaw=torch.atan2(mean[:, 7], mean[:, 6]))


def _opposite(difference: Tensor) -> Tensor:
    """1 where angles differ by more than a quarter turn, else 0."""
    return (difference.cos() < 0).to(difference.dtype)


def _first_best(score: Tensor, voter: Tensor, count: int) -> Tensor:
    """Row (count,) of the highest score of each voter; of equal ones the first."""
    order = score.argsort(descending=True, stable=True)
    order = order[voter[order].argsort(stable=True)]
    starts = voter.bincount(minlength=count).cumsum(0) - voter.bincount(minlength=count)
    return order[starts[:count]] if len(order) else order


def _places(boxes: Boxes, stage: Tensor) -> tuple[Tensor, Tensor]:
    """Place (N,) of each box among those of its sample and stage, and their number (samples, stages)."""
    stages, number = torch.unique(stage, return_inverse=True)
    group = boxes.batch * len(stages) + number
    sizes = group.bincount(minlength=boxes.batch_size * len(stages))
    order = group.argsort(stable=True)
    starts = sizes.cumsum(0) - sizes
    place = torch.empty_like(group)
    place[order] = torch.arange(len(group), device=group.device) - starts[group[order]]
    return place, sizes.view(-1, len(stages))


def _regions(boxes: Boxes, stage: Tensor) -> Tensor:
    """Region (N,) of each box: its place among the boxes of its sample and stage."""
    place, sizes = _places(boxes, stage)
    if bool((sizes != sizes[:, :1]).any()):
        raise ConfigError(
            "postprocessor 'box_voting' needs as many boxes of every stage\n"
            f"  found, by sample and stage: {sizes.tolist()}\n"
            "  fix: put it before whatever drops boxes: postprocessor=[box_voting,nms], or mode: cluster"
        )
    before: Tensor = sizes[:, 0].cumsum(0) - sizes[:, 0]
    return place + before[boxes.batch]
