"""The report: claims first, then the paper in its order, every figure, every row, and what was left out.

``REPORT.md`` with the figures beside it, and the same as one HTML page that needs nothing else. Written
from files alone; ``results/`` beside it holds the small ones of every run that counts, enough to
make the report again, and to go on with the study.
"""

from __future__ import annotations

import base64
import html
import os
import platform
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import footwork
from footwork import checkpoint
from footwork.checkpoint import CheckpointError, write_atomically
from footwork.record import RunError, source_digest
from footwork.statistics import iqm
from footwork.study.answers import ANSWERS, CHOICES, said
from footwork.study.claims import CLAIMS, Claim, Finding, Judgement, judge_all, prefixes_at_hand, rows_read, show_effect
from footwork.study.experiments import EXPERIMENTS, SCHEDULES, find_row, is_row
from footwork.study.figures import FIGURES, Drawn, draw_figures
from footwork.study.measure import EVALUATION, TRANSITIONS
from footwork.study.plan import STUDY_FILE, default_rows, plan, read_machine
from footwork.study.results import CURVE, METRICS, Results, Sample, copy_curve, seeds_in_words
from footwork.study.runs import read_actors
from footwork.train import planned_steps

RESULTS = "results"  # folder of a report, with the small files of its runs
WRITTEN = "WRITTEN_BY_FOOTWORK_REPORT"  # in that folder: the next report may replace it


@dataclass(frozen=True)
class Heading:
    """A heading; the level as in HTML."""

    text: str
    level: int = 2


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Code:
    """Commands."""

    text: str


