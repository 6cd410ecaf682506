"""`lidarfw show`: the wiring of a config or checkpoint, its parameters, and on request the whole config."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarfw.files import require_checkpoint

if TYPE_CHECKING:
    from lidarfw.assembly import Plan, Step
    from lidarfw.model import PerceptionModel


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw show`."""
    parser.add_argument("overrides", nargs="*", metavar="OVERRIDE|CKPT", help="as for train, or one checkpoint")
    parser.add_argument("--config-dir", metavar="DIR", help="folder with configs of your own")
    parser.add_argument("--config", action="store_true", help="print the resolved config too")


def run(args: argparse.Namespace) -> int:
    """Print the wiring table."""
    from lidarfw.assembly import build, plan

    if len(args.overrides) == 1 and args.overrides[0].endswith(".ckpt"):
        require_checkpoint(args.overrides[0])
        import lidarfw

        model = lidarfw.load(Path(args.overrides[0]))
    else:
        from lidarfw.config import compose

        own = [f"--config-dir={args.config_dir}"] if args.config_dir else []
        model = build(plan(compose([*own, *args.overrides])))
    if args.config:
        from omegaconf import OmegaConf

        print(OmegaConf.to_yaml(OmegaConf.create(model.plan.config)))
    print(table(model.plan, model))
    return 0


def table(plan: Plan, model: PerceptionModel) -> str:
    """The wiring table: component, what it takes and from where, what it gives."""
    data = "; targets " + ", ".join(sorted(k.__name__ for k in plan.data.targets)) if plan.data.targets else ""
    rows = [("component", "takes", "gives", "parameters")]
    rows.append((_dataset(plan), "-", ", ".join(str(s) for s in plan.data.inputs.values()) + data, ""))
    for step in plan.steps:
        rows += _rows(step, model)
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    lines = ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, [*widths, 0], strict=True)).rstrip() for row in rows]
    total: int = sum(p.numel() for p in model.parameters())
    versions = ", ".join(f"{name} {version}" for name, version in plan.distributions.items())
    warnings = [f"warning: {text}" for text in plan.warnings]
    return "\n".join([*lines, f"{_count(total)} parameters · {versions}", *warnings])


def _dataset(plan: Plan) -> str:
    return f"dataset.{next(iter(plan.config.get('dataset') or {'?': None}))}"


def _rows(step: Step, model: PerceptionModel) -> list[tuple[str, str, str, str]]:
    takes = [f"{name} <- {', '.join(str(r) for r in refs)}" for name, refs in step.takes.items() if refs] or ["-"]
    replaced = ", ".join(sorted({ref.producer for ref in step.replaces if step.slot not in ("postprocessor",)}))
    gives = _gives(getattr(model.component(step), "provides", None)) + (f" (replaces {replaced})" if replaced else "")
    note = f"(default of {step.default_of})" if step.default_of else gives
    if step.slot == "loss" and step.weight != 1:
        note = f"{note} weight {step.weight}".strip()
    module: Any = model.component(step)
    count = sum(p.numel() for p in module.parameters()) if step.slot != "metric" else 0
    first = (step.id, takes[0], note, _count(count) if count else "")
    return [first, *(("", text, "", "") for text in takes[1:])]


def _gives(provides: Any) -> str:
    if provides is None:
        return ""
    if isinstance(provides, tuple):
        return "; ".join(_gives(part) for part in provides)
    if isinstance(provides, list):
        channels = "/".join(str(s.channels) for s in provides)
        strides = "/".join(str(s.stride) for s in provides)
        return f"{provides[0].kind.__name__} {channels}ch stride {strides}"
    return str(provides)


def _count(number: int) -> str:
    return f"{number / 1e6:.2f} M" if number >= 1e6 else f"{number / 1e3:.1f} k" if number >= 1000 else str(number)
