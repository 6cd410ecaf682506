"""Declarations read from source equal those of the imported class, and nothing is imported for them."""

import subprocess
import sys

import pytest

from lidarfw import declaration, registry
from lidarfw.interfaces import SLOTS

COMPONENTS = [(slot, name) for slot in SLOTS for name in registry.names(slot)]


def core(declared):
    """What the assembly and the config use of a declaration."""
    options = {name: (str(o.annotation), o.default) for name, o in declared.options.items()}
    return declared.specs, options, declared.takes, declared.special, declared.gives, declared.output, declared.defaults


@pytest.mark.parametrize(("slot", "name"), COMPONENTS)
def test_source_and_class_declare_the_same(slot, name):
    assert core(declaration.read(slot, name)) == core(declaration.of_class(slot, registry.load(slot, name)))


def test_reading_declarations_does_not_import_torch():
    code = (
        "import sys; from lidarfw import declaration; from lidarfw.interfaces import SLOTS\n"
        "found = [d.entry.name for slot in SLOTS for d in declaration.all_declarations(slot)]\n"
        "print(len(found), 'torch' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert int(out[0]) >= len(COMPONENTS)
    assert out[1] == "False"


SOURCE = """
from dataclasses import dataclass
from typing import Annotated, Literal, Optional

from lidarfw.interfaces import Head
from lidarfw.types import BEV, Boxes, Spec, Stride, Tap, Targets, Voxels

WIDTHS = (16, 32)
Mode = Literal["a", "b"]


@dataclass
class Output:
    tap: BEV


class Base(Head):
    defaults = {"loss": ["x"]}

    def __init__(self, bev: Spec, *, widths: tuple[int, ...] = WIDTHS, mode: Mode = "a", scale: float = 3 / 2):
        super().__init__()
        self.provides = Spec(Boxes)

    def decode(self, output: Output) -> Boxes:
        return Boxes.empty()


class Mine(Base):
    def forward(
        self, bev: Annotated[BEV, Stride(4)], levels: Optional[list[Voxels]] = None, targets: Targets | None = None
    ) -> Output:
        return Output(bev)


class Computed(Base):
    def __init__(self, bev: Spec, *, size: int = len(WIDTHS)):
        super().__init__(bev)

    def forward(self, bev: BEV) -> Output:
        return Output(bev)
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "somebodys_heads.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(str(tmp_path))
    return "somebodys_heads"


def test_inheritance_constants_and_constraints_are_understood_without_an_import(module):
    declared = declaration.read("head", f"{module}:Mine")
    assert module not in sys.modules
    assert [str(p) for p in declared.takes] == ["bev: BEV", "levels: list[Voxels]"]
    assert declared.takes[0].stride == 4
    assert declared.takes[1].optional
    assert declared.special == ("targets",)
    assert declared.output == f"{module}.Output"
    assert declared.defaults == {"loss": ["x"]}
    assert {name: o.default for name, o in declared.options.items()} == {"widths": (16, 32), "mode": "a", "scale": 1.5}


def test_a_computed_default_is_found_by_importing(module):
    declared = declaration.read("head", f"{module}:Computed")
    assert declared.options["size"].default == 2
    assert module in sys.modules
    del sys.modules[module]
