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
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

from lidarfw import ops
from lidarfw.ops import naive, rivals, sparse_conv
from lidarfw.ops.rulebook import Kernel, strided_rulebook, submanifold_rulebook
from lidarfw.types import Grid, Points, RangeView, SceneCoords, Voxels

GRID = Grid((0.0, -40.0, -3.0), (70.4, 40.0, 1.0), (0.05, 0.05, 0.1))  # KITTI, as SECOND has it
CHANNELS = (16, 32, 64, 64, 128)
VIEW = RangeView(64, 2048, math.radians(3), math.radians(-25))
_SENSOR_HEIGHT = 1.73  # metres

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


def street_scan(sweeps: int = 1, half_view: float = math.radians(41), seed: int = 0) -> Points:
    """Points of a simulated 64-beam scanner in a street with facades, cars, poles and bushes.

    Args:
        sweeps: scans taken a metre apart, all in the frame of the first.
        half_view: radians kept to either side of straight ahead; pi keeps the whole turn.
    """
    random = torch.Generator().manual_seed(seed)
    boxes, depth = _street(random)
    scans = [_scan(boxes, depth, torch.tensor([float(k), 0.0, 0.0]), half_view, random) for k in range(sweeps)]
    xyz = torch.cat(scans)
    remission = torch.rand(len(xyz), 1, generator=random)
    return Points.from_scan(xyz, remission)


def _street(random: torch.Generator) -> tuple[Tensor, Tensor]:
    """Axis-aligned boxes (K, 6) lower and upper corner, and how deep a ray gets into each (K,) metres."""

    def row(count: int, low: list[float], high: list[float], size: list[float], vary: list[float]) -> Tensor:
        center = torch.tensor(low) + torch.rand(count, 3, generator=random) * (torch.tensor(high) - torch.tensor(low))
        half = (torch.tensor(size) + torch.rand(count, 3, generator=random) * torch.tensor(vary)) / 2
        base = torch.cat([center[:, :2] - half[:, :2], torch.full((count, 1), -_SENSOR_HEIGHT)], 1)
        return torch.cat([base, base + 2 * half], 1)

    sides = (-1, 1)
    facades = [row(12, [-70, side * 16.0, 0], [90, side * 24.0, 0], [9, 6, 5], [8, 3, 7]) for side in sides]
    cars = [row(12, [-60, side * 4.5, 0], [80, side * 6.0, 0], [3.8, 1.6, 1.4], [1, 0.3, 0.5]) for side in sides]
    poles = row(20, [-60, -9, 0], [80, 9, 0], [0.15, 0.15, 4], [0.2, 0.2, 3])
    bushes = [row(20, [-60, side * 8.0, 0], [80, side * 13.0, 0], [1.5, 1.5, 0.8], [4, 3, 2]) for side in sides]
    crowns = [row(12, [-60, side * 7.0, 0], [80, side * 12.0, 0], [3, 3, 4], [4, 3, 4]) for side in sides]
    crowns = [c + torch.tensor([0, 0, 2.5, 0, 0, 0]) for c in crowns]
    solid, soft = torch.cat([*facades, *cars, poles]), torch.cat([*bushes, *crowns])
    return torch.cat([solid, soft]), torch.cat([torch.zeros(len(solid)), torch.full((len(soft),), 2.5)])


def _scan(boxes: Tensor, depth: Tensor, origin: Tensor, half_view: float, random: torch.Generator) -> Tensor:
    """(N, 3) returns of one turn, in the frame of the street."""
    elevation = torch.cat([torch.linspace(2, -8.3, 32), torch.linspace(-8.8, -24.8, 32)]).deg2rad()
    azimuth = torch.arange(2083) / 2083 * 2 * math.pi - math.pi
    azimuth = azimuth[azimuth.abs() < half_view]
    flat, angle = elevation.cos()[:, None], azimuth[None]
    rays = [flat * angle.cos(), flat * angle.sin(), elevation.sin()[:, None] * torch.ones_like(angle)]
    direction = torch.stack(rays, -1).view(-1, 3)
    distance = torch.where(direction[:, 2] < 0, -_SENSOR_HEIGHT / direction[:, 2], torch.inf)
    for box, soft in zip(boxes, depth, strict=True):
        first, second = (box[:3] - origin) / direction, (box[3:] - origin) / direction
        near, far = torch.minimum(first, second).amax(1), torch.maximum(first, second).amin(1)
        inside = near + soft * torch.rand(len(near), generator=random)
        hit = (near > 0) & (near < far) & (inside < far)
        distance = torch.where(hit, torch.minimum(distance, inside), distance)
    distance = distance + torch.randn(len(distance), generator=random) * 0.015
    rough = (origin + direction * distance[:, None])[:, 1].abs() > 5.5  # grass beside the road
    distance = distance - rough * torch.rand(len(distance), generator=random) * 0.04 * distance.clamp(max=25)
    seen = (distance < 100) & (torch.rand(len(distance), generator=random) > 0.08)
    return direction[seen] * distance[seen, None] + origin


