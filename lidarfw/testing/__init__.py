"""Tools for tests: the conformance kit, synthetic data, example features."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lidarfw._lazy import lazy_attributes

if TYPE_CHECKING:
    from lidarfw.testing.checks import component_checks, run_checks
    from lidarfw.testing.examples import example, spec_of
    from lidarfw.testing.synthetic import SyntheticDataset

__getattr__ = lazy_attributes(
    __name__,
    {
        "SyntheticDataset": "lidarfw.testing.synthetic",
        "component_checks": "lidarfw.testing.checks",
        "example": "lidarfw.testing.examples",
        "run_checks": "lidarfw.testing.checks",
        "spec_of": "lidarfw.testing.examples",
    },
)
__all__ = ["SyntheticDataset", "component_checks", "example", "run_checks", "spec_of"]
