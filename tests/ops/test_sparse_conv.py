"""Sparse convolution against dense convolution at the active cells, and its contracts."""

import copy

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor, nn
from torch.nn import functional as F

from lidarfw.ops import (
    SparseAvgPool3d,
    SparseConv3d,
    SparseInverseConv3d,
    SparseMaxPool3d,
    SparseModule,
    SparseSequential,
    SubmanifoldConv3d,
    from_dense,
    fuse,
    rulebook,
    to_dense,
)
from lidarfw.types import Grid, Voxels

SUBMANIFOLD = [(3, 1), ((1, 3, 5), 1), (3, 2), ((3, 1, 1), (2, 1, 1)), (1, 1), (5, (1, 2, 3))]
STRIDED = [
    (3, 2, 1, 1), (3, 2, (0, 1, 1), 1), ((3, 1, 1), (2, 1, 1), 0, 1), (2, 2, 0, 1), (3, 1, 1, 1),
    (3, 2, 2, 2), (3, 3, 1, 1), (1, 2, 0, 1), (4, (1, 2, 3), 1, (1, 2, 1)),
]  # fmt: skip


def make_voxels(count: int, channels: int, batch_size: int = 1, seed: int = 0, shape=(7, 9, 8)) -> Voxels:
    """Random cells (at most `count`) with float64 features."""
    random = torch.Generator().manual_seed(seed)
    size = torch.tensor([batch_size, *shape])
    index = (torch.rand(count, 4, generator=random) * size).long()
    index = torch.unique(index, dim=0) if count else index
    grid = Grid((0, 0, 0), tuple(float(n) for n in reversed(shape)), (1, 1, 1))
    features = torch.randn(len(index), channels, dtype=torch.float64, generator=random)
    return Voxels(features.requires_grad_(), index, grid, shape, batch_size=batch_size)


def dense_weight(conv) -> Tensor:
    shape = (*conv.kernel.size, conv.in_channels, conv.out_channels)
    return conv.weight.view(shape).permute(4, 3, 0, 1, 2)


def at_cells(dense: Tensor, voxels: Voxels) -> Tensor:
    b, z, y, x = voxels.index.unbind(1)
    return dense[b, :, z, y, x]


def dense_conv(voxels: Voxels, conv) -> Tensor:
    kernel = conv.kernel
    return F.conv3d(to_dense(voxels), dense_weight(conv), conv.bias, kernel.stride, kernel.padding, kernel.dilation)


def assert_same_gradients(ours: Tensor, expected: Tensor, inputs: list[Tensor]) -> None:
    weight = torch.randn(ours.shape, dtype=ours.dtype, generator=torch.Generator().manual_seed(9))
    for one, two in zip(
        torch.autograd.grad((ours * weight).sum(), inputs),
        torch.autograd.grad((expected * weight).sum(), inputs),
        strict=True,
    ):
        torch.testing.assert_close(one, two)


@pytest.mark.parametrize(("size", "dilation"), SUBMANIFOLD)
@pytest.mark.parametrize(
    "limits", [{}, {"_TABLE": 2**6}, {"_TABLE": 2}, {"_BLOCK_PAIRS": 32}, {"_BATCH_PAIRS": 8}], ids=str
)
def test_submanifold_equals_dense_convolution(size, dilation, limits: dict[str, int], monkeypatch) -> None:
    for name, value in limits.items():  # several chunks, binary search, several blocks
        monkeypatch.setattr(rulebook, name, value)
    voxels = make_voxels(150, 5, 2)
    conv = SubmanifoldConv3d(5, 4, size, dilation, bias=True).double()
    ours, expected = conv(voxels), at_cells(dense_conv(voxels, conv), voxels)
    torch.testing.assert_close(ours.features, expected)
    assert ours.index is voxels.index
    assert_same_gradients(ours.features, expected, [voxels.features, conv.weight, conv.bias])


