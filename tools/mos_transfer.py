#!/usr/bin/env python3
"""How a network for moving objects that learned from the town does on real scans, as it is and after fine-tuning.

python tools/mos_transfer.py SEMANTIC_KITTI CKPT --out DIR [--past 4] [OVERRIDE ...]

SEMANTIC_KITTI: a folder in its official layout. Each of its sequences in turn is held out: the checkpoint is
fine-tuned on all others (`lidarfw train experiment=mos_finetune`, changed by the overrides) and tested on it. Nothing
is chosen by the sequence held out: the number of passes and the rate are those of the experiment.

The table has IoU, precision and recall of moving points of every sequence by itself and, as the benchmark counts, of
the points of all of them together: of the checkpoint as it is, of the fine-tuned ones, each with and without the
filter, and of calling everything moving that can move, by the true classes. Scans with fewer than `--past` scans of
the sequence before them do not count (the filter sees them), nor do points without a label; so it is in
tools/mos_baseline.py. DIR gets the runs, table.md, table.json and a picture of the last scan of each sequence: right
green, wrong orange, missed blue, above by the checkpoint as it is and below by the fine-tuned one.

Runs that are there already are taken as they are.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from lidarfw_dpdc_mos.study import Figures, Seen, filtered, make_filter, movable_points, predictions

import lidarfw
from lidarfw import draw
from lidarfw.errors import LidarfwError
from lidarfw.files import write_text
from lidarfw.types import PointLabels, RangeImage

Flags = list[torch.Tensor]  # (N,) bool of every frame: found to move
Table = dict[str, dict[str, Figures]]  # by setting, then by sequence

OUTCOMES = ("missed", "wrong", "right")  # drawn blue, orange, green


def sequences_in(root: str) -> list[str]:
    """Names of the sequences of a folder."""
    folders = [Path(root) / "sequences", Path(root) / "dataset" / "sequences"]
    names = [entry.name for folder in folders if folder.is_dir() for entry in sorted(folder.iterdir())]
    if len(names) < 2:
        raise LidarfwError(f"{root} has {len(names)} sequences; to hold one out, two are needed")
    return names


def finetune(root: str, checkpoint: Path, held_out: str, names: Sequence[str], run: Path, extra: Sequence[str]) -> Path:
    """The checkpoint of a fine-tuning on all sequences but one."""
    result = run / "checkpoints" / "last.ckpt"
    if not result.exists():
        train = "+".join(name for name in names if name != held_out)
        command = [
            sys.executable, "-m", "lidarfw", "train", "experiment=mos_finetune", f"dataset.semantic_kitti.root={root}",
            f"splits.train={train}", f"splits.val={held_out}", f"splits.test={held_out}",
            f"init={{from: {checkpoint}}}", "trainer=cpu", "logger=csv", f"hydra.run.dir={run}", *extra,
        ]  # fmt: skip
        subprocess.run(command, check=True)
    return result


def see(root: str, checkpoint: Path, sequence: str, past: int) -> list[Seen]:
    """What a checkpoint says of a sequence."""
    data = {"root": root, "task": "moving", "pose": "true", "sweeps": lidarfw.load(checkpoint).plan.data.sweeps}
    options = [f"dataset.semantic_kitti.{name}={value}" for name, value in data.items()]
    return list(predictions(checkpoint, ["dataset=semantic_kitti", *options, f"splits.test={sequence}"], past))


def judge(frames: Sequence[Seen]) -> dict[str, Flags]:
    """Points found by the network alone, and with the paper's filter."""
    part = make_filter(frames[0], {})
    alone = [seen.labels.probability[:, 1] for seen in frames]
    return {name: [p > 0.5 for p in found] for name, found in (("", alone), (" + filter", filtered(frames, part)))}


def count(frames: Sequence[Seen], flags: Flags) -> Figures:
    """Figures of the frames that count."""
    total = Figures()
    for seen, moving in zip(frames, flags, strict=True):
        if seen.counts:
            total.add(seen, moving)
    return total


def picture(seen: Seen, moving: torch.Tensor) -> draw.Picture:
    """The range image of a frame with what is right, wrong and missed in it."""
    image = next(value for value in seen.result.inputs.values() if isinstance(value, RangeImage))
    true, known = seen.truth == 1, seen.truth >= 0
    outcomes = torch.stack([true & ~moving, moving & ~true & known, true & moving], 1).float()
    return draw.range_labels(image, seen.points, PointLabels(outcomes, seen.points.batch), OUTCOMES, scale=4)


def markdown(table: Table) -> str:
    """IoU of every sequence, then IoU, precision and recall of all their points."""
    names = list(next(iter(table.values())))
    lines = ["| | " + " | ".join([*names, "all", "precision", "recall"]) + " |", "|---" * (len(names) + 4) + "|"]
    for setting, row in table.items():
        whole = pooled(row.values()).to_plain()
        cells = [row[name].to_plain()["iou"] for name in names] + [whole[k] for k in ("iou", "precision", "recall")]
        lines.append(f"| {setting} | " + " | ".join(f"{100 * value:.1f}" for value in cells) + " |")
    return "\n".join(lines)


def pooled(parts: Iterable[Figures]) -> Figures:
    """Figures of the points of all parts together."""
    total = Figures()
    for part in parts:
        total.right, total.wrong, total.missed = (
            getattr(total, name) + getattr(part, name) for name in ("right", "wrong", "missed")
        )
    return total


def hold_out(args: argparse.Namespace, held_out: str, names: Sequence[str], table: Table) -> None:
    """Fine-tune without one sequence, and add its figures and its picture."""
    tuned = finetune(args.root, args.checkpoint, held_out, names, args.out / held_out, args.overrides)
    pictures = []
    for name, checkpoint in (("town", args.checkpoint), ("fine-tuned", tuned)):
        frames = see(args.root, checkpoint, held_out, args.past)
        for suffix, flags in judge(frames).items():
            table.setdefault(name + suffix, {})[held_out] = count(frames, flags)
            pictures += [] if suffix else [picture(frames[-1], flags[-1])]
    movable = movable_points(frames, args.root, held_out)
    table.setdefault("all that can move (true classes)", {})[held_out] = count(frames, movable)
    draw.write_png(args.out / f"{held_out}.png", draw.side_by_side(pictures, 1, pictures[0].shape[1]))


def main(arguments: list[str] | None = None) -> int:
    """Run the command; its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", metavar="SEMANTIC_KITTI")
    parser.add_argument("checkpoint", metavar="CKPT", type=Path)
    parser.add_argument("overrides", metavar="OVERRIDE", nargs="*", help="of the fine-tuning, as for lidarfw train")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True)
    parser.add_argument("--past", type=int, default=4, help="scans before a scan that counts (default: 4)")
    args = parser.parse_args(arguments)
    table: Table = {}
    try:
        names = sequences_in(args.root)
        for name in names:
            hold_out(args, name, names, table)
    except (LidarfwError, subprocess.CalledProcessError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    text = markdown(table)
    print(text)
    write_text(args.out / "table.md", text + "\n")
    plain = {setting: {name: one.to_plain() for name, one in row.items()} for setting, row in table.items()}
    write_text(args.out / "table.json", json.dumps(plain, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
