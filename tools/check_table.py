#!/usr/bin/env python3
"""Write docs/conformance.md from the docstrings of the checks.

python tools/check_table.py            write it
python tools/check_table.py --check    exit 1 where the file is not what would be written
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from lidarfw.interfaces import SLOTS
from lidarfw.testing.checks import CHECKS
from lidarfw.testing.checks.packaging import PACKAGE_CHECKS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "conformance.md"
INTRODUCTION = """# Conformance

Written by `python tools/check_table.py`; do not edit.

What every component must do, whoever ships it, as named checks. In a plugin's tests, the whole file is

```python
from lidarfw.testing import component_checks

test_conformance = component_checks("acme-lidar")
```

which gives one pytest case for every component of the distribution and every check that applies to it: `pytest -k
head.acme`, `pytest -k batch_mates`. The same without pytest, and for a class that is not packaged yet:

```console
$ lidarfw check acme-lidar
$ lidarfw check my_package.my_module:MyHead -v
$ lidarfw check acme-lidar -k batch_mates
```

Exit code 1 means that a check failed. Inputs are made up from the annotations of `forward` and of the same few
synthetic frames: random features on four variations of width, stride and grid, noisy copies of the objects as
detections, and frames that are empty or hold one point. A component with options that have no default, or whose
defaults are too large for a test, says in a class attribute what to try it with: `example = {"channels": 16}`.

Fixtures for tests of your own come with the installed package: `synthetic_frame`, `synthetic_sequence`, `spec_of`
(`spec_of(BEV)` is a small Spec for an `__init__`) and `isolated_registry`, which hides other installed plugins and
takes classes that are not packaged: `isolated_registry(head={"toy": ToyHead})`.
"""
GROUPS = {
    "declared": "What the signatures say",
    "forward": "Backbones, necks, heads, postprocessors",
    "loss": "Losses and metrics",
    "stream": "Filters and trackers",
    "retriever": "Retrievers",
    "data": "Datasets and transforms",
}


def page() -> str:
    """The text of docs/conformance.md."""
    sections = [INTRODUCTION, _section("The distribution", [(check, "distribution") for check in PACKAGE_CHECKS])]
    for module, title in GROUPS.items():
        own = [(c.run, _slots(c.slots)) for c in CHECKS if c.run.__module__.endswith(f".{module}")]
        sections.append(_section(title, own))
    return "\n".join(sections)


def _slots(slots: tuple[str, ...]) -> str:
    return "all" if set(slots) == set(SLOTS) else ", ".join(slots)


def _section(title: str, checks: Iterable[tuple[Callable[[Any], None], str]]) -> str:
    rows = [f"| `{check.__name__}` | {slots} | {(check.__doc__ or '').strip()} |" for check, slots in checks]
    return "\n".join([f"## {title}\n", "| check | of | what must hold |", "|---|---|---|", *rows, ""])


def main() -> int:
    parser = argparse.ArgumentParser(description="Write docs/conformance.md.")
    parser.add_argument("--check", action="store_true", help="only compare")
    if parser.parse_args().check:
        current = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
        if current != page():
            print(f"{PAGE} is out of date: python tools/check_table.py", file=sys.stderr)
        return int(current != page())
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
