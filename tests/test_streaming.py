"""Streams: order, delay, reset, and going on from a saved state."""

from __future__ import annotations

import dataclasses
import io
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lidarfw.assembly import build, plan
from lidarfw.config import compose
from lidarfw.errors import CheckpointError
from lidarfw.interfaces import Filter, Tracker
from lidarfw.model import PerceptionModel
from lidarfw.plain import from_plain, to_plain
from lidarfw.streaming import Stream
from lidarfw.testing.synthetic import frames
from lidarfw.types import Batch, Boxes, Frame, FrameResult, Points, Tracks


@dataclass
class Held:
    frames: deque[FrameResult] = field(default_factory=deque)
    evidence: Tensor = field(default_factory=lambda: torch.zeros(1))


class Delay(Filter):
    """Holds `frames` frames back and adds up the scores it has seen."""

    def __init__(self, frames: int) -> None:
        super().__init__()
        self.frames = frames

    def start(self) -> Held:
        return Held()

    def step(self, state: Held, frame: FrameResult, points: Points) -> list[FrameResult]:
        assert len(points) == frame.predictions["points"]
        state.evidence = state.evidence * 0.5 + frame.of(Boxes).score.sum()
        state.frames.append(frame)
        return [self._done(state)] if len(state.frames) > self.frames else []

    def flush(self, state: Held) -> list[FrameResult]:
        return [self._done(state) for _ in range(len(state.frames))]

    def _done(self, state: Held) -> FrameResult:
        frame = state.frames.popleft()
        boxes = frame.of(Boxes)
        return frame.with_prediction(boxes, boxes.replace(score=boxes.score * 0 + state.evidence))


@dataclass
class Identity:
    number: int


@dataclass
class Numbers:
    given: list[Identity] = field(default_factory=list)


class Count(Tracker):
    """Gives every box the next number."""

    def start(self) -> Numbers:
        return Numbers()

    def step(self, state: Numbers, frame: FrameResult) -> list[FrameResult]:
        boxes = frame.of(Boxes)
        first = len(state.given)
        state.given += [Identity(first + i) for i in range(len(boxes))]
        frame.tracks = Tracks(boxes, torch.tensor([i.number for i in state.given[first:]], dtype=torch.long))
        return [frame]


class Oracle(nn.Module):
    """A model that gives the targets back."""

    def __init__(self, filters: dict[str, Filter]) -> None:
        super().__init__()
        self.filters = filters

    def predict(self, batch: Batch) -> list[FrameResult]:
        predictions = {"head.oracle": batch.targets.boxes, "points": len(batch.inputs["points"])}
        return [FrameResult(batch.meta[0], predictions, inputs=batch.inputs)]

    def filter_arguments(self, component: str, result: FrameResult) -> dict[str, Any]:
        return {"points": result.inputs["points"]} if component.startswith("filter") else {}


def stream(*delays: int, max_gap: float = 1.0) -> Stream:
    model = Oracle({**{f"filter.delay{i}": Delay(n) for i, n in enumerate(delays)}, "tracker.count": Count()})
    return Stream(model, max_gap)  # type: ignore[arg-type]


def run(stream: Stream, sequence: list[Frame]) -> list[FrameResult]:
    return [result for frame in sequence for result in stream.step(frame)]


def facts(results: list[FrameResult]) -> list[Any]:
    return [(r.meta.id, r.of(Boxes).score.tolist(), r.tracks.id.tolist() if r.tracks else None) for r in results]


def moved(street: list[Frame], shift: float = 0.0, **changes: Any) -> list[Frame]:
    """The frames again, later or in another sequence, under new ids."""
    news = [{"id": f"again_{f.meta.id}", "time": f.meta.time + shift, **changes} for f in street]
    return [f.replace(meta=dataclasses.replace(f.meta, **new)) for f, new in zip(street, news, strict=True)]


@pytest.fixture(scope="module")
def street() -> list[Frame]:
    return frames(6, points=1024)


def test_without_filters_every_frame_comes_out_at_once(street: list[Frame]) -> None:
    plain = Stream(Oracle({}))  # type: ignore[arg-type]
    assert [[r.meta.id for r in plain.step(f)] for f in street] == [[f.meta.id] for f in street]
    assert plain.flush() == []


@pytest.mark.parametrize("delays", [(0,), (2,), (10,), (1, 2), (2, 0, 1)])
def test_delayed_frames_come_out_once_and_in_order(street: list[Frame], delays: tuple[int, ...]) -> None:
    one = stream(*delays)
    early = run(one, street)
    assert len(early) == max(0, len(street) - sum(delays))
    assert [r.meta.id for r in early + one.flush()] == [f.meta.id for f in street]


