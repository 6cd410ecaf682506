"""A component under test: built from made-up Specs, called with made-up inputs."""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from lidarfw import declaration, registry
from lidarfw.declaration import Declaration, Parameter
from lidarfw.errors import AssemblyError
from lidarfw.types import VOCABULARY


class FailedError(Exception):
    """The component does not do what a check asks; the message says what it did."""


class SkippedError(Exception):
    """A check does not apply; the message says why."""


def require(condition: Any, message: str) -> None:
    """FailedError with that message unless the condition holds."""
    if not condition:
        raise FailedError(message)


@dataclass(frozen=True)
class Check:
    """One named check and the slots that it applies to."""

    name: str
    slots: tuple[str, ...]
    run: Callable[[Subject], None]


CHECKS: list[Check] = []


def check(*slots: str) -> Callable[[Callable[[Subject], None]], Callable[[Subject], None]]:
    """Make a function a check of components of these slots; its docstring is what `lidarfw check` explains."""

    def add(function: Callable[[Subject], None]) -> Callable[[Subject], None]:
        CHECKS.append(Check(function.__name__, slots, function))
        return function

    return add


@dataclass(frozen=True)
class Subject:
    """A component by slot and name; `given` is the class itself where it is not registered."""

    slot: str
    name: str
    given: type | None = None

    @property
    def id(self) -> str:
        return f"{self.slot}.{self.name}"

    @functools.cached_property
    def cls(self) -> Any:
        """The class, imported."""
        return self.given or registry.load(self.slot, self.name)

    @functools.cached_property
    def declared(self) -> Declaration:
        """What its signatures say."""
        return declaration.of_class(self.slot, self.cls)

    @property
    def options(self) -> dict[str, Any]:
        """Its defaults, and what the class attribute `example` says for the rest."""
        options: dict[str, Any] = copy.deepcopy(getattr(self.cls, "example", {}))
        missing = [
            n for n, o in self.declared.options.items() if o.default is declaration.REQUIRED and n not in options
        ]
        require(not missing, f"option {', '.join(missing)} has no default: add a class attribute example = {{...}}")
        return options

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Everything that it takes, a tracker's forward and step alike."""
        extra = self.declared.trainable or ()
        return (*self.declared.takes, *(p for p in extra if p.name not in {t.name for t in self.declared.takes}))


@dataclass
class Built:
    """An instance, the Specs it was built from, and the heads whose outputs it reads."""

    subject: Subject
    module: Any
    specs: dict[str, Any]
    heads: dict[str, Built]

    def arguments(self, frames: Sequence[Any], training: bool) -> dict[str, Any]:
        """Made-up inputs of its forward for the frames."""
        from lidarfw.testing import examples

        declared = self.subject.declared
        takes = declared.trainable or () if self.subject.slot == "tracker" else declared.takes
        found = {p.name: self._argument(p, frames, training) for p in takes}
        if "targets" in declared.special:
            found["targets"] = examples.targets(frames) if training or self.subject.slot == "loss" else None
        if "meta" in declared.special:
            found["meta"] = [frame.meta for frame in frames]
        if "progress" in declared.special:
            found["progress"] = 0.5
        return found

    def _argument(self, p: Parameter, frames: Sequence[Any], training: bool) -> Any:
        from lidarfw.testing.examples import example

        spec = self.specs[p.name]
        if p.name in self.heads:
            head = self.heads[p.name]
            return head.module.train(training)(**head.arguments(frames, training))
        if isinstance(spec, list):
            return [example(level, frames, f"{p.name}{number}") for number, level in enumerate(spec)]
        if isinstance(spec, dict):
            return {name: example(one, frames, name) for name, one in spec.items()}
        return None if spec is None else example(spec, frames, p.name)

    def run(self, frames: Sequence[Any], training: bool = False) -> Any:
        """What forward gives for the frames."""
        return self.module.train(training)(**self.arguments(frames, training))

    def result(self, frames: Sequence[Any]) -> Any:
        """What it provides for the frames in evaluation: what forward returns, of a head what decode returns."""
        import torch

        with torch.no_grad():
            output = self.run(frames)
            return self.module.decode(output) if self.subject.slot == "head" else output


def build(subject: Subject, variation: Any = None, *, seed: int = 0, optional: bool = True) -> Built:
    """An instance with random weights of that seed; without its optional inputs unless `optional`."""
    import torch

    from lidarfw.testing import examples

    variation = variation or examples.VARIATIONS[0]
    heads = {p.name: build(_head_giving(p), variation) for p in subject.parameters if isinstance(p.kind, str)}
    specs = {p.name: None if p.optional and not optional else _specs(p, variation, heads) for p in subject.parameters}
    given = {
        name: _data_spec(subject) if name == "data" else _spec(subject, specs, name) for name in subject.declared.specs
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Built(subject, subject.cls(**given, **subject.options), specs, heads)


def _spec(subject: Subject, specs: dict[str, Any], name: str) -> Any:
    require(name in specs, f"__init__ asks for the Spec {name!r}, which is no parameter of its forward")
    return specs[name]


def _specs(p: Parameter, variation: Any, heads: dict[str, Built]) -> Any:
    from lidarfw.testing.examples import spec_of

    if p.name in heads:
        return heads[p.name].module.provides
    require(p.kind in VOCABULARY.values(), f"parameter {p.name!r} is no type of lidarfw.types and no head's output")
    if p.form == "list":
        return [spec_of(p.kind, variation, level=level) for level in range(3)]
    if p.form == "dict":
        return {name: spec_of(p.kind, variation) for name in ("first", "second")}
    return spec_of(p.kind, variation if p.stride is None else dataclasses.replace(variation, stride=p.stride))


def _head_giving(p: Parameter) -> Subject:
    slots = ("head", "tracker")
    found = [(slot, d.entry.name) for slot in slots for d in declaration.all_declarations(slot) if d.output == p.kind]
    require(found, f"parameter {p.name!r} is {p.kind}, which no installed head or tracker returns")
    return Subject(*found[0])


def _data_spec(subject: Subject) -> Any:
    from lidarfw.testing.examples import CLASSES, spec_of
    from lidarfw.types import Boxes, DataSpec, Image, PointLabels, Points, Poses, Tracks

    inputs = {"points": spec_of(Points), "image": spec_of(Image), "pose": spec_of(Poses)}
    sweeps = max([1, *(p.sweeps or 1 for p in subject.parameters)])
    return DataSpec(inputs, frozenset({Boxes, PointLabels, Poses, Tracks}), CLASSES, sweeps)


def accepted_variations(subject: Subject) -> Iterator[tuple[Any, Built]]:
    """Every variation of the Specs that the component can be built from; FailedError where it refuses all."""
    from lidarfw.testing.examples import VARIATIONS

    refusals = []
    for variation in VARIATIONS:
        try:
            built = build(subject, variation)
        except AssemblyError as error:
            refusals.append(str(error))
            continue
        yield variation, built
    require(len(refusals) < len(VARIATIONS), f"refuses every Spec it is offered: {refusals[:1]}")
