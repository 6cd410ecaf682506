"""Descriptors of places: the head of CosPlace, its variant for bird's-eye views, and the fusion of several branches.

Source: Berton, Masone and Caputo, CosPlace, CVPR 2022 (head); the paper, 3.4 and 3.5 (branches and fusion).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Head
from lidarfw.types import BEV, Descriptors, FrameMeta, Image, Record, Spec
from torch import Tensor, nn
from torch.nn import functional as F

FUSIONS = ("concat", "add", "weighted")


@dataclass
class PlaceOutput(Record):
    """What a place head gives to its loss."""

    vector: Tensor  # (B, D), of length 1
    modality: tuple[str, ...]  # "camera" or "lidar" of each sample; a label, nothing computes with it


@dataclass
class FusedOutput(Record):
    """A fused descriptor; it has no loss, the branches learn by themselves."""

    vector: Tensor  # (B, D)
    modality: tuple[str, ...]


def unit(vector: Tensor) -> Tensor:
    """Rows (or channels, dimension 1) of length 1; those that are zero stay zero."""
    return F.normalize(vector, dim=1, eps=1e-12)


class GeM(nn.Module):
    """Generalised mean over the last dimension, (mean max(x, 1e-6)^p)^(1/p); p is learned.

    Radenovic, Tolias and Chum, "Fine-tuning CNN Image Retrieval with No Human Annotation", PAMI 2019.
    """

    def __init__(self, power: float = 3.0) -> None:
        super().__init__()
        self.power = nn.Parameter(torch.tensor(power))

    def forward(self, features: Tensor) -> Tensor:
        """(..., N) -> (...)."""
        return features.clamp(min=1e-6).pow(self.power).mean(-1).pow(1 / self.power)


class PlaceHead(Head):
    """L2 norm over channels, generalised mean over the map, linear layer, L2 norm (CosPlace)."""

    defaults = {"loss": ["tsap"], "metric": ["recall_at"]}

    def __init__(self, image: Spec, *, channels: int = 512) -> None:
        """Options: channels, the length D of the descriptor."""
        super().__init__()
        self.pool = GeM()
        self.linear = nn.Linear(image.channels, _positive(channels))
        self.provides = Spec(Descriptors, channels)

    def forward(self, image: Image, meta: list[FrameMeta]) -> PlaceOutput:
        """Feature maps (B, F, h, w) -> descriptors (B, D)."""
        pooled = self.pool(unit(image.features).flatten(2))
        return PlaceOutput(unit(self.linear(pooled)), _modalities(meta))

    def decode(self, output: PlaceOutput) -> Descriptors:
        """The descriptors."""
        return Descriptors(output.vector, output.modality)


class PlaceBEVHead(Head):
    """The head of CosPlace on a bird's-eye view with the sensor in the middle, blind to the heading.

    The generalised mean is taken over each of `rings` rings round the middle of the grid, so turning the map leaves it
    as it is, and the distance of things stays known. Cells farther out than the nearest border are left out.
    """

    defaults = {"loss": ["tsap"], "metric": ["recall_at"]}
    example: ClassVar[dict[str, Any]] = {"rings": 2}

    def __init__(self, bev: Spec, *, channels: int = 256, rings: int = 8) -> None:
        """Options: channels, the length D of the descriptor; rings."""
        super().__init__()
        self.pool = GeM()
        self.linear = nn.Linear(bev.channels * _positive(rings), _positive(channels))
        self.register_buffer("ring", _ring_weights(bev, rings), persistent=False)
        self.provides = Spec(Descriptors, channels)

    def forward(self, bev: BEV, meta: list[FrameMeta]) -> PlaceOutput:
        """Feature maps (B, F, h, w) -> descriptors (B, D)."""
        powers = unit(bev.features).flatten(2).clamp(min=1e-6).pow(self.pool.power)
        pooled = (powers @ self.ring.T).pow(1 / self.pool.power)  # type: ignore[operator]  # (B, F, rings)
        return PlaceOutput(unit(self.linear(pooled.flatten(1))), _modalities(meta))

    def decode(self, output: PlaceOutput) -> Descriptors:
        """The descriptors."""
        return Descriptors(output.vector, output.modality)


def _ring_weights(bev: Spec, rings: int) -> Tensor:
    """(rings, h * w): how much each cell counts in the mean of each ring; every row adds up to 1.

    A cell belongs to its two nearest rings in proportion, so that nothing jumps when a map is turned.
    """
    centers = bev.grid.bev_centers(bev.stride)
    middle = [(low + high) / 2 for low, high in zip(bev.grid.lower[:2], bev.grid.upper[:2], strict=True)]
    reach = min((high - low) / 2 for low, high in zip(bev.grid.lower[:2], bev.grid.upper[:2], strict=True))
    radius = (centers - centers.new_tensor(middle)).norm(dim=2).flatten() / reach
    place = radius * rings - 0.5  # the middle of ring i lies at i
    weights = (1 - (place - torch.arange(rings)[:, None]).abs()).clamp(min=0)
    weights[0] = torch.where(place < 0, 1.0, weights[0])
    weights = torch.where(radius <= 1, weights, 0)
    empty = weights.sum(1, keepdim=True) == 0  # a ring thinner than a cell takes the cell nearest to it
    nearest = F.one_hot((place - torch.arange(rings)[:, None]).abs().argmin(1), len(radius)).to(weights)
    weights = torch.where(empty, nearest, weights)
    return weights / weights.sum(1, keepdim=True)


def _positive(value: int) -> int:
    if value < 1:
        raise ConfigError(f"channels and rings of a place head must be at least 1, got {value}")
    return value


def _modalities(meta: list[FrameMeta]) -> tuple[str, ...]:
    return tuple(frame.modality for frame in meta)


class LateFusionHead(Head):
    """One descriptor of those of several branches, each trained by itself and cut from the graph here (paper 3.5).

    `concat`: one after the other, divided by sqrt(K), so the squared distance is the mean of those of the branches.
    `weighted`: the same with a factor for each branch. `add`: the normalised sum, in which branches can cancel out.
    Branches are left out by naming the others: `inputs: {parts: [head.intensity, head.depth]}`.
    """

    def __init__(
        self, parts: dict[str, Spec], *, fusion: str = "concat", weights: dict[str, float] | None = None
    ) -> None:
        """Options: fusion: concat, add or weighted. weights: by name of the branch, for weighted."""
        super().__init__()
        widths = {name: spec.channels for name, spec in parts.items()}
        self.fusion, self.names, self.weights = fusion, list(parts), dict(weights or {})
        self._check(widths)
        channels = next(iter(widths.values())) if fusion == "add" else sum(widths.values())
        self.provides = Spec(Descriptors, channels)

    def _check(self, widths: dict[str, int]) -> None:
        if self.fusion not in FUSIONS:
            raise ConfigError(f"late_fusion: fusion is {self.fusion!r}; use one of: {', '.join(FUSIONS)}")
        if self.fusion == "add" and len(set(widths.values())) > 1:
            raise ConfigError(f"late_fusion: to add descriptors they must be of one length, found {widths}")
        if self.fusion == "weighted" and (set(self.weights) != set(widths) or min(self.weights.values()) <= 0):
            raise ConfigError(f"late_fusion: weights must be above 0 for {', '.join(widths)}, got {self.weights}")

    def forward(self, parts: dict[str, Descriptors]) -> FusedOutput:
        """K descriptors (B, D) -> one (B, K * D), or (B, D) for `add`."""
        vectors = [parts[name].vector for name in self.names]
        modality = parts[self.names[0]].modality
        if self.fusion == "add":
            return FusedOutput(unit(torch.stack(vectors).sum(0)), modality)
        factors = [self.weights[name] if self.fusion == "weighted" else 1.0 for name in self.names]
        whole = torch.cat([factor * vector for factor, vector in zip(factors, vectors, strict=True)], 1)
        return FusedOutput(whole / math.sqrt(sum(factor**2 for factor in factors)), modality)

    def decode(self, output: FusedOutput) -> Descriptors:
        """The descriptors."""
        return Descriptors(output.vector, output.modality)
