"""Blocks, backbone and schedule."""

from __future__ import annotations

import math

import pytest
import torch
from lidarfw import merge
from lidarfw.errors import AssemblyError, ConfigError
from lidarfw.types import DataSpec, Points, RangeImage, RangeView, Spec
from torch import nn

from lidarfw_dpdc_mos.backbone import DPDCBackbone
from lidarfw_dpdc_mos.blocks import MetaKernel, MotionGuidedAttention, SoftPool2d
from lidarfw_dpdc_mos.convolution import DPDC2d
from lidarfw_dpdc_mos.schedule import WarmupRestarts

VIEW = RangeView(16, 64, math.radians(3), math.radians(-25))
DATA = DataSpec({"points": Spec(Points, 1)})
SMALL = {"stem": 8, "widths": (16, 16, 16)}


def image(channels: int = 4, view: RangeView = VIEW, batch: int = 1) -> RangeImage:
    g = torch.Generator().manual_seed(0)
    size = (view.height, view.width)
    mask = torch.rand(batch, *size, generator=g) > 0.2
    xyz = torch.randn(batch, 3, *size, generator=g) * 10 * mask[:, None]
    features = torch.rand(batch, channels, *size, generator=g) * mask[:, None]
    return RangeImage(features, xyz, mask, torch.zeros(0, dtype=torch.long), view)


def backbone(channels: int = 4, view: RangeView = VIEW, **options: object) -> DPDCBackbone:
    torch.manual_seed(0)
    return DPDCBackbone(Spec(RangeImage, channels, 1, view), DATA, **{**SMALL, **options})  # type: ignore[arg-type]


def trained(net: DPDCBackbone, channels: int = 4) -> DPDCBackbone:
    """With statistics of normalisation that are not those of the start."""
    for _ in range(3):
        net.train()(image(channels, batch=2))
    return net.eval()


def test_soft_pool() -> None:
    assert float(SoftPool2d()(torch.tensor([[[[1.0, 2], [3, 4]]]]))) == pytest.approx(3.4926527)
    assert SoftPool2d()(torch.tensor([[[[200.0, 0], [0, 0]]]])).tolist() == [[[[200.0]]]]


def test_attention_keeps_what_does_not_move() -> None:
    attention, appearance = MotionGuidedAttention(4), torch.randn(1, 4, 3, 5)
    nn.init.zeros_(attention.which.weight)
    nn.init.zeros_(attention.which.bias)  # type: ignore[arg-type]
    nn.init.zeros_(attention.where.weight)
    for bias, factor in ((-1e4, 1.0), (1e4, 2.0)):
        nn.init.constant_(attention.where.bias, bias)  # type: ignore[arg-type]
        result = attention(appearance, torch.randn(1, 4, 3, 5))
        assert torch.allclose(result, factor * appearance, atol=1e-5)  # the gain of an even softmax is 1


def test_meta_kernel_is_the_unfolded_one() -> None:
    """The weights of the nine neighbours by the definition: a network on their relative coordinates, one by one."""
    torch.manual_seed(0)
    meta = MetaKernel(6, 5, circular=False).eval()
    features, place = torch.randn(2, 6, 4, 7), torch.randn(2, 5, 4, 7)
    around, far = (nn.functional.pad(x, (1, 1, 1, 1)) for x in (features, place))
    total = torch.zeros(2, 6, 4, 7)
    for r in range(3):
        for c in range(3):
            relative = far[..., r : r + 4, c : c + 7] - place
            hidden = nn.functional.conv2d(relative, meta.place.weight) + meta.shift
            weight = meta.weigh(nn.functional.leaky_relu(hidden, 0.01))
            total += nn.functional.conv2d(weight * around[..., r : r + 4, c : c + 7], meta.join[3 * r + c])
    assert torch.allclose(meta(features, place), meta.finish(total), atol=1e-5)


