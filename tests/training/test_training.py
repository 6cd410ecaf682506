"""What a run does: losses, metrics, streams, optimizers, balance, EMA, starting weights, and when it stops."""

import csv
import math
import os
import signal
import time

import pytest
import torch
import training_parts
from training_runs import assert_same_weights, settings, weights

import lidarfw
from lidarfw import registry
from lidarfw.errors import ConfigError, DataError, TrainingError
from lidarfw.training import PerceptionModule, UncertaintyBalance, parameter_groups

LONG = ["trainer.max_epochs=40", "transform=[]", "dataset.toy.frames=16", "loader.batch_size=8", "optimizer.lr=0.05",
        "backbone.toy.dropout=0", "backbone.toy.width=16", "trainer.check_val_every_n_epoch=8"]  # fmt: skip


def rows(folder) -> list[dict[str, float]]:
    with (folder / "metrics.csv").open() as file:
        return [{name: float(value) for name, value in row.items() if value} for row in csv.DictReader(file)]


def test_it_learns_and_writes_what_it_did(run, tmp_path):
    figures = run(tmp_path, *LONG, "splits.val=train")
    assert figures["val/toy/accuracy"] > 0.9
    assert figures["val/toy/frames"] == 16
    logged = [row["loss/total"] for row in rows(tmp_path) if "loss/total" in row]
    assert len(logged) == 40 * 2
    assert sum(logged[-4:]) < 0.4 * sum(logged[:4])
    first = rows(tmp_path)[0]
    assert first["loss/total"] == pytest.approx(first["loss/toy/center"] + first["loss/toy/class"])
    assert (tmp_path / "config.yaml").read_text().startswith("name: train")


def test_the_same_seed_gives_the_same_run(run, tmp_path):
    run(tmp_path / "a")
    run(tmp_path / "b")
    run(tmp_path / "c", "seed=2")
    assert_same_weights(tmp_path / "a", tmp_path / "b")
    assert not torch.equal(*(weights(tmp_path / n)["model.backbone.toy.layer.weight"] for n in "ac"))


def test_workers_do_not_change_the_run(run, tmp_path):
    run(tmp_path / "a", "trainer.max_epochs=1")
    run(tmp_path / "b", "trainer.max_epochs=1", "loader.workers=2")
    assert_same_weights(tmp_path / "a", tmp_path / "b")


def test_best_is_of_the_best_validation(run, tmp_path):
    run(tmp_path, *LONG, "splits.val=train")
    values = [row["val/toy/accuracy"] for row in rows(tmp_path) if "val/toy/accuracy" in row]
    steps = [row["step"] for row in rows(tmp_path) if "val/toy/accuracy" in row]
    best = torch.load(tmp_path / "checkpoints/best.ckpt", weights_only=True)
    assert best["global_step"] == steps[values.index(max(values))] + 1
    assert best["lidarfw"]["figures"]["val/toy/accuracy"] == pytest.approx(max(values))


def test_a_figure_that_should_be_small(run, tmp_path):
    run(
        tmp_path,
        *LONG,
        "splits.val=train",
        "callbacks.checkpoints.monitor=loss/total",
        "callbacks.checkpoints.mode=min",
    )
    losses = {row["step"]: row["loss/total"] for row in rows(tmp_path) if "loss/total" in row}
    at_validation = {row["step"]: losses[row["step"]] for row in rows(tmp_path) if "val/toy/accuracy" in row}
    best = torch.load(tmp_path / "checkpoints/best.ckpt", weights_only=True)
    assert len(at_validation) == 5
    assert best["global_step"] == min(at_validation, key=at_validation.get) + 1


def test_a_figure_that_is_not_there_is_said(run, tmp_path):
    with pytest.warns(UserWarning, match=r"no best.ckpt: there is no figure 'val/nope' .*\n.*val/toy/accuracy"):
        run(tmp_path, "trainer.max_epochs=1", "callbacks.checkpoints.monitor=val/nope")
    assert not (tmp_path / "checkpoints/best.ckpt").exists()


