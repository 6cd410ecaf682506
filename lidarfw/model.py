"""The model of a plan: runs the components in order, collects losses, decodes and post-processes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from torch import Tensor, nn

from lidarfw.assembly import Plan, Ref, Step
from lidarfw.declaration import Parameter
from lidarfw.interfaces import Filter
from lidarfw.types import Batch, FrameResult, Record, take

if TYPE_CHECKING:
    from lidarfw.streaming import Stream

_MODULE_SLOTS = ("backbone", "neck", "head", "loss", "postprocessor", "filter", "tracker", "retriever")


class PerceptionModel(nn.Module):
    """Components wired by a plan. Parameter names are config names: `head.center.shared.weight`."""

    def __init__(self, plan: Plan, modules: dict[str, Any]) -> None:
        super().__init__()
        self.plan = plan
        for slot in _MODULE_SLOTS:
            setattr(self, slot, nn.ModuleDict({step.name: modules[step.id] for step in plan.of(slot)}))
        # metrics hold figures, not weights: they stay out of state_dict
        self._metrics: dict[str, Any] = {step.name: modules[step.id] for step in plan.of("metric")}

    def component(self, step: Step) -> Any:
        """The module of a step."""
        return self._metrics[step.name] if step.slot == "metric" else getattr(self, step.slot)[step.name]

    # features and raw outputs

    def forward(self, batch: Batch) -> dict[str, Any]:
        """What every backbone, neck and head (and trainable tracker, in training) returns, by name ("head.center")."""
        outputs: dict[str, Any] = {f"data.{name}": value for name, value in batch.inputs.items()}
        for slot in ("backbone", "neck", "head"):
            for step in self.plan.of(slot):
                outputs[step.id] = self._call(step, step.declared.takes, outputs, batch)
        for step in self.plan.of("tracker"):
            if self.training and step.declared.trainable is not None:
                attached = self._attached(step, outputs)
                outputs[step.id] = self._call(step, step.declared.trainable, {**outputs, **attached}, batch)
        return outputs

    def _attached(self, step: Step, outputs: dict[str, Any]) -> dict[str, Any]:
        """Predictions that a tracker trains on, still in the graph: its losses reach the head that made them."""
        heads = {ref.producer for refs in step.takes.values() for ref in refs if ref.item == "value"}
        heads = {head for head in heads if head.startswith("head.")}
        return {f"{head}.decoded": self._decode(head, outputs) for head in heads}

    def losses(self, outputs: dict[str, Any], batch: Batch, progress: float = 1.0) -> dict[str, dict[str, Tensor]]:
        """Weighted terms of every loss: name -> term -> scalar. `progress` is the share of training done, for ramps."""
        terms = {}
        for step in self.plan.of("loss"):
            weight = step.weight * (min(1.0, progress / step.ramp) if step.ramp > 0 else 1.0)
            if weight != 0:
                found = self._call(step, step.declared.takes, outputs, batch, progress)
                terms[step.name] = {name: weight * term for name, term in found.items()}
        return terms

    # predictions

    def predict(self, batch: Batch) -> list[FrameResult]:
        """Forward, decode and post-process: one result per frame."""
        return self.decode(self(batch), batch)

    def decode(self, outputs: dict[str, Any], batch: Batch) -> list[FrameResult]:
        """Predictions of every head that no later one replaced, post-processed, one result per frame."""
        final = {ref.producer for ref in self.plan.visible}
        predicted = {h.id: self._decoded(h.id, outputs) for h in self.plan.of("head") if h.id in final}
        for step in self.plan.of("postprocessor"):
            arguments = {
                p.name: self._argument(step, p, {**outputs, **predicted}, predicted) for p in step.declared.takes
            }
            result = self.component(step)(**arguments, **self._special(step, batch))
            replaced = step.replaces
            predicted[replaced[0].producer if replaced else step.id] = result
        taps = {name: outputs[name].tap for name in self._asked("tap")}
        hidden = {name: self._decoded(name, outputs) for name in self._asked("value") - final}
        columns = (predicted, batch.inputs, taps, hidden)
        return [self._result(batch, number, *columns) for number in range(len(batch))]

    def _asked(self, item: str) -> set[str]:
        """The heads whose tap or value a metric asks for."""
        refs = [ref for step in self.plan.of("metric") for taken in step.takes.values() for ref in taken]
        return {ref.producer for ref in refs if ref.item == item and ref.producer.startswith("head.")}

    def _result(self, batch: Batch, number: int, *columns: dict[str, Any]) -> FrameResult:
        own = [{name: take(value, number) for name, value in column.items()} for column in columns]
        return FrameResult(batch.meta[number], own[0], None, take(batch.targets, number), *own[1:])

    # wiring at run time

    def _call(
        self,
        step: Step,
        parameters: Iterable[Parameter],
        outputs: dict[str, Any],
        batch: Batch,
        progress: float = 1.0,
    ) -> Any:
        arguments = {p.name: self._argument(step, p, outputs) for p in parameters}
        return self.component(step)(**arguments, **self._special(step, batch, progress))

    def _special(self, step: Step, batch: Batch, progress: float = 1.0) -> dict[str, Any]:
        """`targets` (losses always, other components in training only), `meta` and `progress`, where asked for."""
        special: dict[str, Any] = {}
        if "targets" in step.declared.special:
            special["targets"] = batch.targets if self.training or step.slot == "loss" else None
        if "meta" in step.declared.special:
            special["meta"] = batch.meta
        if "progress" in step.declared.special:
            special["progress"] = progress
        return special

    def _argument(
        self, step: Step, p: Parameter, outputs: dict[str, Any], predicted: dict[str, Any] | None = None
    ) -> Any:
        refs = [ref for ref in step.takes[p.name] if not (p.optional and _is_absent_input(ref, outputs))]
        values = [self._value(ref, outputs, predicted) for ref in refs]
        if p.form == "dict":
            return {ref.producer.partition(".")[2]: value for ref, value in zip(refs, values, strict=True)}
        if not values:
            return None
        levels = [v for value in values for v in (value if isinstance(value, list) else [value])]
        if p.form == "list":
            return levels
        if p.stride is not None and len(levels) > 1:
            return next(level for level in levels if level.stride == p.stride)
        return max(levels, key=lambda level: level.stride) if len(levels) > 1 else levels[0]

    def _value(self, ref: Ref, outputs: dict[str, Any], predicted: dict[str, Any] | None) -> Any:
        if predicted is not None and ref.item == "value" and ref.producer in predicted:
            return predicted[ref.producer]
        if ref.item == "tap" and f"{ref.producer}.tap" in outputs:  # of a finished frame
            return outputs[f"{ref.producer}.tap"]
        value = outputs[ref.producer]
        if ref.item == "output":
            return value
        if ref.item == "tap":
            return value.tap
        if ref.producer.startswith("head."):
            return self._decoded(ref.producer, outputs)
        return next(part for part in value if _is(part, ref.kind)) if isinstance(value, tuple) else value

    def _decoded(self, head: str, outputs: dict[str, Any]) -> Any:
        """The prediction of a head, decoded once per batch; cut from the graph, but for trackers (`_attached`)."""
        key = f"{head}.decoded"
        if key not in outputs:
            outputs[key] = self._decode(head, outputs).detach()
        return outputs[key]

    def _decode(self, head: str, outputs: dict[str, Any]) -> Record:
        part: Any = self.get_submodule(head)
        decoded: Record = part.decode(outputs[head])
        return decoded

    # streams

    @property
    def filters(self) -> dict[str, Filter]:
        """Filters in order, then the tracker, by name ("filter.bayes")."""
        return {step.id: self.component(step) for slot in ("filter", "tracker") for step in self.plan.of(slot)}

    def filter_arguments(self, name: str, result: FrameResult) -> dict[str, Any]:
        """What a filter's or tracker's `step` takes beside state and frame."""
        step = next(step for step in self.plan.steps if step.id == name)
        return self._from_result(step, result)

    def stream(self) -> Stream:
        """A stream over this model: state of its filters and tracker for one vehicle."""
        from lidarfw.streaming import Stream

        return Stream(self)

    def _from_result(self, step: Step, result: FrameResult) -> dict[str, Any]:
        found: dict[str, Any] = {f"data.{name}": value for name, value in result.inputs.items()}
        found |= {**result.replaced, **result.predictions}
        found |= {f"{name}.tap": tap for name, tap in result.taps.items()}
        found |= {step.id: result.tracks for step in self.plan.of("tracker")}
        arguments = {p.name: self._argument(step, p, found, found) for p in step.declared.takes}
        if "targets" in step.declared.special:
            arguments["targets"] = result.targets
        if "meta" in step.declared.special:
            arguments["meta"] = [result.meta]
        return arguments

    # metrics

    def update_metrics(self, results: list[FrameResult], metrics: Mapping[str, Any] | None = None) -> None:
        """Count finished frames in; `metrics` are others of the same names, where not the model's own."""
        for result in results:
            for step in self.plan.of("metric"):
                (metrics or self._metrics)[step.name].update(**self._from_result(step, result))

    def compute_metrics(self) -> dict[str, float]:
        """All figures, as "metric/key"."""
        figures: dict[str, float] = {}
        for name, metric in self._metrics.items():
            figures |= {f"{name}/{key}": float(value) for key, value in metric.compute().items()}
        return figures

    def reset_metrics(self) -> None:
        """Forget all counts."""
        for metric in self._metrics.values():
            metric.reset()

    @property
    def metrics(self) -> dict[str, Any]:
        """The metrics by name."""
        return self._metrics

    @property
    def monitor(self) -> str | None:
        """The figure that stands for the run: `monitor` of the first metric, as "metric/key"."""
        for name, metric in self._metrics.items():
            return f"{name}/{metric.monitor}"
        return None


def _is_absent_input(ref: Ref, outputs: dict[str, Any]) -> bool:
    """Whether a frame lacks an input that its dataset gives: a scan by itself has no pose, say."""
    return ref.producer.startswith("data.") and ref.producer not in outputs


def _is(value: Any, kind: type) -> bool:
    return isinstance(value[0] if isinstance(value, list) and value else value, kind)


__all__ = ["PerceptionModel"]