def test_sizes_of_the_paper() -> None:
    net = DPDCBackbone(Spec(RangeImage, 4, 1, RangeView(64, 2048, 0.05, -0.43)), DATA)
    blocks = [module for module in net.modules() if isinstance(module, DPDC2d)]
    assert [(block.in_channels, block.channels, block.size) for block in blocks] == [(32, 32, 5)] * 3
    assert net.provides == Spec(RangeImage, 32, 1, RangeView(64, 2048, 0.05, -0.43))
    before, after = (sum(p.numel() for p in model.parameters()) for model in (net, merge(net)))
    norms = 2 * sum(m.num_features for m in net.modules() if isinstance(m, nn.BatchNorm2d))
    kept = 2 * sum(m.num_features for m in merge(net).modules() if isinstance(m, nn.BatchNorm2d))
    assert before - after == 3 * (37888 - 25600) + norms - kept
    assert 12e6 < before < 15e6


@pytest.mark.parametrize("fusion", ["attention", "add", "concat", "stack"])
def test_merged_network_gives_the_same(fusion: str) -> None:
    net = trained(backbone(6, fusion=fusion), 6)
    given = image(6)
    with torch.no_grad():
        one, other = net(given).features, merge(net)(given).features
    assert float((one - other).abs().max()) <= 1e-5 * max(1.0, float(one.abs().max()))


@pytest.mark.parametrize("channels", [2, 4])
def test_turning_the_input_turns_the_output(channels: int) -> None:
    """T16: with circular columns a shift by a whole cell of the coarsest map shifts the result."""
    net, given = trained(backbone(channels), channels), image(channels)
    turned = RangeImage(given.features.roll(16, -1), given.xyz.roll(16, -1), given.mask.roll(16, -1), given.pixel, VIEW)
    with torch.no_grad():
        assert torch.allclose(net(turned).features, net(given).features.roll(16, -1), atol=1e-5)


def test_zero_padding_holds_inside_only() -> None:
    view = RangeView(16, 256, 0.05, -0.43)
    options = {"circular": False, "meta_kernel": False, "fusion": "add"}
    net = backbone(4, view, **options)
    net.eval()
    given = image(4, view)
    turned = RangeImage(given.features.roll(16, -1), given.xyz.roll(16, -1), given.mask.roll(16, -1), given.pixel, view)
    with torch.no_grad():
        apart = (net(turned).features - net(given).features.roll(16, -1)).abs().amax((0, 1, 2))
    assert float(apart[96:160].max()) < 1e-5 < float(apart[16:24].max())


def test_placement_and_baselines() -> None:
    def places(**options: object) -> int:
        return sum(isinstance(m, DPDC2d) for m in backbone(**options).modules())  # type: ignore[arg-type]

    assert [places(placement=p) for p in ((), ("context",), ("res1", "res3"), ("context", "up1"))] == [0, 3, 2, 4]
    dense = next(m for m in backbone(branches=("dense",)).modules() if isinstance(m, DPDC2d))
    assert dense.merged().weight.numel() == 8 * 8 * 25
    assert backbone(2).motion_context is None
    assert backbone(fusion="stack").motion_context is None


def test_errors_name_the_option() -> None:
    with pytest.raises(ConfigError, match="multiples of 8"):
        backbone(widths=(16, 20))
    with pytest.raises(ConfigError, match="there is no 'res4'"):
        backbone(placement=("res4",))
    with pytest.raises(ConfigError, match="attention, add, concat, stack"):
        backbone(fusion="sum")
    with pytest.raises(AssemblyError, match="height and width that 4 divides"):
        backbone(4, RangeView(18, 64, 0.05, -0.43))


def test_learning_rate_of_the_paper() -> None:
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = WarmupRestarts(optimizer)
    rates = []
    for _ in range(100):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates[:10] == pytest.approx([0.1 * (e + 1) for e in range(10)])
    assert [rates[e] for e in (10, 40, 70)] == [1, 1, 1]
    assert rates[25] == pytest.approx(0.5)
    assert rates[99] == pytest.approx(0.5 * (1 + math.cos(math.pi * 29 / 30)))
    with pytest.raises(ValueError, match="cycle >= 1"):
        WarmupRestarts(optimizer, cycle=0)
