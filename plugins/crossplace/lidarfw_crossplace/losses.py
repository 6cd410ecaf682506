"""Losses on the descriptors of a batch: truncated smooth average precision, and two baselines.

What is alike is known from the poses: frames nearer than `positive` metres show the same place, frames farther than
`negative` another one, and those between count as neither. Height and heading do not matter.

Sources: the paper, equations 3 and 4; Komorowski, "Improving Point Cloud Based Place Recognition with Ranking-based
Loss and Large Batch Training" (MinkLoc3Dv2), ICPR 2022.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Loss
from lidarfw.types import Targets
from torch import Tensor
from torch.nn import functional as F

from lidarfw_crossplace.heads import PlaceOutput

NUMERATORS = ("topk", "all")


def pairwise_distance(vector: Tensor) -> Tensor:
    """Euclidean distances (B, B) of descriptors (B, D), with finite gradients also where two are equal."""
    squares = (vector[:, None] - vector).square().sum(2) if len(vector) <= 64 else _squares(vector)
    return squares.clamp(min=1e-12).sqrt()


def _squares(vector: Tensor) -> Tensor:
    length = vector.square().sum(1)
    return length[:, None] + length - 2 * vector @ vector.T


def neighbours(output: PlaceOutput, targets: Targets, positive: float, negative: float) -> tuple[Tensor, Tensor]:
    """Which frames (B, B) show the same place, and which another one; a frame is neither to itself.

    Of frames without a pose neither is known.
    """
    if targets.poses is None:
        unknown = torch.zeros(len(output.vector), len(output.vector), dtype=torch.bool, device=output.vector.device)
        return unknown, unknown
    place = targets.poses.matrix[:, :2, 3].double()
    metres = torch.cdist(place, place, compute_mode="donot_use_mm_for_euclid_dist")
    known = targets.poses.ok[:, None] & targets.poses.ok
    known &= ~torch.eye(len(place), dtype=torch.bool, device=place.device)
    return known & (metres < positive), known & (metres > negative)


def smooth_rank(difference: Tensor, tau: float) -> Tensor:
    """G(x; tau) = 1 / (1 + exp(-x / tau)), with the exponent kept within +-50."""
    return torch.sigmoid((difference / tau).clamp(-50, 50))


def smooth_average_precision(
    distance: Tensor, positive: Tensor, negative: Tensor, *, k: int = 4, tau: float = 0.01, numerator: str = "topk"
) -> tuple[Tensor, Tensor]:
    """AP (B,) of each query, equation 4, and whether it has a positive at all (B,); AP is 0 where it has none.

    Args:
        distance: (Q, N) between descriptors.
        positive, negative: (Q, N) bool; what is neither is left out.
        k: how many of the nearest positives are ranked.
        numerator: `topk` counts these among each other, as the paper; `all` counts all positives, as MinkLoc3Dv2.
    """
    count = min(k, distance.shape[1])
    nearest = distance.detach().masked_fill(~positive, torch.inf).topk(count, dim=1, largest=False).indices
    chosen = positive.gather(1, nearest)  # (Q, k), False where a query has fewer positives
    ahead = smooth_rank(distance.gather(1, nearest)[:, :, None] - distance[:, None], tau)  # (Q, k, N)
    counted = torch.zeros_like(positive).scatter(1, nearest, chosen) if numerator == "topk" else positive
    rank_here = 1 + _without_self(ahead, counted, nearest)
    rank_all = 1 + _without_self(ahead, positive | negative, nearest)
    ratio = torch.where(chosen, rank_here / rank_all, 0)
    return ratio.sum(1) / chosen.sum(1).clamp(min=1), chosen.any(1)


def _without_self(ahead: Tensor, counted: Tensor, nearest: Tensor) -> Tensor:
    """(Q, k) sum over the counted elements except the ranked one itself."""
    own = ahead.gather(2, nearest[:, :, None])[:, :, 0] * counted.gather(1, nearest)
    return (ahead * counted[:, None]).sum(2) - own


class _PlaceLoss(Loss):
    """What the losses on places share: radii in metres."""

    example: ClassVar[dict[str, Any]] = {"positive": 0.4, "negative": 0.5}  # metres, for frames of one drive

    def __init__(self, positive: float, negative: float) -> None:
        super().__init__()
        if not 0 < positive <= negative:
            raise ConfigError(
                f"positives must end where negatives begin or before: got positive {positive}, negative {negative} m\n"
                "  fix: for example positive: 10, negative: 50"
            )
        self.positive, self.negative = positive, negative


class TSAPLoss(_PlaceLoss):
    """Truncated smooth average precision (equations 3 and 4): 1 - AP, the mean over all queries with a positive.

    Each sample of the batch is a query among the others. 0 for a batch without positives.
    """

    def __init__(
        self,
        *,
        positive: float = 10.0,
        negative: float = 50.0,
        k: int = 4,
        tau: float = 0.01,
        numerator: str = "topk",
    ) -> None:
        """Options: radii in metres; the others: see `smooth_average_precision`."""
        super().__init__(positive, negative)
        if k < 1 or tau <= 0 or numerator not in NUMERATORS:
            raise ConfigError(
                f"tsap needs k of at least 1, tau above 0 and a numerator of {' or '.join(NUMERATORS)}; "
                f"got {k}, {tau} and {numerator!r}"
            )
        self.k, self.tau, self.numerator = k, tau, numerator

    def forward(self, output: PlaceOutput, targets: Targets) -> dict[str, Tensor]:
        """The term `tsap`, 0..1."""
        masks = neighbours(output, targets, self.positive, self.negative)
        distance = pairwise_distance(output.vector)
        precision, asked = smooth_average_precision(distance, *masks, k=self.k, tau=self.tau, numerator=self.numerator)
        lost = torch.where(asked, 1 - precision, 0 * precision)
        return {"tsap": lost.sum() / asked.sum().clamp(min=1)}


class TripletLoss(_PlaceLoss):
    """Baseline: the farthest positive must be nearer than the nearest negative, by a margin (Hermans et al., 2017)."""

    def __init__(self, *, positive: float = 10.0, negative: float = 50.0, margin: float = 0.2) -> None:
        """Options: radii in metres; margin between distances of descriptors."""
        super().__init__(positive, negative)
        self.margin = margin

    def forward(self, output: PlaceOutput, targets: Targets) -> dict[str, Tensor]:
        """The term `triplet`; the mean over queries with a positive and a negative."""
        positive, negative = neighbours(output, targets, self.positive, self.negative)
        distance = pairwise_distance(output.vector)
        asked = positive.any(1) & negative.any(1)
        farthest = distance.masked_fill(~positive, -torch.inf).amax(1)
        nearest = distance.masked_fill(~negative, torch.inf).amin(1)
        lost = F.relu((farthest - nearest)[asked] + self.margin)
        return {"triplet": lost.sum() / asked.sum().clamp(min=1) + 0 * distance.sum()}


class InfoNCELoss(_PlaceLoss):
    """Baseline: every positive against all negatives of its query (van den Oord et al., 2018)."""

    def __init__(self, *, positive: float = 10.0, negative: float = 50.0, temperature: float = 0.07) -> None:
        """Options: radii in metres; temperature of the similarities."""
        super().__init__(positive, negative)
        if temperature <= 0:
            raise ConfigError(f"info_nce needs a temperature above 0, got {temperature}")
        self.temperature = temperature

    def forward(self, output: PlaceOutput, targets: Targets) -> dict[str, Tensor]:
        """The term `info_nce`; the mean over all positive pairs."""
        positive, negative = neighbours(output, targets, self.positive, self.negative)
        similar = output.vector @ output.vector.T / self.temperature
        others = similar.masked_fill(~negative, -1e4).logsumexp(1, keepdim=True)
        lost = F.softplus(others - similar)  # -log(e^s / (e^s + sum over negatives of e^n))
        return {"info_nce": torch.where(positive, lost, 0).sum() / positive.sum().clamp(min=1)}
