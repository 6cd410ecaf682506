"""Retrievers for maps that outgrow comparing every query with every place: FAISS in memory, Milvus beyond a machine.

Sources: Douze et al., "The Faiss library", 2024; Malkov and Yashunin, "Efficient and robust approximate nearest
neighbor search using Hierarchical Navigable Small World graphs" (HNSW), PAMI 2020; Jegou, Douze and Schmid, "Product
quantization for nearest neighbor search" (IVF-PQ), PAMI 2011. Both engines are optional: pip install
'lidarfw-crossplace[faiss]' or '[milvus]'.
"""

from __future__ import annotations

import importlib
import logging
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from lidarfw.components.retrievers.exact import ExactRetriever
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import atomic_path
from lidarfw.interfaces import Retriever
from lidarfw.retrieval import Index
from lidarfw.types import Descriptors, Matches, Poses
from torch import Tensor

log = logging.getLogger(__name__)
KINDS = ("flat", "hnsw", "ivf_pq")
_ENGINES = {"IndexFlat": "flat", "IndexFlatL2": "flat", "IndexHNSWFlat": "hnsw", "IndexIVFPQ": "ivf_pq"}
_TRIED = 256  # queries of the report on an approximate index
_PLACES_A_CELL = 64  # at most that the cells of ivf_pq are learnt from: a million places take a quarter of the time
_ROWS = 1000  # at a time, to and from a database


