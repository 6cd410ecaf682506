"""Hydra over the registry: every registered component is a config option with typed defaults.

`component://` answers Hydra's questions from the metadata of the entry points; only a component that is
selected has its signature read. YAML files of core and plugins (`lidarfw.conf` entry points) come before it in
the search path: presets and experiments.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast, get_args, get_origin

from hydra import compose as hydra_compose
from hydra import initialize_config_module
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from lidarfw import declaration, registry
from lidarfw.errors import ConfigError, LidarfwError
from lidarfw.interfaces import SLOTS

RESERVED = ("type", "inputs")  # keys of every component node
LOSS_RESERVED = ("weight", "ramp")  # of loss nodes too
_GROUPS = ("trainer", "optimizer", "scheduler", "callbacks", "logger", "experiment", "debug")  # beside the slots
_ALLOWED_TARGETS = ("torch.optim.", "lightning.pytorch.", "lightning.fabric.plugins.", "lidarfw.callbacks.")
_ALLOWED_BASES = {
    "torch.optim": ("Optimizer",),
    "torch.optim.lr_scheduler": ("LRScheduler",),
    "lightning.pytorch": ("Callback", "Trainer"),
    "lightning.pytorch.loggers": ("Logger",),
    "lightning.pytorch.profilers": ("Profiler",),
    "lightning.pytorch.strategies": ("Strategy",),
    "lightning.pytorch.plugins": ("CheckpointIO", "ClusterEnvironment", "Precision"),
}


class ComponentSource(ConfigSource):
    """`component://`: slots are config groups, registered components are their options."""

    @staticmethod
    def scheme() -> str:
        return "component"

    def available(self) -> bool:
        return True

    def is_group(self, config_path: str) -> bool:
        return config_path.strip("/") in ("", *SLOTS)

    def is_config(self, config_path: str) -> bool:
        slot, _, name = config_path.removesuffix(".yaml").strip("/").partition("/")
        return slot in SLOTS and name in registry.names(slot)

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        path = config_path.strip("/")
        if path == "":
            return [] if results_filter == ObjectType.CONFIG else sorted(SLOTS)
        return [] if results_filter == ObjectType.GROUP or path not in SLOTS else registry.names(path)

    def load_config(self, config_path: str) -> ConfigResult:
        slot, _, name = config_path.removesuffix(".yaml").partition("/")
        config = OmegaConf.create({name: OmegaConf.structured(node_class(slot, name))})
        return ConfigResult(registry.find(slot, name).origin, config_path, config, {"package": None})


class LidarfwSearchPath(SearchPathPlugin):
    """Adds the plugins' config packages and the registry to Hydra's search path, after core's own configs."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for entry in registry.conf_packages():
            if entry.distribution != "lidarfw":
                search_path.append(entry.origin, f"pkg://{entry.value}")
        search_path.append("installed components", "component://")


def register() -> None:
    """Make Hydra know the registry; may be called more than once."""
    plugins = Plugins.instance()
    for plugin in (ComponentSource, LidarfwSearchPath):
        if plugin not in plugins.discover(plugin.__base__):
            plugins.register(plugin)


def node_class(slot: str, name: str) -> type:
    """The dataclass of a component's config node: `type`, `inputs`, and its options with defaults and types."""
    declared = declaration.read(slot, name)
    parameters = [*declared.takes, *(declared.trainable or ())]
    inputs = dataclasses.make_dataclass("inputs", [(n, Any, None) for n in dict.fromkeys(p.name for p in parameters)])
    fields: list[Any] = [("type", str, name), ("inputs", inputs, dataclasses.field(default_factory=inputs))]
    if slot == "loss":
        fields += [("weight", float, 1.0), ("ramp", float, 0.0)]
    for option, (annotation, default) in ((n, (o.annotation, o.default)) for n, o in declared.options.items()):
        fields.append((option, supported(annotation), _field(default)))
    return dataclasses.make_dataclass(
        f"{slot.title()} {name!r}".replace(" ", "_").replace("'", ""), fields, kw_only=True
    )


def _field(default: Any) -> Any:
    if default is declaration.REQUIRED:
        return dataclasses.field(default="???")
    if isinstance(default, (list, dict, tuple)):
        value = list(default) if isinstance(default, tuple) else default
        return dataclasses.field(default_factory=lambda: value)
    return dataclasses.field(default=default)


