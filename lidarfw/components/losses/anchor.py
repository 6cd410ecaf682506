"""The loss of the anchor head: anchors matched with boxes by IoU, focal loss, smooth L1, direction."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidarfw.components.heads.anchor import AnchorOutput, direction_bin, encode
from lidarfw.components.losses.bev import has_extent, inside_grid
from lidarfw.interfaces import Loss
from lidarfw.ops import nearest_bev_iou
from lidarfw.types import Boxes, Spec, Targets

NEGATIVE, NEITHER = -1, -2  # in place of the number of an anchor's box


def focal(logits: Tensor, positive: Tensor, alpha: float, gamma: float) -> Tensor:
    """Elementwise sigmoid focal loss (Lin et al., ICCV 2017, equation 5); `positive` is bool."""
    signed = torch.where(positive, logits, -logits)
    weight = torch.where(positive, alpha, 1 - alpha)
    return -weight * (-signed).sigmoid() ** gamma * nn.functional.logsigmoid(signed)


def match(iou: Tensor, matched: Tensor, unmatched: Tensor) -> Tensor:
    """Box number of each anchor (A,) from IoUs (A, M); NEGATIVE or NEITHER where it has none.

    An anchor takes the box it overlaps most, if by `matched` or more. The anchor that overlaps a box most takes
    that box however little it is, so that no box stays without one; the larger IoU wins where two boxes want the
    same anchor.
    """
    if iou.shape[1] == 0:
        return torch.full((len(iou),), NEGATIVE, dtype=torch.long, device=iou.device)
    best, favourite = iou.max(0)
    forced = torch.zeros_like(iou).scatter_(0, favourite[None], (best > 0).to(iou.dtype)[None])
    overlap, box = (iou + 2 * forced).max(1)  # an IoU is at most 1, so forced pairs come first
    none = torch.where(overlap < unmatched, NEGATIVE, NEITHER)
    return torch.where(overlap >= matched, box, none)


class AnchorLoss(Loss):
    """Train the anchor head (SECOND, Yan et al., Sensors 2018; values of its KITTI configuration).

    An anchor is compared with the boxes of its own class by the IoU of their footprints turned to the nearest axis.
    Terms: `class` (focal loss over all classes, `alpha`, `gamma`), `box` (smooth L1 with `beta`, yaw by the sine of
    its error) and `direction` (cross entropy), each times its weight, divided by the number of positive anchors of
    the sample and averaged over samples.

    Boxes with their centre outside the map are dropped. Anchors that overlap an ignored box of their class by the
    `unmatched` IoU or more are neither positive nor negative, unless a box to learn takes them.
    """

    def __init__(
        self,
        anchor: Spec,
        *,
        class_weight: float = 1.0,
        box_weight: float = 2.0,
        direction_weight: float = 0.2,
        alpha: float = 0.25,
        gamma: float = 2.0,
        beta: float = 1 / 9,
    ) -> None:
        super().__init__()
        self.class_weight, self.box_weight, self.direction_weight = class_weight, box_weight, direction_weight
        self.alpha, self.gamma, self.beta = alpha, gamma, beta

    def forward(self, anchor: AnchorOutput, targets: Targets) -> dict[str, Tensor]:
        """The terms; all 0 where the batch has no box labels at all."""
        if targets.boxes is None:
            return {"class": anchor.score.sum() * 0 + anchor.residual.sum() * 0 + anchor.direction.sum() * 0}
        boxes = targets.boxes[inside_grid(targets.boxes, anchor.tap.grid, anchor.tap.stride)]
        chosen = self.assign(anchor, boxes, targets.ignored)
        sample, row = (chosen >= 0).nonzero().unbind(1)
        objects = sample.bincount(minlength=len(chosen)).clamp(min=1) * len(chosen)
        box = boxes[chosen[sample, row]]
        error = encode(box.tensor, anchor.anchors[row]) - anchor.residual[sample, row].float()
        error = torch.cat([error[:, :6], error[:, 6:].sin()], 1)
        distance = nn.functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=self.beta)
        logits = anchor.direction[sample, row].float()
        turned = nn.functional.cross_entropy(logits, direction_bin(box.yaw), reduction="none")
        return {
            "class": self.class_weight * (self._class(anchor, boxes, chosen) / objects).sum(),
            "box": self.box_weight * (distance.sum(1) / objects[sample]).sum(),
            "direction": self.direction_weight * (turned / objects[sample]).sum(),
        }

    def _class(self, anchor: AnchorOutput, boxes: Boxes, chosen: Tensor) -> Tensor:
        """Focal loss (B,) summed over the anchors that are positive or negative."""
        positive = torch.zeros_like(anchor.score, dtype=torch.bool)
        sample, row = (chosen >= 0).nonzero().unbind(1)
        positive[sample, row, boxes.label[chosen[sample, row]]] = True
        loss = focal(anchor.score.float(), positive, self.alpha, self.gamma)
        return loss.masked_fill((chosen == NEITHER)[:, :, None], 0).sum((1, 2))

    @torch.no_grad()
    def assign(self, anchor: AnchorOutput, boxes: Boxes, ignored: Boxes | None) -> Tensor:
        """Row of `boxes` that each anchor (B, A) of each sample has to find, NEGATIVE or NEITHER."""
        chosen = torch.full(anchor.score.shape[:2], NEGATIVE, device=anchor.score.device)
        ignored = Boxes.empty(device=boxes.batch.device) if ignored is None else ignored[has_extent(ignored)]
        for label, (matched, unmatched) in enumerate(anchor.thresholds):
            rows = (anchor.label == label).nonzero()[:, 0]
            places = anchor.anchors[rows]
            for sample in range(len(chosen)):
                own = ((boxes.batch == sample) & (boxes.label == label)).nonzero()[:, 0]
                number = match(nearest_bev_iou(places, boxes.tensor[own]), matched, unmatched)
                found = number >= 0
                number[found] = own[number[found]]
                others = (ignored.batch == sample) & ((ignored.label == label) | (ignored.label == -1))
                if others.any():
                    overlap = nearest_bev_iou(places, ignored.tensor[others]).amax(1)
                    number[~found & (overlap >= unmatched)] = NEITHER
                chosen[sample, rows] = number
        return chosen
