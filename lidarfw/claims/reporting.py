"""What came out, for people: a table of verdicts and a forest plot; and for programs: the figures as JSON."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any

from lidarfw import __version__
from lidarfw.claims.judging import CONTRADICTED, MEANING, NEUTRAL, SUPPORTED, UNDECIDED, judge
from lidarfw.claims.reading import Claim, ClaimsFile
from lidarfw.claims.running import Work, commit
from lidarfw.draw import COLOURS
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import atomic_path, write_text

_COLOUR = {SUPPORTED: COLOURS[2], CONTRADICTED: COLOURS[1], NEUTRAL: COLOURS[0], UNDECIDED: COLOURS[7]}
_FORMAT = 1


def outcomes(stated: ClaimsFile, work: Work, claims: Sequence[Claim], recorded: Mapping[str, Any]) -> list[Any]:
    """An entry for every claim: judged now, or as recorded earlier, or without an outcome.

    `recorded` are the entries of an earlier JSON file, by claim. One stands in where the runs are not there (any
    more, or not on this machine) and the claim has not been changed since. A claim whose runs cannot be compared has
    the reason as its `fault`.
    """
    return [_entry(claim, work if claim in claims else None, recorded.get(claim.name)) for claim in stated.claims]


def _entry(claim: Claim, work: Work | None, old: Mapping[str, Any] | None) -> Mapping[str, Any]:
    empty: dict[str, Any] = {"name": claim.name, "definition": definition(claim), "outcome": None, "runs": []}
    try:
        found = _judged(claim, work) if work else None
    except ConfigError as error:
        return empty | {"fault": str(error)}
    unchanged = old is not None and old["definition"] == definition(claim)
    return found or (old if old is not None and unchanged else empty)


def definition(claim: Claim) -> dict[str, Any]:
    """The claim in plain types."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(claim)))
    return plain


def recorded_in(path: Path) -> dict[str, Any]:
    """The entries of a JSON file of results by claim; none where there is no file."""
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {entry["name"]: entry for entry in content["claims"] if entry["outcome"] is not None}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} holds no results of claims: {error!r}\n  fix: delete it") from error


def _judged(claim: Claim, work: Work) -> dict[str, Any] | None:
    results = {run.name: {seed: work.result(run, seed) for seed in claim.seeds} for run in claim.runs}
    there = {name: {s: r for s, r in by_seed.items() if r is not None} for name, by_seed in results.items()}
    shared = [seed for seed in claim.seeds if all(seed in by_seed for by_seed in there.values())]
    if not shared:
        return None
    own = {name: {seed: by_seed[seed] for seed in shared} for name, by_seed in there.items()}
    baseline = claim.baseline if isinstance(claim.baseline, float) else own[claim.baseline.name]
    outcome = judge(claim, baseline, own[claim.variant.name])
    return {
        "name": claim.name,
        "definition": definition(claim),
        "outcome": asdict(outcome) | {"per_seed": {str(seed): value for seed, value in outcome.per_seed.items()}},
        "runs": [_run_entry(claim, run.name, seed, own, work) for run in claim.runs for seed in shared],
        "date": date.today().isoformat(),
        "resamples": work.stated.resamples,
        "block": work.stated.block,
    }


def _run_entry(claim: Claim, name: str, seed: int, results: Mapping[str, Any], work: Work) -> dict[str, Any]:
    run = next(run for run in claim.runs if run.name == name)
    about, content = work.training(run, seed), results[name][seed]
    kept = {key: about.get(key) for key in ("training", "commit", "date", "seconds")}
    return {"run": name, "seed": seed, "frames": len(content["frames"]), "figures": content["figures"], **kept}


# --- the table -------------------------------------------------------------------------------------------------------


def write(folder: Path, stated: ClaimsFile, entries: Sequence[Mapping[str, Any]], command: str) -> Path:
    """Write NAME.md, NAME.png and NAME.json into `folder`; the path of the table."""
    page = folder / f"{stated.name}.md"
    content = {"format": _FORMAT, "lidarfw": __version__, "commit": commit(), "claims": list(entries)}
    write_text(page.with_suffix(".json"), json.dumps(content, indent=1) + "\n")
    drawn = [entry for entry in entries if entry["outcome"]]
    if drawn:
        forest_plot(page.with_suffix(".png"), drawn)
    write_text(page, text(stated, entries, command))
    return page


