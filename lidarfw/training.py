"""Training and evaluation: one Lightning module for every model, `train` and `evaluate` from a config."""

from __future__ import annotations

import fnmatch
import inspect
import logging
import math
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as pl
import numpy as np
import torch
import yaml
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import ModelSummary, ProgressBar
from lightning.pytorch.utilities import rank_zero_only, rank_zero_warn
from omegaconf import DictConfig
from torch import Tensor, nn

from lidarfw import checkpoint
from lidarfw.callbacks import Termination
from lidarfw.config import instantiate, to_plain
from lidarfw.data import DataModule
from lidarfw.errors import CheckpointError, ConfigError, TrainingError
from lidarfw.evaluation import MODEL_KEYS, evaluation_config
from lidarfw.files import write_text
from lidarfw.types import Batch, DataSpec, FrameResult

if TYPE_CHECKING:
    from lidarfw.model import PerceptionModel
    from lidarfw.resampling import FrameRecord

log = logging.getLogger(__name__)
_say = rank_zero_only(log.info)


class UncertaintyBalance(nn.Module):
    """Learned weights of several losses (Kendall, Gal and Cipolla, CVPR 2018, eq. 10).

    With s the log-variance of a task, its loss counts as exp(-s) * loss / 2 + s / 2.
    """

    def __init__(self, names: Iterable[str]) -> None:
        super().__init__()
        self.log_variance = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in names})

    def forward(self, losses: Mapping[str, Tensor]) -> Tensor:
        """The total of the given losses, scalars by name."""
        total = torch.stack([0.0 * s for s in self.log_variance.values()]).sum()  # losses left out stay in the graph
        for name, loss in losses.items():
            s = self.log_variance[name]
            total = total + 0.5 * (torch.exp(-s) * loss + s)
        return total

    def weights(self) -> dict[str, Tensor]:
        """What each loss is multiplied with now."""
        return {name: 0.5 * torch.exp(-s.detach()) for name, s in self.log_variance.items()}


