"""Sparse 3D convolution in plain torch, for CPU and GPU.

Submanifold convolution after Graham et al., "3D Semantic Segmentation with Submanifold Sparse
Convolutional Networks" (CVPR 2018), section 3. The compute is gather, one matrix product per kernel
element, and a sum by output row: the gathered rows of all elements lie in one scratch buffer that is
kept between calls, and the sum is an `embedding_bag`, which needs no atomic addition. Each output row adds
its terms in a fixed order, so results do not depend on the number of threads.

Weights are (kernel volume, C_in, C_out), elements in z, y, x order: the dense `conv3d` weight is
`weight.view(kz, ky, kx, C_in, C_out).permute(4, 3, 0, 1, 2)`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import accumulate
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from lidarfw.errors import LidarfwError
from lidarfw.ops.product import SLACK, add_product, add_transposed_product, multiply
from lidarfw.ops.rulebook import Batch, Block, Kernel, Rulebook, Triple, strided_rulebook, submanifold_rulebook
from lidarfw.ops.scratch import scratch
from lidarfw.types import Voxels


def convolve(
    features: Tensor, weight: Tensor, book: Rulebook, bias: Tensor | None = None, rectify: bool = False
) -> Tensor:
    """(num_outputs, C_out): every pair's input row times the weight of its element, summed by output row.

    Block by block: per element gather the rows, multiply; then sum the products, and add the product of
    the centre, which is an identity and needs no gathering. Not differentiable.

    Args:
        bias: (C_out,) added to every row.
        rectify: set what is negative to 0, while the block is in the cache.
    """
    weights = weight.unbind()
    output = features.new_empty(book.num_outputs, weight.shape[2])
    for block in book.blocks:
        products = scratch("products", block.pairs + SLACK, weight.shape[2], features)
        rows = scratch("rows", block.largest + SLACK, weight.shape[1], features)
        for done, batch in _batches(block):
            torch.index_select(features, 0, batch.inputs, out=rows[: batch.pairs])
            multiply(rows, batch.sizes, [weights[element] for element in batch.elements], products[done:])
        total = sum_block(block, products)
        if book.symmetric:
            add_product(features[block.rows], weights[book.volume // 2], total)
        total = total if bias is None else total.add_(bias)
        total = total.relu_() if rectify else total
        if len(book.blocks) == 1:
            return total
        output[block.rows] = total
    return output


def sum_block(block: Block, products: Tensor) -> Tensor:
    """(rows, C) sums of the products (at least pairs, C) of a block."""
    if not block.pairs:
        return products.new_zeros(block.rows.stop - block.rows.start, products.shape[1])
    return F.embedding_bag(block.order, products, block.starts, mode="sum", include_last_offset=True)


class _Convolution(torch.autograd.Function):
    """Saves features and weight only; gathered rows are gathered again for the gradients."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, book: Rulebook) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.book = book
        with torch.autocast(features.device.type, enabled=False):
            return convolve(features, weight, book)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        features, weight = ctx.saved_tensors
        need_features, need_weight, _ = ctx.needs_input_grad
        with torch.autocast(features.device.type, enabled=False):
            d_features, d_weight = _gradients(
                features, weight, gradient.contiguous(), ctx.book.transposed(), need_features, need_weight
            )
        return d_features, d_weight, None


