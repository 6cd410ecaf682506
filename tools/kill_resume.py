"""Kill a training run again and again with SIGKILL, resume it each time, and compare with an uninterrupted run.

    python tools/kill_resume.py --kills 10 -- trainer=cpu dataset.synthetic.frames=24 trainer.max_epochs=4

Prints the verdict; exit code 0 only when the final weights, optimizer state and figures are equal bit for bit.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch


def start(folder: Path, overrides: list[str]) -> subprocess.Popen[bytes]:
    """`lidarfw train` in a process group of its own, so that its workers can be killed with it."""
    command = [sys.executable, "-m", "lidarfw", "train", *overrides, f"hydra.run.dir={folder}", "resume=auto"]
    log = (folder.parent / f"{folder.name}.log").open("ab")
    return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def finish(folder: Path, overrides: list[str]) -> float:
    """Run to the end; the seconds it took."""
    began = time.monotonic()
    if start(folder, overrides).wait() != 0:
        sys.exit(f"the run in {folder} failed: see {folder.parent / folder.name}.log")
    return time.monotonic() - began


def written(folder: Path) -> int:
    """When last.ckpt was written, in nanoseconds; 0 where it is not there."""
    path = folder / "checkpoints" / "last.ckpt"
    return path.stat().st_mtime_ns if path.exists() else 0


def kill_once(folder: Path, overrides: list[str], spread: float) -> bool:
    """Start or resume, and kill at a random moment within `spread` seconds after a checkpoint; False if it ended."""
    before, process = written(folder), start(folder, overrides)
    while process.poll() is None and written(folder) == before:
        time.sleep(0.01)
    time.sleep(random.uniform(0, spread))
    if process.poll() is not None:
        return False
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return True


def different(one: Any, other: Any, path: str = "") -> list[str]:
    """Places where two checkpoints differ."""
    if isinstance(one, torch.Tensor):
        return [] if isinstance(other, torch.Tensor) and torch.equal(one, other) else [path]
    if isinstance(one, dict) and isinstance(other, dict):
        keys = {*one, *other}
        return [
            place for key in sorted(keys, key=str) for place in different(one.get(key), other.get(key), f"{path}/{key}")
        ]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [
            place for i, (a, b) in enumerate(zip(one, other, strict=True)) for place in different(a, b, f"{path}/{i}")
        ]
    return [] if one == other else [path]


def compare(one: Path, other: Path) -> list[str]:
    """Differences in weights, optimizer, scheduler, step and figures of two finished runs."""
    contents = [torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True) for folder in (one, other)]
    keys = ("state_dict", "current_model_state", "optimizer_states", "lr_schedulers", "global_step", "epoch")
    picked = [{**{key: c.get(key) for key in keys}, "figures": c["lidarfw"]["figures"]} for c in contents]
    return different(*picked)


def main() -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--folder", type=Path, default=Path("runs/kill_resume"))
    parser.add_argument("--every", type=int, default=2, help="steps between checkpoints")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    parser.add_argument("overrides", nargs="*", help="of lidarfw train, after --")
    args = parser.parse_args()
    random.seed(args.seed)
    shutil.rmtree(args.folder, ignore_errors=True)
    args.folder.mkdir(parents=True)
    overrides = [*args.overrides, f"callbacks.checkpoints.every_n_steps={args.every}"]
    whole, killed = args.folder / "whole", args.folder / "killed"
    seconds = finish(whole, overrides)
    print(f"uninterrupted run: {seconds:.1f} s")
    kills = 0
    while kills < args.kills:
        if not kill_once(killed, overrides, spread=seconds / args.kills / 2):
            break
        kills += 1
        step = torch.load(killed / "checkpoints" / "last.ckpt", weights_only=True)["global_step"]
        print(f"kill {kills}: last.ckpt is of step {step}", flush=True)
    finish(killed, overrides)
    places = compare(whole, killed)
    print(f"{kills} kills, {len(places)} differences" + "".join(f"\n  {place}" for place in places[:10]))
    print("equal bit for bit" if not places else "NOT EQUAL")
    return 0 if not places and kills == args.kills else 1


if __name__ == "__main__":
    sys.exit(main())
