"""Claims: the file, the runs, the verdicts and the table, with real runs of the tiny detector."""

import json
import multiprocessing
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import training_parts
from training_runs import assert_same_weights

from lidarfw.assembly import plan
from lidarfw.claims import judging, reading, reporting, running
from lidarfw.claims.reading import Claim, Run
from lidarfw.cli import main
from lidarfw.config import compose
from lidarfw.errors import ConfigError, DataError
from lidarfw.evaluation import evaluation_config
from lidarfw.resampling import draws

TRAINED = Run("trained", ())
UNTRAINED = Run("untrained", ())
CLAIMS = """
paper: A. Nybody, "Training helps", 2026
overrides: {overrides}
seeds: [1, 2]
resamples: 60
block: 4
runs:
  trained: []
  same: ["name=another"]
  untrained: [optimizer.lr=1e-7]
  delayed: {{overrides: [], eval: [filter=delay]}}
claims:
  training:
    claim: Training helps
    source: "Table 1: 0.5 -> 0.9"
    baseline: untrained
    variant: trained
    metric: toy/accuracy
    better: higher
  delaying:
    claim: Another name and a delay are worse
    baseline: same
    variant: delayed
    metric: toy/accuracy
    better: lower
  forgetting:
    claim: Training hurts
    baseline: trained
    variant: untrained
    metric: toy/accuracy
    better: higher
    long: true
"""


def test_the_file_of_the_documentation_is_accepted(tmp_path):
    pytest.importorskip("lidarfw_town")
    text = (Path(__file__).parents[2] / "docs/claims.md").read_text().partition("```yaml\n")[2].partition("```")[0]
    (tmp_path / "claims.yaml").write_text(text)
    stated = reading.read(tmp_path / "claims.yaml")
    for run in {run.name: run for claim in stated.claims for run in claim.runs}.values():
        assert evaluation_config(plan(compose(list(run.overrides))).config, run.evaluation)


class Forked:
    """`lidarfw ARGUMENTS` in a fork of this process, which knows the tiny detector."""

    def __init__(self, arguments, log, threads, lock) -> None:
        self.process = multiprocessing.get_context("fork").Process(target=self._main, args=(arguments, log))
        self.process.start()

    @staticmethod
    def _main(arguments, log) -> None:
        with Path(log).open("a") as sys.stdout:
            sys.stderr = sys.stdout
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            try:
                code = main(arguments)
            except SystemExit as error:
                code = error.code
        os._exit(code if isinstance(code, int) else 1)

    def poll(self):
        return self.process.exitcode

    def terminate(self) -> None:
        self.process.terminate()

    def kill(self) -> None:
        self.process.kill()

    def wait(self, timeout=None) -> int:
        self.process.join(timeout)
        return self.process.exitcode


class Counted:
    """Starts forks and remembers what was asked for."""

    def __init__(self) -> None:
        self.started = []

    def __call__(self, arguments, log, threads, lock) -> Forked:
        self.started.append(arguments)
        return Forked(arguments, log, threads, lock)

    def of(self, command: str) -> int:
        return sum(arguments[0] == command for arguments in self.started)


@pytest.fixture
def start(monkeypatch) -> Counted:
    counted = Counted()
    monkeypatch.setattr(running, "start_process", counted)
    return counted


@pytest.fixture
def file(tmp_path) -> Path:
    overrides = [*training_parts.OVERRIDES, "dataset.toy.frames=24", "callbacks.checkpoints.every_n_steps=2"]
    path = tmp_path / "toy" / "claims.yaml"
    path.parent.mkdir()
    path.write_text(CLAIMS.format(overrides=json.dumps(overrides)))
    return path


def table_of(folder: Path) -> dict[str, str]:
    """The last cell of each row of the verdict table, by its first."""
    rows = [line.split("|") for line in (folder / "toy.md").read_text().splitlines() if line.startswith("| ")]
    return {row[1].strip(): row[-2].strip() for row in rows}


# --- from the file to the table


