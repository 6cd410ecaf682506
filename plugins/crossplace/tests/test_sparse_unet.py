"""Classes of points by the sparse U-Net."""

from __future__ import annotations

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import DataSpec, PointLabels, Points, Spec, Targets, Voxels

from lidarfw_crossplace.sparse_unet import MinkUNetBackbone, PointCrossEntropyLoss, VoxelLabelsHead

SMALL = {
    "lower": (-8.0, -8.0, -2.0),
    "upper": (8.0, 8.0, 2.0),
    "cell": (0.5, 0.5, 0.5),
    "channels": (8, 8, 16, 16, 16),
    "up_channels": (16, 16, 8, 8),
    "blocks": (1,) * 8,
}
DATA = DataSpec({"points": Spec(Points, 1)}, frozenset({PointLabels}), ("ground", "wall"))


def scene(seed: int) -> tuple[Points, Targets]:
    """A ground with walls of any place on it: a point alone does not say which of the two it is of."""
    draw = torch.Generator().manual_seed(seed)
    ground = torch.rand(1500, 3, generator=draw) * torch.tensor([16.0, 16.0, 0.0]) - torch.tensor([8.0, 8.0, 0.0])
    ground[:, 2] = torch.rand(1, generator=draw) * 3 - 1.9
    wall = torch.rand(700, 3, generator=draw) * torch.tensor([0.2, 8.0, 1.5])
    wall += torch.tensor([float(torch.rand(1, generator=draw)) * 12 - 6, -4.0, 0.0])
    wall[:, 2] += ground[0, 2]
    xyz = torch.cat([ground, wall])
    label = torch.cat([torch.zeros(1500), torch.ones(700)]).long()
    batch = torch.zeros(len(xyz), dtype=torch.long)
    truth = PointLabels(torch.nn.functional.one_hot(label, 2).float(), batch)
    return Points(xyz, torch.zeros(len(xyz), 1), batch, 1), Targets(points=truth)


def test_34c_has_the_size_of_the_original() -> None:
    net = MinkUNetBackbone(Spec(Points, 1))
    assert 35e6 < sum(weight.numel() for weight in net.parameters()) < 45e6
    assert net.provides.channels == 96


def test_it_learns_what_a_point_alone_does_not_tell() -> None:
    torch.manual_seed(0)
    net = MinkUNetBackbone(Spec(Points, 1), **SMALL)
    head = VoxelLabelsHead(net.provides, Spec(Points, 1), DATA)
    loss, weights = PointCrossEntropyLoss(), [*net.parameters(), *head.parameters()]
    optimizer = torch.optim.Adam(weights, lr=1e-2)
    for step in range(25):
        points, targets = scene(step)
        lost = loss(head(net(points), points), targets)["cross_entropy"]
        optimizer.zero_grad()
        lost.backward()
        optimizer.step()
    net.eval()
    points, targets = scene(1000)
    found = head.decode(head(net(points), points))
    assert targets.points is not None
    assert (found.label == targets.points.label).float().mean() > 0.9


def test_points_outside_of_the_grid_have_no_class() -> None:
    torch.manual_seed(0)
    net = MinkUNetBackbone(Spec(Points, 1), **SMALL).eval()
    head = VoxelLabelsHead(net.provides, Spec(Points, 1), DATA)
    xyz = torch.tensor([[-7.9, -7.9, -1.9], [100.0, 0, 0], [float("nan"), 0, 0]])
    points = Points(xyz, torch.zeros(3, 1), torch.zeros(3, dtype=torch.long), 1)
    inside = points[torch.tensor([True, False, False])]
    voxels: Voxels = net(inside)
    found = head.decode(head(voxels, points))
    assert found.label.tolist()[1:] == [-1, -1]
    assert float(found.probability[0].sum().detach()) == pytest.approx(1)
    assert PointCrossEntropyLoss()(head(voxels, points), Targets())["cross_entropy"] == 0


def test_wrong_widths_are_named() -> None:
    with pytest.raises(ConfigError, match="5 channels, 4 up_channels and 8 blocks"):
        MinkUNetBackbone(Spec(Points, 1), channels=(4, 4))
