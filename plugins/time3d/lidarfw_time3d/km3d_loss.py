"""The loss of the monocular detection head (KM3D, section 3.4; Time3D, equation 5)."""

from __future__ import annotations

import math

import torch
from lidarfw.components.losses.bev import has_extent, windows
from lidarfw.components.losses.center import gaussian_radius, penalty_reduced_focal
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Loss
from lidarfw.ops import paired_iou_3d
from lidarfw.types import Boxes, Spec, Targets
from torch import Tensor, nn

from lidarfw_time3d.km3d import (
    BINS,
    EXTENT,
    KEYPOINTS,
    OFFSET,
    SIZE,
    SURE,
    TURN,
    Found,
    KM3DOutput,
    found_at,
)
from lidarfw_time3d.monocular import NEAR, keypoints, observation, rectangles, wrapped

_OVERLAP = 0.7  # that a rectangle keeps when its corners move by the radius of its Gaussian
_BEYOND = 0.5  # of the picture: keypoints farther outside are not learned
_COORDINATES = 15  # more than so many of the 18 must be known for the place to be learned
_LEAST = 0.3
_WITHIN = math.pi / 6  # a bin reaches so far beyond the half turn about its middle


class KM3DLoss(Loss):
    """Train the monocular head (KM3D, section 3.4; Time3D, equation 5, with the terms that it leaves out).

    Terms: `heatmap`, penalty-reduced focal; L1 of `keypoints` (cells), weighted by depth so that near objects do not
    rule, `size` (metres, times 2), `offset` and `extent` (cells, the latter times 0.1); `turn`, cross-entropy and
    smooth L1 of two overlapping bins of the observation angle (times 0.2); `position`, the distance of the place
    that the keypoints lead to; `confidence`, cross-entropy to the 3D IoU. The last two rise as
    exp(-5 (1 - e)^2), where e is the share `rise` of the training that is done; `position` starts when that is 0.3.

    Learned are objects whose rectangle has its centre in the picture. Cells within an ignored rectangle give no
    heat-map loss for its class. Raises ConfigError where `rise` is not in (0, 1].
    """

    def __init__(self, km3d: Spec, *, rise: float = 0.5) -> None:
        super().__init__()
        if not 0 < rise <= 1:
            raise ConfigError(f"rise: expected a share of the training in (0, 1], found {rise}")
        self.rise = rise

    def forward(self, km3d: KM3DOutput, targets: Targets, progress: float) -> dict[str, Tensor]:
        """The terms; all 0 where nothing is labelled."""
        nothing = 0 * (km3d.heatmap.sum() + km3d.regression.sum() + km3d.embedding.sum())
        names = ("keypoints", "size", "turn", "offset", "extent", "position", "confidence")
        if targets.boxes is None:
            return {"heatmap": nothing} | dict.fromkeys(names, nothing)
        boxes, rectangle = seen(km3d, targets.boxes)
        heatmap = self._heatmap(km3d, boxes, rectangle, targets.ignored)
        if len(boxes) == 0:
            return {"heatmap": heatmap + nothing} | dict.fromkeys(names, nothing)
        middle = (rectangle[:, :2] + rectangle[:, 2:]) / 2 / km3d.stride
        found = found_at(km3d, boxes.batch, middle.floor().long())
        rising = ramp_up(progress / self.rise)
        terms = shape_terms(found, boxes, rectangle) | {
            "turn": 0.2 * turn_loss(found.values[:, TURN], angles(found, boxes)),
            **self._place(found, boxes, rising),
        }
        return {"heatmap": heatmap + nothing} | {name: terms[name].to(nothing) for name in names}

    def _heatmap(self, output: KM3DOutput, boxes: Boxes, rectangle: Tensor, ignored: Boxes | None) -> Tensor:
        target = gaussians(output, boxes, rectangle)
        loss = penalty_reduced_focal(output.heatmap.float(), target)
        if ignored is not None and len(ignored):
            loss = loss.masked_fill(_ignored(output, ignored) & (target < 1), 0)
        return loss.sum() / max(len(boxes), 1)

    def _place(self, found: Found, boxes: Boxes, rising: float) -> dict[str, Tensor]:
        true, tensor = boxes.tensor.double(), found.boxes()
        enough = known_keypoints(found, boxes).sum(1) * 2 > _COORDINATES
        apart = ((tensor[:, :3] - true[:, :3]).square().sum(1) + 1e-12).sqrt()
        position = (apart * enough).sum() / (enough.sum() + 1)
        overlap = paired_iou_3d(tensor.detach().float(), boxes.tensor).clamp(0, 1)
        sure = nn.functional.binary_cross_entropy_with_logits(found.values[:, SURE][:, 0], overlap)
        return {"position": (rising if rising >= _LEAST else 0.0) * position, "confidence": rising * sure}


def ramp_up(share: float) -> float:
    """exp(-5 (1 - share)^2), 1 from share 1 on (Laine and Aila, ICLR 2017)."""
    return math.exp(-5 * (1 - min(max(share, 0.0), 1.0)) ** 2)


def seen(output: KM3DOutput, boxes: Boxes) -> tuple[Boxes, Tensor]:
    """The objects of a batch that can be learned, and their rectangles (N, 4) in the picture."""
    boxes = boxes[has_extent(boxes)]
    lens = output.lens(boxes.batch)
    rectangle = rectangles(boxes.tensor, lens)
    ahead = lens.to_camera(boxes.center[:, None])[:, 0, 2] > NEAR
    cell = (rectangle[:, :2] + rectangle[:, 2:]) / 2 / output.stride
    limits = cell.new_tensor([output.heatmap.shape[3], output.heatmap.shape[2]])
    there = ahead & (rectangle[:, 2:] > rectangle[:, :2]).all(1) & (cell < limits).all(1)
    return boxes[there], rectangle[there]


