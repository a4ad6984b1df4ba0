"""Make the pages of results and the README's table from the figures in results/.

``python -m experiments.page`` writes them.

The texts of the pages are in ``experiments/*.md.jinja``. Their figures are in the JSON files that
the programs of ``experiments/`` and ``benchmarks/`` write.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from benchmarks.record import PROGRAMS, RESULTS, ROOT, Results, made_by, reported
from docs.pages import between
from docs.pages import table as markdown_table
from experiments import (
    ablations,
    packer,
    packer_selection,
    packing,
    physics,
    planning,
    real_cell,
    real_goods,
)
from experiments.rows import main_of, mean
from marl_pack.exact.spec import ExactSpec
from marl_pack.files import write_atomically
from marl_pack.option_record import options_of
from marl_pack.physics import table1
from marl_pack.service.limits import ServiceLimits
from marl_pack.service.refusals import CODES
from marl_pack.stability import RULES

PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"
RS = "rs"
POLICIES = {
    RS: "`rs`, trained on RS",
    "cut_1": "`cut_1`, trained on CUT-1",
    "cut_2": "`cut_2`, trained on CUT-2",
    "types125": "`types125`, trained on 125 types",
    "plain": "`plain`, trained on RS, without the planes `feasible_*` and `afterstate_value`",
    **{name: f"heuristic `{name}`" for name in packing.HEURISTICS},
}
"""The names of the rows of the first table."""
UPRIGHT = {
    "rs_upright": "`rs_upright`, trained on RS",
    f"rs_upright {packing.UPRIGHT_PLAN}": f"the same with `{packing.UPRIGHT_PLAN}`",
    "types125_upright": "`types125_upright`, trained on 125 types",
    f"types125_upright {packing.UPRIGHT_PLAN}": f"the same with `{packing.UPRIGHT_PLAN}`",
    RS: "`rs`, trained with six orientations",
    "types125": "`types125`, trained with six orientations",
    "max_feasible": "heuristic `max_feasible`",
}
"""The names of the rows of the table of two orientations."""


def render(folder: Path = RESULTS) -> str:
    """Return the text of docs/results.md.

    Args:
        folder: the folder of the JSON files.

    Raises:
        ValueError: if figures are missing; names the commands that measure them.
    """
    tables = tables_in(folder)
    return template("results").render(
        {name: tables[name].row for name in ("other_rules", "masks", "room", "game")},
        rules_row=tables["rules"].row,
        training_rows=fastest(tables["training"].rows()),
        made=lambda name: made(tables[name]),
        packing_table=packing_table(
            tables["packing"], POLICIES, packing.SETS, packing.MODELS
        ),
        upright_table=packing_table(
            tables["two_orientations"], UPRIGHT, packing.UPRIGHT_SETS, packing.UPRIGHT
        ),
        sets=packing.SETS,
        upright_sets=packing.UPRIGHT_SETS,
        rs=tables["packing"].row(f"--policy {RS} {packing.SETS['RS']}"),
        symmetric=tables["packing"].row(f"--policy {RS} --symmetric {packing.SETS['RS']}"),
        rs_items=packing.SETS["RS"],
        bodies_rows=[(key.partition("--seed 1")[2].strip(), tables["bodies"].row(key))
                     for key in packing.TABLES["bodies"]],
        rules=[rule for rule in RULES if rule != "none"],
        plans=[(plan, tables["planning"].row(f"{RS}, {plan}"))
               for plan in (planning.NONE, *planning.PLANS)],
        curves=tables["learning_curve"].rows(),
        order=("rs", "plain", "cut_1", "cut_2", "types125"),
        spreads=tables["volume_spread"].rows(),
        greedy=tables["afterstates"].rows(),
        ablations_table=ablations_table(tables["ablations"]),
        controls_report=controls_report(tables["controls"]),
        table1_rows=[(key, tables["table1"].row(key)) for key in physics.TABLE1],
        paper_table1=table1.PAPER,
        reported=reported(),
    )  # fmt: skip


def tables_in(folder: Path) -> dict[str, Results]:
    """Return all tables by name.

    Raises:
        ValueError: if figures are missing; names the commands that measure them.
    """
    missing = [name for name in PROGRAMS if not Results(name, folder).path.is_file()]
    if missing:
        commands = ", ".join(f"`{made_by(name)}`" for name in missing)
        raise ValueError(f"{folder}: figures are missing; run {commands}")
    return {name: Results(name, folder) for name in PROGRAMS}


def template(page: str) -> Template:
    """Return the template of a page."""
    environment = Environment(
        loader=FileSystemLoader(ROOT / "experiments"), undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, autoescape=False,
    )  # fmt: skip
    environment.filters |= {
        "percent": percent, "signed": signed, "grouped": grouped, "number": number,
        "plain": plain, "utilization": utilization,
    }  # fmt: skip
    return environment.get_template(f"{page}.md.jinja")


def render_real_goods(folder: Path = RESULTS) -> str:
    """Return the text of docs/real_goods.md; the arguments are those of :func:`render`."""
    tables = tables_in(folder)
    row = tables["real_goods"].row

    def cell(stream: str, policy: str, options: str) -> str:
        figures = row(f"{stream} {policy} {options}")
        text = f"{utilization(figures)} ({figures['packed']:.1f})"
        return f"**{text}**" if policy == "tuned" else text

    return template("real_goods").render(
        bound=lambda stream: row(f"{stream} {real_goods.BOUND}"),
        made=lambda name: made(tables[name]), rules=real_goods.RULES, cells=real_goods.CELLS,
        policies=real_goods.POLICIES, streams=real_goods.BINS, cell=cell, reported=reported(),
        exact_rows=list(tables["exact"].rows().items()),
    )  # fmt: skip


def render_real_cell(folder: Path = RESULTS) -> str:
    """Return the text of docs/real_cell.md; the arguments are those of :func:`render`."""
    tables = tables_in(folder)
    row = tables["real_cell"].row

    def overview(stream: str, setting: str) -> dict[str, Any]:
        rows = [row(f"{stream} / {setting} / {trial}") for trial in real_cell.TRIALS]
        return {
            "planned": rows[0]["planned"],
            **{key: sum(each[key] for each in rows) for key in ("collapses", "results")},
        }

    def collapsed(rows: Iterable[dict[str, Any]]) -> str:
        counts = [(each["collapses"], each["results"]) for each in rows]
        return f"{sum(c for c, _ in counts)} of {sum(n for _, n in counts):,}"

    def placed(setting: str) -> str:
        trials = [trial for trial in real_cell.TRIALS if trial.startswith("place")]
        return collapsed(row(f"{s} / {setting} / {t}") for s in real_goods.BINS for t in trials)

    return template("real_cell").render(
        made=lambda name: made(tables[name]), sound=real_cell.SOUND, trials=real_cell.TRIALS,
        settings=real_cell.SETTINGS, streams=real_goods.BINS,
        strict=lambda stream, setting: row(f"{stream} / {setting} / {real_cell.STRICT}"),
        trial_of=lambda stream, setting, trial: row(f"{stream} / {setting} / {trial}"),
        overview=overview, placed=placed,
        shaken=lambda stream, setting: collapsed([row(f"{stream} / {setting} / shake 0.2 g")]),
    )  # fmt: skip


def render_packer(folder: Path = RESULTS) -> str:
    """Return the text of docs/packer_results.md; the arguments are those of :func:`render`."""
    tables = tables_in(folder)
    row = tables["packer"].row
    budgets = [f"search budget={budget}ms" for budget in reversed(packer.BUDGETS)]
    heuristics = ("max_contact", "linear", "tuned")
    equal = [row(f"{stream} {name}")["equal"] for stream in real_goods.BINS for name in heuristics]

    def order_rows(orders: str, policy: str) -> Iterable[dict[str, Any]]:
        figures = row(f"orders {orders} {policy}")
        names = list(dict.fromkeys(each["order"] for each in figures["bins"]))
        for name in names:
            bins = [each for each in figures["bins"] if each["order"] == name]
            yield {
                "order": name, "pallets": len(bins), "boxes": sum(b["boxes"] for b in bins),
                "left_out": figures["left_out"],
                "fill": ", ".join(percent(b["fill"], 1) for b in bins),
                "height": ", ".join(f"{b['height_mm']:g}" for b in bins),
            }  # fmt: skip

    def selected(option: str, stream: str, policy: str, number: int) -> dict[str, Any]:
        rows = tables["packer_selection"]
        first = packer_selection.FIRST[option]
        own, base = (rows.row(f"{option} {stream} {policy} {n}") for n in (number, first))
        return {**own, "gain": mean(np.array(own["each"]) - np.array(base["each"]))}

    return template("packer").render(
        selection=packer_selection, selected=selected,
        bound=tables["real_goods"].row(f"cases {real_goods.BOUND}")["utilization"],
        made=lambda name: made(tables[name]), streams=real_goods.BINS,
        policies=(*heuristics, *budgets), equal=f"{sum(equal)} of {len(equal)} rows are equal",
        figures=lambda stream, policy: row(f"{stream} {policy}"), utilization=utilization,
        budget=packer.BUDGETS[0], trial=lambda stream: row(f"{stream} trial"),
        poses=row("mix poses"), clearance=f"{packer.CLEARANCE:g}",
        place_error=f"{packer.PLACE_ERROR:g}", yaw=f"{packer.YAW:g}",
        order_sets=packer.ORDERS, order_policies=("max_contact", "linear", "search"),
        order_rows=order_rows, answer_policies=("max_contact", "linear", "rs"),
        answers=lambda policy: row(f"answers {policy}"),
    )  # fmt: skip


def render_replay(folder: Path = RESULTS) -> str:
    """Return the text of docs/replay.md; the arguments are those of :func:`render`."""
    table = tables_in(folder)["page"]
    rows = sorted(table.rows().values(), key=lambda row: row["boxes"])
    lines = [
        (f"{row['boxes']:,}", f"{row['bins']}", f"{row['kilobytes'] / 1000:.1f}",
         f"{row['median_ms']:.0f}", f"{row['slowest_ms']:.0f}")
        for row in rows
    ]  # fmt: skip
    head = ("boxes", "bins", "page, MB", "median, ms", "slowest of 7, ms")
    text = f"{markdown_table(head, *lines)}\n\n{made(table)}"
    page = PAGE.with_name("replay.md").read_text(encoding="utf-8")
    return between(page, "opening", text)


def render_service(folder: Path = RESULTS) -> str:
    """Return the text of docs/service.md; the arguments are those of :func:`render`."""
    tables = tables_in(folder)
    rows = tables["service"].rows()
    memory = rows.pop("memory")
    return template("service").render(
        loads=sorted(rows.items(), key=lambda row: (row[0].split(",")[0], row[1]["clients"])),
        memory=memory, cores=memory["record"]["cores"], made=lambda name: made(tables[name]),
        limits=options_of(ServiceLimits),
        options=[each for each in options_of(ExactSpec) if each.name not in ("alpha", "beta")],
        codes=sorted(CODES.items(), key=lambda code: code[1][0]),
    )  # fmt: skip


def render_buffer(folder: Path = RESULTS) -> str:
    """Return the text of docs/buffer.md; the arguments are those of :func:`render`."""
    table = tables_in(folder)["selection"]
    page = PAGE.with_name("buffer.md").read_text(encoding="utf-8")
    for option, keys in packing.SELECTION.items():
        head = ["`evaluate`", "episodes", "utilization %", "boxes", "ms a decision", "falls"]
        head += ["adds to greedy value"] * (option == "trained")
        lines = []
        for key in keys:
            row = table.row(key)
            falls = f"{row['falls']} of {row['judged_episodes']:,}" if "falls" in row else "–"
            line = [
                f"`{key}`", f"{row['episodes']:,}", utilization(row), f"{row['packed']:.1f}",
                f"{1000 * row['cpu_seconds'] / (row['episodes'] * row['packed']):.1f}", falls,
            ]  # fmt: skip
            if option == "trained":
                greedy = table.row(re.sub(r"--policy \S+", "--policy rs", key))
                line.append(signed(difference(row, greedy)))
            lines.append(tuple(line))
        page = between(page, option, markdown_table(tuple(head), *lines))
    return between(page, "made", f"Made by {made(table)}.")


PAGES = {
    PAGE: render,
    PAGE.with_name("real_goods.md"): render_real_goods,
    PAGE.with_name("real_cell.md"): render_real_cell,
    PAGE.with_name("packer_results.md"): render_packer,
    PAGE.with_name("replay.md"): render_replay,
    PAGE.with_name("buffer.md"): render_buffer,
    PAGE.with_name("service.md"): render_service,
}
"""Every page of results, with the function that makes its text."""


def fastest(rows: Mapping[str, dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    """Return the fastest row of each settings file, precision and device, the slowest first."""
    best: dict[str, tuple[str, dict[str, Any]]] = {}
    for name, row in sorted(rows.items(), key=lambda item: item[1]["items_per_second"]):
        best[re.sub(r", N = [\d,]+\d", "", name)] = name, row
    return list(best.values())


def difference(row: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, float]:
    """Return how much more a row fills than another, as if they had independent sequences."""
    halves = [(each["interval"][1] - each["interval"][0]) / 2 for each in (row, other)]
    return {"mean": row["utilization"] - other["utilization"], "half": math.hypot(*halves)}


def percent(share: float | Mapping[str, float], digits: int = 2) -> str:
    """Return a share in per cent, or a mean with its interval, as text."""
    if isinstance(share, Mapping):
        return f"{100 * share['mean']:.{digits}f} ± {100 * share['half']:.{digits}f}"
    return f"{100 * share:.{digits}f}"


def signed(share: Mapping[str, float]) -> str:
    """Return a difference with its interval in points, as text."""
    return f"{100 * share['mean']:+.2f} ± {100 * share['half']:.2f}".replace("-", "−")


def grouped(number: float, digits: int = 0) -> str:
    """Return a number with its thousands grouped."""
    return f"{number:,.{digits}f}"


def number(value: float, form: str) -> str:
    """Return a number in one of Python's formats, with "−" as minus sign."""
    return format(value, form).replace("-", "−")


