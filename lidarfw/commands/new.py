"""`lidarfw new`: a plugin distribution to start from, which passes `lidarfw check` as it is."""

from __future__ import annotations

import argparse
import importlib.util
import keyword
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template

import lidarfw
from lidarfw import registry
from lidarfw.errors import ConfigError
from lidarfw.interfaces import SLOTS

_PRESETS = {  # an option of each template, with another value
    "dataset": "classes: [Car]",
    "transform": "share: 0.05",
    "backbone": "channels: 32",
    "neck": "channels: 32",
    "head": "channels: 32",
    "loss": "margin: 1.0",
    "postprocessor": "count: 20",
    "filter": "distance: 40.0",
    "tracker": "distance: 1.0",
    "retriever": "chunk: 64",
    "metric": "radius: 0.5",
}
_BESIDE = {"loss": "center", "postprocessor": "nms", "metric": "box_ap"}  # what the experiment keeps in the same slot


@dataclass(frozen=True)
class Names:
    """What the pieces of a new distribution are called."""

    distribution: str
    slot: str
    component: str

    @property
    def package(self) -> str:
        return self.distribution.replace("-", "_")

    @property
    def module(self) -> str:
        return "losses" if self.slot == "loss" else f"{self.slot}s"

    @property
    def stem(self) -> str:
        return "".join(part.capitalize() for part in self.component.split("_"))

    @property
    def cls(self) -> str:
        return self.stem + SLOTS[self.slot]

    @property
    def entry_points(self) -> str:
        """The tables of pyproject.toml; a head brings its loss."""
        values = {self.slot: self.cls} | ({"loss": f"{self.stem}Loss"} if self.slot == "head" else {})
        return "\n".join(
            f'[project.entry-points."lidarfw.{slot}"]\n{self.component} = "{self.package}.{self.module}:{cls}"\n'
            for slot, cls in values.items()
        )

    @property
    def selection(self) -> str:
        """What the experiment selects in the slot."""
        preset = f"{self.component}_small"
        return f"[{_BESIDE[self.slot]}, {preset}]" if self.slot in _BESIDE else preset

    @property
    def experiment(self) -> str:
        """Name of the experiment, "" where core has nothing to combine the component with."""
        return "" if self.slot == "retriever" else f"{self.component}_demo"

    @property
    def files(self) -> dict[str, str]:
        """Path of each file and the template that it is written from."""
        files = {
            "pyproject.toml": "pyproject",
            "README.md": "readme",
            "tests/test_conformance.py": "test",
            f"{self.package}/{self.module}.py": self.slot,
            f"{self.package}/conf/{self.slot}/{self.component}_small.yaml": "preset",
        }
        return files | (
            {f"{self.package}/conf/experiment/{self.experiment}.yaml": "experiment"} if self.experiment else {}
        )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw new`."""
    parser.add_argument("name", help="name of the distribution, such as acme-lidar")
    parser.add_argument("--slot", required=True, choices=list(SLOTS), help="what the component is")
    parser.add_argument("--component", help="its name in configs; default: the distribution's, without lidarfw-")
    parser.add_argument("-o", "--output", metavar="DIR", help="folder to write; default: ./NAME")


def run(args: argparse.Namespace) -> int:
    """Write the distribution and say what to do next."""
    component = args.component or args.name.removeprefix("lidarfw-").replace("-", "_")
    folder = Path(args.output or args.name)
    create(Names(args.name, args.slot, component), folder)
    print(f"wrote {folder}\nnext:\n  pip install -e {folder}\n  lidarfw check {args.name}")
    return 0


def create(names: Names, folder: Path) -> None:
    """Write the files of a new distribution. ConfigError for names that are taken or no names, or a folder in use."""
    _check(names, folder)
    values = _values(names)
    texts = {path: Template(_template(name)).substitute(values) for path, name in names.files.items()}
    texts[f"{names.package}/__init__.py"] = f'"""The {names.slot} `{names.component}` for lidarfw."""\n'
    texts[f"{names.package}/conf/__init__.py"] = '"""Presets and experiments."""\n'
    try:
        for path, text in texts.items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"cannot write {folder}: {error.strerror or error}.\n  fix: another folder with -o"
        ) from error


def _template(name: str) -> str:
    return resources.files("lidarfw.templates").joinpath(f"{name}.template").read_text(encoding="utf-8")


def _values(names: Names) -> dict[str, str]:
    major, minor = lidarfw.__version__.split(".")[:2]
    commands = [f"lidarfw {command} experiment={names.experiment}\n" for command in ("show", "train")]
    row = f"| `{names.package}/conf/experiment/{names.experiment}.yaml` | an experiment: what it is combined with |\n"
    fields = ("distribution", "slot", "component", "package", "module", "stem", "cls", "entry_points", "selection")
    return {name: getattr(names, name) for name in fields} | {
        "version": f"{major}.{minor}",
        "next_version": f"{major}.{int(minor) + 1}",
        "preset_option": _PRESETS[names.slot],
        "commands": "".join(commands) if names.experiment else "",
        "experiment_row": row if names.experiment else "",
    }


def _check(names: Names, folder: Path) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", names.distribution) or keyword.iskeyword(names.package):
        raise ConfigError(
            f"{names.distribution!r} is no name for a distribution.\n"
            "  fix: small letters, digits and single hyphens, such as acme-lidar; no word of Python"
        )
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", names.component):
        raise ConfigError(
            f"{names.component!r} is no name for a component.\n"
            "  fix: --component with small letters, digits and single underscores"
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} exists and is not empty.\n  fix: choose another folder with -o")
    if importlib.util.find_spec(names.package) is not None:
        raise ConfigError(
            f"a package named {names.package!r} is installed already.\n  fix: choose another name, such as "
            f"lidarfw-{names.distribution}"
        )
    slots = [names.slot, *(["loss"] if names.slot == "head" else [])]
    taken = [entry for slot in slots for entry in registry.entries(slot) if entry.name == names.component]
    if taken:
        raise ConfigError(
            f"{taken[0].slot} {names.component!r} exists already, in {taken[0].origin}.\n  fix: --component OTHER_NAME"
        )