def text(stated: ClaimsFile, entries: Sequence[Mapping[str, Any]], command: str) -> str:
    """The table as Markdown."""
    done = [entry for entry in entries if entry["outcome"]]
    counts = [f"{sum(e['outcome']['verdict'] == verdict for e in done)} {verdict}" for verdict in MEANING]
    faulty = sum("fault" in entry for entry in entries)
    missing = len(entries) - len(done) - faulty
    counts += [f"{missing} not run"] * bool(missing) + [f"{faulty} not judged"] * bool(faulty)
    parts = [
        "---\norphan: true\n---\n",  # for Sphinx: a page of no table of contents
        f"# Claims: {stated.name}\n",
        f"{stated.paper}\n" if stated.paper else "",
        f"{', '.join(counts)}.\n",
        f"![differences with their intervals]({stated.name}.png)\n" if done else "",
        _table(entries),
        _how(stated, done, command),
        _runs(done),
    ]
    return "\n".join(part for part in parts if part)


def _table(entries: Sequence[Mapping[str, Any]]) -> str:
    head = ["claim", "in the paper", "figure", "baseline", "variant", "difference, 90 % interval", "seeds", "verdict"]
    rows = [head, ["---"] * len(head), *(_row(entry) for entry in entries)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def _row(entry: Mapping[str, Any]) -> list[str]:
    claim = entry["definition"]
    arrow = "↑" if claim["better"] == "higher" else "↓"
    names = [_name_of(claim["baseline"]), _name_of(claim["variant"])]
    first = [claim["text"], claim["source"] or "-", f"`{claim['metric']}` {arrow}"]
    found = entry["outcome"]
    if found is None:
        why = "not judged" if "fault" in entry else "not run" + " (long)" * claim["long"]
        return [*first, *names, "-", "-", why]
    values = [f"{name}: {found[key]:.4g}" for name, key in zip(names, ("baseline", "variant"), strict=True)]
    difference = f"{found['difference']:+.4g} [{found['low']:+.4g}, {found['high']:+.4g}]"
    sign = 1 if claim["better"] == "higher" else -1
    favour = sum(sign * value > 0 for value in found["per_seed"].values())
    verdict = f"**{found['verdict']}**" + f" (long, {entry['date']})" * claim["long"]
    return [*first, *values, difference, f"{favour} of {len(found['per_seed'])}", verdict]


def _name_of(run: Any) -> str:
    return run["name"] if isinstance(run, dict) else "to reach"


def spent(entries: Sequence[Mapping[str, Any]]) -> float:
    """Seconds of wall time of all runs of these claims; a training that several runs evaluate counts once."""
    runs = [run for entry in entries for run in entry["runs"]]
    seconds = {(run.get("training") or run["run"], run["seed"]): run["seconds"] or 0 for run in runs}
    return float(sum(seconds.values()))


def _how(stated: ClaimsFile, done: Sequence[Mapping[str, Any]], command: str) -> str:
    lines = [
        "## How it was measured\n",
        f"`{command}`, {date.today().isoformat()}, lidarfw {__version__}, commit {commit() or 'unknown'}, "
        f"{platform.machine()} with {os.cpu_count()} cores. Wall time of all runs together: "
        f"{spent(done) / 60:.0f} minutes; several run at once.\n",
        f"Differences are variant less baseline. An interval is the middle 90 % of {stated.resamples} bootstrap "
        "samples. A sample draws the seeds with replacement and, for all seeds alike, the test frames, in blocks of "
        f"{stated.block} consecutive frames of a sequence; figures such as average precision are computed anew on the "
        "drawn frames. A claim may say otherwise: `resample: sequences` draws whole sequences and averages their "
        "figures, `resample: seeds` draws the seeds only. Paired runs share seeds and drawn frames.\n",
        "\n".join(f"- **{verdict}**: {meaning}." for verdict, meaning in MEANING.items()) + "\n",
        "The margin is 5 % of the baseline's figure where a claim does not give another. With few seeds an interval "
        "says little about other seeds: the column `seeds` counts those whose difference has the claimed sign.\n",
    ]
    return "\n".join(lines)


def _runs(done: Sequence[Mapping[str, Any]]) -> str:
    """A row for every run and seed, with the figures that claims use."""
    used = list(dict.fromkeys(entry["definition"]["metric"] for entry in done))
    rows: dict[tuple[str, int], list[str]] = {}
    for entry in done:
        for run in entry["runs"]:
            figures = [_figure(run["figures"].get(key)) for key in used]
            made = [f"{run['seconds'] or 0:.0f}", run["commit"] or "-", run["date"] or "-"]
            rows[run["run"], run["seed"]] = [f"{run['run']}", str(run["seed"]), *figures, str(run["frames"]), *made]
    if not rows:
        return ""
    head = ["run", "seed", *(f"`{key}`" for key in used), "frames", "seconds", "commit", "date"]
    table = [head, ["---"] * len(head), *(rows[key] for key in sorted(rows))]
    stated = {run["name"]: run for e in done for run in _stated_runs(e["definition"])}
    lists = [f"- `{name}`: `{' '.join(run['overrides'])}`{_evaluated(run)}" for name, run in sorted(stated.items())]
    return "\n".join(["## The runs\n", *lists, "", *(f"| {' | '.join(row)} |" for row in table), ""])


def _stated_runs(claim: Mapping[str, Any]) -> list[Any]:
    return [run for run in (claim["baseline"], claim["variant"]) if isinstance(run, dict)]


def _evaluated(run: Mapping[str, Any]) -> str:
    return f", evaluated with `{' '.join(run['evaluation'])}`" if run["evaluation"] else ""


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


# --- the picture -----------------------------------------------------------------------------------------------------


def forest_plot(path: Path, entries: Sequence[Mapping[str, Any]]) -> None:
    """Gains of all claims in percent of the larger figure, with intervals; dots are single seeds.

    Of the larger one, so that a baseline next to nothing does not push all others together.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 1.4 + 0.5 * len(entries)), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for place, entry in enumerate(entries):
        _draw_row(axes, len(entries) - 1 - place, entry)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(entries)), [_label(entry) for entry in reversed(entries)], fontsize=9)
    axes.set_ylim(-0.6, len(entries) - 0.4)
    axes.set_xlabel("← worse      gain in % of the larger figure, 90 % interval; dots: seeds      better →")
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right", "left"]].set_visible(False)
    handles = [
        axes.plot([], [], "s-", color=_COLOUR[verdict], label=verdict)[0]
        for verdict in MEANING
        if any(entry["outcome"]["verdict"] == verdict for entry in entries)
    ]
    axes.legend(handles=handles, loc="lower left", bbox_to_anchor=(0, 1), ncols=4, frameon=False, fontsize=9)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def _draw_row(axes: Any, height: float, entry: Mapping[str, Any]) -> None:
    found, claim = entry["outcome"], entry["definition"]
    scale = (100 if claim["better"] == "higher" else -100) / (max(abs(found["baseline"]), abs(found["variant"])) or 1)
    low, high = sorted((found["low"] * scale, found["high"] * scale))
    colour, gain = _COLOUR[found["verdict"]], found["difference"] * scale
    axes.plot([low, high], [height, height], color=colour, linewidth=2.5, solid_capstyle="butt")
    axes.plot(gain, height, "s", color=colour, markersize=7)
    seeds = [value * scale for value in found["per_seed"].values()]
    axes.plot(seeds, [height - 0.22] * len(seeds), ".", color=colour, markersize=5, alpha=0.7)


def _label(entry: Mapping[str, Any]) -> str:
    claim = entry["definition"]
    return f"{claim['name']}\n{_name_of(claim['baseline'])} → {_name_of(claim['variant'])}, {claim['metric']}"
