"""Checks of what backbones, necks, heads and postprocessors compute."""

from __future__ import annotations

import copy
from typing import Any

import torch

from lidarfw.testing.checks.compare import boxes_difference, copied, difference, finite, floats, sample
from lidarfw.testing.checks.shape import mismatch
from lidarfw.testing.checks.subject import Built, Subject, accepted_variations, build, check, require
from lidarfw.testing.examples import empty, street, thinned
from lidarfw.types import Boxes

MODULES = ("backbone", "neck", "head", "postprocessor")
TOLERANCE = 1e-4  # convolutions of other batch sizes add up in another order


@check(*MODULES)
def provides_what_it_says(subject: Subject) -> None:
    """For two widths, strides and grids, what comes out has the kind, channels, stride and grid of `provides`."""
    for variation, built in accepted_variations(subject):
        provides = getattr(built.module, "provides", None)
        require(provides is not None, "__init__ does not set self.provides")
        text = mismatch(provides, built.result(street()[:2]), batch_size=2)
        require(not text, f"{variation.name}: {text}")
        if subject.slot == "head" and hasattr(built.module, "tap"):
            text = mismatch(built.module.tap, built.run(street()[:2]).tap, batch_size=2)
            require(not text, f"{variation.name}: tap: {text}")


@check(*MODULES)
def works_without_optional_inputs(subject: Subject) -> None:
    """Optional parameters may be absent."""
    if not any(p.optional for p in subject.parameters):
        return
    built = build(subject, optional=False)
    text = mismatch(built.module.provides, built.result(street()[:2]), batch_size=2)
    require(not text, text)


@check(*MODULES)
def evaluation_is_deterministic(subject: Subject) -> None:
    """In evaluation the same input gives the same result, bit for bit."""
    built = build(subject)
    text = difference(built.result(street()[:2]), built.result(street()[:2]))
    require(not text, f"two runs on the same input differ: {text}")


@check(*MODULES, "loss")
def inputs_are_left_alone(subject: Subject) -> None:
    """forward does not write into what it takes: another component reads it too."""
    built = build(subject)
    arguments = built.arguments(street()[:2], training=True)
    before = copied(arguments, lambda tensor: tensor.detach().clone())
    built.module.train()(**arguments)
    text = difference(before, copied(arguments, torch.Tensor.detach))
    require(not text, f"forward changed its input {text} (an in-place operation?)")


@check(*MODULES)
def batch_mates_do_not_matter(subject: Subject) -> None:
    """In evaluation the result of a frame is the same alone and beside other frames."""
    built = build(subject)
    first, second, third = street()[:3]
    alone = sample(built.result([first]), 0)
    for frames, number in (([first, second], 0), ([third, first], 1), ([empty(second), first], 1)):
        beside = sample(built.result(frames), number)
        compare = boxes_difference if isinstance(alone, Boxes) else difference
        text = compare(alone, beside, TOLERANCE)
        require(not text, f"frame {number} of a batch of {len(frames)} differs from the same frame alone: {text}")


@check(*MODULES)
def works_on_almost_nothing(subject: Subject) -> None:
    """No points and no objects, one point, and a batch in which one frame is empty: finite, in training too."""
    frame = street()[0]
    for what, frames in (
        ("a frame without points", [empty(frame)]),
        ("one point", [thinned(frame, 1)]),
        ("an empty frame beside a full one", [empty(frame), frame]),
    ):
        built = build(subject)
        text = mismatch(built.module.provides, built.result(frames), batch_size=len(frames))
        require(not text, f"{what}: {text}")
        require(finite(built.run(frames, training=True)), f"{what}: not finite in training")


@check(*MODULES, "tracker")
def gradients_reach_every_parameter(subject: Subject) -> None:
    """Every parameter gets a finite gradient from what `forward` gives."""
    built = build(subject)
    if subject.slot == "tracker" and subject.declared.trainable is None:
        require(not list(built.module.parameters()), "it has parameters but no forward to train them")
        return
    _require_gradients(built, floats(built.run(street()[:2], training=True)))


@check(*MODULES)
def runs_in_bfloat16(subject: Subject) -> None:
    """Forward and backward under bf16 autocast give finite values."""
    built = build(subject)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = built.run(street()[:2], training=True)
        result = built.result(street()[:2])
    require(finite(result), "evaluation is not finite")
    if list(built.module.parameters()):
        _require_gradients(built, floats(output))


@check(*MODULES)
def weights_make_the_result(subject: Subject) -> None:
    """An instance with other initial weights gives the same after a strict load of the state_dict; so does a copy."""
    built, other = build(subject, seed=0), build(subject, seed=1)
    built.run(street()[:2], training=True)  # moves the statistics of normalisation layers
    expected = built.result(street()[:2])
    other.module.load_state_dict(built.module.state_dict(), strict=True)
    for what, module in (("a loaded state_dict", other.module), ("copy.deepcopy", copy.deepcopy(built.module))):
        text = difference(expected, Built(subject, module, built.specs, built.heads).result(street()[:2]))
        require(not text, f"{what} gives another result: {text}")


def _require_gradients(built: Built, outputs: list[torch.Tensor]) -> None:
    named = [(name, p) for name, p in built.module.named_parameters() if p.requires_grad]
    if not named:
        return
    outputs = [tensor for tensor in outputs if tensor.requires_grad]
    require(outputs, "nothing that comes out depends on the parameters")
    generator = torch.Generator().manual_seed(0)
    total: Any = sum((t.float() * torch.randn(t.shape, generator=generator)).mean() for t in outputs)
    total.backward()
    for name, parameter in named:
        require(parameter.grad is not None, f"no gradient reaches the parameter {name}")
        require(bool(parameter.grad.isfinite().all()), f"the gradient of {name} is not finite")


@check("postprocessor")
def twice_is_once(subject: Subject) -> None:
    """A postprocessor that is declared `idempotent` changes nothing the second time."""
    if not getattr(subject.cls, "idempotent", False):
        return
    built = build(subject)
    names = [p.name for p in subject.declared.takes if p.kind is built.module.provides.kind]
    require(len(names) == 1, "idempotent = True is for those that take one prediction and give the same kind")
    arguments = built.arguments(street()[:2], training=False)
    once = built.module.eval()(**arguments)
    text = difference(once, built.module(**{**arguments, names[0]: once}))
    require(not text, f"the second time gives another result: {text}")
