"""The runs that claims need: each is trained and evaluated once, in a folder named after what it depends on."""

from __future__ import annotations

import fcntl
import functools
import hashlib
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, Protocol, TextIO

from lidarfw import config, registry
from lidarfw.assembly import plan
from lidarfw.claims.reading import Claim, ClaimsFile, Run
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import write_text
from lidarfw.registry import did_you_mean

_QUIET = ("trainer.enable_progress_bar=false", "trainer.enable_model_summary=false")
_NO_MATTER = ("name", "seed", "logger", "resume")  # of a config, to the weights; the seed names a subfolder
_TRAINED, _SECONDS, _LOG = "trained.json", "seconds.json", "log.txt"
_PAUSE = 0.05  # seconds between two looks at the processes
_STOP_WITHIN = 30.0  # seconds that a process may take to save and end


class Process(Protocol):
    """What is needed of a `subprocess.Popen`."""

    def poll(self) -> int | None: ...
    def terminate(self) -> None: ...
    def kill(self) -> None: ...
    def wait(self, timeout: float | None = None) -> int: ...


Start = Callable[[Sequence[str], Path, int, int], Process]  # arguments of lidarfw, log file, threads, lock


def start_process(arguments: Sequence[str], log: Path, threads: int, lock: int) -> Process:
    """`lidarfw ARGUMENTS` as a process of its own, its output at the end of `log`.

    It keeps the file number `lock` open, so that the lock lasts as long as the process, whatever becomes of this one.
    """
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    with log.open("ab") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "lidarfw", *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **dict.fromkeys(names, str(threads))},
            pass_fds=(lock,),
            start_new_session=True,  # Ctrl-C is for the runner, which ends its processes
        )


@dataclass(frozen=True)
class Evaluation:
    """`lidarfw eval` of one checkpoint; done where its file stands."""

    run: Run
    file: Path


@dataclass
class Job:
    """One training with one seed, and the evaluations of its checkpoint."""

    overrides: tuple[str, ...]
    seed: int
    folder: Path
    evaluations: list[Evaluation] = field(default_factory=list)

    @property
    def name(self) -> str:
        """For people: the first run that it serves, and the seed."""
        return f"{self.evaluations[0].run.name}, seed {self.seed}"

    @property
    def trained(self) -> bool:
        """Whether the training is done."""
        return (self.folder / _TRAINED).is_file()

    @property
    def done(self) -> bool:
        """Whether training and evaluations are done."""
        return self.trained and all(e.file.is_file() for e in self.evaluations)

    @property
    def seconds(self) -> float:
        """Wall time spent on it so far."""
        return float(sum(_read_json(self.folder / _SECONDS).values()))

    def spend(self, what: str, seconds: float) -> None:
        """Note wall time; a training may be made in several goes."""
        spent = _read_json(self.folder / _SECONDS)
        write_text(self.folder / _SECONDS, json.dumps({**spent, what: spent.get(what, 0) + seconds}) + "\n")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is damaged: {error}\n  fix: delete {path.parent}; it is made again") from error


# --- what there is to do ---------------------------------------------------------------------------------------------


@functools.cache
def identity(overrides: tuple[str, ...]) -> dict[str, Any]:
    """What the weights of a run depend on, but for the seed: the resolved config and the versions of its parts."""
    composed = config.compose(list(overrides))
    wired = plan(composed)
    plain = {key: value for key, value in config.to_plain(composed).items() if key not in _NO_MATTER}
    parts = [registry.find(slot, node["type"]) for slot in ("dataset", "transform") for node in _nodes(plain, slot)]
    versions = {**wired.distributions, "torch": importlib.metadata.version("torch")}
    versions |= {part.distribution: part.version for part in parts if part.version}
    return {"config": plain, "versions": versions, "metrics": [step.name for step in wired.of("metric")]}


def _nodes(plain: dict[str, Any], slot: str) -> list[dict[str, Any]]:
    return [node for node in (plain.get(slot) or {}).values() if "type" in node]


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:12]


