"""The file that states claims: runs as lists of overrides, and what one of them is said to do better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from lidarfw.errors import ConfigError
from lidarfw.registry import did_you_mean

BETTER = ("lower", "higher")
RESAMPLE = ("frames", "sequences", "seeds")
_FILE_KEYS = ("paper", "experiment", "overrides", "seeds", "minutes", "resamples", "block", "runs", "claims")
_RUN_KEYS = ("experiment", "overrides", "eval")
_CLAIM_KEYS = (
    "claim", "source", "baseline", "variant", "metric", "better", "paired", "resample", "seeds", "margin", "long",
)  # fmt: skip


@dataclass(frozen=True)
class Run:
    """A way to train and evaluate: `lidarfw train OVERRIDES`, then `lidarfw eval CKPT EVALUATION`."""

    name: str
    overrides: tuple[str, ...]
    evaluation: tuple[str, ...] = ()


@dataclass(frozen=True)
class Claim:
    """`variant` is better than `baseline` (a run, or a number to reach) by a figure of their evaluations."""

    name: str
    text: str
    source: str  # table of the paper, with its figures
    baseline: Run | float
    variant: Run
    metric: str  # "metric/key"
    better: str  # of BETTER
    seeds: tuple[int, ...]
    paired: bool = True
    resample: str = "frames"  # of RESAMPLE
    margin: str | float = "5%"  # up to which a difference counts as none: of the baseline's figure, or absolute
    long: bool = False

    @property
    def runs(self) -> list[Run]:
        """The runs that it needs."""
        return [run for run in (self.baseline, self.variant) if isinstance(run, Run)]

    def margin_of(self, baseline: float) -> float:
        """The margin in the metric's own unit."""
        if isinstance(self.margin, str):
            return abs(baseline) * float(self.margin.removesuffix("%")) / 100
        return self.margin


@dataclass(frozen=True)
class ClaimsFile:
    """What a file states."""

    name: str  # of the results
    path: Path
    paper: str
    claims: list[Claim]
    minutes: float = 5.0  # that a run takes, until one has been measured
    resamples: int = 500
    block: int = 10
    extra: tuple[str, ...] = field(default=())  # overrides of all runs, from the command line


def find(name: str) -> Path:
    """The file of a plugin of this repository ("taco"), or the one at a path."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise ConfigError(f"there is no file {path}")
        return path
    found = Path("plugins") / name / "claims.yaml"
    if not found.is_file():
        known = sorted(p.parent.name for p in Path("plugins").glob("*/claims.yaml"))
        there = ", ".join(known) or "no plugin here states claims"
        raise ConfigError(
            f"there is no {found}.\n  with claims: {there}{did_you_mean(name, known)}\n"
            "  fix: run it from the root of the repository, or give the path of a claims.yaml"
        )
    return found


def read(path: Path, extra: Sequence[str] = ()) -> ClaimsFile:
    """The claims of a file, `extra` overrides added to every run; ConfigError naming file, key and what is wrong."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None) or str(error)
        place = f"line {mark.line + 1}: " if mark else ""
        raise ConfigError(f"{path} cannot be read: {place}{problem}") from error
    node = _mapping(content, str(path), _FILE_KEYS, ("runs", "claims"))
    runs = {name: _run(f"{path}: runs.{name}", name, value, node, extra) for name, value in _items(node, path, "runs")}
    seeds = _seeds(node.get("seeds", [1, 2, 3]), f"{path}: seeds")
    claims = [
        _claim(f"{path}: claims.{name}", name, value, runs, seeds) for name, value in _items(node, path, "claims")
    ]
    numbers = {key: _positive(node[key], f"{path}: {key}") for key in ("minutes", "resamples", "block") if key in node}
    whole = {key: int(value) if key != "minutes" else value for key, value in numbers.items()}
    title = path.resolve().parent.name if path.stem == "claims" else path.stem
    return ClaimsFile(title, path, str(node.get("paper", "")), claims, extra=tuple(extra), **whole)  # type: ignore[arg-type]


def _items(node: Mapping[str, Any], path: Path, key: str) -> list[tuple[str, Any]]:
    value = node[key]
    if not isinstance(value, dict) or not value:
        raise ConfigError(f"{path}: {key} must hold entries by name, found {value!r}")
    return [(str(name), entry) for name, entry in value.items()]


