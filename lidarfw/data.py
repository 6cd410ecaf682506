"""Datasets -> batches: which frames are read when, by whom, and how a stopped epoch goes on.

Nothing here keeps a random state. The order of an epoch is a function of (seed, epoch), the augmentation of a frame
one of (seed, epoch, frame), so a resumed run and a run with other workers read the same batches.
"""

from __future__ import annotations

import itertools
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.utilities import rank_zero_warn
from scipy.spatial import KDTree
from torch.utils.data import DataLoader, get_worker_info

from lidarfw.errors import CheckpointError, ConfigError, DataError, LidarfwError
from lidarfw.interfaces import Dataset, Transform
from lidarfw.types import Batch, Frame, collate

if TYPE_CHECKING:
    from omegaconf import DictConfig

BAD_SAMPLE_POLICIES = ("error", "skip")
MAX_SKIPPED = 0.1  # share of the frames of a split that `bad_sample: skip` puts up with; one frame always
_BROKEN_FILE = (DataError, OSError, ValueError)  # what a broken file causes; any other exception is a bug


@dataclass(frozen=True)
class BadSample:
    """A frame that could not be read. Plain strings: it crosses a process border where many exceptions cannot."""

    id: str
    reason: str
    skippable: bool
    error: Exception | None = None  # the exception itself, where no process border was crossed


class Loaded(NamedTuple):
    """What a worker hands over: the batch (None where no frame was readable) and the frames that were not."""

    batch: Batch | None
    bad: list[BadSample]


Key = tuple[int, int]  # epoch, clip number


class Clips(torch.utils.data.Dataset[Any]):
    """Clips of transformed frames: runs of consecutive frames of one sequence, of length 1 unless `loader.clip` is set.

    All frames of a clip get the same random numbers, so an augmentation turns them alike. With `replace`, a clip that
    holds a broken frame is replaced by the next readable one (training keeps its batch size); otherwise it is left out.
    """

    def __init__(
        self,
        dataset: Dataset,
        transforms: Sequence[Transform],
        clips: Sequence[Sequence[int]],
        seed: int,
        replace: bool,
    ) -> None:
        self.dataset = dataset
        self.transforms = list(transforms)
        self.clips = clips
        self.seed = seed
        self.replace = replace

    def __len__(self) -> int:
        return len(self.clips)

    def __getitems__(self, keys: Sequence[Key]) -> tuple[list[Frame], list[BadSample]]:
        """Frames of the clips in their order, and the frames that could not be read."""
        frames: list[Frame] = []
        bad: list[BadSample] = []
        for epoch, number in keys:
            for attempt in range(len(self.clips) if self.replace else 1):
                clip, failed = self._clip(epoch, (number + attempt) % len(self.clips))
                bad += [failed] if failed else []
                frames += clip
                if clip or (failed and not failed.skippable):
                    break
        return frames, bad

    def _clip(self, epoch: int, number: int) -> tuple[list[Frame], BadSample | None]:
        frames = []
        for index in self.clips[number]:
            try:
                frames.append(self._frame(epoch, index, first=self.clips[number][0]))
            except Exception as error:
                return [], self._bad(index, error)
        return frames, None

    def _frame(self, epoch: int, index: int, first: int) -> Frame:
        frame = self.dataset[index]
        for place, transform in enumerate(self.transforms):
            frame = transform(frame, np.random.default_rng((self.seed, epoch, first, place)))
        return frame

    def _bad(self, index: int, error: Exception) -> BadSample:
        reason = str(error) if isinstance(error, LidarfwError) else f"{type(error).__name__}: {error}{_place(error)}"
        keep = error if get_worker_info() is None else None
        return BadSample(self.name(index), reason, isinstance(error, _BROKEN_FILE), keep)

    def name(self, index: int) -> str:
        """How messages call a frame."""
        return self.dataset.meta(index).id

    def names(self, keys: Sequence[Key]) -> str:
        """How messages call the frames of a batch."""
        return ", ".join(self.name(index) for _, number in keys for index in self.clips[number])


def _place(error: Exception) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return f", at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""