def test_effects_are_found_and_nothing_runs_twice(file, tmp_path, start, capsys):
    out = tmp_path / "results"
    arguments = ["claims", str(file), "-o", str(out), "--runs", str(tmp_path / "runs")]
    assert main(arguments) == 0
    verdicts = table_of(out)
    assert verdicts["Training helps"] == "**supported**"
    assert verdicts["Another name and a delay are worse"] == "**neutral**"
    assert verdicts["Training hurts"].startswith("**contradicted** (long")  # its runs are those of the first claim
    # trained, same and delayed are one training; same and trained one evaluation
    assert (start.of("train"), start.of("eval")) == (2 * 2, 3 * 2)

    figures = {entry["name"]: entry for entry in json.loads((out / "toy.json").read_text())["claims"]}
    outcome = figures["training"]["outcome"]
    assert outcome["low"] > 0
    assert outcome["difference"] == pytest.approx(np.mean(list(outcome["per_seed"].values())))
    assert {run["seed"] for run in figures["training"]["runs"]} == {1, 2}
    assert all(run["seconds"] > 0 and run["frames"] == 24 for run in figures["training"]["runs"])
    assert (out / "toy.png").read_bytes().startswith(b"\x89PNG")
    assert 'A. Nybody, "Training helps"' in (out / "toy.md").read_text()

    made = {(run["training"], run["seed"]): run["seconds"] for entry in figures.values() for run in entry["runs"]}
    assert len(made) == 2 * 2
    assert reporting.spent(list(figures.values())) == pytest.approx(sum(made.values()))

    before = len(start.started)
    assert main(arguments) == 0
    assert len(start.started) == before
    assert table_of(out) == verdicts

    # without the runs, what was recorded stays; a claim that was changed since is not run
    file.write_text(file.read_text().replace("claim: Training helps", "claim: Training does help"))
    assert main([*arguments[:-1], str(tmp_path / "elsewhere"), "--minutes", "0"]) == 0
    later = table_of(out)
    assert (later["Training does help"], later["Another name and a delay are worse"]) == ("not run", "**neutral**")
    assert "4 of 4 runs are left" in capsys.readouterr().err


def test_a_run_that_was_stopped_or_killed_goes_on(file, tmp_path, start):
    stated = reading.read(file, ["trainer.max_epochs=8"])
    claims = [replace(stated.claims[0], baseline=0.5, seeds=(1,))]
    whole = running.Work(stated, claims, tmp_path / "whole")
    running.Runner(whole).run()
    assert not whole.left
    work = running.Work(stated, claims, tmp_path / "runs")

    class Stops:
        """Ends the runner (Ctrl-C), or kills the process, once there is a checkpoint of it."""

        def __init__(self, kill: bool) -> None:
            self.kill, self.stopped = kill, []

        def update(self, active, done) -> None:
            for one in active:
                if one.what == "train" and (one.job.folder / "checkpoints/last.ckpt").exists():
                    self.stopped.append(one.job.folder)
                    if not self.kill:
                        raise KeyboardInterrupt
                    one.process.kill()

    with pytest.raises(KeyboardInterrupt):
        running.Runner(work).run(Stops(kill=False))
    runner = running.Runner(work)
    runner.run(Stops(kill=True))
    (job,) = work.left
    assert "exit code -9" in runner.failed[job.folder]
    running.Runner(work).run()
    assert not work.left
    assert_same_weights(next(iter(whole.jobs)), job.folder)
    assert not list(job.folder.glob("**/.*.ckpt"))


def test_seeds_of_a_run_are_a_sweep_of_a_launcher(file, tmp_path, start):
    stated = reading.read(file)
    work = running.Work(stated, [replace(stated.claims[0], baseline=0.5)], tmp_path / "runs")
    running.Runner(work, launcher="basic").run()
    assert not work.left
    assert (start.of("train"), start.of("eval")) == (1, 2)
    assert all("hydra/launcher=basic" in arguments for arguments in start.started if arguments[0] == "train")
    assert work.result(stated.claims[0].variant, 2)["figures"]["toy/frames"] == 24


def test_a_sweep_that_fails_is_not_taken_for_an_older_checkpoint(file, tmp_path, start):
    stated = reading.read(file, ["dataset.toy.poison=3"])
    work = running.Work(stated, [replace(stated.claims[0], baseline=0.5)], tmp_path / "runs")
    for job in work.left:
        (job.folder / "checkpoints").mkdir(parents=True)
    runner = running.Runner(work, launcher="basic")
    runner.run()
    assert set(runner.failed) == set(work.jobs)
    assert not any(job.trained for job in work.left)
    log = (job.folder.parent / "log.txt").read_text()
    assert all(f"{job.folder}: " in log for job in work.left)  # both are named
    assert start.of("eval") == 0


