"""Walk through, copy and compare whatever components return."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lidarfw.types import Boxes, Voxels, take


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every tensor and plain value in a nested result, with its place; caches are left out."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if field.compare:
                yield from leaves(getattr(value, field.name), f"{path}.{field.name}")
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from leaves(item, f"{path}[{key!r}]")
    elif isinstance(value, (list, tuple)):
        yield f"len({path})", len(value)
        for number, item in enumerate(value):
            yield from leaves(item, f"{path}[{number}]")
    else:
        yield path, torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def floats(value: Any) -> list[Tensor]:
    """Every floating-point tensor in a nested result."""
    return [leaf for _, leaf in leaves(value) if isinstance(leaf, Tensor) and leaf.is_floating_point()]


def finite(value: Any) -> bool:
    """Whether every floating-point tensor is finite throughout."""
    return all(bool(tensor.isfinite().all()) for tensor in floats(value))


def difference(first: Any, second: Any, tolerance: float = 0.0) -> str:
    """Where two results differ, in words; "" where they do not. `tolerance` is relative to the largest value."""
    ours, theirs = dict(leaves(first)), dict(leaves(second))
    if ours.keys() != theirs.keys():
        return f"has {sorted(ours.keys() ^ theirs.keys())[0]} only once"
    for place, value in ours.items():
        text = _leaf_difference(value, theirs[place], tolerance)
        if text:
            return f"{place.lstrip('.') or 'the value'}: {text}"
    return ""


def _leaf_difference(value: Any, other: Any, tolerance: float) -> str:
    if not isinstance(value, Tensor) or not isinstance(other, Tensor):
        equal = value == other or (value != value and other != other)
        return "" if type(value) is type(other) and equal else f"{value!r} and {other!r}"
    if value.shape != other.shape or value.dtype != other.dtype:
        return f"{value.dtype} {tuple(value.shape)} and {other.dtype} {tuple(other.shape)}"
    if torch.equal(value, other):
        return ""
    if not value.is_floating_point():
        return "whole numbers differ"
    scale = float(value[value.isfinite()].abs().max()) if bool(value.isfinite().any()) else 0.0
    if torch.allclose(value, other, rtol=0, atol=tolerance * max(scale, 1e-6), equal_nan=True):
        return ""
    return f"differs by up to {float((value - other).abs().nan_to_num().max()):.3g} where values reach {scale:.3g}"


def boxes_difference(first: Boxes, second: Boxes, tolerance: float) -> str:
    """Like `difference` for boxes in any order; one in twenty may be missing.

    A head keeps its best boxes. With random weights scores are so close that rounding decides which those are.
    """
    rows, others = _rows(first), _rows(second)
    if not len(rows) or not len(others):
        return "" if len(rows) == len(others) else f"{len(rows)} and {len(others)} boxes"
    near = torch.cdist(rows, others, p=torch.inf) <= tolerance * float(rows.abs().max())
    found = min(float(near.any(dim).float().mean()) for dim in (0, 1))
    return "" if found >= 0.95 else f"only {found:.0%} of {len(rows)} and {len(others)} boxes are the same"


def _rows(boxes: Boxes) -> Tensor:
    angle = [boxes.yaw.sin(), boxes.yaw.cos(), boxes.score, boxes.label.float()]
    return torch.cat([boxes.center, boxes.size, torch.stack(angle, 1)], 1)


def copied(value: Any, function: Callable[[Tensor], Tensor] = Tensor.clone) -> Any:
    """A nested copy with `function` applied to every tensor."""
    if isinstance(value, Tensor):
        return function(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: copied(getattr(value, f.name), function) for f in dataclasses.fields(value)}
        return type(value)(**fields)
    if isinstance(value, dict):
        return {key: copied(item, function) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(copied(item, function) for item in value)
    return value


def sample(value: Any, number: int) -> Any:
    """What a result says of one frame of its batch."""
    if isinstance(value, (list, tuple)):
        return [sample(item, number) for item in value]
    if isinstance(value, Voxels):
        rows = value.index[:, 0] == number
        return (value.features[rows], value.index[rows, 1:], value.shape, value.strides)
    return take(value, number)
