"""Retriever `exact`, the map index and recall."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lidarfw.cli import main
from lidarfw.components.retrievers.exact import ExactRetriever
from lidarfw.errors import ConfigError, DataError
from lidarfw.retrieval import Index, recall_at
from lidarfw.types import Descriptors, Matches, Poses


def unit(number: int, width: int = 32, seed: int = 0) -> Tensor:
    return torch.nn.functional.normalize(
        torch.randn(number, width, generator=torch.Generator().manual_seed(seed)), dim=1
    )


def poses_of(x: list[float] | int) -> Poses:
    places = torch.arange(x, dtype=torch.float64) if isinstance(x, int) else torch.tensor(x, dtype=torch.float64)
    matrix = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
    matrix[:, 0, 3] = places
    return Poses(matrix, torch.ones(len(places), dtype=torch.bool), torch.ones(len(places)))


@pytest.mark.parametrize("chunk", [7, 100, 8192])
def test_every_place_finds_itself_first(chunk: int) -> None:
    vector = unit(100)
    vector[50:] = vector[:50] + 1e-6 * unit(50, seed=1)  # near copies
    retriever = ExactRetriever(chunk=chunk)
    index = retriever.build(Descriptors(vector), poses_of(100))
    for k in (1, 5):
        matches = retriever.query(index, Descriptors(vector), k)
        assert matches.index[:, 0].tolist() == list(range(100))
        assert matches.distance[:, 0].tolist() == [0.0] * 100
        alone = [retriever.query(index, Descriptors(row[None]), k) for row in vector]
        assert [int(match.index[0, 0]) for match in alone] == list(range(100))
        assert {float(match.distance[0, 0]) for match in alone} == {0.0}


@pytest.mark.parametrize("count", [1, 16, 17])
def test_few_and_many_queries_find_the_same(count: int) -> None:
    vector, queries = unit(500), unit(count, seed=1)
    retriever = ExactRetriever(chunk=128)
    index = retriever.build(Descriptors(vector), poses_of(500))
    matches = retriever.query(index, Descriptors(queries), 5)
    expected = (queries[:, None].double() - vector.double()).norm(dim=2).sort(1)
    assert matches.index.equal(expected.indices[:, :5])
    torch.testing.assert_close(matches.distance.double(), expected.values[:, :5], atol=1e-6, rtol=0)


def test_search_equals_sorting_all_distances() -> None:
    vector, queries = unit(300), unit(40, seed=1)
    retriever = ExactRetriever(chunk=64)
    matches = retriever.query(retriever.build(Descriptors(vector), poses_of(300)), Descriptors(queries), 12)
    distance = (queries[:, None].double() - vector.double()).norm(dim=2)
    expected = distance.sort(1)
    assert matches.index.equal(expected.indices[:, :12])
    torch.testing.assert_close(matches.distance.double(), expected.values[:, :12], atol=1e-6, rtol=0)


def test_more_queries_than_are_searched_at_once() -> None:
    vector = unit(1500, 8)
    retriever = ExactRetriever()
    matches = retriever.query(retriever.build(Descriptors(vector), poses_of(1500)), Descriptors(vector), 1)
    assert matches.index[:, 0].tolist() == list(range(1500))


@pytest.mark.parametrize("size", [0, 3])
def test_small_maps_are_filled_up(size: int) -> None:
    retriever = ExactRetriever()
    index = retriever.build(Descriptors(unit(size)), poses_of(size))
    matches = retriever.query(index, Descriptors(unit(2)), 5)
    assert matches.index.shape == matches.distance.shape == (2, 5)
    assert (matches.index[:, size:] == -1).all()
    assert matches.distance[:, size:].isinf().all()
    assert matches.distance[:, :size].isfinite().all()
    none = retriever.query(index, Descriptors(unit(0)), 5)
    assert none.index.shape == (0, 5)


def test_bad_descriptors_are_refused() -> None:
    retriever, bad = ExactRetriever(), unit(5)
    index = retriever.build(Descriptors(unit(5)), poses_of(5))
    bad[3, 2] = torch.nan
    with pytest.raises(DataError, match="query's descriptors hold NaN or inf, the first in row 3"):
        retriever.query(index, Descriptors(bad), 1)
    with pytest.raises(DataError, match="map's"):
        retriever.build(Descriptors(bad), poses_of(5))
    with pytest.raises(DataError, match="5 descriptors but 4 poses"):
        retriever.build(Descriptors(unit(5)), poses_of(4))
    with pytest.raises(ConfigError, match="descriptors of 32 numbers, the query has 16"):
        retriever.query(index, Descriptors(unit(5, 16)), 1)
    with pytest.raises(ConfigError, match="at least 1"):
        retriever.query(index, Descriptors(unit(5)), 0)
    with pytest.raises(ConfigError, match="chunk"):
        ExactRetriever(chunk=0)


# --- index file -----------------------------------------------------------------------------------------------------


def test_saved_index_is_the_same(tmp_path: Path) -> None:
    retriever = ExactRetriever()
    index = retriever.build(Descriptors(unit(9), ("lidar",) * 5 + ("camera",) * 4), poses_of(9))
    index = index.replace(time=torch.arange(9, dtype=torch.float64))
    path = tmp_path / "maps" / "town.npz"
    index.save(path)
    again = Index.load(path)
    assert again.vector.equal(index.vector)
    assert again.pose.equal(index.pose)
    assert again.time.equal(index.time)
    assert again.modality == index.modality
    assert os.listdir(path.parent) == ["town.npz"]
    queries = Descriptors(unit(4, seed=3))
    assert retriever.query(again, queries, 3).index.equal(retriever.query(index, queries, 3).index)


def test_failed_save_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    retriever, path = ExactRetriever(), tmp_path / "map.npz"
    retriever.build(Descriptors(unit(3)), poses_of(3)).save(path)

    def full_disk(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(DataError, match="No space left"):
        retriever.build(Descriptors(unit(8)), poses_of(8)).save(path)
    assert len(Index.load(path)) == 3
    assert os.listdir(tmp_path) == ["map.npz"]


def broken_files(folder: Path) -> dict[str, Path]:
    whole = folder / "whole.npz"
    ExactRetriever().build(Descriptors(unit(5)), poses_of(5)).save(whole)
    content = whole.read_bytes()
    arrays = dict(np.load(whole))
    made = {
        "missing": None,
        "empty": b"",
        "cut": content[: len(content) // 2],
        "text": b"not an index",
    }
    paths = {name: folder / f"{name}.npz" for name in [*made, "pickle", "no pose", "rows", "pose shape", "format"]}
    for name, data in made.items():
        if data is not None:
            paths[name].write_bytes(data)
    np.savez(paths["pickle"], **{**arrays, "vector": np.array([{"a": 1}], dtype=object)})
    np.savez(paths["no pose"], **{name: value for name, value in arrays.items() if name != "pose"})
    np.savez(paths["rows"], **{**arrays, "time": arrays["time"][:3]})
    np.savez(paths["pose shape"], **{**arrays, "pose": arrays["pose"][:, :3]})
    np.savez(paths["format"], **{**arrays, "format": np.array(9)})
    return paths


def test_broken_index_files_are_named(tmp_path: Path) -> None:
    for name, path in broken_files(tmp_path).items():
        with pytest.raises(DataError, match=f"{name}.npz"):
            Index.load(path)


def test_a_map_that_is_not_there_is_not_called_broken(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"there is no map .*none\.npz\.\n  fix: make one with lidarfw index build"):
        Index.load(tmp_path / "none.npz")


# --- recall ---------------------------------------------------------------------------------------------------------


def test_recall_golden() -> None:
    index = ExactRetriever().build(Descriptors(unit(4)), poses_of([0.0, 10.0, 20.0, 30.0]))
    queries = poses_of([1.0, 11.0, 29.0, 500.0, 1.0])  # the fourth has no place near it
    queries.ok[4] = False
    rows = torch.tensor([[0, 1, 2], [3, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2]])
    matches = Matches(rows, torch.zeros(5, 3))
    found = recall_at(matches, queries, index, radius=5.0, counts=(1, 2, 3))
    assert found == pytest.approx({"recall@1": 1 / 3, "recall@2": 2 / 3, "recall@3": 2 / 3})
    assert recall_at(matches, queries, index, radius=15.0, counts=(1,)) == {"recall@1": pytest.approx(1 / 3)}


def test_a_place_without_a_pose_is_near_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Not even a query at the origin."""
    poses = poses_of([1.0, 0.0, 100.0])
    poses.ok[:2] = False  # the first has numbers that are no pose
    poses.matrix[1] = 0
    retriever, vector = ExactRetriever(), unit(3)
    retriever.build(Descriptors(vector), poses).save(tmp_path / "map.npz")
    retriever.build(Descriptors(vector), poses_of([1.0, 0.0, 99.0])).save(tmp_path / "queries.npz")
    assert Index.load(tmp_path / "map.npz").known.tolist() == [False, False, True]
    for queries, recall in ((slice(0, 2), "0.0000"), (slice(0, 3), "1.0000")):
        index = Index.load(tmp_path / "queries.npz")
        index.replace(vector=index.vector[queries], pose=index.pose[queries], time=index.time[queries]).save(
            tmp_path / "some.npz"
        )
        assert main(["index", "eval", str(tmp_path / "map.npz"), str(tmp_path / "some.npz"), "--counts", "3"]) == 0
        assert recall in capsys.readouterr().out


def test_recall_without_anything_is_zero() -> None:
    empty = ExactRetriever().build(Descriptors(unit(0)), poses_of(0))
    matches = ExactRetriever().query(empty, Descriptors(unit(3)), 2)
    assert recall_at(matches, poses_of(3), empty) == {"recall@1": 0.0, "recall@5": 0.0, "recall@10": 0.0}
    index = ExactRetriever().build(Descriptors(unit(2)), poses_of(2))
    none = Matches(torch.zeros(0, 1, dtype=torch.long), torch.zeros(0, 1))
    assert recall_at(none, poses_of(0), index, counts=(1,)) == {"recall@1": 0.0}
