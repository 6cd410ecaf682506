"""Entry points are the registry: `lidarfw.<slot>` groups of installed distributions, imported only when selected."""

from __future__ import annotations

import difflib
import functools
import importlib
import importlib.metadata
import inspect
import json
import logging
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

from lidarfw.errors import RegistryError
from lidarfw.interfaces import SLOTS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """One declared component: where it is and who ships it."""

    slot: str
    name: str
    value: str  # "package.module:Class"
    distribution: str = ""
    version: str = ""

    @property
    def origin(self) -> str:
        """Distribution and version, as messages show them."""
        return f"{self.distribution} {self.version}".strip()


_in_use: list[dict[str, dict[str, Any]]] = []  # classes given by `use`, innermost last


@functools.cache
def _installed() -> dict[str, tuple[Entry, ...]]:
    found: dict[str, list[Entry]] = {}
    for slot in (*SLOTS, "conf"):
        for point in importlib.metadata.entry_points(group=f"lidarfw.{slot}"):
            if point.dist is not None:
                entry = Entry(slot, point.name, point.value, point.dist.name, point.dist.version)
                found.setdefault(slot, []).append(entry)
    return {slot: tuple(sorted(entries, key=lambda e: (e.name, e.distribution))) for slot, entries in found.items()}


def entries(slot: str) -> list[Entry]:
    """All declared components of a slot, those of `use` included, by name; nothing is imported."""
    local = [
        Entry(slot, name, f"{cls.__module__}:{cls.__qualname__}", "this program")
        for layer in _in_use
        for name, cls in layer.get(slot, {}).items()
    ]
    hidden = {entry.name for entry in local}
    return [*local, *(entry for entry in _installed().get(slot, ()) if entry.name not in hidden)]


def names(slot: str) -> list[str]:
    """Names of the components of a slot."""
    return sorted({entry.name for entry in entries(slot)})


def conf_packages() -> list[Entry]:
    """Config packages of core (first) and plugins."""
    return sorted(_installed().get("conf", ()), key=lambda e: (e.distribution != "lidarfw", e.distribution))


@contextmanager
def use(**slots: dict[str, Any]) -> Iterator[None]:
    """Register classes for tests and notebooks: `with registry.use(head={"toy": ToyHead}): ...`."""
    unknown = sorted(set(slots) - set(SLOTS))
    if unknown:
        raise RegistryError(f"no slot named {unknown[0]!r}.\n  slots: {', '.join(SLOTS)}")
    _in_use.append(slots)
    try:
        yield
    finally:
        _in_use.remove(slots)


def packages() -> set[str]:
    """Top-level packages of all declared components."""
    return {entry.value.partition(":")[0].partition(".")[0] for slot in SLOTS for entry in entries(slot)} - {"__main__"}


def trusted(name: str) -> bool:
    """Whether a stranger may choose this component: it is named, or its class is of a package that declares some."""
    module, colon, _ = name.partition(":")
    parts = module.split(".")
    return not colon or (parts[0] in packages() and "__main__" not in parts)


def find(slot: str, name: str) -> Entry:
    """The entry of a component: a registered name, or "package.module:Class" for a class that is not packaged."""
    if ":" in name:
        return Entry(slot, name, name)
    found = [entry for entry in entries(slot) if entry.name == name]
    if not found:
        raise RegistryError(_unknown(slot, name))
    if len({entry.distribution for entry in found}) > 1:
        origins = " and ".join(entry.origin for entry in found)
        raise RegistryError(
            f"{slot} {name!r} comes from two distributions: {origins}.\n"
            f'  fix: uninstall one, or name the class: {slot}: {{{name}: {{type: "{found[-1].value}"}}}}'
        )
    return found[0]


def given(slot: str, name: str) -> Any:
    """The class that `use` gave for a name, innermost first, or None."""
    return next((layer[slot][name] for layer in reversed(_in_use) if name in layer.get(slot, {})), None)


