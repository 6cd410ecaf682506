"""DPDC2d: kernels, merging and padding (golden values by NumPy)."""

from __future__ import annotations

import copy

import pytest
import torch
from lidarfw import merge
from lidarfw.components.layers import BatchNorm2d
from lidarfw.errors import ConfigError
from torch import Tensor, nn

from lidarfw_dpdc_mos.convolution import BRANCHES, FIVE, DPDC2d, RangeConv2d, convolve, go_round

THREE = {
    "cdc": [[1, 2, 3], [4, -36, 5], [6, 7, 8]],
    "sdc": [[5, 5, 5], [2, 0, -2], [-1, -5, -9]],
    "ddc": [[1, 7, 4], [-2, 0, 4], [-4, -9, -1]],
}
RDC = [[1, 0, 2, 0, 3], [0, -1, -2, -3, 0], [4, -4, 0, -5, 5], [0, -6, -7, -8, 0], [6, 0, 7, 0, 8]]
MERGED = [[2, 0, 4, 0, 6], [0, 6, 12, 9, 0], [8, 0, -31, 2, 11], [0, -5, -14, -10, 0], [13, 0, 15, 0, 17]]


def numbered(**options: object) -> DPDC2d:
    """One channel, weights 1, 2, 3, ... in the order of the pairs."""
    conv = DPDC2d(1, 1, **options)  # type: ignore[arg-type]
    with torch.no_grad():
        for weight in conv.weights.values():
            weight.copy_(torch.arange(1.0, weight.numel() + 1).view_as(weight))
    return conv.double()


def by_branch(conv: DPDC2d, image: Tensor) -> dict[str, Tensor]:
    """What each branch gives by itself, without the bias."""
    return {
        name: convolve(image, kernel, None, conv.stride, 1, conv.groups, conv.circular)
        for name, kernel in conv.kernels().items()
    }


@torch.no_grad()
def test_kernels_of_the_branches() -> None:
    kernels = numbered().kernels()
    for name, expected in THREE.items():
        assert kernels[name][0, 0, 1:4, 1:4].tolist() == expected, name
        assert float(kernels[name].abs().sum()) == sum(abs(v) for row in expected for v in row)
    assert kernels["rdc"][0, 0].tolist() == RDC
    assert kernels["dilated"][0, 0, ::2, ::2].flatten().tolist() == list(range(1, 10))
    assert [float(kernels[name].sum()) for name in FIVE] == [0, 0, 0, 0, 45]


def test_merged_kernel() -> None:
    merged = numbered().merged().weight
    assert merged[0, 0].tolist() == MERGED
    assert float(merged.detach().sum()) == 45
    assert float(merged.detach().abs().sum()) == 165


def test_an_impulse_gives_the_kernel_turned_round() -> None:
    image = torch.zeros(1, 1, 5, 5, dtype=torch.float64)
    image[0, 0, 2, 2] = 1
    conv = numbered()
    assert conv(image)[0, 0].tolist() == [row[::-1] for row in MERGED[::-1]]
    assert by_branch(conv, image)["rdc"][0, 0].tolist() == [row[::-1] for row in RDC[::-1]]


def test_a_ramp() -> None:
    image = torch.arange(25, dtype=torch.float64).view(1, 1, 5, 5)
    conv = numbered()
    parts = by_branch(conv, image)
    assert [float(parts[name][0, 0, 2, 2]) for name in FIVE] == [80, 80, -162, -118, 732]
    result = conv(image)[0, 0]
    assert result[0].tolist() == [248, 213, 328, 24, 92]
    assert result[2].tolist() == [274, 250, 612, 37, 128]
    assert result[4].tolist() == [100, 203, 402, 66, -152]
    assert float((result - sum(parts.values())[0, 0]).abs().max()) == 0


def test_differences_ignore_a_constant() -> None:
    image = torch.full((1, 1, 8, 9), 7.0, dtype=torch.float64)
    for name, part in by_branch(numbered(), image).items():
        inner = part[0, 0, 2:-2, 2:-2].abs().max()
        assert (float(inner) == 0) == (name != "dilated"), name


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"circular": True},
        {"stride": 2},
        {"groups": 2},
        {"dilation": 3},
        {"dilation": 1},
        {"difference_dilation": 2},
        {"branches": [name for name in BRANCHES if name != "dense"]},
        {"branches": ["dense"], "bias": False},
    ],
    ids=str,
)
def test_merged_is_the_sum_of_the_branches(options: dict[str, object]) -> None:
    torch.manual_seed(0)
    for kind, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        conv = DPDC2d(4, 6, **options).to(kind)  # type: ignore[arg-type]
        for weight in conv.weights.values():
            nn.init.normal_(weight, std=weight[0].numel() ** -0.5)
        image = torch.randn(2, 4, 16, 40, dtype=kind)
        bias = 0 if conv.bias is None else conv.bias.detach()[:, None, None]
        parts = sum(by_branch(conv, image).values()) + bias
        merged = conv.merged()
        assert isinstance(merged, RangeConv2d)
        assert float((merged(image) - parts).abs().max()) < tolerance
        assert float((conv(image) - parts).abs().max()) < tolerance


