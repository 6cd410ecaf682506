"""The localization loss: how far the predicted map coordinates lie from the true ones."""

from __future__ import annotations

import torch
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Loss
from lidarfw.ops import points_in_boxes, transform
from lidarfw.types import Boxes, Poses, SceneCoords, Spec, Targets
from torch import Tensor
from torch.nn.functional import cross_entropy

from lidarfw_taco.heads.scene_coord import SceneCoordOutput


class SceneCoordLoss(Loss):
    """L1 distance of the predicted map coordinates in metres (SGLoc, CVPR 2023; L_loc of TACO, equation 6).

    Term `l1`: the sum over x, y, z, averaged over all pairs of the batch by their weights; frames without a pose
    count nothing. `moving_weight` is multiplied to pairs on objects that are labelled as moving: 0 leaves them out,
    for they have left when the place is seen again. `clamp` bounds the error of a pair in metres; 0 does not.

    Term `region`, of heads with regions: the cross-entropy of the region that each scan was taken in.
    """

    def __init__(self, scene_coord: Spec, *, moving_weight: float = 1.0, clamp: float = 0.0) -> None:
        super().__init__()
        if moving_weight < 0 or clamp < 0:
            raise ConfigError(
                f"moving_weight and clamp must not be negative, got {moving_weight} and {clamp}.\n"
                "  fix: moving_weight: 0 leaves moving objects out, clamp: 0 bounds nothing"
            )
        self.moving_weight, self.clamp = moving_weight, clamp

    def forward(self, scene_coord: SceneCoordOutput, targets: Targets) -> dict[str, Tensor]:
        """The term; 0 where the batch has no poses or no pairs."""
        pairs = scene_coord.pairs
        if targets.poses is None:
            return {"l1": pairs.world.sum() * 0}
        error = (pairs.world - true_places(pairs, targets.poses)).abs().sum(1)
        error = error.clamp(max=self.clamp) if self.clamp > 0 else error
        weight = pairs.weight.detach() * targets.poses.ok[pairs.batch]
        if self.moving_weight != 1:
            weight = weight * torch.where(_on_moving(pairs, targets.boxes), self.moving_weight, 1.0)
        error = torch.where(weight > 0, error, 0)  # where no pose is known the error may be anything
        terms = {"l1": (weight * error).sum() / weight.sum().clamp(min=1)}
        return terms | _region_term(scene_coord)


def _region_term(scene_coord: SceneCoordOutput) -> dict[str, Tensor]:
    """Cross-entropy of the regions, averaged over the scans whose pose is known."""
    logits, region = scene_coord.region_logits, scene_coord.region
    if logits is None or region is None:
        return {}
    total = cross_entropy(logits, region, ignore_index=-1, reduction="sum")
    return {"region": total / (region >= 0).sum().clamp(min=1)}


@torch.no_grad()
def true_places(pairs: SceneCoords, poses: Poses) -> Tensor:
    """Map coordinates (N, 3) of the pairs' sources: a rigid map takes the mean of points to the mean of its images."""
    return transform(poses.matrix.to(pairs.source.dtype)[pairs.batch], pairs.source[:, None])[:, 0]


@torch.no_grad()
def _on_moving(pairs: SceneCoords, boxes: Boxes | None) -> Tensor:
    """(N,) bool: the source lies in a box that is labelled as moving."""
    if boxes is None or boxes.moving is None:
        raise ConfigError(
            "loss.scene_coord.moving_weight needs boxes that say what moves, and the dataset gives none.\n"
            "  fix: loss.scene_coord.moving_weight=1, or a dataset whose boxes have `moving`"
        )
    moving = boxes[boxes.moving == 1]
    return points_in_boxes(pairs.source, moving.tensor, pairs.batch, moving.batch) >= 0