def _library(module: str, extra: str, what: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(
            f"retriever {what!r} needs the library {module}, which is not installed\n"
            f"  fix: pip install 'lidarfw-crossplace[{extra}]', or retriever=exact"
        ) from error


def agreement(retriever: Retriever, index: Index, queries: Descriptors, k: int = 1) -> float:
    """Recall against exact search: the share of the k truly nearest places that a retriever finds too.

    `index` must hold the descriptors of its places, as all indices but those of a database do.
    """
    exact = ExactRetriever().query(index, queries, k).index
    found = retriever.query(index, queries, k).index
    hits = (exact[:, :, None] == found[:, None]) & (exact >= 0)[:, :, None]
    return float(hits.any(2).sum()) / max(int((exact >= 0).sum()), 1)


def _checked(descriptors: Descriptors, poses: Poses) -> Index:
    """The rows of a map, with the checks of exact search."""
    return ExactRetriever().build(descriptors, poses)


@dataclass
class FaissIndex(Index):
    """A map with a FAISS index of its descriptors; the file holds plain arrays, no pickle."""

    engine: Any = None  # faiss.Index; number i is place i

    def save(self, path: str | Path) -> None:
        """Write an .npz file of plain arrays, atomically. DataError where the file system refuses."""
        faiss = _library("faiss", "faiss", "faiss")
        arrays = {name: getattr(self, name).cpu().numpy() for name in ("vector", "pose", "time")}
        arrays |= {"modality": np.array(self.modality, dtype=np.str_), "format": np.array(1)}
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, engine=faiss.serialize_index(self.engine), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> FaissIndex:
        """Read what `save` wrote. DataError where the file holds no FAISS index."""
        faiss, rows = _library("faiss", "faiss", "faiss"), Index.load(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                engine = faiss.deserialize_index(file["engine"])
        except (KeyError, ValueError, RuntimeError, zipfile.BadZipFile) as error:
            raise DataError(f"{path} holds no FAISS index: {error}.\n  fix: build it with retriever=faiss") from error
        if engine.ntotal != len(rows):
            raise DataError(f"{path}: the FAISS index has {engine.ntotal} places, the map {len(rows)}")
        return cls(rows.vector, rows.pose, rows.time, rows.modality, engine)


class FaissRetriever(Retriever):
    """Nearest neighbours by FAISS, in memory, by L2 distance.

    `flat` compares with every place; `hnsw` walks a graph: the fastest at a given recall, 4 D + 8 M bytes a place;
    `ivf_pq` compares codes of `code_bytes` a place in the `probes` cells nearest to the query: the smallest. The
    distances of matches are exact in all three, since the candidates of `ivf_pq` are compared once more with the
    descriptors of the map. After a build, the log says the recall against exact search on the map's own descriptors.
    """

    example: ClassVar[dict[str, Any]] = {"kind": "hnsw"}

    def __init__(
        self,
        *,
        kind: str = "hnsw",
        links: int = 32,
        build_depth: int = 200,
        search_depth: int = 128,
        cells: int = 0,
        probes: int = 32,
        code_bytes: int = 64,
        candidates: int = 100,
    ) -> None:
        """Options.

        kind: flat, hnsw or ivf_pq, of maps that are built; one that stands is searched as the kind that it is. links,
        build_depth, search_depth: M, efConstruction and efSearch of hnsw. cells: of
        ivf_pq, 0 for 4 sqrt(N). probes: cells searched. code_bytes: of a place; must divide the descriptor's length.
        candidates: places of ivf_pq that are compared exactly.
        """
        super().__init__()
        if kind not in KINDS:
            raise ConfigError(f"retriever 'faiss': kind is {kind!r}; use one of: {', '.join(KINDS)}")
        self.kind, self.links, self.build_depth, self.search_depth = kind, links, build_depth, search_depth
        self.cells, self.probes, self.code_bytes, self.candidates = cells, probes, code_bytes, candidates

    def build(self, descriptors: Descriptors, poses: Poses) -> FaissIndex:
        """The index of a map."""
        rows = _checked(descriptors, poses)
        vector = _array(rows.vector)
        engine = self._engine(*vector.shape)
        if not engine.is_trained:
            engine.train(vector)
        engine.add(vector)
        index = FaissIndex(rows.vector, rows.pose, rows.time, rows.modality, engine)
        self.report(index)
        return index

    def add(self, index: FaissIndex, descriptors: Descriptors, poses: Poses) -> FaissIndex:
        """The index with more places; the graph or the cells stay as they are."""
        rows = _checked(descriptors, poses)
        index.engine.add(_array(rows.vector))
        whole = {n: torch.cat([getattr(index, n), getattr(rows, n)]) for n in ("vector", "pose", "time")}
        return FaissIndex(**whole, modality=(*index.modality, *rows.modality), engine=index.engine)

    def report(self, index: FaissIndex) -> float:
        """Recall of the 10 nearest against exact search, of descriptors of the map; the log says it."""
        kind = _kind_of(index.engine)
        if kind == "flat" or not len(index):
            return 1.0
        chosen = torch.linspace(0, len(index) - 1, min(len(index), _TRIED)).round().long()
        queries = Descriptors(index.vector[chosen], ())
        recall = agreement(self, index, queries, min(10, len(index)))
        log.info("%s over %d places finds %.1f %% of the 10 truly nearest", kind, len(index), 100 * recall)
        return recall

    def _engine(self, count: int, width: int) -> Any:
        faiss = _library("faiss", "faiss", "faiss")
        if self.kind == "flat":
            return faiss.IndexFlatL2(width)
        if self.kind == "hnsw":
            engine = faiss.IndexHNSWFlat(width, self.links)
            engine.hnsw.efConstruction = self.build_depth
            return engine
        if width % self.code_bytes:
            raise ConfigError(f"retriever 'faiss': code_bytes {self.code_bytes} does not divide the {width} numbers")
        if count < 256:
            raise DataError(f"ivf_pq learns 256 codes a part and needs as many places, the map has {count}: kind=flat")
        cells = self.cells or max(int(4 * count**0.5), 1)
        cells = min(cells, count // 39 or 1)
        engine = faiss.IndexIVFPQ(faiss.IndexFlatL2(width), width, cells, self.code_bytes, 8)
        engine.cp.max_points_per_centroid = _PLACES_A_CELL
        return engine

    @torch.no_grad()
    def query(self, index: FaissIndex, descriptors: Descriptors, k: int) -> Matches:
        """The k nearest places of each descriptor; -1 and inf where the map has fewer or the search found fewer."""
        if k < 1:
            raise ConfigError(f"a query needs k of at least 1, found {k}")
        vector = _array(descriptors.vector)
        if len(index) and vector.shape[1] != index.engine.d:
            raise ConfigError(f"the map has descriptors of {index.engine.d} numbers, the query has {vector.shape[1]}")
        if not len(vector):
            return Matches(torch.zeros(0, k, dtype=torch.long), torch.zeros(0, k))
        wanted = max(k, self.candidates) if _kind_of(index.engine) == "ivf_pq" else k
        rows = torch.from_numpy(self._search(index.engine, vector, min(wanted, max(len(index), 1))))
        return _sorted(index.vector, torch.from_numpy(vector), rows, k)

    def _search(self, engine: Any, vector: npt.NDArray[np.float32], k: int) -> npt.NDArray[np.int64]:
        kind = _kind_of(engine)
        if kind == "hnsw":
            engine.hnsw.efSearch = max(self.search_depth, k)
        elif kind == "ivf_pq":
            engine.nprobe = self.probes
        _, rows = engine.search(vector, k)
        return rows  # type: ignore[no-any-return]


def _kind_of(engine: Any) -> str:
    """The kind that a map was built as, whatever it is now asked with."""
    name = type(engine).__name__
    if name not in _ENGINES:
        raise DataError(f"the map holds a FAISS {name}, expected one of: {', '.join(KINDS)}\n  fix: build it anew")
    return _ENGINES[name]


def _array(vector: Tensor) -> npt.NDArray[np.float32]:
    return np.ascontiguousarray(vector.detach().cpu().float().numpy())


def _sorted(places: Tensor, vector: Tensor, rows: Tensor, k: int) -> Matches:
    """The k nearest of the candidate rows (Q, n) of each query, by exact distance."""
    blocks = []
    for part, some in zip(vector.split(_ROWS), rows.split(_ROWS), strict=True):  # type: ignore[no-untyped-call]
        apart = (part[:, None] - places[some.clamp(min=0)]).norm(dim=2) if len(places) else some.float()
        blocks.append(torch.where(some >= 0, apart, torch.inf))
    distance, order = torch.cat(blocks).sort(dim=1, stable=True)
    missing = max(k - rows.shape[1], 0)
    row = torch.nn.functional.pad(rows.gather(1, order), (0, missing), value=-1)[:, :k]
    return Matches(row, torch.nn.functional.pad(distance, (0, missing), value=torch.inf)[:, :k])


@dataclass
class MilvusIndex(Index):
    """A map whose descriptors lie in a Milvus collection; here are only poses, times and modalities.

    `vector` is (N, 0). The saved file names the database and the collection.
    """

    uri: str = ""
    collection: str = ""

    def save(self, path: str | Path) -> None:
        """Write poses, times and the address as plain arrays, atomically."""
        arrays = {name: getattr(self, name).cpu().numpy() for name in ("vector", "pose", "time")}
        arrays |= {"modality": np.array(self.modality, dtype=np.str_), "format": np.array(1)}
        arrays |= {name: np.array(getattr(self, name), dtype=np.str_) for name in ("uri", "collection")}
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> MilvusIndex:
        """Read what `save` wrote. DataError where the file names no collection."""
        rows = Index.load(path)
        with np.load(path, allow_pickle=False) as file:
            if not {"uri", "collection"} <= set(file.files):
                raise DataError(f"{path} names no Milvus collection.\n  fix: build it with retriever=milvus")
            uri, collection = str(file["uri"]), str(file["collection"])
        return cls(rows.vector, rows.pose, rows.time, rows.modality, uri, collection)


class MilvusRetriever(Retriever):
    """Nearest neighbours by a Milvus database: a local file (milvus-lite), or a cluster by its address.

    The descriptors live in the database, with the number of the place as their key; what is asked for and what comes
    back are the same as with the other retrievers. `build` replaces a collection of that name.
    """

    def __init__(
        self, *, uri: str = "places.db", collection: str = "places", token: str = "", kind: str = "AUTOINDEX"
    ) -> None:
        """Options: uri, file or address; collection; token, user:password of a cluster; kind, Milvus's index type."""
        super().__init__()
        self.uri, self.collection, self.token, self.kind = uri, collection, token, kind
        self._client: Any = None

    def _connected(self) -> Any:
        if self._client is None:
            pymilvus = _library("pymilvus", "milvus", "milvus")
            try:
                self._client = pymilvus.MilvusClient(self.uri, token=self.token)
            except pymilvus.MilvusException as error:
                raise DataError(f"no Milvus database answers at {self.uri}: {error}") from error
        return self._client

    def build(self, descriptors: Descriptors, poses: Poses) -> MilvusIndex:
        """The index of a map, in a new collection."""
        rows, client = _checked(descriptors, poses), self._connected()
        if client.has_collection(self.collection):
            client.drop_collection(self.collection)
        client.create_collection(
            self.collection, dimension=rows.vector.shape[1], primary_field_name="id", id_type="int",
            vector_field_name="vector", metric_type="L2", auto_id=False, consistency_level="Strong",
            index_params=self._index_params(client),
        )  # fmt: skip
        empty = MilvusIndex(rows.vector[:0, :0], rows.pose[:0], rows.time[:0], (), self.uri, self.collection)
        return self.add(empty, descriptors, poses)

    def _index_params(self, client: Any) -> Any:
        parameters = client.prepare_index_params()
        parameters.add_index("vector", index_type=self.kind, metric_type="L2")
        return parameters

    def add(self, index: MilvusIndex, descriptors: Descriptors, poses: Poses) -> MilvusIndex:
        """The index with more places."""
        rows, first = _checked(descriptors, poses), len(index)
        vector = _array(rows.vector)
        for start in range(0, len(vector), _ROWS):
            part = vector[start : start + _ROWS]
            data = [{"id": first + start + number, "vector": row.tolist()} for number, row in enumerate(part)]
            self._connected().insert(index.collection, data)
        whole = {n: torch.cat([getattr(index, n), getattr(rows, n)]) for n in ("pose", "time")}
        modality = (*index.modality, *rows.modality)
        return MilvusIndex(rows.vector.new_zeros(first + len(rows), 0), **whole, modality=modality, uri=index.uri,
                           collection=index.collection)  # fmt: skip

    @torch.no_grad()
    def query(self, index: MilvusIndex, descriptors: Descriptors, k: int) -> Matches:
        """The k nearest places of each descriptor; -1 and inf where the map has fewer."""
        if k < 1:
            raise ConfigError(f"a query needs k of at least 1, found {k}")
        vector = _array(descriptors.vector)
        row = torch.full((len(vector), k), -1, dtype=torch.long)
        distance = torch.full((len(vector), k), torch.inf)
        for start in range(0, len(vector) if len(index) else 0, _ROWS):
            asked = vector[start : start + _ROWS].tolist()
            found = self._connected().search(index.collection, asked, limit=min(k, len(index)), anns_field="vector")
            for number, hits in enumerate(found, start):
                row[number, : len(hits)] = torch.tensor([hit["id"] for hit in hits])
                squares = torch.tensor([hit["distance"] for hit in hits])
                distance[number, : len(hits)] = squares.clamp(min=0).sqrt()  # Milvus gives squared L2
        return Matches(row, distance)
