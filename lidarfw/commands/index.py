"""`lidarfw index`: maps of place descriptors: build one from scans or pictures, search it, judge it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarfw.errors import ConfigError, DataError
from lidarfw.files import require_checkpoint

if TYPE_CHECKING:
    from lidarfw.interfaces import Retriever
    from lidarfw.retrieval import Index
    from lidarfw.types import Descriptors, Frame, Poses


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw index`."""
    ways = parser.add_subparsers(dest="way", metavar="build|query|eval", required=True)
    build = ways.add_parser("build", help="describe scans or pictures and write, or lengthen, a map")
    _add_input(build)
    build.add_argument("-o", "--output", metavar="FILE", type=Path, required=True, help="the map, an .npz file")
    build.add_argument("--poses", metavar="FILE", type=Path, help="12 numbers a line and scan, sensor to map")
    build.add_argument("--add", action="store_true", help="to a map that stands already")
    query = ways.add_parser("query", help="the nearest places of scans or pictures")
    query.add_argument("map", metavar="MAP", type=Path, help="of `lidarfw index build`")
    _add_input(query)
    query.add_argument("-k", metavar="K", type=int, default=5, help="places for each (%(default)s)")
    query.add_argument("--json", metavar="FILE", type=Path, help="write them as JSON too")
    judge = ways.add_parser("eval", help="recall of the queries of one map in another, and against exact search")
    judge.add_argument("map", metavar="MAP", type=Path)
    judge.add_argument("queries", metavar="QUERIES", type=Path, help="also of `lidarfw index build`, with poses")
    judge.add_argument("--radius", metavar="M", type=float, nargs="+", default=[5.0], help="metres (5)")
    judge.add_argument("--counts", metavar="N", type=int, nargs="+", default=[1, 5, 10], help="of matches (1 5 10)")
    judge.add_argument("--json", metavar="FILE", type=Path, help="write the figures as JSON too")
    for way in (build, query, judge):
        way.add_argument("--retriever", metavar="NAME", default="exact", help="exact, or one of a plugin (%(default)s)")
        way.add_argument("--option", metavar="KEY=VALUE", action="append", default=[], help="of the retriever")


