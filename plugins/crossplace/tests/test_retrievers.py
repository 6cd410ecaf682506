"""Approximate search against exact search, and what happens without the engines."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lidarfw.components.retrievers.exact import ExactRetriever
from lidarfw.errors import ConfigError, DataError
from lidarfw.retrieval import Index
from lidarfw.testing import run_checks
from lidarfw.types import Descriptors, Poses

from lidarfw_crossplace.retrievers import FaissIndex, FaissRetriever, MilvusIndex, MilvusRetriever, agreement


def drive(count: int, width: int = 32) -> tuple[Descriptors, Poses]:
    """Descriptors that change slowly along a way, as those of a drive do."""
    generator = torch.Generator().manual_seed(0)
    steps = torch.randn(count, width, generator=generator).cumsum(0) + 4 * torch.randn(width, generator=generator)
    vector = torch.nn.functional.normalize(steps, dim=1)
    matrix = torch.eye(4).repeat(count, 1, 1)
    matrix[:, 0, 3] = torch.arange(count)
    return Descriptors(vector, ("lidar",) * count), Poses(matrix, torch.ones(count) > 0, torch.ones(count))


def some(descriptors: Descriptors, rows: slice) -> Descriptors:
    noise = 0.01 * torch.randn(descriptors.vector[rows].shape, generator=torch.Generator().manual_seed(1))
    return Descriptors(torch.nn.functional.normalize(descriptors.vector[rows] + noise, dim=1), ())


@pytest.mark.parametrize("kind", ["flat", "hnsw", "ivf_pq"])
def test_faiss_finds_nearly_what_exact_search_finds(kind: str, tmp_path: Path) -> None:
    pytest.importorskip("faiss", reason="needs lidarfw-crossplace[faiss]")
    places, poses = drive(2000)
    retriever = FaissRetriever(kind=kind, code_bytes=8)
    index = retriever.build(places, poses)
    queries = some(places, slice(0, 2000, 20))
    assert agreement(retriever, index, queries) >= (1.0 if kind == "flat" else 0.95)
    assert retriever.report(index) > 0.9
    exact, found = ExactRetriever().query(index, queries, 3), retriever.query(index, queries, 3)
    same = exact.index == found.index
    assert torch.allclose(exact.distance[same], found.distance[same], atol=1e-5)
    index.save(tmp_path / "map.npz")
    assert torch.equal(retriever.query(FaissIndex.load(tmp_path / "map.npz"), queries, 3).index, found.index)


def test_faiss_adds_places_and_fills_up() -> None:
    pytest.importorskip("faiss", reason="needs lidarfw-crossplace[faiss]")
    places, poses = drive(30)
    halves = [_part(places, poses, part) for part in (slice(0, 15), slice(15, 30))]
    retriever = FaissRetriever()
    index = retriever.add(retriever.build(*halves[0]), *halves[1])
    found = retriever.query(index, places, 32)
    assert found.index[:, 0].tolist() == list(range(30))
    assert (found.index[:, 30:] == -1).all()
    assert found.distance[:, 30:].isinf().all()
    assert torch.equal(index.pose, poses.matrix)
    assert len(index.modality) == 30


def _part(places: Descriptors, poses: Poses, rows: slice) -> tuple[Descriptors, Poses]:
    chosen = Poses(poses.matrix[rows], poses.ok[rows], poses.confidence[rows])
    return Descriptors(places.vector[rows], places.modality[rows]), chosen


def test_agreement_sees_an_engine_that_fails() -> None:
    class Blind(ExactRetriever):
        def query(self, index: Index, descriptors: Descriptors, k: int):  # type: ignore[no-untyped-def]
            found = super().query(index, descriptors, k)
            return found.replace(index=(found.index + 7) % len(index))

    places, poses = drive(100)
    index = ExactRetriever().build(places, poses)
    assert agreement(ExactRetriever(), index, places, 2) == 1
    assert agreement(Blind(), index, places) == 0


def test_missing_engines_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, retriever in (("faiss", FaissRetriever()), ("pymilvus", MilvusRetriever())):
        monkeypatch.setitem(__import__("sys").modules, name, None)
        with pytest.raises(ConfigError, match=r"needs the library.*\n.*pip install 'lidarfw-crossplace\["):
            retriever.build(*drive(4))  # type: ignore[attr-defined]


def test_conformance_skips_what_needs_a_missing_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "faiss", None)
    results = {r.check: r for r in run_checks("lidarfw_crossplace.retrievers:FaissRetriever")}
    assert results["finds_every_place_again"].status == "skipped"
    assert "lidarfw-crossplace[faiss]" in results["finds_every_place_again"].message


def test_files_of_other_indices_are_refused(tmp_path: Path) -> None:
    ExactRetriever().build(*drive(4)).save(tmp_path / "map.npz")
    with pytest.raises(DataError, match="names no Milvus collection"):
        MilvusIndex.load(tmp_path / "map.npz")
    pytest.importorskip("faiss", reason="needs lidarfw-crossplace[faiss]")
    with pytest.raises(DataError, match="no FAISS index"):
        FaissIndex.load(tmp_path / "map.npz")


def test_milvus_finds_what_exact_search_finds(tmp_path: Path) -> None:
    pytest.importorskip("pymilvus", reason="needs lidarfw-crossplace[milvus]")
    pytest.importorskip("milvus_lite", reason="needs lidarfw-crossplace[milvus]")
    places, poses = drive(60)
    retriever = MilvusRetriever(uri=str(tmp_path / "places.db"))
    index = retriever.build(places, poses)
    exact = ExactRetriever().query(ExactRetriever().build(places, poses), some(places, slice(0, 60, 3)), 3)
    index.save(tmp_path / "map.npz")
    found = retriever.query(MilvusIndex.load(tmp_path / "map.npz"), some(places, slice(0, 60, 3)), 3)
    assert torch.equal(found.index, exact.index)
    assert torch.allclose(found.distance, exact.distance, atol=1e-3)
    assert (retriever.query(index, places, 62).index[:, 60:] == -1).all()


@pytest.mark.parametrize("kind", ["flat", "hnsw", "ivf_pq"])
def test_a_map_is_searched_as_the_kind_that_it_was_built_as(kind: str) -> None:
    pytest.importorskip("faiss", reason="needs lidarfw-crossplace[faiss]")
    places, poses = drive(2000)
    index = FaissRetriever(kind=kind, code_bytes=8).build(places, poses)
    queries = some(places, slice(0, 2000, 20))
    expected = FaissRetriever(kind=kind, code_bytes=8).query(index, queries, 3)
    for other in ("flat", "hnsw", "ivf_pq"):
        assert torch.equal(FaissRetriever(kind=other).query(index, queries, 3).index, expected.index)


def test_an_engine_of_another_kind_is_refused() -> None:
    places, poses = drive(3)
    rows = ExactRetriever().build(places, poses)
    index = FaissIndex(rows.vector, rows.pose, rows.time, rows.modality, engine=SimpleNamespace(d=32))
    with pytest.raises(DataError, match="holds a FAISS SimpleNamespace, expected one of: flat, hnsw, ivf_pq"):
        FaissRetriever().query(index, places, 1)
