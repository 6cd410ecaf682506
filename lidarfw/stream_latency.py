"""How long frames take that follow each other, from scan to filtered result: `lidarfw bench CKPT --stream N`."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from lidarfw.assembly import named_transforms
from lidarfw.components.datasets.drives import Drive, merge_scans, pose_of
from lidarfw.latency import clocks, memory, now
from lidarfw.model import PerceptionModel
from lidarfw.ops.inputs import street_scan
from lidarfw.streaming import Stream
from lidarfw.types import Frame, FrameMeta, FrameResult, Points, Poses, Targets, collate

_WARM_UP = 3  # frames that do not count
_STEP = 0.8  # metres from frame to frame


@dataclass
class StreamLatency:
    """Time and memory of a stream of frames."""

    parts: dict[str, tuple[float, float]]  # median and 99th percentile, milliseconds
    total: tuple[float, float]
    frames: int
    points: int  # of the last frame, past scans included
    parameters: int
    memory: tuple[float, float]  # MB at the peak, after a tenth of the frames and after all of them
    device: str
    threads: int
    precision: str

    @property
    def frames_per_second(self) -> float:
        """From the median."""
        return 1e3 / self.total[0]

    def to_plain(self) -> dict[str, Any]:
        """For a JSON file."""
        return {**asdict(self), "frames_per_second": self.frames_per_second}


def simulated_drive(model: PerceptionModel, count: int, scan: Points | None = None) -> Iterator[Frame]:
    """Frames of a sensor that drives through an unchanging scan, before the model's transforms.

    The scan is `street_scan` where none is given. Past scans are moved into each frame as the loaders of recorded
    drives move them.
    """
    spec = model.plan.data
    scan = street_scan(half_view=math.pi) if scan is None else scan
    times = np.arange(count, dtype=np.float64) * 0.1
    drive = Drive("street", [Path("street")] * count, times, _straight_ahead(count))
    for place in range(count):
        places = list(range(place, max(-1, place - spec.sweeps), -1))
        inputs: dict[str, Any] = {}
        for name, s in spec.inputs.items():
            if s.kind is Points:
                own = scan.replace(features=scan.features.repeat(1, max(s.channels, 1))[:, : s.channels])
                inputs[name] = own if spec.sweeps == 1 else merge_scans([own] * len(places), drive, places)
            elif s.kind is Poses:
                inputs[name] = pose_of(drive, place)
        yield Frame(inputs, Targets(), FrameMeta(f"{place:06d}", drive.name, place, float(drive.times[place])))


def _straight_ahead(count: int) -> npt.NDArray[np.float64]:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count) * _STEP
    return poses


class _TimedStream(Stream):
    """Adds the milliseconds of every filter, and of the tracker, to `times`."""

    def __init__(self, model: PerceptionModel, times: dict[str, list[float]]) -> None:
        super().__init__(model)
        self.times = times

    def _step_filter(self, name: str, result: FrameResult) -> list[FrameResult]:
        begin = now()
        finished = super()._step_filter(name, result)
        self.times[name].append((now() - begin) * 1e3)
        return finished


def measure_stream(
    model: PerceptionModel, count: int, precision: str = "fp32", scan: Points | None = None
) -> StreamLatency:
    """Times of every part on `count` frames of a simulated drive.

    Parts: moving past scans into the frame (data), each transform, each component, each filter; what is left of the
    total is decoding and wiring. `precision` fp32 or bf16 (autocast).
    """
    device = next((p.device for p in model.parameters()), torch.device("cpu"))
    times: dict[str, list[float]] = defaultdict(list)
    running = _TimedStream(model.eval(), times)
    frames = _timed_frames(model, simulated_drive(model, count + _WARM_UP, scan), times)
    peaks = [0.0, 0.0]
    points = 0
    with torch.no_grad(), clocks(model, times):
        for number in range(count + _WARM_UP):
            if number == _WARM_UP:
                times.clear()
            begin = now()
            frame = next(frames)
            with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
                result = model.predict(collate([frame]).to(device))[0]
            running.advance(result)
            times["total"].append((now() - begin) * 1e3)
            points = sum(len(value) for value in frame.inputs.values() if isinstance(value, Points))
            peaks[number > count // 10 + _WARM_UP] = memory(device)
    total = _percentiles(times.pop("total"))
    parts = {name: _percentiles(values) for name, values in times.items()}
    size = sum(p.numel() for p in model.parameters())
    found = (peaks[0], max(peaks))
    return StreamLatency(parts, total, count, points, size, found, str(device), torch.get_num_threads(), precision)


def _timed_frames(model: PerceptionModel, frames: Iterator[Frame], times: dict[str, list[float]]) -> Iterator[Frame]:
    """The frames after the model's transforms; how long each step takes goes to `times`."""
    transforms = named_transforms(model.plan.config, training=False)
    while True:
        begin = now()
        frame = next(frames)
        times["data"].append((now() - begin) * 1e3)
        for name, transform in transforms.items():
            begin = now()
            frame = transform(frame, np.random.default_rng(0))
            times[f"transform.{name}"].append((now() - begin) * 1e3)
        yield frame


def _percentiles(values: list[float]) -> tuple[float, float]:
    middle, high = np.percentile(values, [50, 99])
    return float(middle), float(high)
