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

from lidarfw_time3d.monocular import wrapped

_REACH = 50.0  # metres that count as 1
_WAVES = (0.1, 0.3, 1.0)  # rad/m
_PIXELS = 1000.0  # pixels that count as 1
_SHAPE, _CATEGORY = 128, 32
CUES = ("box3d", "box2d", "appearance", "category")
GEOMETRIES = ("ordered", "unordered", "raw")
FLOWS = ("attention", "mlp")
STATES = 3  # motion attributes of a family of classes at most: moving, parked, stopped of vehicles, say
_OPTIONAL = ("box2d", "appearance")  # cues that a detector may not give


def mlp(sizes: tuple[int, ...]) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for wide, narrow in itertools.pairwise(sizes):
        layers += [nn.Linear(wide, narrow), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class CornerEmbedding(nn.Module):
    """PointNet over the corners of a box: (..., C, D) -> (..., 128).

    The maximum over the corners forgets their order, and with it the heading; so with `ordered` every corner carries
    its number.
    """

    def __init__(self, corners: int, dimensions: int, ordered: bool) -> None:
        super().__init__()
        self.register_buffer("number", torch.eye(corners if ordered else 0), persistent=False)
        self.points = mlp((dimensions + len(self.number), 64, _SHAPE))
        self.out, self.ordered = nn.Linear(_SHAPE, _SHAPE), ordered

    number: Tensor

    def forward(self, corners: Tensor) -> Tensor:
        if self.ordered:
            corners = torch.cat([corners, self.number.expand(*corners.shape[:-1], -1)], -1)
        result: Tensor = self.out(self.points(corners).amax(-2))
        return result


class CueEmbedding(nn.Module):
    """Heterogeneous cues (section 3.2): 3D box, 2D box, appearance, class and score -> F (B, K, d).

    `cues` are those that it looks at. A cue that is not there is a learned vector, and is dropped now and then in
    training, so that any subset will do. `geometry` says how boxes are told: by their `ordered` corners, by
    `unordered` ones, or by their `raw` numbers.
    """

    def __init__(
        self,
        classes: int,
        width: int,
        appearance: int,
        cues: tuple[str, ...] = CUES,
        geometry: str = "ordered",
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.cues = tuple(cue for cue in CUES if cue in cues and (cue != "appearance" or appearance))
        self.embed = nn.ModuleDict({cue: _embedding(cue, classes, appearance, geometry) for cue in self.cues})
        self.level = nn.ModuleDict({cue: nn.LayerNorm(_wide(cue)) for cue in self.cues})  # no cue drowns another
        self.absent = nn.ParameterDict({c: nn.Parameter(torch.zeros(_SHAPE)) for c in self.cues if c in _OPTIONAL})
        inputs = sum(map(_wide, self.cues)) + 1
        self.join = nn.Sequential(
            nn.Linear(inputs, width), nn.ReLU(), nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU(),
            nn.LayerNorm(width),
        )  # fmt: skip
        self.classes, self.width, self.looks, self.dropout = classes, width, appearance, dropout
        self.raw = geometry == "raw"

    def forward(
        self, boxes: Tensor, label: Tensor, score: Tensor, box2d: Tensor | None, appearance: Tensor | None
    ) -> Tensor:
        """Embeddings of boxes (B, K, 7) in the sensor frame of now; 2D boxes (B, K, 4) and appearance (B, K, A)."""
        known = {
            "box3d": self._box3d(boxes),
            "box2d": self._box2d(boxes.new_zeros(*boxes.shape[:2], 4) if box2d is None else box2d / _PIXELS),
            "appearance": boxes.new_zeros(*boxes.shape[:2], self.looks) if appearance is None else appearance,
            "category": nn.functional.one_hot(label, self.classes).to(boxes.dtype),
        }
        there = {"box2d": box2d is not None, "appearance": appearance is not None}
        told = {cue: self.level[cue](self.embed[cue](known[cue])) for cue in self.cues}
        parts = [self._or_absent(told[cue], cue, there.get(cue, True)) for cue in self.cues]
        result: Tensor = self.join(torch.cat([*parts, score[..., None]], -1))
        return result

    def _box3d(self, boxes: Tensor) -> Tensor:
        if self.raw:
            angle = boxes[..., 6:]
            return torch.cat([waves(boxes[..., :3]), boxes[..., 3:6], wrapped(angle)], -1)
        return waves(box_corners(boxes.reshape(-1, 7)).reshape(*boxes.shape[:2], 8, 3))

    def _box2d(self, rectangle: Tensor) -> Tensor:
        if self.raw:
            return rectangle
        return rectangle[..., [0, 1, 0, 3, 2, 1, 2, 3]].reshape(*rectangle.shape[:-1], 4, 2)

    def _or_absent(self, cue: Tensor, name: str, present: bool) -> Tensor:
        if name not in self.absent:
            return cue
        there = torch.full(cue.shape[:1], present, device=cue.device)
        if self.training:
            there = there & (torch.rand(len(there), device=cue.device) >= self.dropout)
        return torch.where(there[:, None, None], cue, self.absent[name])


def _wide(cue: str) -> int:
    """The width of the embedding of a cue."""
    return _CATEGORY if cue == "category" else _SHAPE


def _embedding(cue: str, classes: int, appearance: int, geometry: str) -> nn.Module:
    """The network of one cue."""
    if cue == "category":
        return nn.Linear(classes, _wide(cue))
    if cue == "appearance":
        return nn.Sequential(nn.LayerNorm(appearance), nn.Linear(appearance, _SHAPE))
    corners, numbers = (8, 3 + 6 * len(_WAVES)) if cue == "box3d" else (4, 2)
    if geometry == "raw":
        return mlp((numbers + 4 if cue == "box3d" else 4, 64, _SHAPE, _SHAPE))
    return CornerEmbedding(corners, numbers, geometry == "ordered")


def waves(places: Tensor) -> Tensor:
    """Places (..., 3) in metres as (..., 21): over 50 m, and sines and cosines of them.

    The paper's corners alone hardly tell one metre of a hundred apart, and two cars are told apart by a metre.
    """
    angles = torch.cat([places * wave for wave in _WAVES], -1)
    return torch.cat([places / _REACH, angles.sin(), angles.cos()], -1)


class SpatialFlow(nn.Module):
    """Self-attention among the boxes of a frame (section 3.3): F (B, K, d) -> F^ (B, K, d), empty places 0.

    Encoder layers with the norm last and no positional encoding: the geometry stands in the embedding. `kind="mlp"`
    has networks of as many weights in their place, for each box by itself.
    """

    def __init__(self, width: int, layers: int, heads: int, kind: str = "attention", dropout: float = 0.1) -> None:
        super().__init__()
        self.alone = kind == "mlp"
        if self.alone:
            self.layers: nn.Module = nn.Sequential(*(_Alone(width, dropout) for _ in range(layers)))
            return
        layer = nn.TransformerEncoderLayer(width, heads, 4 * width, dropout, batch_first=True)
        self.layers = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        """F^ (B, K, d) of F (B, K, d), with mask (B, K)."""
        if features.numel() == 0:
            return features
        if self.alone:
            each: Tensor = self.layers(features) * mask[..., None]
            return each
        hidden = ~mask
        hidden = hidden & ~hidden.all(1, keepdim=True)  # a frame without boxes would have nothing to look at: NaN
        result: Tensor = self.layers(features, src_key_padding_mask=hidden) * mask[..., None]
        return result


class _Alone(nn.Module):
    """As many weights as an encoder layer, without a look at the other boxes."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.network, self.norm = mlp((width, 6 * width, width)), nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, features: Tensor) -> Tensor:
        result: Tensor = self.norm(features + self.dropout(self.network(features)))
        return result


class TemporalFlow(nn.Module):
    """Cross-attention between two frames (equations 3 and 4): affinity, and what the past says of each box now.

    The logits of eq. 3 come from the product of every attention head by a small network over the heads, without
    softmax; a learned number is the logit of "none", in a row for newborn and a column for lost objects. Eq. 4
    gathers the past with the same products, with softmax; with `kind="mlp"` it does not, and a network of as many
    weights looks at the boxes of now alone. The time between the frames enters the past.
    """

    def __init__(self, width: int, heads: int, kind: str = "attention") -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
        self.combine = mlp((heads, heads, 1))
        self.newborn, self.lost = nn.Parameter(torch.zeros(())), nn.Parameter(torch.zeros(()))
        self.seconds, self.out = nn.Linear(1, width), nn.Linear(width, width)
        self.velocity, self.refine = mlp((width, width, width, 3)), mlp((width, width, width, 6))
        self.attribute = mlp((width, width, width, STATES))
        for parameter in self.refine[-1].parameters():
            nn.init.zeros_(parameter)  # refinement starts at none
        self.heads, self.gathers = heads, kind == "attention"
        self._start_as_similarity()

    def _start_as_similarity(self) -> None:
        """Equal queries and keys, and logits that rise with every head's product, so that like boxes have high ones.

        From two random maps the network learns the few objects of its training drives by heart instead. Half of the
        hidden units see the products negated, and are taken away, as positive ones alone would cut off what is unlike.
        """
        self.key.load_state_dict(self.query.state_dict())
        (first, first_bias), (last, _) = (layer.parameters() for layer in (self.combine[0], self.combine[-1]))
        sign = torch.ones(len(first))
        sign[1::2] = -1
        with torch.no_grad():
            first.abs_().mul_(sign[:, None])
            last.abs_().mul_(sign)
            first_bias.zero_()

    def forward(
        self, past: Tensor, now: Tensor, past_mask: Tensor, now_mask: Tensor, seconds: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Logits (P, Kp + 1, Kn + 1), rows past and columns now; velocity (P, Kn, 3) m/s; refinement (P, Kn, 6) m;
        logits (P, Kn, 3) of motion attributes.

        Args:
            past: (P, Kp, d).
            now: (P, Kn, d).
            past_mask, now_mask: (P, Kp), (P, Kn).
            seconds: (P,) between the frames.
        """
        past = past + self.seconds(seconds[:, None])[:, None]
        product = self._products(past, now)
        logits = self.bordered(self.combine(product.movedim(1, -1))[..., 0].float(), past_mask, now_mask)
        gathered = self._gathered(product, past, past_mask) if self.gathers else self.value(now).relu()
        mixed = now + self.out(gathered)
        return logits, self.velocity(mixed), self.refine(mixed), self.attribute(mixed)

    def _gathered(self, product: Tensor, past: Tensor, past_mask: Tensor) -> Tensor:
        """(P, Kn, d) of the past for each box now (eq. 4)."""
        closed = torch.where(past_mask[:, None, :, None], product, -1e9)
        share = closed.softmax(2) * past_mask[:, None, :, None]  # of every past box in each box now
        value = self.value(past).unflatten(-1, (self.heads, -1))
        return torch.einsum("phij,pihc->pjhc", share, value).flatten(2)

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
