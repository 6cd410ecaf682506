"""`lidarfw bench`: the time that a model's components take, or the operations against others."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarfw.errors import ConfigError
from lidarfw.files import require_checkpoint

if TYPE_CHECKING:
    from lidarfw.latency import Latency
    from lidarfw.model import PerceptionModel
    from lidarfw.ops.bench import Report
    from lidarfw.stream_latency import StreamLatency
    from lidarfw.types import Points

RIVALS = {"spconv": "spconv", "numba": "numba", "shapely": "shapely", "faiss": "faiss-cpu"}  # package: distribution


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw bench`."""
    parser.add_argument(
        "what", nargs="*", metavar="ops|CKPT|OVERRIDE", help="the word ops; or a checkpoint; or overrides as for train"
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the figures too")
    parser.add_argument("--threads", metavar="N", type=int, help="of the processor (all)")
    parser.add_argument("--rounds", metavar="N", type=int, default=7, help="measurements of each (%(default)s)")
    parser.add_argument("--scan", metavar="FILE", type=Path, help="a real scan; else a simulated street")
    model = parser.add_argument_group("of a model")
    model.add_argument("--batch", metavar="N", type=int, default=1, help="frames in a batch (%(default)s)")
    model.add_argument("--stream", metavar="N", type=int, help="N frames one by one, from scan to filtered result")
    model.add_argument("--merge", action="store_true", help="merge the model for inference first (lidarfw.merge)")
    model.add_argument("--precision", choices=("fp32", "bf16"), default="fp32", help="of --stream (%(default)s)")
    model.add_argument("--calib", metavar="FILE", type=Path, help="KITTI calibration of the scan")
    model.add_argument("--image", metavar="FILE", type=Path, help="picture of the scan")
    ops = parser.add_argument_group("of ops")
    ops.add_argument("--against", choices=RIVALS, action="append", default=[], help="measure an installed rival too")
    ops.add_argument("--town", action="store_true", help="measure on a scan of the simulated town too (lidarfw-town)")
    ops.add_argument("--only", metavar="TEXT", default="", help="cases whose name contains it")
    ops.add_argument("--picture", metavar="FILE", type=Path, help="PNG of the ratios")


def run(args: argparse.Namespace) -> int:
    """Measure and print a table."""
    _check(args)
    import torch

    if args.threads:
        torch.set_num_threads(args.threads)
    found = _bench_ops(args) if args.what == ["ops"] else _bench_model(args)
    if args.json:
        from lidarfw.files import write_text

        write_text(args.json, json.dumps(found, indent=1) + "\n")
    return 0


def _check(args: argparse.Namespace) -> None:
    if _is_checkpoint(args.what):
        require_checkpoint(args.what[0])
    for option in ("threads", "rounds", "batch", "stream"):
        if getattr(args, option) is not None and getattr(args, option) < 1:
            raise ConfigError(f"--{option} must be at least 1, got {getattr(args, option)}")
    from importlib.util import find_spec

    missing = [name for name in args.against if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"--against {missing[0]}: {missing[0]} is not installed here\n"
            f"  fix: pip install {RIVALS[missing[0]]}, best in an environment of its own; lidarfw does not need it"
        )


def _bench_ops(args: argparse.Namespace) -> dict[str, Any]:
    from rich.console import Console

    from lidarfw.ops import bench
    from lidarfw.ops.inputs import town_scan

    scans = {args.scan.stem: _scan(args.scan)} if args.scan else {}
    scans |= {"town": town_scan()} if args.town else {}
    with Console(stderr=True).status("measuring") as status:
        report = bench.measure(set(args.against), args.rounds, scans, args.only, lambda case: status.update(case))
    print(ops_table(report))
    if args.picture and report.timings:
        from lidarfw.files import atomic_path

        with atomic_path(args.picture) as temporary:
            bench.draw(report, temporary)
    return report.to_plain()


def _scan(path: Path) -> Points:
    import torch

    from lidarfw.io import read_points
    from lidarfw.types import Points

    scan = read_points(path)
    return Points.from_scan(torch.from_numpy(scan.xyz), torch.from_numpy(scan.features[:, :1].copy()))


def ops_table(report: Report) -> str:
    """Median milliseconds of each candidate, and how many times as long as ours the others take."""
    about = report.machine
    lines = [f"{about['processor']}, {about['threads']} thread(s), torch {about['torch']}; median milliseconds"]
    width = max((len(t.case) for t in report.timings), default=0)
    for timing in report.timings:
        cells = [f"ours {timing.median('ours'):.2f}"]
        cells += [f"{n} {timing.median(n):.2f} ({timing.ratio(n):.2f}x)" for n in timing.candidates if n != "ours"]
        lines.append(f"{timing.case:<{width}}  {'  '.join(cells)}")
    lines += [f"{name}: {value:.3g}" for name, value in report.figures.items()]
    return "\n".join(lines)


def _bench_model(args: argparse.Namespace) -> dict[str, Any]:
    from lidarfw import latency

    model = _model(args.what)
    if args.merge:
        from lidarfw.merging import merge

        model = merge(model)
    if args.stream:
        from lidarfw.stream_latency import measure_stream

        streamed = measure_stream(model, args.stream, args.precision, _scan(args.scan) if args.scan else None)
        print(stream_table(streamed))
        return streamed.to_plain()
    if args.scan:
        frame = latency.read_frame(model, args.scan, args.calib, args.image)
    else:
        frame = latency.simulated_frame(model)
    found = latency.measure(model, frame, args.batch, args.rounds)
    print(model_table(found))
    return found.to_plain()


def _is_checkpoint(what: list[str]) -> bool:
    return len(what) == 1 and what[0].endswith((".ckpt", ".safetensors"))


def _model(what: list[str]) -> PerceptionModel:
    import torch

    import lidarfw
    from lidarfw.assembly import build, plan
    from lidarfw.config import compose

    model = lidarfw.load(Path(what[0])) if _is_checkpoint(what) else build(plan(compose(what)))
    return model.to("cuda" if torch.cuda.is_available() else "cpu")


def stream_table(found: StreamLatency) -> str:
    """Median and 99th percentile of each part, and the sums."""
    from lidarfw.latency import clock_name

    rows = {**found.parts, "total": found.total}
    width = max(map(len, rows))
    lines = [f"{'':<{width}}  {'p50':>8}  {'p99':>8} ms"]
    lines += [f"{name:<{width}}  {middle:8.1f}  {high:8.1f}" for name, (middle, high) in rows.items()]
    lines.append(f"{found.frames_per_second:.1f} frames/s over {found.frames} frames of {found.points} points")
    early, late = found.memory
    lines.append(f"{found.parameters / 1e6:.2f} M parameters, peak {early:.0f} MB early, {late:.0f} MB at the end")
    lines.append(f"on {found.device}, {found.threads} thread(s), {found.precision}; {clock_name()}")
    return "\n".join(lines)


def model_table(found: Latency) -> str:
    """Milliseconds of each component, and the sums."""
    rows = {**found.components, "total": found.total}
    width = max(map(len, rows))
    lines = [f"{name:<{width}}  {value:8.1f} ms  {value / found.total:6.1%}" for name, value in rows.items()]
    lines.append(f"{found.frames_per_second:.1f} frames/s at {found.frames} frame(s) of {found.points} points in all")
    lines.append(f"{found.parameters / 1e6:.2f} M parameters, {found.memory:.0f} MB at the peak")
    lines.append(f"on {found.device}, {found.threads} thread(s)")
    return "\n".join(lines)
