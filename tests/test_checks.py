"""The conformance kit finds mistakes: one broken component for every check."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from pathlib import Path

import pytest

from lidarfw import registry
from lidarfw.cli import main
from lidarfw.errors import RegistryError
from lidarfw.testing.checks import CHECKS, cases, run_checks

FILE = Path(__file__).parent / "fixtures" / "mutants.py"
_spec = importlib.util.spec_from_file_location("mutants", FILE)
mutants = sys.modules["mutants"] = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(mutants)
BROKEN = [c for c in vars(mutants).values() if inspect.isclass(c) and getattr(c, "caught_by", "")]
UNTESTED = {  # checks for which no mistake is made here, and why
    "works_without_optional_inputs",  # the same comparison as provides_what_it_says
    "is_read_without_import",  # needs an installed component
    "fits_its_interface",  # cases() refuses such a class before
    "spec_needs_no_files",
    "frames_make_batches",
    "index_survives_saving",
    "fills_up_small_maps",
}


@pytest.mark.parametrize("broken", BROKEN, ids=lambda c: c.__name__)
def test_a_mistake_is_found_by_its_check(broken: type) -> None:
    failed = {r.check: r.message for r in run_checks(broken) if r.status == "failed"}
    assert broken.caught_by in failed
    assert failed[broken.caught_by]


@pytest.mark.parametrize("sound", [mutants.Sound, mutants.SmallDataset], ids=lambda c: c.__name__)
def test_a_sound_component_passes(sound: type) -> None:
    assert [r for r in run_checks(sound) if r.status != "passed"] == []


def test_every_check_is_tried_on_a_mistake() -> None:
    assert {c.name for c in CHECKS} - {c.caught_by for c in BROKEN} == UNTESTED


def test_an_unknown_distribution_is_named_with_the_known_ones() -> None:
    with pytest.raises(
        RegistryError, match=r"no installed distribution 'lidarfv' .*\n.*lidarfw.*\n.*did you mean 'lidarfw'"
    ):
        cases("lidarfv")


@pytest.mark.parametrize(
    ("target", "code", "text"),
    [
        ("mutants:Sound", 0, "14 checks: 14 passed, 0 failed, 0 skipped"),
        ("mutants:WritesIntoItsInput", 1, "forward changed its input"),
        ("mutants:Nothing", 2, "'mutants:Nothing' cannot be imported"),
        ("mutants:FILE", 2, "write it as package.module:Class"),
        ("mutants:Grid", 2, "Grid derives from none of the interfaces"),
    ],
)
def test_check_on_the_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], target: str, code: int, text: str
) -> None:
    monkeypatch.chdir(FILE.parent)
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["check", target]) == code
    out = capsys.readouterr()
    assert text in " ".join((out.out + out.err).split())


def test_fixtures_for_plugins(synthetic_frame, synthetic_sequence, spec_of, isolated_registry) -> None:
    assert [f.meta.index for f in synthetic_sequence] == [0, 1, 2, 3]
    assert synthetic_frame.targets.boxes is not None
    assert spec_of(mutants.BEV).kind is mutants.BEV
    isolated_registry(neck={"toy": mutants.Sound})
    assert registry.load("neck", "toy") is mutants.Sound
    assert {e.distribution for e in registry.entries("neck")} == {"lidarfw", "this program"}
