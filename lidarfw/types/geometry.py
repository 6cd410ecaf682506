"""The only owners of metric <-> index: `Grid` (voxels, BEV), `RangeView` (range images), `Camera` (pictures)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

from lidarfw._lazy import LazyModule
from lidarfw.errors import GeometryError

if TYPE_CHECKING:
    import numpy as np
    import torch
    from torch import Tensor
else:
    np = LazyModule("numpy")
    torch = LazyModule("torch")

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Grid:
    """A box of space cut into cells. Metric values are x, y, z in metres; index values are z, y, x.

    A point belongs to cell floor((point - lower) / cell); `lower` is inside, `upper` is not.
    At a stride s, cell i covers the grid cells [i*s, (i+1)*s).
    """

    lower: Triple
    upper: Triple
    cell: Triple

    def __post_init__(self) -> None:
        for axis, low, high, size in zip("xyz", self.lower, self.upper, self.cell, strict=True):
            if not size > 0:
                raise GeometryError(f"grid: cell size along {axis} must be positive, got {size}")
            if not high - low >= size / 2:
                raise GeometryError(f"grid: range along {axis} is empty: lower {low}, upper {high}, cell {size}")

    def shape(self, strides: int | tuple[int, int, int] = 1) -> tuple[int, int, int]:
        """Cells (D, H, W) at `strides` (z, y, x, or one number): rounded at stride 1, then rounded up."""
        each = (strides,) * 3 if isinstance(strides, int) else strides
        cells = [round((h - l) / c) for l, h, c in zip(self.lower, self.upper, self.cell, strict=True)]
        depth, height, width = (-(-n // s) for n, s in zip(reversed(cells), each, strict=True))
        return depth, height, width

    def index(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Cell (N, 3) int64 z, y, x of points (N, 3) at stride 1, and whether each lies inside (N,) bool.

        Divides by the cell size: multiplying by its reciprocal moves points across edges.
        """
        cell = torch.floor((xyz - xyz.new_tensor(self.lower)) / xyz.new_tensor(self.cell))
        size = cell.new_tensor(self.shape()[::-1])
        inside = ((cell >= 0) & (cell < size)).all(1)  # False for NaN
        return torch.where(inside[:, None], cell, 0).long().flip(1), inside

    def center(self, index: Tensor, strides: int | tuple[int, int, int] = 1) -> Tensor:
        """Centre (N, 3) x, y, z in metres of cells (N, 3) z, y, x at `strides`."""
        each = (strides,) * 3 if isinstance(strides, int) else strides
        lower = torch.tensor(self.lower, device=index.device)
        cell = torch.tensor([c * s for c, s in zip(self.cell, reversed(each), strict=True)], device=index.device)
        return (index.flip(1) + 0.5) * cell + lower

    def pixel(self, xy: Tensor, stride: int = 1) -> Tensor:
        """Continuous BEV coordinates (..., 2) column, row of metric x, y (..., 2): cell i spans [i, i + 1)."""
        cell = xy.new_tensor(self.cell[:2]) * stride
        return (xy - xy.new_tensor(self.lower[:2])) / cell

    def bev_centers(self, stride: int = 1, device: torch.device | str = "cpu") -> Tensor:
        """Metric centres (H, W, 2) x, y of the BEV cells at a stride."""
        _, height, width = self.shape(stride)
        rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        flat = torch.stack([torch.zeros_like(rows), rows, columns], -1).reshape(-1, 3)
        return self.center(flat.to(device), stride)[:, :2].view(height, width, 2)


