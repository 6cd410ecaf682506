"""The monocular detection head of Time3D (section 3.1): boxes in space from one picture, with an appearance vector.

Source: Li and Zhao, "Monocular 3D Detection with Geometric Constraints Embedding and Semi-supervised Training" (KM3D),
RA-L 2021.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from lidarfw.components.heads.center import HEATMAP_BIAS
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Head
from lidarfw.types import Boxes, Camera, DataSpec, Image, Record, Spec
from torch import Tensor, nn

from lidarfw_time3d.monocular import NEAR, Lens, observation, solve, wrapped

# channels of the regression maps
KEYPOINTS, OFFSET, SIZE, TURN, SURE, EXTENT = (
    slice(0, 18), slice(18, 20), slice(20, 23), slice(23, 31), slice(31, 32), slice(32, 34),
)  # fmt: skip
_WIDTHS = {"keypoints": 18, "offset": 2, "size": 3, "turn": 8, "sure": 1, "extent": 2}
BINS = (-math.pi / 2, math.pi / 2)  # middles of the two bins of the observation angle
_CAR = (3.9, 1.6, 1.5)  # l, w, h in metres that the map of sizes starts from
_LEAST, _FARTHEST = 0.1, 300.0  # metres: of a side of a box, and of its distance


@dataclass
class KM3DOutput(Record):
    """Raw maps; a cell (row i, column j) is the pixel (stride j, stride i) of the picture."""

    heatmap: Tensor  # (B, C, H, W) logits
    # (B, 34, H, W): nine keypoints x, y and the offset of the centre, in cells from the cell; l, w, h in metres; of
    # each bin of the angle the two logits out and in, the sine and cosine from its middle; logit of the overlap in
    # space; width and height of the rectangle in cells
    regression: Tensor
    embedding: Tensor  # (B, E, H, W)
    cameras: tuple[Camera, ...]
    stride: int

    def lens(self, batch: Tensor) -> Lens:
        """The cameras of objects in samples (N,)."""
        return Lens.of(self.cameras, self.heatmap.device)[batch]


@dataclass
class Found:
    """What the maps say of N cells."""

    values: Tensor  # (N, 34)
    cell: Tensor  # (N, 2) column, row
    stride: int
    lens: Lens

    @property
    def keypoints(self) -> Tensor:
        """(N, 9, 2) pixels."""
        return (self.values[:, KEYPOINTS].reshape(-1, 9, 2) + self.cell[:, None]) * self.stride

    @property
    def size(self) -> Tensor:
        """(N, 3) l, w, h in metres."""
        return self.values[:, SIZE].clamp(min=_LEAST)

    @property
    def rectangle(self) -> Tensor:
        """(N, 4) left, top, right, bottom in pixels."""
        middle, half = self.cell + self.values[:, OFFSET], self.values[:, EXTENT].clamp(min=0) / 2
        return torch.cat([middle - half, middle + half], 1) * self.stride

    def yaw(self, pixel: Tensor) -> Tensor:
        """(N,) headings of boxes whose centre is seen at a pixel (N, 2): of the bin that is more sure to be in."""
        bins = self.values[:, TURN].reshape(-1, 2, 4)
        sure = bins[:, :, 1] - bins[:, :, 0]
        chosen = bins[torch.arange(len(bins), device=bins.device), sure.argmax(1)]
        middle = bins.new_tensor(BINS)[sure.argmax(1)]
        angle = wrapped(middle + torch.atan2(chosen[:, 2], chosen[:, 3]))
        return observation(angle.double(), self.lens.bearing(pixel))

    def boxes(self) -> Tensor:
        """(N, 7) in the sensor frame."""
        keypoints = self.keypoints
        yaw = self.yaw(keypoints[:, 8])
        center = solve(keypoints, self.size.double(), yaw.detach(), self.lens)
        return torch.cat([center, self.size.double(), yaw[:, None]], 1)


class KM3D(Head):
    """Boxes in space from one picture (KM3D, sections 3.2 and 3.3; Time3D, section 3.1) and an appearance vector.

    Objects are peaks of a heat map of their rectangles' centres. Each says where the eight corners and the centre of
    its box are in the picture, its size, its observation angle (two bins) and how well the box will overlap; a
    least-squares fit of the box to its keypoints gives its place, differentiably. `decode` takes the `max_objects`
    highest peaks of each sample with a score (peak times overlap) from `score_threshold`, and leaves out those that
    are not before the camera. Boxes carry their rectangle `box2d` (pixels of the input picture), observation angle,
    and the re-ID vector as `embedding`, sampled between cells.

    Cameras must be pinholes without distortion. Raises ConfigError for others where the dataset says its camera.
    """

    example: ClassVar = {"channels": 8, "appearance": 8}
    defaults = {"loss": ["km3d"], "postprocessor": ["nms"], "metric": ["box_ap"]}

    def __init__(
        self,
        image: Spec,
        data: DataSpec,
        *,
        channels: int = 256,
        appearance: int = 64,
        max_objects: int = 128,
        score_threshold: float = 0.05,
    ) -> None:
        """Options: width of the hidden maps; of the re-ID vector; objects of a picture at most; least score."""
        super().__init__()
        camera = image.geometry
        if isinstance(camera, Camera) and camera.model != "pinhole":
            raise ConfigError(f"head km3d needs pictures of a pinhole camera, the dataset's is {camera.model}")
        self.max_objects, self.score_threshold = max_objects, score_threshold
        widths = {"heatmap": len(data.classes), **_WIDTHS, "embedding": appearance}
        self.hidden = nn.Sequential(
            nn.Conv2d(image.channels, channels * len(widths), 3, padding=1), nn.ReLU(inplace=True)
        )
        self.last = nn.ModuleDict({name: nn.Conv2d(channels, width, 1) for name, width in widths.items()})
        for name, conv in self.last.items():
            nn.init.constant_(conv.get_parameter("bias"), HEATMAP_BIAS if name == "heatmap" else 0.0)
        with torch.no_grad():
            self.last["size"].get_parameter("bias").copy_(torch.tensor(_CAR))
        self.provides = Spec(Boxes, appearance, classes=data.classes)

    def forward(self, image: Image) -> KM3DOutput:
        """Maps of picture features (B, C, H, W)."""
        hidden = self.hidden(image.features).chunk(len(self.last), 1)
        maps = {name: conv(part) for (name, conv), part in zip(self.last.items(), hidden, strict=True)}
        regression = torch.cat([maps[name] for name in _WIDTHS], 1)
        return KM3DOutput(maps["heatmap"], regression, maps["embedding"], image.cameras, image.stride)

    def decode(self, output: KM3DOutput) -> Boxes:
        """Boxes by sample and falling peak."""
        score, label, batch, cell = self._peaks(output.heatmap.float())
        found = found_at(output, batch, cell)
        score = score * found.values[:, SURE][:, 0].sigmoid()
        tensor = found.boxes()
        depth = found.lens.to_camera(tensor[:, None, :3])[:, 0, 2]
        seen = (depth > NEAR) & (depth < _FARTHEST) & tensor.isfinite().all(1) & (score >= self.score_threshold)
        boxes = Boxes.from_tensor(tensor.to(score), label, score, batch, len(output.heatmap)).replace(
            box2d=found.rectangle,
            alpha=observation(tensor[:, 6], found.lens.bearing(found.keypoints[:, 8])).to(score),
            embedding=between_cells(output.embedding.float(), batch, cell + found.values[:, OFFSET]),
        )
        return boxes[seen]

    def _peaks(self, heatmap: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Score, class, sample (N,) and cell (N, 2) column, row of the highest local maxima of each sample."""
        count, _, height, width = heatmap.shape
        peak = heatmap == nn.functional.max_pool2d(heatmap, 3, stride=1, padding=1)
        logits = torch.where(peak, heatmap, -torch.inf).flatten(1)
        logit, index = logits.topk(min(self.max_objects, logits.shape[1]), dim=1)
        batch = torch.arange(count, device=heatmap.device)[:, None].expand_as(index)
        there = logit > -torch.inf
        index, place = index[there], index[there] % (height * width)
        cell = torch.stack([place % width, torch.div(place, width, rounding_mode="floor")], 1)
        return logit[there].sigmoid(), torch.div(index, height * width, rounding_mode="floor"), batch[there], cell


def found_at(output: KM3DOutput, batch: Tensor, cell: Tensor) -> Found:
    """What the maps say at cells (N, 2) column, row of samples (N,)."""
    values = output.regression[batch, :, cell[:, 1], cell[:, 0]].float()
    return Found(values, cell, output.stride, output.lens(batch))


def between_cells(maps: Tensor, batch: Tensor, place: Tensor) -> Tensor:
    """Values (N, E) of maps (B, E, H, W) at places (N, 2) column, row between cells, by bilinear interpolation."""
    border = place.new_tensor([maps.shape[3] - 1, maps.shape[2] - 1])
    inside = place.clamp(min=0).minimum(border)
    low = inside.floor().minimum((border - 1).clamp(min=0))
    share = inside - low
    total = maps.new_zeros(len(place), maps.shape[1])
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        cell = (low + low.new_tensor([dx, dy])).minimum(border).long()
        x, y = (share if dx else 1 - share)[:, 0], (share if dy else 1 - share)[:, 1]
        total = total + maps[batch, :, cell[:, 1], cell[:, 0]] * (x * y)[:, None]
    return total