@dataclass(frozen=True)
class TableBlock:
    """A table; cells are plain text, lines in them separated by newlines."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Picture:
    """A figure with its caption."""

    drawn: Drawn


Block = Heading | Text | Code | TableBlock | Picture


def write_report(results: Results, to: Path, command: str) -> list[Path]:
    """Draw every figure, judge every claim, and write it all into a folder.

    Args:
        results: of a study.
        to: the folder; what it holds of an earlier report is replaced.
        command: the line that made this report.

    Raises:
        RunError: see :func:`check_place`.
        OSError: it cannot be written.
        CheckpointError: it cannot be written.
    """
    check_place(results.study.runs, to)
    prefixes = prefixes_at_hand(results)
    for row in all_rows(results):
        results.samples(row)
    drawn = [one for prefix in prefixes for one in draw_figures(results, FIGURES, to / "figures", prefix)]
    export(results, to / RESULTS)  # first: it may find what is wrong with a file, and the pages say so
    blocks = report_blocks(results, drawn, command)
    pages = {"REPORT.md": _markdown(blocks, to), "report.html": _page(blocks, _title(results))}
    for name, text in pages.items():
        write_atomically(to / name, text.encode())
    return [to / name for name in pages]


def report_blocks(results: Results, drawn: Sequence[Drawn], command: str) -> list[Block]:
    """The report, whatever it is to be written as."""
    judgements = judge_all(results)
    rows = [row for row in all_rows(results) if results.samples(row)]
    blocks: list[Block] = [Heading(_title(results), 1), Text(_summary(results, judgements, rows))]
    if results.study.size.short is not None:
        blocks.append(
            Text(
                "**Quick study: runs of a few updates and few seeds. It shows that everything works, not what holds.**"
            )
        )
    blocks += [Heading("Claims"), _overview_table(judgements), Text(_READING)]
    blocks += [Heading("Each claim in each setting", 3), _claims_table(judgements)]
    blocks += [Heading("Every comparison", 3), _comparisons_table(judgements)]
    blocks += [Heading("The paper, in its order"), _answers_table(judgements, results)]
    blocks += [Heading("What the paper leaves open, and what we took", 3), _choices_table()]
    blocks += [Heading("Figures"), *[Picture(d) for d in drawn]]
    blocks += [Heading("Rows"), _rows_table(results, rows), Text(_ROWS)]
    made = _made(results, rows, command)  # reads files, and so may find problems with them
    blocks += [Heading("Left out, and why"), *_left_out(results, drawn)]
    blocks += [Heading("How this was made"), *made]
    return blocks


_READING = (
    "An effect is a difference of interquartile means over seeds (of shares: in percentage points) with its 95 % "
    "stratified-bootstrap interval, whole seeds drawn within each row. P is the probability that a run of the first "
    "row scores higher than one of the second. Rules, margins and the number of seeds asked for stood in "
    "footwork/study/claims.py before the runs. Masters and flat policies are judged by the way: how much nearer to "
    "the goal an episode ends than it began, along the straight line, as a share of the distance at the start. That "
    "is the distance part of the paper's reward, which is what it plots; on AntMaze it calls an ant at the wall "
    "nearer than one half-way around it, so success and the way around the walls stand beside it. Comparisons that "
    "are only shown do not decide; most of them were added after the first seeds had been seen. Differences that were "
    "to be at least the bound and are smaller, or of the other sign, do not hold. Masters that stand on the same "
    "sub-policies are not independent: their seeds are drawn together, as in a paired comparison (claims 9 and 13; "
    "decided before a penalised master was trained). Nothing is corrected for the number of comparisons. With 10 "
    "seeds such an interval covers the truth 92 to 96 times in 100, with 3 under 80 times (normal scores, simulated)."
)
_ROWS = (
    "Interquartile means over seeds. Control steps: of one run, all its directions counted. Minutes: of training, mean "
    "over runs, one core each, without the measuring that follows (200 episodes, drawn from the policy and not its "
    "mean, or the hand-over matrix and random switching). Way: along the straight line. One row with what it stands "
    "on: `footwork reproduce --rows ROW`."
)


def _title(results: Results) -> str:
    size = results.study.size
    return "Footwork: the study" + ("" if size.name == "full" else f" ({size.name})")


def _summary(results: Results, judgements: Sequence[Judgement], rows: Sequence[str]) -> str:
    count = {
        verdict: sum(j.verdict == verdict for j in judgements) for verdict in ("holds", "does not hold", "undecided")
    }
    said = ", ".join(f"{number} {verdict}" for verdict, number in count.items())
    elsewhere = [j for j in judgements if j.setting.prefix]
    if elsewhere:
        ants = ", ".join(dict.fromkeys(j.setting.prefix.strip("/") for j in elsewhere))
        said += f" ({len(elsewhere)} of the settings are ablations, {ants}, with fewer seeds than a verdict asks for)"
    seeds = sum(len(results.samples(row)) for row in rows)
    length = " Runs of any length count." if results.any_length else ""
    return f"{len(CLAIMS)} claims in {len(judgements)} settings: {said}. {seeds} runs of {len(rows)} rows.{length}"


def all_rows(results: Results) -> list[str]:
    """The table, and the same under every engine or ant at hand."""
    elsewhere = [prefix + row for prefix in prefixes_at_hand(results) if prefix for row in EXPERIMENTS]
    known = [row for row in elsewhere if row not in EXPERIMENTS and is_row(row)]
    return [*EXPERIMENTS, *known]


def _overview_table(judgements: Sequence[Judgement]) -> TableBlock:
    """A line per claim: the verdict in each setting, and the effect of the comparison that decided first."""
    rows = []
    for claim in CLAIMS:
        mine = [j for j in judgements if j.claim is claim]
        paper = [j for j in mine if not j.setting.prefix and j.setting.schedule == "paper"]
        ours = [j for j in mine if not j.setting.prefix and j.setting.schedule != "paper"]
        elsewhere = [j for j in mine if j.setting.prefix]
        cells = [_brief(paper), _brief(ours), _brief(elsewhere, named=True)]
        rows.append((str(claim.number), f"{claim.words}\n({_source(claim)})", *cells))
    header = ("", "claim", "the paper's setting", "our reward, our masters' schedule", "other ants and engines")
    return TableBlock(header, tuple(rows))


def _brief(judgements: Sequence[Judgement], named: bool = False) -> str:
    lines = []
    for j in judgements:
        deciding = [f for f in j.findings if f.contrast.decides and f.effect is not None]
        place = f"{j.where.removesuffix(f', {SCHEDULES[j.setting.schedule]}')}: " if named else ""
        so_far = "" if j.verdict == j.so_far else f" (so far: {j.so_far})"
        lines.append(f"{place}{j.verdict}{so_far if deciding else ': no runs yet'}")
        lines += [_said(f) for f in ([f for f in deciding if f.so_far == j.so_far] or deciding)[:1]]
        lines += [f"and {len(deciding) - 1} more"] if len(deciding) > 1 else []
    return "\n".join(lines) or "-"


def _claims_table(judgements: Sequence[Judgement]) -> TableBlock:
    rows = []
    for j in judgements:
        said = [_said(f) for f in j.findings if f.contrast.decides]
        said += [f"(shown) {_said(f)}" for f in j.findings if not f.contrast.decides and f.effect is not None]
        rows.append((str(j.claim.number), j.where, j.verdict, "\n".join(said), j.why))
    return TableBlock(("", "where", "verdict", "effect [95 %], P, seeds", "because"), tuple(rows))


def _said(finding: Finding) -> str:
    """A comparison in one line."""
    chance = "" if finding.probability is None else f", P {finding.probability:.2f}"
    return f"{finding.contrast.words}: {show_effect(finding)}{chance}, {seeds_in_words(_seeds(finding.seeds))}"


def _source(claim: Claim) -> str:
    return claim.section if claim.section == "ours" else f"section {claim.section}"


def _seeds(counts: tuple[int, ...]) -> str:
    return str(counts[0]) if len(set(counts)) == 1 else " / ".join(map(str, counts))


def _comparisons_table(judgements: Sequence[Judgement]) -> TableBlock:
    rows = [
        (
            str(j.claim.number),
            j.where,
            f.contrast.words + ("" if f.contrast.decides else " (shown only)"),
            " ".join(
                f"{'+' if w > 0 else '−'} {row}" for w, row in zip(f.contrast.weights, f.rows, strict=True)
            ).removeprefix("+ "),
            METRICS[f.contrast.metric].words,
            f"{f.contrast.rule}, {METRICS[f.contrast.metric].show(f.contrast.bound)}",
            show_effect(f),
            "-" if f.probability is None else f"{f.probability:.2f}",
            _seeds(f.seeds),
            f.verdict if f.verdict == f.so_far else f"{f.verdict} (so far: {f.so_far})",
        )
        for j in judgements
        for f in j.findings
    ]
    header = ("", "where", "what", "rows", "metric", "rule, bound", "effect [95 %]", "P", "seeds", "verdict")
    return TableBlock(header, tuple(rows))


def _answers_table(judgements: Sequence[Judgement], results: Results) -> TableBlock:
    rows = tuple(
        (answer.section, answer.words, said(answer, judgements, results), ", ".join(map(str, answer.figures)) or "-")
        for answer in ANSWERS
    )
    return TableBlock(("section", "the paper says", "answer", "figures"), rows)


def _rows_table(results: Results, rows: Sequence[str]) -> TableBlock:
    metrics = ("way", "route", "success", "handover", "speed", "return")
    lines = []
    for row in rows:
        experiment, walker = results.study.row(row), find_row(row).is_walker
        shown = {"handover", "speed", "return"} if walker else {"way", "route", "success"}
        cells = [_middle(results, row, name) if name in shown else "" for name in metrics]
        minutes = [curve.seconds[-1] / 60 for _, curve in results.curves(row)]
        steps = f"{planned_steps(experiment) * experiment.runs_per_seed:,}"
        wall = f"{np.mean(minutes):.1f}" if minutes else "-"
        lines.append((row, str(len(results.samples(row))), steps, wall, *cells))
    header = (
        "row",
        "seeds",
        "control steps",
        "minutes",
        "way",
        "around walls",
        "within 1 m",
        "hand-overs",
        "m/s",
        "training return",
    )
    return TableBlock(header, tuple(lines))


def _middle(results: Results, row: str, metric: str) -> str:
    scores = results.scores(row, metric)
    return METRICS[metric].show(float(iqm(scores))) if len(scores) else "-"


def _choices_table() -> TableBlock:
    return TableBlock(("what", "here"), tuple((choice.what, choice.here) for choice in CHOICES))


def _left_out(results: Results, drawn: Sequence[Drawn]) -> list[Block]:
    missing = list(dict.fromkeys(row for d in drawn for row in d.without))
    planned: dict[str, int] = {}
    read = rows_read(prefixes_at_hand(results))
    for job in plan(results.study, default_rows(results.study.size, rows_read()), rows_read()):
        planned[job.row] = planned.get(job.row, 0) + 1
    missing += [row for row in (*planned, *read) if row not in missing and not results.samples(row)]
    few = {row: len(results.samples(row)) for row in planned if 0 < len(results.samples(row)) < planned[row]}
    blocks: list[Block] = []
    if missing:
        blocks.append(Text(f"Rows of the study that have no finished run: {', '.join(dict.fromkeys(missing))}."))
    if few:
        said = ", ".join(f"{row} {have} of {planned[row]}" for row, have in few.items())
        blocks.append(Text(f"Rows with fewer seeds than the study plans: {said}."))
    if results.problems:
        here = f"{results.study.runs}{os.sep}"
        lines = tuple((problem.replace(here, ""),) for problem in results.problems)
        blocks.append(TableBlock(("file or run",), lines))
    return blocks or [Text("Nothing.")]


def _made(results: Results, rows: Sequence[str], command: str) -> list[Block]:
    found: dict[tuple[str, str], int] = {}
    for row in rows:
        for sample in results.samples(row):
            for name, version in sample.run.versions().items():
                found[name, str(version)] = found.get((name, str(version)), 0) + 1
    versions = tuple((name, version, str(count)) for (name, version), count in sorted(found.items()))
    machine = read_machine(results.study.runs) or "not recorded"
    steps = sum(
        planned_steps(results.study.row(row)) * results.study.row(row).runs_per_seed * len(results.samples(row))
        for row in rows
    )
    hours = sum(curve.seconds[-1] for row in rows for _, curve in results.curves(row)) / 3600
    spent = f"{steps / 1e6:,.1f} M control steps and {hours:.1f} hours of one core in training alone"
    here = f"footwork {footwork.__version__}, Python {platform.python_version()}"
    again = "footwork report --runs results --to .  # in this folder: the same report from the files beside it"
    return [
        Code(f"{command}\n{again}"),
        Text(f"Machine of the runs: {machine}; {spent}. Report written by {here}, source {source_digest()}."),
        TableBlock(("version of", "is", "runs"), versions),
    ]


def check_place(runs: Path, to: Path) -> None:
    """Refuse a folder for the report in which writing it would cost something that is not an older report's.

    Raises:
        RunError: ``to``/results holds the runs, or something that no report wrote.
    """
    place = to / RESULTS
    if runs.resolve() == place.resolve():  # a report made again from its own files leaves them as they are
        return
    if runs.resolve().is_relative_to(place.resolve()):
        raise RunError(f"{place} would be replaced, and the runs in {runs} are in it: choose another --to")
    if place.exists() and not (place / WRITTEN).is_file() and (not place.is_dir() or any(place.iterdir())):
        raise RunError(f"{place} holds something that no report wrote (it has no {WRITTEN}): choose another --to")


def export(results: Results, to: Path) -> None:
    """Copy the small files of every run that was read: enough to draw and to judge again.

    And policies, without their critics: of every seed where other rows stand on them, so that ``footwork reproduce``
    goes on from a copy of this folder as it would from the runs themselves; else of the first seed, so that each row
    can be watched and evaluated from here. A master finds its sub-policies beside it, under the same seed.

    What an earlier report wrote there stays until everything has been copied.

    Raises:
        RunError: see :func:`check_place`.
        OSError: they cannot be written.
        CheckpointError: they cannot be written.
    """
    check_place(results.study.runs, to.parent)
    if to.resolve() == results.study.runs.resolve():
        return
    new, old = to.with_name(f".{to.name}.new"), to.with_name(f".{to.name}.old")
    for left in (new, old):
        shutil.rmtree(left, ignore_errors=True)
    new.mkdir(parents=True)
    for row, samples in results.all_samples().items():
        for sample in {sample.run: sample for sample in samples}.values():
            _copy_run(results, sample, new / row / sample.run.path.name, row, first=sample.run == samples[0].run)
    if (results.study.runs / STUDY_FILE).is_file():
        shutil.copyfile(results.study.runs / STUDY_FILE, new / STUDY_FILE)
    (new / WRITTEN).write_text("footwork report wrote this folder, and the next one replaces it.\n", encoding="utf-8")
    if to.exists():
        to.rename(old)
    new.rename(to)
    shutil.rmtree(old, ignore_errors=True)


def _copy_run(results: Results, sample: Sample, place: Path, row: str, first: bool) -> None:
    run = sample.run
    place.mkdir(parents=True, exist_ok=True)
    for name in ("config.json", "DONE", EVALUATION, TRANSITIONS):
        if (run.path / name).is_file():
            shutil.copyfile(run.path / name, place / name)
    curve = results.whole_curve(sample)
    if curve is not None:
        copy_curve(curve, run, sample.experiment, place / CURVE)
    stood_on = row in {experiment.needs for experiment in EXPERIMENTS.values()}
    if (first or stood_on) and run.policy_path.is_file():
        try:
            actors, meta = read_actors(run.policy_path)
        except CheckpointError as error:
            results.problems[f"{error}: the report's results lack it"] = None
        else:
            checkpoint.save(place / run.policy_path.name, actors, meta)


# Markdown and HTML ----------------------------------------------------------------------------------------------------


def _markdown(blocks: Sequence[Block], to: Path) -> str:
    return "\n\n".join(_as_markdown(block, to) for block in blocks) + "\n"


def _as_markdown(block: Block, to: Path) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {text}"
        case Text(text):
            return text
        case Code(text):
            return f"```\n{text}\n```"
        case TableBlock(header, rows):
            lines = [header, ("---",) * len(header), *rows]
            return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)
        case Picture(drawn):
            png, svg = (os.path.relpath(path, to) for path in drawn.files)
            return f"### {_heading(drawn)}\n\n![{drawn.figure.title}]({png})\n\n{_caption(drawn)} [SVG]({svg})"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", "<br>")


def _heading(drawn: Drawn) -> str:
    figure = drawn.figure
    number = figure.name.partition("-")[0].lstrip("0")
    paper = f" (the paper's {figure.paper})" if figure.paper else ""
    where = f", {drawn.prefix.strip('/')}" if drawn.prefix else ""
    return f"{number}. {figure.title}{where}{paper}"


def _caption(drawn: Drawn) -> str:
    without = f" Without finished runs: {', '.join(drawn.without)}." if drawn.without else ""
    under = f" --under {drawn.prefix.strip('/')}" if drawn.prefix else ""
    return f"{drawn.figure.caption}{without} Drawn by `footwork figures {drawn.figure.name}{under}`."


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; font-size: 13px; margin: 1rem 0; display: block; overflow-x: auto; }
th, td { border-bottom: 1px solid #ddd; padding: .3rem .6rem; text-align: left; vertical-align: top;
  white-space: pre-line; }
th { border-bottom: 2px solid #999; }
.holds { color: #00664b; font-weight: 600; } .does-not-hold { color: #a33b00; font-weight: 600; }
.undecided { color: #555; font-weight: 600; }
figure { margin: 2rem 0; } img { max-width: 100%; height: auto; } figcaption { font-size: 14px; color: #444; }
pre { background: #f5f4f0; padding: .8rem; overflow-x: auto; }
"""