@dataclass(frozen=True)
class RangeView:
    """A spherical image of a spinning LiDAR.

    Column 0 looks backward (azimuth +pi) and columns run clockwise: column = (1 - azimuth/pi) * W / 2.
    Row 0 is the highest elevation. Angles in radians.
    """

    height: int
    width: int
    up: float  # elevation of the upper edge of row 0
    down: float  # elevation of the lower edge of the last row
    clip: bool = False  # points above the first or below the last row count to that row; else they are outside

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise GeometryError(f"range view: height and width must be positive, got {self.height} x {self.width}")
        if not -math.pi / 2 <= self.down < self.up <= math.pi / 2:
            raise GeometryError(
                f"range view: need -pi/2 <= down < up <= pi/2, got down {self.down}, up {self.up}; angles are radians"
            )

    def project(self, xyz: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pixel of points (N, 3): row (N,) int64, column (N,) int64, range (N,) metres, inside (N,) bool.

        Inside is False above `up` and at or below `down` (unless `clip`), at the origin and where xyz is not finite;
        row and column are 0 there.
        """
        x, y, z = (axis.contiguous() for axis in xyz.unbind(1))  # several times as fast as strided columns
        flat = x * x + y * y
        distance = torch.sqrt(flat + z * z)
        elevation, azimuth = torch.atan2(z, torch.sqrt(flat)), torch.atan2(y, x)
        row = torch.floor((self.up - elevation) / (self.up - self.down) * self.height)
        row = row.clamp(0, self.height - 1) if self.clip else row
        column = torch.floor((1 - azimuth / math.pi) * (self.width / 2)) % self.width
        inside = (row >= 0) & (row < self.height) & (distance > 0) & torch.isfinite(distance)
        return torch.where(inside, row, 0).long(), torch.where(inside, column, 0).long(), distance, inside

    def direction(self, row: Tensor, column: Tensor) -> Tensor:
        """Unit vectors (..., 3) through the centres of pixels (...), in the sensor frame."""
        elevation = self.up - (row + 0.5) / self.height * (self.up - self.down)
        azimuth = (1 - (column + 0.5) * 2 / self.width) * math.pi
        flat = torch.cos(elevation)
        return torch.stack([flat * torch.cos(azimuth), flat * torch.sin(azimuth), torch.sin(elevation)], -1)


_COEFFICIENTS = {"pinhole": (0, 4, 5), "mei": (1, 5), "fisheye": (0, 4), "equirectangular": (0,)}
_IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Camera:
    """A calibrated camera. Plain numbers only, so that it can stand in a config and a checkpoint.

    The camera frame is x right, y down, z ahead. Pixel coordinates are u right, v down, and whole numbers are
    pixel centres (as in OpenCV): the picture covers [-0.5, width - 0.5) x [-0.5, height - 0.5).

    ===============  =====================  ==============================================================
    model            distortion             source
    ===============  =====================  ==============================================================
    pinhole          k1, k2, p1, p2 (, k3)  Brown-Conrady radial and tangential, as in OpenCV
    mei              xi (, k1, k2, p1, p2)  Mei and Rives, ICRA 2007: unit sphere seen from (0, 0, -xi)
    fisheye          k1, k2, k3, k4         Kannala and Brandt, PAMI 2006: polynomial of the angle
    equirectangular  none                   u = fx * azimuth + cx, v = fy * (angle below the horizon) + cy
    ===============  =====================  ==============================================================

    An empty `distortion` means none (mei needs xi), an empty `from_sensor` the identity.
    """

    model: str
    width: int  # pixels
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels (per radian for equirectangular)
    distortion: tuple[float, ...] = ()
    from_sensor: tuple[tuple[float, ...], ...] = ()  # 4 x 4, sensor -> camera; may mirror and scale

    def __post_init__(self) -> None:
        if self.model not in _COEFFICIENTS:
            raise GeometryError(f"camera: no model {self.model!r}; there are {', '.join(_COEFFICIENTS)}")
        if self.width < 1 or self.height < 1:
            raise GeometryError(f"camera: width and height must be positive, got {self.width} x {self.height}")
        numbers = [*self.intrinsics, *self.distortion, *(value for row in self.from_sensor for value in row)]
        if not all(math.isfinite(value) for value in numbers):
            raise GeometryError(f"camera: calibration has a value that is not finite: {self}")
        if len(self.intrinsics) != 4 or self.intrinsics[0] == 0 or self.intrinsics[1] == 0:
            raise GeometryError(f"camera: intrinsics are fx, fy, cx, cy with fx, fy not 0, got {self.intrinsics}")
        if len(self.distortion) not in _COEFFICIENTS[self.model]:
            counts = " or ".join(str(count) for count in _COEFFICIENTS[self.model])
            raise GeometryError(f"camera: {self.model} takes {counts} distortion values, got {len(self.distortion)}")
        if self.model == "mei" and self.distortion[0] < 0:
            raise GeometryError(f"camera: xi of a mei camera must not be negative, got {self.distortion[0]}")
        _check_similarity(self.from_sensor or _IDENTITY)

    def to_camera(self, xyz: Tensor) -> Tensor:
        """Points (N, 3) of the sensor frame in the camera frame, metres."""
        matrix = xyz.new_tensor(self.from_sensor or _IDENTITY)
        return xyz @ matrix[:3, :3].T + matrix[:3, 3]

    def project(self, xyz: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Image of points (N, 3) of the sensor frame: uv (N, 2) pixels, depth (N,) metres, valid (N,) bool.

        Depth is z of the camera frame for pinhole, the distance to the camera for the models that can look
        sideways. uv is NaN where a point has no image at all (behind a pinhole camera, beyond the angle up to
        which the distortion is one-to-one); valid means that it lies within the picture.
        """
        xyz = self.to_camera(xyz)
        plane, imaged = self._to_plane(xyz)
        focal, centre = self._focal_and_centre(plane)
        uv = torch.where(imaged[:, None], plane * focal + centre, torch.nan)
        valid = ((uv >= -0.5) & (uv < uv.new_tensor([self.width, self.height]) - 0.5)).all(1)
        return uv, xyz[:, 2] if self.model == "pinhole" else xyz.norm(dim=1), valid

    def rays(self, uv: Tensor) -> Tensor:
        """Unit directions (N, 3) in the camera frame of pixels (N, 2); NaN for pixels that no point projects to."""
        focal, centre = self._focal_and_centre(uv)
        plane = (uv - centre) / focal
        if self.model == "equirectangular":
            return _from_angles(plane)
        if self.model == "fisheye":
            return _fisheye_rays(plane, self.distortion)
        xi, coefficients = self._mirror_and_distortion()
        return _lift(_undistort(plane, coefficients), xi)

    def sensor_rays(self, uv: Tensor) -> tuple[Tensor, Tensor]:
        """The rays of pixels (N, 2) in the sensor frame: camera position (3,) metres, unit directions (N, 3)."""
        inverse = torch.linalg.inv(uv.new_tensor(self.from_sensor or _IDENTITY))
        directions = self.rays(uv) @ inverse[:3, :3].T
        return inverse[:3, 3], torch.nn.functional.normalize(directions, dim=1)

    def transformed(self, matrix: Tensor | np.ndarray) -> Camera:
        """The same camera for a sensor frame that was moved: points p become matrix @ p and keep their pixels.

        `matrix` (4, 4) turns, moves, mirrors or scales evenly, as augmentations do.
        """
        old = np.array(self.from_sensor or _IDENTITY)
        new = old @ np.linalg.inv(np.asarray(matrix, dtype=np.float64))
        return replace(self, from_sensor=tuple(tuple(float(value) for value in row) for row in new))

    def scaled(self, factor: float) -> Camera:
        """The camera of the picture resized to round(width * factor) x round(height * factor)."""
        width, height = round(self.width * factor), round(self.height * factor)
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy = self.intrinsics
        intrinsics = (fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5)
        return replace(self, width=width, height=height, intrinsics=intrinsics)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of the part of the picture that starts at pixel (left, top); may reach beyond the picture."""
        fx, fy, cx, cy = self.intrinsics
        return replace(self, width=width, height=height, intrinsics=(fx, fy, cx - left, cy - top))

    def _focal_and_centre(self, like: Tensor) -> tuple[Tensor, Tensor]:
        values = like.new_tensor(self.intrinsics)
        return values[:2], values[2:]

    def _mirror_and_distortion(self) -> tuple[float, tuple[float, ...]]:
        return (self.distortion[0], self.distortion[1:]) if self.model == "mei" else (0.0, self.distortion)

    def _to_plane(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Image plane coordinates (N, 2) for focal length 1, distorted, and whether the point has an image."""
        if self.model == "equirectangular":
            return _angles(xyz)
        if self.model == "fisheye":
            return _fisheye_plane(xyz, self.distortion)
        xi, coefficients = self._mirror_and_distortion()
        plane, imaged = _mirror_plane(xyz, xi)
        radius = plane.norm(dim=1)
        return _distort(plane, coefficients), imaged & (radius < _one_to_one(_radial_part(coefficients)))


def _check_similarity(matrix: tuple[tuple[float, ...], ...]) -> None:
    """GeometryError unless the matrix is 4 x 4: a rotation or reflection times one scale, and a translation."""
    if [len(row) for row in matrix] != [4] * 4 or tuple(matrix[3]) != (0, 0, 0, 1):
        raise GeometryError(f"camera: from_sensor must be 4 x 4 with last row 0 0 0 1, got {matrix}")
    rows = [row[:3] for row in matrix[:3]]
    scale = sum(value * value for row in rows for value in row) / 3
    gram = [[sum(a * b for a, b in zip(r, s, strict=True)) - scale * (r is s) for s in rows] for r in rows]
    if not max(abs(value) for row in gram for value in row) <= 1e-3 * scale or scale < 1e-12:
        raise GeometryError(f"camera: the rotation in from_sensor is not orthogonal: {rows}")


def _radial_part(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """k1, k2 (, k3) of the OpenCV order k1, k2, p1, p2 (, k3)."""
    return coefficients[:2] + coefficients[4:]


def _polynomial(square: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """1 + k1 s + k2 s^2 + ... at s = `square`."""
    total = torch.zeros_like(square)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * square
    return total + 1


def _derivative_coefficients(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Of f(r) = r (1 + k1 r^2 + k2 r^4 ...): f'(r) = 1 + 3 k1 r^2 + 5 k2 r^4 ..."""
    return tuple((2 * power + 3) * coefficient for power, coefficient in enumerate(coefficients))


@lru_cache(maxsize=256)
def _one_to_one(coefficients: tuple[float, ...], end: float = math.inf) -> float:
    """The radius up to which r (1 + k1 r^2 + ...) grows, at most `end`."""
    roots = np.roots([*reversed(_derivative_coefficients(coefficients)), 1.0])
    squares = [float(root.real) for root in roots if abs(root.imag) < 1e-9 * abs(root) and root.real > 0]
    return min([end, *(math.sqrt(square) for square in squares)])


def _invert_radial(value: Tensor, coefficients: tuple[float, ...], end: float = math.inf) -> Tensor:
    """r >= 0 with r (1 + k1 r^2 + ...) = `value`, at most where that stops to grow: Newton steps kept in a bracket."""
    slopes = _derivative_coefficients(coefficients)
    low, high = torch.zeros_like(value), torch.full_like(value, min(_one_to_one(coefficients, end), 1e6))
    goal = torch.minimum(value, high * _polynomial(high**2, coefficients))
    radius = torch.minimum(value, high)
    for _ in range(60):
        error = radius * _polynomial(radius**2, coefficients) - goal
        if bool((error.abs() <= 4 * torch.finfo(value.dtype).eps * (1 + goal)).all()):
            break
        low, high = torch.where(error < 0, radius, low), torch.where(error > 0, radius, high)
        step = radius - error / _polynomial(radius**2, slopes)
        radius = torch.where((step > low) & (step < high), step, (low + high) / 2)
    return radius


def _distort(plane: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Radial and tangential distortion of ideal points (N, 2)."""
    if not coefficients:
        return plane
    square = (plane**2).sum(1, keepdim=True)
    p1, p2 = coefficients[2:4]
    product = 2 * plane.prod(1, keepdim=True) * plane.new_tensor([p1, p2])
    tangential = product + (square + 2 * plane**2) * plane.new_tensor([p2, p1])
    return plane * _polynomial(square, _radial_part(coefficients)) + tangential


def _undistort(goal: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Inverse of `_distort`, NaN where there is none: the radial inverse, then Newton steps in two dimensions."""
    if not coefficients:
        return goal
    radial = _radial_part(coefficients)
    radius = goal.norm(dim=1, keepdim=True)
    start = _invert_radial(radius, radial).clamp(max=0.99 * _one_to_one(radial))  # at the limit there is no slope
    plane = goal * start / radius.clamp(min=1e-30)
    tolerance = 16 * torch.finfo(goal.dtype).eps * (1 + radius[:, 0])
    active = torch.arange(len(goal), device=goal.device)
    for _ in range(40):  # one or two on most of the picture; halving near the limit, where the slope vanishes
        error = _distort(plane[active], coefficients) - goal[active]
        wrong = error.norm(dim=1) > tolerance[active]
        active = active[wrong]
        if not len(active):
            break
        plane[active] = plane[active] - _newton_step(plane[active], error[wrong], coefficients)
    found = ((_distort(plane, coefficients) - goal).norm(dim=1) <= tolerance) & (
        plane.norm(dim=1) < _one_to_one(radial)
    )
    return torch.where(found[:, None], plane, torch.nan)


def _newton_step(plane: Tensor, error: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Solve J step = error for the (symmetric) Jacobian J of `_distort`."""
    (x, y), (ex, ey) = plane.unbind(1), error.unbind(1)
    radial, (p1, p2) = _radial_part(coefficients), coefficients[2:4]
    square = x**2 + y**2
    factor = _polynomial(square, radial)
    slope = sum((power + 1) * k * square**power for power, k in enumerate(radial))
    xx = factor + 2 * slope * x**2 + 2 * p1 * y + 6 * p2 * x
    yy = factor + 2 * slope * y**2 + 6 * p1 * y + 2 * p2 * x
    xy = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y
    determinant = xx * yy - xy**2
    return torch.stack([yy * ex - xy * ey, xx * ey - xy * ex], 1) / determinant[:, None]


def _mirror_plane(xyz: Tensor, xi: float) -> tuple[Tensor, Tensor]:
    """Perspective image from (0, 0, -xi) of the points on the unit sphere; xi = 0 is the pinhole camera."""
    distance = xyz.norm(dim=1) if xi else torch.ones_like(xyz[:, 0])
    depth = xyz[:, 2] + xi * distance
    nearest = 0.0 if xi == 0 else -min(xi, 1 / xi)  # beyond this cosine the sphere hides the point, or depth <= 0
    imaged = (xyz[:, 2] > nearest * distance) & (depth > 0)
    return xyz[:, :2] / torch.where(imaged, depth, 1)[:, None], imaged


def _lift(plane: Tensor, xi: float) -> Tensor:
    """Inverse of `_mirror_plane` as unit directions (Mei and Rives 2007, equation 4), NaN where there is none."""
    square = (plane**2).sum(1, keepdim=True)
    factor = (xi + torch.sqrt(1 + (1 - xi**2) * square)) / (square + 1)
    ahead = factor - xi if xi else torch.ones_like(factor)
    return torch.nn.functional.normalize(torch.cat([plane * (factor if xi else 1), ahead], 1), dim=1)


def _fisheye_plane(xyz: Tensor, coefficients: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Kannala-Brandt: the distance from the image centre is a polynomial of the angle to the optical axis."""
    side = (xyz[:, :2] ** 2).sum(1).clamp(min=torch.finfo(xyz.dtype).tiny).sqrt()
    angle = torch.atan2(side, xyz[:, 2])
    scale = angle * _polynomial(angle**2, coefficients) / side
    imaged = (angle < _one_to_one(coefficients, math.pi)) & (xyz != 0).any(1)
    return xyz[:, :2] * scale[:, None], imaged


def _fisheye_rays(plane: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    radius = plane.norm(dim=1, keepdim=True)
    angle = _invert_radial(radius, coefficients, math.pi)
    limit = _one_to_one(coefficients, math.pi)
    edge = limit * _polynomial(radius.new_tensor(limit**2), coefficients)
    angle = torch.where(radius <= edge, angle, torch.nan)
    return torch.cat([plane / radius.clamp(min=1e-30) * torch.sin(angle), torch.cos(angle)], 1)


def _angles(xyz: Tensor) -> tuple[Tensor, Tensor]:
    """Azimuth to the right of z and angle below the horizon (N, 2), radians."""
    below = torch.atan2(xyz[:, 1], xyz[:, ::2].norm(dim=1))
    return torch.stack([torch.atan2(xyz[:, 0], xyz[:, 2]), below], 1), (xyz != 0).any(1)


def _from_angles(angles: Tensor) -> Tensor:
    azimuth, below = angles.unbind(1)
    flat = torch.cos(below)
    return torch.stack([flat * torch.sin(azimuth), torch.sin(below), flat * torch.cos(azimuth)], 1)
