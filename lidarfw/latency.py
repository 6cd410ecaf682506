"""How long a model takes: `lidarfw bench` on a checkpoint or config."""

from __future__ import annotations

import contextlib
import math
import resource
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from lidarfw.assembly import make_transforms
from lidarfw.errors import ConfigError
from lidarfw.model import PerceptionModel
from lidarfw.ops.inputs import street_scan
from lidarfw.predict import FrameReader, find_sources, needed_inputs
from lidarfw.types import Batch, Frame, FrameMeta, Points, Targets, collate

_SLOTS = ("backbone", "neck", "head", "postprocessor")


@dataclass
class Latency:
    """Time and memory of a model at inference."""

    components: dict[str, float]  # median milliseconds per batch, by "backbone.second"; "rest": decoding and wiring
    total: float  # median milliseconds per batch
    frames: int  # in the batch
    points: int  # in the batch
    parameters: int
    memory: float  # MB: on a GPU the peak of the pass, on a CPU the peak of the process so far
    device: str
    threads: int

    @property
    def frames_per_second(self) -> float:
        """From the median."""
        return self.frames / self.total * 1e3

    def to_plain(self) -> dict[str, Any]:
        """For a JSON file."""
        return {**asdict(self), "frames_per_second": self.frames_per_second}


def simulated_frame(model: PerceptionModel) -> Frame:
    """A scan of `lidarfw.ops.inputs.street_scan` in place of the model's data.

    Raises ConfigError where the model reads more than points.
    """
    spec = model.plan.data
    scan = street_scan(half_view=math.pi)
    time_ = torch.zeros(len(scan)) if spec.sweeps > 1 else None
    inputs = {
        name: scan.replace(features=scan.features.repeat(1, max(s.channels, 1))[:, : s.channels], time=time_)
        for name, s in spec.inputs.items()
        if s.kind is Points
    }
    frame = Frame(inputs, Targets(), FrameMeta("street"))
    for transform in make_transforms(model.plan.config, training=False):
        frame = transform(frame, np.random.default_rng(0))
    missing = [
        f"{name} ({spec.inputs[name].kind.__name__})" for name in needed_inputs(model) if name not in frame.inputs
    ]
    if missing:
        raise ConfigError(
            f"bench simulates points only, and the model also reads {', '.join(missing)}\n"
            "  fix: --scan FILE --image FILE, real ones"
        )
    return frame


def read_frame(model: PerceptionModel, scan: Path, calibration: Path | None, image: Path | None) -> Frame:
    """The frame of a scan file, as `lidarfw predict` reads it."""
    reader = FrameReader(model)
    return reader.read(find_sources([scan], reader.lidar, calibration, image)[0])


@contextlib.contextmanager
def clocks(model: PerceptionModel, times: dict[str, list[float]]) -> Iterator[None]:
    """Within the block every component's forward adds its milliseconds to `times`."""
    started: dict[str, float] = {}

    def before(name: str) -> Any:
        def hook(module: nn.Module, args: Any) -> None:
            started[name] = now()

        return hook

    def after(name: str) -> Any:
        def hook(module: nn.Module, args: Any, output: Any) -> None:
            times[name].append((now() - started[name]) * 1e3)

        return hook

    handles = []
    for step in model.plan.steps:
        if step.slot in _SLOTS:
            module = model.component(step)
            handles += [module.register_forward_pre_hook(before(step.id)), module.register_forward_hook(after(step.id))]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def now() -> float:
    """Seconds: of the processor at one thread, which other programs do not disturb, else of the clock on the wall."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
        return time.perf_counter()
    return time.process_time() if torch.get_num_threads() == 1 else time.perf_counter()


def clock_name() -> str:
    """What `now` counts."""
    return "processor time" if torch.get_num_threads() == 1 and not torch.cuda.is_available() else "wall time"


def measure(model: PerceptionModel, frame: Frame, batch_size: int = 1, rounds: int = 10) -> Latency:
    """Median times of prediction on a batch of equal frames, after two rounds to warm up."""
    device = next((p.device for p in model.parameters()), torch.device("cpu"))
    batch: Batch = collate([frame] * batch_size).to(device)
    model = model.eval()
    times: dict[str, list[float]] = defaultdict(list)
    totals = []
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    with torch.no_grad():
        for _ in range(2):
            model.predict(batch)
        with clocks(model, times):
            for _ in range(rounds):
                begin = now()
                model.predict(batch)
                totals.append((now() - begin) * 1e3)
    total = statistics.median(totals)
    components = {name: statistics.median(values) for name, values in times.items()}
    components["rest"] = max(total - sum(components.values()), 0.0)
    points = sum(len(value) for value in batch.inputs.values() if isinstance(value, Points))
    parameters = sum(p.numel() for p in model.parameters())
    return Latency(
        components, total, batch_size, points, parameters, memory(device), str(device), torch.get_num_threads()
    )


def memory(device: torch.device) -> float:
    """MB at the peak."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated() / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
