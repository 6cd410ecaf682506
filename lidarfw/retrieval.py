"""The index of a map for place retrieval, and recall figures."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lidarfw.errors import DataError
from lidarfw.files import atomic_path
from lidarfw.types import Matches, Poses, Record

FORMAT = 1
_ROWS = {"vector": 2, "pose": 3, "time": 1, "modality": 1}  # arrays of the file and their dimensions


@dataclass
class Index(Record):
    """One descriptor and pose for each of the N places of a map."""

    vector: Tensor  # (N, D) float32
    pose: Tensor  # (N, 4, 4) sensor to map; zeros where not known
    time: Tensor  # (N,) seconds; NaN where not known
    modality: tuple[str, ...] = ()  # "lidar" or "camera" of each place, or empty

    def __len__(self) -> int:
        return int(self.vector.shape[0])

    @property
    def known(self) -> Tensor:
        """(N,) bool: which places have a pose."""
        return self.pose[:, 3, 3] == 1

    def save(self, path: str | Path) -> None:
        """Write an .npz file of plain arrays, atomically. DataError where the file system refuses."""
        arrays = {name: getattr(self, name).cpu().numpy() for name in ("vector", "pose", "time")}
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez(file, format=np.array(FORMAT), modality=np.array(self.modality, dtype=np.str_), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Index:
        """Read what `save` wrote. DataError names what is wrong with the file; it can hold no code."""
        if not Path(path).is_file():
            raise DataError(f"there is no map {path}.\n  fix: make one with lidarfw index build CKPT SCAN... -o {path}")
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in ("format", *_ROWS)}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise DataError(
                f"{path} is no index of a map: {error}.\n  fix: write it again with lidarfw index build"
            ) from error
        _check(path, arrays)
        modality = tuple(str(name) for name in arrays["modality"])
        vector, pose, time = (torch.from_numpy(arrays[name]) for name in ("vector", "pose", "time"))
        return cls(vector, pose, time, modality)


def _check(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    if arrays["format"].tolist() != FORMAT:
        raise DataError(f"{path}: index format {arrays['format'].tolist()}, this version of lidarfw reads {FORMAT}")
    for name, dimensions in _ROWS.items():
        array, rows = arrays[name], len(arrays["vector"]) if arrays["vector"].ndim else 0
        expected_rows = {0, rows} if name == "modality" else {rows}
        if (
            array.ndim != dimensions
            or len(array) not in expected_rows
            or (name == "pose" and array.shape[1:] != (4, 4))
        ):
            raise DataError(f"{path}: {name} has shape {array.shape}, which does not fit {rows} places")


def recall_at(
    matches: Matches, queries: Poses, index: Index, *, radius: float = 5.0, counts: Sequence[int] = (1, 5, 10)
) -> dict[str, float]:
    """Share of queries with a place within `radius` metres among their N best matches: `{"recall@1": 0.9, ...}`.

    Only queries that have such a place in the map, and whose pose is ok, are counted; 0 where there are none. A place
    whose pose is not known is near nothing.
    """
    places, here = index.pose[:, :3, 3].double(), queries.matrix[:, :3, 3].double()
    blocks = [_nearest(here[i : i + 1024], places[index.known]) for i in range(0, max(len(here), 1), 1024)]
    solvable = queries.ok & (torch.cat(blocks) <= radius)
    found = places[matches.index.clamp(min=0)] if len(index) else here[:, None].expand(*matches.index.shape, 3)
    known = (matches.index >= 0) & (index.known[matches.index.clamp(min=0)] if len(index) else False)
    right = ((found - here[:, None]).norm(dim=2) <= radius) & known
    total = max(int(solvable.sum()), 1)
    return {f"recall@{count}": float((right[:, :count].any(1) & solvable).sum() / total) for count in counts}


def _nearest(places: Tensor, others: Tensor) -> Tensor:
    """Distance (M,) of each place to the nearest of the others, inf where there are none."""
    distance = torch.cdist(places, others)
    return torch.cat([distance, distance.new_full((len(distance), 1), torch.inf)], 1).amin(1)
