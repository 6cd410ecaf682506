"""`lidarfw check`: the conformance kit without pytest."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from lidarfw import registry
from lidarfw.errors import ConfigError

if TYPE_CHECKING:
    from lidarfw.testing.checks import Case, CheckResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw check`."""
    parser.add_argument(
        "target", nargs="?", help="distribution, or package.module:Class; default: the project in this folder"
    )
    parser.add_argument("-k", "--only", metavar="WORD", default="", help="only checks with this in component or name")
    parser.add_argument("-v", "--verbose", action="store_true", help="one line per check, the passed ones too")


def run(args: argparse.Namespace) -> int:
    """Run the checks, print a table, and give 1 where one failed."""
    from lidarfw.testing.checks import cases

    sys.path.insert(0, str(Path.cwd()))  # so that package.module:Class need not be installed
    chosen = [case for case in cases(args.target or _project_here()) if args.only in case.id]
    if not chosen:
        raise ConfigError(f"no check matches {args.only!r}.\n  fix: lidarfw check {args.target or ''} -v lists them")
    results = _run(chosen)
    _print(results, args.verbose)
    return 1 if any(result.status == "failed" for result in results) else 0


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
