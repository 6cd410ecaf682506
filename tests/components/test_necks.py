"""Necks: bev_fpn, height_compression, the adapters and lift."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from lidarfw.components.necks.adapters import BEVToVoxels, PointsToBEV, PointsToVoxels, RangeToPoints, VoxelsToPoints
from lidarfw.components.necks.bev_fpn import BEVFPN
from lidarfw.components.necks.height_compression import HeightCompression
from lidarfw.components.necks.lift import Lift
from lidarfw.errors import ConfigError, DataError
from lidarfw.ops import to_dense, voxelize_mean
from lidarfw.types import BEV, Camera, Grid, Image, Points, RangeImage, RangeView, Spec, Voxels

GRID = Grid((0.0, -2.0, -1.0), (6.0, 2.0, 1.0), (0.5, 0.5, 0.25))  # 8 x 8 x 12 cells
ODD = Grid((0.0, -2.0, -1.0), (6.6, 2.2, 1.0), (0.2, 0.3, 2.0))  # 1 x 14 x 33 cells


def make_bev(grid: Grid = GRID, channels: int = 5, stride: int = 1, batch_size: int = 2) -> tuple[Spec, BEV]:
    _, height, width = grid.shape(stride)
    random = torch.Generator().manual_seed(0)
    features = torch.randn(batch_size, channels, height, width, generator=random)
    return Spec(BEV, channels, stride, grid), BEV(features, grid, stride)


def make_points(number: int = 200, channels: int = 1, batch_size: int = 1) -> Points:
    random = torch.Generator().manual_seed(1)
    xyz = torch.rand(number, 3, generator=random) * torch.tensor([7.0, 5.0, 2.4]) - torch.tensor([0.3, 2.5, 1.2])
    batch = torch.randint(0, batch_size, (number,), generator=random)
    return Points(xyz, torch.randn(number, channels, generator=random), batch, batch_size)


def make_voxels(channels: int = 3, batch_size: int = 2, number: int = 200) -> tuple[Spec, Voxels]:
    voxels = voxelize_mean(make_points(number, channels, batch_size), GRID)
    features = voxels.features[:, 3:]
    return Spec(Voxels, channels, 1, GRID, depth=8), voxels.with_features(features)


def assert_fits(spec: Spec, value: BEV | Voxels | Points) -> None:
    """The value is exactly what the spec says."""
    assert spec.kind is type(value)
    assert value.features.shape[1] == spec.channels
    if isinstance(value, Voxels):
        assert (spec.geometry, spec.stride) == (value.grid, value.stride)
        assert value.shape == (spec.depth, *spec.grid.shape(spec.stride)[1:])
    if isinstance(value, BEV):
        assert (spec.geometry, spec.stride) == (value.grid, value.stride)
        assert value.features.shape[2:] == spec.grid.shape(spec.stride)[1:]


def assert_gradients_everywhere(module: nn.Module) -> None:
    silent = [k for k, p in module.named_parameters() if p.grad is None or not float(p.grad.abs().sum()) > 0]
    assert not silent


# --- bev_fpn -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grid", [GRID, ODD])
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("strides", [(2, 2, 2), (1, 2), (1, 3, 2), (3,)])
def test_bev_fpn_provides_equals_the_output(grid: Grid, stride: int, strides: tuple[int, ...]) -> None:
    spec, bev = make_bev(grid, 5, stride)
    blocks = len(strides)
    options = {"layers": (2, 1, 3)[:blocks], "channels": (4, 6, 8)[:blocks], "upsampled": (3, 4, 5)[:blocks]}
    neck = BEVFPN(spec, strides=strides, **options)
    result = neck(bev)
    assert_fits(neck.provides, result)
    assert neck.provides.stride == stride * strides[0]
    (result.features * torch.randn_like(result.features)).sum().backward()
    assert_gradients_everywhere(neck)


def test_bev_fpn_has_the_layers_of_the_papers() -> None:
    pointpillars = BEVFPN(Spec(BEV, 64, 1, GRID))
    convolutions = [m for block in pointpillars.blocks for m in block.modules() if isinstance(m, nn.Conv2d)]
    widths = [(m.in_channels, m.out_channels, m.stride[0]) for m in convolutions]
    first = [(64, 64, 2), *[(64, 64, 1)] * 3]
    assert widths == [*first, (64, 128, 2), *[(128, 128, 1)] * 5, (128, 256, 2), *[(256, 256, 1)] * 5]
    assert [up[0].kernel_size[0] for up in pointpillars.ups] == [1, 2, 4]
    assert pointpillars.provides.channels == 384
    norms = [m for m in pointpillars.modules() if isinstance(m, nn.BatchNorm2d)]
    assert {(m.eps, m.momentum) for m in norms} == {(1e-3, 0.01)}


def test_bev_fpn_upsamples_to_the_right_cell() -> None:
    """A single 1 at (5, 3) of a map passes identity convolutions and comes back at its place at every scale."""
    neck = BEVFPN(Spec(BEV, 1, 1, GRID), strides=(1, 2), layers=(1, 1), channels=(1, 1), upsampled=(1, 1)).eval()
    with torch.no_grad():
        for block in neck.blocks:
            block[0][0].weight.zero_()[0, 0, 1, 1] = 1
        for up in neck.ups:
            up[0].weight.fill_(1)
    features = torch.zeros(1, 1, 8, 12)
    features[0, 0, 4, 2] = 1.0
    result = neck(BEV(features, GRID, 1)).features[0]
    scale = 1 / (1 + 1e-3) ** 0.5
    expected = torch.zeros(2, 8, 12)
    expected[0, 4, 2] = scale**2
    expected[1, 4:6, 2:4] = scale**3
    torch.testing.assert_close(result, expected)


def test_bev_fpn_on_one_cell_trains() -> None:
    grid = Grid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    spec, bev = make_bev(grid, 4, batch_size=1)
    result = BEVFPN(spec, layers=(1, 1, 1), channels=(4, 4, 4), upsampled=(4, 4, 4))(bev)
    assert result.features.shape == (1, 12, 1, 1)
    assert bool(result.features.isfinite().all())


def test_bev_fpn_batch_mates_do_not_change_a_sample() -> None:
    spec, bev = make_bev()
    neck = BEVFPN(spec, layers=(1, 1, 1), channels=(4, 4, 4), upsampled=(4, 4, 4))
    neck(bev)
    neck.eval()
    alone = neck(BEV(bev.features[1:], GRID, 1))
    torch.testing.assert_close(alone.features[0], neck(bev).features[1], atol=1e-6, rtol=1e-5)


def test_bev_fpn_wants_one_number_per_block() -> None:
    with pytest.raises(ConfigError, match=r"given: strides: \[2, 2\], layers: \[4, 6, 6\].*\n  fix: give 3 numbers"):
        BEVFPN(Spec(BEV, 4, 1, GRID), strides=(2, 2))
    with pytest.raises(ConfigError, match="positive"):
        BEVFPN(Spec(BEV, 4, 1, GRID), layers=(0, 1, 1))


# --- height_compression --------------------------------------------------------------------------------------------


def test_height_compression_lays_z_into_the_channels() -> None:
    features = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    index = torch.tensor([[0, 0, 1, 2], [0, 2, 1, 2], [1, 1, 0, 0]])
    voxels = Voxels(features, index, GRID, (3, 2, 4), (4, 4, 4), batch_size=2)
    bev = HeightCompression(Spec(Voxels, 2, 4, GRID, depth=3))(voxels)
    assert bev.features[0, :, 1, 2].tolist() == [1, 0, 3, 2, 0, 4]
    assert bev.features[1, :, 0, 0].tolist() == [0, 5, 0, 0, 6, 0]
    assert int((bev.features != 0).sum()) == 6


@pytest.mark.parametrize("channels", [1, 4])
def test_height_compression_provides_equals_the_output(channels: int) -> None:
    spec, voxels = make_voxels(channels)
    voxels.features.requires_grad_()
    neck = HeightCompression(spec)
    result = neck(voxels)
    assert_fits(neck.provides, result)
    dense = to_dense(voxels)
    torch.testing.assert_close(result.features, dense.reshape(2, channels * 8, 8, 12))
    result.features.sum().backward()
    assert bool((voxels.features.grad == 1).all())


def test_height_compression_of_nothing() -> None:
    spec, voxels = make_voxels(number=0)
    assert HeightCompression(spec)(voxels).features.shape == (2, 24, 8, 12)


# --- adapters ------------------------------------------------------------------------------------------------------


def test_bev_to_voxels_and_back() -> None:
    spec, bev = make_bev(stride=2)
    bev.features[:, :, 1] = 0  # a row without anything
    neck = BEVToVoxels(spec)
    voxels = neck(bev)
    assert_fits(neck.provides, voxels)
    assert len(voxels) == 2 * 3 * 6  # 4 x 6 cells, one row of each sample is empty
    assert voxels.centers()[0].tolist() == [0.5, -1.5, 0.0]  # cell 0, 0 at stride 2, half of the height
    back = HeightCompression(neck.provides)(voxels)
    torch.testing.assert_close(back.features, bev.features)


def test_points_to_voxels_gives_means() -> None:
    neck = PointsToVoxels(Spec(Points, 1), lower=(0, 0, 0), upper=(2, 2, 2), cell=(1, 1, 1))
    xyz = torch.tensor([[0.2, 0.4, 1.6], [0.6, 0.4, 1.2], [1.5, 0.5, 0.5], [2.0, 0.5, 0.5]])
    voxels = neck(Points.from_scan(xyz, torch.tensor([[1.0], [3.0], [5.0], [7.0]])))
    assert_fits(neck.provides, voxels)
    assert voxels.index.tolist() == [[0, 0, 0, 1], [0, 1, 0, 0]]
    torch.testing.assert_close(voxels.features, torch.tensor([[1.5, 0.5, 0.5, 5.0], [0.4, 0.4, 1.4, 2.0]]))


@pytest.mark.parametrize("channels", [0, 6])
def test_points_to_bev_provides_equals_the_output(channels: int) -> None:
    neck = PointsToBEV(Spec(Points, channels), lower=GRID.lower, upper=GRID.upper, cell=(0.5, 0.25), channels=7)
    result = neck(make_points(channels=channels, batch_size=2))
    assert_fits(neck.provides, result)
    (result.features * torch.randn_like(result.features)).sum().backward()
    assert_gradients_everywhere(neck)


def line_of_voxels(values: list[float]) -> Voxels:
    """One row of 1 m cells along x, centres at 0.5, 1.5, ...; a value of 0 leaves a cell out."""
    grid = Grid((0.0, 0.0, 0.0), (float(len(values)), 1.0, 1.0), (1.0, 1.0, 1.0))
    x = torch.tensor([i for i, v in enumerate(values) if v])
    index = torch.stack([torch.zeros_like(x)] * 3 + [x], 1)
    return Voxels(torch.tensor([[v] for v in values if v]), index, grid, grid.shape())


def test_voxels_to_points_interpolates_between_centres() -> None:
    voxels = line_of_voxels([2.0, 6.0, 0.0, 10.0, 0.0, 0.0])
    x = torch.tensor([0.5, 1.0, 0.75, 0.0, 1.9, 2.5, 3.2, 5.4, -0.1, 6.5, torch.nan])
    points = Points.from_scan(torch.stack([x, torch.full_like(x, 0.3), torch.full_like(x, 0.9)], 1), x[:, None])
    neck = VoxelsToPoints(Spec(Voxels, 1, 1, voxels.grid), Spec(Points, 1))
    result = neck(voxels, points)
    assert_fits(neck.provides, result)
    expected = [2, 4, 3, 2, 6, 0, 10, 0, 0, 0, 0]  # 1.9: its empty neighbour does not count; 2.5: centre of a gap
    torch.testing.assert_close(result.features[:, 0], torch.tensor(expected, dtype=torch.float32))
    assert result.xyz is points.xyz


def test_voxels_to_points_is_linear_inside_a_full_grid() -> None:
    grid = Grid((0.0, 0.0, 0.0), (4.0, 4.0, 4.0), (1.0, 1.0, 1.0))
    cells = torch.cartesian_prod(torch.arange(2), *[torch.arange(2)] * 3)
    voxels = Voxels(torch.zeros(16, 1), cells, grid, (2, 2, 2), (2, 2, 2), batch_size=2)
    plane = torch.tensor([1.0, -2.0, 3.0])
    voxels = voxels.with_features((voxels.centers() @ plane + 10 * cells[:, 0])[:, None])
    xyz = 1 + 2 * torch.rand(50, 3)  # between the centres at 1 and 3 m
    batch = torch.arange(50) % 2
    result = VoxelsToPoints(Spec(Voxels, 1, 2, grid, depth=2), Spec(Points, 0))(
        voxels, Points(xyz, torch.zeros(50, 0), batch, 2)
    )
    torch.testing.assert_close(result.features[:, 0], xyz @ plane + 10 * batch)


def test_voxels_to_points_finds_a_voxel_for_every_point_of_the_grid() -> None:
    from lidarfw.components.backbones.second import SecondBackbone

    points = make_points(300, batch_size=2)
    backbone = SecondBackbone(Spec(Points, 1), lower=GRID.lower, upper=GRID.upper, cell=(0.1, 0.1, 0.05))
    for spec, level in zip(backbone.provides, backbone(points), strict=True):
        neck = VoxelsToPoints(spec, Spec(Points, 1))
        ones = neck(level.with_features(torch.ones(len(level), 1)), points).features[:, 0]
        torch.testing.assert_close(ones, backbone.grid.index(points.xyz)[1].float())


def test_voxels_to_points_gradient_and_nothing() -> None:
    spec, voxels = make_voxels(batch_size=1)
    voxels.features.requires_grad_()
    neck = VoxelsToPoints(spec, Spec(Points, 1))
    neck(voxels, make_points()).features.sum().backward()
    assert bool((voxels.features.grad > 0).all())
    assert neck(voxels, make_points(0)).features.shape == (0, 3)
    spec, empty = make_voxels(number=0)
    assert not neck(empty, make_points(batch_size=2)).features.any()


def test_range_to_points_takes_the_pixel_of_each_point() -> None:
    view = RangeView(2, 3, 0.1, -0.3)
    features = torch.arange(24.0).view(2, 2, 2, 3)  # B, C, H, W
    pixel = torch.tensor([0, 5, -1, 6 + 2, 0])
    image = RangeImage(features, torch.zeros(2, 3, 2, 3), torch.ones(2, 2, 3, dtype=torch.bool), pixel, view)
    points = Points(torch.rand(5, 3), torch.rand(5, 1), torch.tensor([0, 0, 0, 1, 0]), 2)
    neck = RangeToPoints(Spec(RangeImage, 2, 1, view), Spec(Points, 1))
    result = neck(image, points)
    assert_fits(neck.provides, result)
    assert result.features.tolist() == [[0, 6], [5, 11], [0, 0], [14, 20], [0, 6]]
    with pytest.raises(DataError, match="made of 5 points, given are 4"):
        neck(image, points[:4])


# --- lift ----------------------------------------------------------------------------------------------------------

# looks along x of the sensor: camera x = -y, camera y = -z, camera z = x
FROM_SENSOR = ((0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera("pinhole", 80, 40, (40.0, 40.0, 39.5, 19.5), (), FROM_SENSOR)


def coordinate_maps(stride: int) -> torch.Tensor:
    """Features (2, h, w) whose channels are u and v of the cells' centres."""
    height, width = -(-40 // stride), -(-80 // stride)
    u = (torch.arange(width) + 0.5) * stride - 0.5
    v = (torch.arange(height) + 0.5) * stride - 0.5
    return torch.stack([u.expand(height, width), v[:, None].expand(height, width)])


def identity_lift(specs: list[Spec]) -> Lift:
    neck = Lift(specs, lower=(-4, -4, -1), upper=(8, 4, 1), cell=(2, 2, 1), channels=2)
    for lateral in neck.laterals:
        nn.init.eye_(lateral.weight.data[:, :, 0, 0])
        nn.init.zeros_(lateral.bias)
    return neck


@pytest.mark.parametrize("stride", [1, 4])
def test_lift_looks_up_the_projected_centres(stride: int) -> None:
    neck = identity_lift([Spec(Image, 2, stride, CAMERA)])
    result = neck([Image(coordinate_maps(stride)[None], (CAMERA,), stride)])
    assert_fits(neck.provides, result)
    # cell row 1, column 5: x = 7 m, y = -1 m, z = -0.5 and 0.5 m, so u = 39.5 + 40/7 and v = 19.5 -+ 20/7
    torch.testing.assert_close(result.features[0, :, 1, 5], torch.tensor([39.5 + 40 / 7, 19.5]))
    # x = 3 m, y = -3 m: u = 79.5 is the picture's edge, outside; x = 3, y = 1: both heights, v = 19.5 -+ 20/3
    assert result.features[0, :, 0, 3].tolist() == [0, 0]
    torch.testing.assert_close(result.features[0, :, 2, 3], torch.tensor([39.5 - 40 / 3, 19.5]))
    assert not result.features[0, :, :, :2].any()  # behind the camera


def test_lift_averages_only_what_is_seen() -> None:
    tilted = Camera("pinhole", 80, 40, (40.0, 40.0, 39.5, 8.0), (), FROM_SENSOR)  # sees little above the axis
    result = identity_lift([Spec(Image, 2, 1, tilted)])([Image(coordinate_maps(1)[None], (tilted,), 1)])
    # x = 1 m, y = 1 m: u = -0.5 lies inside, v = 28 for the lower height only (-12 for the upper one)
    torch.testing.assert_close(result.features[0, :, 2, 2], torch.tensor([0.0, 28.0]))


def test_lift_adds_the_levels_at_the_finest_stride() -> None:
    specs = [Spec(Image, 2, s, CAMERA) for s in (4, 8, 16)]
    neck = identity_lift(specs)
    images = [Image(torch.full((2, 2, -(-40 // s), -(-80 // s)), float(s)), (CAMERA,) * 2, s) for s in (4, 8, 16)]
    result = neck(images)
    assert_fits(neck.provides, result)
    assert set(result.features.unique().tolist()) == {0.0, 28.0}
    result.features.sum().backward()
    assert_gradients_everywhere(neck)


def test_lift_keeps_samples_with_their_cameras_apart() -> None:
    other = Camera("pinhole", 80, 40, (50.0, 50.0, 30.0, 19.5), (), FROM_SENSOR)
    neck = identity_lift([Spec(Image, 2, 1, CAMERA)])
    maps = coordinate_maps(1)[None]
    both = neck([Image(torch.cat([maps, 2 * maps]), (CAMERA, other), 1)]).features
    torch.testing.assert_close(both[0], neck([Image(maps, (CAMERA,), 1)]).features[0])
    torch.testing.assert_close(both[1], neck([Image(2 * maps, (other,), 1)]).features[0])
    assert not torch.allclose(both[1], 2 * both[0])


# --- a real scan ---------------------------------------------------------------------------------------------------


def test_chain_of_necks_on_a_real_scan(real_data: Callable[[str], Path]) -> None:
    raw = np.fromfile(real_data("kitti_object/training/velodyne/000001.bin"), np.float32).reshape(-1, 4)
    points = Points.from_scan(torch.from_numpy(raw[:, :3].copy()), torch.from_numpy(raw[:, 3:].copy()))
    to_voxels = PointsToVoxels(Spec(Points, 1), cell=(0.4, 0.4, 0.4))
    voxels = to_voxels(points)
    compress = HeightCompression(to_voxels.provides)
    fpn = BEVFPN(compress.provides, strides=(1, 2), layers=(1, 1), channels=(8, 8), upsampled=(8, 8))
    bev = fpn(compress(voxels))
    assert_fits(fpn.provides, bev)
    back = VoxelsToPoints(to_voxels.provides, Spec(Points, 1))(voxels, points)
    inside = to_voxels.grid.index(points.xyz)[1]
    near = (back.features[inside, :3] - points.xyz[inside]).norm(dim=1)
    assert float(near.median()) < 0.2  # the interpolated mean position is where the point is
    assert float(near.max()) < 0.8
    assert not back.features[~inside].any()
