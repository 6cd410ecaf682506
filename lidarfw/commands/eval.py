"""`lidarfw eval`: the figures of a checkpoint on the test split of its dataset, or of another one."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

from lidarfw.errors import ConfigError
from lidarfw.files import require_checkpoint, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw eval`."""
    parser.add_argument("checkpoint", metavar="CKPT", help="of `lidarfw train`")
    parser.add_argument(
        "overrides",
        metavar="OVERRIDE",
        nargs="*",
        help="changes dataset, splits, loader, trainer, metric: dataset.kitti.root=/data splits.test=val",
    )
    parser.add_argument("--json", metavar="FILE", help="write the figures too")
    parser.add_argument(
        "--frames", metavar="FILE", help="write figures of every frame, every sequence and of bootstrap samples (JSON)"
    )
    parser.add_argument("--resamples", type=int, default=500, metavar="N", help="bootstrap samples (default: 500)")
    parser.add_argument(
        "--block", type=int, default=10, metavar="N", help="consecutive frames that are drawn together (default: 10)"
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate and print a table."""
    for option in ("resamples", "block"):
        if getattr(args, option) < 1:
            raise ConfigError(f"--{option} must be at least 1, got {getattr(args, option)}")
    require_checkpoint(args.checkpoint)
    from lidarfw.resampling import FrameRecord
    from lidarfw.training import evaluate

    record = FrameRecord() if args.frames else None
    figures = evaluate(Path(args.checkpoint), args.overrides, record)
    detail = record.to_plain(args.resamples, args.block) if record else {}
    alone = detail.get("blocks", 0) == 1
    print(table(figures, {} if alone else detail.get("resampled", {})))
    if alone:
        print(f"no intervals: all frames are one block of {args.block}.\n  fix: a smaller --block")
    if args.json:
        plain = {name: value if math.isfinite(value) else None for name, value in figures.items()}
        write_text(args.json, json.dumps(plain, indent=1) + "\n")
    if args.frames:
        write_text(args.frames, json.dumps(detail) + "\n")
    return 0


def table(figures: dict[str, float], resampled: dict[str, list[float | None]] | None = None) -> str:
    """The figures by metric, one per line; of losses too, where the evaluation gives them.

    `resampled` are values of the same figures on bootstrap samples: their middle 90 % stands behind each.
    """
    if not figures:
        return "no figures: the model has no metric for what this dataset labels"
    lines, width = [], max(len(name.partition("/")[2] or name) for name in figures)
    group = ""
    for name, value in figures.items():
        metric, _, key = name.partition("/")
        if key and metric != group:
            lines.append(metric)
            group = metric
        text = "-" if math.isnan(value) else f"{value:.4f}"
        lines.append(f"  {key or name:<{width}}  {text:>10}{_interval((resampled or {}).get(name, []))}")
    return "\n".join(lines)


def _interval(values: list[float | None]) -> str:
    from lidarfw.resampling import interval

    low, high = interval([math.nan if value is None else value for value in values])
    return "" if math.isnan(low) else f"  [{low:.4f}, {high:.4f}]"
