"""Grid, RangeView and Camera: metric <-> index, against OpenCV, hand formulas and real calibrations."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lidarfw.errors import LidarfwError
from lidarfw.types import Camera, Grid, RangeView

PINHOLE = Camera("pinhole", 1242, 375, (721.5377, 721.5377, 609.5593, 172.854))
DISTORTED = Camera(
    "pinhole",
    1392,
    512,
    (788.629315, 786.38223, 687.158398, 317.752196),
    (-0.344441, 0.141678, 0.000414, -0.000222, -0.029608),
)
FISHEYE = Camera(
    "fisheye", 1920, 1208, (1176.93, 1177.72, 962.275, 612.725), (-0.0540096, -0.0784275, 0.0959641, -0.0515253)
)
MEI = Camera("mei", 1400, 1400, (1336.322, 1335.788, 716.943, 705.765), (2.2134, 0.016798, 1.65488, 4.222e-4, 4.246e-4))
NARROW_MEI = Camera("mei", 640, 480, (300.0, 310.0, 320.0, 240.0), (0.8,))
PANORAMA = Camera("equirectangular", 1024, 512, (1024 / (2 * math.pi), 512 / math.pi, 511.5, 255.5))
CAMERAS = [PINHOLE, DISTORTED, FISHEYE, MEI, NARROW_MEI, PANORAMA]
NAMES = ["pinhole", "distorted", "fisheye", "mei", "narrow_mei", "panorama"]
TURN = (  # lidar x forward, y left, z up -> camera x right, y down, z ahead, 0.3 m off
    (0.0, -1.0, 0.0, 0.1),
    (0.0, 0.0, -1.0, -0.2),
    (1.0, 0.0, 0.0, -0.3),
    (0.0, 0.0, 0.0, 1.0),
)


def random_points(count: int = 3000, seed: int = 0) -> Tensor:
    return torch.tensor(np.random.default_rng(seed).normal((0, 0, 3), 4, (count, 3)))


def pixels_of(camera: Camera, count: int = 4000) -> Tensor:
    corner = [camera.width - 0.5, camera.height - 0.5]
    return torch.tensor(np.random.default_rng(1).uniform([-0.5, -0.5], corner, (count, 2)))


def opencv_matrix(camera: Camera) -> np.ndarray:
    fx, fy, cx, cy = camera.intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


# Grid


def test_grid_cells_cover_half_open_intervals() -> None:
    grid = Grid((0.0, -2.0, -1.0), (4.0, 2.0, 1.0), (0.5, 1.0, 2.0))
    assert grid.shape() == (1, 4, 8)
    assert grid.shape(3) == (1, 2, 3)
    index, inside = grid.index(torch.tensor([[0.0, -2.0, -1.0], [3.99, 1.99, 0.99], [4.0, 0.0, 0.0], [math.nan, 0, 0]]))
    assert index.tolist() == [[0, 0, 0], [0, 3, 7], [0, 0, 0], [0, 0, 0]]
    assert inside.tolist() == [True, True, False, False]


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 9), st.floats(0.05, 2), st.floats(-50, 50), st.integers(1, 4))
def test_grid_centres_fall_into_their_own_cells(cells: int, size: float, lower: float, stride: int) -> None:
    grid = Grid((lower,) * 3, (lower + cells * size,) * 3, (size,) * 3)
    assert grid.shape() == (cells,) * 3
    index = torch.cartesian_prod(*[torch.arange(cells)] * 3).reshape(-1, 3)
    found, inside = grid.index(grid.center(index))
    assert inside.all()
    assert torch.equal(found, index)
    assert grid.bev_centers(stride).shape == (*grid.shape(stride)[1:], 2)


def test_bev_centres_and_pixels_are_inverse() -> None:
    grid = Grid((-3.0, 1.0, 0.0), (5.0, 9.0, 1.0), (0.25, 0.5, 1.0))
    pixel = grid.pixel(grid.bev_centers(2), 2)
    rows, columns = torch.meshgrid(torch.arange(8.0), torch.arange(16.0), indexing="ij")
    torch.testing.assert_close(pixel, torch.stack([columns, rows], -1) + 0.5)


# RangeView


def test_range_view_golden_pixels() -> None:
    view = RangeView(64, 1024, math.radians(3), math.radians(-25))
    xyz = torch.tensor([[10.0, 0, 0], [0, 10, 0], [0, -10, 0], [-10, -1e-3, 0], [-10, 1e-3, 0], [10, 0, 5], [0, 0, 0]])
    row, column, distance, inside = view.project(xyz)
    assert column[:5].tolist() == [512, 256, 768, 1023, 0]
    assert row[:5].tolist() == [6] * 5  # 3 of 28 degrees below the top: row 6.86
    assert inside.tolist() == [True] * 5 + [False] * 2
    assert distance[:2].tolist() == [10, 10]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_range_directions_fall_into_their_own_pixels(dtype: torch.dtype) -> None:
    view = RangeView(32, 900, 0.2, -0.4)
    row, column = torch.meshgrid(torch.arange(32), torch.arange(900), indexing="ij")
    xyz = view.direction(row.to(dtype), column.to(dtype)).reshape(-1, 3)
    torch.testing.assert_close(xyz.norm(dim=1), torch.ones(len(xyz), dtype=dtype))
    found_row, found_column, _, inside = view.project(xyz * 7)
    assert inside.all()
    assert torch.equal(found_row, row.flatten())
    assert torch.equal(found_column, column.flatten())


def test_range_view_takes_no_point_and_broken_points() -> None:
    view = RangeView(16, 360, 0.2, -0.4)
    assert all(len(value) == 0 for value in view.project(torch.zeros(0, 3)))
    _, _, _, inside = view.project(torch.tensor([[math.nan, 0, 0], [math.inf, 0, 0]]))
    assert not inside.any()


# Camera: projection


def test_pinhole_golden_numbers() -> None:
    uv, depth, valid = PINHOLE.project(torch.tensor([[1.0, 0.5, 10.0], [0.0, 0.0, -5.0], [20.0, 0.0, 10.0]]))
    torch.testing.assert_close(uv[0], torch.tensor([609.5593 + 72.15377, 172.854 + 36.076885]))
    assert depth.tolist() == [10, -5, 10]
    assert valid.tolist() == [True, False, False]
    assert uv[1].isnan().all()
    assert uv[2].isfinite().all()


def test_distorted_pinhole_equals_opencv() -> None:
    xyz = random_points()
    uv, _, valid = DISTORTED.project(xyz)
    expected, _ = cv2.projectPoints(
        xyz.numpy(), np.zeros(3), np.zeros(3), opencv_matrix(DISTORTED), np.array(DISTORTED.distortion)
    )
    imaged = uv.isfinite().all(1)
    assert 100 < valid.sum() < imaged.sum()
    torch.testing.assert_close(uv[imaged], torch.tensor(expected[:, 0])[imaged], atol=1e-7, rtol=0)


def test_points_that_distortion_would_fold_into_the_picture_are_not_valid() -> None:
    barrel = Camera("pinhole", 640, 480, (400.0, 400.0, 320.0, 240.0), (-0.3, 0.0, 0.0, 0.0))
    xyz = torch.tensor([[1.8, 0.0, 1.0]])  # r = 1.8 > 1 / sqrt(0.9): 1.8 * (1 - 0.3 * 3.24) = 0.05, mid-picture
    folded, _ = cv2.projectPoints(
        xyz.numpy(), np.zeros(3), np.zeros(3), opencv_matrix(barrel), np.array([-0.3, 0, 0, 0])
    )
    assert abs(folded[0, 0, 0] - 340.16) < 0.1
    uv, _, valid = barrel.project(xyz)
    assert not valid.any()
    assert uv.isnan().all()


def test_fisheye_equals_opencv() -> None:
    xyz = random_points()
    uv, depth, _ = FISHEYE.project(xyz)
    expected, _ = cv2.fisheye.projectPoints(
        xyz.numpy()[:, None], np.zeros(3), np.zeros(3), opencv_matrix(FISHEYE), np.array(FISHEYE.distortion)
    )
    ahead = uv.isfinite().all(1) & (xyz[:, 2] > 0)
    assert ahead.sum() > 1000
    torch.testing.assert_close(uv[ahead], torch.tensor(expected[:, 0])[ahead], atol=1e-7, rtol=0)
    torch.testing.assert_close(depth, xyz.norm(dim=1))


def mei_by_hand(
    x: float, y: float, z: float, mirror: tuple[float, ...], gamma: tuple[float, ...]
) -> tuple[float, float]:
    """Mei and Rives 2007, section II, written out for one point."""
    xi, k1, k2, p1, p2 = mirror
    norm = math.sqrt(x * x + y * y + z * z)
    mx, my = x / norm / (z / norm + xi), y / norm / (z / norm + xi)
    r2 = mx * mx + my * my
    radial = 1 + k1 * r2 + k2 * r2 * r2
    dx = 2 * p1 * mx * my + p2 * (r2 + 2 * mx * mx)
    dy = p1 * (r2 + 2 * my * my) + 2 * p2 * mx * my
    return gamma[0] * (mx * radial + dx) + gamma[2], gamma[1] * (my * radial + dy) + gamma[3]


def test_mei_with_the_kitti_360_calibration(real_data: Callable[[str], Path]) -> None:
    storage = cv2.FileStorage(str(real_data("kitti_360/calibration/image_02.yaml")), cv2.FILE_STORAGE_READ)
    mirror = storage.getNode("mirror_parameters"), storage.getNode("distortion_parameters")
    xi, k1, k2, p1, p2 = (mirror[i > 0].getNode(n).real() for i, n in enumerate(("xi", "k1", "k2", "p1", "p2")))
    projection = storage.getNode("projection_parameters")
    gamma = tuple(projection.getNode(name).real() for name in ("gamma1", "gamma2", "u0", "v0"))
    camera = Camera("mei", 1400, 1400, gamma, (xi, k1, k2, p1, p2))
    xyz = random_points()
    uv, _, valid = camera.project(xyz)
    expected = torch.tensor([mei_by_hand(*point, (xi, k1, k2, p1, p2), gamma) for point in xyz.tolist()])
    imaged = uv.isfinite().all(1)
    assert torch.equal(imaged, xyz[:, 2] / xyz.norm(dim=1) > -1 / xi)  # the tangent cone of the sphere
    torch.testing.assert_close(uv[imaged], expected.double()[imaged], atol=1e-3, rtol=1e-6)
    sideways, _, seen = camera.project(torch.tensor([[5.0, 0.0, 0.0]]).double())  # 90 degrees off the axis
    assert seen.all()
    assert valid.sum() > 100
    torch.testing.assert_close(sideways, torch.tensor([mei_by_hand(5, 0, 0, (xi, k1, k2, p1, p2), gamma)]).double())


def test_mei_golden_numbers() -> None:
    uv, _, valid = MEI.project(torch.tensor([[0.0, 0.0, 4.0], [3.0, 0.0, 4.0], [0.0, 0.0, -1.0]]).double())
    m = 0.6 / (0.8 + 2.2134)  # the point (3, 0, 4) lies at (0.6, 0, 0.8) on the sphere
    u = m * (1 + 0.016798 * m**2 + 1.65488 * m**4) + 3 * 4.246e-4 * m**2
    torch.testing.assert_close(uv[0], torch.tensor([716.943, 705.765]).double())
    torch.testing.assert_close(uv[1, 0].item(), 1336.322 * u + 716.943)
    assert valid.tolist() == [True, True, False]


def test_a_pinhole_is_a_mei_camera_with_its_eye_at_the_centre() -> None:
    xyz = random_points()
    central = Camera("mei", 1242, 375, PINHOLE.intrinsics, (0.0,))
    torch.testing.assert_close(central.project(xyz)[0], PINHOLE.project(xyz)[0], equal_nan=True)


def test_equirectangular_golden_pixels() -> None:
    uv, depth, valid = PANORAMA.project(
        torch.tensor([[0.0, 0.0, 2.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    )
    torch.testing.assert_close(uv[:3], torch.tensor([[511.5, 255.5], [767.5, 255.5], [511.5, 511.5]]))
    assert depth.tolist() == [2, 2, 2, 0]
    assert valid.tolist() == [True, True, False, False]  # straight down is the outer edge of the last row


@pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
def test_rays_and_projection_are_inverse(camera: Camera) -> None:
    uv = pixels_of(camera)
    rays = camera.rays(uv)
    seen = rays.isfinite().all(1)
    assert seen.double().mean() > 0.8
    torch.testing.assert_close(rays[seen].norm(dim=1), torch.ones(int(seen.sum())).double())
    back, _, valid = camera.project(rays * 5)
    assert valid[seen].all()
    assert (back - uv)[seen].abs().max() < 1e-6


@pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
def test_every_valid_point_lies_on_the_ray_of_its_pixel(camera: Camera) -> None:
    """The other direction: nothing valid was folded over."""
    xyz = random_points(20000)
    uv, _, valid = camera.project(xyz)
    assert valid.sum() > 300
    direction = torch.nn.functional.normalize(xyz, dim=1)
    assert (camera.rays(uv[valid]) - direction[valid]).norm(dim=1).max() < 1e-9


@pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
def test_single_precision_and_edge_cases(camera: Camera) -> None:
    xyz = random_points(500)
    exact, _, valid = camera.project(xyz)
    single, depth, _ = camera.project(xyz.float())
    assert single.dtype == depth.dtype == torch.float32
    assert (single.double() - exact)[valid].abs().max() < 1e-2
    empty = camera.project(torch.zeros(0, 3))
    assert [tuple(value.shape) for value in empty] == [(0, 2), (0,), (0,)]
    assert camera.rays(torch.zeros(0, 2)).shape == (0, 3)
    broken = torch.tensor([[math.nan, 0, 1], [math.inf, 0, 1], [0, 0, 0]])
    assert not camera.project(broken)[2].any()


@pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
def test_projection_has_gradients(camera: Camera) -> None:
    xyz = torch.cat([random_points(50), torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]])]).requires_grad_()
    uv, _, valid = camera.project(xyz)
    uv[valid].sum().backward()
    assert xyz.grad is not None
    assert xyz.grad.isfinite().all()
    assert (xyz.grad[valid] != 0).any(1).all()


# Camera: frames and pictures


@pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
def test_sensor_rays_start_at_the_camera(camera: Camera) -> None:
    camera = Camera(camera.model, camera.width, camera.height, camera.intrinsics, camera.distortion, TURN)
    uv = pixels_of(camera, 200)
    centre, rays = camera.sensor_rays(uv)
    torch.testing.assert_close(centre, torch.tensor([0.3, 0.1, -0.2]).double())
    seen = rays.isfinite().all(1)
    back, _, _ = camera.project(centre + 9 * rays[seen])
    assert (back - uv[seen]).abs().max() < 1e-6


@settings(max_examples=30, deadline=None)
@given(st.floats(-3, 3), st.floats(0.9, 1.1), st.booleans(), st.floats(-5, 5))
def test_augmented_points_keep_their_pixels(angle: float, scale: float, mirror: bool, shift: float) -> None:
    camera = Camera("pinhole", 1242, 375, PINHOLE.intrinsics, (), TURN)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]) * scale
    matrix[2, 2] = scale
    matrix[1] *= -1 if mirror else 1
    matrix[:3, 3] = shift
    xyz = random_points(200)
    moved = xyz @ matrix[:3, :3].T + matrix[:3, 3]
    before, after = camera.project(xyz), camera.transformed(matrix).project(moved)
    torch.testing.assert_close(before, after, atol=1e-6, rtol=1e-6, equal_nan=True)


def test_scaled_and_cropped_cameras_see_the_changed_picture() -> None:
    """A bright spot is found where the changed camera projects it, also for resizing by cv2."""
    picture = np.zeros((376, 1240, 3), np.float32)
    picture[100:104, 600:604] = 1
    camera = Camera("pinhole", 1240, 376, PINHOLE.intrinsics)
    xyz = camera.rays(torch.tensor([[601.5, 101.5]]).double())
    half = camera.scaled(0.5)
    assert (half.width, half.height) == (620, 188)
    small = cv2.resize(picture, (620, 188), interpolation=cv2.INTER_AREA)
    spot = np.argwhere(small[..., 0] > 0.5).mean(0)[::-1].copy()
    torch.testing.assert_close(half.project(xyz)[0][0], torch.tensor(spot))
    crop = camera.cropped(500, 50, 200, 100)
    spot = np.argwhere(picture[50:150, 500:700, 0]).mean(0)[::-1].copy()
    torch.testing.assert_close(crop.project(xyz)[0][0], torch.tensor(spot))
    assert not camera.cropped(0, 0, 200, 100).project(xyz)[2].any()


def test_cameras_hash_and_compare_and_stand_in_sets() -> None:
    assert len({PINHOLE, Camera("pinhole", 1242, 375, PINHOLE.intrinsics), MEI}) == 2


BAD: dict[str, tuple[Callable[[], object], str]] = {
    "model": (lambda: Camera("pin", 10, 10, (1, 1, 1, 1)), "no model 'pin'"),
    "size": (lambda: Camera("pinhole", 0, 10, (1, 1, 1, 1)), "positive"),
    "focal": (lambda: Camera("pinhole", 10, 10, (0, 1, 1, 1)), "fx, fy not 0"),
    "intrinsics": (lambda: Camera("pinhole", 10, 10, (1, 1, 1)), "fx, fy, cx, cy"),  # type: ignore[arg-type]
    "not finite": (lambda: Camera("pinhole", 10, 10, (1, math.nan, 1, 1)), "not finite"),
    "count": (lambda: Camera("fisheye", 10, 10, (1, 1, 1, 1), (0.1, 0.2)), "fisheye takes 0 or 4"),
    "no xi": (lambda: Camera("mei", 10, 10, (1, 1, 1, 1)), "mei takes 1 or 5"),
    "xi": (lambda: Camera("mei", 10, 10, (1, 1, 1, 1), (-0.5,)), "negative"),
    "shape": (lambda: Camera("pinhole", 10, 10, (1, 1, 1, 1), (), TURN[:3]), "4 x 4"),
    "singular": (lambda: Camera("pinhole", 10, 10, (1, 1, 1, 1), (), (*[(0.0,) * 4] * 3, TURN[3])), "not orthogonal"),
    "skewed": (
        lambda: Camera("pinhole", 10, 10, (1, 1, 1, 1), (), ((1, 0.1, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))),
        "not orthogonal",
    ),
    "cell": (lambda: Grid((0, 0, 0), (1, 1, 1), (0.1, -0.1, 0.1)), "along y must be positive"),
    "range": (lambda: Grid((0, 0, 0), (1, 1, 0), (0.1, 0.1, 0.1)), "along z is empty"),
    "rows": (lambda: RangeView(0, 10, 0.1, -0.1), "positive"),
    "degrees": (lambda: RangeView(64, 1024, 3, -25), "radians"),
    "upside": (lambda: RangeView(64, 1024, -0.1, 0.1), "down < up"),
}


@pytest.mark.parametrize("case", BAD)
def test_impossible_geometry_is_refused(case: str) -> None:
    make, message = BAD[case]
    with pytest.raises(LidarfwError, match=message):
        make()
