"""Backbones: pillars, second, resnet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarfw.components.backbones.pillars import PillarsBackbone
from lidarfw.components.backbones.resnet import ResNetBackbone
from lidarfw.components.backbones.second import SecondBackbone
from lidarfw.components.layers import BatchNorm1d
from lidarfw.errors import ConfigError
from lidarfw.ops import to_dense, voxelize_mean
from lidarfw.types import BEV, Camera, Grid, Image, Points, Spec, Voxels

# ranges and cells: even, odd number of cells, cells that do not divide the range in binary
GRIDS = [
    ((0.0, -8.0, -3.0), (16.0, 8.0, 1.0), (0.5, 0.5, 0.2)),
    ((-5.0, -7.0, -2.0), (6.1, 6.3, 2.3), (0.3, 0.7, 0.1)),
    ((0.0, -3.2, -3.0), (7.04, 3.2, 1.0), (0.16, 0.16, 0.125)),
]


def make_points(number: int = 400, channels: int = 1, batch_size: int = 1, seed: int = 0) -> Points:
    """Points spread over and beyond the grids above."""
    random = torch.Generator().manual_seed(seed)
    xyz = (torch.rand(number, 3, generator=random) - 0.3) * torch.tensor([24.0, 24.0, 8.0]) + torch.tensor(
        [0, -5.0, -1]
    )
    features = torch.rand(number, channels, generator=random)
    batch = torch.randint(0, batch_size, (number,), generator=random)
    return Points(xyz, features, batch, batch_size)


def backbone_of(name: str, channels: int = 1, grid: tuple = GRIDS[0], **options: object) -> nn.Module:
    lower, upper, cell = grid
    spec = Spec(Points, channels)
    if name == "pillars":
        return PillarsBackbone(spec, lower=lower, upper=upper, cell=cell[:2], **{"channels": 8, **options})
    small = {"channels": (4, 8, 8, 12), "out_channels": 16}
    return SecondBackbone(spec, lower=lower, upper=upper, cell=cell, **{**small, **options})


def outputs_of(result: BEV | list[Voxels]) -> list[BEV | Voxels]:
    return result if isinstance(result, list) else [result]


def dense_of(result: BEV | list[Voxels]) -> list[Tensor]:
    """Dense maps (B, ...) of all levels, to compare samples of different batches."""
    return [to_dense(level) if isinstance(level, Voxels) else level.features for level in outputs_of(result)]


def assert_fits(spec: Spec, value: BEV | Voxels | Image) -> None:
    """The value is exactly what the spec says."""
    assert spec.kind is type(value)
    assert spec.stride == value.stride
    assert value.features.shape[1] == spec.channels
    if isinstance(value, Voxels):
        assert spec.geometry == value.grid
        assert value.shape == (spec.depth, *spec.grid.shape(spec.stride)[1:])
        assert bool((value.index >= 0).all())
        assert bool((value.index < torch.tensor([value.batch_size, *value.shape])).all())
    if isinstance(value, BEV):
        assert spec.geometry == value.grid
        assert value.features.shape[2:] == spec.grid.shape(spec.stride)[1:]


# --- what comes out is what provides says --------------------------------------------------------------------------


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("channels", [0, 1, 3])
@pytest.mark.parametrize("name", ["pillars", "second"])
def test_provides_equals_the_output(name: str, channels: int, grid: tuple) -> None:
    backbone = backbone_of(name, channels, grid)
    provides = backbone.provides if isinstance(backbone.provides, list) else [backbone.provides]
    outputs = outputs_of(backbone(make_points(channels=channels, batch_size=2)))
    assert len(provides) == len(outputs)
    for spec, value in zip(provides, outputs, strict=True):
        assert_fits(spec, value)
        assert value.batch_size == 2


def test_second_halves_the_depth_as_the_paper_on_kitti() -> None:
    specs = SecondBackbone(Spec(Points, 1)).provides
    assert [s.depth for s in specs] == [40, 20, 10, 2]
    assert [s.stride for s in specs] == [1, 2, 4, 8]
    assert [s.channels for s in specs] == [16, 32, 64, 128]
    assert specs[-1].grid.shape(8)[1:] == (200, 176)


@pytest.mark.parametrize(("cells", "depth"), [(80, 4), (160, 9), (40, 2), (20, 1), (17, 1)])
def test_second_depth_of_other_grids(cells: int, depth: int) -> None:
    grid = ((0.0, 0.0, 0.0), (2.0, 2.0, cells * 0.5), (0.5, 0.5, 0.5))
    backbone = backbone_of("second", 1, grid)
    assert backbone.provides[-1].depth == depth
    points = Points.from_scan(torch.rand(50, 3) * torch.tensor([2, 2, cells * 0.5]), torch.rand(50, 1))
    assert backbone(points)[-1].shape[0] == depth


# --- golden numbers ------------------------------------------------------------------------------------------------


def test_pillars_describe_points_as_the_paper() -> None:
    backbone = PillarsBackbone(Spec(Points, 1), lower=(0, 0, -1), upper=(4, 4, 1), cell=(2, 2))
    xyz = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.4], [3.0, 3.5, 0.2]])
    index = torch.tensor([[0, 0, 0, 0], [0, 0, 1, 1]])
    described = backbone.encoder.describe(xyz, torch.tensor([[0.2], [0.6], [0.9]]), torch.tensor([0, 0, 1]), index)
    expected = [
        [0.5, 0.5, 0.0, 0.2, -0.5, 0.0, -0.2, -0.5, -0.5],
        [1.5, 0.5, 0.4, 0.6, 0.5, 0.0, 0.2, 0.5, -0.5],
        [3.0, 3.5, 0.2, 0.9, 0.0, 0.0, 0.0, 0.0, 0.5],
    ]
    torch.testing.assert_close(described, torch.tensor(expected))


def test_pillars_take_the_maximum_and_stand_at_row_y_column_x() -> None:
    backbone = PillarsBackbone(Spec(Points, 1), lower=(0, 0, -1), upper=(6, 4, 1), cell=(2, 2), channels=2).eval()
    with torch.no_grad():
        backbone.encoder.linear.weight.zero_()
        backbone.encoder.linear.weight[0, 3] = 1  # remission
        backbone.encoder.linear.weight[1, 2] = -10  # -10 z: ReLU cuts it off for z > 0
    xyz = torch.tensor([[4.1, 0.1, 0.5], [5.9, 1.9, 0.1], [1.0, 2.5, -0.5], [6.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    points = Points.from_scan(xyz, torch.tensor([[0.2], [0.7], [0.3], [9.0], [9.0]]))  # the last two lie outside
    scale = 1 / (1 + 1e-3) ** 0.5  # batch normalisation with running mean 0, variance 1
    expected = torch.zeros(1, 2, 2, 3)
    expected[0, 0, 0, 2], expected[0, :, 1, 0] = 0.7 * scale, torch.tensor([0.3, 5.0]) * scale
    torch.testing.assert_close(backbone(points).features, expected)


def test_paper_sizes_in_numbers_of_parameters() -> None:
    pillars = PillarsBackbone(Spec(Points, 1))
    assert pillars.encoder.linear.weight.shape == (64, 9)  # D = 9
    assert pillars.provides.grid.shape() == (1, 500, 440)
    pairs = 4 * 16 + 16 * 16 + 16 * 32 + 2 * 32 * 32 + 32 * 64 + 2 * 64 * 64 + 3 * 64 * 64
    norms = 2 * (2 * 16 + 3 * 32 + 6 * 64 + 128)
    assert count(SecondBackbone(Spec(Points, 1))) == 27 * pairs + 3 * 64 * 128 + norms
    assert count(ResNetBackbone(Spec(Image, 3))) == 11_176_512  # ResNet-18 without its classifier


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def dense_layer(values: Tensor, mask: Tensor, conv: nn.Module, norm: BatchNorm1d) -> tuple[Tensor, Tensor]:
    """A sparse convolution, normalisation and ReLU as dense ones: values and occupied cells (B, C | 1, D, H, W)."""
    kernel = conv.kernel
    weight = conv.weight.view(*kernel.size, conv.in_channels, conv.out_channels).permute(4, 3, 0, 1, 2)
    geometry = {"stride": kernel.stride, "padding": kernel.padding}
    if kernel.stride != (1, 1, 1):
        mask = F.conv3d(mask, torch.ones(1, 1, *kernel.size), **geometry).clamp(max=1)
    values = F.conv3d(values, weight, **geometry)
    shape = (1, -1, 1, 1, 1)
    mean, variance = norm.running_mean.view(shape), norm.running_var.view(shape)
    values = (values - mean) / (variance + 1e-3).sqrt() * norm.weight.view(shape) + norm.bias.view(shape)
    return values.relu() * mask, mask


def test_second_equals_the_same_network_in_dense_convolutions() -> None:
    backbone = backbone_of("second", 2, ((0, -4, -2), (8, 4, 2), (0.5, 0.5, 0.2)))
    backbone(make_points(300, 2))  # moves the running statistics away from 0 and 1
    backbone.eval()
    points = make_points(150, 2, batch_size=2, seed=1)
    voxels = voxelize_mean(points, backbone.grid)
    values, mask = to_dense(voxels), to_dense(voxels.with_features(torch.ones(len(voxels), 1)))
    for stage, level in zip(backbone.stages, backbone(points), strict=True):
        for layer in stage:
            values, mask = dense_layer(values, mask, layer[0], layer[1])
        torch.testing.assert_close(to_dense(level), values, atol=1e-5, rtol=1e-4)
        assert len(level) == int(mask.sum())


# --- samples, few points, gradients --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pillars", "second"])
def test_batch_mates_do_not_change_a_sample(name: str) -> None:
    backbone = backbone_of(name)
    backbone(make_points())
    backbone.eval()
    points = make_points(900, batch_size=3)
    whole = dense_of(backbone(points))
    for number, alone in enumerate(points.samples()):
        for one, several in zip(dense_of(backbone(alone)), whole, strict=True):
            torch.testing.assert_close(one[0], several[number], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("name", ["pillars", "second"])
def test_the_last_sample_may_be_empty(name: str) -> None:
    points = make_points(batch_size=1).replace(batch_size=2)
    for level in dense_of(backbone_of(name)(points)):
        assert level.shape[0] == 2
        assert not level[1].any()


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("name", ["pillars", "second"])
def test_few_points_give_finite_outputs_and_gradients(name: str, number: int, training: bool) -> None:
    backbone = backbone_of(name).train(training)
    points = Points.from_scan(torch.tensor([[3.0, 1.0, -1.0], [9.0, 2.0, 0.0]])[:number], torch.rand(number, 1))
    outputs = outputs_of(backbone(points))
    sum(level.features.square().sum() for level in outputs).backward()
    assert all(bool(level.features.isfinite().all()) for level in outputs)
    for key, parameter in backbone.named_parameters():
        assert parameter.grad is not None, key
        assert bool(parameter.grad.isfinite().all()), key
    assert all(bool(buffer.isfinite().all()) for buffer in backbone.buffers())


def test_points_outside_and_not_finite_are_left_out() -> None:
    points = make_points(100)
    bad = torch.tensor([[torch.nan, 0.0, 0.0], [torch.inf, 0.0, 0.0], [1e9, 0.0, 0.0], [5.0, 0.0, 50.0]])
    more = Points.from_scan(torch.cat([points.xyz, bad]), torch.cat([points.features, torch.full((4, 1), torch.nan)]))
    for name in ("pillars", "second"):
        backbone = backbone_of(name).eval()
        for clean, dirty in zip(dense_of(backbone(points)), dense_of(backbone(more)), strict=True):
            torch.testing.assert_close(clean, dirty)


@pytest.mark.parametrize("name", ["pillars", "second"])
def test_gradient_reaches_every_parameter(name: str) -> None:
    torch.manual_seed(0)
    backbone = backbone_of(name)
    outputs = outputs_of(backbone(make_points(2000)))
    (outputs[-1].features * torch.rand_like(outputs[-1].features)).sum().backward()
    silent = [key for key, parameter in backbone.named_parameters() if not parameter.grad.abs().sum() > 0]
    assert not silent


@pytest.mark.parametrize("name", ["pillars", "second"])
def test_gradient_reaches_the_features_of_the_points(name: str) -> None:
    points = make_points(50)
    points.features.requires_grad_()
    backbone = backbone_of(name)
    outputs_of(backbone(points))[0].features.square().sum().backward()
    assert points.features.grad is not None
    assert float(points.features.grad.abs().sum()) > 0


def test_one_row_is_normalised_by_the_running_statistics() -> None:
    norm = BatchNorm1d(2)
    norm.running_mean[:] = torch.tensor([1.0, 2.0])
    norm.running_var[:] = torch.tensor([4.0, 9.0])
    expected = torch.tensor([[2.0 / 4.001**0.5, 3.0 / 9.001**0.5]])
    torch.testing.assert_close(norm(torch.tensor([[3.0, 5.0]])), expected)
    assert norm(torch.zeros(0, 2)).shape == (0, 2)
    assert norm.running_mean.tolist() == [1.0, 2.0]
    norm(torch.randn(10, 2))
    assert norm.running_mean.tolist() != [1.0, 2.0]


# --- resnet --------------------------------------------------------------------------------------------------------


def make_image(height: int, width: int, stride: int = 1, channels: int = 3, batch_size: int = 1) -> tuple[Spec, Image]:
    camera = Camera("pinhole", width * stride, height * stride, (100.0, 100.0, width / 2, height / 2))
    random = torch.Generator().manual_seed(0)
    features = torch.rand(batch_size, channels, height, width, generator=random)
    return Spec(Image, channels, stride, camera), Image(features, (camera,) * batch_size, stride)


@pytest.mark.parametrize(("height", "width", "stride", "channels"), [(64, 96, 1, 3), (37, 121, 1, 1), (33, 40, 2, 5)])
def test_resnet_provides_equals_the_output(height: int, width: int, stride: int, channels: int) -> None:
    spec, image = make_image(height, width, stride, channels, batch_size=2)
    backbone = ResNetBackbone(spec, channels=(4, 6, 8, 10), blocks=(1, 2, 1, 1))
    for number, (provided, value) in enumerate(zip(backbone.provides, backbone(image), strict=True)):
        assert_fits(provided, value)
        assert provided.stride == stride * 2 ** (2 + number)
        assert provided.geometry == spec.geometry == value.cameras[0]
        assert value.features.shape[2:] == (-(-height // 2 ** (2 + number)), -(-width // 2 ** (2 + number)))


def test_resnet_batch_mates_and_gradients() -> None:
    spec, image = make_image(64, 96, batch_size=2)
    backbone = ResNetBackbone(spec, channels=(4, 6, 8, 10))
    backbone(image)[-1].features.square().sum().backward()
    assert all(p.grad is not None and float(p.grad.abs().sum()) > 0 for p in backbone.parameters())
    backbone.eval()
    alone = Image(image.features[1:], image.cameras[1:])
    for one, both in zip(backbone(alone), backbone(image), strict=True):
        torch.testing.assert_close(one.features[0], both.features[1], atol=1e-5, rtol=1e-5)


def test_resnet_trains_on_a_picture_of_one_cell() -> None:
    spec, image = make_image(8, 8)
    outputs = ResNetBackbone(spec, channels=(4, 4, 4, 4))(image)
    assert outputs[-1].features.shape == (1, 4, 1, 1)
    assert bool(outputs[-1].features.isfinite().all())


def test_a_residual_block_adds_its_input() -> None:
    spec, image = make_image(16, 16)
    backbone = ResNetBackbone(spec, channels=(4, 4, 4, 4), blocks=(1, 1, 1, 1)).eval()
    nn.init.zeros_(backbone.stages[0][0].branch[-1].weight)
    torch.testing.assert_close(backbone(image)[0].features, backbone.stem(image.features))


# --- wrong options -------------------------------------------------------------------------------------------------


def test_wrong_options_say_what_to_write() -> None:
    points = Spec(Points, 1)
    with pytest.raises(ConfigError, match=r"cell size along x must be positive.*\n.*given: lower.*\n.*fix:"):
        PillarsBackbone(points, cell=(0.0, 0.16))
    with pytest.raises(ConfigError, match="make no grid"):
        SecondBackbone(points, lower=(0.0, 0.0))
    with pytest.raises(ConfigError, match=r"at least 17 cells along z, its grid has 16\n.*\n.*at most 0.235 m"):
        SecondBackbone(points, cell=(0.1, 0.1, 0.25))
    with pytest.raises(ConfigError, match=r"four stages.*\n.*channels: \[16, 32\]"):
        SecondBackbone(points, channels=(16, 32))
    with pytest.raises(ConfigError, match="four stages"):
        ResNetBackbone(Spec(Image, 3), blocks=(2, 2))


# --- a real scan ---------------------------------------------------------------------------------------------------


@pytest.fixture
def kitti_scan(real_data: Callable[[str], Path]) -> Points:
    raw = np.fromfile(real_data("kitti_object/training/velodyne/000001.bin"), np.float32).reshape(-1, 4)
    return Points.from_scan(torch.from_numpy(raw[:, :3].copy()), torch.from_numpy(raw[:, 3:].copy()))


def occupied(points: Points, grid: Grid) -> np.ndarray:
    """Rows z, y, x of the occupied cells, computed in numpy."""
    cells = np.floor((points.xyz.numpy() - np.float32(grid.lower)) / np.float32(grid.cell)).astype(int)[:, ::-1]
    return np.unique(cells[((cells >= 0) & (cells < grid.shape())).all(1)], axis=0)


def test_pillars_of_a_real_scan(kitti_scan: Points) -> None:
    backbone = PillarsBackbone(Spec(Points, 1), cell=(0.32, 0.32), channels=32)
    bev = backbone(kitti_scan)
    filled = (bev.features[0] != 0).any(0)
    cells = occupied(kitti_scan, backbone.provides.grid)
    expected = torch.zeros_like(filled)
    expected[cells[:, 1], cells[:, 2]] = True
    assert bool(expected[filled].all())  # ReLU may leave a pillar at 0, no empty one is filled
    assert int(filled.sum()) > 0.95 * len(cells) > 1000


def test_second_on_a_real_scan(kitti_scan: Points) -> None:
    backbone = SecondBackbone(Spec(Points, 1), cell=(0.1, 0.1, 0.1), channels=(8, 8, 16, 16), out_channels=16)
    levels = backbone(kitti_scan)
    cells = occupied(kitti_scan, backbone.grid)
    assert levels[0].index[:, 1:].tolist() == cells.tolist()
    for spec, level in zip(backbone.provides, levels, strict=True):
        assert_fits(spec, level)
    levels[-1].features.square().mean().backward()
    assert all(bool(p.grad.isfinite().all()) and float(p.grad.abs().sum()) > 0 for p in backbone.parameters())
