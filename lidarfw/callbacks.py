"""Callbacks and loggers of training that Lightning does not bring."""

from __future__ import annotations

import csv
import logging
import signal
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities import rank_zero_only, rank_zero_warn

from lidarfw.errors import ConfigError
from lidarfw.files import atomic_path
from lidarfw.types import collate

log = logging.getLogger(__name__)
TERMINATED = 143  # exit code of a process that ended on SIGTERM: 128 + 15


class Checkpoints(Checkpoint):
    """Writes `checkpoints/last.ckpt` and `checkpoints/best.ckpt` of a run.

    last.ckpt: every `every_n_steps` optimizer steps, before every validation, and at the end. It is only written
    where no gradient waits to be accumulated further, so a resumed run equals an uninterrupted one bit for bit.
    best.ckpt: after every validation whose `monitor` figure is the best so far. Higher is better for `mode: max`.
    """

    def __init__(self, *, every_n_steps: int = 500, monitor: str | None = None, mode: str = "max") -> None:
        self.every_n_steps = every_n_steps
        self.monitor = monitor  # default: what the model names, see PerceptionModel.monitor
        if mode not in ("max", "min"):
            raise ConfigError(f"callbacks.checkpoints.mode is {mode!r}; use max or min")
        self.sign = 1.0 if mode == "max" else -1.0
        self.best: float | None = None
        self.saved_at = 0  # global step of last.ckpt
        self.folder = Path("checkpoints")
        self._before_validation = False

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Find the folder; clear away what a killed process left half-written."""
        self.folder = Path(trainer.default_root_dir) / "checkpoints"
        self.monitor = self.monitor or getattr(pl_module, "monitor", None)
        if stage == "fit" and trainer.is_global_zero:
            for leftover in self.folder.glob(".*.ckpt"):
                leftover.unlink(missing_ok=True)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Count from where the run starts."""
        self.saved_at = trainer.global_step

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        """Save every n steps."""
        if self._due(trainer) and not pending_gradients(trainer) and not validation_follows(trainer):
            self.save_last(trainer)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save before a validation: it may take long, and a resumed run then starts with it."""
        if _in_training(trainer) and trainer.global_step > self.saved_at and not pending_gradients(trainer):
            self._before_validation = True
            self.save_last(trainer)
            self._before_validation = False

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the best."""
        figure = trainer.callback_metrics.get(self.monitor or "")
        if self.monitor and figure is None and not trainer.sanity_checking:
            names = ", ".join(name for name in trainer.callback_metrics if name.startswith("val/")) or "none"
            rank_zero_warn(f"no best.ckpt: there is no figure {self.monitor!r} to monitor.\n  there are: {names}")
        if not _in_training(trainer) or figure is None or torch.isnan(figure):
            return
        value = float(figure)
        if self.best is None or self.sign * value > self.sign * self.best:
            self.best = value
            trainer.save_checkpoint(self.folder / "best.ckpt", weights_only=False)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save after the last epoch."""
        if _ends(trainer):
            self.save_last(trainer)

    def save_last(self, trainer: pl.Trainer) -> None:
        """Write last.ckpt now."""
        self.saved_at = trainer.global_step
        if not trainer.fast_dev_run:  # type: ignore[attr-defined]
            trainer.save_checkpoint(self.folder / "last.ckpt", weights_only=False)

    def _due(self, trainer: pl.Trainer) -> bool:
        return trainer.global_step - self.saved_at >= self.every_n_steps

    def state_dict(self) -> dict[str, Any]:
        """The best figure so far."""
        return {"best": self.best, "monitor": self.monitor}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with the best figure, if it is still the same one."""
        if state_dict["monitor"] == self.monitor:
            self.best = state_dict["best"]

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Before a validation, note in Lightning's loop state that it is to run: as if its first batch had begun."""
        if not self._before_validation:
            return
        progress = checkpoint["loops"]["fit_loop"]["epoch_loop.val_loop.batch_progress"]
        progress["total"] = {"ready": 1, "started": 1, "processed": 0, "completed": 0}
        progress["current"] = {"ready": 0, "started": 0, "processed": 0, "completed": 0}
        progress["is_last_batch"] = False


class Termination(Checkpoint):
    """On SIGTERM, ends the run with exit code 143, after the optimizer step at hand and a last.ckpt of it.

    Outside of training (set-up, sanity check, test) it ends at once. A subclass of Checkpoint only so that Lightning
    runs it after the other callbacks.
    """

    def __init__(self) -> None:
        self.requested = False
        self._training = False
        self._before: Any = None

    def __enter__(self) -> Termination:
        """Listen from now on."""
        self._before = signal.getsignal(signal.SIGTERM)
        self._listen()
        return self

    def __exit__(self, *error: object) -> None:
        """Give the signal back to whom it belonged."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._before or signal.SIG_DFL)

    def _listen(self) -> None:
        if threading.current_thread() is threading.main_thread():  # Python allows it nowhere else
            signal.signal(signal.SIGTERM, self._receive)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        if not self._training:
            raise SystemExit(TERMINATED)

    def on_sanity_check_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Lightning has just put its own handler in, which ends with exit code 0: put ours back."""
        self._listen()

    def on_test_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Likewise."""
        self._listen()

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """From here on there is something to save."""
        self._listen()
        self._training = True

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        """Save and end, all processes at the same step. Before a validation, that saves by itself."""
        if not pending_gradients(trainer) and not validation_follows(trainer) and self._asked(trainer):
            self._save(trainer)
            raise SystemExit(TERMINATED)

    def on_validation_batch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        """End: last.ckpt was written right before the validation."""
        if self.requested:
            raise SystemExit(TERMINATED)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Everything is saved: from now on a signal ends the process at once."""
        self._training = False
        if self.requested:
            raise SystemExit(TERMINATED)

    def _asked(self, trainer: pl.Trainer) -> bool:
        return trainer.strategy.reduce_boolean_decision(self.requested, all=False)

    def _save(self, trainer: pl.Trainer) -> None:
        for callback in trainer.checkpoint_callbacks:
            if isinstance(callback, Checkpoints):
                callback.save_last(trainer)
                log.warning("SIGTERM: saved %s; go on with resume=auto", callback.folder / "last.ckpt")