def test_filters_that_hold_frames_back_lose_none(run, tmp_path):
    plain = run(tmp_path / "plain", "trainer.max_epochs=1")
    delayed = run(tmp_path / "delayed", "trainer.max_epochs=1", "filter=delay", "loader.batch_size=5")
    assert delayed["val/toy/frames"] == plain["val/toy/frames"] == 12


def test_no_loss_weight_at_all(run, tmp_path):
    with pytest.raises(TrainingError, match="no loss to train on"):
        run(tmp_path, "loss=toy", "loss.toy.weight=0")


def test_ramp_grows_with_the_run(run, tmp_path):
    run(tmp_path, "loss=toy", "loss.toy.ramp=1.0", "optimizer.lr=1e-9", "backbone.toy.dropout=0", "transform=[]")
    totals = [row["loss/total"] for row in rows(tmp_path) if "loss/total" in row]
    assert len(totals) == 18
    assert totals[0] == pytest.approx(totals[-1] / 18, rel=0.7)
    assert totals[0] < totals[8] / 3


# --- stopping


@pytest.mark.parametrize("step", [0, 7])
def test_a_loss_that_is_not_finite_stops_before_the_step(step, tmp_path, run, monkeypatch):
    seen = []
    forward = training_parts.ToyLoss.forward

    def poisoned(self, toy: training_parts.ToyOutput, targets: training_parts.Targets):
        seen.append(None)
        terms = forward(self, toy, targets)
        return {**terms, "center": terms["center"] * math.nan} if len(seen) == step + 1 else terms

    modules = []
    init = PerceptionModule.__init__
    monkeypatch.setattr(
        PerceptionModule, "__init__", lambda self, *a, **k: (modules.append(self), init(self, *a, **k))[1]
    )
    monkeypatch.setattr(training_parts.ToyLoss, "forward", poisoned)
    with pytest.raises(TrainingError) as error:
        run(tmp_path, "callbacks.checkpoints.every_n_steps=1")
    message = str(error.value)
    assert f"loss toy/center is nan at step {step} (epoch {step // 6}), samples train0" in message
    assert "weights are those of the step before" in message
    assert len(message.splitlines()) <= 10
    assert modules[0].global_step == step
    assert all(torch.isfinite(p).all() for p in modules[0].parameters())
    if step:
        assert all(torch.isfinite(value).all() for value in weights(tmp_path).values())


def test_a_gradient_that_is_not_finite_stops_before_the_step(run, tmp_path, monkeypatch):
    class Spoil(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, grad):
            return grad * math.inf

    forward = training_parts.ToyLoss.forward

    def spoiled(self, toy: training_parts.ToyOutput, targets: training_parts.Targets):
        return {name: Spoil.apply(term) for name, term in forward(self, toy, targets).items()}

    monkeypatch.setattr(training_parts.ToyLoss, "forward", spoiled)
    with pytest.raises(TrainingError, match=r"gradient of backbone\.toy\.layer\.weight and \d+ other weights"):
        run(tmp_path)


def test_a_broken_input_is_named(run, tmp_path):
    with pytest.raises(TrainingError, match=r"loss toy/center is nan, toy/class is nan .* train003"):
        run(tmp_path, "dataset.toy.poison=3", "splits.val=null")


def test_a_worker_that_dies_while_the_model_works(run, tmp_path, monkeypatch):
    step = PerceptionModule.training_step

    def kill_worker(self, batch, batch_idx):
        loader = self.trainer.datamodule._train_loader
        os.kill(loader._iterator._workers[0].pid, signal.SIGKILL)
        time.sleep(1)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(PerceptionModule, "training_step", kill_worker)
    with pytest.raises(
        DataError, match=r"worker died: DataLoader worker .* (is killed by signal|exited unexpectedly)"
    ) as error:
        run(tmp_path, "loader.workers=1")
    assert "the batch that was waited for: train" in str(error.value)


