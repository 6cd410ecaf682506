"""Rulebooks: which input row meets which output row under which element of the kernel.

A rulebook depends on coordinates and kernel only. It is made once and kept in `Voxels.cache`, so every
layer of equal kernel on the same cells shares it, whatever the layers are called.

Sites are numbered by the key of a grid with a margin around it, so a neighbour is key + constant and
never wraps to another line; the order of the keys is the canonical order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarfw.ops.cells import cell_columns, cell_index, cell_key, key_type, row_starts
from lidarfw.ops.scratch import scratch, zeroed
from lidarfw.types import Voxels

Triple = tuple[int, int, int]

_TABLE = 2**21  # chunks of the key space that the first lookup table counts: 8 MB
_BLOCK_PAIRS = 3 * 2**15  # pairs computed at a time: their products, 24 MB at 64 channels, stay in the cache
_BATCH_PAIRS = 2**14  # pairs whose rows are gathered by one call, where several kernel elements have so few


@dataclass(frozen=True)
class Kernel:
    """Geometry of a convolution, each as (z, y, x)."""

    size: Triple
    stride: Triple = (1, 1, 1)
    padding: Triple = (0, 0, 0)
    dilation: Triple = (1, 1, 1)

    @property
    def volume(self) -> int:
        return self.size[0] * self.size[1] * self.size[2]

    def output_shape(self, shape: Triple) -> Triple:
        """floor((n + 2 p - d (k - 1) - 1) / s) + 1 along each axis."""
        axes = zip(shape, self.size, self.stride, self.padding, self.dilation, strict=True)
        depth, height, width = ((n + 2 * p - d * (k - 1) - 1) // s + 1 for n, k, s, p, d in axes)
        return depth, height, width


@dataclass
class Batch:
    """Pairs under a few kernel elements, side by side: their rows are gathered by one call."""

    inputs: Tensor  # (pairs,) int32 input rows, by element
    outputs: Tensor  # (pairs,) int32 output rows
    elements: tuple[int, ...]  # kernel elements
    sizes: tuple[int, ...]  # pairs of each element

    @property
    def pairs(self) -> int:
        return len(self.inputs)


@dataclass
class Block:
    """A run of output rows and the pairs that reach them: what is computed at a time.

    The products of a block stay in the processor's cache until they are summed, and its size bounds the
    scratch memory, whatever the size of the scan.
    """

    rows: slice  # output rows
    inputs: Tensor  # (pairs,) int32 input rows, of all batches
    batches: tuple[Batch, ...]
    order: Tensor  # (pairs,) int32 pairs of the block sorted by output row
    starts: Tensor  # (rows + 1,) int32: row r of the block owns order[starts[r]:starts[r + 1]]

    @property
    def pairs(self) -> int:
        return len(self.order)

    @property
    def largest(self) -> int:
        """Pairs of the largest batch."""
        return max((batch.pairs for batch in self.batches), default=0)


@dataclass
class Rulebook:
    """Pairs of input and output rows, by block, and within it by kernel element; each such run ascends in both."""

    inputs: Tensor  # (P,) int32 row of the input
    outputs: Tensor  # (P,) int32 row of the output
    blocks: tuple[Block, ...]  # each of at most about `_BLOCK_PAIRS` pairs, covering all output rows
    num_inputs: int
    num_outputs: int
    volume: int  # elements of the kernel
    symmetric: bool = False  # submanifold: the pairs of an element are those of its mirror image, swapped
    _transposed: Rulebook | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return int(self.inputs.shape[0])

    def transposed(self) -> Rulebook:
        """The rulebook from outputs to inputs, for gradients and inverse convolution.

        That of a submanifold convolution holds the same pairs, under mirrored kernel elements.
        """
        if self._transposed is None:
            self._transposed = self._mirrored() if self.symmetric else self._turned()
            self._transposed._transposed = self
        return self._transposed

    def _mirrored(self) -> Rulebook:
        def mirrored(batch: Batch) -> Batch:
            return replace(batch, elements=tuple(self.volume - 1 - element for element in batch.elements))

        blocks = (replace(block, batches=tuple(map(mirrored, block.batches))) for block in self.blocks)
        return replace(self, blocks=tuple(blocks))

    def _turned(self) -> Rulebook:
        groups = self.by_element()
        inputs, outputs = (torch.cat([self.inputs[:0], *(pair[side] for pair in groups.values())]) for side in (0, 1))
        counts = [len(group) for group, _ in groups.values()]
        return make_rulebook(outputs, inputs, list(groups), counts, self.num_outputs, self.num_inputs, self.volume)

    def by_element(self) -> dict[int, tuple[Tensor, Tensor]]:
        """Input and output rows, each (n,) int32 and ascending, of every kernel element that has pairs."""
        runs: dict[int, list[tuple[Tensor, ...]]] = {}
        for batch in (batch for block in self.blocks for batch in block.batches):
            sides = (side.split_with_sizes(batch.sizes) for side in (batch.inputs, batch.outputs))
            for element, run in zip(batch.elements, zip(*sides, strict=True), strict=True):
                runs.setdefault(element, []).append(run)
        return {e: (torch.cat([i for i, _ in runs[e]]), torch.cat([o for _, o in runs[e]])) for e in sorted(runs)}

    def pairs_per_output(self) -> Tensor:
        """(num_outputs,) int64."""
        return torch.bincount(self.outputs, minlength=self.num_outputs)


def make_rulebook(
    inputs: Tensor,
    outputs: Tensor,
    elements: Sequence[int],
    counts: Sequence[int],
    num_inputs: int,
    num_outputs: int,
    volume: int,
    symmetric: bool = False,
    order: Tensor | None = None,
) -> Rulebook:
    """The rulebook of pairs (P,) int32 that come grouped by kernel element, each group ascending in both.

    Args:
        elements: kernel element of each group.
        counts: pairs in each group.
        order: (P,) the pairs sorted by output row, stably, where it is known.
    """
    starts = row_starts(torch.bincount(outputs, minlength=num_outputs))
    number = len(inputs) // _BLOCK_PAIRS + 1
    first_rows = torch.searchsorted(starts, torch.arange(number, device=starts.device) * _BLOCK_PAIRS)
    sizes = _run_sizes(outputs, counts, first_rows)
    inputs, outputs = _by_block(inputs, sizes), _by_block(outputs, sizes)
    totals = [sum(runs) for runs in sizes]
    rows = [slice(*ends) for ends in pairwise([*first_rows.tolist(), num_outputs])]
    parts = zip(rows, inputs.split_with_sizes(totals), outputs.split_with_sizes(totals), sizes, strict=True)
    known = order if number == 1 else None
    blocks = tuple(_block(r, i, o, elements, runs, starts, known) for r, i, o, runs in parts)
    return Rulebook(inputs, outputs, blocks, num_inputs, num_outputs, volume, symmetric)


def _run_sizes(outputs: Tensor, counts: Sequence[int], first_rows: Tensor) -> list[list[int]]:
    """Of each block, how many pairs of each group reach its rows."""
    if len(first_rows) == 1 or not counts:
        return [list(counts)] * len(first_rows)
    begins = [torch.searchsorted(group, first_rows.int()) for group in outputs.split_with_sizes(tuple(counts))]
    ends = torch.tensor(counts, device=first_rows.device)[:, None]
    sizes: list[list[int]] = torch.cat([torch.stack(begins), ends], 1).diff(dim=1).t().tolist()
    return sizes


def _by_block(side: Tensor, sizes: Sequence[Sequence[int]]) -> Tensor:
    """What is ordered by group and block in the order of block and group."""
    if len(sizes) == 1:
        return side
    runs = side.split_with_sizes([size for group in zip(*sizes, strict=True) for size in group])
    return torch.cat([run for block in range(len(sizes)) for run in runs[block :: len(sizes)]])


def _block(
    rows: slice,
    inputs: Tensor,
    outputs: Tensor,
    elements: Sequence[int],
    sizes: Sequence[int],
    starts: Tensor,
    order: Tensor | None,
) -> Block:
    groups = list(_batched([run for run in zip(elements, sizes, strict=True) if run[1]]))
    totals = [sum(size for _, size in group) for group in groups]
    parts = zip(inputs.split_with_sizes(totals), outputs.split_with_sizes(totals), groups, strict=True)
    batches = tuple(Batch(i, o, tuple(e for e, _ in group), tuple(n for _, n in group)) for i, o, group in parts)
    order, own = _order(outputs, rows) if order is None else order, starts[rows.start : rows.stop + 1]
    return Block(rows, inputs, batches, order.int(), (own - own[0]).int())


def _order(outputs: Tensor, rows: slice) -> Tensor:
    """The pairs sorted by output row, stably."""
    if rows.stop - rows.start < 2**15:  # fewer digits for the radix sort
        outputs = (outputs - rows.start).short()
    return torch.sort(outputs, stable=True)[1]


_Run = tuple[int, int]  # kernel element, pairs


def _batched(runs: Sequence[_Run]) -> Iterator[list[_Run]]:
    """The runs in order, as many together as make `_BATCH_PAIRS` pairs at most, but at least one."""
    batch: list[_Run] = []
    for run in runs:
        if batch and sum(size for _, size in batch) + run[1] > _BATCH_PAIRS:
            yield batch
            batch = []
        batch.append(run)
    if batch:
        yield batch


@dataclass
class _Sites:
    """The cells of a Voxels as separate vectors; kept in its cache."""

    index: Tensor  # the index that this was made of, to notice a replaced one
    columns: tuple[Tensor, Tensor, Tensor, Tensor]  # b, z, y, x, each (N,), of the narrowest integer type


def _sites(voxels: Voxels) -> _Sites:
    """The sites of the voxels; drops rulebooks of other cells from the cache."""
    known = voxels.cache.get("sites")
    if isinstance(known, _Sites) and known.index is voxels.index:
        return known
    voxels.cache.clear()
    cells = voxels.batch_size * voxels.shape[0] * voxels.shape[1] * voxels.shape[2]
    b, z, y, x = voxels.index.t().to(key_type(cells)).contiguous().unbind()
    key = cell_key((b, z, y, x), voxels.shape)
    if len(key) and not bool((key[1:] > key[:-1]).all()):
        raise ValueError("voxels: index must be sorted by (b, z, y, x) with each cell once; assign_cells gives it so")
    known = _Sites(voxels.index, (b, z, y, x))
    voxels.cache["sites"] = known
    return known


def submanifold_rulebook(voxels: Voxels, kernel: Kernel) -> Rulebook:
    """Pairs of a stride 1 convolution whose outputs are the input cells; the centre, an identity, is left out."""
    sites = _sites(voxels)
    key = ("submanifold", kernel)
    if key not in voxels.cache:
        voxels.cache[key] = _make_submanifold(sites, voxels, kernel)
    book: Rulebook = voxels.cache[key]
    return book


def _make_submanifold(sites: _Sites, voxels: Voxels, kernel: Kernel) -> Rulebook:
    margin = tuple(k // 2 * d for k, d in zip(kernel.size, kernel.dilation, strict=True))
    depth, height, width = (n + 2 * m for n, m in zip(voxels.shape, margin, strict=True))
    cells = voxels.batch_size * depth * height * width
    b, z, y, x = (column.to(key_type(cells)) for column in sites.columns)
    keys = cell_key((b, z + margin[0], y + margin[1], x + margin[2]), (depth, height, width))
    shifts = [
        (dz * height + dy) * width + dx
        for dz, dy, dx in product(*(range(-m, m + 1, d) for m, d in zip(margin, kernel.dilation, strict=True)))
    ]
    half = range(kernel.volume // 2 + 1, kernel.volume)
    rows, neighbours, counts = _find(keys, [shifts[e] for e in half], cells)
    elements = (*half, *(kernel.volume - 1 - e for e in half))
    return make_rulebook(
        torch.cat([neighbours, rows]), torch.cat([rows, neighbours]), elements, counts * 2, len(keys), len(keys),
        kernel.volume, True,
    )  # fmt: skip


def _find(keys: Tensor, shifts: Sequence[int], cells: int) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """All (row, neighbour) with keys[neighbour] == keys[row] + shift, grouped by shift, and the groups' sizes."""
    if not len(keys) or not shifts:
        none = torch.zeros(0, dtype=torch.int32, device=keys.device)
        return none, none, (0,) * len(shifts)
    wanted = (keys + torch.tensor(shifts, dtype=keys.dtype, device=keys.device)[:, None]).view(-1)
    neighbour = _look_up(keys, wanted, cells)
    place = (neighbour >= 0).nonzero().squeeze(1)
    ends = torch.searchsorted(place, torch.arange(len(shifts) + 1, device=place.device) * len(keys))
    counts = tuple(ends.diff().tolist())
    found, rows = neighbour.index_select(0, place), place.int()
    for group, own in enumerate(rows.split_with_sizes(counts)):
        own.sub_(group * len(keys))
    return rows, found, counts