def _gradients(
    features: Tensor, weight: Tensor, gradient: Tensor, book: Rulebook, need_features: bool, need_weight: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Gradients of features and weight, over the transposed rulebook, which leads from outputs to inputs."""
    flipped = weight.transpose(1, 2).contiguous().unbind()
    d_features = torch.empty_like(features) if need_features else None
    d_weight = torch.zeros_like(weight) if need_weight else None
    for block in book.blocks:
        products = scratch("products", block.pairs + SLACK, weight.shape[1], gradient)
        _block_gradients(block, features, gradient, flipped, products if need_features else None, d_weight)
        if d_features is not None:
            d_features[block.rows] = sum_block(block, products)
    if book.symmetric:
        centre = book.volume // 2
        if d_features is not None:
            add_product(gradient, flipped[centre], d_features)
        if d_weight is not None:
            add_transposed_product(features, gradient, (len(features),), (d_weight[centre],))
    return d_features, d_weight


def _block_gradients(
    block: Block,
    features: Tensor,
    gradient: Tensor,
    flipped: tuple[Tensor, ...],
    products: Tensor | None,
    d_weight: Tensor | None,
) -> None:
    """Fill the products (pairs, C_in) that sum to the gradient of the features; add to the gradient of the weight."""
    arrived = scratch("rows", block.largest + SLACK, gradient.shape[1], gradient)
    seen = scratch("features", block.largest, features.shape[1], features)
    for done, batch in _batches(block):
        rows = torch.index_select(gradient, 0, batch.inputs, out=arrived[: batch.pairs])
        if d_weight is not None:
            own = torch.index_select(features, 0, batch.outputs, out=seen[: batch.pairs])
            add_transposed_product(own, rows, batch.sizes, [d_weight[element] for element in batch.elements])
        if products is not None:
            multiply(arrived, batch.sizes, [flipped[element] for element in batch.elements], products[done:])


def _batches(block: Block) -> Iterator[tuple[int, Batch]]:
    """The batches, each with the number of pairs before it."""
    return zip(accumulate((batch.pairs for batch in block.batches), initial=0), block.batches)


def triple(value: int | tuple[int, int, int]) -> Triple:
    return (value, value, value) if isinstance(value, int) else (value[0], value[1], value[2])


def _compute_types(features: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Features and weight in the type to compute in.

    Under autocast that is its type on a GPU, and float32 on a CPU, where 16 bit products are slower.
    """
    kind = features.device.type
    if torch.is_autocast_enabled(kind):
        target = torch.float32 if kind == "cpu" else torch.get_autocast_dtype(kind)
        return features.to(target), weight.to(target)
    return features, weight


class SparseModule(nn.Module):
    """Base of the layers that take Voxels and give Voxels, so that `SparseSequential` knows them.

    `torch.export`, `torch.jit.trace` and ONNX, which cannot express them, are refused with advice.
    """

    def __call__(self, *args: Any, **kwargs: Any) -> Voxels:
        exporting = torch.compiler.is_compiling() and not torch.compiler.is_dynamo_compiling()
        if exporting or torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
            raise LidarfwError(
                f"{type(self).__name__} cannot be exported: how many pairs a sparse layer has depends on the scan.\n"
                "  Export the dense part behind it (neck and heads, which take a BEV); run the sparse backbone eagerly."
            )
        return cast(Voxels, super().__call__(*args, **kwargs))


class SparseConvolution(SparseModule):
    """Weights and geometry that the sparse convolutions share."""

    def __init__(self, in_channels: int, out_channels: int, kernel: Kernel, bias: bool) -> None:
        super().__init__()
        self.in_channels, self.out_channels, self.kernel = in_channels, out_channels, kernel
        self.weight = nn.Parameter(torch.empty(kernel.volume, in_channels, out_channels))
        self.bias = nn.Parameter(torch.empty(out_channels)) if bias else None
        self.rectify = False  # set by `fuse`: a ReLU is part of the layer
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Uniform in +-1/sqrt(fan in), as torch's dense convolutions."""
        bound = 1 / math.sqrt(self.kernel.volume * self.in_channels)
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -bound, bound)

    def extra_repr(self) -> str:
        kernel = self.kernel
        text = f"{self.in_channels}, {self.out_channels}, kernel_size={kernel.size}"
        for name, value in (("stride", kernel.stride), ("padding", kernel.padding), ("dilation", kernel.dilation)):
            text += f", {name}={value}" if value not in ((1, 1, 1), (0, 0, 0)) else ""
        return text + f", bias={self.bias is not None}"

    def _apply_rulebook(self, features: Tensor, book: Rulebook) -> Tensor:
        if features.shape[1] != self.in_channels:
            raise ValueError(
                f"{type(self).__name__}: voxels have {features.shape[1]} channels, the layer takes {self.in_channels}"
            )
        features, weight = _compute_types(features, self.weight)
        bias = None if self.bias is None else self.bias.to(weight.dtype)
        if not torch.is_grad_enabled():
            with torch.autocast(features.device.type, enabled=False):
                return convolve(features.contiguous(), weight, book, bias, self.rectify)
        output = cast(Tensor, _Convolution.apply(features.contiguous(), weight, book))  # type: ignore[no-untyped-call]
        output = output if bias is None else output.add_(bias)
        return output.relu_() if self.rectify else output


