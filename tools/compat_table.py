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

from lidarfw import assembly, declaration, registry
from lidarfw.errors import AssemblyError
from lidarfw.types import BEV, PREDICTIONS, DataSpec, RangeImage

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "compatibility.md"
INPUTS = {"image": True}  # options of the synthetic dataset: points and a picture
RANGE = {"range_projection": {"type": "range_projection", "height": 16, "width": 64}}
INTRODUCTION = """# What fits together

Written by `python tools/compat_table.py`; do not edit. Every backbone with every chain of up to two necks and every
head of this repository, on data with points and a picture: {plans} combinations, of which {valid} can be wired and use
every part. Those not listed are refused with the reason and a fix, or have a neck that nothing reads.

A head that takes what another head predicts stands behind the first one that gives it: `anchor` → `msrm`. Backbones
for range images get theirs by `transform=range_projection`. Not listed, since their inputs come with a dataset of their
own: {apart}.
"""


@dataclass(frozen=True)
class Combination:
    """One backbone, a chain of necks, and heads of which each takes what the one before predicts."""

    backbone: str
    necks: tuple[str, ...]
    heads: tuple[str, ...]

    @property
    def id(self) -> str:
        return "+".join((self.backbone, *self.necks, *self.heads))

    def config(self, sizes: dict[str, dict[str, Any]] | None = None) -> dict[str, Any]:
        """The model part of a config; `sizes` holds options by "slot.name"."""
        chosen = {"backbone": (self.backbone,), "neck": self.necks, "head": self.heads}
        nodes = {
            slot: {name: {"type": name, **(sizes or {}).get(f"{slot}.{name}", {})} for name in names}
            for slot, names in chosen.items()
        }
        return {**data_config(self.backbone), **nodes}


def repository_names(slot: str) -> list[str]:
    """Components of the distributions in this repository; other installed plugins are left out."""
    projects = [ROOT, *(file.parent for file in (ROOT / "plugins").glob("*/pyproject.toml"))]
    here = {registry.project_name(project) for project in projects}
    return sorted({entry.name for entry in registry.entries(slot) if entry.distribution in here})


def _kinds(slot: str, name: str) -> set[Any]:
    """What a component cannot do without."""
    return {p.kind for p in declaration.read(slot, name).takes if not p.optional}


def data_config(backbone: str) -> dict[str, Any]:
    """Points and a picture, and a range image for a backbone that takes one."""
    transform = RANGE if RangeImage in _kinds("backbone", backbone) else {}
    return {"dataset": {"synthetic": {"type": "synthetic", **INPUTS}}, "transform": transform}


@functools.cache
def data_spec(backbone: str) -> DataSpec:
    """The data that a backbone is tried on, with every kind of target."""
    return assembly.plan(data_config(backbone)).data


def backbones() -> list[str]:
    """Those whose input can be made here."""
    return [name for name in repository_names("backbone") if BEV not in _kinds("backbone", name)]


@functools.cache
def head_chains() -> list[tuple[str, ...]]:
    """Every head, behind the first one that predicts what it takes."""
    names = repository_names("head")
    taken = {name: _kinds("head", name) & set(PREDICTIONS) for name in names}
    given = {name: {kind for kind, _ in declaration.read("head", name).gives} for name in names}
    first = {name: next((n for n in names if taken[name] & given[n] and not taken[n]), "") for name in names}
    return [(first[name], name) if taken[name] else (name,) for name in names]


def plan(combination: Combination) -> assembly.Plan | None:
    """How it is wired, or None where it is refused."""
    try:
        return assembly.plan(combination.config(), data_spec(combination.backbone))
    except AssemblyError:
        return None


def fits(combination: Combination) -> bool:
    """Whether it can be wired, with a reader for what each part gives."""
    planned = plan(combination)
    return planned is not None and not assembly.unread(planned.steps)


def chains(backbone: str) -> Iterator[tuple[str, ...]]:
    """Chains of up to two necks that can be wired behind a backbone; a refused neck is not extended."""
    necks = repository_names("neck")
    yield ()
    for first in necks:
        if plan(Combination(backbone, (first,), ())):
            yield (first,)
            yield from ((first, n) for n in necks if n != first and plan(Combination(backbone, (first, n), ())))


@functools.cache
def valid_combinations() -> list[Combination]:
    """Those that fit."""
    found = (
        Combination(backbone, chain, heads)
        for backbone in backbones()
        for chain in chains(backbone)
        for heads in head_chains()
    )
    return [combination for combination in found if fits(combination)]


def count() -> int:
    """How many combinations there are, valid or not."""
    necks = len(repository_names("neck"))
    return len(backbones()) * (1 + necks + necks * (necks - 1)) * len(head_chains())


def page() -> str:
    """The text of docs/compatibility.md."""
    valid, columns = valid_combinations(), head_chains()
    apart = [f"`{name}`" for name in repository_names("backbone") if name not in backbones()]
    parts = [INTRODUCTION.format(plans=count(), valid=len(valid), apart=", ".join(apart) or "none")]
    titles = " | ".join(" → ".join(heads) for heads in columns)
    for backbone in backbones():
        rows = [f"## backbone `{backbone}`\n", f"| necks | {titles} |", "|---|" + "---|" * len(columns)]
        shown = dict.fromkeys(c.necks for c in valid if c.backbone == backbone)
        for chain in shown:
            marks = ["yes" if Combination(backbone, chain, heads) in valid else "" for heads in columns]
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
