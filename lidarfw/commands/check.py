"""`lidarfw check`: the conformance kit without pytest; `lidarfw check data`: every frame of a dataset."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from lidarfw import registry
from lidarfw.errors import ConfigError

if TYPE_CHECKING:
    from lidarfw.datacheck import Findings
    from lidarfw.interfaces import Dataset
    from lidarfw.testing.checks import Case, CheckResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw check`."""
    parser.add_argument(
        "target",
        nargs="?",
        help="distribution, or package.module:Class; default: the project in this folder. `data` reads a dataset",
    )
    parser.add_argument(
        "data", nargs="*", metavar="DATASET KEY=VALUE", help="after `data`: kitti root=/data/kitti split=val ..."
    )
    parser.add_argument("-k", "--only", metavar="WORD", default="", help="only checks with this in component or name")
    parser.add_argument("-v", "--verbose", action="store_true", help="one line per check, the passed ones too")


def run(args: argparse.Namespace) -> int:
    """Run the checks, print a table, and give 1 where one failed."""
    if args.target == "data":
        return _check_data(args.data, args.verbose)
    if args.data:
        raise ConfigError(
            f"one target at a time, found also {' '.join(args.data)}.\n  fix: lidarfw check {args.target}"
        )
    from lidarfw.testing.checks import cases

    sys.path.insert(0, str(Path.cwd()))  # so that package.module:Class need not be installed
    chosen = [case for case in cases(args.target or _project_here()) if args.only in case.id]
    if not chosen:
        raise ConfigError(f"no check matches {args.only!r}.\n  fix: lidarfw check {args.target or ''} -v lists them")
    results = _run(chosen)
    _print(results, args.verbose)
    return 1 if any(result.status == "failed" for result in results) else 0


def _check_data(words: list[str], verbose: bool) -> int:
    """Read a split of a dataset, print each fault and a table, and give 1 where there is a fault."""
    from lidarfw.datacheck import check_dataset

    if not words or "=" in words[0]:
        raise ConfigError("which dataset?\n  fix: lidarfw check data kitti root=/path/to/kitti split=train")
    dataset = _dataset(words[0], words[1:])
    found = check_dataset(dataset, _track)
    for frame, reason in found.faults:
        print(f"{frame}: {reason}")
    _print_data(f"{words[0]}, split {dataset.split}", found, verbose)
    return 1 if found.faults else 0


def _dataset(name: str, overrides: list[str]) -> Dataset:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    from lidarfw import declaration
    from lidarfw.assembly import make_dataset

    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
        options = {override.key_or_group: override.value() for override in parsed}
    except HydraException as error:
        raise ConfigError(f"cannot read the options {' '.join(overrides)}: {error}") from error
    split = options.pop("split", declaration.read("dataset", name).options["split"].default)
    return make_dataset({"dataset": {name: {"type": name, **options}}}, str(split))


def _track(frames: range) -> Iterator[int]:
    from rich.console import Console
    from rich.progress import track

    yield from track(frames, "frames", console=Console(stderr=True), transient=True)


def _print_data(title: str, found: Findings, verbose: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    console, table = Console(soft_wrap=False), Table("of", "value", title=title, title_justify="left")
    for what, value in found.summary(verbose).items():
        table.add_row(what, value)
    console.print(table)


def _project_here() -> str:
    file = Path("pyproject.toml")
    if not (file.is_file() and registry.declared_by(Path())):
        raise ConfigError(
            "nothing to check: this folder holds no pyproject.toml with lidarfw entry points.\n"
            "  fix: lidarfw check DISTRIBUTION, or lidarfw check package.module:Class"
        )
    return registry.project_name(Path())


def _run(chosen: list[Case]) -> list[CheckResult]:
    from rich.console import Console
    from rich.progress import Progress, TextColumn

    columns = (*Progress.get_default_columns(), TextColumn("{task.fields[case]}"))
    results = []
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("checks", total=len(chosen), case="")
        for case in chosen:
            progress.update(task, case=case.id)
            results.append(case.result())
            progress.advance(task)
    return results


def _print(results: list[CheckResult], verbose: bool) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console, table = Console(soft_wrap=False), Table("component", "check", "result", show_lines=False)
    colours = {"passed": "green", "skipped": "yellow", "failed": "red"}
    for component in dict.fromkeys(result.component for result in results):
        own = [result for result in results if result.component == component]
        shown = own if verbose else [result for result in own if result.status != "passed"]
        if not verbose:
            table.add_row(component, Text(f"{_count(own, 'passed')} of {len(own)}"), Text("passed", style="green"))
        for result in shown:
            text = result.status if result.status == "passed" else f"{result.status}: {result.message}"
            table.add_row(component if verbose else "", result.check, Text(text, style=colours[result.status]))
    console.print(table)
    counts = ", ".join(f"{_count(results, status)} {status}" for status in ("passed", "failed", "skipped"))
    console.print(f"{len(results)} checks: {counts}")


def _count(results: Iterable[CheckResult], status: str) -> int:
    return sum(result.status == status for result in results)