def test_a_training_without_a_checkpoint_fails_alone(file, tmp_path, start):
    text = file.read_text().replace("untrained: [optimizer.lr=1e-7]", "untrained: [trainer.fast_dev_run=true]")
    file.write_text(text.replace("seeds: [1, 2]", "seeds: [1]"))
    stated = reading.read(file)
    for launcher in (None, "basic"):
        work = running.Work(stated, stated.claims[:1], tmp_path / f"runs_{launcher}")
        runner = running.Runner(work, jobs=1, launcher=launcher)
        runner.run()
        ((folder, reason),) = runner.failed.items()
        assert "left no checkpoints/last.ckpt" in reason
        assert [job.folder for job in work.left] == [folder]


def test_a_budget_starts_nothing_that_cannot_end_in_time(file, tmp_path, start):
    stated = reading.read(file)
    work = running.Work(stated, [replace(stated.claims[0], baseline=0.5, seeds=(1,))], tmp_path / "runs")
    running.Runner(work, minutes=4.9).run()  # a run is said to take 5
    assert not start.started
    job = work.left[0]
    job.spend("train", 290.0)
    runner = running.Runner(work, jobs=1, minutes=4.9)
    assert runner.expected(job) == pytest.approx(30)  # never below a tenth
    runner.run()
    assert job.done
    assert {arguments[0] for arguments in start.started} == {"train", "eval"}


def test_a_run_that_fails_is_named_and_the_others_go_on(file, tmp_path, start, capsys):
    text = file.read_text().replace("untrained: [optimizer.lr=1e-7]", "untrained: [dataset.toy.poison=3]")
    file.write_text(text.replace("seeds: [1, 2]", "seeds: [1]").replace("baseline: same", "baseline: 1.01"))
    arguments = ["claims", str(file), "-o", str(tmp_path / "out"), "--runs", str(tmp_path / "runs")]
    assert main([*arguments, "--only", "training", "delaying"]) == 1
    error = capsys.readouterr().err
    assert "failed: untrained, seed 1: exit code 2" in error
    assert "is nan" in error
    assert table_of(tmp_path / "out")["Training helps"] == "not run"
    assert table_of(tmp_path / "out")["Another name and a delay are worse"] == "**supported**"


def test_a_claim_that_cannot_be_judged_does_not_take_the_others_along(file, tmp_path, start, capsys):
    text = file.read_text().replace("eval: [filter=delay]", "eval: [dataset.toy.frames=12]")
    file.write_text(text.replace("seeds: [1, 2]", "seeds: [1]"))
    out = tmp_path / "out"
    assert main(["claims", str(file), "-o", str(out), "--runs", str(tmp_path / "runs")]) == 1
    printed = capsys.readouterr()
    assert "claims.delaying: the runs were not evaluated on the same frames: 24 and 12" in printed.err
    assert "not judged    Another name and a delay are worse" in printed.out
    assert table_of(out)["Another name and a delay are worse"] == "not judged"
    assert table_of(out)["Training helps"] == "**supported**"
    assert "1 not judged." in (out / "toy.md").read_text()


def test_only_one_process_makes_a_run(file, tmp_path, start):
    stated = reading.read(file)
    work = running.Work(stated, [replace(stated.claims[0], baseline=0.5, seeds=(1,))], tmp_path / "runs")
    (job,) = work.left
    lock = running._lock(job.folder)
    assert lock is not None
    runner = running.Runner(work)
    runner.run()
    assert runner.busy == [job]
    assert not start.started
    lock.close()
    assert running._lock(job.folder) is not None


def test_other_options_versions_and_seeds_are_other_runs(file, tmp_path, monkeypatch):
    overrides = tuple(training_parts.OVERRIDES)
    one = running.identity(overrides)
    assert running._digest(one) == running._digest(running.identity((*overrides, "name=x", "seed=4")))
    assert running._digest(one) != running._digest(running.identity((*overrides, "optimizer.lr=0.02")))
    assert one["versions"]["lidarfw"]
    assert one["versions"]["torch"]


