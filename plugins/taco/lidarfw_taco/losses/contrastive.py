"""The three task-aware contrastive losses of TACO (equations 1 to 5). They are for training only.

They take the taps of any head that predicts boxes and any that predicts scene coordinates. Where the paper leaves
something open or contradicts itself, the class says what was decided.
"""

from __future__ import annotations

import warnings
from typing import Annotated

import torch
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Loss
from lidarfw.types import BEV, Boxes, SceneCoords, Spec, Tap, Targets
from torch import Tensor

from lidarfw_taco.features import (
    MODES,
    POOLING,
    cell_features,
    mean_similarity,
    object_features,
    occupied,
    require_equal_widths,
    top_cells,
    unit,
)

DETACH = ("none", "localization", "detection")
SCOPES = ("sample", "batch")


class ITCL(Loss):
    """Inter-task loss: push localization features away from object features (TACO, equation 1).

    The mean cosine of the `top` longest vectors of the localization map with the vectors of all labelled objects on
    the detection map, moving or not ("movable"), over all pairs of a sample, then over samples; a sample without
    pairs counts 0. With `exclude_objects`, cells in the footprint of an object are not chosen.

    `mode`: raw (equation 1, least at -1), relu or square (least where the features are orthogonal, which is what the
    text asks for; the same as raw for taps that are not negative, but for the gradient). `pooling`: an object's vector
    is the mean over its footprint, or what lies at its center. `detach`: the side that gets no gradient.
    """

    def __init__(
        self,
        detection: Spec,
        localization: Spec,
        *,
        top: int = 128,
        mode: str = "raw",
        exclude_objects: bool = True,
        pooling: str = "mean",
        detach: str = "none",
    ) -> None:
        super().__init__()
        require_equal_widths("itcl", detection, localization)
        _one_of("itcl", mode=(mode, MODES), pooling=(pooling, POOLING), detach=(detach, DETACH))
        _above_zero("itcl", top=top)
        self.top, self.mode, self.exclude_objects = top, mode, exclude_objects
        self.pooling, self.detach = pooling, detach
        self._looked = False

    def forward(
        self,
        detection: Annotated[BEV, Tap(Boxes)],
        localization: Annotated[BEV, Tap(SceneCoords)],
        targets: Targets,
    ) -> dict[str, Tensor]:
        """The term `cosine`."""
        nothing = _nothing(detection, localization)
        boxes = targets.boxes
        if boxes is None:
            return {"cosine": nothing}
        self._warn_of_signed(detection, localization)
        objects, rows = object_features(detection, boxes, self.pooling)
        cells, valid, _ = top_cells(localization, self.top, _excluded(localization, boxes, self.exclude_objects))
        objects = objects.detach() if self.detach == "detection" else objects
        cells = cells.detach() if self.detach == "localization" else cells
        return {"cosine": nothing + mean_similarity(cells, valid, objects, boxes.batch[rows], self.mode).mean()}

    def _warn_of_signed(self, *taps: BEV) -> None:
        """Once: with negative features the raw cosine pulls towards opposite ones, not towards independent ones."""
        if self.mode == "raw" and not self._looked and any(bool((tap.features < 0).any()) for tap in taps):
            warnings.warn("itcl: a tap has negative features.\n  fix: loss.itcl.mode=square", stacklevel=2)
        self._looked = True


class IDCL(Loss):
    """Intra-detection loss: moving and parked objects of a class alike (TACO, equations 2 to 4).

    An object is an anchor if the opposite motion state has one of its class. Its candidates are all objects of the
    opposite state, its positives those of its class: l = logsumexp(candidates) - logsumexp(positives) of cosines over
    `temperature`, and 0 where all candidates are positives. The moving anchors are averaged, the static ones too, and
    the two means added; then the mean over samples. An anchor without positives would have an infinite loss in the
    paper's equations: it is left out, and the mean is over those that are left.

    `scope`: candidates of the same sample, or, where frames hold few objects, of the whole batch. Objects whose state
    is unknown play no part. Boxes need `moving`: by the dataset or by the transform `motion_state`.
    """

    def __init__(
        self, detection: Spec, *, temperature: float = 0.1, scope: str = "sample", pooling: str = "mean"
    ) -> None:
        super().__init__()
        _one_of("idcl", scope=(scope, SCOPES), pooling=(pooling, POOLING))
        _above_zero("idcl", temperature=temperature)
        self.temperature, self.scope, self.pooling = temperature, scope, pooling

    def forward(self, detection: Annotated[BEV, Tap(Boxes)], targets: Targets) -> dict[str, Tensor]:
        """The term `nce`."""
        nothing = _nothing(detection)
        boxes = targets.boxes
        if boxes is None:
            return {"nce": nothing}
        moving = moving_of(boxes, "idcl")
        vectors, rows = object_features(detection, boxes, self.pooling)
        batch = boxes.batch[rows] if self.scope == "sample" else torch.zeros_like(rows)
        samples = detection.batch_size if self.scope == "sample" else 1
        return {
            "nce": nothing + motion_contrast(vectors, boxes.label[rows], moving[rows], batch, samples, self.temperature)
        }