def supported(annotation: Any) -> Any:
    """The annotation as far as OmegaConf can check it, else Any."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if annotation in (int, float, bool, str):
        return annotation
    if origin in (list, dict) and all(supported(a) is a for a in arguments):
        return annotation
    if origin is tuple:
        inner = set(arguments) - {...}
        return list[inner.pop()] if len(inner) == 1 and inner <= {int, float, bool, str} else Any  # type: ignore[misc]
    if type(None) in arguments:
        rest = [a for a in arguments if a is not type(None)]
        return typing.Optional[rest[0]] if len(rest) == 1 and rest[0] in (int, float, bool, str) else Any  # noqa: UP045
    return Any


def compose(overrides: Iterable[str] = (), config_name: str = "train") -> DictConfig:
    """The config of `lidarfw train OVERRIDES`, not yet resolved.

    An override `--config-dir=DIR` adds a folder of one's own configs, as on the command line.
    Raises ConfigError, RegistryError: what is misspelt, what there is, and the nearest name.
    """
    register()
    overrides = with_config_dirs(list(overrides))
    GlobalHydra.instance().clear()
    try:
        with initialize_config_module("lidarfw.conf", version_base="1.3"):
            config = hydra_compose(config_name, overrides, return_hydra_config=True)
    except LidarfwError:
        raise
    except HydraException as error:
        raise explain(error, overrides) from error
    except YAMLError as error:
        raise ConfigError(f"a config file is not plain YAML: {error}") from error
    except ValueError as error:  # Hydra's answer to `neck=null`
        nulls = [o for o in overrides if o.endswith("=null")]
        hint = f"\n  fix: {nulls[0].removesuffix('null')}[] selects none" if nulls else ""
        raise ConfigError(f"{error}{hint}") from error
    # Hydra builds its callbacks by itself, before any code of ours could look at them
    _check_targets(OmegaConf.to_container(config.hydra.callbacks))
    with open_dict(config):
        del config["hydra"]
    return config


def with_config_dirs(arguments: list[str]) -> list[str]:
    """`--config-dir DIR` (or `=DIR`, or `-cd DIR`) as the override that Hydra's compose understands."""
    folders, rest = [], []
    words = iter(arguments)
    for word in words:
        if word in ("--config-dir", "-cd"):
            folders.append(next(words, ""))
        elif word.startswith("--config-dir="):
            folders.append(word.partition("=")[2])
        else:
            rest.append(word)
    for folder in folders:
        if not Path(folder).is_dir():
            raise ConfigError(f"--config-dir {folder!r} is no folder")
    return rest + (
        [f"hydra.searchpath=[{','.join(f'file://{Path(f).resolve()}' for f in folders)}]"] if folders else []
    )


def jobs_to_compose(arguments: list[str]) -> Iterator[list[str]]:
    """Overrides of jobs of a sweep that hold every choice of a group between them: `head=a,b seed=1,2` gives two."""
    overrides = [argument for argument in arguments if not argument.startswith("-")]
    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
    except HydraException as error:
        raise explain(error, overrides) from error
    rows = [(o.key_or_group, _values(o)) for o in parsed]
    first = [values[:1] for _, values in rows]
    yield [text for values in first for text in values]
    for place, (key, values) in enumerate(rows):
        for value in values[1:] if key in (*SLOTS, *_GROUPS) else ():
            yield [text for chosen in (*first[:place], [value], *first[place + 1 :]) for text in chosen]


def _values(override: Override) -> list[str]:
    """The overrides that stand for one, several for a sweep; none where only the sweeper knows them."""
    if not override.is_sweep_override():
        return [override.input_line or ""]
    listed = override.is_discrete_sweep() and not isinstance(override.value(), Glob)
    values = override.sweep_string_iterator() if listed else ()
    return [f"{override.get_key_element()}={value}" for value in values]


def explain(error: HydraException, overrides: list[str]) -> LidarfwError:
    """A Hydra error in our words, with the nearest name."""
    cause = error.__cause__ if isinstance(error.__cause__, LidarfwError) else None
    if cause is not None:
        return cause
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.removesuffix(".yaml").rpartition("/")
        if group in SLOTS:
            return _unknown_component(group, name, list(error.options or ()))
        near = registry.did_you_mean(name, list(error.options or ()))
        options = ", ".join(error.options or ()) or "none"
        return ConfigError(f"no {group or 'config'} named {name!r}.\n  there are: {options}{near}")
    if isinstance(error, OverrideParseException):
        return ConfigError(f"cannot read the override {error.override!r}: {error.message}")
    return ConfigError(_override_error(error))