def test_out_of_memory_says_what_to_do(run, tmp_path, monkeypatch):
    def exhausted(self, toy: training_parts.ToyOutput, targets: training_parts.Targets):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")

    monkeypatch.setattr(training_parts.ToyLoss, "forward", exhausted)
    with pytest.raises(TrainingError, match=r"out of memory at step 0, samples train0.*20\.00 GiB") as error:
        run(tmp_path)
    assert "loader.batch_size" in str(error.value)


def test_a_folder_that_cannot_be_written(run, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(lidarfw.errors.LidarfwError, match="file"):
        run(tmp_path / "file" / "run")


# --- optimizers


def model() -> torch.nn.Module:
    from lidarfw.assembly import build, plan

    return build(plan(settings("unused")))


def test_groups_by_name():
    named = [(f"model.{name}", p) for name, p in model().named_parameters()]
    groups = parameter_groups(named, {"backbone.*": {"lr": 1e-4}, "*.bias": {"weight_decay": 0}})
    assert [{k: v for k, v in group.items() if k != "params"} for group in groups] == [
        {"lr": 1e-4}, {"weight_decay": 0}, {}
    ]  # fmt: skip
    assert [len(group["params"]) for group in groups] == [4, 2, 2]  # the first pattern that fits counts


def test_a_group_that_fits_nothing_lists_the_names():
    with pytest.raises(ConfigError, match=r"'neck\.\*'") as error:
        parameter_groups([(f"model.{n}", p) for n, p in model().named_parameters()], {"neck.*": {"lr": 1}})
    assert "backbone.toy, head.toy" in str(error.value)


def test_one_cycle_peaks_at_the_rate_of_each_group(run, tmp_path, monkeypatch):
    rates = []
    step = PerceptionModule.training_step

    def watch(self, batch, batch_idx):
        rates.append([group["lr"] for group in self.trainer.optimizers[0].param_groups])
        return step(self, batch, batch_idx)

    monkeypatch.setattr(PerceptionModule, "training_step", watch)
    run(tmp_path, "optimizer.groups={backbone.*: {lr: 0.001}}", "scheduler.pct_start=0.5")
    peaks = [max(rate) for rate in zip(*rates, strict=True)]
    assert peaks == pytest.approx([0.001, 0.01], rel=0.05)
    assert rates[0] == pytest.approx([0.0001, 0.001])
    assert rates[-1][1] < 1e-4
    assert len(rates) == 18


@pytest.mark.parametrize(
    "overrides",
    [["scheduler=cosine"], ["scheduler=constant"], ["scheduler=multistep"], ["optimizer=sgd"], ["optimizer=adam"],
     ["trainer.precision=bf16-mixed"], ["trainer.overfit_batches=2"], ["trainer.fast_dev_run=true"],
     ["callbacks=none"], ["logger=none"], ["logger=default"], ["debug=fast"], ["debug=overfit", "trainer.max_epochs=2"],
     ["debug=profile", "trainer.max_steps=2"], ["trainer.detect_anomaly=true"]],
    ids=" ".join,
)  # fmt: skip
def test_choices_of_the_configs_train(overrides, run, tmp_path):
    figures = run(tmp_path, "trainer.max_epochs=1", *overrides)
    assert math.isfinite(figures["loss/total"])


def test_overfitting_repeats_the_same_batches(run, tmp_path, monkeypatch):
    seen = []
    step = PerceptionModule.training_step

    def watch(self, batch, batch_idx):
        seen.append([meta.id for meta in batch.meta])
        return step(self, batch, batch_idx)

    monkeypatch.setattr(PerceptionModule, "training_step", watch)
    run(tmp_path, "trainer.overfit_batches=2")
    assert len(seen) == 6
    assert seen[:2] == seen[2:4] == seen[4:]


@pytest.mark.parametrize(
    ("override", "text"),
    [("+optimizer.speed=3", "optimizer: AdamW: .*speed"),
     ("optimizer.lr=-1", "optimizer: AdamW: Invalid learning rate"),
     ("+scheduler.foo=1", "scheduler: OneCycleLR: .*foo"), ("trainer.devices=-5", "trainer: "),
     ("balance=magic", "balance is 'magic'"), ("init={to: x}", "init takes"),
     ("trainer.max_epochs=-1", "fix: trainer.max_epochs=N"), ("seed=abc", "seed must be a whole number .* 'abc'"),
     ("callbacks.checkpoints.mode=minimum", "mode is 'minimum'; use max or min")],
)  # fmt: skip
def test_wrong_settings(override, text, run, tmp_path):
    with pytest.raises(ConfigError, match=text):
        run(tmp_path, override)


def test_a_cycle_that_rises_for_one_step(run, tmp_path):
    with pytest.raises(ConfigError, match=r"cannot divide a run of 2 steps(.|\n)*another scheduler.pct_start"):
        run(tmp_path, "trainer.max_steps=2", "scheduler.pct_start=0.5")


def test_slurm_outside_of_a_job(run, tmp_path, monkeypatch):
    monkeypatch.delenv("SLURM_NTASKS", raising=False)
    with pytest.raises(ConfigError, match="inside a Slurm job only"):
        run(tmp_path, "trainer=slurm")


def test_an_optimizer_from_elsewhere_is_refused(run, tmp_path):
    with pytest.raises(ConfigError, match="not allowed"):
        run(tmp_path, "optimizer._target_=os.system")


# --- balance


def test_uncertainty_is_the_formula_of_the_paper():
    balance = UncertaintyBalance(["a", "b", "unused"])
    with torch.no_grad():
        balance.log_variance["a"].fill_(math.log(4.0))
    total = balance({"a": torch.tensor(8.0), "b": torch.tensor(3.0)})
    # sigma_a^2 = 4: 8 / (2 * 4) + log 2; sigma_b^2 = 1: 3 / 2 + 0
    assert float(total.detach()) == pytest.approx(1 + math.log(2) + 1.5)
    total.backward()
    assert all(p.grad is not None for p in balance.parameters())
    assert balance.weights()["a"] == pytest.approx(0.125)


def test_uncertainty_learns_its_weights(run, tmp_path):
    run(tmp_path, *LONG, "balance=uncertainty")
    learned = weights(tmp_path)["balance.log_variance.toy"]
    assert float(learned) != 0
    lidarfw.load(tmp_path / "checkpoints/last.ckpt")  # its parameters are no part of the model


# --- average and start


def test_frozen_parts_stay_as_they_are(run, tmp_path):
    run(tmp_path / "first", "trainer.max_epochs=1")
    start = f"init={{from: {tmp_path / 'first/checkpoints/last.ckpt'}, only: [backbone.toy]}}"
    frozen = ["callbacks=freeze", "callbacks.freeze.parts=[backbone.toy]"]
    settled = "+callbacks.settled={_target_: lidarfw.callbacks.SettledNorms}"
    run(tmp_path / "second", start, *frozen, settled, "trainer.val_check_interval=2", "trainer.num_sanity_val_steps=1")
    before, after = weights(tmp_path / "first"), weights(tmp_path / "second")
    same = {name for name in before if torch.equal(before[name], after[name])}
    assert same == {name for name in before if name.startswith("model.backbone.toy.")}
    assert {name.rsplit(".", 1)[1] for name in same} >= {"weight", "running_mean", "running_var"}


def test_frozen_parts_have_no_dropout(run, tmp_path, monkeypatch):
    step, modes = PerceptionModule.training_step, []

    def watch(self, batch, batch_idx):
        modes.append((self.model.backbone["toy"].dropout.training, self.model.head["toy"].training))
        return step(self, batch, batch_idx)

    monkeypatch.setattr(PerceptionModule, "training_step", watch)
    frozen = ["callbacks=freeze", "callbacks.freeze.parts=[backbone.toy]", "scheduler=constant"]
    run(tmp_path, *frozen, "trainer.val_check_interval=2", "trainer.num_sanity_val_steps=1")
    assert set(modes) == {(False, True)}
    run(tmp_path, *frozen, "trainer.max_epochs=4", "resume=auto")
    assert set(modes) == {(False, True)}


@pytest.mark.parametrize(("parts", "wrong"), [("[backbone.second]", "no 'backbone.second'"), ("[]", "it is empty")])
def test_only_parts_of_the_model_can_be_frozen(parts, wrong, run, tmp_path):
    with pytest.raises(ConfigError, match=rf"{wrong}\n  fix: some of backbone.toy, head.toy"):
        run(tmp_path, "callbacks=freeze", f"callbacks.freeze.parts={parts}")


def test_ema_is_the_average_and_what_load_gives(run, tmp_path):
    run(tmp_path, "callbacks=ema", "callbacks.ema.decay=0.5", "trainer.max_epochs=1", "scheduler=constant",
        "callbacks.checkpoints.every_n_steps=1", "splits.val=null", "trainer.max_steps=2")  # fmt: skip
    two = torch.load(tmp_path / "checkpoints/last.ckpt", weights_only=True)
    run(tmp_path / "one", "callbacks=ema", "trainer.max_epochs=1", "scheduler=constant", "splits.val=null",
        "trainer.max_steps=1")  # fmt: skip
    one = torch.load(tmp_path / "one/checkpoints/last.ckpt", weights_only=True)
    name = "model.head.toy.center.weight"
    expected = 0.5 * one["current_model_state"][name] + 0.5 * two["current_model_state"][name]
    assert torch.allclose(two["state_dict"][name], expected)
    loaded = lidarfw.load(tmp_path / "checkpoints/last.ckpt")
    assert torch.equal(loaded.head["toy"].center.weight, two["state_dict"][name])


def test_start_from_other_weights(run, tmp_path, caplog):
    run(tmp_path / "first")
    source = tmp_path / "first/checkpoints/last.ckpt"
    with caplog.at_level("INFO"):
        run(tmp_path / "second", f"init={{from: {source}, only: [backbone.toy]}}", "trainer.fast_dev_run=true",
            "optimizer.lr=1e-12")  # fmt: skip
    assert "loaded 7 weights" in caplog.text
    assert "not loaded: 4 (head.toy.center.weight" in caplog.text


def test_start_from_a_model_of_other_width(run, tmp_path, caplog):
    run(tmp_path / "first", "dataset.toy.classes=[a,b,c]")
    source = tmp_path / "first/checkpoints/last.ckpt"
    with caplog.at_level("INFO"):
        run(tmp_path / "second", f"init={{from: {source}}}", "trainer.max_epochs=1")
    assert "loaded 9 weights" in caplog.text
    assert "other shape: 2 (head.toy.label.weight (3, 8) there, (2, 8) here" in caplog.text


@pytest.mark.parametrize(("part", "text"), [("backbone.taco", "has no 'backbone.taco'"), ("neck", "has no 'neck'")])
def test_start_from_a_part_that_is_not_there(part, text, run, tmp_path):
    run(tmp_path / "first", "trainer.max_epochs=1")
    source = tmp_path / "first/checkpoints/last.ckpt"
    with pytest.raises(ConfigError, match=text) as error:
        run(tmp_path / "second", f"init={{from: {source}, only: [{part}]}}")
    assert "backbone.toy, head.toy" in str(error.value)


def test_several_losses_are_logged_by_name(run, tmp_path):
    with registry.use(loss={"second": training_parts.ToyLoss}):
        figures = run(tmp_path, "loss=[toy,second]", "loss.second.weight=0.5", "trainer.max_epochs=1")
    assert figures["loss/second/center"] == pytest.approx(0.5 * figures["loss/toy/center"])