def _look_up(keys: Tensor, wanted: Tensor, cells: int) -> Tensor:
    """Row (K,) int32 of `keys` (N,), which ascend, that equals each of `wanted` (K,), or -1; overwrites `wanted`.

    Two tables: the first numbers those of at most `_TABLE` equal chunks of the key space that hold a key, the
    second holds the rows, cell by cell, of the numbered chunks. Both fit a processor's cache where one table
    over all cells would not, and the first is swept of what was written instead of being made anew.
    """
    bits = ((cells - 1) // _TABLE).bit_length()
    chunk, rows = keys >> bits, torch.arange(len(keys), dtype=torch.int32, device=keys.device)
    number = F.pad((chunk[1:] != chunk[:-1]).cumsum(0, dtype=torch.int32), (1, 0)) + 1
    size = (int(number[-1]) + 1) << bits
    if size > _TABLE * 64:
        return _search(keys, wanted)
    begin, written, inside = number << bits, chunk.long(), (1 << bits) - 1
    begins = zeroed("chunks", (cells >> bits) + 1, rows).scatter_(0, written, begin)
    cell = scratch("cells", size, 1, rows).view(-1).fill_(-1)
    cell.scatter_(0, (begin + (keys & inside)).long(), rows)
    place = begins.index_select(0, wanted >> bits)
    found = cell.index_select(0, place.add_(wanted.bitwise_and_(inside)))
    begins.index_fill_(0, written, 0)
    return found


def _search(keys: Tensor, wanted: Tensor) -> Tensor:
    """`_look_up` by binary search, for few keys in a huge space."""
    place = torch.searchsorted(keys, wanted, out_int32=True).clamp_(max=len(keys) - 1)
    return torch.where(keys[place] == wanted, place, -1)


@dataclass
class StridedRulebook:
    """The rulebook of a strided convolution and the cells that it makes."""

    book: Rulebook
    index: Tensor  # (M, 4) int64 output cells, canonical
    shape: Triple
    cache: dict[object, object] = field(default_factory=dict, repr=False)  # rulebooks of the output cells


def strided_rulebook(voxels: Voxels, kernel: Kernel) -> StridedRulebook:
    """Pairs of a convolution whose outputs are all cells that a kernel placed there sees an input from."""
    sites = _sites(voxels)
    key = ("strided", kernel)
    if key not in voxels.cache:
        voxels.cache[key] = _make_strided(sites, voxels, kernel)
    strided: StridedRulebook = voxels.cache[key]
    return strided


def _axis_pairs(
    coordinate: Tensor, size: int, stride: int, padding: int, dilation: int, outputs: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Output coordinate, kernel element and validity, each (A, N), of all pairs along one axis."""
    padded = coordinate + padding
    if dilation == 1:  # element = padded mod stride + a * stride
        first = torch.div(padded, stride, rounding_mode="floor")
        step = torch.arange(-(-size // stride), dtype=padded.dtype, device=padded.device)[:, None]
        output, element = first - step, (padded - first * stride) + step * stride
        return output, element, (element < size) & (output >= 0) & (output < outputs)
    element = torch.arange(size, dtype=padded.dtype, device=padded.device)[:, None].expand(-1, len(padded))
    reached = padded - element * dilation
    output = torch.div(reached, stride, rounding_mode="floor")
    return output, element, (output * stride == reached) & (output >= 0) & (output < outputs)


def _make_strided(sites: _Sites, voxels: Voxels, kernel: Kernel) -> StridedRulebook:
    shape = kernel.output_shape(voxels.shape)
    cells = voxels.batch_size * shape[0] * shape[1] * shape[2]
    b, *coordinates = (column.to(key_type(cells)) for column in sites.columns)
    axes = zip(coordinates, kernel.size, kernel.stride, kernel.padding, kernel.dilation, shape, strict=True)
    (oz, kz, vz), (oy, ky, vy), (ox, kx, vx) = (_axis_pairs(*axis) for axis in axes)
    plane = (b * shape[0] + oz)[:, None] * shape[1] + oy
    key = plane[:, :, None] * shape[2] + ox
    element = (kz[:, None] * kernel.size[1] + ky)[:, :, None] * kernel.size[2] + kx
    valid = (vz[:, None] & vy)[:, :, None] & vx
    flat = valid.view(-1).nonzero().squeeze(1)
    element, by_element = torch.sort(element.view(-1).index_select(0, flat).to(_element_type(kernel)), stable=True)
    flat = flat.index_select(0, by_element)
    counts = tuple(torch.bincount(element, minlength=kernel.volume).tolist())
    key, order = torch.sort(key.view(-1).index_select(0, flat), stable=True)
    first = F.pad(key[1:] != key[:-1], (1, 0), value=True)[: len(key)]  # of the pairs of an output
    row = first.cumsum(0, dtype=torch.int32) - 1
    unique, outputs = torch.masked_select(key, first), torch.empty_like(row).scatter_(0, order, row)
    inputs = flat.int() % max(len(b), 1)
    book = make_rulebook(inputs, outputs, range(kernel.volume), counts, len(b), len(unique), kernel.volume, order=order)
    columns = cell_columns(unique, shape)
    index = cell_index(columns)
    return StridedRulebook(book, index, shape, {"sites": _Sites(index, columns)})


def _element_type(kernel: Kernel) -> torch.dtype:
    return torch.uint8 if kernel.volume < 256 else torch.int32