def plain(value: float) -> str:
    """Return a small number without an exponent."""
    return np.format_float_positional(value, 2, fractional=False, trim="-")


def utilization(row: Mapping[str, Any]) -> str:
    """Return a row's utilization with its interval, in per cent."""
    low, high = row["interval"]
    return percent({"mean": row["utilization"], "half": (high - low) / 2})


def made(table: Results) -> str:
    """Return the command of a table, and the processors, seeds, commits and dates of its rows."""
    records = [row["record"] for row in table.rows().values()]

    def all_of(name: str) -> str:
        return ", ".join(sorted({str(r[name]) for r in records if name in r}))

    seeds = sorted({seed for r in records for seed in r["seeds"].split(", ") if seed})
    threads = all_of("threads")
    words = [
        all_of("cpu"),
        *([all_of("gpu")] if any("gpu" in r for r in records) else []),
        f"{threads} thread" + "s" * (threads != "1"),
        *([f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)}"] if seeds else []),
        f"commit {all_of('commit')}",
        all_of("date"),
    ]
    return f"`{made_by(table.name)}` ({', '.join(words)})"


def packing_table(
    table: Results,
    policies: Mapping[str, str],
    sets: Mapping[str, str],
    models: Mapping[str, Sequence[str]],
) -> list[dict[str, Any]]:
    """Return a row for each policy: utilization by set, equilibrium and falls over all sets.

    Args:
        table: the table of the figures.
        policies: the names of the rows, by the option ``--policy``.
        sets: the other options of each set of items, by its name.
        models: the learned agents that play each set; all heuristics play all sets.
    """
    lines = []
    for policy, name in policies.items():
        rows = {
            items: table.row(f"--policy {policy} {options}")
            for items, options in sets.items()
            if policy in (*models[items], *packing.HEURISTICS)
        }
        lines.append({
            "name": name,
            "learned": policy not in packing.HEURISTICS,
            "cells": {items: f"{utilization(row)} ({row['packed']:.1f})"
                      for items, row in rows.items()},
            **judgement(rows.values()),
        })  # fmt: skip
    return lines


