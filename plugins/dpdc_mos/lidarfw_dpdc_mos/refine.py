"""The back-projection module with sparse convolutions: labels of points corrected in space.

Source: Tang, Zhu and Sun, Remote Sensing 2025, 17(2), 195, section 3.2 ("the output is produced by a back-projection
module, utilizing sparse convolution"), in the form of a small network of points and voxels (Tang et al., "Searching
Efficient 3D Architectures with Sparse Point-Voxel Convolution", ECCV 2020, section 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from lidarfw.components.layers import BatchNorm1d, grid_from_options
from lidarfw.components.necks.adapters import RangeToPoints, VoxelsToPoints
from lidarfw.components.per_class import per_class
from lidarfw.interfaces import Head, Loss
from lidarfw.ops import SparseConv3d, SparseInverseConv3d, SparseSequential, SubmanifoldConv3d, voxelize_mean
from lidarfw.types import PointLabels, Points, RangeImage, Spec, Targets, Voxels
from torch import Tensor, nn

from lidarfw_dpdc_mos.losses import lovasz_softmax, weighted_cross_entropy

_LEAST = 1e-6  # probability of the first stage that its logarithm begins at


@dataclass
class RefineOutput:
    """Raw output of the head."""

    logits: Tensor  # (N, K)
    points: Points


class SparseRefineHead(Head):
    """Labels of points from those of an earlier head, corrected by what lies around them in space.

    A point brings the features of its pixel, its own, and the probabilities that it was given. These go through a
    linear layer, and from there through sparse convolutions on voxels of side `cell` (one level down and up again),
    whose result is interpolated back to the points. The sum of both gives a correction of the logits, 0 at the start.

    A head and not a postprocessor, because it has weights to train: head=[moving_seg,sparse_refine]. What it takes is
    cut from the graph, so the first stage learns from its own loss alone. Points outside the range keep the linear
    part only.
    """

    defaults = {"loss": ["sparse_refine"], "metric": ["mos_iou"]}
    example = {"lower": (0.0, -16.0, -3.0), "upper": (32.0, 16.0, 1.0), "cell": 0.5, "channels": 8}

    def __init__(
        self,
        labels: Spec,
        image: Spec,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (-50.0, -50.0, -4.0),
        upper: tuple[float, float, float] = (50.0, 50.0, 2.0),
        cell: float = 0.2,
        channels: int = 32,
    ) -> None:
        """Options: range x, y, z and side of a voxel in metres; width."""
        super().__init__()
        self.grid = grid_from_options(lower, upper, (cell, cell, cell))
        classes = len(labels.classes)
        self.gather = RangeToPoints(image, points)
        self.enter = nn.Sequential(
            nn.Linear(image.channels + classes + points.channels, channels), BatchNorm1d(channels), nn.ReLU()
        )
        self.fine = _sparse(SubmanifoldConv3d(3 + channels, channels, 3), channels)
        down = SparseConv3d(channels, 2 * channels, 3, 2, 1)
        self.coarse = SparseSequential(
            _sparse(down, 2 * channels), _sparse(SubmanifoldConv3d(2 * channels, 2 * channels, 3), 2 * channels)
        )
        self.up = SparseInverseConv3d(2 * channels, channels, 3, 2, 1)
        self.finish = _sparse(SubmanifoldConv3d(2 * channels, channels, 3), channels)
        self.spread = VoxelsToPoints(Spec(Voxels, channels, 1, self.grid, depth=self.grid.shape()[0]), points)
        self.correct = nn.Linear(channels, classes)
        nn.init.zeros_(self.correct.weight)
        nn.init.zeros_(self.correct.bias)
        self.provides = Spec(PointLabels, classes=labels.classes)

    def forward(self, labels: PointLabels, image: RangeImage, points: Points) -> RefineOutput:
        """Logits (N, K) of the points of the scan."""
        before = labels.probability.detach()
        seen = self.gather(image.detach(), points).features
        own = self.enter(torch.cat([seen, before.to(seen), points.features], 1))
        around = self.spread(self._convolve(points.replace(features=own)), points).features
        logits = before.clamp(min=_LEAST).log() + self.correct(torch.relu(own + around))
        return RefineOutput(logits, points)

    def _convolve(self, points: Points) -> Voxels:
        fine: Voxels = self.fine(voxelize_mean(points, self.grid))
        up: Voxels = self.up(self.coarse(fine), fine)
        joined: Voxels = self.finish(fine.with_features(torch.cat([fine.features, up.features], 1)))
        return joined

    def decode(self, output: RefineOutput) -> PointLabels:
        """Probabilities (N, K) of every point."""
        return PointLabels(output.logits.float().softmax(1), output.points.batch, output.points.batch_size)


def _sparse(conv: nn.Module, channels: int) -> SparseSequential:
    return SparseSequential(conv, BatchNorm1d(channels), nn.ReLU())


class SparseRefineLoss(Loss):
    """Weighted cross entropy and Lovasz softmax on the points of the sparse_refine head (eq. 20, 21).

    Classes weigh 1 / (their `frequency` + 0.001), and 0 at frequency 0; without frequencies all weigh the same. Points
    without a label do not count.
    """

    weight: Tensor

    def __init__(self, output: Spec, *, frequency: dict[str, float] | None = None) -> None:
        super().__init__()
        shares = per_class(output.classes, frequency, 1.0, "loss.sparse_refine.frequency")
        weights = [1 / (share + 1e-3) if share > 0 else 0.0 for share in shares]
        self.register_buffer("weight", torch.tensor(weights), persistent=False)

    def forward(self, output: RefineOutput, targets: Targets) -> dict[str, Tensor]:
        """Terms cross_entropy and lovasz; 0 where no point is labelled."""
        nothing = output.logits.float().sum() * 0
        if targets.points is None:
            return {"cross_entropy": nothing, "lovasz": nothing}
        label = targets.points.label
        probability = output.logits.float().softmax(1)[label >= 0]
        known = label[label >= 0]
        return {
            "cross_entropy": weighted_cross_entropy(probability, known, self.weight) + nothing,
            "lovasz": lovasz_softmax(probability, known) + nothing,
        }
