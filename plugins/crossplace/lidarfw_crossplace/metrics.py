"""How well one sensor finds the places of another: the protocols and figures of the paper (4.2 to 4.5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from lidarfw.components.metrics.recall_at import PlaceMetric, precision_recall, rank_of_first
from lidarfw.errors import ConfigError
from lidarfw.types import Spec
from torch import Tensor

DIRECTIONS = {"2d3d": ("camera", "lidar"), "3d2d": ("lidar", "camera"), "2d2d": ("camera",) * 2, "3d3d": ("lidar",) * 2}
QUERIES = 512  # at a time
_CAMERA = 1.0


class PlaceRecall(PlaceMetric):
    """Place recognition across sensors: each of four directions, query to map: 2d3d, 3d2d, 2d2d, 3d3d.

    Which frames are queries and which the map: with `map_sequences`, these sequences are the map and all others query.
    Without, as in the paper (4.2), a frame becomes a query when the drive has gone on by more than `spacing` metres
    since the last one; the others are the map. Then a frame of the map taken a moment before or after is nearly always
    there; with `apart` seconds, map frames of the query's own sequence that are nearer in time are left out, so only
    true revisits count. A match is right where the positions in the ground plane are less than a radius apart.

    `compute` gives for each direction and radius `recall@N`, `recall@1%` (a hundredth of the map, rounded, at least
    one), `ap`, `ceiling`, the share of queries with a right place at all, and `chance`, the recall@1 of guessing, as
    `2d3d_recall@1_10m`; for each direction `2d3d_error`, the mean distance in metres of the best matches, and
    `2d3d_queries`; and `recall@1`, the mean of 2d3d and 3d2d at the first radius, or of the directions that there are.
    Queries without any right place count as misses unless `exclude_hopeless`. Raises ConfigError for radii, counts and
    spacing that are not positive, and where no frame is of the map.
    """

    monitor: ClassVar[str] = "recall@1"
    higher_is_better = True

    def __init__(
        self,
        descriptors: Spec,
        *,
        radii: Sequence[float] = (10.0, 1.0, 2.0, 5.0, 20.0),
        counts: Sequence[int] = (1, 5),
        map_sequences: Sequence[str] = (),
        spacing: float = 3.0,
        apart: float = 0.0,
        exclude_hopeless: bool = False,
    ) -> None:
        super().__init__(descriptors, map_sequences)
        if not radii or min(*radii, *counts, spacing) <= 0 or apart < 0:
            raise ConfigError(
                f"metric.place_recall: radii, counts and spacing must be above 0 and apart at least 0, "
                f"got {list(radii)}, {list(counts)}, {spacing} and {apart}"
            )
        self.radii, self.counts = list(radii), sorted({1, *counts})
        self.spacing, self.apart, self.exclude_hopeless = spacing, apart, exclude_hopeless

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        vectors, places = self.gathered()
        asking, asked = self._roles(places)
        camera = places[:, 5] == _CAMERA
        figures: dict[str, float] = {}
        for name, (query, map_) in DIRECTIONS.items():
            rows, base = asking & (camera == (query == "camera")), asked & (camera == (map_ == "camera"))
            if rows.any() and base.any():
                figures |= {f"{name}_{key}": value for key, value in self._judge(vectors, places, rows, base).items()}
        first = f"recall@1_{self.radii[0]:g}m"
        there = [n for n in DIRECTIONS if f"{n}_{first}" in figures]
        main = [n for n in there if n in ("2d3d", "3d2d")] or there
        total = sum(figures[f"{n}_{first}"] for n in main) / max(len(main), 1)
        return {**figures, "recall@1": total}

    def _roles(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Which frames (F,) are queries, and which the map."""
        if self.map:
            in_map = self.in_map(places)
            return ~in_map, in_map
        queries = torch.zeros(len(places), dtype=torch.bool)
        for key in torch.unique(places[:, [0, 5]], dim=0):
            rows = (places[:, [0, 5]] == key).all(1).nonzero()[:, 0]
            rows = rows[places[rows, 1].argsort(stable=True)]
            queries[rows.cpu()] = spaced(places[rows, 2:4].cpu(), self.spacing)
        queries = queries.to(places.device)
        return queries, ~queries

    def _judge(self, vectors: Tensor, places: Tensor, rows: Tensor, base: Tensor) -> dict[str, float]:
        """Figures of one direction."""
        numbers, there = rows.nonzero()[:, 0], base.nonzero()[:, 0]
        blocks = [
            self._search(vectors, places, numbers[i : i + QUERIES], there) for i in range(0, len(numbers), QUERIES)
        ]
        found = torch.cat(blocks).cpu()  # (Q, 2 + 2 R)
        best, metres, count = found[:, 0], found[:, 1], len(there)
        figures = {"queries": float(len(found)), "error": float(metres[metres.isfinite()].mean().nan_to_num())}
        for place, radius in enumerate(self.radii):
            rank, share = found[:, 2 + 2 * place], found[:, 3 + 2 * place]
            hope = share > 0
            counted = hope if self.exclude_hopeless else torch.ones_like(hope)
            total = max(int(counted.sum()), 1)
            limits = {f"recall@{n}": n for n in self.counts} | {"recall@1%": max(round(count / 100), 1)}
            figures |= {f"{key}_{radius:g}m": float((rank <= n).sum()) / total for key, n in limits.items()}
            figures[f"ceiling_{radius:g}m"] = float(hope.sum()) / max(len(hope), 1)
            figures[f"chance_{radius:g}m"] = float(share[counted].sum()) / total
            precision, recall = precision_recall(best, rank == 1, int(hope.sum()))
            gain = torch.diff(recall, prepend=recall.new_zeros(1))
            figures[f"ap_{radius:g}m"] = float((gain * precision).sum())
        return figures

    def _search(self, vectors: Tensor, places: Tensor, rows: Tensor, there: Tensor) -> Tensor:
        """(Q, 2 + 2 R): distance of descriptors and metres to the best match, then for each radius the rank of the
        first right place (inf for none; of equal distances the wrong one comes first) and the share of right ones."""
        distance = torch.cdist(vectors[rows].double(), vectors[there].double())
        metres = torch.cdist(places[rows, 2:4], places[there, 2:4], compute_mode="donot_use_mm_for_euclid_dist")
        searched = (places[rows, :1] != places[there, 0]) | ((places[rows, 1:2] - places[there, 1]).abs() >= self.apart)
        distance = distance.masked_fill(~searched, torch.inf)
        best = distance.amin(1)
        ties = metres.masked_fill(~searched | (distance > best[:, None]), -torch.inf).amax(1)
        columns = [best, torch.where(best.isfinite(), ties, torch.inf)]
        for radius in self.radii:
            right = searched & (metres < radius)
            columns += [rank_of_first(right, searched, distance), right.sum(1) / searched.sum(1).clamp(min=1)]
        return torch.stack([column.double() for column in columns], 1)


def spaced(places: Tensor, spacing: float) -> Tensor:
    """Which frames (N,) of a drive become queries: each one more than `spacing` metres of way after the last.

    Split of SaliencyI2PLoc: the way since the last query is added up frame by frame; the first frame is none.
    """
    steps = (places[1:] - places[:-1]).norm(dim=1).tolist()
    chosen, way = [False] * min(len(places), 1), 0.0
    for step in steps:  # a running sum that starts again; some thousand numbers once per evaluation
        way += step
        chosen.append(way > spacing)
        way = 0.0 if way > spacing else way
    return torch.tensor(chosen, dtype=torch.bool)


def mcnemar(one: Tensor, other: Tensor) -> float:
    """The p-value that two methods are equally good, from which queries (Q,) each got right.

    Exact binomial test where they differ in fewer than 25 queries, else chi-squared with continuity correction.
    """
    from scipy import stats

    better, worse = int((one & ~other).sum()), int((~one & other).sum())
    if better + worse == 0:
        return 1.0
    if better + worse < 25:
        return float(stats.binomtest(better, better + worse, 0.5).pvalue)
    square = max(abs(better - worse) - 1, 0) ** 2 / (better + worse)
    return math.erfc(math.sqrt(square / 2))
