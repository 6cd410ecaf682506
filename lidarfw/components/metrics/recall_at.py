"""How well descriptors find places again: Recall@N, precision and recall of the best match."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from lidarfw.components.metrics.sequence import sequence_number
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Metric
from lidarfw.types import Descriptors, FrameMeta, Spec, Targets

QUERIES = 512  # at a time


class PlaceMetric(Metric):
    """Base of metrics on descriptors of places: keeps those of all frames, since any may be the match of another.

    Frames without a true pose are left out. Raises DataError for descriptors that are not finite.
    """

    full_state_update = False
    vectors: list[Tensor]  # (F, D)
    places: list[Tensor]  # (F, 6) sequence, time, x, y, z in the map, 1 for camera and 0 for others

    def __init__(self, descriptors: Spec, map_sequences: Sequence[str] = ()) -> None:
        super().__init__()
        self.channels = descriptors.channels
        self.map_sequences = [str(name) for name in map_sequences]
        self.map = [sequence_number(name) for name in self.map_sequences]
        self.add_state("vectors", default=[], dist_reduce_fx="cat")
        self.add_state("places", default=[], dist_reduce_fx="cat")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        self.vectors.append(torch.zeros(0, self.channels, device=self.device))
        self.places.append(torch.zeros(0, 6, dtype=torch.float64, device=self.device))

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._start()

    def update(self, descriptors: Descriptors, targets: Targets, meta: list[FrameMeta]) -> None:
        """Take the descriptors of one frame, or of a batch of frames, in."""
        if targets.poses is None:
            return
        bad = [frame.id for frame, row in zip(meta, descriptors.vector, strict=True) if not row.isfinite().all()]
        if bad:
            raise DataError(f"frame {bad[0]}: its descriptor holds NaN or inf. Did the training diverge?")
        said = [(sequence_number(frame.sequence), frame.time, float(frame.modality == "camera")) for frame in meta]
        where = torch.tensor(said, dtype=torch.float64, device=self.device).view(-1, 3)
        known = targets.poses.ok.to(self.device)
        position = targets.poses.matrix[:, :3, 3].double().to(self.device)
        self.vectors.append(descriptors.vector.detach().float().to(self.device)[known])
        self.places.append(torch.cat([where[:, :2], position, where[:, 2:]], 1)[known])

    def is_reference(self, frame: FrameMeta) -> bool:
        """Whether it is of the map, if sequences are named that are."""
        return sequence_number(frame.sequence) in self.map

    def in_map(self, places: Tensor) -> Tensor:
        """(F,) bool: frames of the sequences that are the map; all others query.

        ConfigError where there are frames, but none of the map.
        """
        inside = torch.isin(places[:, 0], places.new_tensor(self.map))
        if len(places) and not bool(inside.any()):
            raise ConfigError(
                f"map_sequences of the metric are {', '.join(self.map_sequences)}, but none of the {len(places)} "
                "frames that were evaluated is of the map\n"
                "  fix: metric.NAME.map_sequences=[...] with some of the sequences of the split"
            )
        return inside

    def gathered(self) -> tuple[Tensor, Tensor]:
        """Descriptors (F, D) and places (F, 6) of all frames; after an exchange the states are tensors, not lists."""
        states = (self.vectors, self.places)
        vectors, places = (torch.cat(state) if isinstance(state, list) else state for state in states)
        return vectors, places


def rank_of_first(right: Tensor, searched: Tensor, distance: Tensor) -> Tensor:
    """(Q,) rank of the nearest right place among those searched, inf for none; of equal ones the wrong come first.

    All (Q, F): which places are right, which are searched, and the distance of descriptors.
    """
    right = right & searched
    nearest = distance.masked_fill(~right, torch.inf).amin(1, keepdim=True)
    before = (searched & ~right & (distance <= nearest)).sum(1)
    return torch.where(right.any(1), before + 1.0, torch.inf)


class RecallAt(PlaceMetric):
    """Place recognition: Recall@N and Recall@1 %, average precision and best F1 of the best match.

    A match is right where the two true positions are within the radius. `radii` (metres) are judged one by one.
    With `map_sequences`, the frames of these sequences are the map and all others are queries. Without, each frame
    searches the earlier frames of its own sequence that are at least `gap` seconds older, as loops are detected.
    Frames without a true pose are left out, queries without any frame to search too.

    Recall@N: share of the queries with a right place among the N of smallest L2 distance; @1 % takes a hundredth of
    the places searched, rounded, at least one. Of equal distances the wrong place comes first, so equal descriptors
    for all frames do not find anything. With `revisits_only` a query without any right place is not counted, else it
    is a miss. Average precision takes the best match of every query as a loop if its distance is at most a threshold:
    precision is the share of right ones among the loops, recall the share of found ones among the queries that have
    a right place; summed over the steps of recall.

    `compute` gives for each radius `recall@{N}_{radius}m`, `recall@1%_{radius}m`, `ap_{radius}m`, `f1_{radius}m`,
    `revisits_{radius}m`, how many queries have a right place; `queries`; and `recall@1` at the first radius. All are
    0 without queries. Kept are descriptors, positions and times, since any frame may be the match of a later one.
    Raises ConfigError for radii and counts that are not positive, DataError for descriptors that are not finite.
    """

    monitor: ClassVar[str] = "recall@1"
    higher_is_better = True

    def __init__(
        self,
        descriptors: Spec,
        *,
        radii: Sequence[float] = (5.0, 10.0, 20.0),
        counts: Sequence[int] = (1, 5),
        map_sequences: Sequence[str] = (),
        gap: float = 30.0,
        revisits_only: bool = True,
    ) -> None:
        super().__init__(descriptors, map_sequences)
        if not radii or min(*radii, *counts, 1) <= 0:
            raise ConfigError(f"metric.recall_at: radii and counts must be above 0, got {radii} and {counts}")
        self.radii, self.counts = list(radii), sorted({1, *counts})
        self.gap, self.revisits_only = gap, revisits_only

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        vectors, places = self.gathered()
        if self.map:
            self.in_map(places)  # looks whether there is one, before it is searched block by block
        rows = torch.arange(len(places), device=places.device)
        blocks = [self._search(rows[i : i + QUERIES], vectors, places) for i in range(0, len(places), QUERIES)]
        found = torch.cat([torch.zeros(0, 2 + 2 * len(self.radii)), *(block.cpu() for block in blocks)])
        figures: dict[str, float] = {"queries": float(len(found))}
        for number, radius in enumerate(self.radii):
            rank, revisit = found[:, 2 + 2 * number], found[:, 3 + 2 * number] > 0
            figures |= {f"{key}_{radius:g}m": value for key, value in self._judge(found, rank, revisit).items()}
        return {**figures, "recall@1": figures[f"recall@1_{self.radii[0]:g}m"]}

    def _search(self, rows: Tensor, vectors: Tensor, places: Tensor) -> Tensor:
        """(Q, 2 + 2 R) of the queries among these rows: distance of the best match, places searched, and for each
        radius the rank of the first right place (inf for none) and whether there is one."""
        searched = self._searched(places[rows], places)
        rows, searched = rows[searched.any(1)], searched[searched.any(1)]
        distance = torch.cdist(vectors[rows].double(), vectors.double()).masked_fill(~searched, torch.inf)
        metres = torch.cdist(places[rows, 2:5], places[:, 2:5], compute_mode="donot_use_mm_for_euclid_dist")
        columns = [distance.amin(1), searched.sum(1)]
        for radius in self.radii:
            rank = rank_of_first(metres <= radius, searched, distance)
            columns += [rank, rank.isfinite()]
        return torch.stack([column.double() for column in columns], 1)

    def _searched(self, queries: Tensor, places: Tensor) -> Tensor:
        """(Q, F) which frames each query searches."""
        if self.map:
            in_map = torch.isin(places[:, 0], places.new_tensor(self.map))
            return ~torch.isin(queries[:, 0], places.new_tensor(self.map))[:, None] & in_map
        return (queries[:, :1] == places[:, 0]) & (queries[:, 1:2] - places[:, 1] >= self.gap)

    def _judge(self, found: Tensor, rank: Tensor, revisit: Tensor) -> dict[str, float]:
        """Figures of one radius."""
        counted = revisit if self.revisits_only else torch.ones_like(revisit)
        total = max(int(counted.sum()), 1)
        limits = {f"recall@{count}": float(count) for count in self.counts}
        figures = {name: float((rank <= limit).sum()) / total for name, limit in limits.items()}
        hundredth = (found[:, 1] / 100).round().clamp(min=1)
        figures["recall@1%"] = float((rank <= hundredth).sum()) / total
        precision, recall = precision_recall(found[:, 0], rank == 1, int(revisit.sum()))
        f1 = 2 * precision * recall / (precision + recall).clamp(min=1e-12)
        gain = torch.diff(recall, prepend=recall.new_zeros(1))
        best = float(f1.max()) if len(f1) else 0.0
        return {**figures, "ap": float((gain * precision).sum()), "f1": best, "revisits": float(revisit.sum())}


def precision_recall(distance: Tensor, right: Tensor, revisits: int) -> tuple[Tensor, Tensor]:
    """Precision and recall (S,) at each distinct distance of the best matches (Q,), rising.

    `right` (Q,) says which of them are right, `revisits` how many queries have a right place at all.
    """
    order = distance.argsort(stable=True)
    distance, hits = distance[order], right[order].double().cumsum(0)
    last = torch.cat([distance[1:] != distance[:-1], distance.new_ones(min(len(distance), 1)) > 0])  # of each step
    loops = last.nonzero()[:, 0] + 1
    return hits[last] / loops, hits[last] / max(revisits, 1)
