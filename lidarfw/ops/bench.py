"""Measurements of the operations: `lidarfw bench ops`.

Candidates of a case run in turn within every round, so that a change in the load of the machine hits all of
them alike; what counts is the ratio of their medians. Yardsticks are the naive versions of
`lidarfw.ops.naive` and whatever rivals are installed.
"""

from __future__ import annotations

import math
import multiprocessing
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

from lidarfw import ops
from lidarfw.ops import naive, rivals, sparse_conv
from lidarfw.ops.inputs import random_boxes, street_scan
from lidarfw.ops.rulebook import Kernel, strided_rulebook, submanifold_rulebook
from lidarfw.types import Grid, Points, RangeView, SceneCoords, Voxels

GRID = Grid((0.0, -40.0, -3.0), (70.4, 40.0, 1.0), (0.05, 0.05, 0.1))  # KITTI, as SECOND has it
CHANNELS = (16, 32, 64, 64, 128)
VIEW = RangeView(64, 2048, math.radians(3), math.radians(-25))

Run = Callable[[], Any]


@dataclass
class Timing:
    """Milliseconds of the candidates of one case, over the rounds."""

    case: str
    candidates: dict[str, list[float]]

    def median(self, candidate: str) -> float:
        return statistics.median(self.candidates[candidate])

    def ratio(self, rival: str) -> float:
        """How many times as long the rival takes as ours."""
        return self.median(rival) / self.median("ours")


@dataclass
class Report:
    """What a run of the benchmark measured."""

    machine: dict[str, Any]
    timings: list[Timing] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)  # efficiency, memory in MB, slopes

    def to_plain(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)