# --- errors


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("metric: toy/accuracy", "metric: toi/accuracy", "has no metric 'toi'.\n  it has: toy\n  did you mean 'toy'"),
        ("metric: toy/accuracy", "metric: accuracy", "must be METRIC/KEY"),
        ("baseline: untrained", "baseline: untraind", "no run of that name.*did you mean 'untrained'"),
        ("better: higher", "better: more", "use one of: lower, higher"),
        ("source:", "sorce:", "there is no key 'sorce'.*did you mean 'source'"),
        ("    baseline: untrained\n", "", "baseline is missing"),
        ("seeds: [1, 2]", "seeds: [1, 1]", "list of different numbers"),
        ("block: 4", "block: 0", "must be a number above 0"),
        ("trained: []", "trained: 3", "expected keys experiment, overrides, eval"),
        ("runs:", "runs: [1]\nrans:", "there is no key 'rans'"),
        ("long: true", "long: 2", "long must be true or false"),
        ("long: true", "margin: wide", "must be a share such as 5%"),
        ("trained: []", "trained: [head.toy.dpth=1]", "no option 'dpth'"),
        ("paper:", "paper: [", "cannot be read: line 3: expected"),
    ],
)
def test_a_wrong_file_is_refused_before_anything_runs(old, new, text, file, tmp_path, start, capsys):
    file.write_text(file.read_text().replace(old, new, 1))
    assert main(["claims", str(file), "-o", str(tmp_path / "out"), "--runs", str(tmp_path / "runs")]) == 2
    error = capsys.readouterr().err
    assert re.search(text, error, re.DOTALL), error
    assert not start.started
    assert not (tmp_path / "out").exists()


def test_a_file_without_claims_is_refused(tmp_path):
    (tmp_path / "claims.yaml").write_text("runs: {a: []}\nclaims: {}")
    with pytest.raises(ConfigError, match="claims must hold entries by name"):
        reading.read(tmp_path / "claims.yaml")


