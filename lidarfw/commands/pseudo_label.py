"""`lidarfw pseudo-label`: learn from a few labelled scans and many that are not."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lidarfw.errors import ConfigError
from lidarfw.files import require_checkpoint

if TYPE_CHECKING:
    from lidarfw.pseudo_labels import Round


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw pseudo-label`."""
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="of all rounds; goes on where it stopped")
    parser.add_argument(
        "overrides", nargs="+", metavar="OVERRIDE", help="of `lidarfw train`, with dataset=folder; boxes/ of some scans"
    )
    parser.add_argument("--rounds", type=int, default=2, metavar="N", help="with pseudo-labels (%(default)s)")
    parser.add_argument("--start", metavar="CKPT", help="weights that the first round begins with")
    parser.add_argument(
        "--keep", nargs="+", default=[], metavar="CLASS=SCORE",
        help="from which score on a box is learned from (Car 0.7, others 0.5)",
    )  # fmt: skip
    parser.add_argument(
        "--ignore", type=float, default=0.3, metavar="SCORE", help="from which on it is no background (%(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Make the rounds that are missing; a table of all."""
    keep = dict(_score(text) for text in args.keep)
    if args.rounds < 0:
        raise ConfigError(f"--rounds is a number of rounds, got {args.rounds}")
    if args.folder.exists() and not args.folder.is_dir():
        raise ConfigError(
            f"{args.folder} is a file; the rounds need a folder.\n  fix: lidarfw pseudo-label runs/mine ..."
        )
    if args.start:
        require_checkpoint(args.start)
    from lidarfw import checkpoint
    from lidarfw.pseudo_labels import Loop, Settings

    if args.start:
        checkpoint.verify(args.start)  # before the folder is begun with it
    loop = Loop(args.folder, Settings(tuple(args.overrides), args.start, keep, args.ignore))
    found = []
    for one in loop.run(args.rounds):
        found.append(one)
        print(f"round {one.number}: {args.folder / f'round_{one.number}' / 'checkpoints' / 'last.ckpt'}")
    print(table(found))
    return 0


def _score(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise ConfigError(f"--keep takes CLASS=SCORE, got {text!r}.\n  fix: --keep Car=0.7 Pedestrian=0.5") from None


def table(rounds: Sequence[Round]) -> str:
    """Frames, pseudo-labels and figures of every round, one column each."""
    names = list(dict.fromkeys(name for one in rounds for name in one.kept))
    figures = list(dict.fromkeys(name for one in rounds for name in one.figures))
    rows = [["", *(f"round {one.number}" for one in rounds)]]
    rows.append(["labelled frames", *(str(one.frames) for one in rounds)])
    rows.append(["frames with pseudo-labels", *(str(one.pseudo_frames) for one in rounds)])
    rows += [[f"  {name}", *(str(one.kept.get(name, 0)) for one in rounds)] for name in names]
    rows.append(["  ignored", *(str(one.ignored) for one in rounds)])
    rows += [
        [name, *(f"{one.figures[name]:.4f}" if name in one.figures else "-" for one in rounds)] for name in figures
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [[cell.rjust(w) if n else cell.ljust(w) for n, (cell, w) in enumerate(zip(row, widths))] for row in rows]
    return "\n".join("  ".join(line).rstrip() for line in lines)


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