class SubmanifoldConv3d(SparseConvolution):
    """Convolution whose output cells are its input cells; zero where no input lies.

    `kernel_size` and `dilation` are numbers or (z, y, x); the kernel must be odd.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | tuple[int, int, int] = 3,
        dilation: int | tuple[int, int, int] = 1,
        bias: bool = False,
    ) -> None:
        size, dilation = triple(kernel_size), triple(dilation)
        if not all(k % 2 for k in size):
            raise ValueError(f"SubmanifoldConv3d: kernel_size must be odd to have a centre, got {size}")
        padding = (size[0] // 2 * dilation[0], size[1] // 2 * dilation[1], size[2] // 2 * dilation[2])
        super().__init__(in_channels, out_channels, Kernel(size, (1, 1, 1), padding, dilation), bias)

    def forward(self, voxels: Voxels) -> Voxels:
        return voxels.with_features(self._apply_rulebook(voxels.features, submanifold_rulebook(voxels, self.kernel)))


class SparseConv3d(SparseConvolution):
    """Convolution with a stride: an output cell exists where its kernel sees at least one input cell.

    The output shape is floor((n + 2 p - d (k - 1) - 1) / s) + 1 along each axis.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | tuple[int, int, int],
        stride: int | tuple[int, int, int] = 1,
        padding: int | tuple[int, int, int] = 0,
        dilation: int | tuple[int, int, int] = 1,
        bias: bool = False,
    ) -> None:
        kernel = Kernel(triple(kernel_size), triple(stride), triple(padding), triple(dilation))
        super().__init__(in_channels, out_channels, kernel, bias)

    def forward(self, voxels: Voxels) -> Voxels:
        book = strided_rulebook(voxels, self.kernel).book
        return strided_voxels(voxels, self.kernel, self._apply_rulebook(voxels.features, book))


def strided_voxels(voxels: Voxels, kernel: Kernel, features: Tensor) -> Voxels:
    """The voxels that a strided convolution or pooling of `voxels` makes, with their features."""
    made = strided_rulebook(voxels, kernel)
    (a, b, c), (d, e, f) = voxels.strides, kernel.stride
    strides = (a * d, b * e, c * f)
    return Voxels(features, made.index, voxels.grid, made.shape, strides, voxels.batch_size, made.cache)


class SparseInverseConv3d(SparseConvolution):
    """The transpose of a strided convolution: from its output cells back to its input cells.

    Give it the geometry of the `SparseConv3d` (or pooling) to undo; forward takes the coarse voxels and
    the fine ones that went into that layer.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | tuple[int, int, int],
        stride: int | tuple[int, int, int] = 1,
        padding: int | tuple[int, int, int] = 0,
        dilation: int | tuple[int, int, int] = 1,
        bias: bool = False,
    ) -> None:
        kernel = Kernel(triple(kernel_size), triple(stride), triple(padding), triple(dilation))
        super().__init__(in_channels, out_channels, kernel, bias)

    def forward(self, voxels: Voxels, fine: Voxels) -> Voxels:
        """Features on the cells of `fine`.

        Raises:
            ValueError: `voxels` are not the output cells of a layer of this geometry on `fine`.
        """
        made = strided_rulebook(fine, self.kernel)
        if made.index is not voxels.index and not torch.equal(made.index, voxels.index):
            raise ValueError(
                f"SparseInverseConv3d: the {len(voxels)} coarse voxels are not what {self.kernel} makes of the "
                f"{len(fine)} fine ones ({len(made.index)} cells); give it the geometry of the layer to undo"
            )
        return fine.with_features(self._apply_rulebook(voxels.features, made.book.transposed()))
