"""Does a value look as a Spec says?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from lidarfw.types import (
    BEV,
    Boxes,
    Descriptors,
    Image,
    Matches,
    PointLabels,
    Points,
    Poses,
    RangeImage,
    RangeView,
    SceneCoords,
    Spec,
    Tracks,
    Voxels,
)


def mismatch(provides: Any, value: Any, batch_size: int) -> str:
    """How a value departs from a Spec (or a list or tuple of them), in words; "" where it does not."""
    if isinstance(provides, (list, tuple)):
        if not isinstance(value, type(provides)) or len(value) != len(provides):
            return f"provides is a {type(provides).__name__} of {len(provides)}, what came out is {_kind(value)}"
        texts = (mismatch(spec, part, batch_size) for spec, part in zip(provides, value, strict=True))
        return next((text for text in texts if text), "")
    if not isinstance(provides, Spec):
        return f"provides is {provides!r}, no Spec"
    if not isinstance(value, provides.kind):
        return f"provides {provides.kind.__name__}, but what came out is {_kind(value)}"
    facts = {"finite": (_is_finite(value), True)} | _FACTS[provides.kind](provides, value, batch_size)
    wrong = [f"{name} {found}, expected {wanted}" for name, (found, wanted) in facts.items() if found != wanted]
    return f"{provides.kind.__name__}: {wrong[0]}" if wrong else ""


def _kind(value: Any) -> str:
    return f"a {type(value).__name__}" + (f" of {len(value)}" if isinstance(value, (list, tuple)) else "")


def _is_finite(value: Any) -> bool:
    from lidarfw.testing.checks.compare import finite

    return isinstance(value, Matches) or finite(value)


Facts = dict[str, tuple[Any, Any]]  # what -> (found, expected)


def _rows(value: Any, batch_size: int) -> Facts:
    batch = value.batch
    inside = bool(((batch >= 0) & (batch < batch_size)).all())
    lengths = {int(t.shape[0]) for t in vars(value).values() if isinstance(t, torch.Tensor)}
    return {
        "batch_size": (value.batch_size, batch_size),
        "batch numbers within the batch": (inside, True),
        "fields of one length": (lengths, {len(value)}),
    }


def _points(spec: Spec, value: Points, batch_size: int) -> Facts:
    return _rows(value, batch_size) | {"channels": (value.features.shape[1], spec.channels)}


def _voxels(spec: Spec, value: Voxels, batch_size: int) -> Facts:
    index, limits = value.index, torch.tensor([batch_size, *value.shape])
    size = torch.tensor([1, *value.shape]).flip(0).cumprod(0).flip(0)
    key = (index.cpu() * torch.cat([size[1:], torch.ones(1, dtype=torch.long)])).sum(1)
    return {
        "batch_size": (value.batch_size, batch_size),
        "features": (tuple(value.features.shape), (len(value), spec.channels)),
        "stride": (value.stride, spec.stride),
        "grid": (value.grid, spec.geometry),
        "depth": (value.shape[0], spec.depth),
        "height and width": (value.shape[1:], spec.grid.shape(value.strides)[1:]),
        "index within the grid": (bool(((index.cpu() >= 0) & (index.cpu() < limits)).all()), True),
        "index sorted by b, z, y, x, each cell once": (bool((key[1:] > key[:-1]).all()), True),
    }


def _bev(spec: Spec, value: BEV, batch_size: int) -> Facts:
    size = (batch_size, spec.channels, *spec.grid.shape(spec.stride)[1:])
    return {
        "grid": (value.grid, spec.geometry),
        "stride": (value.stride, spec.stride),
        "features": (tuple(value.features.shape), size),
    }


def _image(spec: Spec, value: Image, batch_size: int) -> Facts:
    return {
        "channels and batch": (tuple(value.features.shape[:2]), (batch_size, spec.channels)),
        "stride": (value.stride, spec.stride),
        "cameras": (len(value.cameras), batch_size),
    }


def _range_image(spec: Spec, value: RangeImage, batch_size: int) -> Facts:
    view = spec.geometry
    size = (batch_size, spec.channels, view.height, view.width) if isinstance(view, RangeView) else None
    return {"view": (value.view, view), "features": (tuple(value.features.shape), size)}


def _boxes(spec: Spec, value: Boxes, batch_size: int) -> Facts:
    known = bool(((value.label >= 0) & (value.label < len(spec.classes))).all())
    return _rows(value, batch_size) | {
        "labels within the classes": (known, True),
        "positive sizes": (bool((value.size > 0).all()), True),
        "scores within 0..1": (bool(((value.score >= 0) & (value.score <= 1)).all()), True),
    }


def _point_labels(spec: Spec, value: PointLabels, batch_size: int) -> Facts:
    within = bool(((value.probability >= 0) & (value.probability <= 1 + 1e-5)).all())
    return _rows(value, batch_size) | {
        "classes": (value.probability.shape[1], len(spec.classes)),
        "probabilities within 0..1": (within, True),
    }


def _scene_coords(spec: Spec, value: SceneCoords, batch_size: int) -> Facts:
    return _rows(value, batch_size)


def _poses(spec: Spec, value: Poses, batch_size: int) -> Facts:
    last = value.matrix.new_tensor([0, 0, 0, 1]).expand(batch_size, 4)
    return {
        "matrix": (tuple(value.matrix.shape), (batch_size, 4, 4)),
        "last row 0 0 0 1": (bool(torch.allclose(value.matrix[:, 3], last)), True),
        "ok": (tuple(value.ok.shape), (batch_size,)),
    }


def _descriptors(spec: Spec, value: Descriptors, batch_size: int) -> Facts:
    length = value.vector.norm(dim=1)
    return {
        "vector": (tuple(value.vector.shape), (batch_size, spec.channels)),
        "modality of every frame": (len(value.modality), batch_size),
        "vectors of length 1": (bool(torch.allclose(length, torch.ones_like(length), atol=1e-3)), True),
    }


def _tracks(spec: Spec, value: Tracks, batch_size: int) -> Facts:
    return _boxes(spec, value.boxes, batch_size) | {"ids": (len(value.id), len(value.boxes))}


def _matches(spec: Spec, value: Matches, batch_size: int) -> Facts:
    return {"queries": (len(value.index), batch_size)}


_FACTS: dict[type, Callable[..., Facts]] = {
    Points: _points, Voxels: _voxels, BEV: _bev, Image: _image, RangeImage: _range_image, Boxes: _boxes,
    PointLabels: _point_labels, SceneCoords: _scene_coords, Poses: _poses, Descriptors: _descriptors,
    Tracks: _tracks, Matches: _matches,
}  # fmt: skip