@pytest.mark.parametrize("pairs", [2**16, 16])
@pytest.mark.parametrize(("size", "stride", "padding", "dilation"), STRIDED)
def test_strided_equals_dense_convolution(size, stride, padding, dilation, pairs: int, monkeypatch) -> None:
    monkeypatch.setattr(rulebook, "_BLOCK_PAIRS", pairs)
    voxels = make_voxels(60, 5, 2)
    conv = SparseConv3d(5, 4, size, stride, padding, dilation, bias=True).double()
    ours, dense = conv(voxels), dense_conv(voxels, conv)
    assert dense.shape[2:] == ours.shape
    expected = at_cells(dense, ours)
    torch.testing.assert_close(ours.features, expected)
    assert_same_gradients(ours.features, expected, [voxels.features, conv.weight, conv.bias])
    ones = copy.deepcopy(conv)
    nn.init.ones_(ones.weight)
    nn.init.zeros_(ones.bias)
    touched = dense_conv(voxels.with_features(torch.ones_like(voxels.features)), ones)[:, 0] > 0.5
    assert torch.equal(ours.index, touched.nonzero())  # canonical, and exactly the cells that see an input


@pytest.mark.parametrize(("size", "stride", "padding"), [c[:3] for c in STRIDED if c[3] == 1])
def test_inverse_equals_dense_transposed_convolution(size, stride, padding) -> None:
    fine = make_voxels(60, 5, 2)
    coarse = SparseConv3d(5, 6, size, stride, padding).double()(fine)
    coarse = coarse.with_features(coarse.features.detach().requires_grad_())
    conv = SparseInverseConv3d(6, 4, size, stride, padding).double()
    ours = conv(coarse, fine)
    weight = conv.weight.view(*conv.kernel.size, 6, 4).permute(3, 4, 0, 1, 2)
    dense = F.pad(F.conv_transpose3d(to_dense(coarse), weight, None, conv.kernel.stride), (0, 9, 0, 9, 0, 9))
    z, y, x = conv.kernel.padding
    expected = at_cells(dense[:, :, z:, y:, x:], fine)
    torch.testing.assert_close(ours.features, expected)
    assert ours.index is fine.index
    assert_same_gradients(ours.features, expected, [coarse.features, conv.weight])


def test_inverse_refuses_cells_of_another_layer() -> None:
    fine = make_voxels(60, 5)
    coarse = SparseConv3d(5, 6, 3, 2, 1).double()(fine)
    with pytest.raises(ValueError, match="geometry of the layer to undo"):
        SparseInverseConv3d(6, 5, 2, 2).double()(coarse, fine)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 40), st.integers(1, 3), st.tuples(*[st.integers(1, 9)] * 3), st.tuples(*[st.integers(1, 3)] * 3),
    st.integers(1, 3), st.integers(0, 1), st.integers(0, 10**6),
)  # fmt: skip
def test_any_shape_stride_and_batch(count, batch_size, shape, size, stride, padding, seed) -> None:
    torch.manual_seed(seed)
    voxels = make_voxels(count, 3, batch_size, seed, shape)
    if all(n + 2 * padding >= k for n, k in zip(shape, size, strict=True)):
        conv = SparseConv3d(3, 2, size, stride, padding).double()
        ours = conv(voxels)
        torch.testing.assert_close(ours.features, at_cells(dense_conv(voxels, conv), ours))
    conv = SubmanifoldConv3d(3, 2).double()
    torch.testing.assert_close(conv(voxels).features, at_cells(dense_conv(voxels, conv), voxels))