class ILCL(Loss):
    """Intra-localization loss: push geographic features away from those on parked objects (TACO, equation 5).

    The mean cosine of the `top` longest vectors of the localization map (the geographic ones) with the vectors of
    static objects on the same map (the pseudo-geographic ones, which are gone at the next visit); the paper's text
    swaps the two names. Cells in the footprint of any object are no geographic ones, with `exclude_objects`: else a
    parked car would be pushed away from itself. Samples without pairs count 0.

    `per_cell` takes every cell of a static object instead of one vector for each object. `mode`, `pooling`: as for
    itcl. Boxes need `moving`: by the dataset or by the transform `motion_state`.
    """

    def __init__(
        self,
        localization: Spec,
        *,
        top: int = 128,
        mode: str = "raw",
        exclude_objects: bool = True,
        pooling: str = "mean",
        per_cell: bool = False,
    ) -> None:
        super().__init__()
        _one_of("ilcl", mode=(mode, MODES), pooling=(pooling, POOLING))
        _above_zero("ilcl", top=top)
        self.top, self.mode, self.exclude_objects = top, mode, exclude_objects
        self.pooling, self.per_cell = pooling, per_cell

    def forward(self, localization: Annotated[BEV, Tap(SceneCoords)], targets: Targets) -> dict[str, Tensor]:
        """The term `cosine`."""
        nothing = _nothing(localization)
        boxes = targets.boxes
        if boxes is None:
            return {"cosine": nothing}
        static = boxes[moving_of(boxes, "ilcl") == 0]
        if self.per_cell:
            objects, batch = cell_features(localization, static)
        else:
            objects, rows = object_features(localization, static, self.pooling)
            batch = static.batch[rows]
        cells, valid, _ = top_cells(localization, self.top, _excluded(localization, boxes, self.exclude_objects))
        return {"cosine": nothing + mean_similarity(cells, valid, objects, batch, self.mode).mean()}


def motion_contrast(
    vectors: Tensor, label: Tensor, moving: Tensor, batch: Tensor, samples: int, temperature: float
) -> Tensor:
    """L_IDCL (equations 2 to 4) of object vectors (M, C) with classes, motion states (1, 0, -1) and samples (M,)."""
    known = (moving >= 0).nonzero()[:, 0]
    vectors, label, moving, batch = unit(vectors[known].float()), label[known], moving[known], batch[known]
    candidates = (batch[:, None] == batch) & (moving[:, None] != moving)
    positives = candidates & (label[:, None] == label)
    anchors = positives.any(1).nonzero()[:, 0]
    with torch.autocast(vectors.device.type, enabled=False):
        logits = vectors[anchors] @ vectors.T / temperature

    def pooled(mask: Tensor) -> Tensor:
        return logits.masked_fill(~mask[anchors], -torch.inf).logsumexp(1)

    each = pooled(candidates) - pooled(positives)
    half = batch[anchors] * 2 + moving[anchors].long()  # static and moving anchors of each sample
    total = each.new_zeros(2 * samples).index_add(0, half, each)
    return (total / half.bincount(minlength=2 * samples).clamp(min=1)).sum() / samples


def moving_of(boxes: Boxes, loss: str) -> Tensor:
    """Motion state (M,) of the boxes: 1 moving, 0 static, -1 unknown; ConfigError where the data does not say."""
    if boxes.moving is None and len(boxes):
        raise ConfigError(
            f"loss.{loss} needs boxes that say what moves, and the dataset gives none.\n"
            "  fix: transform=[motion_state,...] works it out from velocities, or from tracks or boxes over time"
        )
    return torch.zeros_like(boxes.label) if boxes.moving is None else boxes.moving


def _excluded(localization: BEV, boxes: Boxes, exclude: bool) -> Tensor | None:
    return occupied(localization, boxes) if exclude else None


def _nothing(*maps: BEV) -> Tensor:
    """0, attached to the graph, for what has no pair."""
    return torch.stack([bev.features.float().sum() * 0 for bev in maps]).sum()


def _one_of(loss: str, **options: tuple[str, tuple[str, ...]]) -> None:
    for name, (value, known) in options.items():
        if value not in known:
            raise ConfigError(f"loss.{loss}.{name} is {value!r}; use one of: {', '.join(known)}")


def _above_zero(loss: str, **options: float) -> None:
    for name, value in options.items():
        if value <= 0:
            raise ConfigError(f"loss.{loss}.{name} must be above 0, got {value}")
