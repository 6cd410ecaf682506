"""How retrievers grow with the map: python -m lidarfw_crossplace.scale --places 10000 100000.

Descriptors are like those of a drive, not random vectors: what is near along the way is alike, and queries are taken at
places of the map once more, with a little noise. Random vectors are all equally far from each other, which no search
structure can use and no place descriptor is.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from lidarfw.cli import answered
from lidarfw.components.retrievers.exact import ExactRetriever
from lidarfw.files import write_text
from lidarfw.interfaces import Retriever
from lidarfw.retrieval import Index
from lidarfw.types import Descriptors, Matches, Poses
from rich.console import Console
from torch import Tensor
from torch.nn import functional as F

from lidarfw_crossplace.retrievers import FaissIndex, FaissRetriever, MilvusRetriever

KINDS = ("exact", "flat", "hnsw", "ivf_pq", "milvus")
_HIDDEN = 48  # numbers that decide what a place looks like
_MEMORY = 25  # frames after which a place looks another way
_BRANCHES = 3  # of a fused descriptor, each of length 1 / sqrt(3)
_BLOCK = 20_000  # descriptors made at a time


@dataclass
class Row:
    """What was measured of a retriever over a map. Times are of this process, seconds of CPU."""

    kind: str
    places: int
    build: float
    queries_a_second: float  # asked 64 at a time
    single: float  # milliseconds for a query that comes alone
    recall: float  # share of queries whose nearest place is that of exact search
    bytes_a_place: float  # of the search structure, beside the map's own 4 D + 72
    saved: float  # bytes a place of the file on disk, all included


def drive(places: int, width: int, generator: torch.Generator) -> Tensor:
    """Hidden state (places, 48) along a way: a random walk that forgets in `_MEMORY` steps."""
    from scipy.signal import lfilter

    keep = 1 - 1 / _MEMORY
    steps = torch.randn(places, _HIDDEN, generator=generator) * (1 - keep**2) ** 0.5
    walked = lfilter([1.0], [1.0, -keep], steps.numpy(), axis=0)
    return torch.from_numpy(walked).float()


def descriptors(hidden: Tensor, width: int, noise: float, generator: torch.Generator) -> Tensor:
    """(N, width) fused descriptors of hidden states: in each branch a fixed random layer, noise, length 1."""
    fixed = torch.Generator().manual_seed(0)
    weights = torch.randn(_BRANCHES, hidden.shape[1], width // _BRANCHES, generator=fixed) / hidden.shape[1] ** 0.5
    found = torch.empty(len(hidden), width // _BRANCHES * _BRANCHES)
    for start in range(0, len(hidden), _BLOCK):
        part = torch.tanh(torch.einsum("nh,khd->nkd", hidden[start : start + _BLOCK], weights))
        part += noise * torch.randn(part.shape, generator=generator)
        found[start : start + _BLOCK] = F.normalize(part, dim=2).flatten(1) / _BRANCHES**0.5
    return found


def make(kind: str, folder: Path) -> Retriever:
    """The retriever of a name, with its usual options."""
    if kind == "exact":
        return ExactRetriever()
    return MilvusRetriever(uri=str(folder / "places.db")) if kind == "milvus" else FaissRetriever(kind=kind)


def measure(kind: str, places: Tensor, queries: Tensor, truth: Tensor, folder: Path) -> Row:
    """Build a map of descriptors (N, D) and ask it for those of queries (Q, D), whose nearest places are `truth`."""
    retriever, poses = make(kind, folder), _poses(len(places))
    start = time.process_time()
    index = retriever.build(Descriptors(places, ()), poses)
    built = time.process_time() - start
    start = time.process_time()
    found = [retriever.query(index, Descriptors(part, ()), 1) for part in queries.split(64)]  # type: ignore[no-untyped-call]
    together = (time.process_time() - start) / len(queries)
    alone = queries[:16]
    start = time.process_time()
    for row in alone:
        retriever.query(index, Descriptors(row[None], ()), 1)
    single = (time.process_time() - start) / len(alone)
    recall = float((torch.cat([part.index[:, 0] for part in found]) == truth).float().mean())
    saved = _saved(index, folder)
    return Row(kind, len(places), built, 1 / together, 1000 * single, recall, _engine_bytes(index), saved)


def _poses(count: int) -> Poses:
    matrix = torch.eye(4).expand(count, 4, 4)
    return Poses(matrix, torch.ones(count, dtype=torch.bool), torch.ones(count))


def _engine_bytes(index: Index) -> float:
    if not isinstance(index, FaissIndex):
        return 0.0
    import faiss

    count = faiss.VectorIOWriter()
    faiss.write_index(index.engine, count)
    return float(count.data.size()) / len(index)


def _saved(index: Index, folder: Path) -> float:
    path = folder / "map.npz"
    index.save(path)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / len(index)
    path.unlink()
    return size


def exact_rows(places: Tensor, queries: Tensor) -> Tensor:
    """(Q,) the nearest place of each query."""
    found: Matches = ExactRetriever().query(ExactRetriever().build(Descriptors(places, ()), _poses(len(places))),
                                            Descriptors(queries, ()), 1)  # fmt: skip
    return found.index[:, 0]


def sweep(counts: Sequence[int], kinds: Sequence[str], width: int, asked: int, noise: float) -> list[Row]:
    """A row for each retriever and size of the map; of equal size all are asked the same."""
    console, rows = Console(stderr=True), []
    for count in counts:
        generator = torch.Generator().manual_seed(1)
        hidden = drive(count, width, generator)
        places = descriptors(hidden, width, noise, generator)
        chosen = torch.randperm(count, generator=generator)[:asked]
        queries = descriptors(hidden[chosen], width, noise, generator)
        truth = exact_rows(places, queries)
        for kind in kinds:
            with console.status(f"{kind}, {count} places"), TemporaryDirectory() as folder:
                rows.append(measure(kind, places, queries, truth, Path(folder)))
            console.print(rows[-1])
    return rows


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown."""
    head = ("retriever", "places", "build, s", "queries/s", "one query, ms", "recall@1", "bytes a place", "on disk")
    lines = [
        f"| {r.kind} | {r.places:,} | {r.build:.1f} | {r.queries_a_second:,.0f} | {r.single:.2f} | {r.recall:.3f} | "
        f"{r.bytes_a_place:,.0f} | {r.saved:,.0f} |"
        for r in rows
    ]
    return "\n".join([f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(fields(Row)) - 1), *lines]) + "\n"


@answered
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, nargs="+", default=[10_000, 100_000], help="sizes of the map")
    parser.add_argument("--retrievers", nargs="+", choices=KINDS, default=["exact", "hnsw", "ivf_pq"])
    parser.add_argument("--width", type=int, default=1536, help="numbers of a descriptor (%(default)s)")
    parser.add_argument("--queries", type=int, default=512, help="(%(default)s)")
    parser.add_argument("--noise", type=float, default=0.3, help="of the descriptors (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures too")
    args = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO)
    rows = sweep(args.places, args.retrievers, args.width, args.queries, args.noise)
    print(table(rows))
    if args.json:
        write_text(args.json, json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
