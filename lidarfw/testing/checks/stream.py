"""Checks of filters and trackers over sequences of frames."""

from __future__ import annotations

import dataclasses
import io
from typing import Any

import torch

from lidarfw.declaration import Parameter
from lidarfw.streaming import Stream
from lidarfw.testing.checks.compare import difference
from lidarfw.testing.checks.subject import Built, Subject, build, check, require
from lidarfw.testing.examples import empty, example, spec_of, street
from lidarfw.types import Boxes, Frame, FrameResult, PointLabels, Tracks

STREAMED = ("filter", "tracker")


class Replay:
    """Stands for a model: its frames are predicted already."""

    def __init__(self, built: Built) -> None:
        self.built = built
        self.filters = {built.subject.id: built.module.eval()}

    def filter_arguments(self, name: str, result: FrameResult) -> dict[str, Any]:
        """Predictions and inputs of the frame, by the kinds that `step` asks for."""
        found = {p.name: self._argument(p, result) for p in self.built.subject.declared.takes}
        special = {"targets": result.targets, "meta": [result.meta]}
        return found | {n: special[n] for n in self.built.subject.declared.special}

    def _argument(self, p: Parameter, result: FrameResult) -> Any:
        values = [v for v in (*result.predictions.values(), *result.inputs.values()) if isinstance(v, p.kind)]
        if p.optional and p.kind not in (Boxes, PointLabels):
            return next(iter(values), None)
        require(values, f"step asks for {p}, which no example frame has")
        return {"first": values[0]} if p.form == "dict" else [values[0]] if p.form == "list" else values[0]


def _stream(built: Built) -> Stream:
    return Stream(Replay(built))  # type: ignore[arg-type]


def _results(frames: list[Frame]) -> list[FrameResult]:
    specs = {"head.boxes": spec_of(Boxes), "head.points": spec_of(PointLabels)}
    return [
        FrameResult(f.meta, {n: example(s, [f]) for n, s in specs.items()}, None, f.targets, dict(f.inputs))
        for f in frames
    ]


def _run(stream: Stream, results: list[FrameResult]) -> list[FrameResult]:
    return [done for result in results for done in stream.advance(result)]


def _sequence() -> list[FrameResult]:
    frames = list(street(6))
    return _results([*frames[:2], dataclasses.replace(empty(frames[2]), meta=frames[2].meta), *frames[3:]])


@check(*STREAMED)
def every_frame_comes_out_once_in_order(subject: Subject) -> None:
    """After flush every frame that went in has come out, once and in order; an empty one and a lone one too."""
    sequence = _sequence()
    for results in (sequence, sequence[:1]):
        stream = _stream(build(subject))
        out = [r.meta.id for r in _run(stream, results) + stream.flush()]
        require(out == [r.meta.id for r in results], f"frames in: {[r.meta.id for r in results]}, out: {out}")


@check(*STREAMED)
def streams_do_not_touch_each_other(subject: Subject) -> None:
    """Two interleaved streams of one component give what two separate runs give."""
    built, sequence = build(subject), _sequence()
    first, second, alone = (_stream(built) for _ in range(3))
    mixed: list[FrameResult] = []
    for result, other in zip(sequence, _results(list(reversed(street(6)))), strict=True):
        mixed += first.advance(result)
        second.advance(dataclasses.replace(other, meta=dataclasses.replace(other.meta, time=result.meta.time)))
    text = difference(_run(alone, _sequence()) + alone.flush(), mixed + first.flush())
    require(not text, f"a stream gives another result when a second one runs beside it: {text}")


@check(*STREAMED)
def a_saved_state_goes_on_bit_for_bit(subject: Subject) -> None:
    """A state saved in the middle of a sequence, by weights_only means, goes on as if nothing had happened."""
    built = build(subject)
    whole, first, second = (_stream(built) for _ in range(3))
    expected = _run(whole, _sequence()) + whole.flush()
    head = _run(first, _sequence()[:3])
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    _run(first, _sequence()[3:])
    second.load_state_dict(torch.load(io.BytesIO(file.getvalue()), weights_only=True))
    text = difference(expected, head + _run(second, _sequence()[3:]) + second.flush())
    require(not text, f"the run that was saved and restored differs: {text}")


@check("tracker")
def a_still_object_keeps_its_id(subject: Subject) -> None:
    """An object that stays where it is has one id through the sequence, and every box has an id of its own."""
    from lidarfw.testing.synthetic import frames

    still = frames(1, points=2048, image=True, pose=True)[0]
    times = [dataclasses.replace(still.meta, id=str(i), index=i, time=0.1 * i) for i in range(5)]
    results = _results([still.replace(meta=meta) for meta in times])
    truth = still.targets.boxes
    for result in results:
        result.predictions["head.boxes"] = truth
    stream = _stream(build(subject))
    out = _run(stream, results) + stream.flush()
    require(all(isinstance(r.tracks, Tracks) for r in out), "a frame came out without tracks")
    ids = [r.tracks.id.tolist() for r in out if r.tracks is not None]
    require(len(set(ids[-1])) == len(ids[-1]), f"two boxes share an id: {ids[-1]}")
    require(ids[-1] and ids[-1] == ids[-2], f"the ids of still objects changed from {ids[-2]} to {ids[-1]}")
