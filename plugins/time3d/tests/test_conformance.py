"""The parts of this distribution against the rules of their interfaces."""

from __future__ import annotations

from lidarfw.testing import component_checks

test_conformance = component_checks("lidarfw-time3d")
