"""The conformance kit: what every component and distribution must do, as named checks.

In a plugin's tests: `test_conformance = component_checks("acme-lidar")`. Without pytest: `lidarfw check acme-lidar`.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from lidarfw import interfaces, registry
from lidarfw.errors import ConfigError, RegistryError
from lidarfw.interfaces import SLOTS
from lidarfw.testing.checks import data, declared, forward, loss, retriever, stream
from lidarfw.testing.checks.packaging import PACKAGE_CHECKS, entries
from lidarfw.testing.checks.subject import CHECKS, FailedError, SkippedError, Subject

_MODULES = (data, declared, forward, loss, retriever, stream)  # importing them fills CHECKS


@dataclass(frozen=True)
class CheckResult:
    """The outcome of one check of one component or distribution."""

    component: str  # "head.center", or the name of the distribution
    check: str
    status: str  # passed, failed or skipped
    message: str = ""


@dataclass(frozen=True)
class Case:
    """One check to run."""

    component: str
    check: str
    run: Callable[[], None]

    @property
    def id(self) -> str:
        return f"{self.component}-{self.check}"

    def result(self) -> CheckResult:
        """Run it. An unexpected exception is a failure too: a component must not crash on legal input."""
        import torch

        torch.manual_seed(0)
        try:
            self.run()
        except SkippedError as reason:
            return CheckResult(self.component, self.check, "skipped", str(reason))
        except FailedError as error:
            return CheckResult(self.component, self.check, "failed", str(error))
        except Exception as error:
            if isinstance(error, ConfigError) and isinstance(error.__cause__, ImportError):  # an optional library
                return CheckResult(self.component, self.check, "skipped", str(error))
            return CheckResult(self.component, self.check, "failed", f"{type(error).__name__}: {error}{_place(error)}")
        return CheckResult(self.component, self.check, "passed")


def _place(error: Exception) -> str:
    frame = inspect.getinnerframes(error.__traceback__)[-1] if error.__traceback__ else None
    return f" ({frame.filename}:{frame.lineno})" if frame else ""


def cases(target: str | type) -> list[Case]:
    """Every check of a distribution, of "package.module:Class", or of a class; components are not imported yet."""
    if isinstance(target, str) and ":" not in target:
        return [*_package_cases(target), *(case for e in entries(target) for case in _cases(Subject(e.slot, e.name)))]
    cls = _import(target) if isinstance(target, str) else target
    return list(_cases(Subject(_slot_of(cls), cls.__name__, cls)))


def run_checks(target: str | type) -> list[CheckResult]:
    """Run every check of a distribution, of "package.module:Class", or of a class."""
    return [case.result() for case in cases(target)]


def component_checks(distribution: str) -> Callable[[Case], None]:
    """A pytest test with one case for every component of a distribution and every check.

    `test_conformance = component_checks("acme-lidar")` is a whole test file.
    """
    import pytest

    found = cases(distribution)

    @pytest.mark.parametrize("case", found, ids=[case.id for case in found])
    def test_conformance(case: Case) -> None:
        result = case.result()
        if result.status == "skipped":
            pytest.skip(result.message)
        if result.status == "failed":
            pytest.fail(f"{result.component}: {result.message}", pytrace=False)

    return test_conformance


def _package_cases(distribution: str) -> Iterator[Case]:
    there = sorted({e.distribution for slot in SLOTS for e in registry.entries(slot)})
    if distribution not in there:
        near = registry.did_you_mean(distribution, there)
        raise RegistryError(
            f"no installed distribution {distribution!r} declares lidarfw components.\n"
            f"  there are: {', '.join(there)}{near}"
        )
    for function in PACKAGE_CHECKS:
        yield Case(distribution, function.__name__, lambda function=function: function(distribution))  # type: ignore[misc]


def _cases(subject: Subject) -> Iterator[Case]:
    for check in CHECKS:
        if subject.slot in check.slots:
            yield Case(subject.id, check.name, lambda check=check: check.run(subject))  # type: ignore[misc]


def _import(target: str) -> type:
    module, _, name = target.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise RegistryError(f"{target!r} cannot be imported: {error}.\n  write it as package.module:Class") from error
    if not inspect.isclass(found):
        raise RegistryError(f"{target!r} is no class")
    return found


def _slot_of(cls: type) -> str:
    # tracker before filter: a Tracker is a Filter
    for slot in sorted(SLOTS, key=lambda slot: slot != "tracker"):
        if issubclass(cls, getattr(interfaces, SLOTS[slot])):
            return slot
    raise RegistryError(f"{cls.__name__} derives from none of the interfaces: {', '.join(SLOTS.values())}")


__all__ = ["Case", "CheckResult", "cases", "component_checks", "run_checks"]
