"""The parts of one refinement stage: encoder, attention over stages, branches, part score.

Sources: the MSRM paper, figures 4 and 5, equations 4 to 7; widths of CasA (Wu et al., TGRS 2022); the part score is
the part-sensitive warping of SA-SSD (He et al., CVPR 2020, section 3.4).
"""

from __future__ import annotations

import math

import torch
from lidarfw.components.layers import BatchNorm1d, conv_block
from lidarfw.types import BEV, Spec
from torch import Tensor, nn

from lidarfw_msrm.heads.pooling import bilinear

PARTS = 7  # x 7 parts of a footprint
POSITION = 8  # channels of the stage code


class StageEncoder(nn.Sequential):
    """Equation 4: the pooled features (N, F) of a region become its token (N, C)."""

    def __init__(self, in_channels: int, channels: int, dropout: float) -> None:
        super().__init__(
            nn.Linear(in_channels, channels, bias=False),
            BatchNorm1d(channels),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(channels, channels, bias=False),
            BatchNorm1d(channels),
            nn.ReLU(),
        )


class StageAttention(nn.Module):
    """Equations 5 to 7: the token of the current stage asks, those of the same region in all stages so far answer.

    The paper writes queries, keys and values of one token only, over which a softmax is 1. As its text and figure 5
    say, keys and values are the sequence of stages. A sine and cosine code of the stage goes in beside the tokens.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value = (nn.Linear(channels + POSITION, channels) for _ in range(3))
        self.out = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor) -> Tensor:
        """(N, 2 C): what attention gathers from tokens (N, T, C), oldest stage first, and the last token itself."""
        code = _stage_code(tokens.shape[1], tokens).expand(len(tokens), -1, -1)
        coded = torch.cat([tokens, code], 2)
        query, key, value = (
            layer(x).unflatten(2, (self.heads, -1)).transpose(1, 2)
            for layer, x in ((self.query, coded[:, -1:]), (self.key, coded), (self.value, coded))
        )
        weight = (query @ key.transpose(2, 3) / math.sqrt(query.shape[3])).softmax(3)
        gathered = (weight @ value).transpose(1, 2).flatten(1)
        return torch.cat([self.out(gathered), tokens[:, -1]], 1)


def _stage_code(stages: int, like: Tensor) -> Tensor:
    """(stages, POSITION) sines and cosines of the stage number at falling frequencies (Vaswani et al., 2017, 3.5)."""
    frequency = 10000 ** (-torch.arange(0, POSITION, 2, device=like.device) / POSITION)
    angle = torch.arange(stages, device=like.device)[:, None] * frequency
    return torch.cat([angle.sin(), angle.cos()], 1).to(like.dtype)


def branch(in_channels: int, channels: int, out_channels: int, dropout: float) -> nn.Sequential:
    """A branch of a stage: linear layers with GELU (section II-C). Its last layer starts at "no change"."""
    last = nn.Linear(channels, out_channels)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    first = nn.Linear(in_channels, channels)
    return nn.Sequential(first, nn.GELU(), nn.Dropout(dropout), nn.Linear(channels, channels), nn.GELU(), last)


class PartScore(nn.Module):
    """How well each of 7 x 7 parts of a footprint is seen where it should lie (SA-SSD, section 3.4): part k is read
    from map k alone, so a box that is off reads the wrong parts."""

    def __init__(self, bev: Spec) -> None:
        super().__init__()
        self.maps = nn.Sequential(
            conv_block(bev.channels, bev.channels), nn.Conv2d(bev.channels, PARTS**2, 1, bias=False)
        )

    def forward(self, bev: BEV) -> BEV:
        """The maps (B, 49, H, W)."""
        return BEV(self.maps(bev.features), bev.grid, bev.stride)

    @staticmethod
    def score(maps: BEV, rois: Tensor, batch: Tensor) -> Tensor:
        """Logit (N,) of regions (N, 7): the mean of their parts; what lies outside of the map counts as 0."""
        steps = torch.linspace(-0.5, 0.5, PARTS, device=rois.device, dtype=rois.dtype)
        local = torch.cartesian_prod(steps, steps) * rois[:, None, 3:5]
        cos, sin = rois[:, 6:].cos(), rois[:, 6:].sin()
        x, y = local.unbind(2)
        place = torch.stack([x * cos - y * sin, x * sin + y * cos], 2) + rois[:, None, :2]
        part = torch.arange(PARTS**2, device=rois.device).repeat(len(rois))
        values = bilinear(maps, place.view(-1, 2), batch.repeat_interleave(PARTS**2), part)
        return values.view(len(rois), PARTS**2).mean(1)