class Work:
    """The jobs of a file's claims: equal trainings are one job, whatever runs and claims ask for them."""

    def __init__(self, stated: ClaimsFile, claims: Sequence[Claim], root: Path) -> None:
        self.stated, self.root = stated, root
        self.jobs: dict[Path, Job] = {}
        self._files: dict[tuple[str, int], Evaluation] = {}
        for claim in claims:
            for run in claim.runs:
                self._check(run, claim)
        most = max((len(claim.seeds) for claim in claims), default=0)
        for place in range(most):  # the first seed of everything comes first: an early stop leaves pairs
            for claim in claims:
                for run in claim.runs if place < len(claim.seeds) else ():
                    self._add(run, claim.seeds[place])

    def _check(self, run: Run, claim: Claim) -> None:
        """Refuse what cannot work before anything is run."""
        known = identity(run.overrides)["metrics"]
        metric = claim.metric.partition("/")[0]
        if metric not in known and not any("metric" in override for override in run.evaluation):
            raise ConfigError(
                f"{self.stated.path}: claims.{claim.name}.metric: run {run.name!r} has no metric {metric!r}.\n"
                f"  it has: {', '.join(known) or 'none'}{did_you_mean(metric, known)}"
            )

    def _add(self, run: Run, seed: int) -> None:
        if (run.name, seed) in self._files:
            return
        folder = self.root / _digest(identity(run.overrides)) / f"seed_{seed}"
        job = self.jobs.setdefault(folder, Job(run.overrides, seed, folder))
        settings = [run.evaluation, self.stated.resamples, self.stated.block]
        evaluation = Evaluation(run, folder / f"eval_{_digest(settings)}.json")
        self._files[run.name, seed] = evaluation
        if evaluation.file not in [e.file for e in job.evaluations]:
            job.evaluations.append(evaluation)

    def result(self, run: Run, seed: int) -> dict[str, Any] | None:
        """What `lidarfw eval --frames` wrote, or None where it has not been run."""
        file = self._files[run.name, seed].file
        return _read_json(file) if file.is_file() else None

    def training(self, run: Run, seed: int) -> dict[str, Any]:
        """When, from which commit and in which time a run was trained; `training` names what it shares with others."""
        folder = self._files[run.name, seed].file.parent
        spent = sum(_read_json(folder / _SECONDS).values())
        return {**_read_json(folder / _TRAINED), "seconds": spent, "training": folder.parent.name}

    @property
    def left(self) -> list[Job]:
        """The jobs that are not done."""
        return [job for job in self.jobs.values() if not job.done]


# --- doing it --------------------------------------------------------------------------------------------------------


@dataclass
class Active:
    """A job with a process."""

    job: Job
    what: str  # train, or name of the evaluation's file
    process: Process
    began: float
    lock: TextIO


class Display(Protocol):
    """Shows what goes on."""

    def update(self, active: Sequence[Active], done: int) -> None:
        """The jobs at hand, and how many are done."""


