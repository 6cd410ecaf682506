"""Base classes of the data types: named tensors that move, map and concatenate together."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from typing_extensions import Self

from lidarfw._lazy import LazyModule

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")


def _map(value: Any, function: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(value, Record):
        return value.map(function)
    if isinstance(value, torch.Tensor):
        return function(value)
    if isinstance(value, dict):
        return {key: _map(item, function) for key, item in value.items()}
    if isinstance(value, list):
        return [_map(item, function) for item in value]
    return value


class Record:
    """A dataclass whose tensors are moved and mapped together."""

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """A copy with `function` applied to every tensor, nested ones too."""
        fields = {f.name: _map(getattr(self, f.name), function) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        return type(self)(**fields)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Self:
        """A copy on `device`."""
        return self.map(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def detach(self) -> Self:
        """A copy cut from the autograd graph."""
        return self.map(lambda tensor: tensor.detach())

    def pin_memory(self) -> Self:
        """A copy in page-locked memory, for fast transfer to a GPU."""
        return self.map(lambda tensor: tensor.pin_memory())

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


class Rows(Record):
    """A record of tensors with one row per element (point, box, ...).

    Every such record has `batch` (N,) int64, the sample that each row belongs to, and
    `batch_size`, since the last samples of a batch may have no row at all.
    """

    batch: Tensor
    batch_size: int

    def __len__(self) -> int:
        return int(self.batch.shape[0])

    def __getitem__(self, rows: Tensor | slice) -> Self:
        """The chosen rows: a bool mask (N,), integer indices (M,) or a slice."""
        return self.map(lambda tensor: tensor[rows])

    def sample(self, number: int) -> Self:
        """The rows of one sample, as a batch of one."""
        rows = self[self.batch == number]
        return rows.replace(batch=torch.zeros_like(rows.batch), batch_size=1)

    def samples(self) -> list[Self]:
        """Each sample of the batch by itself."""
        return [self.sample(number) for number in range(self.batch_size)]

    @classmethod
    def cat(cls, records: Sequence[Self], as_batch: bool = False) -> Self:
        """All rows of `records`; with `as_batch`, their samples become samples of one batch.

        An optional field is kept where every record with rows has it.
        """
        first = records[0]
        starts = [sum(r.batch_size for r in records[:i]) if as_batch else 0 for i in range(len(records))]
        fields: dict[str, Any] = {}
        for field in dataclasses.fields(first):  # type: ignore[arg-type]
            values = [getattr(r, field.name) for r in records]
            if all(isinstance(v, torch.Tensor) for v in values):
                fields[field.name] = torch.cat(values)
            elif field.name not in ("batch", "batch_size"):
                filled = [v for v, r in zip(values, records, strict=True) if len(r)]
                whole = bool(filled) and all(isinstance(v, torch.Tensor) for v in filled)
                fields[field.name] = torch.cat(filled) if whole else (None if filled else values[0])
        fields["batch"] = torch.cat([r.batch + start for r, start in zip(records, starts, strict=True)])
        fields["batch_size"] = sum(r.batch_size for r in records) if as_batch else max(r.batch_size for r in records)
        return cls(**fields)
