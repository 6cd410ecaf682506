"""The edge-aware loss: weighted cross entropy, Lovasz softmax, and the integral of a signed distance.

Source: Tang, Zhu and Sun, Remote Sensing 2025, 17(2), 195, section 3.5; Berman et al., "The Lovasz-Softmax loss",
CVPR 2018; Kervadec et al., "Boundary loss for highly unbalanced segmentation", MIDL 2019.
"""

from __future__ import annotations

import torch
from lidarfw.components.per_class import per_class
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Loss
from lidarfw.types import Spec, Targets
from torch import Tensor

from lidarfw_dpdc_mos.distance import distance_maps, on_pixels
from lidarfw_dpdc_mos.heads import MovingSegOutput


def weighted_cross_entropy(probability: Tensor, label: Tensor, weight: Tensor) -> Tensor:
    """Mean of -log p of the true class, weighted by `weight` (K,) of that class (eq. 20); 0 without weight.

    probability (N, K), label (N,) in 0..K-1. Divided by the sum of the weights, as torch does.
    """
    each = weight.to(probability)[label]
    true = probability.gather(1, label[:, None])[:, 0].clamp(min=1e-8)
    return -(each * true.log()).sum() / each.sum().clamp(min=torch.finfo(probability.dtype).tiny)


def lovasz_softmax(probability: Tensor, label: Tensor) -> Tensor:
    """Mean over the classes present of the Lovasz extension of the Jaccard loss (eq. 21; Berman et al., eq. 8-9).

    probability (N, K), label (N,) in 0..K-1; 0 for no pixel.
    """
    present = torch.unique(label).tolist()
    terms = [_lovasz((label == number).to(probability), probability[:, number]) for number in present]
    return torch.stack(terms).mean() if terms else probability.sum() * 0


def _lovasz(truth: Tensor, probability: Tensor) -> Tensor:
    error, order = (truth - probability).abs().sort(descending=True)
    return error @ _jaccard_gradient(truth[order])


def _jaccard_gradient(truth: Tensor) -> Tensor:
    """Steps of the Jaccard loss as more and more pixels, by falling error, are wrong (Berman et al., algorithm 1)."""
    total = truth.sum()
    jaccard = 1 - (total - truth.cumsum(0)) / (total + (1 - truth).cumsum(0))
    return torch.cat([jaccard[:1], jaccard.diff()])


def edge_integral(probability: Tensor, distance: Tensor, valid: Tensor, limit: float = 20.0) -> Tensor:
    """Mean over valid pixels of phi * s (eq. 18): low where probability lies inside, negative at best.

    probability, distance (B, C, H, W) of the same C classes, valid (B, H, W) bool. With a `limit` above 0 the
    distance is clipped there and divided by it, to -1..1; 0 leaves it as it is. 0 without a valid pixel.
    """
    phi = (distance / limit).clamp(-1, 1) if limit > 0 else distance
    pixels = valid.sum().clamp(min=1) * probability.shape[1]
    return (phi * probability * valid[:, None]).sum() / pixels


def edge_aware_terms(
    logits: Tensor,
    label: Tensor,
    distance: Tensor,
    alpha: float,
    weight: Tensor | None = None,
    limit: float = 20.0,
) -> dict[str, Tensor]:
    """(1 - alpha) * (cross entropy + Lovasz) + alpha * edge (eq. 19), term by term, of any mask: range image, BEV, ...

    logits (B, K, H, W), label (B, H, W) int64 with -1 for pixels that do not count, distance (B, C, H, W) as of
    `distance_maps`, weight (K,) of the classes.
    """
    probability = logits.float().softmax(1)
    valid = label >= 0
    rows, known = probability.movedim(1, -1)[valid], label[valid]
    weight = rows.new_ones(rows.shape[1]) if weight is None else weight
    nothing = logits.float().sum() * 0  # keeps the graph, and the terms finite, where no pixel counts
    chosen = probability[:, 1:] if distance.shape[1] < probability.shape[1] else probability
    return {
        "cross_entropy": (1 - alpha) * weighted_cross_entropy(rows, known, weight) + nothing,
        "lovasz": (1 - alpha) * lovasz_softmax(rows, known) + nothing,
        "edge": alpha * edge_integral(chosen, distance.to(probability), valid, limit) + nothing,
    }


class EdgeAwareLoss(Loss):
    """L = (1 - alpha) (L_wce + L_ls) + alpha L_E on the pixels of the moving_seg head (eq. 19).

    Classes weigh 1 / (their `frequency` + 0.001), and 0 at frequency 0; without frequencies all weigh the same. Pixels
    without a labelled point do not count. The edge term integrates probability times signed distance over them, the
    distance clipped to `limit` pixels and divided by it (limit 0: as it is). alpha goes from `alpha` to `alpha_end`
    over the training, in `alpha_steps` equal steps (the paper's epochs), or evenly for alpha_steps 0.

    Distance maps come from the transform `edge_distance`; where the loader has none they are made here, in pixels.
    Where no class has an edge the edge term is 0. It can be negative, and so can the total.
    """

    weight: Tensor

    def __init__(
        self,
        output: Spec,
        *,
        frequency: dict[str, float] | None = None,
        alpha: float = 0.02,
        alpha_end: float = 0.515,
        alpha_steps: int = 100,
        limit: float = 20.0,
    ) -> None:
        super().__init__()
        if not (0 <= alpha <= 1 and 0 <= alpha_end <= 1):
            raise ConfigError(f"loss.edge_aware: alpha and alpha_end lie within 0..1, found {alpha} and {alpha_end}")
        shares = per_class(output.classes, frequency, 1.0, "loss.edge_aware.frequency")
        weights = [1 / (share + 1e-3) if share > 0 else 0.0 for share in shares]
        self.register_buffer("weight", torch.tensor(weights), persistent=False)
        self.classes, self.limit = len(output.classes), limit
        self.alpha, self.alpha_end, self.alpha_steps = alpha, alpha_end, alpha_steps

    def forward(self, output: MovingSegOutput, targets: Targets, progress: float = 1.0) -> dict[str, Tensor]:
        """Terms cross_entropy, lovasz and edge, each with its share of alpha; 0 where no point is labelled."""
        if targets.points is None:
            zero = output.logits.float().sum() * 0
            return {"cross_entropy": zero, "lovasz": zero, "edge": zero}
        label = on_pixels(targets.points.label, output.image, output.points, empty=-1)
        known = targets.pixels
        distance = distance_maps(label, self.classes) if known is None else known.features
        return edge_aware_terms(output.logits, label, distance, self.alpha_at(progress), self.weight, self.limit)

    def alpha_at(self, progress: float) -> float:
        """alpha when that share of the training is done, 0..1."""
        if self.alpha_steps > 1:
            step = min(int(progress * self.alpha_steps - 1e-6), self.alpha_steps - 1)
            progress = step / (self.alpha_steps - 1)
        return self.alpha + (self.alpha_end - self.alpha) * progress
