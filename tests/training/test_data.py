"""Loading: orders, clips, ranks, going on mid-epoch, broken frames, dying workers."""

import os
import signal
import time

import numpy as np
import pytest
import torch
from training_parts import ToyDataset, ToyJitter

from lidarfw.data import DataModule, FrameLoader
from lidarfw.errors import CheckpointError, ConfigError, DataError
from lidarfw.interfaces import Transform


def loader(**options) -> FrameLoader:
    dataset = options.pop("dataset", None) or ToyDataset(frames=options.pop("frames", 12))
    transforms = options.pop("transforms", [])
    stage = options.pop("stage", "train")
    data = DataModule({stage: dataset}, {stage: transforms}, **options)
    data.setup("fit")
    return getattr(data, f"{stage}_dataloader")()


def ids(batches) -> list[list[str]]:
    return [[meta.id for meta in batch.meta] for batch in batches]


def flat(batches: list[list[str]]) -> list[str]:
    return [name for batch in batches for name in batch]


def test_every_epoch_has_every_frame_in_an_order_of_its_own():
    frames = loader(batch_size=5)
    first, again = ids(frames), ids(frames)
    frames.order.set_epoch(1)
    second = ids(frames)
    assert first == again != second
    assert [len(batch) for batch in first] == [5, 5, 2]
    assert sorted(flat(first)) == sorted(flat(second)) == [f"train{i:03d}" for i in range(12)]


def test_another_seed_gives_another_order():
    assert ids(loader(seed=1)) != ids(loader(seed=2))


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_workers_do_not_change_the_batches(workers):
    made = [batch.inputs["points"].xyz for batch in loader(workers=workers, transforms=[ToyJitter()])]
    alone = [batch.inputs["points"].xyz for batch in loader(transforms=[ToyJitter()])]
    assert len(made) == 6
    assert all(torch.equal(a, b) for a, b in zip(made, alone, strict=True))


def test_augmentation_is_new_every_epoch():
    frames = loader(frames=1, transforms=[ToyJitter()])
    first = next(iter(frames)).inputs["points"].xyz
    frames.order.set_epoch(1)
    assert not torch.equal(first, next(iter(frames)).inputs["points"].xyz)


@pytest.mark.parametrize("workers", [0, 2])
def test_going_on_mid_epoch_gives_the_rest_of_it(workers):
    frames = loader(workers=workers)
    frames.order.set_epoch(3)
    whole = ids(frames)
    batches = iter(frames)
    for _ in range(4):
        next(batches)
    state = frames.state_dict()

    other = loader(workers=workers)
    other.load_state_dict(state)
    other.order.set_epoch(3)
    assert ids(other) == whole[4:]
    other.order.set_epoch(4)
    assert len(ids(other)) == 6


def test_going_on_at_the_end_of_an_epoch_gives_a_whole_new_one():
    frames = loader()
    list(frames)
    other = loader()
    other.load_state_dict(frames.state_dict())
    other.order.set_epoch(1)
    assert len(ids(other)) == 6


def test_going_on_with_another_batch_size_is_refused():
    state = loader().state_dict()
    with pytest.raises(CheckpointError, match="batches = 6, this run has 4") as error:
        loader(batch_size=3).load_state_dict(state)
    assert "init.from" in str(error.value)


def test_clips_are_consecutive_frames_of_one_sequence():
    batches = ids(loader(clip=3, batch_size=2))
    clips = [batch[i : i + 3] for batch in batches for i in range(0, len(batch), 3)]
    starts = [int(clip[0][-3:]) for clip in clips]
    assert sorted(starts) == [0, 1, 4, 5, 8, 9]
    assert all(clip == [f"train{s + i:03d}" for i in range(3)] for clip, s in zip(clips, starts, strict=True))


def test_frames_of_a_clip_are_augmented_alike():
    draws = []

    class Draw(Transform):
        def __call__(self, frame, rng: np.random.Generator):
            draws.append(rng.random())
            return frame

    next(iter(loader(clip=2, batch_size=2, transforms=[Draw()])))
    assert draws[0] == draws[1] != draws[2] == draws[3]


def test_clip_longer_than_any_sequence():
    with pytest.raises(ConfigError, match="longest sequence has 4"):
        loader(clip=5)


@pytest.mark.parametrize("world", [2, 5])
def test_ranks_share_an_epoch(world, monkeypatch):
    seen = []
    for rank in range(world):
        monkeypatch.setattr(DataModule, "rank", rank)
        monkeypatch.setattr(DataModule, "world", world)
        seen.append(ids(loader(batch_size=2)))
    assert len({len(batches) for batches in seen}) == 1
    frames = [name for batches in seen for batch in batches for name in batch]
    assert set(frames) == {f"train{i:03d}" for i in range(12)}
    assert len(frames) <= 12 + world - 1


def test_evaluation_gives_whole_sequences_in_order_to_one_rank(monkeypatch):
    seen = []
    for rank in range(2):
        monkeypatch.setattr(DataModule, "rank", rank)
        monkeypatch.setattr(DataModule, "world", 2)
        seen.append(flat(ids(loader(stage="val", batch_size=3, dataset=ToyDataset(split="val")))))
    assert seen[0] == [f"val{i:03d}" for i in (0, 1, 2, 3, 8, 9, 10, 11)]
    assert seen[1] == [f"val{i:03d}" for i in (4, 5, 6, 7)]


