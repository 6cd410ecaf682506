#!/usr/bin/env python3
"""Write docs/compatibility.md: which backbone, necks (none, one or two) and head can be put together.

    python tools/compat_table.py            write it
    python tools/compat_table.py --check    exit 1 where the file is not what would be written

The answers come from `lidarfw.assembly.plan` alone; tests/test_matrix.py builds and trains what is said to fit.
"""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarfw import assembly, registry
from lidarfw.errors import AssemblyError
from lidarfw.types import DataSpec

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "compatibility.md"
INPUTS = {"image": True}  # options of the synthetic dataset: points and a picture
INTRODUCTION = """# What fits together

Written by `python tools/compat_table.py`; do not edit. Every backbone with every chain of up to two necks and every
head of this repository, on data with points and a picture: {plans} combinations, of which {valid} can be wired and use
every part. Those not listed are refused with the reason and a fix, or have a neck that nothing reads.
"""


@dataclass(frozen=True)
class Combination:
    """One backbone, a chain of necks, one head ("" for none)."""

    backbone: str
    necks: tuple[str, ...]
    head: str

    @property
    def id(self) -> str:
        return "+".join((self.backbone, *self.necks, self.head))

    def config(self, sizes: dict[str, dict[str, Any]] | None = None) -> dict[str, Any]:
        """The model part of a config; `sizes` holds options by "slot.name"."""
        chosen = {"backbone": (self.backbone,), "neck": self.necks, "head": (self.head,) if self.head else ()}
        nodes = {
            slot: {name: {"type": name, **(sizes or {}).get(f"{slot}.{name}", {})} for name in names}
            for slot, names in chosen.items()
        }
        return {"dataset": {"synthetic": {"type": "synthetic", **INPUTS}}, **nodes}


def repository_names(slot: str) -> list[str]:
    """Components of the distributions in this repository; other installed plugins are left out."""
    projects = [ROOT, *(file.parent for file in (ROOT / "plugins").glob("*/pyproject.toml"))]
    here = {registry.project_name(project) for project in projects}
    return sorted({entry.name for entry in registry.entries(slot) if entry.distribution in here})


def data_spec() -> DataSpec:
    """Points and a picture, with every kind of target."""
    return assembly.make_dataset({"dataset": {"synthetic": {"type": "synthetic", **INPUTS}}}, "train").spec


def plan(combination: Combination, data: DataSpec) -> assembly.Plan | None:
    """How it is wired, or None where it is refused."""
    try:
        return assembly.plan(combination.config(), data)
    except AssemblyError:
        return None


def fits(combination: Combination, data: DataSpec) -> bool:
    """Whether it can be wired, with a reader for what each part gives."""
    planned = plan(combination, data)
    steps = [] if planned is None else planned.steps
    read = {ref.producer for step in steps for refs in step.takes.values() for ref in refs}
    return bool(steps) and all(step.id in read for step in steps if step.slot in ("backbone", "neck"))


def chains(backbone: str, data: DataSpec) -> Iterator[tuple[str, ...]]:
    """Chains of up to two necks that can be wired behind a backbone; a refused neck is not extended."""
    necks = repository_names("neck")
    yield ()
    for first in necks:
        if plan(Combination(backbone, (first,), ""), data):
            yield (first,)
            yield from ((first, n) for n in necks if n != first and plan(Combination(backbone, (first, n), ""), data))


@functools.cache
def valid_combinations() -> list[Combination]:
    """Those that fit."""
    data, heads = data_spec(), repository_names("head")
    found = (
        Combination(backbone, chain, head)
        for backbone in repository_names("backbone")
        for chain in chains(backbone, data)
        for head in heads
    )
    return [combination for combination in found if fits(combination, data)]


def count() -> int:
    """How many combinations there are, valid or not."""
    backbones, necks, heads = (len(repository_names(slot)) for slot in ("backbone", "neck", "head"))
    return backbones * (1 + necks + necks * (necks - 1)) * heads


def page() -> str:
    """The text of docs/compatibility.md."""
    valid, heads = valid_combinations(), repository_names("head")
    parts = [INTRODUCTION.format(plans=count(), valid=len(valid))]
    for backbone in repository_names("backbone"):
        rows = [f"## backbone `{backbone}`\n", f"| necks | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
        shown = dict.fromkeys(c.necks for c in valid if c.backbone == backbone)
        for chain in shown:
            marks = ["yes" if Combination(backbone, chain, head) in valid else "" for head in heads]
            rows.append(f"| {' → '.join(f'`{neck}`' for neck in chain) or 'none'} | {' | '.join(marks)} |")
        parts.append("\n".join(rows if shown else [rows[0], "No head fits."]) + "\n")
    return "\n".join(parts)


def main() -> int:
    parser = argparse.ArgumentParser(description="Write docs/compatibility.md.")
    parser.add_argument("--check", action="store_true", help="only compare")
    args = parser.parse_args()
    text = page()
    if args.check:
        current = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
        if current != text:
            print(f"{PAGE} is out of date: python tools/compat_table.py", file=sys.stderr)
        return int(current != text)
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
