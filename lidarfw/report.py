"""The report of a run: one HTML file that needs nothing else, with figures, curves, pictures, wiring and config."""

from __future__ import annotations

import base64
import html
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml

from lidarfw import draw
from lidarfw.checkpoint import load
from lidarfw.data import evaluation_data
from lidarfw.errors import DataError
from lidarfw.files import write_text
from lidarfw.predict import extent_of, keep_scores, pictures_of
from lidarfw.types import FrameResult, collate

if TYPE_CHECKING:
    from lidarfw.model import PerceptionModel

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1f24; background: #fff; max-width: 1100px; margin: 2em auto;
  padding: 0 1em; }
h1 { font-size: 1.6em; margin-bottom: 0; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ddd; }
p.sub { color: #59636e; margin-top: .2em; } img { max-width: 100%; display: block; }
.tiles { display: flex; flex-wrap: wrap; gap: .8em; margin: 1em 0; }
.tile { border: 1px solid #ddd; border-radius: 6px; padding: .6em 1em; min-width: 7em; }
.tile b { display: block; font-size: 1.5em; } .tile span { color: #59636e; font-size: .85em; }
table { border-collapse: collapse; font-size: .92em; } td, th { padding: .25em .9em .25em 0; text-align: left;
  border-bottom: 1px solid #eee; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
pre { background: #f6f8fa; padding: .8em; overflow-x: auto; font-size: 12px; border-radius: 6px; }
figure { margin: 1em 0; } figure img { cursor: zoom-in; }
input:checked + img { position: fixed; inset: 0; margin: auto; max-width: 98vw; max-height: 98vh; cursor: zoom-out;
  box-shadow: 0 0 0 100vmax #000b; }
summary { cursor: pointer; } figcaption { color: #59636e; font-size: .9em; }
.frames { display: grid; grid-template-columns: repeat(auto-fit, minmax(440px, 1fr)); gap: 1em; }
"""


def write_report(
    run_dir: str | Path,
    figures: Mapping[str, float] | None = None,
    *,
    split: str | None = None,
    frames: int = 4,
    score: float = 0.3,
    seconds: Mapping[str, float] | None = None,
    pictures: Mapping[str, str | Path] | None = None,
) -> Path:
    """Write RUN/report.html and give its path.

    Args:
        run_dir: folder of a `lidarfw train` run: checkpoints/, metrics.csv.
        figures: of an evaluation ("box_ap/car_3d_ap"); by default the last ones of metrics.csv.
        split: of the dataset, whose frames are shown; by default the one that the run was validated on.
        frames: how many of them, evenly spaced over the split.
        score: boxes below are not drawn.
        seconds: wall time by stage, shown where given.
        pictures: PNG files by caption, shown after the predictions.
    """
    folder = Path(run_dir)
    path = _checkpoint(folder)
    model = load(path)
    split = split or model.plan.config["splits"]["val"]
    metrics = folder / "metrics.csv"
    curves = draw.read_metrics(metrics) if metrics.exists() else {}
    figures = figures if figures is not None else _last_figures(curves)
    parts = [
        _header(folder, path, model),
        _tiles(model, figures, seconds),
        _section(
            "Curves", _image(draw.curves(curves), "running means; faint lines are single steps") if curves else ""
        ),
        _section(f"Predictions beside the truth, split {split}", _frames(model, split, frames, score)),
        _section("Data", "".join(_png(Path(file).read_bytes(), text) for text, file in (pictures or {}).items())),
        _section("Figures", _figures(figures)),
        _section("Wiring", _wiring(model)),
        _section("Time", _table(["stage", "seconds"], [(k, f"{v:.1f}") for k, v in (seconds or {}).items()])),
        _section("Environment", _table(["", ""], _environment(model))),
        _section("Config", _config(model)),
    ]
    text = f"<!doctype html><html lang=en><meta charset=utf-8><title>{_name(folder)}</title><style>{_STYLE}</style>"
    write_text(folder / "report.html", text + "\n".join(parts) + "</html>\n")
    return folder / "report.html"


def _checkpoint(folder: Path) -> Path:
    """The best checkpoint of a run, or its last."""
    for name in ("best", "last"):
        if (folder / "checkpoints" / f"{name}.ckpt").exists():
            return folder / "checkpoints" / f"{name}.ckpt"
    raise DataError(
        f"{folder}: has no checkpoints/best.ckpt or last.ckpt\n  fix: give the folder of a `lidarfw train` run"
    )


def _name(folder: Path) -> str:
    return html.escape(folder.resolve().name)


def _last_figures(curves: Mapping[str, Any]) -> dict[str, float]:
    """The last value of each curve of the validation."""
    return {name.removeprefix("val/"): float(v[-1]) for name, (_, v) in curves.items() if name.startswith("val/")}


def _section(title: str, content: str) -> str:
    return f"<h2>{html.escape(title)}</h2>\n{content}" if content else ""


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    if not rows:
        return ""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header) if any(header) else ""
    return f"<table><tr>{head}</tr>" + "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows) + "</table>"


def _cell(text: str) -> str:
    number = re.fullmatch(r"-?\d+\.\d+", text)
    return f"<td{' class=n' if number else ''}>{html.escape(text)}</td>"


def _image(picture: draw.Picture, caption: str) -> str:
    return _png(draw.png_bytes(picture), caption)


def _png(content: bytes, caption: str) -> str:
    data, text = base64.b64encode(content).decode(), html.escape(caption)
    picture_tag = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    return f"<figure><label><input type=checkbox hidden>{picture_tag}</label><figcaption>{text}</figcaption></figure>"


def _header(folder: Path, checkpoint: Path, model: PerceptionModel) -> str:
    parts = " + ".join(step.id for slot in ("backbone", "neck", "head") for step in model.plan.of(slot))
    written = datetime.now().strftime("%Y-%m-%d %H:%M")
    dataset = ", ".join(model.plan.config.get("dataset") or {})
    return (
        f"<h1>{_name(folder)}</h1><p class=sub>{html.escape(parts)} on {html.escape(dataset)} · "
        f"{html.escape(checkpoint.name)} · {written}</p>"
    )


def _tiles(model: PerceptionModel, figures: Mapping[str, float], seconds: Mapping[str, float] | None) -> str:
    monitor = model.monitor
    tiles = [(f"{figures[monitor]:.3f}", monitor)] if monitor is not None and monitor in figures else []
    tiles.append((f"{sum(p.numel() for p in model.parameters()) / 1e6:.2f} M", "parameters"))
    tiles += [(f"{sum(seconds.values()):.0f} s", "in all")] if seconds else []
    cells = "".join(f"<div class=tile><b>{value}</b><span>{html.escape(name)}</span></div>" for value, name in tiles)
    return f"<div class=tiles>{cells}</div>"


def _frames(model: PerceptionModel, split: str, count: int, score: float) -> str:
    shown = []
    extent = extent_of(model)
    for result in _results(model, split, count):
        pictures = pictures_of(keep_scores(result, score), model.plan.data.classes, extent)
        caption = f"{result.meta.id}: boxes with a score of {score:g} or more; truth "
        shown += [_image(p, caption + ("dashed" if name == "bev" else "in white")) for name, p in pictures.items()]
    return f"<div class=frames>{''.join(shown)}</div>" if shown else ""


@torch.no_grad()
def _results(model: PerceptionModel, split: str, count: int) -> Iterator[FrameResult]:
    """Results of frames evenly spaced over a split, with their truth."""
    dataset, transforms = evaluation_data(model.plan.config, split)
    for index in sorted({round(i * (len(dataset) - 1) / max(count - 1, 1)) for i in range(count)}):
        frame = dataset[index]
        for transform in transforms:
            frame = transform(frame, np.random.default_rng(0))
        yield model.predict(collate([frame]))[0]


def _figures(figures: Mapping[str, float]) -> str:
    return _table(["figure", "value"], [(name, f"{value:.4f}") for name, value in figures.items()])


def _wiring(model: PerceptionModel) -> str:
    from lidarfw.commands.show import table

    return f"<pre>{html.escape(table(model.plan, model))}</pre>"


def _config(model: PerceptionModel) -> str:
    text = yaml.safe_dump(model.plan.config, sort_keys=False, default_flow_style=None, width=120)
    lines = text.count("\n")
    return f"<details><summary>the whole config ({lines} lines)</summary><pre>{html.escape(text)}</pre></details>"


def _environment(model: PerceptionModel) -> list[tuple[str, str]]:
    """What the figures were made with."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    rows = [
        ("Python", platform.python_version()),
        ("torch", str(torch.__version__)),
        ("system", f"{platform.system()} {platform.machine()}"),
        ("threads", str(torch.get_num_threads())),
        ("GPU", gpu),
    ]
    return rows + list(model.plan.distributions.items())