def judgement(rows: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the share of packings in equilibrium, and the counts of judged packings and falls."""
    rows = list(rows)
    packings = sum(row["episodes"] for row in rows)
    judged = sum(row.get("judged_episodes", 0) for row in rows)
    placements = sum(row.get("judged", 0) for row in rows)
    unclear = sum(row.get("no_verdict", 0) for row in rows)
    all_of = f" of {packings:,}" if judged < packings else ""
    return {
        "equilibrium": sum(row["episodes"] * row["strict_equilibrium"] for row in rows) / packings,
        "judged": f"{placements:,} in {judged:,}{all_of}" if judged else "none",
        "falls": str(sum(row.get("falls", 0) for row in rows)) * bool(judged)
        + f" ({unclear} without a verdict)" * bool(unclear),
    }


def ablations_table(table: Results) -> list[dict[str, Any]]:
    """Return a row for each change with which all seeds have been trained.

    Raises:
        ValueError: if there are no runs without a change, with which the others are compared.
    """
    rows = table.rows()
    lines: list[dict[str, Any]] = []
    first = None
    for change in ablations.CHANGES:
        keys = [ablations.key_of(change, seed) for seed in ablations.SEEDS]
        if first is None:
            runs = [table.row(key) for key in keys]
        elif all(key in rows for key in keys):
            runs = [rows[key] for key in keys]
        else:
            continue
        values = np.array([run["utilization"] for run in runs])
        first = values if first is None else first
        lines.append({
            "name": ablations.WORDS[change], "items": runs[0]["items"],
            "utilization": mean(values), "each": ", ".join(map(percent, values)),
            "difference": mean(values - first) if lines else None,
        })  # fmt: skip
    return lines


def controls_report(table: Results) -> dict[str, Any]:
    """Return how many controls were judged correctly, and where verdicts flip."""
    report = table.row(physics.CONTROLS)
    outcomes = report["controls"]
    right = {of: sum(o[of] == o["known"] for o in outcomes)
             for of in ("judge", "equilibrium", "everything")}  # fmt: skip
    flips = [at for at in report["flips_at_mm"].values() if at is not None]
    return {"number": len(outcomes), **right, "outside": -min(flips), "inside": max(0, *flips)}


def readme(page: str, folder: Path = RESULTS) -> str:
    """Return README.md with its table of results.

    Args:
        page: the current text of README.md.
        folder: the folder of the JSON files.
    """
    sets = ("RS", "CUT-1")
    table = Results("packing", folder)
    paper = reported()["packing"][0]
    rows = [("", *sets), (f"{paper['who']} (reported)", *(f"{paper[name]} %" for name in sets))]
    for policy in (RS, "max_feasible", "dblf", "random"):
        figures = (table.row(f"--policy {policy} {packing.SETS[name]}") for name in sets)
        rows.append((POLICIES[policy], *(f"{utilization(row)} %" for row in figures)))
    return between(page, "results", markdown_table(*rows))


def _write(text: str, file: BinaryIO) -> None:
    file.write(text.encode())


def main() -> int:
    """Write the pages and the README's table; return the exit status."""
    texts = {page: make() for page, make in PAGES.items()}
    for path, text in (texts | {README: readme(README.read_text("utf-8"))}).items():
        write_atomically(path, partial(_write, text))
        print(f"{path}: {len(text.splitlines())} lines")
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))