def test_a_new_sequence_flushes_and_starts_anew(street: list[Frame]) -> None:
    one, fresh = stream(2), stream(2)
    together = run(one, street + moved(street, sequence="other")) + one.flush()
    alone = run(fresh, street) + fresh.flush()
    assert facts(together[:6]) == facts(alone)
    assert [f[1:] for f in facts(together[6:])] == [f[1:] for f in facts(alone)]


@pytest.mark.parametrize(("shift", "resets"), [(0.9, False), (1.2, True), (-0.6, True)])
def test_a_gap_in_time_starts_anew(street: list[Frame], shift: float, resets: bool) -> None:
    one = stream(1)
    later = moved(street, shift=street[-1].meta.time + shift)
    results = run(one, street + later) + one.flush()
    assert len(results) == 12
    ids = [r.tracks.id.min().item() for r in results if r.tracks is not None and len(r.tracks.id)]
    assert ids.count(0) == (2 if resets else 1)


def test_two_streams_of_one_model_do_not_touch_each_other(street: list[Frame]) -> None:
    model = Oracle({"filter.delay": Delay(1), "tracker.count": Count()})
    a, b, alone = (Stream(model) for _ in range(3))  # type: ignore[arg-type]
    mixed: list[FrameResult] = []
    for frame, other in zip(street, reversed(street), strict=True):
        mixed += a.step(frame)
        b.step(moved([other], sequence="b", time=frame.meta.time)[0])
    assert facts(mixed) == facts(run(alone, street))


@pytest.mark.parametrize("cut", [1, 3])
def test_a_saved_stream_goes_on_bit_for_bit(street: list[Frame], cut: int) -> None:
    whole, first, second = stream(2), stream(2), stream(2)
    expected = run(whole, street) + whole.flush()
    head = run(first, street[:cut])
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    run(first, street[cut:])  # the saved state is a copy
    tail = run(second, street[cut:]) + second.flush()
    assert facts(head + tail) == facts(expected)


def test_a_state_of_other_filters_is_refused() -> None:
    with pytest.raises(CheckpointError, match=r"ran filters .*delay0.* this model has \['tracker.count'\]"):
        stream().load_state_dict(stream(1).state_dict())


def test_plain_types_round_trip(street: list[Frame]) -> None:
    value = {"a": (1, 2.5, None), 3: {"x", "y"}, "array": np.arange(3), "number": np.float32(2), "frame": street[0]}
    back = from_plain(to_plain(value))
    assert back["a"] == value["a"]
    assert back[3] == value[3]
    assert isinstance(back["number"], np.float32)
    assert back["array"].dtype == np.arange(3).dtype
    assert back["frame"].meta == street[0].meta
    assert torch.equal(back["frame"].targets.boxes.tensor, street[0].targets.boxes.tensor)


def test_plain_types_refuse_what_could_run_code() -> None:
    with pytest.raises(CheckpointError, match=r"builtins.function cannot be saved|function cannot be saved"):
        to_plain({"call": lambda: None})
    with pytest.raises(CheckpointError, match="'Popen'"):
        from_plain({"type": "Popen", "fields": {"args": "true"}})


@pytest.fixture(scope="module")
def model() -> PerceptionModel:
    """The default detector, small, with a filter and a tracker that uses the poses."""
    near = ["backbone.pillars.lower=[0,-16,-3]", "backbone.pillars.upper=[32,16,1]"]
    chosen = ["filter=score", "filter.score.default_score=0.1", "tracker=greedy", "dataset.synthetic.pose=true"]
    torch.manual_seed(0)
    return build(plan(compose([*near, *chosen]))).eval()


def test_a_model_streams_with_its_filter_and_tracker(model: PerceptionModel) -> None:
    sequence = frames(4, points=1024, pose=True)
    whole, first, second = (model.stream() for _ in range(3))
    expected = run(whole, sequence) + whole.flush()
    assert [r.meta.id for r in expected] == [f.meta.id for f in sequence]
    assert sum(len(r.of(Boxes)) for r in expected) > 10
    for result in expected:
        assert result.tracks is not None
        assert len(result.tracks.id.unique()) == len(result.of(Boxes)) == len(result.tracks.boxes)
        assert (result.of(Boxes).score >= 0.1).all()
    head = run(first, sequence[:2])
    second.load_state_dict(first.state_dict())
    assert facts(head + run(second, sequence[2:])) == facts(expected)


def test_the_weights_of_a_model_do_not_change_in_a_stream(model: PerceptionModel) -> None:
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    run(model.stream(), frames(2, points=1024, pose=True))
    assert all(torch.equal(before[name], tensor) for name, tensor in model.state_dict().items())