def _add_input(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("checkpoint", metavar="CKPT", help="of a model that describes places")
    parser.add_argument("scans", metavar="SCAN", nargs="*", help="scans or pictures, or folders of them")
    parser.add_argument("--split", metavar="NAME", help="instead of scans: a split of the model's dataset, with poses")


def run(args: argparse.Namespace) -> int:
    """Build, query or judge."""
    return {"build": _build, "query": _query, "eval": _eval}[args.way](args)


def _build(args: argparse.Namespace) -> int:
    import torch

    from lidarfw.types import Poses

    if args.output.suffix != ".npz":
        raise ConfigError(f"a map is an .npz file, got {args.output}\n  fix: -o {args.output.with_suffix('.npz')}")
    retriever = make_retriever(args.retriever, args.option)
    before = _load(retriever, args.output) if args.add else None
    if args.add and not hasattr(retriever, "add"):
        raise ConfigError(f"retriever {args.retriever!r} cannot add to a map that stands; build it anew without --add")
    descriptors, poses, times, names = _described(args)
    index = retriever.build(descriptors, poses) if before is None else retriever.add(before, descriptors, poses)  # type: ignore[operator]
    index = index.replace(time=torch.cat([index.time[: len(index) - len(times)], times.to(index.time)]))
    index.save(args.output)
    known = isinstance(poses, Poses) and bool(poses.ok.any())
    print(f"{args.output}: {len(index)} places of {descriptors.vector.shape[1]} numbers, {len(names)} of them new")
    if not known:
        print("note: without poses (--poses FILE) the map can be searched, but not judged", file=sys.stderr)
    return 0


def _query(args: argparse.Namespace) -> int:
    retriever = make_retriever(args.retriever, args.option)
    index = _load(retriever, args.map)
    descriptors, _, _, names = _described(args)
    matches = retriever.query(index, descriptors, args.k)
    rows = []
    for name, places, apart in zip(names, matches.index.tolist(), matches.distance.tolist(), strict=True):
        found = [(place, value) for place, value in zip(places, apart, strict=True) if place >= 0]
        rows.append({"query": name, "matches": [_match(index, place, value) for place, value in found]})
        print(f"{name}: " + ", ".join(f"place {place} ({value:.3f})" for place, value in found))
    _write(args.json, rows)
    return 0


def _match(index: Index, place: int, distance: float) -> dict[str, Any]:
    time = float(index.time[place])
    return {
        "place": place,
        "distance": distance,
        "pose": index.pose[place].tolist() if index.known[place] else None,
        "time": None if time != time else time,
        "modality": index.modality[place] if index.modality else None,
    }


def _eval(args: argparse.Namespace) -> int:
    import torch

    from lidarfw.components.retrievers.exact import ExactRetriever
    from lidarfw.retrieval import Index, recall_at
    from lidarfw.types import Descriptors, Poses

    retriever = make_retriever(args.retriever, args.option)
    index, queries = _load(retriever, args.map), Index.load(args.queries)
    if not bool(queries.known.any()) or not bool(index.known.any()):
        raise DataError(
            f"{args.map} or {args.queries} has no poses.\n  fix: build it with --poses FILE or --split NAME"
        )
    described = Descriptors(queries.vector, queries.modality)
    matches = retriever.query(index, described, max(args.counts))
    poses = Poses(queries.pose, queries.known, torch.ones(len(queries)))
    figures = {
        f"{name}_{radius:g}m": value
        for radius in args.radius
        for name, value in recall_at(matches, poses, index, radius=radius, counts=args.counts).items()
    }
    if not isinstance(retriever, ExactRetriever) and index.vector.shape[1]:
        exact = ExactRetriever().query(index, described, 1).index
        figures["agreement@1"] = float((matches.index[:, :1] == exact).float().mean())
    for name, value in figures.items():
        print(f"{name:<20} {value:.4f}")
    _write(args.json, figures)
    return 0


def _write(path: Path | None, content: Any) -> None:
    from lidarfw.files import write_text

    if path is not None:
        write_text(path, json.dumps(content, indent=1) + "\n")


def make_retriever(name: str, options: Sequence[str]) -> Retriever:
    """A retriever by name, with options as KEY=VALUE. RegistryError, ConfigError where that is none."""
    import yaml

    from lidarfw import declaration, registry

    declared = declaration.read("retriever", name).options
    given = {}
    for text in options:
        key, sign, value = text.partition("=")
        if not sign or key not in declared:
            known = ", ".join(declared) or "none"
            raise ConfigError(f"--option {text}: expected KEY=VALUE; options of retriever {name!r}: {known}")
        given[key] = yaml.safe_load(value)
    made: Retriever = registry.load("retriever", name)(**given)
    return made


def _load(retriever: Retriever, path: Path) -> Index:
    """A map as the retriever keeps it: the class that its `build` is annotated to return."""
    import typing

    from lidarfw.retrieval import Index

    kind = typing.get_type_hints(type(retriever).build).get("return", Index)
    loaded: Index = (kind if isinstance(kind, type) and issubclass(kind, Index) else Index).load(path)
    return loaded


def _described(args: argparse.Namespace) -> tuple[Descriptors, Poses, Any, list[str]]:
    """Descriptors, poses, times (N,) and names of what was asked for. Poses are not ok where they are not known."""
    require_checkpoint(args.checkpoint)
    import torch

    import lidarfw
    from lidarfw import predict
    from lidarfw.types import Descriptors, Poses

    model = lidarfw.load(Path(args.checkpoint)).to("cuda" if torch.cuda.is_available() else "cpu")
    reader = predict.FrameReader(model)
    frames, count = _frames(args, model, reader)
    given = predict.read_poses(args.poses, count) if getattr(args, "poses", None) else None
    vectors, modality, matrices, ok, times, names = [], [], [], [], [], []
    for number, result in enumerate(predict.predict_frames(model, frames)):
        try:
            found = result.of(Descriptors)
        except LookupError as error:
            raise ConfigError(f"{args.checkpoint} does not describe places: {error}") from error
        vectors.append(found.vector)
        modality.append(result.meta.modality or ("lidar" if reader.lidar else "camera"))
        true = result.targets.poses if result.targets else None
        matrix = given[number] if given is not None else true.matrix[0] if true is not None else torch.zeros(4, 4)
        matrices.append(matrix.double())
        ok.append(given is not None or (true is not None and bool(true.ok[0])))
        times.append(result.meta.time)
        names.append(result.meta.id)
    poses = Poses(torch.stack(matrices), torch.tensor(ok), torch.tensor(ok).float())
    return Descriptors(torch.cat(vectors), tuple(modality)), poses, torch.tensor(times, dtype=torch.float64), names


def _frames(args: argparse.Namespace, model: Any, reader: Any) -> tuple[Iterable[Frame], int]:
    from lidarfw import predict

    if bool(args.scans) == bool(args.split):
        raise ConfigError("index takes scans or --split, one of them")
    if args.split:
        split = predict.SplitFrames(model, args.split)
        return (split[number] for number in _bar(range(len(split)))), len(split)
    sources = predict.find_sources(args.scans, reader.lidar)
    return predict.read_frames(reader, _bar(sources)), len(sources)


def _bar(items: Sequence[Any]) -> Iterator[Any]:
    from rich.console import Console
    from rich.progress import track

    yield from track(items, "describe", console=Console(stderr=True), transient=True)