def test_evaluation_without_streams_gives_equal_runs_of_frames(monkeypatch):
    seen = []
    for rank in range(3):
        monkeypatch.setattr(DataModule, "rank", rank)
        monkeypatch.setattr(DataModule, "world", 3)
        frames = loader(stage="val", dataset=ToyDataset(split="val", frames=10, length=10), streams=False)
        seen.append(flat(ids(frames)))
    assert [len(part) for part in seen] == [3, 3, 4]
    assert flat(seen) == [f"val{i:03d}" for i in range(10)]


@pytest.mark.parametrize("workers", [0, 1])
def test_a_broken_frame_is_named(workers):
    with pytest.raises(DataError) as error:
        list(loader(dataset=ToyDataset(broken=[7]), workers=workers))
    message = str(error.value)
    assert message.startswith("sample train007: scan007.bin: size 7 is not a multiple of 16\n")
    assert "loader.bad_sample=skip" in message
    assert len(message.splitlines()) <= 10


def test_skipping_says_how_many_and_keeps_the_batches_full():
    frames = loader(dataset=ToyDataset(frames=40, broken=[7, 8]), batch_size=4, bad_sample="skip")
    with pytest.warns(UserWarning, match="2 of 40 skipped: sample train00[78]: scan00"):
        batches = ids(frames)
    assert [len(batch) for batch in batches] == [4] * 10
    assert not {"train007", "train008"} & set(flat(batches))


def test_skipping_in_evaluation_leaves_the_frame_out():
    frames = loader(stage="val", dataset=ToyDataset(split="val", broken=[2]), batch_size=4, bad_sample="skip")
    with pytest.warns(UserWarning, match="1 of 12 skipped"):
        seen = flat(ids(frames))
    assert seen == [f"val{i:03d}" for i in range(12) if i != 2]


def test_skipping_stops_above_a_limit():
    frames = loader(dataset=ToyDataset(broken=[1, 3, 5]), bad_sample="skip")
    with pytest.warns(UserWarning, match="skipped"), pytest.raises(DataError, match="the limit is 10%"):
        list(frames)


class Bug(Transform):
    def __call__(self, frame, rng):
        raise AttributeError("no such thing")


@pytest.mark.parametrize("workers", [0, 1])
def test_a_bug_is_never_skipped(workers):
    with pytest.raises(DataError, match=r"AttributeError: no such thing, at .*test_data.py:\d+"):
        list(loader(transforms=[Bug()], workers=workers, bad_sample="skip"))


class Unpicklable(Transform):
    def __call__(self, frame, rng):
        class LocalError(Exception):
            def __init__(self, a, b):
                super().__init__(a)

        raise LocalError("odd", 2)


def test_an_exception_that_cannot_be_pickled():
    with pytest.raises(DataError, match="LocalError: odd"):
        list(loader(transforms=[Unpicklable()], workers=1))


class Deadly(Transform):
    def __call__(self, frame, rng):
        if frame.meta.id == "train005":
            os.kill(os.getpid(), signal.SIGKILL)
        return frame


def test_a_killed_worker_is_told_with_the_batch():
    with pytest.raises(DataError) as error:
        list(loader(transforms=[Deadly()], workers=1))
    message = str(error.value)
    assert "worker died" in message
    assert "killed for memory?" in message
    assert "the batch that was waited for: train" in message


def test_a_worker_that_dies_between_two_batches_is_told_too(monkeypatch):
    """torch raises where the program is when the signal arrives: here while a batch is judged."""
    judge = FrameLoader._judge

    def slowly(self, bad):
        time.sleep(2)
        judge(self, bad)

    monkeypatch.setattr(FrameLoader, "_judge", slowly)
    with pytest.raises(DataError, match="worker died"):
        list(loader(transforms=[Deadly()], workers=1))


class Slow(Transform):
    def __call__(self, frame, rng):
        time.sleep(30)


def test_a_worker_that_hangs_ends_the_run():
    started = time.monotonic()
    with pytest.raises(DataError, match="no batch came within 1 s") as error:
        list(loader(transforms=[Slow()], workers=1, timeout=1))
    assert "train" in str(error.value)
    assert time.monotonic() - started < 20


def test_frames_that_make_no_batch_are_named():
    class Ragged(Transform):
        def __call__(self, frame, rng):
            points = frame.inputs["points"]
            wide = frame.meta.index % 2 + 1
            return frame.replace(inputs={"points": points.replace(features=torch.ones(len(points), wide))})

    with pytest.raises(DataError, match=r"samples train.* do not make a batch"):
        list(loader(transforms=[Ragged()], batch_size=12))


def test_a_split_without_frames():
    with pytest.raises(DataError, match="split 'train' of ToyDataset has no frames"):
        loader(frames=0)


@pytest.mark.parametrize(
    ("option", "value", "text"),
    [("batch_size", 0, "at least 1"), ("workers", -1, "at least 0"), ("clip", 0, "at least 1"),
     ("timeout", 0, "at least 1"), ("bad_sample", "ignore", "error, skip")],
)  # fmt: skip
def test_wrong_loader_options(option, value, text):
    with pytest.raises(ConfigError, match=f"loader.{option}.*{text}"):
        DataModule({}, **{option: value})
