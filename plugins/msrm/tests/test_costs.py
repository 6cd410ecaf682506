"""What the decomposed PointNet and the attention over stages cost, by formula and as they are computed."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from lidarfw_msrm.heads.pooling import Aggregation, Sites, aggregation_cost
from lidarfw_msrm.heads.stages import StageAttention


def products(module: nn.Module, *inputs: object) -> int:
    """Multiplications of the matrix products in a call."""
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        module(*inputs)
    return counter.get_total_flops() // 2


def test_costs_of_the_paper() -> None:
    naive, decomposed = aggregation_cost(10_000, 160 * 6**3, 16, 64, 32)
    assert (naive, decomposed) == (1_185_546_240, 73_564_160)
    assert round(naive / decomposed, 4) == 16.1158


def test_the_decomposed_form_costs_what_the_formula_says() -> None:
    class Whole(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = Aggregation(64, 32)

        def forward(self, sites: Sites, xyz: Tensor, pairs: Tensor) -> Tensor:
            return self.layer(self.layer.transform(sites), sites, xyz, pairs)  # type: ignore[no-any-return]

    places, count, number = 50, 16, 200
    sites = Sites(torch.rand(number, 3), torch.rand(number, 64), torch.zeros(number, dtype=torch.long))
    pairs = torch.stack([torch.arange(places).repeat_interleave(count), torch.arange(places * count) % number], 1)
    _, decomposed = aggregation_cost(number, places, count, 64, 32)
    after = places * 32 * 32  # the layer after the maximum
    assert products(Whole().train(), sites, torch.rand(places, 3), pairs) == decomposed + after
    # with fixed normalisation no product is left for the pairs; those with places are not matrix products
    assert products(Whole().eval(), sites, torch.rand(places, 3), pairs) == number * 64 * 32 + after


def test_attention_costs_grow_with_the_regions_and_not_with_their_square() -> None:
    attention = StageAttention(256, 4)
    few, many = (products(attention, torch.rand(regions, 3, 256)) for regions in (16, 160))
    assert many == 10 * few
    # R C^2 S of the paper is one of the linear maps over all stages; keys and values are two, query and output one each
    assert 2 * 160 * 256**2 * 3 == 2 * 31_457_280 < many < 3 * 31_457_280
