"""Two processes on the CPU."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from training_runs import assert_same_weights, settings

from lidarfw import callbacks
from lidarfw.training import evaluate, train

TWO = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]
FORKED = [*TWO, "trainer.strategy=ddp_fork"]


def start(folder: Path, *overrides: str, **environment: str) -> subprocess.CompletedProcess:
    script = Path(__file__).with_name("ddp_run.py")
    variables = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    command = [sys.executable, str(script), str(folder), *TWO, *overrides]
    return subprocess.run(command, env=variables, capture_output=True, text=True, timeout=120, check=False)


def test_two_processes_see_every_frame_once_and_agree(tmp_path):
    figures = train(settings(tmp_path, *FORKED, "dataset.toy.frames=13"))
    assert figures["val/toy/frames"] == 13
    assert torch.load(tmp_path / "checkpoints/last.ckpt", weights_only=True)["global_step"] == 3 * 4
    alone = evaluate(tmp_path / "checkpoints/last.ckpt", ["trainer=cpu", "trainer.enable_progress_bar=false"])
    assert alone["toy/accuracy"] == pytest.approx(figures["val/toy/accuracy"])


@pytest.mark.parametrize(("frames", "overrides"), [(4, ["filter=delay"]), (1, []), (4, [])])
def test_a_process_may_have_nothing_to_evaluate(frames, overrides, tmp_path):
    """One sequence on one process for a model with a filter; fewer frames than processes."""
    figures = train(settings(tmp_path, *FORKED, f"dataset.toy.frames={frames}", "trainer.max_epochs=2", *overrides))
    assert figures["val/toy/frames"] == frames


def test_two_processes_resume_bit_for_bit(tmp_path, monkeypatch):
    save = callbacks.Checkpoints.save_last

    def save_and_keep(self, trainer):
        save(self, trainer)
        if trainer.is_global_zero:
            shutil.copy(self.folder / "last.ckpt", tmp_path / f"step{trainer.global_step}.ckpt")

    monkeypatch.setattr(callbacks.Checkpoints, "save_last", save_and_keep)
    overrides = [*FORKED, "callbacks.checkpoints.every_n_steps=1", "trainer.max_epochs=2", "dataset.toy.frames=16"]
    train(settings(tmp_path / "whole", *overrides))
    train(settings(tmp_path / "resumed", *overrides, f"resume={tmp_path / 'step6.ckpt'}"))  # the middle of epoch 1
    assert_same_weights(tmp_path / "whole", tmp_path / "resumed")


def test_a_process_that_fails_ends_the_run(tmp_path):
    done = start(tmp_path, LIDARFW_TEST_FAIL_AT="3")
    assert done.returncode != 0
    assert "process 1 fails" in done.stderr
    assert time.time() - (tmp_path / "failed").stat().st_mtime < 60
