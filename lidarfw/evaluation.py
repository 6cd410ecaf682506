"""The config of an evaluation: that of the checkpoint, with overrides for everything but what it has learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from lidarfw.config import compose
from lidarfw.errors import ConfigError

LEARNED_KEYS = ("backbone", "neck", "head", "loss", "balance")
BROUGHT_KEYS = ("postprocessor", "metric")
MODEL_KEYS = (*LEARNED_KEYS, "postprocessor", "filter", "tracker", "retriever")
TRAINING_KEYS = ("optimizer", "scheduler", "init", "resume")  # of no use in an evaluation
GLOBAL_KEYS = ("experiment", "debug")  # options of these set other keys


def evaluation_config(stored: Mapping[str, Any], overrides: Sequence[str]) -> DictConfig:
    """The config of a checkpoint with overrides; groups (`dataset=NAME`) are composed, keys are set.

    What comes after the heads may change too (`filter=NAME`, `postprocessor.nms.iou_threshold=0.5`), as far as the
    weights of the checkpoint still fit.
    """
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        raise ConfigError(f"cannot read the overrides: {error}") from error
    for override in parsed:
        _refuse(override.key_or_group, override.input_line or "")
        if override.is_delete() and override.key_or_group in BROUGHT_KEYS:
            raise ConfigError(
                f"{override.input_line} has no effect: where none is chosen, the heads bring their own.\n"
                f"  fix: {override.key_or_group}=NAME"
            )
    groups = [o for o in parsed if _selects(o, stored)]
    composed = compose([str(o.input_line) for o in groups])
    progress = {name: node for name, node in (stored.get("callbacks") or {}).items() if name == "progress"}
    config = OmegaConf.create({**stored, "callbacks": progress, "logger": None, "resume": None, "init": None})
    for override in groups:
        config[override.key_or_group] = composed.get(override.key_or_group)
    for override in parsed:
        if override not in groups:
            _set(config, override)
    return config


def _selects(override: Any, stored: Mapping[str, Any]) -> bool:
    """Whether an override chooses options of a config group, as `dataset=kitti` does."""
    key = override.key_or_group
    return "." not in key and (key not in stored or isinstance(stored[key], (dict, type(None))))


def _refuse(key: str, line: str) -> None:
    root = key.partition(".")[0].partition("@")[0]
    if root in LEARNED_KEYS:
        raise ConfigError(
            f"{line}: {root} is part of the model, and the model comes from the checkpoint with its weights.\n"
            "  an evaluation can change: dataset, transform, metric, loader, splits, trainer, seed; and what comes\n"
            "  after the heads: postprocessor, filter, tracker, retriever\n"
            f"  fix: train with {line}"
        )
    if root in GLOBAL_KEYS:
        raise ConfigError(
            f"{line}: the config comes from the checkpoint, {root} would set parts of the model too.\n"
            "  fix: the keys that are to change, one by one, such as dataset=NAME splits.test=val"
        )
    if root in TRAINING_KEYS:
        raise ConfigError(f"{line}: an evaluation does not train, {root} has no effect.\n  fix: leave it out")


def _set(config: DictConfig, override: Any) -> None:
    key = override.key_or_group
    parent, _, name = key.rpartition(".")
    there = OmegaConf.select(config, parent) if parent else config
    # what heads bring along stands in a checkpoint without its options: `plan` knows them
    brought = key.partition(".")[0] in BROUGHT_KEYS and isinstance(there, DictConfig) and "type" in there
    adds = override.is_add() or override.is_force_add() or brought
    if not isinstance(there, DictConfig) or (name not in there and not adds):
        known = ", ".join(str(k) for k in (there if isinstance(there, DictConfig) else config))
        raise ConfigError(f"{override.input_line}: the config of the checkpoint has no {key!r}.\n  there is: {known}")
    if override.is_delete():
        there.pop(name)
    else:
        OmegaConf.update(config, key, override.value(), force_add=True)