def load(slot: str, name: str) -> Any:
    """The class of a component, imported now."""
    local = given(slot, name)
    if local is not None:
        return local
    entry = find(slot, name)
    module, _, attribute = entry.value.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a broken plugin may even call sys.exit while it is imported
        origin = f" ({entry.origin})" if entry.origin else ""
        reason = f"{error or type(error).__name__}, at {_where(error)}"
        raise RegistryError(f"component could not be imported: {slot} {name!r}{origin}: {reason}") from error
    if not inspect.isclass(found):
        raise RegistryError(f"{slot} {name!r} is no class: {entry.value} is a {type(found).__name__}")
    return found


def _where(error: BaseException) -> str:
    if isinstance(error, SyntaxError):
        return f"{_short(error.filename or '')}:{error.lineno}"
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "importlib" not in f.filename]
    return f"{_short(frames[-1].filename)}:{frames[-1].lineno}" if frames else "an unknown place"


def _short(filename: str) -> str:
    return "/".join(Path(filename).parts[-2:])


def _unknown(slot: str, name: str) -> str:
    for distribution, project in editable_projects().items():
        try:
            declared = declared_by(project)
        except RegistryError as error:  # of one plugin: the others are to work
            log.warning("%s: %s", distribution, error)
            continue
        if name in declared.get(slot, {}):
            return (
                f"{slot} {name!r} is declared in {project / 'pyproject.toml'} but not in the installed metadata of "
                f"{distribution}.\n  fix: pip install -e {project}"
            )
    there = ", ".join(f"{entry.name} ({entry.origin})" for entry in entries(slot)) or "none"
    return f"no {slot} named {name!r}.\n  installed {slot}s: {there}{did_you_mean(name, names(slot))}"


def did_you_mean(word: str, choices: list[str]) -> str:
    """A line that proposes the nearest of `choices`, or nothing."""
    near = difflib.get_close_matches(word, choices, n=1)
    return f"\n  did you mean {near[0]!r}?" if near else ""


@functools.cache
def editable_projects() -> dict[str, Path]:
    """Project folder of every distribution that is installed in editable mode and has lidarfw entry points."""
    found = {}
    for distribution in {entry.distribution for group in _installed().values() for entry in group}:
        # beside a checkout's own .egg-info, which knows no origin, the installed metadata is a second answer
        texts = (d.read_text("direct_url.json") for d in importlib.metadata.distributions(name=distribution))
        url = json.loads(next(filter(None, texts), "{}"))
        if url.get("dir_info", {}).get("editable"):
            found[distribution] = Path(unquote(urlparse(url["url"]).path))
    return found


def declared_by(project: Path) -> dict[str, dict[str, str]]:
    """Components that a project's pyproject.toml declares: slot -> name -> value. RegistryError if it is no TOML."""
    points = _project_table(project).get("entry-points", {})
    return {group.removeprefix("lidarfw."): value for group, value in points.items() if group.startswith("lidarfw.")}


def project_name(project: Path) -> str:
    """Name of the distribution that a project's pyproject.toml builds."""
    return str(_project_table(project).get("name", ""))


def _project_table(project: Path) -> dict[str, Any]:
    file = project / "pyproject.toml"
    try:
        text = file.read_text(encoding="utf-8") if file.is_file() else ""
        return dict(tomllib.loads(text).get("project", {}))
    except ValueError as error:  # no TOML, or no text
        raise RegistryError(f"{file} is no TOML: {error}.\n  fix: correct that line") from error


def stale_metadata() -> list[str]:
    """One message for every editable distribution whose pyproject and installed metadata differ."""
    messages = []
    for distribution, project in editable_projects().items():
        try:
            here = {(slot, n) for slot, points in declared_by(project).items() for n in points}
        except RegistryError as error:
            messages.append(f"{distribution}: {error}")
            continue
        there = {
            (slot, e.name) for slot, group in _installed().items() for e in group if e.distribution == distribution
        }
        for slot, name in sorted(here ^ there):
            state = "declared but not installed" if (slot, name) in here else "installed but no longer declared"
            messages.append(f"{distribution}: {slot} {name!r} is {state}.\n  fix: pip install -e {project}")
    return messages
