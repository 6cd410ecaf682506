"""`lidarfw claims`: run what a file of claims needs, and write the table of verdicts."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarfw.claims.reading import Claim, ClaimsFile
    from lidarfw.claims.running import Active, Runner, Work

_TERMINATED = 143


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw claims`."""
    parser.add_argument("claims", metavar="PLUGIN|FILE", help="plugins/PLUGIN/claims.yaml, or any such file")
    parser.add_argument(
        "overrides", metavar="OVERRIDE", nargs="*", help="of all trainings: trainer=gpu, a dataset's root"
    )
    parser.add_argument("--minutes", type=float, metavar="N", help="start no run that would not end within N minutes")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="runs at once (default: 2)")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads of each run (default: 1)")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="CLAIM", help="these claims; the others stay as recorded"
    )
    parser.add_argument("--long", action="store_true", help="also run the claims that are marked long")
    parser.add_argument("--launcher", metavar="NAME", help="Hydra launcher for the trainings, for example slurm")
    parser.add_argument("-o", "--output", default="docs/results", metavar="DIR", help="default: docs/results")
    parser.add_argument("--runs", default="runs/claims", metavar="DIR", help="of all runs (default: runs/claims)")


def run(args: argparse.Namespace) -> int:
    """Run, judge, write; 1 where a run failed or runs cannot be compared."""
    from lidarfw.claims import reporting
    from lidarfw.claims.reading import find, read
    from lidarfw.claims.running import Runner, Work

    _check_numbers(args)
    stated = read(find(args.claims), args.overrides)
    chosen = _chosen(stated, args.only)
    records = Path(args.output) / f"{stated.name}.json"
    recorded = reporting.recorded_in(records)
    wanted = [claim for claim in chosen if args.long or not claim.long]
    work = Work(stated, chosen, Path(args.runs).resolve())
    todo = Work(stated, wanted, work.root)
    runner = Runner(todo, jobs=args.jobs, threads=args.threads, minutes=args.minutes, launcher=args.launcher)
    with _terminable():
        _run_with_bars(runner, todo)
    entries = reporting.outcomes(stated, work, chosen, recorded)
    page = reporting.write(Path(args.output), stated, entries, _command(args))
    for entry in entries:
        without = "not judged" if "fault" in entry else "not run"
        print(f"{entry['outcome']['verdict'] if entry['outcome'] else without:<13} {entry['definition']['text']}")
    print(f"\n{page}")
    faults = [entry["fault"] for entry in entries if "fault" in entry]
    print("".join(f"{fault}\n" for fault in faults), file=sys.stderr, end="")
    return max(_say_what_is_left(runner, todo), int(bool(faults)))


def _check_numbers(args: argparse.Namespace) -> None:
    from lidarfw.errors import ConfigError

    for option in ("jobs", "threads"):
        if getattr(args, option) < 1:
            raise ConfigError(f"--{option} must be at least 1, got {getattr(args, option)}")


def _chosen(stated: ClaimsFile, names: Sequence[str]) -> list[Claim]:
    from lidarfw.errors import ConfigError
    from lidarfw.registry import did_you_mean

    known = [claim.name for claim in stated.claims]
    for name in names:
        if name not in known:
            near = did_you_mean(name, known)
            raise ConfigError(f"{stated.path} states no claim {name!r}.\n  claims: {', '.join(known)}{near}")
    return [claim for claim in stated.claims if not names or claim.name in names]


def _command(args: argparse.Namespace) -> str:
    chosen = ["--only", *args.only] if args.only else []
    return " ".join(["lidarfw claims", str(args.claims), *args.overrides, *chosen, *(["--long"] if args.long else [])])


def _say_what_is_left(runner: Runner, work: Work) -> int:
    for folder, reason in runner.failed.items():
        print(f"failed: {work.jobs[folder].name}: {reason}", file=sys.stderr)
    if runner.busy:
        print(f"{len(runner.busy)} runs are made by another process", file=sys.stderr)
    left = len(work.left) - len(runner.failed) - len(runner.busy)
    if left > 0:
        print(f"{left} of {len(work.jobs)} runs are left: the same command goes on with them", file=sys.stderr)
    return 1 if runner.failed else 0


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM as an exception, so that the runs are told to save and end."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise SystemExit(_TERMINATED)

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _run_with_bars(runner: Runner, work: Work) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    if not work.left:
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns) as progress:
        runner.run(_Bars(progress, runner, len(work.left)))


class _Bars:
    """A bar of all jobs, and one for each at hand, against the time that it is expected to take."""

    def __init__(self, progress: Any, runner: Runner, total: int) -> None:
        self.progress, self.runner = progress, runner
        self.all = progress.add_task("runs", total=total)
        self.tasks: dict[Path, Any] = {}

    def update(self, active: Sequence[Active], done: int) -> None:
        """Show the jobs at hand."""
        self.progress.update(self.all, completed=done)
        here = {one.job.folder for one in active}
        for folder in set(self.tasks) - here:
            self.progress.remove_task(self.tasks.pop(folder))
        for one in active:
            if one.job.folder not in self.tasks:
                seconds = round(one.job.seconds + self.runner.expected(one.job))
                self.tasks[one.job.folder] = self.progress.add_task(one.job.name, total=seconds)
            spent = round(one.job.seconds + time.monotonic() - one.began)
            what = f"{one.job.name}: {'training' if one.what == 'train' else 'evaluation'}"
            self.progress.update(self.tasks[one.job.folder], completed=spent, description=what)
