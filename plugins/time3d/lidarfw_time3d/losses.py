"""The losses of Time3D's tracking: which box is which (eq. 6), and smoothness over time (eq. 7)."""

from __future__ import annotations

import torch
from lidarfw.components.matching import greedy_match
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Loss
from lidarfw.ops import box_corners
from lidarfw.types import Boxes, Spec, Targets
from torch import Tensor, nn

from lidarfw_time3d.flow import association, masked, refine
from lidarfw_time3d.monocular import overlap_2d
from lidarfw_time3d.time3d import Time3DOutput

_NEAR = 2.0  # metres on the ground between a box and the object that it stands for, or
_OVERLAP = 0.5  # IoU of their rectangles in the picture
FALSE = -1  # identity of a box that stands for no object


class AssociationLoss(Loss):
    """Cross-entropy of the association matrix (Time3D, eq. 6), over row and column softmax.

    Every current box costs -log R - log C at its past identity or at "none", averaged over those that are supervised.
    The row "none" is shared by all newborns, so its row softmax cannot reach 1 and the literal loss has a floor:
    with `none="single"` newborns only pay by column, and with `symmetric` lost boxes pay by row as well;
    `none="product", symmetric=False` is the paper's formula. A box that stands for no labelled object (greedy by
    score, same class, centres within 2 m on the ground) is left out with `false_positives="mask"`, or belongs to
    "none". Raises ConfigError for other values.
    """

    def __init__(
        self, flow: Spec, *, none: str = "single", symmetric: bool = True, false_positives: str = "mask"
    ) -> None:
        super().__init__()
        for name, value, known in (
            ("none", none, ("single", "product")), ("false_positives", false_positives, ("mask", "none")),
        ):  # fmt: skip
            if value not in known:
                raise ConfigError(f"{name}: expected one of {', '.join(known)}, found {value!r}")
        self.none, self.symmetric, self.masked = none, symmetric, false_positives == "mask"

    def forward(self, flow: Time3DOutput, targets: Targets) -> dict[str, Tensor]:
        """`association`."""
        identity = identities(flow.boxes, targets)
        if identity is None or len(flow.past) == 0:
            return {"association": 0 * flow.logits.sum()}
        past, now = (_slots(identity, rows) for rows in (flow.past, flow.now))
        logits = flow.logits
        if self.masked:
            logits = masked(logits, past != FALSE, now != FALSE)
        return {"association": association_loss(logits, past, now, self.none, self.symmetric, self.masked)}


def association_loss(
    logits: Tensor, past: Tensor, now: Tensor, none: str = "single", symmetric: bool = True, mask: bool = True
) -> Tensor:
    """Eq. 6 from logits (P, Kp + 1, Kn + 1) and identities (P, Kp), (P, Kn): -1 no object, -2 no box."""
    row, column = association(logits)
    same = (past[:, :, None] == now[:, None]) & (past[:, :, None] >= 0)
    known = (now >= 0) if mask else (now >= FALSE)
    linked = same.any(1)
    newborn = known & ~linked
    both = -(row + column)
    cost = (both[:, :-1, :-1] * same).sum((1, 2))
    cost = cost + ((both if none == "product" else -column)[:, -1, :-1] * newborn).sum(1)
    count = known.sum(1)
    if symmetric:
        lost = ((past >= 0) if mask else (past >= FALSE)) & ~same.any(2)
        cost, count = cost - (row[:, :-1, -1] * lost).sum(1), count + lost.sum(1)
    return cost.sum() / count.sum().clamp(min=1)


def identities(boxes: Boxes, targets: Targets) -> Tensor | None:
    """(M,) identity of each box of a batch, -1 for none; None where nothing is labelled."""
    found = objects(boxes, targets)
    if found is None or targets.tracks is None:
        return None
    ids = torch.cat([targets.tracks.id, found.new_tensor([FALSE])])
    return ids[found]


def objects(boxes: Boxes, targets: Targets) -> Tensor | None:
    """(M,) row of the labelled object that each box stands for, -1 for none; None where nothing is labelled."""
    if targets.tracks is None:
        return None
    known = targets.tracks.boxes
    apart = torch.cdist(boxes.center[:, :2].double(), known.center[:, :2].double())
    near = apart <= _NEAR
    if boxes.box2d is not None and known.box2d is not None:  # depth from a picture may be metres off
        near |= overlap_2d(boxes.box2d.detach(), known.box2d.to(boxes.box2d)) >= _OVERLAP
    near &= (boxes.label[:, None] == known.label) & (boxes.batch[:, None] == known.batch)
    order = boxes.score.argsort(descending=True, stable=True)
    chosen = greedy_match(torch.where(near, -apart, -torch.inf)[order])
    return torch.empty_like(chosen).index_copy_(0, order, chosen)


