"""The network of Time3D: cues of a box as one vector, flow among the boxes of a frame, flow between two frames.

Source: Li and Jin, "Time3D: End-to-End Joint Monocular 3D Object Detection and Tracking for Autonomous Driving",
CVPR 2022, sections 3.2 and 3.3. What the paper leaves open is said where it is decided. B frames with K places for
boxes each; a mask (B, K) says which places hold one.
"""

from __future__ import annotations

import itertools

import torch
from lidarfw.ops import box_corners
from torch import Tensor, nn

_REACH = 50.0  # metres that count as 1
_WAVES = (0.1, 0.3, 1.0)  # rad/m
_PIXELS = 1000.0  # pixels that count as 1
_SHAPE, _CATEGORY = 128, 32


def mlp(sizes: tuple[int, ...]) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for wide, narrow in itertools.pairwise(sizes):
        layers += [nn.Linear(wide, narrow), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class CornerEmbedding(nn.Module):
    """PointNet over the corners of a box: (..., C, D) -> (..., 128).

    The maximum over the corners forgets their order, and with it the heading; so every corner carries its number.
    """

    def __init__(self, corners: int, dimensions: int) -> None:
        super().__init__()
        self.register_buffer("number", torch.eye(corners), persistent=False)
        self.points, self.out = mlp((dimensions + corners, 64, _SHAPE)), nn.Linear(_SHAPE, _SHAPE)

    number: Tensor

    def forward(self, corners: Tensor) -> Tensor:
        number = self.number.expand(*corners.shape[:-1], -1)
        result: Tensor = self.out(self.points(torch.cat([corners, number], -1)).amax(-2))
        return result


class CueEmbedding(nn.Module):
    """Heterogeneous cues (section 3.2): 3D box, 2D box, appearance, class and score -> F (B, K, d).

    A cue that is not there is a learned vector, and is dropped now and then in training, so that any subset will do.
    """

    def __init__(self, classes: int, width: int, appearance: int, dropout: float = 0.1) -> None:
        super().__init__()
        self.box3d, self.box2d = CornerEmbedding(8, 3 + 6 * len(_WAVES)), CornerEmbedding(4, 2)
        self.appearance = nn.Sequential(nn.LayerNorm(appearance), nn.Linear(appearance, _SHAPE)) if appearance else None
        self.category = nn.Linear(classes, _CATEGORY)
        self.absent = nn.ParameterList(nn.Parameter(torch.zeros(_SHAPE)) for _ in range(2 if appearance else 1))
        inputs = (3 if appearance else 2) * _SHAPE + _CATEGORY + 1
        self.join = nn.Sequential(
            nn.Linear(inputs, width), nn.ReLU(), nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU(),
            nn.LayerNorm(width),
        )  # fmt: skip
        self.classes, self.width, self.looks, self.dropout = classes, width, appearance, dropout

    def forward(
        self, boxes: Tensor, label: Tensor, score: Tensor, box2d: Tensor | None, appearance: Tensor | None
    ) -> Tensor:
        """Embeddings of boxes (B, K, 7) in the sensor frame of now; 2D boxes (B, K, 4) and appearance (B, K, A)."""
        corners = box_corners(boxes.reshape(-1, 7)).reshape(*boxes.shape[:2], 8, 3)
        parts = [self.box3d(waves(corners))]
        known = boxes.new_zeros(*boxes.shape[:2], 4) if box2d is None else box2d / _PIXELS
        rectangle = known[..., [0, 1, 0, 3, 2, 1, 2, 3]].reshape(*known.shape[:-1], 4, 2)
        parts.append(self._or_absent(self.box2d(rectangle), 0, box2d is not None))
        if self.appearance is not None:
            seen = boxes.new_zeros(*boxes.shape[:2], self.looks) if appearance is None else appearance
            parts.append(self._or_absent(self.appearance(seen), 1, appearance is not None))
        category = nn.functional.one_hot(label, self.classes).to(boxes.dtype)
        result: Tensor = self.join(torch.cat([*parts, self.category(category), score[..., None]], -1))
        return result

    def _or_absent(self, cue: Tensor, number: int, present: bool) -> Tensor:
        there = torch.full(cue.shape[:1], present, device=cue.device)
        if self.training:
            there = there & (torch.rand(len(there), device=cue.device) >= self.dropout)
        return torch.where(there[:, None, None], cue, self.absent[number])


def waves(places: Tensor) -> Tensor:
    """Places (..., 3) in metres as (..., 21): over 50 m, and sines and cosines of them.

    The paper's corners alone hardly tell one metre of a hundred apart, and two cars are told apart by a metre.
    """
    angles = torch.cat([places * wave for wave in _WAVES], -1)
    return torch.cat([places / _REACH, angles.sin(), angles.cos()], -1)


class SpatialFlow(nn.Module):
    """Self-attention among the boxes of a frame (section 3.3): F (B, K, d) -> F^ (B, K, d), empty places 0.

    Encoder layers with the norm last and no positional encoding: the geometry stands in the embedding.
    """

    def __init__(self, width: int, layers: int, heads: int, dropout: float = 0.1) -> None:
        super().__init__()
        layer = nn.TransformerEncoderLayer(width, heads, 4 * width, dropout, batch_first=True)
        self.layers = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        if features.numel() == 0:
            return features
        hidden = ~mask
        hidden = hidden & ~hidden.all(1, keepdim=True)  # a frame without boxes would have nothing to look at: NaN
        result: Tensor = self.layers(features, src_key_padding_mask=hidden) * mask[..., None]
        return result


class TemporalFlow(nn.Module):
    """Cross-attention between two frames (equations 3 and 4): affinity, and what the past says of each box now.

    The logits of eq. 3 come from the product of every attention head by a small network over the heads, without
    softmax; a learned number is the logit of "none", in a row for newborn and a column for lost objects. Eq. 4
    gathers the past with the same products, with softmax. The time between the frames enters the past.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
        self.combine = mlp((heads, heads, 1))
        self.newborn, self.lost = nn.Parameter(torch.zeros(())), nn.Parameter(torch.zeros(()))
        self.seconds, self.out = nn.Linear(1, width), nn.Linear(width, width)
        self.velocity, self.refine = mlp((width, width, width, 3)), mlp((width, width, width, 6))
        for parameter in self.refine[-1].parameters():
            nn.init.zeros_(parameter)  # refinement starts at none
        self.heads = heads

    def forward(
        self, past: Tensor, now: Tensor, past_mask: Tensor, now_mask: Tensor, seconds: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Logits (P, Kp + 1, Kn + 1), rows past and columns now; velocity (P, Kn, 3) m/s; refinement (P, Kn, 6) m.

        Args:
            past: (P, Kp, d).
            now: (P, Kn, d).
            past_mask, now_mask: (P, Kp), (P, Kn).
            seconds: (P,) between the frames.
        """
        past = past + self.seconds(seconds[:, None])[:, None]
        product = self._products(past, now)
        logits = self.bordered(self.combine(product.movedim(1, -1))[..., 0].float(), past_mask, now_mask)
        closed = torch.where(past_mask[:, None, :, None], product, -1e9)
        share = closed.softmax(2) * past_mask[:, None, :, None]  # of every past box in each box now
        value = self.value(past).unflatten(-1, (self.heads, -1))
        gathered = torch.einsum("phij,pihc->pjhc", share, value).flatten(2)
        mixed = now + self.out(gathered)
        return logits, self.velocity(mixed), self.refine(mixed)

    def _products(self, past: Tensor, now: Tensor) -> Tensor:
        """(P, H, Kp, Kn) scaled products of keys of the past and queries of now, per head."""
        query, key = (layer(x).unflatten(-1, (self.heads, -1)) for layer, x in ((self.query, now), (self.key, past)))
        product: Tensor = torch.einsum("pihc,pjhc->phij", key, query) * query.shape[-1] ** -0.5
        return product

    def bordered(self, logits: Tensor, past_mask: Tensor, now_mask: Tensor) -> Tensor:
        """(P, Kp + 1, Kn + 1): with the row and column of "none", empty places at -1e9."""
        whole = nn.functional.pad(logits, (0, 1, 0, 1))
        row, column = torch.zeros_like(whole), torch.zeros_like(whole)
        row[:, -1], column[:, :-1, -1] = 1, 1
        whole = whole + row * self.newborn + column * self.lost
        return masked(whole, past_mask, now_mask)


def masked(logits: Tensor, past_mask: Tensor, now_mask: Tensor) -> Tensor:
    """Logits (P, Kp + 1, Kn + 1) with -1e9 where a place is empty; "none" is always there."""
    one = past_mask.new_ones(len(past_mask), 1)
    there = torch.cat([past_mask, one], 1)[:, :, None] & torch.cat([now_mask, one], 1)[:, None]
    return torch.where(there, logits, -1e9)


def association(logits: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithms of the row and of the column softmax (..., Kp + 1, Kn + 1) of logits, in float32."""
    return logits.float().log_softmax(-1), logits.float().log_softmax(-2)


def unimodal(logits: Tensor) -> Tensor:
    """Association matrix: row softmax times column softmax, element by element; exactly 0 at empty places."""
    row, column = association(logits)
    return torch.where(logits > -1e8, (row + column).exp(), 0)


def refine(boxes: Tensor, change: Tensor) -> Tensor:
    """Boxes (N, 7) plus the refinement (N, 6): metres of x, y, z, w, h, l (the order of the paper); yaw stays."""
    size = (boxes[:, 3:6] + change[:, [5, 3, 4]]).clamp(min=0.1)
    return torch.cat([boxes[:, :3] + change[:, :3], size, boxes[:, 6:]], 1)
