"""Checkpoints that describe themselves: weights, resolved config, data spec and versions, in plain types only.

`load` rebuilds the model from the file alone. Nothing in a checkpoint can run code: files are read with
`weights_only=True`, and a config can name components of installed plugins only.
"""

from __future__ import annotations

import importlib.metadata
import json
import logging
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml
from lightning.pytorch.plugins import TorchCheckpointIO
from torch import Tensor, nn

from lidarfw import registry
from lidarfw.errors import AssemblyError, CheckpointError, ConfigError, DataError, RegistryError
from lidarfw.files import atomic_path, require_checkpoint
from lidarfw.interfaces import SLOTS
from lidarfw.types import DataSpec

if TYPE_CHECKING:
    from lidarfw.assembly import Plan
    from lidarfw.model import PerceptionModel

FORMAT = 1
KEY = "lidarfw"  # of the description in a checkpoint, and in the metadata of a .safetensors file
PREFIX = "model."  # of the PerceptionModel in the state of the Lightning module
log = logging.getLogger(__name__)


# --- what a checkpoint says of itself -------------------------------------------------------------------------------


def describe(plan: Plan) -> dict[str, Any]:
    """What is stored beside the weights, to rebuild the model without dataset and config files."""
    return {
        "format": FORMAT,
        "config": yaml.safe_dump(plan.config, sort_keys=False, allow_unicode=True),
        "data_spec": plan.data.to_plain(),
        "distributions": dict(plan.distributions),
        "components": dict(plan.components),
    }


def description(checkpoint: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    """The description in a checkpoint that was read from `path`, checked against what is installed."""
    about = checkpoint.get(KEY)
    keys = ("format", "config", "data_spec", "distributions", "components")
    if not isinstance(about, dict) or not isinstance(about.get("format"), int):
        there = ", ".join(map(str, list(checkpoint)[:5])) or "nothing"
        raise CheckpointError(
            f"{path} is no checkpoint of lidarfw: it has no key {KEY!r}, it has {there}.\n"
            "  fix: give the .ckpt of a `lidarfw train` run"
        )
    if about["format"] > FORMAT:
        raise CheckpointError(
            f"{path} has format {about['format']}, this lidarfw reads up to {FORMAT}.\n  fix: pip install -U lidarfw"
        )
    missing = [key for key in keys if key not in about]
    if missing:
        raise CheckpointError(f"{path}: its description lacks {', '.join(missing)}")
    _check_distributions(about, path)
    return about


def _check_distributions(about: Mapping[str, Any], path: str | Path) -> None:
    for name, version in about["distributions"].items():
        try:
            installed = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            part = next((c for c, dist in about["components"].items() if dist == name), "")
            slot, _, component = part.partition(".")
            uses = f"this checkpoint uses {slot} {component!r} from" if part else "this checkpoint needs"
            raise CheckpointError(
                f"{uses} {name} {version}, which is not installed. Fix: pip install {name}\n  file: {path}"
            ) from None
        if installed != version:
            log.warning("%s was written with %s %s, installed is %s", path, name, version, installed)


def config_of(about: Mapping[str, Any], path: str | Path, *, allow_unregistered: bool = False) -> dict[str, Any]:
    """The resolved config of a description; CheckpointError where it could have foreign code imported.

    `allow_unregistered` takes classes "package.module:Class" of any package: only for a file that one trusts.
    """
    try:
        config = yaml.safe_load(about["config"])
    except yaml.YAMLError as error:
        raise CheckpointError(f"{path}: its config is no YAML: {str(error).splitlines()[0]}") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{path}: its config is a {type(config).__name__}, expected a mapping")
    if not allow_unregistered:
        _check_components(config, path)
    return config


def _check_components(config: Mapping[str, Any], path: str | Path) -> None:
    for slot in SLOTS:
        nodes = config.get(slot)
        for name, node in nodes.items() if isinstance(nodes, dict) else ():
            kind = node.get("type", "") if isinstance(node, dict) else ""
            if not isinstance(kind, str) or not registry.trusted(kind):
                raise CheckpointError(
                    f"{path}: {slot}.{name} is {kind!r}, of no installed plugin; it was not imported, since that could "
                    "run code.\n  fix: install the plugin that ships the class (`lidarfw new` starts one); or, for a "
                    "file that you trust,\n  in Python: lidarfw.load(path, allow_unregistered=True)"
                )


# --- reading and writing --------------------------------------------------------------------------------------------


def verify(path: str | Path) -> None:
    """CheckpointError unless the file is there, whole, and every checksum in it fits; names the last good file."""
    path = Path(path)
    require_checkpoint(path)
    reason = _damage(path)
    if reason:
        other = _newest_good(path)
        fix = f"\n  the last good one there: {other}" if other else "\n  there is no other checkpoint in that folder"
        raise CheckpointError(f"{path} cannot be read: {reason}.{fix}")


def _damage(path: Path) -> str | None:
    """What is wrong with a checkpoint file, or None."""
    if path.is_dir():
        return "it is a folder"
    try:
        size = path.stat().st_size
        if size == 0:
            return "it is empty (0 bytes)"
        if path.suffix == ".safetensors":
            return None  # safetensors checks its own header and length
        if not zipfile.is_zipfile(path):
            return f"it is cut off or no checkpoint ({size} bytes, the directory at its end is missing)"
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
        return f"the checksum of {broken} is wrong (the file was damaged)" if broken else None
    except (OSError, zipfile.BadZipFile, NotImplementedError, EOFError, ValueError, RuntimeError) as error:
        return f"{type(error).__name__}: {error}"


def _newest_good(bad: Path) -> Path | None:
    others = sorted((p for p in bad.parent.glob("*.ckpt") if p != bad), key=lambda p: -p.stat().st_mtime)
    return next((p for p in others if _damage(p) is None), None)


def read(path: str | Path) -> dict[str, Any]:
    """The content of a .ckpt or .safetensors file, on the CPU. Never runs code from the file."""
    verify(path)
    if Path(path).suffix == ".safetensors":
        return _read_safetensors(Path(path))
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a hostile or foreign pickle may fail in any way
        raise CheckpointError(
            f"{path} holds more than plain data and was not loaded, since it could run code.\n"
            f"  refused: {_refused(error)}\n  fix: give a checkpoint that lidarfw wrote"
        ) from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path} holds a {type(content).__name__}, expected a checkpoint of lidarfw")
    return content


