"""Group convolutions turn with their input."""

from __future__ import annotations

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import BEV, Grid, Spec

from lidarfw_crossplace.equivariant import EquivariantBEVBackbone, GroupConv2d, turned_cells

GRID = Grid((-6.2, -6.2, -1.0), (6.2, 6.2, 1.0), (0.4, 0.4, 2.0))  # 31 x 31 cells


def test_filters_turn_by_quarters_exactly() -> None:
    cells = torch.arange(9)
    for turn, quarter in zip(turned_cells(8)[::2], range(4), strict=True):
        assert torch.equal(cells[turn].view(3, 3), torch.rot90(cells.view(3, 3), -quarter))
    assert torch.equal(turned_cells(8)[::2], turned_cells(4))


@pytest.mark.parametrize("turns", [4, 8])
def test_layers_turn_with_the_picture(turns: int) -> None:
    torch.manual_seed(0)
    first, second = GroupConv2d(1, 3, turns, lifting=True), GroupConv2d(3, 2, turns)
    picture = torch.randn(1, 1, 9, 9)
    found, turned = second(first(picture)), second(first(torch.rot90(picture, -1, (2, 3))))
    moved = torch.rot90(found, -1, (2, 3)).view(1, 2, turns, 9, 9).roll(turns // 4, 2).flatten(1, 2)
    assert torch.allclose(turned, moved, atol=1e-5)


@pytest.mark.parametrize("turns", [4, 8])
def test_features_move_with_the_view_and_stay_the_same(turns: int) -> None:
    torch.manual_seed(0)
    net = EquivariantBEVBackbone(Spec(BEV, 1, 1, GRID), turns=turns, channels=(2, 4), halve=(True, True)).eval()
    view = torch.rand(2, 1, 31, 31)
    found = net(BEV(view, GRID)).features
    turned = net(BEV(torch.rot90(view, 1, (2, 3)), GRID)).features
    assert found.shape == (2, 4, 4, 4)
    assert torch.allclose(turned, torch.rot90(found, 1, (2, 3)), atol=1e-5)
    assert not torch.allclose(found, torch.rot90(found, 1, (2, 3)), atol=1e-2)


def test_options_that_cannot_be_are_refused() -> None:
    for wrong in ({"turns": 6}, {"channels": (4,)}, {"channels": ()}):
        with pytest.raises(ConfigError, match="turns: 8, channels"):
            EquivariantBEVBackbone(Spec(BEV, 1, 1, GRID), **wrong)
