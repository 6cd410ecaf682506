"""CenterPoint's detection head: objects as peaks of a bird's-eye-view heat map."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lidarfw.components.layers import conv_block
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Head
from lidarfw.types import BEV, Boxes, DataSpec, Grid, Record, Spec

# channels of the regression maps
OFFSET, HEIGHT, SIZE, YAW, VELOCITY = slice(0, 2), slice(2, 3), slice(3, 6), slice(6, 8), slice(8, 10)
HEATMAP_BIAS = -2.19  # sigmoid(-2.19) = 0.1, the focal loss's prior for an empty map
MAX_LOG_SIZE = 5.0  # exp(5) = 148 m; an untrained map must not decode to infinite boxes


@dataclass
class CenterOutput(Record):
    """Raw maps of the center head, at the resolution of `tap`; K classes in G groups."""

    heatmap: Tensor  # (B, K, H, W) logits
    regression: Tensor  # (B, G, 8 or 10, H, W): offset x, y; z; log l, w, h; sin, cos of yaw; velocity x, y
    group: Tensor  # (K,) int64, group whose regression maps a class uses
    tap: BEV

    def at(self, batch: Tensor, label: Tensor, cell: Tensor) -> Tensor:
        """Regression values (..., 8 or 10) of samples, classes and flat cells (...)."""
        return self.regression.flatten(3)[batch, self.group[label], :, cell].float()


def encode(boxes: Boxes, grid: Grid, stride: int) -> tuple[Tensor, Tensor]:
    """Cell (M, 2) column, row of each box centre and its regression target (M, 8) at that cell.

    The offset is in cells from the cell centre, so it lies in [-0.5, 0.5); z is in metres.
    """
    pixel = grid.pixel(boxes.center[:, :2], stride)
    cell = pixel.floor()
    angle = torch.stack([boxes.yaw.sin(), boxes.yaw.cos()], 1)
    return cell.long(), torch.cat([pixel - cell - 0.5, boxes.center[:, 2:], boxes.size.log(), angle], 1)


def decode(values: Tensor, cell: Tensor, grid: Grid, stride: int) -> Tensor:
    """Boxes (M, 7) x, y, z, l, w, h, yaw of regression values (M, 8 or more) at cells (M, 2) column, row."""
    index = torch.cat([torch.zeros_like(cell[:, :1]), cell.flip(1)], 1)
    size = values.new_tensor(grid.cell[:2]) * stride
    xy = grid.center(index, stride)[:, :2] + values[:, OFFSET] * size
    sin, cos = values[:, YAW].unbind(1)
    lengths = values[:, SIZE].clamp(max=MAX_LOG_SIZE).exp()
    return torch.cat([xy, values[:, HEIGHT], lengths, torch.atan2(sin, cos)[:, None]], 1)


class _GroupMaps(nn.Module):
    """The maps of one group of classes: two 3x3 convolutions each, the first ones run as a single convolution."""

    def __init__(self, channels: int, classes: int, velocity: bool) -> None:
        super().__init__()
        widths = {"heatmap": classes, "offset": 2, "height": 1, "size": 3, "yaw": 2}
        widths |= {"velocity": 2} if velocity else {}
        self.hidden = conv_block(channels, channels * len(widths))
        self.last = nn.ModuleDict({name: nn.Conv2d(channels, width, 3, padding=1) for name, width in widths.items()})
        for name, conv in self.last.items():
            nn.init.constant_(conv.get_parameter("bias"), HEATMAP_BIAS if name == "heatmap" else 0.0)

    def forward(self, shared: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.hidden(shared).chunk(len(self.last), 1)
        heatmap, *regression = (conv(part) for conv, part in zip(self.last.values(), hidden, strict=True))
        return heatmap, torch.cat(regression, 1)


def _group_numbers(classes: tuple[str, ...], groups: list[list[str]] | None) -> list[int]:
    """Group of each class; ConfigError unless every class is in exactly one group."""
    if groups is None:
        return [0] * len(classes)
    numbers = {name: number for number, names in enumerate(groups) for name in names}
    named = sorted(name for names in groups for name in names)
    if named != sorted(classes):
        raise ConfigError(
            f"groups must hold every class exactly once.\n  classes of the data: {', '.join(classes)}\n"
            f"  groups: {[list(names) for names in groups]}\n"
            f"  fix, one group per class: 'head.center.groups=[{','.join(f'[{name}]' for name in classes)}]'"
        )
    return [numbers[name] for name in classes]


class CenterHead(Head):
    """Detect objects as peaks of a heat map in bird's-eye view (CenterPoint, Yin et al., CVPR 2021, section 4).

    A shared 3x3 convolution (the tap), then per group of classes a heat map and maps of the offset in the cell,
    height, log size, sine and cosine of yaw, and velocity where asked for. `decode` takes the `max_objects` highest
    local maxima of each sample, all classes together, with a score of at least `score_threshold`.

    Raises ConfigError where `groups` does not hold every class exactly once.
    """

    defaults = {"loss": ["center"], "postprocessor": ["nms"], "metric": ["box_ap"]}

    def __init__(
        self,
        bev: Spec,
        data: DataSpec,
        *,
        channels: int = 64,
        groups: list[list[str]] | None = None,
        velocity: bool = False,
        max_objects: int = 500,
        score_threshold: float = 0.0,
    ) -> None:
        super().__init__()
        numbers = _group_numbers(data.classes, groups)
        self.max_objects, self.score_threshold = max_objects, score_threshold
        self.shared = conv_block(bev.channels, channels)
        sizes = [numbers.count(number) for number in range(len(groups or [[]]))]
        self.groups = nn.ModuleList(_GroupMaps(channels, size, velocity) for size in sizes)
        by_group = sorted(range(len(numbers)), key=lambda label: numbers[label])  # class of each stacked map
        self.register_buffer("group", torch.tensor(numbers), persistent=False)
        self.register_buffer("order", torch.tensor(by_group).argsort(), persistent=False)
        self.tap = Spec(BEV, channels, bev.stride, bev.geometry)
        self.provides = Spec(Boxes, classes=data.classes)

    group: Tensor
    order: Tensor

    def forward(self, bev: BEV) -> CenterOutput:
        """Heat maps and regression maps of bird's-eye-view features (B, C, H, W)."""
        shared = self.shared(bev.features)
        maps = [group(shared) for group in self.groups]
        heatmap = torch.cat([heat for heat, _ in maps], 1).index_select(1, self.order)
        regression = torch.stack([values for _, values in maps], 1)
        return CenterOutput(heatmap, regression, self.group, BEV(shared, bev.grid, bev.stride))

    def decode(self, output: CenterOutput) -> Boxes:
        """Boxes by sample and falling score."""
        score, label, cell = self._peaks(output.heatmap.float())
        batch, rank = (score >= self.score_threshold).nonzero().unbind(1)
        score, label, cell = score[batch, rank], label[batch, rank], cell[batch, rank]
        values = output.at(batch, label, cell)
        width = output.heatmap.shape[3]
        place = torch.stack([cell % width, cell // width], 1)
        tensor = decode(values, place, output.tap.grid, output.tap.stride)
        boxes = Boxes.from_tensor(tensor, label, score, batch, len(output.heatmap))
        return boxes.replace(velocity=values[:, VELOCITY]) if values.shape[1] > VELOCITY.start else boxes

    def _peaks(self, heatmap: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Score, class and flat cell (B, T) of the highest local maxima; score -1 fills up."""
        peak = heatmap == nn.functional.max_pool2d(heatmap, 3, stride=1, padding=1)
        logits = torch.where(peak, heatmap, -torch.inf).flatten(1)
        logit, index = logits.topk(min(self.max_objects, logits.shape[1]), dim=1)
        cells = heatmap.shape[2] * heatmap.shape[3]
        return torch.where(logit > -torch.inf, logit.sigmoid(), -1), index // cells, index % cells