def interleaved(candidates: dict[str, Run], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of every candidate in every round, after one call of each to warm up.

    At one thread the processor's time of this process counts, which other work on the machine hardly changes.
    """
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    for run in candidates.values():
        run()
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, run in candidates.items():
            begin = clock()
            run()
            times[name].append((clock() - begin) * 1e3)
    return times


def backbone(in_channels: int) -> nn.Module:
    """The layers of the `second` backbone at KITTI size, the field's VoxelBackBone8x."""

    def block(layer: nn.Module, width: int) -> list[nn.Module]:
        return [layer, nn.BatchNorm1d(width, eps=1e-3, momentum=0.01), nn.ReLU(inplace=True)]

    before, layers = in_channels, list[nn.Module]()
    for level, width in enumerate(CHANNELS[:4]):
        layers += block(ops.SparseConv3d(before, width, 3, 2, 1), width) if level else []
        layers += block(ops.SubmanifoldConv3d(width if level else before, width), width)
        layers += block(ops.SubmanifoldConv3d(width, width), width)
        before = width
    layers += block(ops.SparseConv3d(before, CHANNELS[4], (3, 1, 1), (2, 1, 1)), CHANNELS[4])
    return ops.SparseSequential(*layers)


def fresh(voxels: Voxels, features: Tensor | None = None) -> Voxels:
    """The voxels without rulebooks, as a network gets them with every scan."""
    return voxels.replace(features=voxels.features if features is None else features, cache={})


def forward_times(net: nn.Module, voxels: Voxels, rounds: int) -> list[float]:
    """Milliseconds of the forward pass, rulebooks included."""
    with torch.no_grad():
        return interleaved({"ours": lambda: net(fresh(voxels))}, rounds)["ours"]


def _forward(net: nn.Module, make: Callable[[], Any]) -> Run:
    @torch.no_grad()
    def run() -> Any:
        return net(make())

    return run


def _train(net: nn.Module, voxels: Voxels, make: Callable[[Tensor], Any]) -> Run:
    def run() -> None:
        features = voxels.features.clone().requires_grad_()
        net(make(features)).features.square().mean().backward()

    return run


def _with_naive_convolution(run: Run) -> None:
    with mock.patch.object(sparse_conv, "convolve", naive.convolve):
        run()


def _backbone_cases(name: str, scan: Points, against: set[str]) -> Iterator[tuple[str, dict[str, Run]]]:
    torch.manual_seed(0)
    voxels = ops.voxelize_mean(scan, GRID)
    net = backbone(voxels.features.shape[1]).eval()
    make = partial(fresh, voxels)
    ours = _forward(net, make)
    forward: dict[str, Run] = {
        "ours": ours,
        "ours, fused": _forward(ops.fuse(net), make),
        "naive": partial(_with_naive_convolution, ours),
    }
    train: dict[str, Run] = {"ours": _train(net, voxels, make)}
    if "spconv" in against:
        rival, make = (
            rivals.spconv_backbone(CHANNELS, voxels.features.shape[1]).eval(),
            partial(rivals.spconv_tensor, voxels),
        )
        forward["spconv"] = _forward(rival, make)
        train["spconv"] = rivals.spconv_backward_on_cpu()(_train(rival, voxels, make))
    yield f"backbone forward ({name}, {len(voxels)} voxels)", forward
    yield f"backbone forward + backward ({name}, {len(voxels)} voxels)", train


def _layer_cases(voxels: Voxels) -> Iterator[tuple[str, dict[str, Run]]]:
    book = submanifold_rulebook(voxels, Kernel((3, 3, 3), padding=(1, 1, 1)))
    for channels in (16, 32, 64, 128):
        features = torch.randn(len(voxels), channels, generator=torch.Generator().manual_seed(0))
        weight = torch.randn(27, channels, channels, generator=torch.Generator().manual_seed(1))
        runs: dict[str, Run] = {
            "ours": partial(sparse_conv.convolve, features, weight, book),
            "naive": partial(naive.convolve, features, weight, book),
        }
        yield f"submanifold layer, {channels} channels, {len(voxels)} voxels", runs


def _voxel_case(scan: Points, against: set[str]) -> tuple[str, dict[str, Run]]:
    grid = Grid((-70.4, -40.0, -3.0), (70.4, 40.0, 1.0), (0.1, 0.1, 0.1))
    runs: dict[str, Run] = {
        "ours": partial(ops.voxelize_mean, scan, grid),
        "naive": partial(naive.voxelize_mean, scan, grid),
    }
    if "spconv" in against:
        runs["spconv"] = rivals.spconv_voxelizer(grid, torch.cat([scan.xyz, scan.features], 1))
    return f"voxelise + mean, {len(scan)} points", runs


def _range_cases(scan: Points) -> Iterator[tuple[str, dict[str, Run]]]:
    xyz, features = scan.xyz.numpy(), scan.features.numpy()
    project: dict[str, Run] = {
        "ours": partial(ops.range_project, scan, VIEW),
        "naive": partial(naive.range_project, xyz, features, VIEW),
    }
    yield f"range projection, {len(scan)} points", project
    image, distance = ops.range_project(scan, VIEW), scan.xyz.norm(dim=1)
    labels = torch.randint(20, image.mask.shape, generator=torch.Generator().manual_seed(0))
    vote: dict[str, Run] = {
        "ours": partial(ops.range_knn, image, labels, distance),
        "naive": partial(naive.range_knn, image, labels, distance),
    }
    yield f"range kNN, {len(scan)} points", vote


def _neighbor_cases(scan: Points, against: set[str]) -> Iterator[tuple[str, dict[str, Run]]]:
    few = scan.xyz[:: max(len(scan) // 8192, 1)][:8192]
    zeros = torch.zeros(len(few), dtype=torch.long)
    sample: dict[str, Run] = {
        "ours": partial(ops.farthest_points, few, zeros, 1, 512),
        "naive": partial(naive.farthest_points, few, 512),
    }
    yield "farthest points, 512 of 8192", sample
    nearest: dict[str, Run] = {
        "ours": partial(ops.knn, few, zeros, few, zeros, 16),
        "naive": partial(naive.nearest, few, few, 16),
    }
    if "faiss" in against:
        nearest["faiss"] = partial(rivals.faiss_nearest, few, few, 16)
    yield "16 nearest of 8192 points", nearest


def _pose_case() -> tuple[str, dict[str, Run]]:
    random = torch.Generator().manual_seed(0)
    source = torch.randn(4096, 3, generator=random) * 20
    world = source + torch.randn(4096, 3, generator=random) * 0.05
    world[::2] += torch.randn(2048, 3, generator=random) * 10
    pairs = SceneCoords(source, world, torch.ones(4096), torch.zeros(4096, dtype=torch.long))
    triples = torch.randint(4096, (1000, 3), generator=random)
    return "RANSAC, 1000 hypotheses, 4096 pairs", {
        "ours": partial(ops.ransac_pose, pairs, hypotheses=1000),
        "naive": partial(naive.best_pose, source, world, triples, 0.6),
    }


def _box_cases(against: set[str]) -> Iterator[tuple[str, dict[str, Run]]]:
    for kind in ("cluster", "spread", "dense"):
        a, b = random_boxes(500, kind), random_boxes(500, kind, 1 if kind != "cluster" else 0)
        runs: dict[str, Run] = {
            "ours": partial(ops.iou_bev, a, b),
            "ours, float64": partial(ops.iou_bev, a.double(), b.double()),
        }
        if "numba" in against:
            runs["numba"] = partial(rivals.numba_iou, a, b)
        if "shapely" in against:
            runs["shapely"] = partial(rivals.shapely_iou, a, b)
        yield f"rotated IoU 500 x 500, {kind}", runs
    for kind in ("cluster", "spread", "dense"):
        boxes, scores = random_boxes(1000, kind), torch.rand(1000, generator=torch.Generator().manual_seed(0))
        runs = {
            "ours": partial(ops.nms_rotated, boxes, scores, 0.1),
            "naive": partial(naive.nms, boxes, scores, 0.1),
        }
        if "numba" in against:
            runs["numba"] = partial(rivals.numba_nms, boxes, scores, 0.1)
        yield f"rotated NMS of 1000, {kind}", runs


def cases(against: set[str], scans: Mapping[str, Points]) -> Iterator[tuple[str, dict[str, Run]]]:
    """Every case with its candidates, on the simulated street and on `scans`, by their names."""
    inputs = {"street": street_scan(), "street, 2 sweeps": street_scan(2, math.radians(90)), **scans}
    for name, scan in inputs.items():
        yield from _backbone_cases(name, scan, against)
    yield from _layer_cases(ops.voxelize_mean(inputs["street"], GRID))
    turn = street_scan(1, math.pi)
    for scan in (turn, *scans.values()):
        yield _voxel_case(scan, against)
        yield from _range_cases(scan)
    yield from _neighbor_cases(turn, against)
    yield from _box_cases(against)
    yield _pose_case()


def flops(voxels: Voxels) -> float:
    """Floating point operations of the backbone's forward pass: two for each pair and weight."""
    total, before = 0.0, voxels.features.shape[1]
    for level, width in enumerate(CHANNELS[:4]):
        if level:
            kernel = Kernel((3, 3, 3), (2, 2, 2), (1, 1, 1))
            total += 2.0 * len(strided_rulebook(voxels, kernel).book) * before * width
            voxels = sparse_conv.strided_voxels(voxels, kernel, voxels.features[:0])
            before = width
        pairs = len(submanifold_rulebook(voxels, Kernel((3, 3, 3), padding=(1, 1, 1)))) + len(voxels)
        total += 2.0 * pairs * width * (before + width)
        before = width
    fold = strided_rulebook(voxels, Kernel((3, 1, 1), (2, 1, 1))).book
    return total + 2.0 * len(fold) * before * CHANNELS[4]


def multiply_rate(rounds: int = 30) -> float:
    """Floating point operations per second of `torch.mm` at (4000, 64) x (64, 64), the best of the rounds."""
    a, b, out = torch.randn(4000, 64), torch.randn(64, 64), torch.empty(4000, 64)
    best = min(interleaved({"mm": lambda: torch.mm(a, b, out=out)}, rounds)["mm"])
    return 2.0 * 4000 * 64 * 64 / (best / 1e3)


def growth(rounds: int) -> dict[str, float]:
    """Milliseconds of the backbone's forward pass by number of voxels, and the slope of a log-log fit."""
    sizes, times = [], []
    for sweeps, degrees in ((1, 25), (1, 90), (2, 90), (4, 90), (8, 90)):
        voxels = ops.voxelize_mean(street_scan(sweeps, math.radians(degrees)), GRID)
        net = backbone(voxels.features.shape[1]).eval()
        measured = forward_times(net, voxels, rounds)
        sizes.append(len(voxels))
        times.append(statistics.median(measured))
    x, y = torch.tensor(sizes).log(), torch.tensor(times).log()
    slope = ((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum()
    named = {f"forward ms at {size} voxels": time for size, time in zip(sizes, times, strict=True)}
    return named | {"growth of time with voxels (log-log slope)": float(slope)}


def _peak(engine: str, sweeps: int, threads: int, answer: Any) -> None:
    """Send MB of resident memory that one forward pass takes above what stood before; runs in its own process."""
    torch.set_num_threads(threads)
    voxels = ops.voxelize_mean(street_scan(sweeps, math.radians(41 if sweeps == 1 else 90)), GRID)
    channels = voxels.features.shape[1]
    net = (backbone(channels) if engine == "ours" else rivals.spconv_backbone(CHANNELS, channels)).eval()
    torch.mm(torch.randn(500, 64), torch.randn(64, 64))  # the libraries' own working memory is no part of it
    Path("/proc/self/clear_refs").write_text("5")
    before = _status("VmRSS")
    with torch.no_grad():
        net(fresh(voxels) if engine == "ours" else rivals.spconv_tensor(voxels))
    answer.send((_status("VmHWM") - before) / 1024)


def _status(name: str) -> int:
    """Kilobytes under a name of /proc/self/status."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name))


def peak_memory(engine: str, sweeps: int, threads: int = 1) -> float | None:
    """MB that the backbone's forward pass of `engine` (ours or spconv) takes; None where there is no Linux /proc."""
    if not Path("/proc/self/clear_refs").exists():
        return None
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(False)
    process = context.Process(target=_peak, args=(engine, sweeps, threads, send))
    process.start()
    send.close()
    value = float(receive.recv())
    process.join()
    return value


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [line.split(":")[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        name = f"{len(models)} x {models[0]}" if models else name
    return {
        "processor": name,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def measure(
    against: set[str],
    rounds: int = 7,
    scans: Mapping[str, Points] = MappingProxyType({}),
    only: str = "",
    started: Callable[[str], None] = lambda case: None,
) -> Report:
    """Run the cases whose name contains `only`.

    Args:
        against: rivals to measure too, of spconv, numba, shapely, faiss; they must be installed.
        scans: scans to measure beside the simulated street, by name.
        started: called with the name of each case as it begins.
    """
    report = Report(machine())
    for name, candidates in cases(against, scans):
        if only in name:
            started(name)
            report.timings.append(Timing(name, interleaved(candidates, rounds)))
    if only in "memory and growth":
        started("memory and growth")
        report.figures |= _figures(against, rounds)
    return report


def _figures(against: set[str], rounds: int) -> dict[str, float]:
    rate, figures = multiply_rate(), dict[str, float]()
    figures["torch.mm GFLOP/s"] = rate / 1e9
    for sweeps, name in ((1, "street"), (2, "street, 2 sweeps")):
        voxels = ops.voxelize_mean(street_scan(sweeps, math.radians(41 if sweeps == 1 else 90)), GRID)
        net = backbone(voxels.features.shape[1]).eval()
        times = forward_times(net, voxels, rounds)
        figures[f"share of the torch.mm rate, rulebooks included ({name})"] = (
            flops(fresh(voxels)) / (statistics.median(times) / 1e3) / rate
        )
        for engine in ("ours", *({"spconv"} & against)):
            peak = peak_memory(engine, sweeps)
            figures |= {} if peak is None else {f"peak MB of the forward pass, {engine} ({name})": peak}
    return figures | growth(rounds)


def draw(report: Report, path: Path) -> None:
    """A picture of the ratios: how many times as long each rival takes as ours."""
    import matplotlib.figure

    timings = [t for t in report.timings if len(t.candidates) > 1]
    others = sorted({name for t in timings for name in t.candidates} - {"ours"})
    bars = [(t.case, name, t.ratio(name)) for t in timings for name in others if name in t.candidates]
    gaps = [timings.index(t) for t in timings for name in others if name in t.candidates]
    y = [-(row + 0.6 * gap) for row, gap in enumerate(gaps)]
    figure = matplotlib.figure.Figure(figsize=(11, 1.6 - 0.17 * (y[-1] if y else 0)), layout="constrained")
    axes = figure.subplots()
    for number, name in enumerate(others):
        own = [(place, ratio) for place, (_, rival, ratio) in zip(y, bars, strict=True) if rival == name]
        drawn = axes.barh([p for p, _ in own], [r - 1 for _, r in own], 0.85, left=1, label=name, color=f"C{number}")
        axes.bar_label(drawn, [f"{r:.1f}" for _, r in own], padding=2, fontsize=7)
    centres = [statistics.mean(p for p, (case, *_) in zip(y, bars, strict=True) if case == t.case) for t in timings]
    axes.set_yticks(centres, [t.case for t in timings], fontsize=8)
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_ylim((y[-1] if y else 0) - 1, 1)
    axes.set_xlabel("time of the other / time of lidarfw.ops (right of 1: lidarfw is faster)")
    axes.set_title(f"{report.machine['processor']}, {report.machine['threads']} thread(s)", fontsize=9)
    axes.legend(loc="lower right", fontsize=8)
    figure.savefig(path, dpi=110)