@torch.no_grad()
def gaussians(output: KM3DOutput, boxes: Boxes, rectangle: Tensor) -> Tensor:
    """Target heat map (B, C, H, W): 1 in the cell of each rectangle's centre, falling off around it."""
    samples, classes, height, width = output.heatmap.shape
    extent = (rectangle[:, 2:] - rectangle[:, :2]) / output.stride
    radius = gaussian_radius(extent, _OVERLAP).long().clamp(min=0)
    cell = ((rectangle[:, :2] + rectangle[:, 2:]) / 2 / output.stride).floor().long()
    owner, place = windows(cell, radius, height, width)
    sigma = (2 * radius[owner] + 1) / 6
    value = torch.exp(-((place - cell[owner]) ** 2).sum(1) / (2 * sigma**2))
    channel = boxes.batch[owner] * classes + boxes.label[owner]
    target = torch.zeros(samples * classes * height * width, device=value.device)
    target.scatter_reduce_(0, (channel * height + place[:, 1]) * width + place[:, 0], value, "amax")
    return target.view(samples, classes, height, width)


@torch.no_grad()
def _ignored(output: KM3DOutput, ignored: Boxes) -> Tensor:
    """Cells and classes (B, C, H, W) bool within rectangles of ignored boxes; label -1 is every class."""
    whole = has_extent(ignored)
    rectangle = rectangles(ignored.tensor.nan_to_num(), output.lens(ignored.batch))
    if ignored.box2d is not None:  # regions without a box in space
        rectangle = torch.where(whole[:, None], rectangle, ignored.box2d.to(rectangle))
    low, high = (rectangle / output.stride).reshape(-1, 2, 2).unbind(1)
    height, width = output.heatmap.shape[2:]
    x, y = (torch.arange(n, device=low.device) for n in (width, height))
    across, along = (x >= low[:, :1].floor()) & (x <= high[:, :1]), (y >= low[:, 1:].floor()) & (y <= high[:, 1:])
    inside = across[:, None] & along[..., None]
    classes = torch.arange(output.heatmap.shape[1], device=low.device)
    of_class = (ignored.label[:, None] == classes) | (ignored.label[:, None] < 0)
    mask = torch.zeros_like(output.heatmap)
    mask.index_add_(0, ignored.batch, (inside[:, None] & of_class[:, :, None, None]).to(mask))
    return mask > 0


def known_keypoints(found: Found, boxes: Boxes) -> Tensor:
    """(N, 9) bool: before the camera, and in the picture or not far beside it."""
    points = found.lens.to_camera(keypoints(boxes.tensor))
    size = found.lens.size[:, None]
    pixel = found.lens.pixels(points)
    near = ((pixel >= -_BEYOND * size) & (pixel <= (1 + _BEYOND) * size)).all(2)
    return near & (points[..., 2] > NEAR)


def shape_terms(found: Found, boxes: Boxes, rectangle: Tensor) -> dict[str, Tensor]:
    """`keypoints`, `size`, `offset`, `extent` of what was found at N objects with `rectangle` (N, 4) pixels."""
    points = found.lens.to_camera(keypoints(boxes.tensor))
    pixel = found.lens.pixels(points) / found.stride - found.cell[:, None]
    known = known_keypoints(found, boxes)[..., None].expand(-1, -1, 2)
    weight = depth_weight(points[:, 8, 2])[:, None, None]
    missed = (found.values[:, KEYPOINTS].reshape(-1, 9, 2) - pixel).abs() * weight
    middle = (rectangle[:, :2] + rectangle[:, 2:]) / 2 / found.stride - found.cell
    extent = (rectangle[:, 2:] - rectangle[:, :2]) / found.stride
    return {
        "keypoints": torch.where(known, missed, 0).sum() / (known.sum() + 1e-4),
        "size": 2 * (found.values[:, SIZE] - boxes.size).abs().mean(),
        "offset": (found.values[:, OFFSET] - middle).abs().mean(),
        "extent": 0.1 * (found.values[:, EXTENT] - extent).abs().mean(),
    }


def depth_weight(depth: Tensor) -> Tensor:
    """Weight (N,) of keypoints of objects at a depth in metres: pixels of near ones err more."""
    return torch.where(depth < 5, 0.01 * depth, (depth.clamp(min=5) - 4).log10() + 0.1)


def angles(found: Found, boxes: Boxes) -> Tensor:
    """(N,) observation angles of objects, by where their centre is seen."""
    centre = found.lens.pixels(found.lens.to_camera(boxes.center[:, None]))[:, 0]
    return observation(boxes.yaw.double(), found.lens.bearing(centre))


def turn_loss(values: Tensor, angle: Tensor) -> Tensor:
    """Two bins (N, 8) against observation angles (N,): whether in each, and sine and cosine from the middle if so."""
    bins = values.reshape(-1, 2, 4).float()
    away = wrapped(angle[:, None] - angle.new_tensor(BINS)).float()
    inside = away.abs() < math.pi / 2 + _WITHIN
    sort = nn.functional.cross_entropy(bins[..., :2].flatten(0, 1), inside.long().flatten())
    goal = torch.stack([away.sin(), away.cos()], 2)
    missed = nn.functional.smooth_l1_loss(bins[..., 2:], goal, reduction="none").sum(2)
    return 2 * sort + (missed * inside).sum() / inside.sum().clamp(min=1)
