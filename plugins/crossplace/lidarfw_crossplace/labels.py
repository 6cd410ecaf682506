"""One set of classes for pictures and scans (paper, table 2), and its colours."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

NOTHING = 255  # no data; id 0 is the road
UNKNOWN, ROAD = 15, 0
CLASSES = (
    "road", "sidewalk", "building", "wall/fence", "pole/traffic light", "traffic sign", "vegetation", "terrain",
    "person", "rider", "car", "truck", "other-vehicle", "motorcycle", "bicycle", "unknown",
)  # fmt: skip
CITYSCAPES = {  # in the order of its train ids
    "road": 0, "sidewalk": 1, "building": 2, "wall": 3, "fence": 3, "pole": 4, "traffic light": 4, "traffic sign": 5,
    "vegetation": 6, "terrain": 7, "sky": 15, "person": 8, "rider": 9, "car": 10, "truck": 11, "bus": 12, "train": 12,
    "motorcycle": 13, "bicycle": 14,
}  # fmt: skip
SEMANTIC_KITTI = {  # in the order of its learning ids, unlabeled first
    "unlabeled": 15, "car": 10, "bicycle": 14, "motorcycle": 13, "truck": 11, "other-vehicle": 12, "person": 8,
    "bicyclist": 9, "motorcyclist": 9, "road": 0, "parking": 15, "sidewalk": 1, "other-ground": 7, "building": 2,
    "fence": 3, "vegetation": 6, "trunk": 6, "terrain": 7, "pole": 4, "traffic-sign": 5,
}  # fmt: skip
KITTI_360 = {  # its label ids, which are those of Cityscapes and a few more; all others are unknown
    7: 0, 8: 1, 9: 15, 11: 2, 12: 3, 13: 3, 17: 4, 18: 4, 19: 4, 20: 5, 21: 6, 22: 7, 23: 15, 24: 8, 25: 9, 26: 10,
    27: 11, 28: 12, 29: 12, 30: 12, 31: 12, 32: 13, 33: 14, 34: 2, 35: 3, 36: 5, 37: 4, 38: 4,
}  # fmt: skip
PALETTE = (
    (128, 64, 128), (244, 35, 232), (70, 70, 70), (102, 102, 156), (153, 153, 153), (220, 220, 0), (107, 142, 35),
    (152, 251, 152), (220, 20, 60), (255, 0, 0), (0, 0, 142), (0, 0, 70), (0, 60, 100), (0, 0, 230), (119, 11, 32),
    (0, 0, 0),
)  # fmt: skip


@functools.cache
def kitti_360_table() -> Tensor:
    """(256,) uint8: unified class of every KITTI-360 id."""
    table = torch.full((256,), UNKNOWN, dtype=torch.uint8)
    table[list(KITTI_360)] = torch.tensor(list(KITTI_360.values()), dtype=torch.uint8)
    return table


def table_of(names: Iterable[str]) -> Tensor:
    """(K,) uint8: unified class of each name, of Cityscapes or of SemanticKITTI; names of neither are unknown."""
    known = CITYSCAPES | SEMANTIC_KITTI
    return torch.tensor([known.get(name.lower(), UNKNOWN) for name in names], dtype=torch.uint8)


def coloured(labels: Tensor) -> Tensor:
    """Unified classes (H, W) uint8 -> colours (3, H, W) 0..1; black for unknown and for no data."""
    table = torch.zeros(256, 3)
    table[: len(PALETTE)] = torch.tensor(PALETTE) / 255
    return table[labels.long()].permute(2, 0, 1).contiguous()


def simulated_labels(
    labels: Tensor, rng: np.random.Generator, *, jitter: float = 0.05, confusion: float = 0.03
) -> Tensor:
    """What a network might say of true classes (H, W): some pixels take those of a neighbour, some regions another one.

    jitter: share of the pixels that look one or two pixels aside, which shows at the borders of regions only.
    confusion: share of the connected regions that get the class of another region of the picture.
    """
    from scipy import ndimage

    known = labels.numpy()
    rows, columns = np.indices(known.shape)
    aside = rng.integers(-2, 3, (2, *known.shape)) * (rng.random(known.shape) < jitter)
    rows = (rows + aside[0]).clip(0, known.shape[0] - 1)
    moved = known[rows, (columns + aside[1]) % known.shape[1]]
    said, present = moved.copy(), np.unique(known[known != NOTHING])
    for name in present:
        region, count = ndimage.label(moved == name)
        wrong = np.r_[False, rng.random(count) < confusion]
        other = np.r_[0, rng.choice(present, count)]
        said = np.where(wrong[region], other[region], said)
    return torch.from_numpy(said.astype(np.uint8))
