"""An interrupted run that goes on ends with the weights of an uninterrupted one, bit for bit."""

import shutil
import signal
import time
from pathlib import Path

import pytest
import torch
from training_runs import Child, assert_same_weights, settings

import lidarfw
from lidarfw import callbacks
from lidarfw.errors import CheckpointError
from lidarfw.training import train

EVERY_STEP = "callbacks.checkpoints.every_n_steps=1"
CASES = {
    "epochs": [],
    "steps": ["trainer.max_epochs=-1", "trainer.max_steps=9"],
    "no_validation": ["splits.val=null"],
    "accumulate": ["trainer.accumulate_grad_batches=4", "dataset.toy.frames=20"],
    "validation_mid_epoch": ["trainer.val_check_interval=0.5"],
    "ema": ["callbacks=ema"],
    "clips": ["loader.clip=2", "balance=uncertainty"],
}


def read(path: Path) -> dict:
    return torch.load(path, weights_only=True)


@pytest.fixture
def kept(monkeypatch, tmp_path) -> list[Path]:
    """Copies of every last.ckpt that is written."""
    found: list[Path] = []
    save = callbacks.Checkpoints.save_last

    def save_and_keep(self, trainer):
        save(self, trainer)
        copy = tmp_path / f"kept{len(found)}.ckpt"
        shutil.copy(self.folder / "last.ckpt", copy)
        found.append(copy)

    monkeypatch.setattr(callbacks.Checkpoints, "save_last", save_and_keep)
    return found


