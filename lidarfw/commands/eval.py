"""`lidarfw eval`: the figures of a checkpoint on the test split of its dataset, or of another one."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path


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


def run(args: argparse.Namespace) -> int:
    """Evaluate and print a table."""
    from lidarfw.files import write_text
    from lidarfw.training import evaluate

    figures = evaluate(Path(args.checkpoint), args.overrides)
    print(table(figures))
    if args.json:
        plain = {name: value if math.isfinite(value) else None for name, value in figures.items()}
        write_text(args.json, json.dumps(plain, indent=1) + "\n")
    return 0


def table(figures: dict[str, float]) -> str:
    """The figures by metric, one per line; of losses too, where the evaluation gives them."""
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
        lines.append(f"  {key or name:<{width}}  {text:>10}")
    return "\n".join(lines)
