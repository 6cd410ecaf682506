"""Latency and memory of a tracker on made-up traffic: `python -m lidarfw_time3d.bench [TRACKER] [--objects 128]`.

Objects drive straight on through a square of 200 m and come in again on the other side, seen with noise and gaps.
The times are processor times of one thread, so that other load on the machine does not count.
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections.abc import Iterator

import numpy as np
import torch
from lidarfw.detections import boxes_of, make_tracker
from lidarfw.types import Boxes, FrameMeta, FrameResult

_SIDE = 200.0  # metres


def traffic(objects: int, frames: int, seed: int = 0) -> Iterator[Boxes]:
    """The detections of each frame, 0.1 s apart."""
    rng = np.random.default_rng(seed)
    place, yaw = rng.uniform(0, _SIDE, (objects, 2)), rng.uniform(-np.pi, np.pi, objects)
    step = 0.1 * rng.uniform(0, 15, objects)[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    for _ in range(frames):
        place = (place + step) % _SIDE
        seen = np.flatnonzero(rng.random(objects) < 0.95)
        center = place[seen] - _SIDE / 2 + rng.normal(0, 0.1, (len(seen), 2))
        rest = np.tile([0.0, 4.2, 1.8, 1.5], (len(seen), 1))
        yield boxes_of(
            np.column_stack([center, rest, yaw[seen]]), [0] * len(seen), rng.uniform(0.5, 0.99, len(seen)).tolist()
        )


def measure(name: str, objects: int, frames: int) -> tuple[list[float], list[int]]:
    """Milliseconds of each frame, and the bytes of the saved state after each tenth of the frames."""
    tracker = make_tracker([f"tracker={name}"], ("Car",))
    state, spent, held = tracker.start(), [], []
    for index, boxes in enumerate(traffic(objects, frames)):
        meta = FrameMeta(str(index), "s", index, index / 10)
        more = {"meta": [meta]} if name.startswith("time3d") else {}
        begin = time.thread_time()
        with torch.no_grad():
            tracker.step(state, FrameResult(meta), boxes, **more)
        spent.append(1000 * (time.thread_time() - begin))
        if (index + 1) % max(frames // 10, 1) == 0:
            held.append(len(pickle.dumps(state)))
    return spent[min(20, frames // 2) :], held


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tracker", nargs="?", default="kalman_confidence", help="(%(default)s)")
    parser.add_argument("--objects", type=int, default=128, help="(%(default)s)")
    parser.add_argument("--frames", type=int, default=500, help="(%(default)s)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    spent, held = measure(arguments.tracker, arguments.objects, arguments.frames)
    p50, p99 = np.percentile(spent, [50, 99])
    print(f"{arguments.tracker}: {arguments.objects} objects, p50 {p50:.2f} ms, p99 {p99:.2f} ms a frame")
    print(f"saved state after each tenth of {arguments.frames} frames, kB: {[round(size / 1000, 1) for size in held]}")


if __name__ == "__main__":
    main()