class PerceptionModule(pl.LightningModule):
    """Trains and evaluates a PerceptionModel; the only LightningModule of lidarfw.

    optimizer, scheduler: config nodes with `_target_`. about: the description that goes into checkpoints.
    Every step seeds torch anew from (seed, step, rank), so no random state has to be saved.
    """

    def __init__(
        self,
        model: PerceptionModel,
        *,
        optimizer: Mapping[str, Any],
        scheduler: Mapping[str, Any] | None = None,
        about: Mapping[str, Any] | None = None,
        balance: str = "fixed",
        seed: int = 1,
    ) -> None:
        super().__init__()
        if balance not in ("fixed", "uncertainty"):
            raise ConfigError(f"balance is {balance!r}; use fixed or uncertainty")
        self.model = model
        self.balance = (
            UncertaintyBalance(step.name for step in model.plan.of("loss")) if balance == "uncertainty" else None
        )
        self.optimizer_node = dict(optimizer)
        self.scheduler_node = dict(scheduler or {})
        self.about = dict(about or {})
        self.seed = seed
        self.sample_ids: list[str] = []  # of the batch at hand, for messages
        self.figures: dict[str, float] = {}  # of the last validation
        self.record: FrameRecord | None = None  # of an evaluation that is asked for figures of single frames
        self._stream: Any = None

    @property
    def monitor(self) -> str | None:
        """The logged figure that stands for the run."""
        return f"val/{self.model.monitor}" if self.model.monitor else None

    # training

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Total loss of a batch; TrainingError where a term is not finite."""
        self._seed(self.global_step, batch_idx)
        self.sample_ids = [meta.id for meta in batch.meta]
        losses = self.model.losses(self.model(batch), batch, self.progress)
        self._check_terms(losses)
        sums = {name: torch.stack(list(terms.values())).sum() for name, terms in losses.items()}
        total = self.balance(sums) if self.balance else torch.stack(list(sums.values())).sum()
        self._log_losses(losses, total, len(batch))
        return total

    @property
    def progress(self) -> float:
        """Share of the training that is done after this step, up to 1; 1 where its length is not known."""
        total = self.trainer.estimated_stepping_batches
        return min(1.0, (self.global_step + 1) / total) if math.isfinite(total) and total else 1.0

    def _seed(self, *numbers: int) -> None:
        state = np.random.SeedSequence((self.seed, *numbers, self.global_rank)).generate_state(1, np.uint64)
        torch.manual_seed(int(state[0]))

    def _check_terms(self, losses: Mapping[str, Mapping[str, Tensor]]) -> None:
        terms = {f"{name}/{term}": value for name, values in losses.items() for term, value in values.items()}
        if not terms:
            raise TrainingError("there is no loss to train on.\n  fix: select a loss, and give one a weight above 0")
        finite = torch.isfinite(torch.stack([value.detach().float() for value in terms.values()]))
        if not bool(finite.all()):
            bad = [name for name, ok in zip(terms, finite.tolist(), strict=True) if not ok]
            raise self._not_finite("loss " + ", ".join(f"{name} is {float(terms[name].detach()):g}" for name in bad))

    def _not_finite(self, what: str) -> TrainingError:
        return TrainingError(
            f"{what} at step {self.global_step} (epoch {self.current_epoch}), samples {', '.join(self.sample_ids)}.\n"
            "  training stopped before the optimizer step: the weights are those of the step before, still finite\n"
            "  fix: look at these samples, lower optimizer.lr, lower trainer.gradient_clip_val, or\n"
            "  trainer.precision=32-true; trainer.detect_anomaly=true names the operation"
        )

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """TrainingError where a gradient is not finite, unless a loss scaler (16-mixed) takes care of that."""
        if getattr(self.trainer.precision_plugin, "scaler", None) is not None:
            return
        grads = {name: p.grad for name, p in self.named_parameters() if p.grad is not None}
        norms = torch._foreach_norm(list(grads.values()))
        finite = torch.isfinite(torch.stack([norm.float() for norm in norms])) if norms else torch.ones(1)
        if not bool(finite.all()):
            bad = [n.removeprefix("model.") for n, ok in zip(grads, finite.tolist(), strict=True) if not ok]
            raise self._not_finite(f"the gradient of {bad[0]} and {len(bad) - 1} other weights is not finite")

    def _log_losses(self, losses: Mapping[str, Mapping[str, Tensor]], total: Tensor, size: int) -> None:
        terms = {f"loss/{name}/{term}": v.detach() for name, values in losses.items() for term, v in values.items()}
        if self.balance:
            terms |= {f"balance/{name}": weight for name, weight in self.balance.weights().items()}
        terms["learning_rate"] = torch.tensor(self.trainer.optimizers[0].param_groups[0]["lr"])
        self.log_dict(terms, batch_size=size)
        self.log("loss/total", total.detach(), batch_size=size, prog_bar=True)

    # evaluation

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Count the finished frames of a batch into the metrics."""
        self._seed(batch_idx)
        self.sample_ids = [meta.id for meta in batch.meta]
        results = self._finished(self.model.decode(self.model(batch), batch))
        if not self._idle:
            self._count(results)

    def _count(self, results: list[FrameResult]) -> None:
        self.model.update_metrics(results)
        if self.record is not None:
            self.record.add(results)

    @property
    def _idle(self) -> bool:
        """Whether this process evaluates a frame only to keep step with the others."""
        return bool(getattr(getattr(self.trainer, "datamodule", None), "idle", False))

    def _finished(self, results: list[FrameResult]) -> list[FrameResult]:
        """The frames that filters and tracker let out; a stream sees whole sequences in order."""
        if self._stream is None:
            return results
        return [done for result in results for done in self._stream.advance(result)]

    def on_validation_epoch_start(self) -> None:
        """Start counting."""
        for metric in self.model.metrics.values():
            metric.to(self.device)
        self.model.reset_metrics()
        self._stream = self.model.stream() if self.model.filters else None

    def on_validation_epoch_end(self) -> None:
        """Log all figures."""
        self._log_metrics("val")

    def _log_metrics(self, stage: str) -> None:
        if self._stream is not None and not self._idle:
            self._count(self._stream.flush())
        try:
            figures = {f"{stage}/{name}": value for name, value in self.model.compute_metrics().items()}
        except ConfigError as error:
            if not self._partial(stage):
                raise
            _say(f"no figures of a part of the {stage} data: {error}")
            return
        for name, value in figures.items():
            self.log(name, value, prog_bar=name == self.monitor, sync_dist=True)
        if not self.trainer.sanity_checking:
            self.figures = figures

    def _partial(self, stage: str) -> bool:
        """Whether only some batches were evaluated: they need not hold all that a metric compares, such as a map."""
        if self.trainer.sanity_checking:
            return True
        test = stage == "test"
        loader = self.trainer.test_dataloaders if test else self.trainer.val_dataloaders
        return sum(self.trainer.num_test_batches if test else self.trainer.num_val_batches) < len(loader or ())

    test_step = validation_step
    on_test_epoch_start = on_validation_epoch_start

    def on_test_epoch_end(self) -> None:
        """Log all figures."""
        self._log_metrics("test")

    # optimizer

    def configure_optimizers(self) -> Any:
        """Optimizer and scheduler of the config."""
        node = dict(self.optimizer_node)
        groups = parameter_groups(self.named_parameters(), node.pop("groups", None) or {})
        optimizer = _build("optimizer", node, groups)
        if not self.scheduler_node.get("_target_"):
            return optimizer
        return {"optimizer": optimizer, "lr_scheduler": self._scheduler(optimizer)}

    def _scheduler(self, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
        node = dict(self.scheduler_node)
        interval = node.pop("interval", "step")
        steps = self.trainer.estimated_stepping_batches
        known = {"max_lr": [group["lr"] for group in optimizer.param_groups], "total_steps": steps, "T_max": steps}
        factory = instantiate({**node, "_partial_": True})
        accepted = inspect.signature(factory.func).parameters
        filled = {name: value for name, value in known.items() if name in accepted and node.get(name) is None}
        if not math.isfinite(steps) and {"total_steps", "T_max"} & set(filled):
            raise ConfigError("this scheduler needs to know the length of the run.\n  fix: trainer.max_epochs=N")
        try:
            scheduler = _call("scheduler", factory, optimizer, **filled)
        except ZeroDivisionError as error:  # OneCycleLR where the rise is one step long
            raise ConfigError(
                f"scheduler: {factory.func.__name__} cannot divide a run of {steps} steps with these options.\n"
                "  fix: another scheduler.pct_start (that share of the steps may not be exactly one), "
                "or scheduler=constant"
            ) from error
        return {"scheduler": scheduler, "interval": interval, "monitor": self.monitor, "strict": False}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the description and the figures of the last validation."""
        checkpoint["lidarfw"] = {**self.about, "figures": self.figures}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that it is of this model, and know the figures of the last validation."""
        check_resumable(checkpoint, self)
        self.figures = dict(checkpoint["lidarfw"].get("figures", {}))


def check_resumable(content: Mapping[str, Any], module: PerceptionModule) -> None:
    """CheckpointError with what differs, unless a checkpoint was written by a run of this model on these classes."""
    about = checkpoint.description(content, "the checkpoint to resume from")
    report = checkpoint.compare(module, content["state_dict"])
    there, here = (spec["data_spec"]["classes"] for spec in (about, module.about))
    if there == here and not (report.missing or report.skipped or report.mismatched):
        return
    stored, own = (
        checkpoint.config_of(spec, "the checkpoint to resume from", allow_unregistered=True)  # only to be compared
        for spec in (about, module.about)
    )
    changes = [line for line in differences(stored, own) if line.startswith((*MODEL_KEYS, "dataset"))]
    raise CheckpointError(
        "cannot resume: the checkpoint is of another model.\n"
        + "".join(f"  {line}\n" for line in changes[:5])
        + f"{report}\n  fix: the same overrides as before, or start a new run from its weights, init={{from: PATH}}"
    )


def differences(there: Any, here: Any, key: str = "") -> list[str]:
    """What two configs do not have in common, as "head.center.width: 64 there, 32 here"."""
    if not (isinstance(there, dict) and isinstance(here, dict)):
        return [] if there == here else [f"{key}: {there} there, {here} here"]
    keys = list(dict.fromkeys([*there, *here]))
    return [d for k in keys for d in differences(there.get(k), here.get(k), f"{key}.{k}".lstrip("."))]


def parameter_groups(named: Iterable[tuple[str, nn.Parameter]], groups: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Optimizer groups by name pattern ("backbone.*": {lr: 1e-4}); the first pattern that fits counts.

    ConfigError for a pattern that fits no trainable parameter.
    """
    parameters = {name.removeprefix(checkpoint.PREFIX): p for name, p in named if p.requires_grad}
    found: dict[str, list[nn.Parameter]] = {pattern: [] for pattern in (*groups, "")}
    for name, parameter in parameters.items():
        pattern = next((pattern for pattern in groups if fnmatch.fnmatchcase(name, pattern)), "")
        found[pattern].append(parameter)
    for pattern in groups:
        if not found[pattern]:
            parts = sorted({".".join(name.split(".")[:2]) for name in parameters})
            raise ConfigError(
                f"optimizer.groups: no weight fits {pattern!r} (that no earlier pattern has).\n"
                f"  there are: {', '.join(parts)}"
            )
    return [{"params": members, **(groups.get(pattern) or {})} for pattern, members in found.items() if members]


def _build(key: str, node: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
    return _call(key, instantiate({**node, "_partial_": True}), *args, **kwargs)


def _call(key: str, factory: Any, *args: Any, **kwargs: Any) -> Any:
    try:
        return factory(*args, **kwargs)
    except (TypeError, ValueError) as error:
        options = ", ".join(inspect.signature(factory.func).parameters)
        raise ConfigError(f"{key}: {factory.func.__name__}: {error}\n  it takes: {options}") from error
    except MisconfigurationException as error:
        raise ConfigError(f"{key}: {error}") from error


# --- runs -----------------------------------------------------------------------------------------------------------


def train(config: DictConfig) -> dict[str, float]:
    """Train as the config says, in the run folder; the last logged figures.

    Raises LidarfwError for everything that a user can mend, SystemExit(143) after SIGTERM.
    """
    from lidarfw.assembly import build, plan

    _quieten()
    with Termination() as stop:
        folder = run_folder(config)
        wired = plan(config)
        for warning in wired.warnings:
            rank_zero_warn(warning)
        _seed_everything(config.seed)
        model = build(wired)
        _initialise(model, config.init)
        module = _module(model, to_plain(config), checkpoint.describe(wired))
        data = DataModule.from_config(config, ("train", "val"), streams=bool(model.filters))
        trainer = make_trainer(config, folder, [stop], validate="val" in data.datasets)
        if trainer.is_global_zero:
            write_text(folder / "config.yaml", yaml.safe_dump(wired.config, sort_keys=False, allow_unicode=True))
        return _fit(trainer, module, data, _resume_from(config.resume, folder))


def _quieten() -> None:
    """Leave out what Lightning says on every run and no user of lidarfw can act on."""
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    for text in (".*LeafSpec.*", ".*does not have many workers.*", ".*smaller than the logging interval.*"):
        warnings.filterwarnings("ignore", message=text)


def _seed_everything(seed: Any) -> None:
    if not isinstance(seed, int) or not 0 <= seed < 2**32:
        raise ConfigError(f"seed must be a whole number from 0 to 2**32 - 1, found {seed!r}")
    pl.seed_everything(seed, verbose=False)


def _module(model: PerceptionModel, config: Mapping[str, Any], about: Mapping[str, Any]) -> PerceptionModule:
    keys = ("optimizer", "scheduler", "balance", "seed")
    return PerceptionModule(model, about=about, **{key: config[key] for key in keys})


def _initialise(model: PerceptionModel, node: Any) -> None:
    if node is None:
        return
    unknown = sorted(set(node) - {"from", "only"})
    if unknown or not node.get("from"):
        raise ConfigError("init takes {from: model.ckpt, only: [backbone.NAME]}" + f", not {unknown}" * bool(unknown))
    report = checkpoint.initialise(model, node["from"], list(node.get("only") or ()))
    _say(f"weights of {node['from']}:\n{report}")


def _fit(trainer: pl.Trainer, module: PerceptionModule, data: DataModule, resume: Path | None) -> dict[str, float]:
    try:
        trainer.fit(module, datamodule=data, ckpt_path=resume, weights_only=True)
    except (torch.OutOfMemoryError, MemoryError) as error:
        raise _out_of_memory(error, module) from error
    except RuntimeError as error:
        told = data.failure(error)
        if told is None:
            raise
        raise told from error
    except MisconfigurationException as error:
        raise ConfigError(f"trainer: {error}") from error
    return {**module.figures, **{name: float(value) for name, value in trainer.callback_metrics.items()}}


def _out_of_memory(error: BaseException, module: PerceptionModule) -> TrainingError:
    first = str(error).splitlines()[0] if str(error) else type(error).__name__
    return TrainingError(
        f"out of memory at step {module.global_step}, samples {', '.join(module.sample_ids)}: {first}\n"
        "  fix: a smaller loader.batch_size with trainer.accumulate_grad_batches, trainer.precision=bf16-mixed,\n"
        "  or a smaller model; what was saved goes on with resume=auto"
    )


def run_folder(config: DictConfig) -> Path:
    """Where a run writes: Hydra's output folder, or `run_dir` of the config."""
    from hydra.core.hydra_config import HydraConfig

    if config.get("run_dir"):
        return Path(config.run_dir)
    if HydraConfig.initialized():
        return Path(HydraConfig.get().runtime.output_dir)
    return Path("runs") / str(config.get("name", "train"))


def _resume_from(resume: str | None, folder: Path) -> Path | None:
    last = folder / "checkpoints" / "last.ckpt"
    if resume is None:
        return None
    if resume != "auto":
        checkpoint.verify(resume)
        return Path(resume)
    if not last.exists():
        _say(f"resume=auto: no {last} yet, starting anew")
        return None
    return last


def make_trainer(
    config: DictConfig, folder: Path, callbacks: Sequence[pl.Callback] = (), validate: bool = True
) -> pl.Trainer:
    """The Lightning trainer of a config, with its loggers and callbacks."""
    node = to_plain(config.trainer)
    if any("SLURM" in str(plugin) for plugin in node.get("plugins") or ()) and "SLURM_NTASKS" not in os.environ:
        raise ConfigError("trainer=slurm runs inside a Slurm job only.\n  fix: srun lidarfw train ..., or trainer=ddp")
    loggers = [_logger(n, folder) for n in _nodes(config.logger)]
    listed = [_build("callbacks", n) for n in _nodes(config.callbacks)]
    for key, kind in (("enable_progress_bar", ProgressBar), ("enable_model_summary", ModelSummary)):
        listed = [callback for callback in listed if node.get(key, True) or not isinstance(callback, kind)]
    options: dict[str, Any] = {
        "default_root_dir": str(folder),
        "logger": loggers or False,
        "callbacks": [*listed, *callbacks],
        "plugins": [*(instantiate(n) for n in node.pop("plugins", None) or ()), checkpoint.AtomicCheckpointIO()],
        "use_distributed_sampler": False,  # the data module divides the frames itself
    }
    if not validate:
        options |= {"limit_val_batches": 0}
    for key in ("strategy", "profiler"):
        if isinstance(node.get(key), dict):
            options[key] = instantiate(node.pop(key))
    trainer: pl.Trainer = _build("trainer", node, **options)
    return trainer


def _nodes(group: DictConfig | None) -> list[dict[str, Any]]:
    return [node for node in (to_plain(group).values() if group else ()) if node]


def _logger(node: dict[str, Any], folder: Path) -> Any:
    factory = instantiate({**node, "_partial_": True})
    takes = "save_dir" in inspect.signature(factory.func).parameters and "save_dir" not in node
    return _call("logger", factory, **({"save_dir": str(folder)} if takes else {}))


# --- evaluation -----------------------------------------------------------------------------------------------------


def evaluate(
    path: str | Path,
    overrides: Sequence[str] = (),
    record: FrameRecord | None = None,
    *,
    allow_unregistered: bool = False,
) -> dict[str, float]:
    """Figures ("metric/key") of a checkpoint on the test split of its config.

    The model comes from the checkpoint; dataset, transforms, metric, loader, splits and trainer from its config too,
    changed by `overrides` (`dataset=kitti`, `dataset.kitti.root=/data`, `splits.test=val`, `trainer=gpu`). `record`
    is filled with what every frame adds to the metrics; it needs an evaluation in one process. `allow_unregistered` is
    that of `lidarfw.load`. Raises ConfigError for an override of what was learned, CheckpointError where the data is
    not what the model learned.
    """
    from lidarfw.assembly import build, plan

    _quieten()
    content = checkpoint.read(path)
    about = checkpoint.description(content, path)
    config = evaluation_config(checkpoint.config_of(about, path, allow_unregistered=allow_unregistered), overrides)
    wired = plan(checkpoint.without_start(to_plain(config)))
    _check_same_data(DataSpec.from_plain(about["data_spec"]), wired.data, path)
    _seed_everything(config.seed)
    model = build(wired)
    checkpoint.restore(model, content, path)
    module = _module(model, to_plain(config), about)
    if record is not None:
        record.start(model)
        module.record = record
    with Termination() as stop:
        trainer = make_trainer(config, Path(path).parent, [stop])
        if record is not None and trainer.world_size > 1:
            raise ConfigError("figures of single frames need an evaluation in one process.\n  fix: trainer.devices=1")
        data = DataModule.from_config(config, ("test",), streams=bool(model.filters))
        trainer.test(module, datamodule=data, verbose=False)
    return {name.removeprefix("test/"): float(value) for name, value in trainer.callback_metrics.items()}


def _check_same_data(learned: Any, offered: Any, path: str | Path) -> None:
    if learned.classes != offered.classes:
        raise CheckpointError(
            f"{path} was trained on the classes {', '.join(learned.classes)}, "
            f"this dataset has {', '.join(offered.classes)}.\n  fix: give the dataset the same, in the same order"
        )
    for name, spec in learned.inputs.items():
        there = offered.inputs.get(name)
        if there is None or (there.kind, there.channels) != (spec.kind, spec.channels):
            given = there or "no such input"
            raise CheckpointError(f"{path} was trained on {name}: {spec}, this dataset gives {given}")


__all__ = ["PerceptionModule", "UncertaintyBalance", "evaluate", "make_trainer", "train"]