def _slots(values: Tensor, rows: Tensor) -> Tensor:
    """Values (M,) at rows (P, K), -2 at empty places."""
    padded = torch.cat([values, values.new_tensor([-2])])
    return padded[rows]


class TemporalConsistencyLoss(Loss):
    """Refined boxes move between two frames as the object did (Time3D, eq. 7), stay near it, and tell its velocity.

    `consistency`: how far each corner of a box moved, against how far that of its labelled object moved, in the map,
    as a mean over corners and pairs (the paper writes a sum). It is blind to where the corner went; with `vector` it
    compares the displacements themselves. `anchor`: L1 of refined corners to the object's, which eq. 7 alone cannot
    give. `velocity`: L1 to the object's displacement over time. `attribute`: cross-entropy to what the object does,
    by `Boxes.attribute` of the labels (0, 1, 2), else by `Boxes.moving` (0 moves, 1 stands). The options are weights.
    """

    def __init__(
        self,
        flow: Spec,
        *,
        consistency: float = 1.0,
        vector: bool = False,
        anchor: float = 1.0,
        velocity: float = 1.0,
        attribute: float = 0.2,
    ) -> None:
        super().__init__()
        self.consistency, self.vector, self.anchor, self.velocity = consistency, vector, anchor, velocity
        self.attribute = attribute

    def forward(self, flow: Time3DOutput, targets: Targets) -> dict[str, Tensor]:
        """`consistency`, `anchor`, `velocity`, `attribute`."""
        nothing = 0 * (flow.refinement.sum() + flow.velocity.sum() + flow.attribute.sum())
        nothings = dict.fromkeys(("consistency", "anchor", "velocity", "attribute"), nothing)
        found = objects(flow.boxes, targets)
        if found is None or targets.tracks is None or len(flow.past) == 0:
            return nothings
        pair, i, j = self._pairs(flow, found, targets)
        if len(pair) == 0:
            return nothings
        past, now = flow.past[pair, i], flow.now[pair, j]
        true = targets.tracks.boxes
        true_past, true_now = (box_corners(flow.seen_from_now(true, found[rows], pair)) for rows in (past, now))
        known_past, known_now = (flow.seen_from_now(flow.boxes, rows, pair) for rows in (past, now))
        refined = box_corners(refine(known_now, flow.refinement[pair, j]))
        moved, should = refined - box_corners(known_past), true_now - true_past
        velocity = (true_now - true_past).mean(1) / flow.seconds.detach()[pair, None]
        return {
            "consistency": self.consistency * consistency(moved, should, self.vector) + nothing,
            "anchor": self.anchor * (refined - true_now).abs().mean() + nothing,
            "velocity": self.velocity * (flow.velocity[pair, j] - velocity).abs().mean() + nothing,
            "attribute": self.attribute * _attribute_loss(flow.attribute[pair, j], true[found[now]]) + nothing,
        }

    def _pairs(self, flow: Time3DOutput, found: Tensor, targets: Targets) -> tuple[Tensor, Tensor, Tensor]:
        """Pair of frames, place in the past and place now of every object that stands in both."""
        assert targets.tracks is not None
        identity = torch.cat([targets.tracks.id, found.new_tensor([FALSE])])[found]
        past, now = _slots(identity, flow.past), _slots(identity, flow.now)
        pair, i, j = ((past[:, :, None] == now[:, None]) & (past[:, :, None] >= 0)).nonzero().unbind(1)
        return pair, i, j


def _attribute_loss(logits: Tensor, objects: Boxes) -> Tensor:
    """Cross-entropy of logits (N, 3), 0 where nothing is said of what the objects do."""
    known = objects.attribute
    if known is None and objects.moving is not None:
        known = _states(objects.moving)
    if known is None:
        return 0 * logits.sum()
    said = known >= 0
    return nn.functional.cross_entropy(logits, known.clamp(min=0), reduction="none")[said].sum() / said.sum().clamp(
        min=1
    )


def _states(moving: Tensor) -> Tensor:
    """0 moves, 1 stands, -1 not known, of 1, 0, -1."""
    return torch.where(moving < 0, -1, 1 - moving.long())


def consistency(moved: Tensor, should: Tensor, vector: bool = False) -> Tensor:
    """Eq. 7 as a mean: displacements of corners (N, 8, 3) against those that they should have; finite at 0."""
    if vector:
        return _length(moved - should).mean()
    return (_length(moved) - _length(should)).abs().mean()


def _length(vectors: Tensor) -> Tensor:
    return (vectors.square().sum(-1) + 1e-12).sqrt()