@pytest.mark.parametrize("case", CASES)
def test_every_save_point(case, run, kept, tmp_path):
    overrides = [*CASES[case], EVERY_STEP, "trainer.max_epochs=2"][: None if case != "steps" else -1]
    figures = run(tmp_path / "whole", *overrides)
    whole = read(tmp_path / "whole/checkpoints/last.ckpt")
    points = [point for point in kept if read(point)["global_step"] < whole["global_step"]]
    assert len(points) >= 4
    for number, point in enumerate((points[len(points) // 2], points[-1])):
        folder = tmp_path / str(number)
        resumed = run(folder, *overrides, f"resume={point}")
        assert_same_weights(tmp_path / "whole", folder)
        last = read(folder / "checkpoints/last.ckpt")
        assert last["global_step"] == whole["global_step"]
        for a, b in zip(last["optimizer_states"][0]["state"].values(), whole["optimizer_states"][0]["state"].values()):
            assert torch.equal(a["exp_avg_sq"], b["exp_avg_sq"])
        assert resumed == figures


def test_best_survives(run, kept, tmp_path):
    """A run that goes on does not take a worse validation for the best one."""
    run(tmp_path, EVERY_STEP)
    last = read(tmp_path / "checkpoints/last.ckpt")
    state = next(value for key, value in last["callbacks"].items() if key.startswith("Checkpoints"))
    best = read(tmp_path / "checkpoints/best.ckpt")["lidarfw"]["figures"]["val/toy/accuracy"]
    assert state["best"] == pytest.approx(best)
    before = (tmp_path / "checkpoints/best.ckpt").read_bytes()
    run(tmp_path, EVERY_STEP, f"resume={kept[-3]}")
    assert (tmp_path / "checkpoints/best.ckpt").read_bytes() == before


def slow(folder: Path, *overrides: str) -> None:
    """A run that takes a moment per step, so that it can be hit in its middle."""
    step = lidarfw.training.PerceptionModule.training_step

    def training_step(self, batch, batch_idx):
        time.sleep(0.03)
        return step(self, batch, batch_idx)

    lidarfw.training.PerceptionModule.training_step = training_step
    train(settings(folder, *overrides))


def wait_for_step(folder: Path, step: int, child: Child) -> None:
    """Wait until last.ckpt is of at least that step."""
    for _ in range(3000):
        path = folder / "checkpoints/last.ckpt"
        if path.exists() and read(path)["global_step"] >= step:
            return
        assert child.process.is_alive(), "the run ended too early"
        time.sleep(0.02)
    pytest.fail("no checkpoint came")


@pytest.mark.parametrize("workers", [0, 2])
def test_killed_twice(workers, run, tmp_path):
    overrides = [f"loader.workers={workers}", "callbacks.checkpoints.every_n_steps=3"]
    run(tmp_path / "whole", *overrides)
    killed = tmp_path / "killed"
    for step in (3, 9):
        child = Child(slow, killed, *overrides, "resume=auto")
        wait_for_step(killed, step, child)
        child.signal(signal.SIGKILL)
        assert child.wait() == -signal.SIGKILL
    run(killed, *overrides, "resume=auto")
    assert_same_weights(tmp_path / "whole", killed)
    lines = (killed / "metrics.csv").read_text().splitlines()
    assert lines == (tmp_path / "whole/metrics.csv").read_text().splitlines()


def test_sigterm_saves_and_says_143(run, tmp_path):
    overrides = ["callbacks.checkpoints.every_n_steps=4", "trainer.max_epochs=4", "trainer.accumulate_grad_batches=2"]
    run(tmp_path / "whole", *overrides)
    stopped = tmp_path / "stopped"
    child = Child(slow, stopped, *overrides)
    wait_for_step(stopped, 3, child)
    time.sleep(0.1)
    child.signal(signal.SIGTERM)
    assert child.wait() == 143
    lidarfw.load(stopped / "checkpoints/last.ckpt")
    run(stopped, *overrides, "resume=auto")
    assert_same_weights(tmp_path / "whole", stopped)


def stop_in_validation(folder: Path, *overrides: str) -> None:
    import os

    update = lidarfw.model.PerceptionModel.update_metrics

    def update_metrics(self, results):
        os.kill(os.getpid(), signal.SIGTERM)
        update(self, results)

    lidarfw.model.PerceptionModel.update_metrics = update_metrics
    train(settings(folder, *overrides))


def test_sigterm_in_validation_repeats_the_validation(run, tmp_path):
    whole = run(tmp_path / "whole", "trainer.max_epochs=1")
    child = Child(stop_in_validation, tmp_path / "stopped", "trainer.max_epochs=1")
    assert child.wait() == 143
    assert read(tmp_path / "stopped/checkpoints/last.ckpt")["global_step"] == 6
    resumed = run(tmp_path / "stopped", "trainer.max_epochs=1", "resume=auto")
    assert resumed["val/toy/frames"] == whole["val/toy/frames"] == 12
    assert_same_weights(tmp_path / "whole", tmp_path / "stopped")


def stop_in_setup(folder: Path) -> None:
    import os

    lidarfw.data.DataModule.prepare_data = lambda self: os.kill(os.getpid(), signal.SIGTERM)
    train(settings(folder))


def test_sigterm_before_training_ends_at_once(tmp_path):
    assert Child(stop_in_setup, tmp_path).wait() == 143
    assert not (tmp_path / "checkpoints/last.ckpt").exists()


def test_the_signal_is_given_back(run, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    run(tmp_path, "trainer.max_epochs=1")
    assert signal.getsignal(signal.SIGTERM) is before


def test_auto_without_a_checkpoint_starts_anew(run, tmp_path):
    run(tmp_path / "auto", "trainer.max_epochs=1", "resume=auto")
    run(tmp_path / "plain", "trainer.max_epochs=1")
    assert_same_weights(tmp_path / "auto", tmp_path / "plain")


def test_a_finished_run_stays_finished(run, tmp_path):
    first = run(tmp_path)
    before = read(tmp_path / "checkpoints/last.ckpt")["global_step"]
    again = run(tmp_path, "resume=auto")
    assert read(tmp_path / "checkpoints/last.ckpt")["global_step"] == before
    assert again["val/toy/accuracy"] == first["val/toy/accuracy"]


def test_resume_with_other_batches_is_refused(run, kept, tmp_path):
    run(tmp_path, EVERY_STEP, "trainer.max_epochs=1")
    with pytest.raises(CheckpointError, match="batches = 6, this run has 4"):
        run(tmp_path / "other", "loader.batch_size=3", f"resume={kept[1]}")


def test_leftovers_of_a_killed_save_are_cleared(run, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    leftover = tmp_path / "checkpoints/.0123456789abcdef.ckpt"
    leftover.write_bytes(b"half")
    run(tmp_path, "trainer.max_epochs=1")
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]


@pytest.mark.parametrize(
    ("override", "text"),
    [("backbone.toy.width=16", "backbone.toy.width: 8 there, 16 here"),
     ("dataset.toy.classes=[b,a]", r"dataset.toy.classes: \['a', 'b'\] there, \['b', 'a'\] here"),
     ("balance=uncertainty", "balance: fixed there, uncertainty here")],
)  # fmt: skip
def test_resuming_another_model_is_refused_with_what_differs(override, text, run, tmp_path):
    run(tmp_path, "trainer.max_epochs=1")
    with pytest.raises(CheckpointError, match=text):
        run(tmp_path, override, "resume=auto")


def test_resuming_a_foreign_checkpoint_is_refused(run, tmp_path):
    torch.save({"state_dict": {}, "pytorch-lightning_version": "2.6.6"}, tmp_path / "foreign.ckpt")
    with pytest.raises(CheckpointError, match="no key 'lidarfw'"):
        run(tmp_path, f"resume={tmp_path / 'foreign.ckpt'}")
