"""Modules that are imported at their first use, so that `lidarfw list` needs no torch."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any


class LazyModule(ModuleType):
    """Stands for the module `name` and imports it when one of its attributes is read."""

    def __getattr__(self, attribute: str) -> Any:
        module = sys.modules.get(self.__name__) or importlib.import_module(
            self.__name__
        )  # the import alone takes 15 us
        return getattr(module, attribute)


def lazy_attributes(package: str, names: dict[str, str]) -> Any:
    """A module-level `__getattr__` (PEP 562) that finds each public name in its submodule.

    `names` maps public name -> module that defines it.
    """

    def __getattr__(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(names[name]), name)

    return __getattr__
