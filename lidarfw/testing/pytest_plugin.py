"""Fixtures for tests of plugins; pytest loads them wherever lidarfw is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from lidarfw.types import Frame, Spec


@pytest.fixture
def synthetic_frame() -> Frame:
    """One small frame with points, a picture, a pose and every kind of target."""
    return _synthetic(1)[0]


@pytest.fixture
def synthetic_sequence() -> list[Frame]:
    """Four such frames of one sequence, in order of time."""
    return _synthetic(4)


def _synthetic(length: int) -> list[Frame]:
    from lidarfw.testing.synthetic import frames

    return frames(length, image=True, pose=True)


@pytest.fixture
def spec_of() -> Callable[..., Spec]:
    """`spec_of(BEV)` is a small Spec of that kind, for the __init__ of a component."""
    from lidarfw.testing import examples

    return examples.spec_of


@pytest.fixture
def isolated_registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Hides every installed plugin but lidarfw; `isolated_registry(head={"toy": ToyHead})` adds components."""
    from lidarfw import registry

    installed = registry._installed()
    core = {slot: tuple(e for e in group if e.distribution == "lidarfw") for slot, group in installed.items()}
    monkeypatch.setattr(registry, "_installed", lambda: core)
    with ExitStack() as stack:

        def use(**slots: dict[str, Any]) -> None:
            stack.enter_context(registry.use(**slots))

        yield use
