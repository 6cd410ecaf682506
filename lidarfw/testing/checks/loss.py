"""Checks of losses and metrics."""

from __future__ import annotations

import math
import warnings
from typing import Any

import torch
from torch import Tensor

from lidarfw.testing.checks.compare import copied, floats
from lidarfw.testing.checks.subject import FailedError, Subject, build, check, require
from lidarfw.testing.examples import empty, example, street, targets
from lidarfw.types import Boxes, PointLabels, Poses, Targets, Tracks

NOTHING = Targets()


def _terms(module: Any, arguments: dict[str, Any]) -> dict[str, Tensor]:
    terms: dict[str, Tensor] = module(**arguments)
    require(isinstance(terms, dict) and terms, f"forward must return named terms, it returned {type(terms).__name__}")
    for name, term in terms.items():
        require(isinstance(term, Tensor) and term.shape == (), f"term {name!r} is no scalar tensor")
        require(bool(term.isfinite()), f"term {name!r} is {float(term.detach())}")
        require(term.requires_grad, f"term {name!r} does not depend on what the heads gave")
    return terms


def _free(arguments: dict[str, Any]) -> tuple[dict[str, Any], list[Tensor]]:
    """The arguments with every floating-point tensor of a head or feature as a free variable."""

    def free(tensor: Tensor) -> Tensor:
        tensor = tensor.detach().clone()
        return tensor.requires_grad_() if tensor.is_floating_point() else tensor

    inputs = {name: value for name, value in arguments.items() if name not in ("targets", "meta")}
    freed = {**arguments, **copied(inputs, free)}
    return freed, floats({name: freed[name] for name in inputs})


@check("loss")
def terms_are_finite_scalars(subject: Subject) -> None:
    """Named scalar terms, finite and attached to the graph: with objects, without, and with an empty frame."""
    built = build(subject)
    for frames in (street()[:2], [empty(street()[0])], [empty(street()[0]), street()[1]]):
        _terms(built.module, _free(built.arguments(frames, training=True))[0])


@check("loss")
def nothing_labelled_costs_nothing(subject: Subject) -> None:
    """A batch without any targets gives 0, attached to the graph."""
    built = build(subject)
    arguments, _ = _free(built.arguments(street()[:2], training=True))
    if "targets" not in arguments:
        return
    for name, term in _terms(built.module, {**arguments, "targets": NOTHING}).items():
        require(float(term.detach()) == 0, f"term {name!r} is {float(term.detach())} without targets, expected 0")


@check("loss")
def falls_when_outputs_follow_it(subject: Subject) -> None:
    """Outputs that move against the gradient cost less."""
    built = build(subject)
    arguments, variables = _free(built.arguments(street(), training=True))  # losses between frames need several
    first = _total(built.module, arguments)
    first.backward()  # type: ignore[no-untyped-call]
    gradients = [v.grad for v in variables]
    moved = [(v, g) for v, g in zip(variables, gradients, strict=True) if g is not None]
    size = math.sqrt(sum(float((g**2).sum()) for _, g in moved))
    require(size > 0, "the gradient is 0 everywhere, with objects to learn")
    for step in (1.0, 0.1, 0.01, 0.001):
        with torch.no_grad():
            for variable, gradient in moved:
                variable -= step * gradient / size
            lower = float(_total(built.module, arguments)) < float(first)
            for variable, gradient in moved:
                variable += step * gradient / size
        if lower:
            return
    raise FailedError("the total does not fall along its negative gradient")


def _total(module: Any, arguments: dict[str, Any]) -> Tensor:
    return torch.stack(list(module(**arguments).values())).sum()


@check("loss")
def gradients_are_finite(subject: Subject) -> None:
    """Gradients with respect to outputs and own parameters are finite, with objects and without."""
    built = build(subject)
    for frames in (street()[:2], [empty(street()[0])]):
        arguments, variables = _free(built.arguments(frames, training=True))
        _total(built.module.train(), arguments).backward()  # type: ignore[no-untyped-call]
        for tensor in [*variables, *built.module.parameters()]:
            require(tensor.grad is None or bool(tensor.grad.isfinite().all()), "a gradient is not finite")


@check("metric")
def figures_are_finite_floats(subject: Subject) -> None:
    """`compute` gives finite floats, `monitor` among them, also for no frame, an empty frame and an unlabelled one."""
    frame = street()[0]
    unlabelled = frame.replace(targets=NOTHING, meta=frame.meta)
    for what, frames in (
        ("no frame", []),
        ("an empty frame", [empty(frame)]),
        ("an unlabelled frame", [unlabelled]),
        ("labelled frames", list(street()[:2])),
    ):
        figures = _figures(subject, frames)
        monitor = subject.cls.monitor
        known = monitor in figures or what != "labelled frames"
        require(known, f"monitor {monitor!r} is not among the figures {sorted(figures)}")
        bad = [name for name, value in figures.items() if not math.isfinite(value)]
        require(not bad, f"{what}: {', '.join(bad)} is not finite")


@check("metric")
def the_truth_scores_best(subject: Subject) -> None:
    """Predictions equal to the targets give the monitored figure its highest value; reset forgets them."""
    built = build(subject)
    frames, monitor = list(street()[:3]), subject.cls.monitor
    perfect = {p.name: _truth(p.kind, frames) for p in subject.declared.takes}
    if any(value is None for value in perfect.values()):
        return
    special = {n: targets(frames) if n == "targets" else [f.meta for f in frames] for n in subject.declared.special}
    noisy = _figures(subject, frames)[monitor]
    built.module.update(**perfect, **special)
    best = float(built.module.compute()[monitor])
    require(best >= noisy and best > 0, f"{monitor} is {best} for the targets themselves, {noisy} for noisy copies")
    built.module.reset()
    built.module.update(**perfect, **special)
    require(float(built.module.compute()[monitor]) == best, "after reset the same frames give another figure")


def _truth(kind: Any, frames: list[Any]) -> Any:
    known = targets(frames)
    return {Boxes: known.boxes, PointLabels: known.points, Poses: known.poses, Tracks: known.tracks}.get(kind)


def _figures(subject: Subject, frames: list[Any]) -> dict[str, float]:
    built = build(subject)
    for frame, labelled in zip(frames, street(), strict=False):
        scene = labelled if frame.targets.boxes is None else frame  # made-up detections start from the objects
        arguments = {name: None if s is None else example(s, [scene], name) for name, s in built.specs.items()}
        special = {n: targets([frame]) if n == "targets" else [frame.meta] for n in subject.declared.special}
        built.module.update(**arguments, **special)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torchmetrics: compute before update
        return {name: float(value) for name, value in built.module.compute().items()}
