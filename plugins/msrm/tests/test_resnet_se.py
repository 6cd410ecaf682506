"""The backbone's shapes and its squeeze and excitation."""

from __future__ import annotations

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.ops import voxelize_mean
from lidarfw.types import Grid, Points, Spec, Voxels
from torch import nn

from lidarfw_msrm.backbones.resnet_se import PLACES, ResNetSE, SqueezeExcitation

GRID = Grid((0.0, 0.0, 0.0), (4.0, 4.0, 4.0), (1.0, 1.0, 1.0))


def voxels(features: list[list[float]], batch: list[int]) -> Voxels:
    cell = torch.arange(len(batch))
    index = torch.stack([torch.tensor(batch), cell % 4, cell // 4, cell * 0], 1)
    return Voxels(torch.tensor(features), index, GRID, (4, 4, 4), batch_size=max(batch) + 1)


def points(seed: int = 0, count: int = 2000, samples: int = 1) -> Points:
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.rand(count, 3, generator=generator) * torch.tensor([16.0, 16, 4]) - torch.tensor([8.0, 8, 2])
    return Points(xyz, torch.rand(count, 1, generator=generator), torch.arange(count) * samples // count, samples)


def small(**options: object) -> ResNetSE:
    torch.manual_seed(0)
    grid = {"lower": (-8.0, -8.0, -2.0), "upper": (8.0, 8.0, 2.0), "cell": (0.2, 0.2, 0.2)}
    widths = {"channels": (4, 8, 8, 8), "out_channels": 8, "blocks": 1}
    return ResNetSE(Spec(Points, 1), **(grid | widths | options))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("lower", "upper", "cell", "shape", "depth"),
    [
        ((0.0, -40.0, -3.0), (70.4, 40.0, 1.0), (0.05, 0.05, 0.05), (200, 176), 4),
        ((-54.0, -54.0, -5.0), (54.0, 54.0, 3.0), (0.075, 0.075, 0.2), (180, 180), 2),
        ((-54.0, -54.0, -5.0), (54.0, 54.0, 3.0), (0.05, 0.05, 0.05), (270, 270), 9),
    ],
)
def test_maps_of_the_papers_grids(
    lower: tuple[float, ...], upper: tuple[float, ...], cell: tuple[float, ...], shape: tuple[int, int], depth: int
) -> None:
    grid = {"lower": lower, "upper": upper, "cell": cell}
    _, bev = ResNetSE(Spec(Points, 1), channels=(4, 4, 4, 4), out_channels=8, blocks=1, **grid).provides  # type: ignore[arg-type]
    assert bev.channels == 8 * depth
    assert bev.grid.shape(8)[1:] == shape


def test_the_mean_of_a_voxel() -> None:
    pair = Points(torch.tensor([[1.0, 0, 0], [3.0, 0, 0]]), torch.tensor([[0.2], [0.4]]), torch.zeros(2).long())
    grid = Grid((0.0, 0.0, 0.0), (4.0, 4.0, 4.0), (4.0, 4.0, 4.0))
    torch.testing.assert_close(voxelize_mean(pair, grid).features, torch.tensor([[2.0, 0, 0, 0.3]]))


def test_excitation_without_weights_halves() -> None:
    block = SqueezeExcitation(2)
    for parameter in block.parameters():
        nn.init.zeros_(parameter)
    found = block(voxels([[1.0, 3.0], [3.0, 5.0]], [0, 0]))
    torch.testing.assert_close(found.features, torch.tensor([[0.5, 1.5], [1.5, 2.5]]))


def test_each_sample_is_squeezed_by_itself() -> None:
    seen = []
    block = SqueezeExcitation(2)
    block.excite.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    first = block(voxels([[1.0, 3.0], [3.0, 5.0], [9.0, 9.0]], [0, 0, 2]))
    torch.testing.assert_close(seen[0], torch.tensor([[2.0, 4.0], [0.0, 0.0], [9.0, 9.0]]))
    second = block(voxels([[1.0, 3.0], [3.0, 5.0], [-7.0, 2.0]], [0, 0, 2]))
    assert torch.equal(first.features[:2], second.features[:2])


@pytest.mark.parametrize("se", PLACES)
def test_every_place_of_excitation(se: str) -> None:
    net = small(se=se)
    blocks = sum(isinstance(module, SqueezeExcitation) for module in net.modules())
    assert blocks == {"none": 0, "input": 1, "all": 5, "conv": 4}[se]
    levels, bev = net(points())
    assert [level.stride for level in levels] == [1, 2, 4, 8]
    assert bev.features.shape == (1, 8, 10, 10)
    assert bool(bev.features.isfinite().all())


def test_refused_options() -> None:
    with pytest.raises(ConfigError, match="none, input, all, conv"):
        small(se="some")
    with pytest.raises(ConfigError, match="17 cells"):
        small(cell=(0.2, 0.2, 0.5))