@pytest.mark.parametrize("layer", [SubmanifoldConv3d(3, 2, bias=True), SparseConv3d(3, 2, 3, 2, 1, bias=True)])
@pytest.mark.parametrize("count", [0, 1, 12])
def test_gradients_match_finite_differences(layer, count: int) -> None:
    voxels, layer = make_voxels(count, 3), layer.double()

    def run(features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        parameters = {"weight": weight, "bias": bias}
        return torch.func.functional_call(layer, parameters, (voxels.with_features(features),)).features

    inputs = [t.detach().clone().requires_grad_() for t in (voxels.features, layer.weight, layer.bias)]
    assert torch.autograd.gradcheck(run, inputs)


@pytest.mark.parametrize(
    "layer",
    [SubmanifoldConv3d(3, 2), SparseConv3d(3, 2, 3, 2, 1), SparseMaxPool3d(2), SparseAvgPool3d(3, 2, 1)],
)
def test_no_voxels_give_zero_gradients_in_the_graph(layer) -> None:
    voxels = make_voxels(0, 3, 2)
    output = layer.double()(voxels)
    assert len(output) == 0
    assert to_dense(output).shape[0] == 2
    output.features.sum().backward()
    assert voxels.features.grad is not None
    for parameter in layer.parameters():
        assert torch.equal(parameter.grad, torch.zeros_like(parameter))


def test_pooling_equals_dense_pooling() -> None:
    voxels = make_voxels(120, 4, 2)
    lowest = to_dense(voxels.with_features(voxels.features - voxels.features.min() + 1))  # positive, empty = 0
    pooled = SparseMaxPool3d(3, 2, 1)(voxels.with_features(voxels.features - voxels.features.min() + 1))
    torch.testing.assert_close(pooled.features, at_cells(F.max_pool3d(lowest, 3, 2, 1), pooled))
    mean = SparseAvgPool3d(3, 2, 1)(voxels)
    ones = voxels.with_features(torch.ones_like(voxels.features))
    total, number = (F.avg_pool3d(to_dense(v), 3, 2, 1) for v in (voxels, ones))
    torch.testing.assert_close(mean.features, at_cells(total, mean) / at_cells(number, mean))
    assert torch.equal(pooled.index, mean.index)
    for layer in (SparseMaxPool3d(3, 2, 1), SparseAvgPool3d(2)):
        assert torch.autograd.gradcheck(
            lambda f, layer=layer: layer(voxels.with_features(f)).features,
            voxels.features.detach().clone().requires_grad_(),
        )


def small_net() -> SparseSequential:
    return SparseSequential(
        SubmanifoldConv3d(3, 8), nn.BatchNorm1d(8), nn.ReLU(),
        SparseSequential(SparseConv3d(8, 8, 3, 2, 1), nn.BatchNorm1d(8), nn.ReLU(), SubmanifoldConv3d(8, 8, bias=True)),
        SparseMaxPool3d(2),
    )  # fmt: skip


def test_a_sample_does_not_depend_on_its_batch_mates() -> None:
    net = small_net().double().eval()
    voxels = make_voxels(200, 3, 3)
    together = net(voxels)
    for number in range(3):
        rows = voxels.index[:, 0] == number
        index = voxels.index[rows] * torch.tensor([0, 1, 1, 1])
        alone = net(Voxels(voxels.features[rows], index, voxels.grid, voxels.shape))
        mates = together.index[:, 0] == number
        assert torch.equal(alone.index[:, 1:], together.index[mates, 1:])
        torch.testing.assert_close(alone.features, together.features[mates], rtol=1e-12, atol=1e-12)


def test_layers_of_equal_kernel_share_one_rulebook() -> None:
    voxels = make_voxels(100, 3)
    one, two = SubmanifoldConv3d(3, 3).double(), SubmanifoldConv3d(3, 3, bias=True).double()
    first = rulebook.submanifold_rulebook(one(voxels), one.kernel)
    assert rulebook.submanifold_rulebook(two(one(voxels)), two.kernel) is first
    down = SparseConv3d(3, 3, 3, 2, 1).double()
    assert down(voxels).index is down(two(voxels)).index


def test_replaced_or_moved_cells_get_their_own_rulebook() -> None:
    conv = SubmanifoldConv3d(3, 3).double()
    voxels, other = make_voxels(100, 3), make_voxels(100, 3, seed=5)
    conv(voxels)
    expected = conv(make_voxels(100, 3, seed=5)).features
    replaced = voxels.replace(features=other.features, index=other.index)
    torch.testing.assert_close(conv(replaced).features, expected)
    torch.testing.assert_close(conv(voxels.map(lambda t: t.clone())).features, conv(voxels).features)


def test_unsorted_cells_are_refused() -> None:
    voxels = make_voxels(50, 3)
    wrong = Voxels(voxels.features, voxels.index.flip(0), voxels.grid, voxels.shape)
    with pytest.raises(ValueError, match=r"sorted by \(b, z, y, x\)"):
        SubmanifoldConv3d(3, 3).double()(wrong)


def test_wrong_channels_and_even_kernels_are_named() -> None:
    with pytest.raises(ValueError, match="3 channels, the layer takes 4"):
        SubmanifoldConv3d(4, 4).double()(make_voxels(10, 3))
    with pytest.raises(ValueError, match="odd"):
        SubmanifoldConv3d(4, 4, 2)


def test_strides_and_shape_follow_the_layers() -> None:
    voxels = make_voxels(100, 3, shape=(9, 16, 24))
    down = SparseConv3d(3, 3, (3, 1, 1), (2, 1, 1)).double()(SparseConv3d(3, 3, 3, 2, 1).double()(voxels))
    assert down.strides == (4, 2, 2)
    assert down.shape == (2, 8, 12)
    assert down.stride == 2


def test_dense_and_back() -> None:
    voxels = make_voxels(80, 4, 2)
    again = from_dense(to_dense(voxels), voxels.grid)
    assert torch.equal(again.index, voxels.index)
    assert torch.equal(again.features, voxels.features)
    assert torch.autograd.gradcheck(
        lambda f: to_dense(voxels.with_features(f)), voxels.features.detach().clone().requires_grad_()
    )


@pytest.mark.parametrize("layer", [SubmanifoldConv3d(16, 32), SparseConv3d(16, 32, 3, 2, 1), SparseAvgPool3d(2)])
def test_threads_do_not_change_the_result(layer) -> None:
    voxels = make_voxels(20000, 16, 2, shape=(20, 60, 60))
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            fresh = voxels.replace(features=voxels.features.detach().float().requires_grad_(), cache={})
            output = layer(fresh).features
            gradients = torch.autograd.grad(output.square().sum(), [fresh.features, *layer.parameters()])
            results.append((output.detach(), *gradients))
    finally:
        torch.set_num_threads(threads)
    (output, d_features, *d_weight), (output_2, d_features_2, *d_weight_2) = results
    assert torch.equal(output, output_2)
    assert torch.equal(d_features, d_features_2)
    for one, two in zip(d_weight, d_weight_2, strict=True):  # sums over thousands of pairs, split between threads
        assert (one - two).abs().max() <= 1e-5 * one.abs().max()


def test_autocast_on_the_cpu_computes_in_float32() -> None:
    conv, voxels = SubmanifoldConv3d(3, 4), make_voxels(50, 3)
    voxels = voxels.with_features(voxels.features.detach().bfloat16())
    with torch.autocast("cpu", torch.bfloat16):
        output = conv(voxels)
        output.features.sum().backward()
    assert output.features.dtype == torch.float32
    assert conv.weight.grad.dtype == torch.float32


def test_more_cells_than_an_int32_counts() -> None:
    """Two clusters at the far ends of a grid of 2^33 cells give what they give in a small one."""
    voxels, conv = make_voxels(60, 3, shape=(8, 10, 8)), SubmanifoldConv3d(3, 4).double()
    near = voxels.index.repeat(2, 1)
    near[len(voxels) :, 0] = 1
    far, move = near.clone(), torch.tensor([0, 2000, 2000, 2000])
    far[len(voxels) :] += move - torch.tensor([1, 0, 0, 0])
    features, grid = voxels.features.repeat(2, 1), Grid((0, 0, 0), (2048, 2048, 2048), (1, 1, 1))
    ours = conv(Voxels(features, far, grid, (2048, 2048, 2048)))
    expected = conv(Voxels(features, near, voxels.grid, voxels.shape, batch_size=2))
    torch.testing.assert_close(ours.features, expected.features)
    down = SparseConv3d(3, 4, 2, 2).double()(Voxels(features, far, grid, (2048, 2048, 2048)))
    assert down.index.max() >= 1000
    assert len(down) == 2 * len(SparseConv3d(3, 4, 2, 2).double()(voxels))


def test_fused_for_inference_gives_the_same_and_leaves_the_original() -> None:
    torch.manual_seed(0)
    net, voxels = small_net().double(), make_voxels(200, 3, 2)
    for _ in range(3):
        net(voxels)  # running statistics that are not the initial ones
    fused = fuse(net)
    assert not any(isinstance(m, nn.BatchNorm1d) for m in fused.modules())
    assert any(isinstance(m, nn.BatchNorm1d) for m in net.modules())
    torch.testing.assert_close(fused(voxels).features, net.eval()(voxels).features)


def test_sequence_takes_sparse_modules_of_others() -> None:
    class Residual(SparseModule):
        def __init__(self) -> None:
            super().__init__()
            self.conv = SubmanifoldConv3d(3, 3).double()

        def forward(self, voxels: Voxels) -> Voxels:
            return voxels.with_features(voxels.features + self.conv(voxels).features)

    block, voxels = Residual(), make_voxels(50, 3)
    expected = (voxels.features + block.conv(voxels).features).relu()
    assert torch.equal(SparseSequential(block, nn.ReLU())(voxels).features, expected)
