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
    """A descriptor of a bird's-eye view with the sensor in the middle, that does not see the heading.

    The map is read in polar coordinates, `rings` by `angles`. Turning the vehicle moves every ring round, which the
    magnitudes of its Fourier transform do not see, while they still tell how things are arranged round the sensor:
    the mean over a ring, its frequency 0, forgets that. The lowest `frequencies` of every ring and channel go through
    a linear layer to unit length. Xu et al., "DiSCO: Differentiable Scan Context with Orientation", RA-L 2021.
    """

    grid: Tensor
    defaults = {"loss": ["tsap"], "metric": ["recall_at"]}
    example: ClassVar[dict[str, Any]] = {"rings": 2, "angles": 8, "frequencies": 3}

    def __init__(
        self, bev: Spec, *, channels: int = 256, rings: int = 8, angles: int = 32, frequencies: int = 9
    ) -> None:
        """Options: channels, the length D of the descriptor; rings; angles of a ring; frequencies that are kept."""
        super().__init__()
        if frequencies > _positive(angles) // 2 + 1:
            raise ConfigError(f"head.place_bev: {angles} angles have {angles // 2 + 1} frequencies, not {frequencies}")
        self.frequencies = _positive(frequencies)
        self.linear = nn.Linear(bev.channels * _positive(rings) * frequencies, _positive(channels))
        self.register_buffer("grid", _polar_grid(bev, rings, angles), persistent=False)
        self.provides = Spec(Descriptors, channels)

    def forward(self, bev: BEV, meta: list[FrameMeta]) -> PlaceOutput:
        """Feature maps (B, F, h, w) -> descriptors (B, D)."""
        places = self.grid.to(bev.features).expand(bev.batch_size, -1, -1, -1)
        polar = F.grid_sample(unit(bev.features), places, align_corners=True)  # (B, F, rings, angles)
        spectrum = torch.fft.rfft(polar.float(), norm="forward")[..., : self.frequencies]
        magnitude = (spectrum.real.square() + spectrum.imag.square() + 1e-8).sqrt()  # finite gradient also at 0
        amplitude = torch.cat([magnitude[..., :1], 2 * magnitude[..., 1:]], 3)  # of the mean and of the cosines
        return PlaceOutput(unit(self.linear(amplitude.flatten(1))), _modalities(meta))

    def decode(self, output: PlaceOutput) -> Descriptors:
        """The descriptors."""
        return Descriptors(output.vector, output.modality)


def _polar_grid(bev: Spec, rings: int, angles: int) -> Tensor:
    """(1, rings, angles, 2) where to read the map, as grid_sample wants it: column and row, -1..1.

    The sensor is in the middle of the map's cells, which may reach a little beyond the grid: padding puts as much on
    either side. The rings end at the nearest border.
    """
    centers = bev.grid.bev_centers(bev.stride).flatten(0, 1)
    half = (centers.amax(0) - centers.amin(0)) / 2
    radius = (torch.arange(rings) + 0.5) / rings * half.min()
    angle = torch.arange(angles) * (2 * math.pi / angles)
    places = radius[:, None, None] * torch.stack([angle.cos(), angle.sin()], 1)
    return (places / half.clamp(min=1e-6))[None]


def _positive(value: int) -> int:
    if value < 1:
        raise ConfigError(f"numbers of a place head must be at least 1, got {value}")
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