def pending_gradients(trainer: pl.Trainer) -> bool:
    """Whether gradients of earlier batches wait for more (accumulate_grad_batches)."""
    return trainer.fit_loop._should_accumulate()


def validation_follows(trainer: pl.Trainer) -> bool:
    """Whether a validation comes after the batch that has just been trained on."""
    fetcher = trainer.fit_loop._data_fetcher
    return fetcher is not None and trainer.fit_loop.epoch_loop._should_check_val_fx(fetcher)


def _in_training(trainer: pl.Trainer) -> bool:
    return trainer.state.fn == "fit" and not trainer.sanity_checking


def _ends(trainer: pl.Trainer) -> bool:
    """Whether the epoch that ends now is the last one."""
    epochs, steps = trainer.max_epochs, trainer.max_steps
    last_epoch = epochs not in (None, -1) and trainer.current_epoch + 1 >= (epochs or 0)
    return last_epoch or trainer.should_stop or (steps != -1 and trainer.global_step >= steps)


class MetricsFile(Logger):
    """`metrics.csv`: a row for every time that something is logged, written at once.

    A resumed run goes on in the same file, from the step it resumed at.
    """

    def __init__(self, save_dir: str) -> None:
        super().__init__()
        self.path = Path(save_dir) / "metrics.csv"
        self._columns: list[str] = []

    @property
    def name(self) -> str:
        """Name of the logger."""
        return "metrics"

    @property
    def version(self) -> str:
        """There is one file per run."""
        return ""

    @rank_zero_only
    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """The config stands in config.yaml."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Add a row."""
        row = {"step": step or 0, **{name: float(value) for name, value in metrics.items()}}
        if not set(row) <= set(self._columns):
            rows = self._read() if self._columns else [old for old in self._read() if int(old["step"]) < row["step"]]
            names = {name: None for old in (*rows, row) for name in old}
            self._columns = list(dict.fromkeys([*self._columns, *names]))
            self._write(rows)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self._columns).writerow(row)

    def _read(self) -> list[dict[str, Any]]:
        if not self.path.exists():
            return []
        with self.path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    def _write(self, rows: list[dict[str, Any]]) -> None:
        with atomic_path(self.path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(rows)


class Freeze(pl.Callback):
    """Keeps parts of the model as they are: no gradients, no dropout, no new statistics of batch normalisation.

    `parts` are components by name, as in `init.only`: backbone.taco. ConfigError where the model has no such part.
    """

    def __init__(self, *, parts: Sequence[str]) -> None:
        self.parts = list(parts)
        self._modules: list[torch.nn.Module] = []

    def setup(self, trainer: pl.Trainer, pl_module: Any, stage: str) -> None:
        """Find the parts; the optimizer, which is made later, then leaves their weights out."""
        named = dict(pl_module.model.named_modules())
        unknown = [part for part in self.parts if part.count(".") != 1 or part not in named]
        if unknown or not self.parts:
            there = [name for name in named if name.count(".") == 1 and list(named[name].parameters())]
            wrong = f"this model has no {unknown[0]!r}" if unknown else "it is empty"
            raise ConfigError(f"callbacks.freeze.parts: {wrong}\n  fix: some of {', '.join(there)}")
        self._modules = [named[part] for part in self.parts]
        for module in self._modules:
            module.requires_grad_(False)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Into evaluation mode, to which Lightning returns after every validation."""
        for module in self._modules:
            module.eval()


class SettledNorms(pl.Callback):
    """After the last batch of a training, set the statistics of batch normalisation anew (`lidarfw.norms`).

    From the first `batches` batches of that epoch, before the last validation and checkpoint. For short trainings and
    small batches, whose running statistics lag behind the weights. On several processes each uses its own frames.
    """

    def __init__(self, batches: int = 50) -> None:
        self.batches = batches

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Settle them if the training is at its end."""
        if not trainer.is_last_batch or trainer.current_epoch + 1 != trainer.max_epochs:
            return
        from lidarfw.norms import settle_norms

        loader: Any = trainer.train_dataloader
        count = min(self.batches, len(loader))
        read = (loader.samples.__getitems__(loader.order.batch(place))[0] for place in range(count))
        settle_norms(pl_module.model, (collate(frames).to(pl_module.device) for frames in read if frames))