def test_the_plugin_or_file_must_be_there(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plugins/taco").mkdir(parents=True)
    (tmp_path / "plugins/taco/claims.yaml").touch()
    assert main(["claims", "tacos"]) == 2
    assert "with claims: taco\n  did you mean 'taco'?" in capsys.readouterr().err
    assert main(["claims", "mine/claims.yaml"]) == 2
    assert "there is no file mine/claims.yaml" in capsys.readouterr().err
    assert main(["claims", "taco", "--jobs", "0"]) == 2
    assert "--jobs must be at least 1" in capsys.readouterr().err


def test_a_damaged_file_of_results_is_named(tmp_path):
    (tmp_path / "toy.json").write_text("{")
    with pytest.raises(DataError, match="holds no results of claims"):
        reporting.recorded_in(tmp_path / "toy.json")


# --- verdicts


def claim(**changes) -> Claim:
    made = Claim("c", "A claim", "", UNTRAINED, TRAINED, "m/x", "lower", (1, 2, 3))
    return replace(made, **changes)


def evaluated(*means: float, spread: float = 0.02, frames: int = 200, samples: int = 400) -> dict[int, dict]:
    """Evaluations by seed, as `lidarfw eval --frames` writes them: errors of frames around each mean, one per seed."""
    noise = np.random.default_rng(0).normal(0, 1, frames)
    found = {}
    for seed, mean in enumerate(means, 1):
        errors = mean + noise + spread * np.random.default_rng(seed).normal(0, 1, frames)
        resampled = errors[draws(frames, samples)].mean(1).tolist()
        ids = [{"id": str(number), "sequence": "a"} for number in range(frames)]
        halves = {"a": {"m/x": [errors[:100].mean()]}, "b": {"m/x": [errors[100:].mean()]}}
        found[seed] = {
            "figures": {"m/x": float(errors.mean())}, "frames": ids,
            "resampled": {"m/x": resampled}, "by_sequence": halves,
        }  # fmt: skip
    return found


def test_verdicts():
    base = evaluated(1.0, 1.02, 0.98)
    assert judging.judge(claim(), base, evaluated(0.8, 0.82, 0.78)).verdict == judging.SUPPORTED
    assert judging.judge(claim(better="higher"), base, evaluated(0.8, 0.82, 0.78)).verdict == judging.CONTRADICTED
    assert judging.judge(claim(margin=0.05), base, evaluated(1.0, 1.02, 0.98)).verdict == judging.NEUTRAL
    assert judging.judge(claim(margin=0.05), base, evaluated(0.7, 1.32, 0.98)).verdict == judging.UNDECIDED


def test_figures_that_are_0_in_all_runs_tell_nothing():
    nothing = evaluated(1.0, 1.0, 1.0)
    for content in nothing.values():
        content["figures"]["m/x"], content["resampled"]["m/x"] = 0.0, [0.0] * 400
    assert judging.judge(claim(), nothing, nothing).verdict == judging.UNDECIDED


def test_pairing_removes_what_both_runs_share():
    base, better = evaluated(1.0, 1.0, 1.0), evaluated(0.95, 0.95, 0.95)
    paired, single = judging.judge(claim(), base, better), judging.judge(claim(paired=False), base, better)
    assert paired.difference == single.difference
    assert single.high - single.low > 5 * (paired.high - paired.low)
    # the error of 200 frames with deviation 1 over two independent means
    assert single.high - single.low == pytest.approx(2 * 1.645 * np.sqrt(2 / 200), rel=0.2)


def test_an_interval_covers_the_truth_about_as_often_as_it_says():
    hits = 0
    for trial in range(60):
        rng = np.random.default_rng(trial)
        one, other = ({"figures": {}, "frames": [], "resampled": {}} for _ in range(2))
        shared = rng.normal(0, 1, 80)
        for content, mean in ((one, 1.0), (other, 0.9)):
            errors = mean + shared + rng.normal(0, 0.3, 80)
            content["figures"]["m/x"] = errors.mean()
            content["resampled"]["m/x"] = errors[draws(80, 300)].mean(1).tolist()
        found = judging.judge(claim(), {1: one}, {1: other})
        hits += found.low <= -0.1 <= found.high
    assert 48 <= hits <= 59  # 54 expected


def test_a_number_may_be_the_baseline():
    found = judging.judge(claim(baseline=1.0), 1.0, evaluated(0.7, 0.72, 0.71))
    assert (found.verdict, found.baseline) == (judging.SUPPORTED, 1.0)
    assert found.per_seed[1] == pytest.approx(found.variant - 1.0, abs=0.02)


def test_sequences_and_seeds_may_be_what_is_drawn():
    base, better = evaluated(1.0, 1.0, 1.0), evaluated(0.9, 0.8, 0.85)
    seeds = judging.judge(claim(resample="seeds"), base, better)
    assert seeds.low == pytest.approx(-0.2, abs=0.02)
    assert seeds.high == pytest.approx(-0.1, abs=0.02)
    sequences = judging.judge(claim(resample="sequences"), base, better)
    assert sequences.low <= seeds.difference <= sequences.high


def test_runs_on_other_frames_do_not_pair():
    base, other = evaluated(1.0), evaluated(0.9)
    other[1]["frames"][5] = {"id": "else", "sequence": "a"}
    with pytest.raises(ConfigError, match="same frames: 200 and 200, different from number 5"):
        judging.judge(claim(), base, other)
    assert judging.judge(claim(paired=False), base, other).verdict


def test_a_figure_that_is_not_there_names_those_that_are():
    with pytest.raises(ConfigError, match="run 'trained' does not exist"):
        judging.judge(claim(metric="m/y"), evaluated(1.0), evaluated(1.0))


def test_expected_time_learns_from_other_seeds(file, tmp_path):
    stated = reading.read(file)
    work = running.Work(stated, stated.claims[:1], tmp_path / "runs")
    runner = running.Runner(work)
    one, other = (job for job in work.jobs.values() if job.evaluations[0].run.name == "trained")
    assert runner.expected(other) == 300
    one.spend("train", 40.0)
    one.spend("eval", 5.0)
    for path in (one.folder / "trained.json", one.evaluations[0].file):
        path.write_text("{}")
    assert runner.expected(other) == 45