class Runner:
    """Makes the missing runs, `jobs` at once; killed at any moment, the next one goes on where this one stood."""

    def __init__(
        self,
        work: Work,
        *,
        jobs: int = 2,
        threads: int = 1,
        minutes: float | None = None,
        launcher: str | None = None,
        start: Start | None = None,
    ) -> None:
        self.work, self.jobs, self.threads, self.launcher = work, jobs, threads, launcher
        self.start = start or start_process
        self.deadline = time.monotonic() + 60 * minutes if minutes is not None else None
        self.done = 0  # jobs
        self.failed: dict[Path, str] = {}  # folder -> why
        self.busy: list[Job] = []  # another runner is at them
        self._active: list[Active] = []

    def run(self, display: Display | None = None) -> None:
        """Run until nothing is left that can end in time. What fails is noted in `failed`; the others go on."""
        waiting = self.work.left
        try:
            if self.launcher:
                self._launch([job for job in waiting if not job.trained], display)
                waiting = [job for job in waiting if job.trained]
            while waiting or self._active:
                while waiting and len(self._active) < self.jobs:
                    self._begin(waiting.pop(0))
                self._collect()
                if display is not None:
                    display.update(self._active, self.done)
                time.sleep(_PAUSE)
        finally:
            self._stop()

    def expected(self, job: Job) -> float:
        """Seconds that a job will still take: by the other seeds of its run, else any run, else the file's guess."""
        done = [other for other in self.work.jobs.values() if other.done and other.seconds > 0]
        alike = [other.seconds for other in done if other.folder.parent == job.folder.parent]
        whole = max(alike or [other.seconds for other in done] or [60 * self.work.stated.minutes])
        return max(whole - job.seconds, 0.1 * whole)

    def _in_time(self, job: Job) -> bool:
        return self.deadline is None or time.monotonic() + self.expected(job) <= self.deadline

    def _begin(self, job: Job) -> None:
        if not self._in_time(job):
            return
        lock = _lock(job.folder)
        if lock is None:
            self.busy.append(job)
        else:
            self._next(job, lock)

    def _next(self, job: Job, lock: TextIO) -> None:
        """Start what comes next of a job, or let it go."""
        found = next(_commands(job, self.work.stated), None)
        if found is None:
            self.done += 1
            lock.close()
            return
        what, arguments = found
        process = self.start(arguments, job.folder / _LOG, self.threads, lock.fileno())
        self._active.append(Active(job, what, process, time.monotonic(), lock))

    def _collect(self) -> None:
        for active in list(self._active):
            code = active.process.poll()
            if code is None:
                continue
            self._active.remove(active)
            active.job.spend(active.what, time.monotonic() - active.began)
            if self._ended_well(active.job, active.what, active.job.folder / _LOG, code):
                self._next(active.job, active.lock)
            else:
                active.lock.close()

    def _ended_well(self, job: Job, what: str, log: Path, code: int) -> bool:
        """Note a training that is done, or why the job failed."""
        try:
            if code == 0 and what == "train":
                _note_trained(job)
        except DataError as error:
            self.failed[job.folder] = str(error)
        if code != 0:
            self.failed[job.folder] = _last_words(log, code)
        return job.folder not in self.failed

    def _stop(self) -> None:
        """End all processes; training saves where it stands."""
        for active in self._active:
            active.process.terminate()
        for active in self._active:
            try:
                active.process.wait(_STOP_WITHIN)
            except subprocess.TimeoutExpired:
                active.process.kill()
                active.process.wait()
            active.job.spend(active.what, time.monotonic() - active.began)
            active.lock.close()
        self._active = []

    # a cluster

    def _launch(self, jobs: Sequence[Job], display: Display | None) -> None:
        """Train the seeds of each run as one sweep of a Hydra launcher, and wait for it; evaluations follow here."""
        folders = dict.fromkeys(job.folder.parent for job in jobs if self._in_time(job))
        for number, folder in enumerate(folders):
            own = [job for job in jobs if job.folder.parent == folder]
            lock = _lock(folder)
            if lock is None:
                self.busy += own
                continue
            process = self.start(self._sweep(own), folder / _LOG, self.threads, lock.fileno())
            self._active.append(Active(own[0], "train", process, time.monotonic(), lock))
            while process.poll() is None:
                if display is not None:
                    display.update(self._active, number)
                time.sleep(_PAUSE)
            self._swept(own, self._active.pop(), process.wait())

    def _sweep(self, jobs: Sequence[Job]) -> list[str]:
        seeds = ",".join(str(job.seed) for job in jobs)
        folder = f"hydra.sweep.dir={jobs[0].folder.parent}"
        options = [f"seed={seeds}", folder, "hydra.sweep.subdir=seed_${seed}", "resume=auto", *_QUIET]
        return ["train", "-m", *jobs[0].overrides, f"hydra/launcher={self.launcher}", *options]

    def _swept(self, jobs: Sequence[Job], active: Active, code: int) -> None:
        active.lock.close()
        for job in jobs:
            job.spend("train", (time.monotonic() - active.began) / len(jobs))
            self._ended_well(job, "train", job.folder.parent / _LOG, code)


def _commands(job: Job, stated: ClaimsFile) -> Iterator[tuple[str, list[str]]]:
    """What a job still needs, as arguments of lidarfw."""
    if not job.trained:
        yield (
            "train",
            ["train", *job.overrides, f"seed={job.seed}", f"hydra.run.dir={job.folder}", "resume=auto", *_QUIET],
        )
    sizes = ["--resamples", str(stated.resamples), "--block", str(stated.block)]
    for evaluation in job.evaluations:
        if not evaluation.file.is_file():
            checkpoint = str(job.folder / "checkpoints" / "last.ckpt")
            options = ["--frames", str(evaluation.file), *sizes]
            yield evaluation.file.stem, ["eval", checkpoint, *evaluation.run.evaluation, *options]


def _note_trained(job: Job) -> None:
    if not (job.folder / "checkpoints" / "last.ckpt").is_file():
        raise DataError(f"{job.folder}: the training left no checkpoints/last.ckpt.\n  fix: callbacks with checkpoints")
    about = {"overrides": job.overrides, "seed": job.seed, "commit": commit(), "date": date.today().isoformat()}
    write_text(job.folder / _TRAINED, json.dumps(about, indent=1) + "\n")


def _last_words(log: Path, code: int) -> str:
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return "\n    ".join([f"exit code {code}, the end of {log}:", *lines[-6:]])


def _lock(folder: Path) -> TextIO | None:
    """A file that says that this process works in the folder, until it is closed; None where another one does."""
    folder.mkdir(parents=True, exist_ok=True)
    file = (folder / ".lock").open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file


def commit() -> str:
    """The commit of the working directory, with + where files differ from it; empty without git."""
    git = shutil.which("git")
    if git is None:
        return ""
    found = subprocess.run([git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    changed = subprocess.run([git, "status", "--porcelain", "-uno"], capture_output=True, text=True)
    return found.stdout.strip() + "+" * bool(changed.stdout.strip()) if found.returncode == 0 else ""
