"""Checks of what a component's signatures say."""

from __future__ import annotations

import inspect
from typing import Any

from lidarfw import declaration, interfaces, registry
from lidarfw.config import node_class
from lidarfw.interfaces import SLOTS
from lidarfw.testing.checks.subject import FailedError, Subject, check, require
from lidarfw.types import VOCABULARY

ALL = tuple(SLOTS)


@check(*ALL)
def fits_its_interface(subject: Subject) -> None:
    """The class derives from the interface of its slot and leaves no abstract method."""
    interface = getattr(interfaces, SLOTS[subject.slot])
    require(inspect.isclass(subject.cls), f"{subject.cls!r} is no class")
    require(issubclass(subject.cls, interface), f"{subject.cls.__name__} does not derive from {interface.__name__}")
    left = sorted(getattr(subject.cls, "__abstractmethods__", ()))
    require(not left, f"{subject.cls.__name__} does not define {', '.join(left)}")


@check(*ALL)
def is_documented(subject: Subject) -> None:
    """The class has a docstring."""
    require(subject.cls.__doc__ and subject.cls.__doc__.strip(), "the class has no docstring")
    own = any("__doc__" in vars(c) and c.__doc__ == subject.cls.__doc__ for c in (subject.cls,))
    require(own, "the class has no docstring of its own")


@check(*ALL)
def needs_are_declared(subject: Subject) -> None:
    """Every parameter has a type of lidarfw.types, or a head's output class; what comes out is annotated."""
    for p in subject.parameters:
        known = isinstance(p.kind, str) or p.kind in VOCABULARY.values()
        require(known, f"parameter {p.name!r} has the annotation {p.kind!r}, which is no type of lidarfw.types")
    giving = ("backbone", "neck", "head", "postprocessor")
    method = "decode" if subject.slot == "head" else "forward"
    if subject.slot in giving:
        require(subject.declared.gives, f"the return annotation of {method} names no type of lidarfw.types")
    for name in subject.declared.specs:
        known = name == "data" or name in {p.name for p in subject.parameters}
        require(known, f"__init__ asks for the Spec {name!r}, which is no parameter of its forward")


@check(*ALL)
def options_fit_a_config(subject: Subject) -> None:
    """Options are keyword-only, annotated, and their defaults can be written in YAML."""
    for name, option in subject.declared.options.items():
        require(option.annotation is not Any, f"option {name!r} has no annotation")
        value = option.default
        require(
            value is declaration.REQUIRED or _plain(value), f"option {name!r} has the default {value!r}, no YAML value"
        )
        require(name not in ("type", "inputs", "weight", "ramp"), f"option {name!r} has a name that every node uses")


def _plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and _plain(item) for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return all(_plain(item) for item in value)
    return value is None or type(value) in (bool, int, float, str)


@check(*ALL)
def is_read_without_import(subject: Subject) -> None:
    """The signatures can be read from the source alone, so that a wrong combination is refused in a second."""
    if subject.given is not None:
        return
    node_class(subject.slot, subject.name)
    source = declaration.from_source(registry.find(subject.slot, subject.name))
    if source is None:
        raise FailedError("the signatures cannot be read without importing it: use plain names and literal defaults")
    for attribute in ("specs", "gives", "special", "output", "defaults"):
        ours, theirs = getattr(source, attribute), getattr(subject.declared, attribute)
        require(ours == theirs, f"{attribute} is {ours} in the source and {theirs} in the class")
    kinds = [
        [(p.name, declaration.kind_name(p.kind), p.form, p.optional) for p in d.takes]
        for d in (source, subject.declared)
    ]
    require(kinds[0] == kinds[1], f"it takes {kinds[0]} by its source and {kinds[1]} by its class")