def random_boxes(count: int, kind: str, seed: int = 0) -> Tensor:
    """(count, 7) boxes: `cluster` round 50 objects, `spread` over 70 x 80 m, or `dense`, all over each other."""
    random = torch.Generator().manual_seed(seed)
    extent = torch.tensor([70, 80, 2, 3, 1, 1, 2 * math.pi]) if kind != "dense" else torch.tensor([1, 1, 1, 3, 1, 1, 6])
    objects = 50 if kind == "cluster" else count
    boxes = torch.rand(objects, 7, generator=random) * extent + torch.tensor([0, -40, -2, 3, 1.5, 1.4, 0])
    if kind != "cluster":
        return boxes
    noise = torch.randn(count, 7, generator=random) * torch.tensor([0.4, 0.4, 0.2, 0.2, 0.1, 0.1, 0.2])
    return boxes[torch.randint(50, (count,), generator=random)] + noise


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


def _backbone_cases(name: str, voxels: Voxels, against: set[str]) -> Iterator[tuple[str, dict[str, Run]]]:
    torch.manual_seed(0)
    net = backbone(voxels.features.shape[1]).eval()
    fused = ops.fuse(net)
    text = f"{name}, {len(voxels)} voxels"

    def forward() -> Any:
        with torch.no_grad():
            return net(fresh(voxels))

    def forward_fused() -> Any:
        with torch.no_grad():
            return fused(fresh(voxels))

    def forward_naive() -> Any:
        with torch.no_grad(), mock.patch.object(sparse_conv, "convolve", naive.convolve):
            return net(fresh(voxels))

    def train() -> None:
        features = voxels.features.clone().requires_grad_()
        net(fresh(voxels, features)).features.square().mean().backward()

    candidates: dict[str, Run] = {"ours": forward, "ours, fused": forward_fused, "naive": forward_naive}
    train_candidates: dict[str, Run] = {"ours": train}
    if "spconv" in against:
        rival = rivals.spconv_backbone(CHANNELS, voxels.features.shape[1]).eval()

        def forward_spconv() -> Any:
            with torch.no_grad():
                return rival(rivals.spconv_tensor(voxels))

        def train_spconv() -> None:
            features = voxels.features.clone().requires_grad_()
            with rivals.spconv_backward_on_cpu():
                rival(rivals.spconv_tensor(voxels, features)).features.square().mean().backward()

        candidates["spconv"], train_candidates["spconv"] = forward_spconv, train_spconv
    yield f"backbone forward ({text})", candidates
    yield f"backbone forward + backward ({text})", train_candidates


def _layer_cases(voxels: Voxels) -> Iterator[tuple[str, dict[str, Run]]]:
    book = submanifold_rulebook(voxels, Kernel((3, 3, 3), padding=(1, 1, 1)))
    book.blocks()
    for channels in (16, 32, 64, 128):
        features = torch.randn(len(voxels), channels, generator=torch.Generator().manual_seed(0))
        weight = torch.randn(27, channels, channels, generator=torch.Generator().manual_seed(1))
        runs: dict[str, Run] = {
            "ours": partial(sparse_conv.convolve, features, weight, book),
            "naive": partial(naive.convolve, features, weight, book),
        }
        yield f"submanifold layer, {channels} channels, {len(voxels)} voxels", runs


