"""Sequences of frames through model, filters and tracker, with one explicit state per sequence."""

from __future__ import annotations

import dataclasses
import typing
from typing import TYPE_CHECKING, Any

import torch

from lidarfw.errors import CheckpointError
from lidarfw.interfaces import Filter
from lidarfw.plain import from_plain, to_plain
from lidarfw.types import Frame, FrameMeta, FrameResult, collate

if TYPE_CHECKING:
    from lidarfw.model import PerceptionModel


class Stream:
    """One run of frames in order of time: `step` for each, `flush` at the end.

    Filters run in listed order and the tracker comes last. A filter may hold frames back, so `step` gives the
    frames that are finished now, none or several. A frame of another sequence, an earlier time, or one more than
    `max_gap` seconds later ends the run: what was held back comes out first, then every state starts anew.
    The state lives here, not in the components: one model serves any number of streams.
    """

    def __init__(self, model: PerceptionModel, max_gap: float = 1.0) -> None:
        self.model = model
        self.max_gap = max_gap
        self._filters: dict[str, Filter] = model.filters
        self._states: dict[str, Any] = {}
        self._last: FrameMeta | None = None

    @torch.no_grad()
    def step(self, frame: Frame) -> list[FrameResult]:
        """Run the model on the next frame; the frames that are finished now, in order."""
        device = next((p.device for p in self.model.parameters()), torch.device("cpu"))
        return self.advance(self.model.predict(collate([frame]).to(device))[0])

    @torch.no_grad()
    def advance(self, result: FrameResult) -> list[FrameResult]:
        """Like `step`, for a frame that the model has predicted already."""
        finished = self.flush() if self._ends_run(result.meta) else []
        if self._last is None:
            self._states = {name: part.start() for name, part in self._filters.items()}
        self._last = result.meta
        return finished + self._run([result], list(self._filters))

    @torch.no_grad()
    def flush(self) -> list[FrameResult]:
        """End the run: the frames that were held back, in order. The next frame starts anew."""
        names = list(self._filters) if self._last is not None else []
        finished: list[FrameResult] = []
        for position, name in enumerate(names):
            finished += self._run(self._filters[name].flush(self._states[name]), names[position + 1 :])
        self._states, self._last = {}, None
        return finished

    def _ends_run(self, meta: FrameMeta) -> bool:
        last = self._last
        return last is not None and (
            meta.sequence != last.sequence or meta.time < last.time or meta.time - last.time > self.max_gap
        )

    def _run(self, results: list[FrameResult], names: list[str]) -> list[FrameResult]:
        for name in names:
            results = [done for result in results for done in self._step_filter(name, result)]
        return results

    def _step_filter(self, name: str, result: FrameResult) -> list[FrameResult]:
        return self._filters[name].step(self._states[name], result, **self.model.filter_arguments(name, result))

    def _classes(self) -> dict[str, type]:
        """Dataclasses that the filters keep as state or inside it, by component and class name."""
        found: dict[str, type] = {}
        for name, part in self._filters.items():
            state = type(part.start())
            found |= {f"{name}:{cls.__qualname__}": cls for cls in _dataclasses_in(state)}
        return found

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on from here, in plain types and tensors; a copy."""
        state = {"filters": list(self._filters), "states": self._states, "last": self._last}
        return {name: to_plain(value, self._classes()) for name, value in state.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where the stream that gave `state` stood. CheckpointError when its filters were others."""
        if state["filters"] != list(self._filters):
            raise CheckpointError(
                f"the saved stream ran filters {state['filters']}, this model has {list(self._filters)}.\n"
                "  fix: load the model that the stream was saved with"
            )
        self._states = from_plain(state["states"], self._classes())
        self._last = from_plain(state["last"])


def _dataclasses_in(annotation: Any) -> set[type]:
    """The dataclasses that an annotation names, through containers and fields; types of lidarfw end the search."""
    inner = {cls for argument in typing.get_args(annotation) for cls in _dataclasses_in(argument)}
    if not (isinstance(annotation, type) and dataclasses.is_dataclass(annotation)):
        return inner
    if annotation.__module__.startswith("lidarfw.types"):
        return set()
    hints = typing.get_type_hints(annotation).values()
    return {annotation}.union(*(_dataclasses_in(hint) for hint in hints if hint is not annotation))
