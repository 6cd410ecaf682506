"""Wrong on purpose: a refinement head whose attention joins tokens of different regions while it learns.

The released code of CasA (Wu et al., TGRS 2022), whose structure MSRM shares, draws its regions anew before every stage
of a training step, the foreground first and each part in random order, and appends the tokens to those of the stages
before, row by row. Row n of stage 1 and row n of stage 2 are then different regions; after training they are the same.

No entry point names this class. It is there for the claim that aligned tokens do better:

    lidarfw train experiment=msrm_town head.msrm.type=lidarfw_msrm.misaligned:MisalignedMSRMHead
"""

from __future__ import annotations

import torch
from lidarfw.types import Boxes, Targets
from torch import Tensor

from lidarfw_msrm.heads.msrm import MSRMHead
from lidarfw_msrm.heads.rois import best_overlap


class MisalignedMSRMHead(MSRMHead):
    """`head.msrm`, in training with the tokens of earlier stages shuffled among the foreground and among the background
    regions of a sample; without boxes to learn, and in evaluation, the same."""

    def _sequence(self, tokens: list[Tensor], rois: Boxes, targets: Targets | None) -> Tensor:
        if not self.training or targets is None or targets.boxes is None:
            return super()._sequence(tokens, rois, targets)
        overlap, _ = best_overlap(rois.tensor, rois, targets.boxes)
        kind = rois.batch * 2 + (overlap > self.foreground[0][rois.label])
        return torch.stack([*(token[_shuffled(kind)] for token in tokens[:-1]), tokens[-1]], 1)


def _shuffled(group: Tensor) -> Tensor:
    """Rows (N,) in a random order, each of the group (N,) of its place."""
    drawn = torch.randperm(len(group), device=group.device)
    rows = torch.empty_like(drawn)
    rows[group.argsort(stable=True)] = drawn[group[drawn].argsort(stable=True)]
    return rows
