"""The refinement head: proposals corrected in several stages, each of which sees the earlier ones.

Sources: the MSRM paper, section II-C, equations 3 to 7; where it is silent, CasA (Wu et al., TGRS 2022) and
Voxel R-CNN (Deng et al., AAAI 2021), as their configurations for KITTI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from lidarfw.components.per_class import check_names
from lidarfw.components.postprocessors.nms import NMS, best_per_frame
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Head
from lidarfw.types import BEV, Boxes, DataSpec, Points, Record, Spec, Targets, Voxels
from torch import Tensor, nn

from lidarfw_msrm.heads.pooling import BEVPooling, SitePooling, Sites
from lidarfw_msrm.heads.rois import best_overlap, refine, sampled
from lidarfw_msrm.heads.stages import PartScore, StageAttention, StageEncoder, branch

# IoU over which a region of a stage learns a box, by class (section II-C); a stage more adds the last step again
FOREGROUND: dict[str, list[float]] = {"Car": [0.5, 0.55, 0.6], "Pedestrian": [0.45, 0.5, 0.55]}
# IoU from which on the confidence to learn is over 0, and at which it reaches 1 (CasA)
CONFIDENCE: dict[str, list[float]] = {"Car": [0.25, 0.75], "Pedestrian": [0.15, 0.65]}
# classes of other data that are treated as cars; all others are treated as pedestrians
LARGE = ("car", "van", "truck", "bus", "trailer", "construction_vehicle", "vehicle")
POOLS = ("auto", "voxels", "points", "bev")
RADII = (2.0, 4.0)  # times the horizontal size of a voxel of the level
POINT_RADII = (0.4, 0.8)  # metres
CHANNELS = 32  # of every kind of sites and radius
# suppression of proposals
TRAINING: dict[str, Any] = {"iou_threshold": 0.8, "score_threshold": 0.0, "max_per_frame": 512}
INFERENCE: dict[str, Any] = TRAINING | {"iou_threshold": 0.75}


@dataclass
class MSRMOutput(Record):
    """Regions and what S stages made of them. Region n keeps its row through all stages."""

    rois: Boxes  # N proposals
    boxes: Tensor  # (S + 1, N, 7) the box that goes into each stage, and the one that comes out of the last
    residual: Tensor  # (S, N, 7) in the frame of the box that goes in
    confidence: Tensor  # (S, N) logits, the part score in them
    tokens: Tensor  # (S, N, C)
    foreground: Tensor  # (S, K) IoU over which a region learns its box
    confident: Tensor  # (K, 2) IoU of confidence 0 and 1


def _column(name: str) -> str:
    return name if name in FOREGROUND else ("Car" if name.lower() in LARGE else "Pedestrian")


def thresholds(classes: Sequence[str], stages: int, given: dict[str, list[float]] | None) -> Tensor:
    """(stages, K) foreground IoU; beyond the third stage the last step is repeated."""
    check_names(classes, given or {}, "foreground")
    empty = next((name for name, row in (given or {}).items() if not row), None)
    if empty is not None:
        raise ConfigError(
            f"foreground of {empty} is empty\n  fix: foreground={{{empty}: [0.5, 0.6]}}, an IoU for each stage"
        )
    rows = [list((given or {}).get(name, FOREGROUND[_column(name)])) for name in classes]
    for row in rows:
        step = row[-1] - row[-2] if len(row) > 1 else 0.0
        row += [min(row[-1] + step * (n + 1), 1.0) for n in range(stages - len(row))]
    return torch.tensor([row[:stages] for row in rows]).T.contiguous().view(stages, len(classes))


class MSRMHead(Head):
    """Refine proposals in `stages` stages (MSRM, section II-C), on any backbone and after any head that gives boxes.

    The `regions` best proposals after suppression go through all stages in the same order; in training they are
    sampled once, half of them foreground. Each stage pools features at `grid` points along each axis of its box,
    encodes them, attends to the tokens of the same region in the earlier stages, and gives a confidence and a
    correction; the next stage starts from the corrected box, cut from the graph. Velocity and class stay those of the
    proposal. `decode` gives the boxes of all stages, for `box_voting`.

    The released code that the paper builds on draws new regions before every stage in training, so that attention
    there joins tokens of different objects. Here it cannot; `lidarfw_msrm.misaligned` does so, to be compared with.
    """

    example: ClassVar[dict[str, object]] = {"grid": 3, "channels": 32, "neighbors": 4}
    defaults = {"loss": ["msrm"], "postprocessor": ["box_voting", "nms"], "metric": ["box_ap"]}

    def __init__(
        self,
        boxes: Spec,
        bev: Spec,
        voxels: list[Spec] | None,
        points: Spec | None,
        data: DataSpec,
        *,
        stages: int = 3,
        regions: int = 160,
        candidates: int = 4000,
        pool: str = "auto",
        strides: tuple[int, ...] = (4, 8),
        grid: int = 6,
        neighbors: int = 16,
        channels: int = 256,
        heads: int = 4,
        dropout: float = 0.3,
        foreground: dict[str, list[float]] | None = None,
    ) -> None:
        """Options.

        regions: proposals a sample, in training and after. candidates: the best proposals, among which they are chosen.
        pool: where features come from, voxels (of the levels `strides`), points or bev; auto is voxels where all these
        levels are there, else bev. neighbors: voxels or points of each grid point. channels, heads, dropout: of the
        stage tokens and their attention. foreground: IoU of every stage, by class name, over which a region learns a
        box.
        """
        super().__init__()
        _check(stages, regions, channels, heads, pool)
        self.regions, self.strides = regions, tuple(strides)
        there = {spec.stride for spec in voxels or []}
        self.pool = pool if pool != "auto" else ("voxels" if there.issuperset(strides) else "bev")
        self.pooling = self._pooling(voxels, points, bev, grid, neighbors)
        width = self.pooling.channels
        self.encoders = nn.ModuleList(StageEncoder(width, channels, dropout) for _ in range(stages))
        self.attention = nn.ModuleList(StageAttention(channels, heads) for _ in range(stages))
        self.confidence = nn.ModuleList(branch(2 * channels, channels, 1, dropout) for _ in range(stages))
        self.correction = nn.ModuleList(branch(2 * channels, channels, 7, dropout) for _ in range(stages))
        self.parts = PartScore(bev)
        self.suppress_training, self.suppress = (
            NMS(boxes, max_candidates=candidates, **way) for way in (TRAINING, INFERENCE)
        )
        confident = [CONFIDENCE[_column(name)] for name in data.classes]
        self.register_buffer("foreground", thresholds(data.classes, stages, foreground), persistent=False)
        self.register_buffer("confident", torch.tensor(confident).view(-1, 2), persistent=False)
        self.provides = Spec(Boxes, classes=data.classes)

    foreground: Tensor
    confident: Tensor

    def forward(
        self,
        boxes: Boxes,
        bev: BEV,
        voxels: list[Voxels] | None = None,
        points: Points | None = None,
        targets: Targets | None = None,
    ) -> MSRMOutput:
        """Stages of the proposals `boxes`; they are sampled where `targets` has boxes."""
        rois = self.propose(boxes, targets)
        sources = self._sources(voxels, points)
        prepared = self.pooling.prepare(sources) if isinstance(self.pooling, SitePooling) else []
        maps, current = self.parts(bev), rois.tensor.detach()
        chain, tokens, residuals, confidences = [current], list[Tensor](), list[Tensor](), list[Tensor]()
        for encode, attend, judge, correct in zip(
            self.encoders, self.attention, self.confidence, self.correction, strict=True
        ):
            pooled = self._pool(sources, prepared, bev, current, rois.batch)
            tokens.append(encode(pooled))
            seen = attend(self._sequence(tokens, rois, targets))
            confidences.append(judge(seen)[:, 0].float() + PartScore.score(maps, current, rois.batch).float())
            residuals.append(correct(seen).float())
            current = refine(residuals[-1], current).detach()
            chain.append(current)
        residual, confidence = torch.stack(residuals), torch.stack(confidences)
        return MSRMOutput(
            rois, torch.stack(chain), residual, confidence, torch.stack(tokens), self.foreground, self.confident
        )

    def decode(self, output: MSRMOutput) -> Boxes:
        """The boxes of all stages, stage by stage: stage 0 are the proposals with their scores, the others have the
        stage's confidence."""
        rois = output.rois
        parts = [rois.replace(stage=torch.zeros_like(rois.label))]
        for number, (box, logit) in enumerate(zip(output.boxes[1:], output.confidence, strict=True), 1):
            changed = {"center": box[:, :3], "size": box[:, 3:6], "yaw": box[:, 6], "score": logit.sigmoid()}
            parts.append(rois.replace(**changed, stage=torch.full_like(rois.label, number)))
        return Boxes.cat(parts)

    @torch.no_grad()
    def propose(self, boxes: Boxes, targets: Targets | None) -> Boxes:
        """The regions: the best proposals, in training a sample of them (section II-C; once, before stage 1)."""
        truth = None if targets is None else targets.boxes
        if truth is None:
            return best_per_frame(self.suppress(boxes), 0.0, self.regions)
        kept: Boxes = self.suppress_training(boxes)
        overlap, _ = best_overlap(kept.tensor, kept, truth)
        limit = self.foreground[0][kept.label].minimum(self.confident[kept.label, 1])
        return kept[sampled(overlap, limit, kept.batch, kept.batch_size, self.regions)]

    def _sequence(self, tokens: list[Tensor], rois: Boxes, targets: Targets | None) -> Tensor:
        """(N, T, C): the tokens that stage T attends to, of the same region in every row."""
        return torch.stack(tokens, 1)

    # features

    def _pooling(
        self, voxels: list[Spec] | None, points: Spec | None, bev: Spec, grid: int, neighbors: int
    ) -> SitePooling | BEVPooling:
        if self.pool == "bev":
            return BEVPooling(bev.channels, CHANNELS, grid)
        if self.pool == "points" and points is not None:
            return SitePooling([points.channels], [POINT_RADII], CHANNELS, grid, neighbors)
        levels = {spec.stride: spec for spec in voxels or []}
        missing = [stride for stride in self.strides if stride not in levels]
        if missing or self.pool == "points":
            there = f"Voxels at strides {', '.join(map(str, levels))}" if levels else "no Voxels"
            raise ConfigError(
                f"head 'msrm' pools from {self.pool}"
                + (f" at strides {list(self.strides)}" if self.pool == "voxels" else "")
                + f", which the model does not have.\n  there: {there}"
                + (", a map (BEV)" if points is None else ", points, a map (BEV)")
                + f"\n  fix: {f'head.msrm.strides={list(levels)[-2:]}' if levels else 'head.msrm.pool=bev'}"
            )
        chosen = [levels[stride] for stride in self.strides]
        radii = [[times * s.grid.cell[0] * s.stride for times in RADII] for s in chosen]
        return SitePooling([s.channels for s in chosen], radii, CHANNELS, grid, neighbors)

    def _sources(self, voxels: list[Voxels] | None, points: Points | None) -> list[Sites]:
        if self.pool == "points" and points is not None:
            return [Sites(points.xyz, points.features, points.batch)]
        levels = {level.stride: level for level in voxels or []}
        return [Sites.of(levels[stride]) for stride in self.strides] if self.pool == "voxels" else []

    def _pool(
        self, sources: list[Sites], prepared: list[list[Tensor]], bev: BEV, rois: Tensor, batch: Tensor
    ) -> Tensor:
        if isinstance(self.pooling, BEVPooling):
            return self.pooling(bev, rois, batch)  # type: ignore[no-any-return]
        return self.pooling(sources, prepared, rois, batch)  # type: ignore[no-any-return]


def _check(stages: int, regions: int, channels: int, heads: int, pool: str) -> None:
    if min(stages, regions, channels, heads) < 1 or channels % heads:
        raise ConfigError(
            "head 'msrm' needs at least one stage and one region, and channels that its attention heads divide\n"
            f"  given: stages: {stages}, regions: {regions}, channels: {channels}, heads: {heads}\n"
            "  fix: for example stages: 3, regions: 160, channels: 256, heads: 4"
        )
    if pool not in POOLS:
        raise ConfigError(f"head 'msrm': pool is one of {', '.join(POOLS)}, not {pool!r}")
