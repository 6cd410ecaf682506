"""Checks of retrievers."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import torch

from lidarfw.testing.checks.compare import difference
from lidarfw.testing.checks.subject import Subject, build, check, require
from lidarfw.types import Descriptors, Poses

PLACES, WIDTH = 20, 16


def _map(subject: Subject) -> tuple[Any, Any, Descriptors]:
    retriever = build(subject).module.eval()
    generator = torch.Generator().manual_seed(0)
    vector = torch.nn.functional.normalize(torch.randn(PLACES, WIDTH, generator=generator), dim=1)
    descriptors = Descriptors(vector, ("lidar",) * PLACES)
    matrix = torch.eye(4).repeat(PLACES, 1, 1)
    matrix[:, 0, 3] = torch.arange(PLACES) * 10.0
    poses = Poses(matrix, torch.ones(PLACES, dtype=torch.bool), torch.ones(PLACES))
    return retriever, retriever.build(descriptors, poses), descriptors


@check("retriever")
def finds_every_place_again(subject: Subject) -> None:
    """The nearest entry of a map's own descriptor is itself, and matches are sorted by distance."""
    retriever, index, descriptors = _map(subject)
    matches = retriever.query(index, descriptors, 3)
    require(matches.index[:, 0].tolist() == list(range(PLACES)), "a descriptor of the map does not find itself")
    require(tuple(matches.index.shape) == (PLACES, 3), f"3 matches were asked for, got {tuple(matches.index.shape)}")
    require(bool((matches.distance.diff(dim=1) >= 0).all()), "matches are not sorted by distance")


@check("retriever")
def index_survives_saving(subject: Subject) -> None:
    """The index saved and loaded gives the same matches."""
    retriever, index, descriptors = _map(subject)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.npz"
        index.save(path)
        loaded = type(index).load(path)
    text = difference(retriever.query(index, descriptors, 5), retriever.query(loaded, descriptors, 5))
    require(not text, f"the loaded index gives other matches: {text}")


@check("retriever")
def fills_up_small_maps(subject: Subject) -> None:
    """Where fewer than k places are in the map, index -1 and distance inf fill up; no query gives no match."""
    retriever, index, descriptors = _map(subject)
    matches = retriever.query(index, descriptors, PLACES + 2)
    require(bool((matches.index[:, PLACES:] == -1).all()), "missing matches must have index -1")
    require(bool(matches.distance[:, PLACES:].isinf().all()), "missing matches must have distance inf")
    require(len(retriever.query(index, Descriptors(descriptors.vector[:0], ()), 2).index) == 0, "no query, no match")
