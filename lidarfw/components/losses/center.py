"""The loss of the center head: penalty-reduced focal loss on the heat map, L1 at the object cells."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidarfw.components.heads.center import HEIGHT, OFFSET, SIZE, VELOCITY, YAW, CenterOutput, encode
from lidarfw.components.losses.bev import footprints, has_extent, inside_grid, windows
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Loss
from lidarfw.types import Boxes, Spec, Targets


def gaussian_radius(size: Tensor, min_overlap: float) -> Tensor:
    """Radius (M,) in cells within which a box of `size` (M, 2) cells moved by its corners keeps `min_overlap` IoU.

    The smallest of the three cases of CornerNet (Law and Deng, ECCV 2018, section 3.2), each root halved as in
    CenterPoint, whose published results rest on it; the geometry would ask for a division by 2a.
    """
    total, area = size.sum(1), size.prod(1)
    outside = (total + (total**2 - 4 * area * (1 - min_overlap) / (1 + min_overlap)).sqrt()) / 2
    inside = (2 * total + (4 * total**2 - 16 * (1 - min_overlap) * area).sqrt()) / 2
    linear = -2 * min_overlap * total
    mixed = (linear + (linear**2 + 16 * min_overlap * (1 - min_overlap) * area).sqrt()) / 2
    return torch.stack([outside, inside, mixed]).amin(0)


def penalty_reduced_focal(logits: Tensor, target: Tensor) -> Tensor:
    """Elementwise focal loss with soft targets 0..1 (CornerNet, equation 1, alpha 2, beta 4)."""
    probability = logits.sigmoid()
    positive = (1 - probability) ** 2 * nn.functional.logsigmoid(logits)
    negative = (1 - target) ** 4 * probability**2 * nn.functional.logsigmoid(-logits)
    return -torch.where(target == 1, positive, negative)


class CenterLoss(Loss):
    """Train the center head (CenterPoint, section 4; details of its released Waymo configuration).

    Every object draws a Gaussian into the heat map of its class: radius from CornerNet's formula with `min_overlap`,
    at least `min_radius` cells. Terms `heatmap` (penalty-reduced focal) and, times `regression_weight`, L1 of
    `offset` (cells), `height` (m), `size` (log m), `yaw` (sine, cosine) and `velocity` (m/s, times
    `velocity_weight`). Each is divided by the number of objects of the sample, then averaged over samples.

    Boxes with their centre outside the map are dropped. Cells on an ignored box give no heat-map loss for its class.
    """

    def __init__(
        self,
        center: Spec,
        *,
        regression_weight: float = 2.0,
        velocity_weight: float = 0.2,
        min_overlap: float = 0.1,
        min_radius: int = 2,
    ) -> None:
        super().__init__()
        self.regression_weight, self.velocity_weight = regression_weight, velocity_weight
        self.min_overlap, self.min_radius = min_overlap, min_radius

    def forward(self, center: CenterOutput, targets: Targets) -> dict[str, Tensor]:
        """The terms; all 0 where the batch has no box labels at all."""
        if targets.boxes is None:
            return {"heatmap": center.heatmap.sum() * 0 + center.regression.sum() * 0}
        boxes = targets.boxes[inside_grid(targets.boxes, center.tap.grid, center.tap.stride)]
        return {"heatmap": self._heatmap(center, boxes, targets.ignored)} | self._regression(center, boxes)

    def _heatmap(self, center: CenterOutput, boxes: Boxes, ignored: Boxes | None) -> Tensor:
        target = self.gaussians(center, boxes)
        loss = penalty_reduced_focal(center.heatmap.float(), target)
        if ignored is not None:
            loss = loss.masked_fill(_ignored_cells(center, ignored) & (target < 1), 0)
        objects = (target == 1).sum((1, 2, 3)).clamp(min=1)
        return (loss.sum((1, 2, 3)) / objects).sum() / max(len(loss), 1)

    @torch.no_grad()
    def gaussians(self, center: CenterOutput, boxes: Boxes) -> Tensor:
        """Target heat map (B, K, H, W) of boxes in the map: 1 in the cell of each centre, falling off around it."""
        samples, classes, height, width = center.heatmap.shape
        grid, stride = center.tap.grid, center.tap.stride
        size = boxes.size[:, :2] / (boxes.size.new_tensor(grid.cell[:2]) * stride)
        radius = gaussian_radius(size, self.min_overlap).long().clamp(min=self.min_radius)
        cell, _ = encode(boxes, grid, stride)
        owner, place = windows(cell, radius, height, width)
        sigma = (2 * radius[owner] + 1) / 6
        value = torch.exp(-((place - cell[owner]) ** 2).sum(1) / (2 * sigma**2))
        channel = boxes.batch[owner] * classes + boxes.label[owner]
        target = torch.zeros(samples * classes * height * width, device=value.device)
        target.scatter_reduce_(0, (channel * height + place[:, 1]) * width + place[:, 0], value, "amax")
        return target.view(samples, classes, height, width)

    def _regression(self, center: CenterOutput, boxes: Boxes) -> dict[str, Tensor]:
        cell, target = encode(boxes, center.tap.grid, center.tap.stride)
        values = center.at(boxes.batch, boxes.label, cell[:, 1] * center.heatmap.shape[3] + cell[:, 0])
        objects = boxes.batch.bincount(minlength=boxes.batch_size).clamp(min=1)
        weight = self.regression_weight / (objects[boxes.batch] * max(boxes.batch_size, 1))
        error = (values[:, : VELOCITY.start] - target).abs() * weight[:, None]
        parts = {"offset": OFFSET, "height": HEIGHT, "size": SIZE, "yaw": YAW}
        terms = {name: error[:, part].sum() for name, part in parts.items()}
        if values.shape[1] > VELOCITY.start:
            known = _velocity(boxes)
            missed = torch.where(known.isfinite(), values[:, VELOCITY] - known.nan_to_num(), 0).abs()
            terms["velocity"] = (missed * weight[:, None] * self.velocity_weight).sum()
        return terms


def _velocity(boxes: Boxes) -> Tensor:
    """Velocity targets (M, 2); NaN where one is not known."""
    if boxes.velocity is None and len(boxes):
        raise ConfigError(
            "head.center predicts velocities, but the boxes of the dataset have none.\n"
            "  fix: head.center.velocity=false, or a dataset with velocities"
        )
    return boxes.center[:, :2] if boxes.velocity is None else boxes.velocity


@torch.no_grad()
def _ignored_cells(center: CenterOutput, ignored: Boxes) -> Tensor:
    """Cells and classes (B, K, H, W) bool that ignored boxes cover; label -1 covers every class."""
    mask = torch.zeros_like(center.heatmap, dtype=torch.bool)
    ignored = ignored[has_extent(ignored)]
    owner, place = footprints(ignored, center.tap.grid, center.tap.stride)
    batch, label = ignored.batch[owner], ignored.label[owner]
    known = label >= 0
    mask[batch[known], label[known], place[known, 1], place[known, 0]] = True
    batch, place = batch[~known], place[~known]
    mask[batch, :, place[:, 1], place[:, 0]] = True
    return mask