def _mapping(value: Any, where: str, known: Sequence[str], needed: Sequence[str]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: expected keys {', '.join(known)}, found {value!r}")
    unknown = [str(key) for key in value if key not in known]
    if unknown:
        near = did_you_mean(unknown[0], list(known))
        raise ConfigError(f"{where}: there is no key {unknown[0]!r}.\n  keys: {', '.join(known)}{near}")
    missing = [key for key in needed if value.get(key) is None]
    if missing:
        raise ConfigError(f"{where}: {missing[0]} is missing")
    return value


def _run(where: str, name: str, value: Any, file: Mapping[str, Any], extra: Sequence[str]) -> Run:
    node = {"overrides": value} if isinstance(value, list) else _mapping(value, where, _RUN_KEYS, ())
    experiment = node.get("experiment", file.get("experiment"))
    chosen = [f"experiment={experiment}"] if experiment else []
    own = _overrides(node.get("overrides") or [], f"{where}.overrides")
    common = _overrides(file.get("overrides") or [], "overrides")
    evaluation = _overrides(node.get("eval") or [], f"{where}.eval")
    return Run(name, (*chosen, *common, *own, *extra), evaluation)


def _overrides(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ConfigError(
            f"{where} must be a list of overrides such as ['head=[center]', optimizer.lr=0.01]: {value!r}"
        )
    return tuple(value)


def _seeds(value: Any, where: str) -> tuple[int, ...]:
    numbers = value if isinstance(value, list) else []
    if not numbers or not all(isinstance(n, int) and n >= 0 for n in numbers) or len(set(numbers)) < len(numbers):
        raise ConfigError(f"{where} must be a list of different numbers such as [1, 2, 3], found {value!r}")
    return tuple(numbers)


def _positive(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value <= 0:
        raise ConfigError(f"{where} must be a number above 0, found {value!r}")
    return float(value)


def _claim(where: str, name: str, value: Any, runs: Mapping[str, Run], seeds: tuple[int, ...]) -> Claim:
    node = _mapping(value, where, _CLAIM_KEYS, ("claim", "baseline", "variant", "metric", "better"))
    for key, known in (("better", BETTER), ("resample", RESAMPLE)):
        if node.get(key, known[0]) not in known:
            raise ConfigError(f"{where}.{key} is {node[key]!r}; use one of: {', '.join(known)}")
    for key in ("paired", "long"):
        if not isinstance(node.get(key, False), bool):
            raise ConfigError(f"{where}.{key} must be true or false, found {node[key]!r}")
    if "/" not in str(node["metric"]):
        raise ConfigError(f"{where}.metric must be METRIC/KEY such as box_ap/mean_3d_ap, found {node['metric']!r}")
    baseline = node["baseline"]
    number = isinstance(baseline, (int, float)) and not isinstance(baseline, bool)
    return Claim(
        name,
        str(node["claim"]),
        str(node.get("source", "")),
        float(baseline) if number else _named(runs, baseline, f"{where}.baseline"),
        _named(runs, node["variant"], f"{where}.variant"),
        str(node["metric"]),
        str(node["better"]),
        _seeds(node["seeds"], f"{where}.seeds") if "seeds" in node else seeds,
        bool(node.get("paired", True)),
        str(node.get("resample", "frames")),
        _margin(node.get("margin", "5%"), f"{where}.margin"),
        bool(node.get("long", False)),
    )


def _named(runs: Mapping[str, Run], name: Any, where: str) -> Run:
    if name not in runs:
        near = did_you_mean(str(name), list(runs))
        raise ConfigError(f"{where} is {name!r}, but there is no run of that name.\n  runs: {', '.join(runs)}{near}")
    return runs[name]


def _margin(value: Any, where: str) -> str | float:
    try:
        size = float(str(value).removesuffix("%"))
    except ValueError:
        size = -1.0
    if isinstance(value, bool) or size < 0:
        raise ConfigError(f"{where} must be a share such as 5% or a number in the metric's unit, found {value!r}")
    return value if isinstance(value, str) and value.endswith("%") else size