def collate_clips(read: tuple[list[Frame], list[BadSample]]) -> Loaded:
    """The batch of what a worker has read; DataError naming the frames that do not go together."""
    frames, bad = read
    try:
        return Loaded(collate(frames) if frames else None, bad)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        names = ", ".join(frame.meta.id for frame in frames)
        raise DataError(f"samples {names} do not make a batch: {type(error).__name__}: {error}") from error


class BatchOrder:
    """Which clips make which batch: a batch sampler whose order is a function of (seed, epoch) alone.

    Every rank gets as many batches as the others; where clips do not divide evenly, the first ones are seen twice.
    """

    def __init__(self, clips: int, batch_size: int, *, seed: int, shuffle: bool, rank: int = 0, world: int = 1) -> None:
        self.clips = clips
        self.batch_size = batch_size
        self.seed = seed
        self.shuffle = shuffle
        self.rank = rank
        self.world = world
        self.epoch = 0
        self.start = 0  # batches that the next iteration leaves out

    @property
    def sampler(self) -> BatchOrder:
        """Itself: Lightning looks here for `set_epoch`."""
        return self

    def set_epoch(self, epoch: int) -> None:
        """Take the order of another epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-self._share() // self.batch_size)

    def _share(self) -> int:
        return -(-self.clips // self.world)

    def numbers(self) -> list[int]:
        """Clip numbers of this rank in the order of the epoch."""
        order = np.arange(self.clips)
        if self.shuffle:
            order = np.random.default_rng((self.seed, self.epoch)).permutation(self.clips)
        padded = np.resize(order, self._share() * self.world) if self.clips else order
        return [int(number) for number in padded[self.rank :: self.world]]

    def batch(self, place: int) -> list[Key]:
        """The keys of one batch of the epoch."""
        first = place * self.batch_size
        return [(self.epoch, number) for number in self.numbers()[first : first + self.batch_size]]

    def __iter__(self) -> Iterator[list[Key]]:
        numbers = self.numbers()
        for first in range(self.start * self.batch_size, len(numbers), self.batch_size):
            yield [(self.epoch, number) for number in numbers[first : first + self.batch_size]]


class PairOrder(BatchOrder):
    """Batches of pairs of frames that were taken less than `radius` metres apart, for losses between places.

    An epoch has half as many pairs as there are frames with a partner: each draws another first frame and any one of
    the frames near to it. ConfigError where no frame has a partner.
    """

    def __init__(
        self, positions: np.ndarray, radius: float, batch_size: int, *, seed: int, rank: int = 0, world: int = 1
    ) -> None:
        self.tree, self.radius = KDTree(positions[:, :2]), radius
        near = self.tree.query_ball_point(positions[:, :2], radius, return_length=True)
        self.paired = np.flatnonzero(near > 1)
        if not len(self.paired):
            raise ConfigError(f"loader.pairs is {radius} m, and no two frames were taken so near to each other")
        super().__init__(2 * -(-len(self.paired) // 2), batch_size, seed=seed, shuffle=True, rank=rank, world=world)

    def _share(self) -> int:
        return 2 * -(-(self.clips // 2) // self.world)

    def numbers(self) -> list[int]:
        """Frame numbers of this rank in the order of the epoch, partners beside each other."""
        draw = np.random.default_rng((self.seed, self.epoch))
        first = draw.permutation(self.paired)[: self.clips // 2]
        near = self.tree.query_ball_point(self.tree.data[first], self.radius, return_sorted=True)
        chances = draw.random(len(first))
        pairs = np.array([(a, _other(a, many, chance)) for a, many, chance in zip(first, near, chances, strict=True)])
        padded = np.resize(pairs, (self._share() // 2 * self.world, 2))
        return [int(number) for number in padded[self.rank :: self.world].ravel()]


def _other(frame: int, near: Sequence[int], chance: float) -> int:
    """One of the frames near to a frame, but not itself; `chance` 0..1 says which."""
    others = [number for number in near if number != frame]
    return others[int(chance * len(others))]


class FrameLoader(DataLoader[Batch]):
    """A DataLoader that goes on in the middle of an epoch, names the frames that fail, and never waits for ever."""

    def __init__(
        self, dataset: Clips, order: BatchOrder, *, workers: int = 0, timeout: float = 120, skip: bool = False
    ):
        super().__init__(
            dataset,  # type: ignore[arg-type]  # yields clips, collates them to a Batch
            batch_sampler=order,  # type: ignore[arg-type]
            num_workers=workers,
            timeout=timeout if workers else 0,
            collate_fn=collate_clips,  # type: ignore[arg-type]
            persistent_workers=workers > 0,
            pin_memory=torch.cuda.is_available(),
        )
        self.samples = dataset
        self.order = order
        self.skip = skip
        self.position = 0  # batches of the epoch that were handed out
        self.resume: tuple[int, int] | None = None  # epoch and position to go on at
        self.skipped: dict[str, str] = {}  # reason by id of frame

    def state_dict(self) -> dict[str, int]:
        """Where in which epoch the loader stands."""
        return {"epoch": self.order.epoch, "position": self.position, "batches": len(self), "seed": self.order.seed}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Go on where `state_dict` was taken. CheckpointError where the batches are no longer the same."""
        for key, here in (("batches", len(self)), ("seed", self.order.seed)):
            if state[key] != here:
                raise CheckpointError(
                    f"cannot resume: the checkpoint was written with {key} = {state[key]}, this run has {here}.\n"
                    "  loader.batch_size, loader.clip, seed, dataset and number of processes must stay the same\n"
                    "  fix: start a new run from its weights, init.from=PATH"
                )
        self.resume = (state["epoch"], state["position"])

    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]
        epoch, position = self.resume or (0, 0)
        self.resume = None
        self.order.start = self.position = position if epoch == self.order.epoch else 0
        try:  # around all of it: torch raises wherever the program is when it hears of the death of a worker
            batches = super().__iter__()
            for place in range(self.position, len(self)):
                loaded = self._next(batches)
                self._judge(loaded.bad)
                self.position = place + 1
                if loaded.batch is not None:
                    yield loaded.batch
        except LidarfwError:
            raise
        except (RuntimeError, OSError, EOFError, MemoryError) as error:
            raise self.failure(error) from error

    def _next(self, batches: Iterator[Any]) -> Loaded:
        try:
            return next(batches)  # type: ignore[no-any-return]
        except LidarfwError as error:
            raise type(error)(_last_lines(error)) from error

    def failure(self, error: Exception) -> DataError:
        """What it means that workers failed while the next batch was prepared. Ends the others."""
        if self._iterator is not None:  # else torch raises again, wherever the program is, when it hears of the death
            self._iterator._shutdown_workers()  # type: ignore[attr-defined]
            self._iterator = None
        keys = self.order.batch(self.position)
        near = f"  the batch that was waited for: {self.samples.names(keys) or 'none'}\n"
        if "timed out" in str(error):
            return DataError(
                f"no batch came within {self.timeout:g} s from {self.num_workers} loader workers.\n{near}"
                "  fix: loader.timeout=600 for a slow disk, or loader.workers=0 to see where it hangs"
            )
        return DataError(
            f"a loader worker died: {str(error).splitlines()[0] if str(error) else type(error).__name__}\n{near}"
            "  killed for memory? fix: fewer loader.workers, a smaller loader.batch_size, "
            "or loader.workers=0 to see the error"
        )

    def _judge(self, bad: Sequence[BadSample]) -> None:
        for sample in bad:
            if not (self.skip and sample.skippable):
                hint = "\n  fix: mend or remove it, or loader.bad_sample=skip" if sample.skippable else ""
                raise DataError(f"sample {sample.id}: {sample.reason}{hint}") from sample.error
            self._skip(sample)

    def _skip(self, sample: BadSample) -> None:
        if sample.id in self.skipped:
            return
        self.skipped[sample.id] = sample.reason
        count, total = len(self.skipped), len(self.samples.dataset)
        rank_zero_warn(f"{count} of {total} skipped: sample {sample.id}: {sample.reason}")
        if count > max(1, MAX_SKIPPED * total):
            raise DataError(
                f"{count} of {total} samples of split {self.samples.dataset.split!r} could not be read, the limit is "
                f"{MAX_SKIPPED:.0%}.\n  the last one: {sample.id}: {sample.reason}\n  fix: check the dataset's root"
            )