def _page(blocks: Sequence[Block], title: str) -> str:
    body = "\n".join(_as_html(block) for block in blocks)
    head = (
        f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{html.escape(title)}</title>'
    )
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n'
    )


def _as_html(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"<h{level}>{html.escape(text)}</h{level}>"
        case Text(text):
            return f"<p>{_inline(text)}</p>"
        case Code(text):
            return f"<pre>{html.escape(text)}</pre>"
        case TableBlock(header, rows):
            lines = ["".join(f"<th>{html.escape(cell)}</th>" for cell in header)]
            lines += ["".join(_table_cell(cell) for cell in row) for row in rows]
            return "<table>" + "\n".join(f"<tr>{line}</tr>" for line in lines) + "</table>"
        case Picture(drawn):
            data = base64.b64encode(drawn.files[0].read_bytes()).decode()
            image = f'<img src="data:image/png;base64,{data}" alt="{html.escape(drawn.figure.title)}">'
            caption = f"<figcaption>{_inline(_caption(drawn))}</figcaption>"
            return f"<figure><h3>{html.escape(_heading(drawn))}</h3>{image}{caption}</figure>"


def _table_cell(text: str) -> str:
    verdict = text if text in ("holds", "does not hold", "undecided") else ""
    mark = f' class="{verdict.replace(" ", "-")}"' if verdict else ""
    return f"<td{mark}>{html.escape(text)}</td>"


def _inline(text: str) -> str:
    """Escaped text in which **bold** and `code` mean what they do in Markdown."""
    parts: list[str] = []
    for number, part in enumerate(html.escape(text).split("`")):
        bold = part.split("**")
        parts.append(
            f"<code>{part}</code>" if number % 2 else "".join(f"<b>{p}</b>" if i % 2 else p for i, p in enumerate(bold))
        )
    return "".join(parts)


__all__ = ["all_rows", "check_place", "export", "report_blocks", "write_report"]
