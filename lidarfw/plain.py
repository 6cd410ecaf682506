"""Records as plain lists, dicts, numbers and tensors, and back: what `torch.load(weights_only=True)` lets through."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from lidarfw import types
from lidarfw.errors import CheckpointError

_KNOWN: dict[str, type] = {
    cls.__name__: cls
    for cls in (
        *types.VOCABULARY.values(),
        *(types.Batch, types.Frame, types.FrameMeta, types.FrameResult, types.Targets),
        *(types.Camera, types.Grid, types.RangeView),
    )
}
_SEQUENCES: dict[str, Any] = {"tuple": tuple, "set": set, "frozenset": frozenset}


def to_plain(value: Any, classes: Mapping[str, type] | None = None) -> Any:
    """A copy of `value` made of None, bool, int, float, str, list, dict and cloned tensors.

    Records of `lidarfw.types` are known; `classes` names further dataclasses. Fields that do not take part in
    comparison (caches) are left out. CheckpointError for anything else.
    """
    known = {**_KNOWN, **(classes or {})}
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    if isinstance(value, np.ndarray):
        return {"type": "array", "tensor": torch.from_numpy(value.copy())}
    if isinstance(value, np.generic):
        return {"type": "array", "tensor": torch.from_numpy(np.array(value))}
    if type(value) is list:
        return [to_plain(item, known) for item in value]
    if isinstance(value, deque):
        return {"type": "deque", "items": [to_plain(item, known) for item in value], "maxlen": value.maxlen}
    if type(value) in _SEQUENCES.values():
        return {"type": type(value).__name__, "items": [to_plain(item, known) for item in value]}
    if type(value) is dict:
        return {"type": "dict", "items": [[to_plain(k, known), to_plain(v, known)] for k, v in value.items()]}
    return _from_dataclass(value, known)


def _from_dataclass(value: Any, known: Mapping[str, type]) -> dict[str, Any]:
    name = next((name for name, cls in known.items() if cls is type(value)), None)
    if name is None:
        kind = f"{type(value).__module__}.{type(value).__qualname__}"
        raise CheckpointError(
            f"a {kind} cannot be saved.\n  savable: numbers, strings, tensors, arrays, containers of them, and "
            "dataclasses of them\n  fix: keep only those in the state"
        )
    fields = {f.name: to_plain(getattr(value, f.name), known) for f in dataclasses.fields(value) if f.compare}
    return {"type": name, "fields": fields}


def from_plain(plain: Any, classes: Mapping[str, type] | None = None) -> Any:
    """Inverse of `to_plain`; builds only records of `lidarfw.types` and the dataclasses in `classes`."""
    known = {**_KNOWN, **(classes or {})}
    if isinstance(plain, torch.Tensor):
        return plain.clone()
    if isinstance(plain, list):
        return [from_plain(item, known) for item in plain]
    if not isinstance(plain, dict):
        return plain
    kind = plain["type"]
    if kind == "array":
        array = plain["tensor"].numpy().copy()
        return array if array.ndim else array[()]
    if kind == "dict":
        return {from_plain(key, known): from_plain(item, known) for key, item in plain["items"]}
    if kind == "deque":
        return deque((from_plain(item, known) for item in plain["items"]), plain["maxlen"])
    if kind in _SEQUENCES:
        return _SEQUENCES[kind](from_plain(item, known) for item in plain["items"])
    if kind not in known:
        raise CheckpointError(f"saved state holds a {kind!r}, which is no type of lidarfw or of the saved components")
    return known[kind](**{name: from_plain(item, known) for name, item in plain["fields"].items()})