def _last_lines(error: LidarfwError) -> str:
    """The message of an error that torch has wrapped into the traceback of a worker."""
    _, found, message = str(error).rpartition(f"{type(error).__name__}: ")
    return message.strip() if found else str(error)


def clips_of(dataset: Dataset, length: int) -> list[Sequence[int]]:
    """Every run of `length` consecutive frames of a sequence."""
    return [
        sequence[first : first + length]
        for sequence in dataset.sequences()
        for first in range(len(sequence) - length + 1)
    ]


class DataModule(pl.LightningDataModule):
    """The one data module: training in shuffled clips (or pairs of frames), evaluation in order of time.

    `datasets` and `transforms` are by stage: train, val, test; a stage may be missing. With `streams`, evaluation
    keeps every sequence on one rank, for filters and trackers; else the ranks get equal runs of frames.
    """

    def __init__(
        self,
        datasets: Mapping[str, Dataset],
        transforms: Mapping[str, Sequence[Transform]] | None = None,
        *,
        seed: int = 1,
        batch_size: int = 2,
        workers: int = 0,
        clip: int = 1,
        pairs: float = 0.0,
        timeout: float = 120,
        bad_sample: str = "error",
        streams: bool = True,
    ) -> None:
        super().__init__()
        self.datasets = dict(datasets)
        self.transforms = {stage: list((transforms or {}).get(stage, ())) for stage in datasets}
        self.seed = seed
        self.batch_size = _at_least("loader.batch_size", batch_size, 1)
        self.workers = _at_least("loader.workers", workers, 0)
        self.clip = _at_least("loader.clip", clip, 1)
        self.pairs = _at_least("loader.pairs", pairs, 0)
        if self.pairs and (self.clip > 1 or self.batch_size % 2):
            raise ConfigError("loader.pairs needs an even loader.batch_size and loader.clip=1")
        self.timeout = _at_least("loader.timeout", timeout, 1)
        if bad_sample not in BAD_SAMPLE_POLICIES:
            raise ConfigError(f"loader.bad_sample is {bad_sample!r}; use one of: {', '.join(BAD_SAMPLE_POLICIES)}")
        self.skip = bad_sample == "skip"
        self.streams = streams
        self.idle = False  # whether this rank has nothing to evaluate, and reads a frame only to keep step
        self._train_loader: FrameLoader | None = None
        self._resume: dict[str, int] | None = None

    @classmethod
    def from_config(cls, config: DictConfig, stages: Sequence[str], streams: bool = True) -> DataModule:
        """Datasets of `config.splits` for these stages (train, val, test), with the transforms of the config."""
        from lidarfw.assembly import make_dataset, make_transforms

        there = [stage for stage in stages if config.splits.get(stage)]
        datasets = {stage: make_dataset(config, config.splits[stage]) for stage in there}
        transforms = {stage: make_transforms(config, training=stage == "train") for stage in there}
        return cls(datasets, transforms, seed=config.seed, streams=streams, **config.loader)

    def prepare_data(self) -> None:
        """Let datasets and transforms get their files ready; Lightning calls this on one process per node."""
        for name, dataset in self.datasets.items():
            _prepare(dataset, self.transforms[name], max(self.workers, 1))

    def setup(self, stage: str) -> None:
        """Tell the transforms which dataset they work on."""
        for name, dataset in self.datasets.items():
            _attach(dataset, self.transforms[name])

    def train_dataloader(self) -> FrameLoader:
        """Every clip once per epoch, in the order of (seed, epoch)."""
        dataset = self._dataset("train")
        clips = clips_of(dataset, self.clip)
        if not clips:
            longest = max((len(s) for s in dataset.sequences()), default=0)
            raise ConfigError(f"loader.clip is {self.clip}, but the longest sequence has {longest} frames")
        order = self._pair_order(dataset) if self.pairs else self._clip_order(len(clips))
        loader = self._loader(Clips(dataset, self.transforms["train"], clips, self.seed, replace=self.skip), order)
        if self._resume is not None:
            loader.load_state_dict(self._resume)
        self._resume, self._train_loader = None, loader
        return loader

    def _clip_order(self, clips: int) -> BatchOrder:
        shuffle = not getattr(self.trainer, "overfit_batches", 0)
        return BatchOrder(clips, self.batch_size, seed=self.seed, shuffle=shuffle, rank=self.rank, world=self.world)

    def _pair_order(self, dataset: Dataset) -> BatchOrder:
        positions = dataset.positions()
        if positions is None:
            name = type(dataset).__name__
            raise ConfigError(f"loader.pairs needs poses, and {name} gives none.\n  fix: loader.pairs=0, or its poses")
        # numbers are those of clips, which go through the sequences one by one
        order = np.concatenate([np.asarray(sequence) for sequence in dataset.sequences()])
        return PairOrder(
            positions[order], self.pairs, self.batch_size, seed=self.seed, rank=self.rank, world=self.world
        )

    def failure(self, error: RuntimeError) -> DataError | None:
        """What an error means that torch raised in the midst of other work, because a training worker died."""
        if self._train_loader is None or "DataLoader worker" not in str(error):
            return None
        return self._train_loader.failure(error)

    def state_dict(self) -> dict[str, Any]:
        """Where the training data stands; part of every checkpoint."""
        return {"train": self._train_loader.state_dict()} if self._train_loader is not None else {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Let the next training loader go on there. Lightning's own way comes too late where the length of the run
        is asked for (by a scheduler, say) before the loops are restored."""
        self._resume = state_dict.get("train")

    def val_dataloader(self) -> FrameLoader:
        """The val split in order."""
        return self._evaluation("val")

    def test_dataloader(self) -> FrameLoader:
        """The test split in order."""
        return self._evaluation("test")

    def _evaluation(self, stage: str) -> FrameLoader:
        dataset = self._dataset(stage)
        runs = dataset.sequences()
        if not self.streams:
            whole = [index for run in runs for index in run]
            bounds = [len(whole) * rank // self.world for rank in range(self.world + 1)]
            runs = [whole[start:end] for start, end in itertools.pairwise(bounds)]
        frames = [(index,) for run in runs[self.rank :: self.world] for index in run]
        self.idle = not frames
        frames = frames or [(0,)]
        order = BatchOrder(len(frames), self.batch_size, seed=self.seed, shuffle=False)
        return self._loader(Clips(dataset, self.transforms[stage], frames, self.seed, replace=False), order)

    def _loader(self, clips: Clips, order: BatchOrder) -> FrameLoader:
        return FrameLoader(clips, order, workers=self.workers, timeout=self.timeout, skip=self.skip)

    def _dataset(self, stage: str) -> Dataset:
        if stage not in self.datasets:
            raise ConfigError(f"there is no {stage} data: splits.{stage} is not set\n  fix: splits.{stage}=NAME")
        dataset = self.datasets[stage]
        if not len(dataset):
            raise DataError(f"split {dataset.split!r} of {type(dataset).__name__} has no frames")
        return dataset

    @property
    def rank(self) -> int:
        """Number of this process in the run."""
        return self.trainer.global_rank if self.trainer else 0

    @property
    def world(self) -> int:
        """Processes of the run."""
        return self.trainer.world_size if self.trainer else 1


def _prepare(dataset: Dataset, transforms: Sequence[Transform], workers: int = 1) -> None:
    dataset.prepare()
    for transform in transforms:
        transform.prepare(dataset, workers)


def _attach(dataset: Dataset, transforms: Sequence[Transform]) -> None:
    for transform in transforms:
        transform.attach(dataset)


def make_ready(dataset: Dataset, transforms: Sequence[Transform]) -> None:
    """Get the files of a dataset and its transforms ready, and tell these what they work on, as a `DataModule` does."""
    _prepare(dataset, transforms)
    _attach(dataset, transforms)


def evaluation_data(config: Mapping[str, Any] | DictConfig, split: str) -> tuple[Dataset, list[Transform]]:
    """The dataset of a config for one split and its transforms of evaluation, ready to be read one by one."""
    from lidarfw.assembly import make_dataset, make_transforms

    dataset, transforms = make_dataset(config, split), make_transforms(config, training=False)
    make_ready(dataset, transforms)
    return dataset, transforms


def _at_least(key: str, value: Any, least: int) -> Any:
    if value < least:
        raise ConfigError(f"{key} must be at least {least}, got {value}")
    return value