def _refused(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if "Unsupported" in line or "GLOBAL" in line]
    return (lines or str(error).splitlines() or [type(error).__name__])[0][:200]


def _read_safetensors(path: Path) -> dict[str, Any]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            weights = {PREFIX + name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # no mapping
        return {"state_dict": weights, **({KEY: json.loads(metadata[KEY])} if KEY in metadata else {})}
    except (SafetensorError, json.JSONDecodeError, OSError) as error:
        raise CheckpointError(f"{path} cannot be read: {str(error).splitlines()[0]}") from error


class AtomicCheckpointIO(TorchCheckpointIO):
    """Checkpoints on a local disk: written beside and moved into place, checked and loaded without running code."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint; on a full disk, CheckpointError, and the file that stood there stays."""
        path = Path(path)
        _check_space(path, checkpoint)
        try:
            with atomic_path(path) as temporary:
                torch.save(checkpoint, temporary)
        except (DataError, RuntimeError) as error:  # torch's writer gives RuntimeError on a full disk
            kept = f"the one before it is still there: {path}" if path.exists() else "nothing stands there"
            reason = str(error).splitlines()[0]
            raise CheckpointError(
                f"checkpoint {path} could not be written: {reason}\n  {kept}\n"
                f"  fix: free space or rights in {path.parent}"
            ) from error

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = True
    ) -> dict[str, Any]:
        """Read a checkpoint; its tensors go to the CPU first."""
        return read(path)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Delete a checkpoint."""
        Path(path).unlink(missing_ok=True)


def _tensor_bytes(value: Any) -> int:
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, Mapping):
        return sum(map(_tensor_bytes, value.values()))
    return sum(map(_tensor_bytes, value)) if isinstance(value, (list, tuple)) else 0


def _check_space(path: Path, checkpoint: Mapping[str, Any]) -> None:
    folder = next((p for p in path.parents if p.is_dir()), Path("."))
    needed, free = _tensor_bytes(checkpoint), shutil.disk_usage(folder).free
    if needed > free:
        kept = f"\n  the one before it is still there: {path}" if path.exists() else ""
        raise CheckpointError(
            f"checkpoint {path} needs {needed / 1e6:.1f} MB, {folder} has {free / 1e6:.1f} MB free.{kept}\n"
            "  fix: free some space, then resume=auto"
        )


# --- models ---------------------------------------------------------------------------------------------------------


def load(path: str | Path, *, allow_unregistered: bool = False) -> PerceptionModel:
    """The trained model in a .ckpt or .safetensors file, in evaluation mode, on the CPU.

    A run with EMA gives the averaged weights. `allow_unregistered` imports classes "package.module:Class" of any
    package, such as your own script: only for a file that you trust. Raises CheckpointError: file damaged, foreign or
    hostile, a distribution missing, format newer, weights that do not fit.
    """
    from lidarfw.assembly import build, plan

    content = read(path)
    about = description(content, path)
    try:
        data = DataSpec.from_plain(about["data_spec"])
        wanted = without_start(config_of(about, path, allow_unregistered=allow_unregistered))
        model = build(plan(wanted, data))
    except (AssemblyError, ConfigError, RegistryError) as error:
        raise CheckpointError(f"{path}: its model cannot be built here: {error}") from error
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise CheckpointError(f"{path}: its description is damaged: {type(error).__name__}: {error}") from error
    restore(model, content, path)
    return model.eval()


def without_start(config: Mapping[str, Any]) -> dict[str, Any]:
    """A config whose components fetch no `pretrained` weights to start from: all will come from a checkpoint."""

    def kept(node: Any) -> Any:
        return {**node, "pretrained": ""} if isinstance(node, dict) and node.get("pretrained") else node

    return {
        slot: {name: kept(node) for name, node in nodes.items()} if isinstance(nodes, dict) else nodes
        for slot, nodes in config.items()
    }


def restore(model: nn.Module, content: Mapping[str, Any], path: str | Path) -> None:
    """Load all weights of a checkpoint that was read already; CheckpointError unless every one fits."""
    weights = weights_of(content, path)
    report = compare(model, weights)
    if report.missing or report.skipped or report.mismatched:
        raise CheckpointError(f"{path}: its weights do not fit the model of its config.\n{report}")
    model.load_state_dict(weights)


def weights_of(content: Mapping[str, Any], path: str | Path) -> dict[str, Tensor]:
    """Weights by parameter name of the model ("head.center.shared.weight")."""
    state = content.get("state_dict")
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise CheckpointError(f"{path} has no weights: no mapping of tensors under 'state_dict'")
    return {name.removeprefix(PREFIX): value for name, value in state.items() if name.startswith(PREFIX)}


def export(checkpoint: str | Path, path: str | Path) -> None:
    """Write the weights and the description of a checkpoint as .safetensors, for sharing; `load` reads it."""
    from safetensors.torch import save

    content = read(checkpoint)
    about = description(content, checkpoint)
    weights = {name: value.clone().contiguous() for name, value in weights_of(content, checkpoint).items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(weights, {KEY: json.dumps(about)}))


# --- starting from other weights ------------------------------------------------------------------------------------


@dataclass
class Report:
    """What became of every weight when a model took over those of another."""

    loaded: list[str]
    missing: list[str]  # of the model, not in the checkpoint: stay as they were
    skipped: list[str]  # of the checkpoint, not in the model or not asked for
    mismatched: dict[str, tuple[tuple[int, ...], tuple[int, ...]]]  # shape in the checkpoint, in the model

    def __str__(self) -> str:
        lines = [f"  loaded {len(self.loaded)} weights"]
        for title, names in (("not in the checkpoint", self.missing), ("not loaded", self.skipped)):
            lines += [f"  {title}: {len(names)} ({_some(names)})"] if names else []
        if self.mismatched:
            shapes = [f"{name} {a} there, {b} here" for name, (a, b) in self.mismatched.items()]
            lines.append(f"  other shape: {len(shapes)} ({_some(shapes)})")
        return "\n".join(lines)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")


def compare(model: nn.Module, weights: Mapping[str, Tensor], only: Sequence[str] = ()) -> Report:
    """Which weights a model can take over; `only` are parts by name ("backbone.taco")."""
    own = model.state_dict()
    wanted = [name for name in own if not only or any(_in(name, part) for part in only)]
    fits = {name: own[name].shape == weights[name].shape for name in wanted if name in weights}
    mismatched = {name: (tuple(weights[name].shape), tuple(own[name].shape)) for name, ok in fits.items() if not ok}
    missing = [name for name in wanted if name not in weights]
    return Report([n for n, ok in fits.items() if ok], missing, [n for n in weights if n not in fits], mismatched)


def _in(name: str, part: str) -> bool:
    return name == part or name.startswith(f"{part}.")


def initialise(model: nn.Module, source: str | Path, only: Sequence[str] = ()) -> Report:
    """Take over the weights of another checkpoint, where names and shapes fit, and say what became of each.

    ConfigError where a part in `only` is in neither, or nothing fits.
    """
    weights = weights_of(read(source), source)
    parts = sorted({".".join(name.split(".")[:2]) for name in weights})
    for part in only:
        if not any(_in(name, part) for name in weights):
            raise ConfigError(f"init.only: {source} has no {part!r}.\n  it has: {', '.join(parts)}")
        if not any(_in(name, part) for name in model.state_dict()):
            raise ConfigError(f"init.only: this model has no {part!r}.\n  the checkpoint has: {', '.join(parts)}")
    report = compare(model, weights, only)
    if not report.loaded:
        raise ConfigError(f"init.from: no weight of {source} fits this model.\n{report}\n  it has: {', '.join(parts)}")
    model.load_state_dict({name: weights[name] for name in report.loaded}, strict=False)
    return report
