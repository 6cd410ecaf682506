"""The loss of the refinement stages: confidence by overlap, corrections and corners of the foreground.

Sources: the MSRM paper, section II-C; soft confidence and corner loss of CasA (Wu et al., TGRS 2022).
"""

from __future__ import annotations

import math

import torch
from lidarfw.components.losses.bev import has_extent
from lidarfw.interfaces import Loss
from lidarfw.ops import box_corners
from lidarfw.types import Boxes, Spec, Targets
from torch import Tensor, nn

from lidarfw_msrm.heads.msrm import MSRMOutput
from lidarfw_msrm.heads.rois import best_overlap, refine, residuals

BETA = 1 / 9  # of the smooth L1 loss


def soft_confidence(overlap: Tensor, limits: Tensor) -> Tensor:
    """Confidence (N,) to learn: IoU (N,) mapped from limits (N, 2) to 0 and 1."""
    low, high = limits.unbind(1)
    return ((overlap - low) / (high - low)).clamp(0, 1)


def corner_distance(boxes: Tensor, truth: Tensor) -> Tensor:
    """Huber distance (N,) of the corners of boxes (N, 7), in the mean; the truth may point either way."""
    turned = torch.cat([truth[:, :6], truth[:, 6:] + math.pi], 1)
    corners = box_corners(boxes)
    apart = [(corners - box_corners(t)).square().sum(2).clamp(min=1e-12).sqrt() for t in (truth, turned)]
    nearer = torch.minimum(*apart)
    return nn.functional.huber_loss(nearer, torch.zeros_like(nearer), reduction="none").mean(1)


class MSRMLoss(Loss):
    """Train the refinement stages (MSRM, section II-C).

    Every stage compares the boxes that go into it with those of their class: the confidence learns the IoU, mapped to
    0..1 by class; regions with an IoU over the stage's threshold learn their correction (smooth L1 in the frame of the
    region, yaw up to half a turn) and the corners of the corrected box. Terms `confidence`, `box` and `corner`, each
    the sum over stages of its mean over regions.

    Regions that overlap an ignored box more than any box to learn give no loss.
    """

    def __init__(self, msrm: Spec) -> None:
        super().__init__()

    def forward(self, msrm: MSRMOutput, targets: Targets) -> dict[str, Tensor]:
        """The terms; all 0 where the batch has no box labels at all."""
        nothing = (msrm.residual.sum() + msrm.confidence.sum()) * 0
        terms = {"confidence": nothing, "box": nothing, "corner": nothing}
        if targets.boxes is None:
            return terms
        truth = targets.boxes[has_extent(targets.boxes)]
        ignored = Boxes.empty(device=truth.batch.device) if targets.ignored is None else targets.ignored
        ignored = ignored[has_extent(ignored)]
        for stage in range(len(msrm.residual)):
            for name, term in self._stage(msrm, stage, truth, ignored).items():
                terms[name] = terms[name] + term
        return terms

    def _stage(self, msrm: MSRMOutput, stage: int, truth: Boxes, ignored: Boxes) -> dict[str, Tensor]:
        rois, label = msrm.boxes[stage], msrm.rois.label
        overlap, row = best_overlap(rois, msrm.rois, truth)
        counts = best_overlap(rois, msrm.rois, ignored)[0] <= overlap
        wanted = soft_confidence(overlap, msrm.confident[label])
        error = nn.functional.binary_cross_entropy_with_logits(msrm.confidence[stage], wanted, reduction="none")
        terms = {"confidence": (error * counts).sum() / counts.sum().clamp(min=1)}
        chosen = (counts & (overlap > msrm.foreground[stage][label])).nonzero()[:, 0]
        objects = max(len(chosen), 1)
        rois, residual, goal = rois[chosen], msrm.residual[stage][chosen], truth.tensor[row[chosen]]
        distance = nn.functional.smooth_l1_loss(residual, residuals(goal, rois), reduction="sum", beta=BETA)
        corner = corner_distance(refine(residual, rois), goal)
        return terms | {"box": distance / objects, "corner": corner.sum() / objects}
