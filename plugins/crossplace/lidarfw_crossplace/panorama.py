"""Panoramas of scans and of cameras in one convention: what is ahead in the middle column, what is left to its left.

Paper 3.1 to 3.3. A panorama is a `RangeView`: row 0 is the highest elevation, column 0 looks backward, columns run
clockwise. `camera_of` is the same view as an equirectangular `Camera`, so both directions of geometry are the core's.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from lidarfw.errors import DataError
from lidarfw.types import Camera, RangeView
from torch import Tensor
from torch.nn import functional as F

from lidarfw_crossplace.alignment import Alignment, azimuth_of, place_of, rays_of

FAR = 1e6  # metres: so far away that it does not matter where on the vehicle a camera sits
_AXES = ((0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))  # sensor -> camera


def camera_of(view: RangeView) -> Camera:
    """The equirectangular camera that sees what the range view sees, pixel by pixel."""
    across, down = view.width / (2 * math.pi), view.height / (view.up - view.down)
    return Camera(
        "equirectangular",
        view.width,
        view.height,
        (across, down, view.width / 2 - 0.5, view.up * down - 0.5),
        (),
        _AXES,
    )


def sphere(width: int) -> RangeView:
    """The whole sphere, `width` x `width` / 2 pixels: what networks on pictures get to see."""
    return RangeView(width // 2, width, math.pi / 2, -math.pi / 2)


# scans


def interpolate_columns(
    values: Tensor, mask: Tensor, gap: int, distance: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Fill gaps of at most `gap` rows between two known pixels of a column (paper 3.2); negative for any gap.

    Numbers are interpolated linearly; with `distance` (H, W) the values are labels and the nearer row is copied, of two
    equally near rows that of the smaller distance. Above the first and below the last known row nothing is filled.

    Args:
        values: (C, H, W).
        mask: (H, W) bool, pixel is known.

    Returns:
        Values with 0 where nothing is known, and the mask of what is known now.
    """
    height = len(mask)
    row = torch.arange(height, device=mask.device)[:, None].expand_as(mask)
    above = torch.where(mask, row, -1).cummax(0).values
    below = torch.where(mask, row, height).flip(0).cummin(0).values.flip(0)
    between = (above >= 0) & (below < height) & ~mask
    if gap >= 0:
        between &= below - above - 1 <= gap
    above, below = torch.where(between, above, row), torch.where(between, below, row)
    upper, lower = (values.gather(1, rows.expand_as(values)) for rows in (above, below))
    if distance is None:
        share = (row - above) / (below - above).clamp(min=1)
        filled = upper + (lower - upper) * share.to(values.dtype)
    else:
        near = distance.gather(0, above) <= distance.gather(0, below)
        first = (row - above < below - row) | ((row - above == below - row) & near)
        filled = torch.where(first, upper, lower)
    known = mask | between
    return torch.where(known, filled, 0), known


# cameras


@dataclass(frozen=True, eq=False)
class Stitcher:
    """Where each pixel of a panorama lies in the pictures of the cameras of a rig, and how much each counts there."""

    place: Tensor  # (K, H, W, 2) pixels in the picture of each camera, as grid_sample wants them (-1..1)
    weight: Tensor  # (K, H, W), adds up to 1 where any camera sees, else 0

    @property
    def covered(self) -> Tensor:
        """(H, W) bool: some camera sees this pixel."""
        return self.weight.sum(0) > 0

    def blend(self, pictures: Sequence[Tensor]) -> Tensor:
        """One panorama (C, H, W) of a picture (C, h, w) from each camera; 0 where none sees."""
        seen = self.alone(pictures)
        return torch.stack([part * weight for part, weight in zip(seen, self.weight, strict=True)]).sum(0)

    def pick(self, pictures: Sequence[Tensor]) -> Tensor:
        """The same for labels and distances, which must not be mixed: a pixel of the camera that counts most."""
        seen = torch.stack(self.alone(pictures, "nearest"))
        best = self.weight.argmax(0).expand(1, *seen.shape[1:])
        return torch.where(self.covered, seen.gather(0, best)[0], 0)

    def alone(self, pictures: Sequence[Tensor], mode: str = "bilinear") -> list[Tensor]:
        """What each camera gives by itself, (C, H, W); where it does not see, anything."""
        return [
            F.grid_sample(picture[None], place[None], mode, "border", align_corners=True)[0]
            for picture, place in zip(pictures, self.place, strict=True)
        ]


