"""The datasets of the town against the rules of their interface."""

from __future__ import annotations

from pathlib import Path

import pytest
from lidarfw.testing import component_checks


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    base: Path = tmp_path_factory.getbasetemp() / "town_cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(base))


test_conformance = component_checks("lidarfw-town")
