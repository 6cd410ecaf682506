"""Every component of the distribution against the rules of its interface."""

from __future__ import annotations

from lidarfw.testing import component_checks

test_conformance = component_checks("lidarfw-crossplace")
