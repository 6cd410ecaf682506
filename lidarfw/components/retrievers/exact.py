"""Exact nearest-neighbour search over all descriptors of a map."""

from __future__ import annotations

import torch
from torch import Tensor

from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Retriever
from lidarfw.retrieval import Index
from lidarfw.types import Descriptors, Matches, Poses

QUERIES = 1024  # at a time
FEW = 16  # queries, up to which differences are faster than inner products


class ExactRetriever(Retriever):
    """Compare every query with every place of the map by L2 distance, `chunk` places at a time.

    Many queries at once go by inner products, in float64 since that formula cancels for near neighbours; a few by
    differences, which reads the map once and copies nothing. A descriptor finds itself, at distance 0, also among near
    copies. Raises DataError for descriptors that are not finite and
    ConfigError for a query of another width than the map.
    """

    def __init__(self, *, chunk: int = 8192) -> None:
        super().__init__()
        if chunk < 1:
            raise ConfigError(f"chunk must be at least 1, found {chunk}")
        self.chunk = chunk

    def build(self, descriptors: Descriptors, poses: Poses) -> Index:
        """The index of a map; its times are not known (NaN), set them by `index.replace(time=...)`.

        A pose that is not ok is not known.
        """
        vector = _finite(descriptors, "map")
        if len(vector) != poses.batch_size:
            raise DataError(
                f"the map has {len(vector)} descriptors but {poses.batch_size} poses; each place needs both"
            )
        time = torch.full((len(vector),), torch.nan, dtype=torch.float64, device=vector.device)
        pose = poses.matrix.masked_fill(~poses.ok[:, None, None], 0)
        return Index(vector, pose, time, descriptors.modality)

    def add(self, index: Index, descriptors: Descriptors, poses: Poses) -> Index:
        """The index with more places behind those it has; the modality is kept where both have it."""
        rows = self.build(descriptors, poses)
        if len(index) and rows.vector.shape[1] != index.vector.shape[1]:
            raise ConfigError(
                f"the map has {index.vector.shape[1]} numbers a place, the new ones {rows.vector.shape[1]}"
            )
        vector, pose, time = (
            torch.cat([getattr(part, name) for part in (index, rows)]) for name in ("vector", "pose", "time")
        )
        named = len(index.modality) == len(index) and len(rows.modality) == len(rows)
        return Index(vector, pose, time, (*index.modality, *rows.modality) if named else ())

    @torch.no_grad()
    def query(self, index: Index, descriptors: Descriptors, k: int) -> Matches:
        """The k nearest places of each descriptor; where the map has fewer, index -1 and distance inf fill up."""
        vector = _finite(descriptors, "query")
        if k < 1:
            raise ConfigError(f"a query needs k of at least 1, found {k}")
        if len(index) and vector.shape[1] != index.vector.shape[1]:
            raise ConfigError(
                f"the map has descriptors of {index.vector.shape[1]} numbers, the query has {vector.shape[1]}.\n"
                "  fix: query with the model that built the map"
            )
        blocks = [self._search(index, vector[i : i + QUERIES], k) for i in range(0, max(len(vector), 1), QUERIES)]
        return Matches(torch.cat([rows for rows, _ in blocks]), torch.cat([distance for _, distance in blocks]))

    def _search(self, index: Index, vector: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Row and distance (Q, k) of the nearest places of a block of queries (Q, D)."""
        best = torch.full((len(vector), k), torch.inf, dtype=torch.float64, device=vector.device)
        rows = torch.full(best.shape, -1, dtype=torch.long, device=vector.device)
        for start in range(0, len(index), self.chunk):
            part = index.vector[start : start + self.chunk]
            distance = _distances(vector, part)
            number = torch.arange(start, start + len(part), device=rows.device).expand(len(vector), -1)
            best, order = torch.cat([best, distance], 1).topk(k, dim=1, largest=False)
            rows = torch.cat([rows, number], 1).gather(1, order)
        exact = (vector[:, None] - index.vector[rows]).norm(dim=2) if len(index) else best.float()
        exact, order = torch.where(rows >= 0, exact, torch.inf).sort(stable=True, dim=1)
        return rows.gather(1, order), exact


def _distances(vector: Tensor, part: Tensor) -> Tensor:
    """(Q, N) in float64."""
    if len(vector) <= FEW:
        return torch.cdist(vector.float(), part.float(), compute_mode="donot_use_mm_for_euclid_dist").double()
    return torch.cdist(vector.double(), part.double(), compute_mode="use_mm_for_euclid_dist")


def _finite(descriptors: Descriptors, what: str) -> Tensor:
    bad = (~descriptors.vector.isfinite().all(1)).nonzero()[:, 0].tolist()
    if bad:
        raise DataError(f"{len(bad)} of the {what}'s descriptors hold NaN or inf, the first in row {bad[0]}")
    return descriptors.vector.detach()
