"""Every built-in component against the conformance kit that plugins use."""

from lidarfw.testing import component_checks

test_conformance = component_checks("lidarfw")
