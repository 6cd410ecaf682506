"""`make demo`: train a detector on the simulated town, evaluate it, predict, and write runs/demo/report.html.

Takes about four minutes on two free cores, the town's scans included, and needs neither data nor a GPU.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path

RUN = Path("runs/demo")
CHECKPOINT = RUN / "checkpoints" / "best.ckpt"
SCANS = 8  # that are predicted


def stage(*arguments: str) -> float:
    """Run one lidarfw command and say so; its seconds."""
    from lidarfw.cli import main

    shown = [word for word in arguments if not word.endswith(".bin")]
    print(f"\n=== lidarfw {' '.join(shown)}", flush=True)
    begin = time.perf_counter()
    code = main(arguments)
    if code:
        sys.exit(f"the demo stopped: lidarfw {arguments[0]} ended with {code}")
    return time.perf_counter() - begin


def scans() -> list[str]:
    """Scans of streets that the model has not seen, with their calibrations and pictures beside them."""
    from lidarfw.assembly import make_dataset
    from lidarfw.checkpoint import load

    dataset = make_dataset(load(CHECKPOINT).plan.config, "val")
    return [dataset.meta(index * len(dataset) // SCANS).path for index in range(SCANS)]


def draw_town() -> Path:
    """A map of the first town that was trained on, and what its sensors see."""
    from lidarfw_town.generate import Job
    from lidarfw_town.picture import write_picture
    from lidarfw_town.sensors import LIDARS

    write_picture(RUN / "town.png", Job("kitti", "").town(0)[0], LIDARS["hdl64"])
    return RUN / "town.png"


def main() -> None:
    """Run all stages."""
    import torch

    torch.set_num_threads(1)  # so small a network is hardly faster on two, and far slower where they are not free
    shutil.rmtree(RUN, ignore_errors=True)
    checkpoint, figures = str(CHECKPOINT), RUN / "figures.json"
    seconds = {"make the town": stage("prepare", "experiment=demo")}
    seconds["train"] = stage("train", "experiment=demo", f"hydra.run.dir={RUN}")
    seconds["evaluate"] = stage("eval", checkpoint, "--json", str(figures))
    seconds["predict"] = stage("predict", checkpoint, *scans(), "-o", str(RUN / "predictions"))
    from lidarfw.report import write_report

    begin = time.perf_counter()
    pictures = {"The town: map, scan and pictures of a moment": draw_town()}
    path = write_report(RUN, json.loads(figures.read_text()), seconds=seconds, pictures=pictures)
    total = sum(seconds.values()) + time.perf_counter() - begin
    print(f"\n=== done in {total:.0f} s: open {path.resolve()}")


if __name__ == "__main__":
    main()
