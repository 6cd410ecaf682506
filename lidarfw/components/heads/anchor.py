"""SECOND's detection head: boxes as corrections of anchors at every cell of a bird's-eye-view map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from lidarfw.components.per_class import check_names
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Head
from lidarfw.types import BEV, Boxes, DataSpec, Record, Spec

# sizes l, w, h and height of the bottom over the sensor (m); IoU from which an anchor is positive, below which negative
KITTI_ANCHORS: dict[str, dict[str, Any]] = {
    "Car": {"size": [3.9, 1.6, 1.56], "bottom": -1.78, "matched": 0.6, "unmatched": 0.45},
    "Pedestrian": {"size": [0.8, 0.6, 1.73], "bottom": -1.465, "matched": 0.5, "unmatched": 0.35},
    "Cyclist": {"size": [1.76, 0.6, 1.73], "bottom": -1.465, "matched": 0.5, "unmatched": 0.35},
}
YAWS = (0.0, math.pi / 2)  # of the anchors of every class and cell
DIRECTION_OFFSET = math.pi / 4  # bin 0 holds yaws from pi/4 to 5 pi/4, so no anchor yaw lies on an edge of the bins
PRIOR = 0.01  # probability that an untrained head gives every anchor
MAX_LOG_RATIO = 4.0  # exp(4) = 55 times the anchor; an untrained head must not decode to infinite boxes


@dataclass
class AnchorOutput(Record):
    """Raw scores and corrections of A anchors; anchors run over rows, columns, classes, yaws (last fastest)."""

    score: Tensor  # (B, A, K) logits
    residual: Tensor  # (B, A, 7)
    direction: Tensor  # (B, A, 2) logits of the half circle of the yaw
    anchors: Tensor  # (A, 7) x, y, z, l, w, h, yaw
    label: Tensor  # (A,) int64, class that an anchor is made for
    thresholds: Tensor  # (K, 2) matched, unmatched IoU
    tap: BEV


def encode(boxes: Tensor, anchors: Tensor) -> Tensor:
    """Residuals (M, 7) that take anchors (M, 7) to boxes (M, 7).

    x, y over the anchor's diagonal, z over its height, log ratios of the sizes, difference of yaw
    (SECOND, Yan et al., Sensors 2018).
    """
    diagonal = anchors[:, 3:5].norm(dim=1, keepdim=True)
    scale = torch.cat([diagonal, diagonal, anchors[:, 5:6]], 1)
    ratio = (boxes[:, 3:6] / anchors[:, 3:6]).log()
    return torch.cat([(boxes[:, :3] - anchors[:, :3]) / scale, ratio, boxes[:, 6:] - anchors[:, 6:]], 1)


def decode(residual: Tensor, anchors: Tensor) -> Tensor:
    """Boxes (M, 7) of residuals (M, 7), the inverse of `encode`."""
    diagonal = anchors[:, 3:5].norm(dim=1, keepdim=True)
    scale = torch.cat([diagonal, diagonal, anchors[:, 5:6]], 1)
    size = anchors[:, 3:6] * residual[:, 3:6].clamp(max=MAX_LOG_RATIO).exp()
    return torch.cat([residual[:, :3] * scale + anchors[:, :3], size, residual[:, 6:] + anchors[:, 6:]], 1)


def direction_bin(yaw: Tensor) -> Tensor:
    """Half circle (M,) int64 0 or 1 that a yaw lies in."""
    return ((yaw - DIRECTION_OFFSET).remainder(2 * math.pi) >= math.pi).long()


def turn(yaw: Tensor, direction: Tensor) -> Tensor:
    """Yaw (M,) in [-pi, pi) on the half circle `direction`; the input is known only up to half a turn."""
    half = (yaw - DIRECTION_OFFSET).remainder(math.pi) + DIRECTION_OFFSET + math.pi * direction
    return (half + math.pi).remainder(2 * math.pi) - math.pi


def _makes_sense(anchor: Any) -> bool:
    try:
        size, bottom = [float(v) for v in anchor["size"]], float(anchor["bottom"])
        in_order = 0 < float(anchor["unmatched"]) <= float(anchor["matched"]) <= 1
    except (TypeError, KeyError, ValueError):
        return False
    return (
        set(anchor) == set(KITTI_ANCHORS["Car"])
        and len(size) == 3
        and min(size) > 0
        and in_order
        and math.isfinite(bottom)
    )


def _checked(name: str, anchor: Any) -> dict[str, Any]:
    """The anchor of a class; ConfigError where a key is missing or a value makes no sense."""
    if not _makes_sense(anchor):
        raise ConfigError(
            f"anchors.{name} needs size (length, width, height > 0), bottom (all in metres), and IoUs "
            f"0 < unmatched <= matched <= 1.\n  found: {anchor}\n"
            f"  for example: 'head.anchor.anchors={{{name}: {{size: [3.9, 1.6, 1.56], bottom: -1.78, "
            f"matched: 0.6, unmatched: 0.45}}}}'"
        )
    return dict(anchor)


def _of_classes(classes: tuple[str, ...], given: dict[str, Any] | None) -> list[dict[str, Any]]:
    """One anchor per class: the given ones before those of KITTI."""
    check_names(classes, given or {}, "anchors")
    known = KITTI_ANCHORS | dict(given or {})
    missing = [name for name in classes if name not in known]
    if missing:
        entries = ", ".join(
            f"{n}: {{size: [4.0, 1.8, 1.6], bottom: -1.8, matched: 0.6, unmatched: 0.45}}" for n in missing
        )
        raise ConfigError(
            f"no anchor for the class{'es' * (len(missing) > 1)} {', '.join(map(repr, missing))}.\n"
            f"  anchors there: {', '.join(known)}\n"
            f"  fix, with your sizes (l, w, h) and bottom height in metres: 'head.anchor.anchors={{{entries}}}'\n"
            f"  or take a head without anchors: head=center"
        )
    return [_checked(name, known[name]) for name in classes]


class AnchorHead(Head):
    """Classify and correct two anchors per class and cell (SECOND; the region proposal network of many detectors).

    Three 1x1 convolutions give class scores, box residuals and the half circle of the yaw. `anchors` maps a class to
    `{size: [l, w, h], bottom: z, matched: IoU, unmatched: IoU}` in metres and replaces or adds to those of KITTI's
    Car, Pedestrian and Cyclist. `decode` takes the `max_objects` best anchors of each sample with a score of at least
    `score_threshold`.

    Raises ConfigError for a class without an anchor, and for an anchor of a class that the data does not have.
    """

    defaults = {"loss": ["anchor"], "postprocessor": ["nms"], "metric": ["box_ap"]}

    def __init__(
        self,
        bev: Spec,
        data: DataSpec,
        *,
        anchors: dict[str, Any] | None = None,
        max_objects: int = 4096,
        score_threshold: float = 0.0,
    ) -> None:
        super().__init__()
        self.max_objects, self.score_threshold = max_objects, score_threshold
        chosen = _of_classes(data.classes, anchors)
        self.classes, self.per_cell = len(chosen), len(chosen) * len(YAWS)
        self.score = nn.Conv2d(bev.channels, self.per_cell * self.classes, 1)
        self.residual = nn.Conv2d(bev.channels, self.per_cell * 7, 1)
        self.direction = nn.Conv2d(bev.channels, self.per_cell * 2, 1)
        nn.init.constant_(self.score.bias, -math.log((1 - PRIOR) / PRIOR))  # type: ignore[arg-type]
        nn.init.normal_(self.residual.weight, std=0.001)
        self._place(bev, chosen)
        self.tap = bev
        self.provides = Spec(Boxes, classes=data.classes)

    anchors: Tensor
    label: Tensor
    thresholds: Tensor

    def _place(self, bev: Spec, chosen: list[dict[str, Any]]) -> None:
        """The anchors of all cells, as buffers that a checkpoint does not hold."""
        xy = bev.grid.bev_centers(bev.stride)[:, :, None, None]
        forms = [[[a["bottom"] + a["size"][2] / 2, *a["size"], yaw] for yaw in YAWS] for a in chosen]
        shape = (*xy.shape[:2], self.classes, len(YAWS))
        form = torch.tensor(forms, dtype=xy.dtype).expand(*shape, 5)
        anchors = torch.cat([xy.expand(*shape, 2), form], -1).flatten(0, 3)
        label = torch.arange(self.classes)[:, None].expand(shape).flatten()
        thresholds = torch.tensor([[a["matched"], a["unmatched"]] for a in chosen])
        for name, values in {"anchors": anchors, "label": label, "thresholds": thresholds}.items():
            self.register_buffer(name, values, persistent=False)

    def forward(self, bev: BEV) -> AnchorOutput:
        """Scores and residuals of all anchors from bird's-eye-view features (B, C, H, W)."""
        score, residual, direction = (
            conv(bev.features).permute(0, 2, 3, 1).reshape(bev.batch_size, len(self.anchors), width)
            for conv, width in ((self.score, self.classes), (self.residual, 7), (self.direction, 2))
        )
        return AnchorOutput(score, residual, direction, self.anchors, self.label, self.thresholds, bev)

    def decode(self, output: AnchorOutput) -> Boxes:
        """Boxes by sample and falling score."""
        logit, label = output.score.float().max(2)
        logit, anchor = logit.topk(min(self.max_objects, logit.shape[1]), dim=1)
        score = logit.sigmoid()
        batch, rank = (score >= self.score_threshold).nonzero().unbind(1)
        score, anchor = score[batch, rank], anchor[batch, rank]
        boxes = decode(output.residual[batch, anchor].float(), output.anchors[anchor])
        yaw = turn(boxes[:, 6], output.direction[batch, anchor].argmax(1))
        boxes = torch.cat([boxes[:, :6], yaw[:, None]], 1)
        return Boxes.from_tensor(boxes, label[batch, anchor], score, batch, len(output.score))
