"""Every option of the groups that this part ships composes, and names only classes that a config may build."""

from pathlib import Path

import pytest

from lidarfw.config import check_target, compose, to_plain

CONF = Path(__file__).parents[2] / "conf"
GROUPS = ("trainer", "optimizer", "scheduler", "callbacks", "logger", "debug")
OPTIONS = [f"{group}={path.stem}" for group in GROUPS for path in sorted((CONF / group).glob("*.yaml"))]


def targets(node: object) -> list[str]:
    if isinstance(node, dict):
        own = [node["_target_"]] if node.get("_target_") else []
        return own + [found for value in node.values() for found in targets(value)]
    return [found for value in node for found in targets(value)] if isinstance(node, list) else []


@pytest.mark.parametrize("option", OPTIONS)
def test_option(option):
    found = targets(to_plain(compose([option])))
    assert any("Trainer" in target for target in found)
    for target in found:
        check_target(target)


def test_there_are_options():
    assert len(OPTIONS) >= 20