@functools.lru_cache(maxsize=16)
def stitcher(
    view: RangeView,
    cameras: tuple[Camera, ...],
    fov: float,
    radius: float = FAR,
    alignment: Alignment = Alignment(),  # noqa: B008 - frozen
) -> Stitcher:
    """The stitcher of a rig (paper 3.1), aligned by calibration, the second camera also by what both see.

    A camera counts by how far inside its field of view a pixel lies, which for two opposite fisheyes blends linearly
    over their overlap.

    Args:
        fov: field of view of the cameras in radians; beyond, a picture is not used.
        radius: metres to what is seen; `FAR` leaves out where the cameras sit.
        alignment: of the second camera.

    DataError where the cameras see no pixel of the panorama.
    """
    pixels = torch.stack(torch.meshgrid(torch.arange(view.height), torch.arange(view.width), indexing="ij"), -1)
    rays = view.direction(*pixels.double().unbind(2)).reshape(-1, 3)
    moved = [_moved(rays, camera, alignment) if number == 1 else rays for number, camera in enumerate(cameras)]
    found = [_seen_by(camera, seen * radius, fov) for camera, seen in zip(cameras, moved, strict=True)]
    size = (len(cameras), view.height, view.width)
    weight = torch.stack([inside for _, inside in found]).view(size)
    if not bool(weight.any()):
        raise DataError("no camera sees any pixel of the panorama. Is the calibration that of this rig?")
    weight = weight / weight.sum(0).clamp(min=1e-12)
    return Stitcher(torch.stack([place for place, _ in found]).view(*size, 2).float(), weight.float())


def _moved(rays: Tensor, camera: Camera, alignment: Alignment) -> Tensor:
    """Where a camera shows what lies in these directions (N, 3)."""
    axis = azimuth_of(camera)
    return rays_of(alignment.moved(place_of(rays, axis)), axis) if alignment.coefficients else rays


def _seen_by(camera: Camera, rays: Tensor, fov: float) -> tuple[Tensor, Tensor]:
    """Places (N, 2) in -1..1 of directions in the picture of a camera, and how far inside its view they lie (N,)."""
    uv, _, valid = camera.project(rays)
    ahead = F.normalize(camera.to_camera(rays), dim=1)[:, 2].clamp(-1, 1)
    whole = camera.model == "equirectangular"
    inside = torch.ones_like(ahead) if whole else (fov / 2 - torch.acos(ahead)).clamp(min=0)
    size = uv.new_tensor([camera.width, camera.height]) - 1
    return torch.where(valid[:, None], 2 * uv / size - 1, 0), inside * valid


def grey(picture: Tensor) -> Tensor:
    """(3, H, W) RGB -> (1, H, W)."""
    return torch.einsum("chw,c->hw", picture, picture.new_tensor([0.299, 0.587, 0.114]))[None]


def depth_from_inverse(inverse: Tensor, known: Tensor) -> Tensor:
    """Depth 0..1, far = 1, from inverse depth (H, W) of unknown scale and offset, as networks for single pictures give.

    1 - (inverse - low) / (high - low), low and high the 1st and 99th percentile of what is known. The paper leaves this
    step out; without it the power would stretch what is near (its table 8 shows that far things gain).
    """
    values = inverse[known]
    if not len(values):
        return torch.zeros_like(inverse)
    low, high = torch.quantile(values.double(), values.new_tensor([0.01, 0.99]).double()).to(values)
    depth = (1 - (inverse - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)
    return torch.where(known, depth, 0)


def simulated_inverse_depth(
    distance: Tensor, rng: np.random.Generator, *, noise: float = 0.1, blur: float = 2.0
) -> Tensor:
    """What a network for single pictures might say of true distances (H, W): a / r + b, noisy and blurred.

    a and b are others for each picture, the noise is lognormal; distance 0 is the sky, infinitely far.
    """
    import cv2

    scale, offset = rng.uniform(0.5, 2.0), rng.uniform(0.0, 0.5)
    metres = distance.numpy()
    near = np.divide(1.0, metres, out=np.zeros_like(metres), where=metres > 0)
    rough = (scale * near * rng.lognormal(0, noise, near.shape) + offset).astype(np.float32)
    return torch.from_numpy(cv2.GaussianBlur(rough, (0, 0), blur)) if blur else torch.from_numpy(rough)


def inpainted(values: Tensor, hole: Tensor) -> Tensor:
    """A map (H, W) of values 0..1 with a hole filled from its border (Telea 2004), in steps of 1 / 255."""
    import cv2

    if not bool(hole.any()):
        return values
    rough = (values * 255).round().clamp(0, 255).to(torch.uint8).numpy()
    filled = cv2.inpaint(rough, hole.to(torch.uint8).numpy(), 3, cv2.INPAINT_TELEA)
    return torch.where(hole, torch.from_numpy(filled).to(values) / 255, values)


# alignment without calibration


def rig_of(cameras: Mapping[str, Camera], names: Sequence[str]) -> tuple[Camera, ...]:
    """The cameras of these names; DataError names one that has no calibration."""
    missing = [name for name in names if name not in cameras]
    if missing:
        raise DataError(f"the frame has no camera {missing[0]}; it has {', '.join(cameras) or 'none'}")
    return tuple(cameras[name] for name in names)
