"""Layers around sparse convolution: pooling, sequences, fusion for inference, and the way to dense maps and back."""

from __future__ import annotations

import copy
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from lidarfw.ops.rulebook import Kernel, Rulebook, strided_rulebook
from lidarfw.ops.scratch import scratch
from lidarfw.ops.sparse_conv import SparseConvolution, SparseModule, strided_voxels, sum_block, triple
from lidarfw.types import Grid, Voxels


class _SparsePool3d(SparseModule):
    def __init__(
        self,
        kernel_size: int | tuple[int, int, int],
        stride: int | tuple[int, int, int] | None = None,
        padding: int | tuple[int, int, int] = 0,
    ) -> None:
        super().__init__()
        size = triple(kernel_size)
        self.kernel = Kernel(size, size if stride is None else triple(stride), triple(padding))

    def extra_repr(self) -> str:
        return f"kernel_size={self.kernel.size}, stride={self.kernel.stride}, padding={self.kernel.padding}"


class SparseMaxPool3d(_SparsePool3d):
    """Maximum over the cells that are there. `stride` defaults to the kernel size."""

    def forward(self, voxels: Voxels) -> Voxels:
        book = strided_rulebook(voxels, self.kernel).book
        rows = voxels.features.index_select(0, book.inputs)
        target = book.outputs.long()[:, None].expand_as(rows)
        lowest = rows.new_full((book.num_outputs, rows.shape[1]), -torch.inf)
        return strided_voxels(voxels, self.kernel, lowest.scatter_reduce(0, target, rows, "amax"))


class SparseAvgPool3d(_SparsePool3d):
    """Mean over the cells that are there. `stride` defaults to the kernel size."""

    def forward(self, voxels: Voxels) -> Voxels:
        book = strided_rulebook(voxels, self.kernel).book
        summed = cast(Tensor, _PairSum.apply(voxels.features, book))  # type: ignore[no-untyped-call]
        return strided_voxels(voxels, self.kernel, summed / book.pairs_per_output()[:, None].to(summed.dtype))


class _PairSum(torch.autograd.Function):
    """Sum of the inputs of every output, without weights."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, book: Rulebook) -> Tensor:
        ctx.book = book
        return _pair_sum(features, book)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _pair_sum(gradient.contiguous(), ctx.book.transposed()), None


def _pair_sum(features: Tensor, book: Rulebook) -> Tensor:
    sums = []
    for block in book.blocks:
        rows = scratch("products", block.pairs, features.shape[1], features)
        sums.append(sum_block(block, torch.index_select(features, 0, block.inputs, out=rows)))
    return torch.cat(sums)


class SparseSequential(SparseModule, nn.Sequential):
    """A sequence of sparse layers (Voxels -> Voxels) and of plain modules, which see the features (N, C)."""

    def forward(self, voxels: Voxels) -> Voxels:  # type: ignore[override]
        for module in self:
            if isinstance(module, SparseModule):
                voxels = module(voxels)
            else:
                voxels = voxels.with_features(module(voxels.features))
        return voxels


def fuse(module: nn.Module) -> nn.Module:
    """A copy for inference in which what follows a sparse convolution is part of it.

    Within each `SparseSequential`, `BatchNorm1d` directly after a convolution goes into its weight and bias, and
    a ReLU after that is applied to each block of rows while it is in the cache. The copy is in eval mode and must
    stay in it.
    """
    fused = copy.deepcopy(module).eval()
    for sequence in [m for m in fused.modules() if isinstance(m, SparseSequential)]:
        convolution: SparseConvolution | None = None
        for name, layer in list(sequence.named_children()):
            if convolution is not None and not convolution.rectify and isinstance(layer, nn.BatchNorm1d):
                _fold(convolution, layer)
                delattr(sequence, name)
            elif convolution is not None and isinstance(layer, nn.ReLU):
                convolution.rectify = True
                delattr(sequence, name)
            else:
                convolution = layer if isinstance(layer, SparseConvolution) else None
    return fused


def _fold(convolution: SparseConvolution, norm: nn.BatchNorm1d) -> None:
    """Put the affine map of the norm in eval mode into the convolution's weight and bias."""
    if norm.running_mean is None or norm.running_var is None:
        raise ValueError("fuse: a batch normalisation without running statistics cannot be part of a convolution")
    with torch.no_grad():
        gain = torch.rsqrt(norm.running_var + norm.eps) * (1.0 if norm.weight is None else norm.weight)
        shift = (0.0 if norm.bias is None else norm.bias) - norm.running_mean * gain
        bias = shift if convolution.bias is None else shift + convolution.bias * gain
        convolution.weight.mul_(gain)
        convolution.bias = nn.Parameter(bias)


def to_dense(voxels: Voxels) -> Tensor:
    """(B, C, D, H, W) map with zeros where no voxel lies."""
    depth, height, width = voxels.shape
    b, z, y, x = voxels.index.unbind(1)
    dense = voxels.features.new_zeros(voxels.batch_size, depth, height, width, voxels.features.shape[1])
    return dense.index_put((b, z, y, x), voxels.features).permute(0, 4, 1, 2, 3).contiguous()


def from_dense(dense: Tensor, grid: Grid, strides: tuple[int, int, int] = (1, 1, 1)) -> Voxels:
    """Voxels where any channel of dense (B, C, D, H, W) differs from zero."""
    index = (dense.detach() != 0).any(1).nonzero()
    b, z, y, x = index.unbind(1)
    batch, _, depth, height, width = dense.shape
    return Voxels(dense[b, :, z, y, x], index, grid, (depth, height, width), strides, batch)