def test_gradients_are_those_of_the_branches() -> None:
    torch.manual_seed(0)
    conv = DPDC2d(3, 2).double()
    image, direction = torch.randn(1, 3, 9, 11, dtype=torch.float64), torch.randn(1, 2, 9, 11, dtype=torch.float64)
    names = [*conv.weights]
    weights = [conv.weights[name] for name in names]
    whole = torch.autograd.grad((conv(image) * direction).sum(), weights)
    parts = torch.autograd.grad((sum(by_branch(conv, image).values()) * direction).sum(), weights)
    for name, one, other in zip(names, whole, parts, strict=True):
        assert torch.allclose(one, other, atol=1e-12), name


def test_sizes_and_parameters() -> None:
    conv = DPDC2d(32, 32, bias=False)
    assert sum(p.numel() for p in conv.parameters()) == 37888
    assert sum(p.numel() for p in conv.merged().parameters()) == 25600
    assert [DPDC2d(1, 1, dilation=d).size for d in (1, 2, 3, 4)] == [5, 5, 7, 9]
    assert DPDC2d(1, 1, difference_dilation=2).size == 9


def test_starts_with_the_variance_of_an_ordinary_convolution() -> None:
    torch.manual_seed(0)
    image = torch.randn(4, 32, 32, 64)
    plain = nn.Conv2d(32, 32, 3, padding=1)(image).std()
    for branches in (FIVE, ("dense",), ("dilated",), ("cdc", "adc", "dilated")):
        assert float(DPDC2d(32, 32, branches=branches)(image).std() / plain) == pytest.approx(1, abs=0.08)


def test_columns_go_round() -> None:
    torch.manual_seed(0)
    image = torch.randn(1, 3, 8, 12)
    for conv in (DPDC2d(3, 2, circular=True), RangeConv2d(3, 2, 2, dilation=2, circular=True)):
        turned = conv(image.roll(5, -1))
        assert torch.allclose(turned, conv(image).roll(5, -1), atol=1e-6)
    assert go_round(torch.arange(3.0).view(1, 1, 1, 3), 4).flatten().tolist() == [2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0]


def test_merge_replaces_blocks_and_folds_norms() -> None:
    torch.manual_seed(0)
    net = nn.Sequential(
        nn.Sequential(DPDC2d(3, 8), BatchNorm2d(8), nn.LeakyReLU()),
        nn.Sequential(RangeConv2d(8, 4, 3, bias=False), nn.BatchNorm2d(4), nn.ReLU()),
        nn.Sequential(nn.ReLU(), nn.BatchNorm2d(4)),  # behind no convolution: stays
    )
    for _ in range(3):
        net(torch.randn(2, 3, 8, 16))
    image, before = torch.randn(2, 3, 8, 16), copy.deepcopy(net.state_dict())
    merged = merge(net)
    assert not merged.training
    kinds = [type(m) for m in merged.modules() if not isinstance(m, nn.Sequential)]
    assert kinds == [RangeConv2d, nn.LeakyReLU, RangeConv2d, nn.ReLU, nn.ReLU, nn.BatchNorm2d]
    assert float((merged(image) - net.eval()(image)).abs().max()) < 1e-5
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    assert isinstance(merge(DPDC2d(3, 8)), RangeConv2d)


def test_weights_are_merged_in_float64() -> None:
    """A single rounding: they are those of the network in float64, and so are the results but for the arithmetic."""
    torch.manual_seed(0)
    net = nn.Sequential(*(nn.Sequential(DPDC2d(8, 8), BatchNorm2d(8), nn.LeakyReLU()) for _ in range(6)))
    for _ in range(3):
        net(30 + 20 * torch.randn(2, 8, 16, 32))
    net.eval()
    image = 30 + 20 * torch.randn(2, 8, 16, 32)
    precise, merged = merge(copy.deepcopy(net).double()), merge(net)
    for one, other in zip(merged.parameters(), precise.parameters(), strict=True):
        assert torch.equal(one, other.float())
    with torch.no_grad():
        truth = copy.deepcopy(net).double()(image.double())
        assert float((precise(image.double()) - truth).abs().max()) < 1e-11
        assert float((merged(image) - truth).abs().max()) < 1e-5 * float(truth.abs().max())


def test_wrong_branches() -> None:
    with pytest.raises(ConfigError, match="no branch 'cdcc'"):
        DPDC2d(1, 1, branches=["cdcc"])
    for branches in ([], ["cdc", "cdc"]):
        with pytest.raises(ConfigError, match="differ from each other"):
            DPDC2d(1, 1, branches=branches)