def _unknown_component(slot: str, name: str, options: list[str]) -> LidarfwError:
    try:
        registry.find(slot, name)
    except LidarfwError as error:
        presets = sorted(set(options) - set(registry.names(slot)))
        text, mark, near = str(error).partition("\n  did you mean")
        text += f"\n  presets: {', '.join(presets)}" if presets else ""
        return type(error)(text + mark + near if near else text + registry.did_you_mean(name, presets))
    return ConfigError(f"{slot} {name!r} could not be loaded")


def _override_error(error: HydraException) -> str:
    """What is wrong with an override such as `head.center.widht=3`, and the nearest key."""
    cause = error.__cause__
    reason = str(cause).splitlines()[0] if cause else str(error)
    match = re.search(r"(?:override|full_key:|append to config[^:]*:) '?([\w./]+)'?", f"{error}\n{cause or ''}")
    key = match.group(1) if match else ""
    slot, _, rest = key.partition(".")
    name, _, option = rest.partition(".")
    if slot not in SLOTS or not name:
        reason = f"there is no config key {key!r}." if "not in struct" in reason else reason
        if slot in _top_keys():
            return f"{reason}\n  `lidarfw train --cfg job` shows all keys; +{key}=VALUE adds one"
        return f"{reason}{registry.did_you_mean(slot, [*SLOTS, *_top_keys()])}"
    if name not in registry.names(slot):
        near = registry.did_you_mean(name, registry.names(slot))
        return f"{slot}.{name} is not selected, and no {slot} has that name.{near}"
    declared = declaration.read(slot, name)
    options = [*RESERVED, *(LOSS_RESERVED if slot == "loss" else ()), *declared.options]
    if re.search(rf"Key '({slot}|{name})'", reason):
        return f"{slot}.{name} has options but is not selected.\n  fix: add {slot}={name} (or {slot}=[...,{name}])"
    if option.startswith("inputs."):
        options = [f"inputs.{p.name}" for p in declared.takes]
    if option in options:
        return f"{key}: {reason}"
    near = registry.did_you_mean(option, options)
    return f"{slot}.{name} has no option {option!r}.\n  options of {slot} {name!r}: {', '.join(options)}{near}"


def _top_keys() -> list[str]:
    return ["name", "seed", "loader", "splits", "balance", "init", "resume", *_GROUPS]


def to_plain(config: DictConfig) -> dict[str, Any]:
    """The resolved config as plain dicts and lists; ConfigError for a missing value or a bad interpolation."""
    try:
        return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except OmegaConfBaseException as error:
        key = error.full_key or ""
        raise ConfigError(f"{key or 'config'}: {str(error).splitlines()[0]}\n  fix: set {key}=VALUE") from error


# --- _target_ ------------------------------------------------------------------------------------------------------


def instantiate(node: Any, **kwargs: Any) -> Any:
    """Build an optimizer, scheduler, trainer, logger or callback from a node with `_target_`.

    A config may come from a stranger, so a target must name a class below one of the allowed modules (or of an
    installed plugin) that is an optimizer, scheduler, callback, logger, strategy, ...; nothing else is imported,
    let alone called. Raises ConfigError.
    """
    import hydra.utils

    plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
    _check_targets(plain)
    return hydra.utils.instantiate(plain, _convert_="all", **kwargs)


def _check_targets(node: Any) -> None:
    if isinstance(node, dict):
        if "_target_" in node:
            check_target(node["_target_"])
        for value in node.values():
            _check_targets(value)
    elif isinstance(node, list):
        for value in node:
            _check_targets(value)


def check_target(target: Any) -> None:
    """ConfigError unless `target` names a class that a config may build."""
    prefixes = (*_ALLOWED_TARGETS, *(f"{package}." for package in sorted(registry.packages() - {"lidarfw"})))
    refused = ConfigError(
        f"_target_ {str(target)[:80]!r} is not allowed in a config.\n  a config may build optimizers, schedulers, "
        f"trainers, loggers, callbacks, strategies and profilers from: {', '.join(prefixes)}\n"
        "  fix: ship the class in an installed plugin, or make it a registered component"
    )
    if not isinstance(target, str) or not re.fullmatch(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+", target):
        raise refused
    if not target.startswith(prefixes):
        raise refused
    module, _, name = target.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"_target_ {target!r} cannot be found: {error}") from error
    if not (inspect.isclass(found) and issubclass(found, _allowed_bases())):
        raise refused
    if not f"{found.__module__}.".startswith(("torch.optim.", "lightning.", "lidarfw.", *prefixes)):
        raise refused  # an allowed module that re-exports a foreign class


def _allowed_bases() -> tuple[type, ...]:
    return tuple(getattr(importlib.import_module(m), name) for m, names in _ALLOWED_BASES.items() for name in names)