def _point_cases(scan: Points, against: set[str]) -> Iterator[tuple[str, dict[str, Run]]]:
    points = torch.cat([scan.xyz, scan.features], 1)
    grid = Grid((-70.4, -40.0, -3.0), (70.4, 40.0, 1.0), (0.1, 0.1, 0.1))
    voxelize: dict[str, Run] = {
        "ours": lambda: ops.voxelize_mean(scan, grid),
        "naive": lambda: naive.voxelize_mean(scan, grid),
    }
    if "spconv" in against:
        voxelize["spconv"] = rivals.spconv_voxelizer(grid, points)
    yield f"voxelise + mean, {len(scan)} points", voxelize
    xyz, features = scan.xyz.numpy(), scan.features.numpy()
    yield (
        f"range projection, {len(scan)} points",
        {
            "ours": lambda: ops.range_project(scan, VIEW),
            "naive": lambda: naive.range_project(xyz, features, VIEW),
        },
    )
    image, distance = ops.range_project(scan, VIEW), scan.xyz.norm(dim=1)
    labels = torch.randint(20, image.mask.shape, generator=torch.Generator().manual_seed(0))
    yield (
        f"range kNN, {len(scan)} points",
        {
            "ours": lambda: ops.range_knn(image, labels, distance),
            "naive": lambda: naive.range_knn(image, labels, distance),
        },
    )
    few = scan.xyz[:: max(len(scan) // 8192, 1)][:8192]
    zeros = torch.zeros(len(few), dtype=torch.long)
    yield (
        "farthest points, 512 of 8192",
        {
            "ours": lambda: ops.farthest_points(few, zeros, 1, 512),
            "naive": lambda: naive.farthest_points(few, 512),
        },
    )
    yield (
        "16 nearest of 8192 points",
        {
            "ours": lambda: ops.knn(few, zeros, few, zeros, 16),
            "naive": lambda: torch.cdist(few, few).topk(16, largest=False),
        },
    )


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
    compiled = rivals.numba_functions() if "numba" in against else None
    for kind in ("cluster", "spread", "dense"):
        a, b = random_boxes(500, kind), random_boxes(500, kind, 1 if kind != "cluster" else 0)
        runs: dict[str, Run] = {
            "ours": partial(ops.iou_bev, a, b),
            "ours, float64": partial(ops.iou_bev, a.double(), b.double()),
        }
        if compiled:
            runs["numba"] = partial(compiled[0], a, b)
        if "shapely" in against:
            runs["shapely"] = partial(rivals.shapely_iou, a, b)
        yield f"rotated IoU 500 x 500, {kind}", runs
    for kind in ("cluster", "spread", "dense"):
        boxes, scores = random_boxes(1000, kind), torch.rand(1000, generator=torch.Generator().manual_seed(0))
        runs = {
            "ours": partial(ops.nms_rotated, boxes, scores, 0.1),
            "naive": partial(naive.nms, boxes, scores, 0.1),
        }
        if compiled:
            runs["numba"] = partial(compiled[1], boxes, scores, 0.1)
        yield f"rotated NMS of 1000, {kind}", runs


def cases(against: set[str], scan: Points | None = None) -> Iterator[tuple[str, dict[str, Run]]]:
    """Every case with its candidates. `scan` is a real one, measured beside the simulated."""
    small = ops.voxelize_mean(street_scan(), GRID)
    large = ops.voxelize_mean(street_scan(2, math.radians(90)), GRID)
    yield from _backbone_cases("street", small, against)
    yield from _backbone_cases("street, 2 sweeps", large, against)
    if scan is not None:
        yield from _backbone_cases("given scan", ops.voxelize_mean(scan, GRID), against)
    yield from _layer_cases(small)
    yield from _point_cases(street_scan(1, math.pi), against)
    if scan is not None:
        yield from _point_cases(scan, against)
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
    scan: Points | None = None,
    only: str = "",
    started: Callable[[str], None] = lambda case: None,
) -> Report:
    """Run the cases whose name contains `only`.

    Args:
        against: rivals to measure too, of spconv, numba, shapely; they must be installed.
        started: called with the name of each case as it begins.
    """
    report = Report(machine())
    for name, candidates in cases(against, scan):
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
    figure = matplotlib.figure.Figure(figsize=(11, 0.42 * len(timings) + 1.6), layout="constrained")
    axes = figure.subplots()
    names = sorted({n for t in timings for n in t.candidates} - {"ours"})
    for number, name in enumerate(names):
        rows = [(len(timings) - i, t.ratio(name)) for i, t in enumerate(timings) if name in t.candidates]
        height = 0.8 / len(names)
        y = [row + (number - (len(names) - 1) / 2) * height for row, _ in rows]
        bars = axes.barh(y, [ratio for _, ratio in rows], height, label=name)
        axes.bar_label(bars, fmt="%.1f", padding=2, fontsize=7)
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_ylim(0.3, len(timings) + 0.7)
    axes.set_yticks([len(timings) - i for i in range(len(timings))], [t.case for t in timings], fontsize=8)
    axes.set_xlabel("time of the other / time of lidarfw.ops (right of 1: lidarfw is faster)")
    axes.set_title(f"{report.machine['processor']}, {report.machine['threads']} thread(s)", fontsize=9)
    axes.legend(loc="lower right", fontsize=8)
    figure.savefig(path, dpi=110)
