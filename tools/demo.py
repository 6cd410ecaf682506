"""`make demo`: train, evaluate and predict on simulated streets, then write runs/demo/report.html.

Takes two to three minutes on one free core, and needs neither data nor a GPU.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path

RUN = Path("runs/demo")
CHECKPOINT = RUN / "checkpoints" / "best.ckpt"
SCANS = RUN / "scans"


def write_scans(count: int = 8) -> None:
    """Scans of a street that the model has not seen, as KITTI-style .bin files."""
    import torch

    from lidarfw.testing.synthetic import SyntheticDataset

    SCANS.mkdir(parents=True)
    dataset = SyntheticDataset(split="test", frames=count, sequence_length=count)
    for index in range(count):
        points = dataset[index].inputs["points"]
        table = torch.cat([points.xyz, points.features], 1).numpy().astype("<f4")
        (SCANS / f"{index:06d}.bin").write_bytes(table.tobytes())


def stage(*arguments: str) -> float:
    """Run one lidarfw command and say so; its seconds."""
    from lidarfw.cli import main

    print(f"\n=== lidarfw {' '.join(arguments)}", flush=True)
    begin = time.perf_counter()
    code = main(arguments)
    if code:
        sys.exit(f"the demo stopped: lidarfw {arguments[0]} ended with {code}")
    return time.perf_counter() - begin


def main() -> None:
    """Run all stages."""
    import torch

    torch.set_num_threads(1)  # so small a network is hardly faster on two, and far slower where they are not free
    shutil.rmtree(RUN, ignore_errors=True)
    checkpoint, figures = str(CHECKPOINT), RUN / "figures.json"
    seconds = {"train": stage("train", "experiment=demo", f"hydra.run.dir={RUN}")}
    seconds["evaluate"] = stage("eval", checkpoint, "splits.test=test", "--json", str(figures))
    write_scans()
    seconds["predict"] = stage("predict", checkpoint, str(SCANS), "-o", str(RUN / "predictions"))
    from lidarfw.report import write_report

    begin = time.perf_counter()
    path = write_report(RUN, json.loads(figures.read_text()), split="test", seconds=seconds)
    total = sum(seconds.values()) + time.perf_counter() - begin
    print(f"\n=== done in {total:.0f} s: open {path.resolve()}")


if __name__ == "__main__":
    main()
