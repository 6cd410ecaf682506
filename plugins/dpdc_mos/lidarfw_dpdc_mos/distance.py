"""What pixels show, and signed distances to the edges of what is labelled.

Source: Tang, Zhu and Sun, Remote Sensing 2025, 17(2), 195, equations 13-18, in the form of Kervadec et al., "Boundary
loss for highly unbalanced segmentation", MIDL 2019, section 2.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from lidarfw.types import Points, RangeImage
from scipy.ndimage import distance_transform_edt
from torch import Tensor

Mask = npt.NDArray[np.bool_]
Distances = npt.NDArray[np.float32]


def on_pixels(values: Tensor, image: RangeImage, points: Points, empty: float = 0) -> Tensor:
    """(B, H, W, ...) values (N, ...) of the point that each pixel shows, `empty` where it has none.

    `points` are those that the image was made of; points that others hide do not count.
    """
    batch, height, width = image.mask.shape
    places = image.xyz.permute(0, 2, 3, 1).reshape(-1, 3)
    inside = (image.pixel >= 0).nonzero()[:, 0]
    shown = inside[(places[image.pixel[inside]] == points.xyz[inside]).all(1)]
    table = values.new_full((batch * height * width, *values.shape[1:]), empty)
    return table.index_copy(0, image.pixel[shown], values[shown]).view(batch, height, width, *values.shape[1:])


def distance_maps(labels: Tensor, classes: int, spacing: tuple[float, float] = (1.0, 1.0), wrap: bool = True) -> Tensor:
    """(B, K, H, W) float32 signed distance to the edge of class 1 where there are two, else of each of the K classes.

    `labels` (B, H, W) int64; unlabelled pixels (-1) count as outside. Of an image in which a class does not occur, or
    nothing else does, the map is 0.
    """
    wanted = [1] if classes == 2 else list(range(classes))
    known = labels.cpu().numpy()
    maps = [[signed_distance(image == number, spacing, wrap) for number in wanted] for image in known]
    return torch.from_numpy(np.array(maps, dtype=np.float32)).to(labels.device)


def signed_distance(inside: Mask, spacing: tuple[float, float] = (1.0, 1.0), wrap: bool = False) -> Distances:
    """(H, W) distance to the edge of a mask: to the nearest pixel inside for those outside, and for those inside
    minus the distance to the nearest one outside, less 1 (one pixel of the finer axis): 0 on the edge.

    phi_G of the level-set form (eq. 18) with the sign of Kervadec et al.: the paper calls phi positive inside, under
    which its loss would push probabilities away from the object. `spacing` is the size of a pixel (row, column);
    with `wrap` columns go round. A mask without an edge gives 0 everywhere.
    """
    if not inside.any() or inside.all():
        return np.zeros(inside.shape, np.float32)
    width = inside.shape[1]
    tiled = np.tile(inside, (1, 3)) if wrap else inside
    outer = distance_transform_edt(~tiled, spacing)
    inner = distance_transform_edt(tiled, spacing)
    signed = np.where(tiled, min(spacing) - inner, outer)
    return np.asarray(signed[:, width : 2 * width] if wrap else signed, dtype=np.float32)
