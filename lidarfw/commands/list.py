"""`lidarfw list`: what is installed, from the metadata of the distributions alone."""

from __future__ import annotations

import argparse
import json
import textwrap
from typing import Any

from lidarfw import declaration, registry
from lidarfw.declaration import REQUIRED, kind_name
from lidarfw.errors import LidarfwError, RegistryError
from lidarfw.interfaces import SLOTS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw list`."""
    parser.add_argument("slot", nargs="?", help=f"one of: {', '.join(SLOTS)}, experiment")
    parser.add_argument("-v", "--verbose", action="store_true", help="also what each takes and gives, and where it is")
    parser.add_argument("--json", metavar="FILE", help="write the list to a file")


def run(args: argparse.Namespace) -> int:
    """Print the components; exit code 2 for a slot that does not exist."""
    slots = list(SLOTS) if args.slot is None else [args.slot]
    if args.slot is not None and args.slot not in (*SLOTS, "experiment"):
        near = registry.did_you_mean(args.slot, [*SLOTS, "experiment"])
        raise RegistryError(f"no slot named {args.slot!r}.\n  slots: {', '.join(SLOTS)}, experiment{near}")
    rows = [row for slot in slots if slot != "experiment" for row in _components(slot, args.verbose or bool(args.json))]
    rows += _yaml_options("experiment") if args.slot in (None, "experiment") else []
    _print(rows, args.verbose)
    for message in registry.stale_metadata():
        print(f"warning: {message}")
    if args.json:
        from lidarfw.files import write_text

        write_text(args.json, json.dumps(rows, indent=2))
    return 0


def _components(slot: str, full: bool) -> list[dict[str, Any]]:
    rows = [
        {"slot": slot, "name": e.name, "from": e.origin, **(_details(slot, e) if full else {})}
        for e in registry.entries(slot)
    ]
    return rows + _yaml_options(slot)


def _yaml_options(group: str) -> list[dict[str, Any]]:
    """Presets of a slot, or experiments: YAML files of core and plugins."""
    import importlib.util
    from pathlib import Path

    rows = []
    for entry in registry.conf_packages():
        spec = importlib.util.find_spec(entry.value)
        for place in (spec.submodule_search_locations or []) if spec else []:
            for file in sorted((Path(place) / group).glob("*.yaml")):
                rows.append({"slot": group, "name": file.stem, "from": entry.origin, "preset": group != "experiment"})
    return rows


def _details(slot: str, entry: registry.Entry) -> dict[str, Any]:
    try:
        d = declaration.read(slot, entry.name)
    except LidarfwError as error:
        return {"error": str(error)}
    return {
        "takes": [str(p) + (" (optional)" if p.optional else "") for p in d.takes],
        "gives": [f"{'list of ' if several else ''}{kind_name(kind)}" for kind, several in d.gives],
        "options": {name: _default(o.default) for name, o in d.options.items()},
        "doc": d.doc.partition("\n\n")[0].replace("\n", " "),
        "file": f"{d.file}:{d.line}",
    }


def _default(value: Any) -> Any:
    return "required" if value is REQUIRED else value


def _print(rows: list[dict[str, Any]], verbose: bool) -> None:
    width = max((len(row["name"]) for row in rows), default=0)
    for slot in dict.fromkeys(row["slot"] for row in rows):
        print(slot)
        for row in (r for r in rows if r["slot"] == slot):
            note = " (preset)" if row.get("preset") else ""
            print(f"  {row['name']:<{width}}  {row['from']}{note}")
            if verbose:
                _print_details(row)


def _print_details(row: dict[str, Any]) -> None:
    if "error" in row:
        print(f"      cannot be read: {row['error']}")
    if "doc" not in row:
        return
    print(textwrap.indent(textwrap.fill(row["doc"], 104), "      "))
    options = ", ".join(f"{name}={value}" for name, value in row["options"].items())
    for label, text in (("takes", ", ".join(row["takes"])), ("gives", ", ".join(row["gives"])), ("options", options)):
        if text:
            print(textwrap.indent(textwrap.fill(f"{label}: {text}", 104, subsequent_indent="  "), "      "))
    print(f"      {row['file']}")
