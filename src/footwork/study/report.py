"""The report: claims first, then the paper in its order, every figure, every row, and what was left out.

``REPORT.md`` with the figures beside it, and the same as one HTML page that needs nothing else. Written
from files alone; ``results/`` beside it holds the small ones of every run that counts, enough to
make the report again, and to go on with the study.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from pathlib import Path

import footwork
from footwork.checkpoint import write_atomically
from footwork.evaluate import HANDOVER_AFTER, HANDOVER_SPEED, HANDOVER_STEPS, IDLE_SPEED, SWITCHING_STEPS
from footwork.physics import ENGINES, libraries_of
from footwork.record import source_digest
from footwork.study.answers import ANSWERS, choices, said
from footwork.study.claims import CLAIMS, Claim
from footwork.study.experiments import SCHEDULES, find_row, in_braces
from footwork.study.figures import FIGURES, Drawn, count_in_words, draw_figures
from footwork.study.judging import Finding, Judgement, judge_all, no_room, show_bound, show_chance, show_effect
from footwork.study.metrics import METRICS, SWITCHED_EVERY
from footwork.study.pages import Block, Bullets, Code, Heading, Picture, TableBlock, Text, markdown, page
from footwork.study.plan import plan, read_machine
from footwork.study.report_files import PAGES, REPORT, RESULTS, check_place, export
from footwork.study.results import Results, all_rows, is_prefix, prefixes_at_hand, seeds_in_words
from footwork.study.row_tables import side_by_side, side_by_side_caption, sub_policies, task_policies
from footwork.train import planned_steps, steps_per_iteration


def write_report(results: Results, to: Path, command: str) -> list[Path]:
    """Draw every figure, judge every claim, and write it all into a folder.

    Args:
        results: of a study.
        to: the folder; what it holds of an earlier report is replaced.
        command: the line that made this report.

    Raises:
        RunError: see :func:`footwork.study.report_files.check_place`.
        OSError: it cannot be written.
        CheckpointError: it cannot be written.
    """
    check_place(results.study, to)
    again = (to / REPORT).is_file()
    prefixes = prefixes_at_hand(results)
    for row in all_rows(results):
        results.samples(row)
    export(results, to / RESULTS)  # first: it may refuse, and may find what is wrong with a file, which the pages say
    drawn = [one for prefix in prefixes for one in draw_figures(results, FIGURES, to / "figures", prefix)]
    if again:
        _remove_older_figures(to / "figures", drawn)
    blocks = report_blocks(results, drawn, command)
    pages = dict(zip(PAGES, (markdown(blocks, to), page(blocks, _title(results))), strict=True))
    for name, text in pages.items():
        write_atomically(to / name, text.encode())
    return [to / name for name in pages]


def _remove_older_figures(place: Path, drawn: Sequence[Drawn]) -> None:
    """Figures of an earlier report that this one does not draw: of another ant's rows that are no longer there.

    What lies in folders of which a report has none is somebody else's.
    """
    here = {file for one in drawn for file in one.files}
    known = {figure.name for figure in FIGURES}
    others = [path for path in place.iterdir() if path.is_dir() and is_prefix(f"{path.name}/")]
    for folder in (place, *others):
        for path in [*folder.glob("*.png"), *folder.glob("*.svg")]:
            if path.stem in known and path not in here:
                path.unlink()
        if folder != place and not any(folder.iterdir()):
            folder.rmdir()


def report_blocks(results: Results, drawn: Sequence[Drawn], command: str) -> list[Block]:
    """The report, whatever it is to be written as."""
    judgements = judge_all(results)
    rows = [row for row in all_rows(results) if results.samples(row)]
    blocks: list[Block] = [Heading(_title(results), 1), *_summary(results, judgements, rows)]
    if results.study.size.short is not None:
        blocks.append(
            Text(
                "**Quick study: runs of a few updates and few seeds. It shows that everything works, not what holds.**"
            )
        )
    blocks += [Heading("Claims"), _overview_table(judgements), Heading("How to read this", 3), Bullets(_reading())]
    blocks += [Heading("Side by side"), Text(side_by_side_caption(results)), side_by_side(results)]
    blocks += [Heading("The paper, in its order"), _answers_table(judgements, results)]
    blocks += [Heading("What the paper leaves open, and what we took", 3), _choices_table(results)]
    blocks += [Heading("Figures"), *[Picture(d, _facts(results)) for d in drawn]]
    blocks += [Heading("Rows"), Text(_rows_read(results))]
    for title, table in (
        ("Sub-policies", sub_policies(results, rows)),
        ("Masters and flat policies", task_policies(results, rows)),
    ):
        blocks += [Heading(title, 3), table] if table.rows else []
    blocks += [Heading("Each claim in each setting"), _claims_table(judgements)]
    blocks += [Heading("Every comparison"), _comparisons_table(judgements)]
    made = _made(results, rows, command)  # reads files, and so may find problems with them
    blocks += [Heading("Left out, and why"), *_left_out(results, judgements, drawn)]
    blocks += [Heading("How this was made"), *made]
    return blocks


def _reading() -> tuple[str, ...]:
    low, high = HANDOVER_AFTER
    return (
        "An effect is a difference of interquartile means over seeds with its 95 % stratified-bootstrap interval, "
        "whole seeds drawn within each row; differences of shares are in percentage points. P is the probability that "
        "a run of the first row scores higher than one of the second (compared seed by seed: the share of seeds that "
        "do).",
        "Rules, margins and the number of seeds asked for stood in footwork/study/claims.py before the study's runs, "
        "after pilots of one to three seeds of the same kinds. By these the stay of interleaved rows was chosen, for "
        "random switching, which is shown at claim 14; no t of the paper's kinds was. A difference that was to be at "
        "least the margin and is smaller, or of the other sign, does not hold. Comparisons that are only shown do not "
        "decide; most of them were added after the first seeds had been seen.",
        "Way: how much nearer to the goal an episode ends than it began, along the straight line, as a share of the "
        "distance at the start. That is the distance part of the paper's reward, which is what it plots, and what "
        "masters and flat policies are judged by. On AntMaze it calls an ant at the wall nearer than one half-way "
        "around it, so success and the way around the walls stand beside it.",
        f"Hand-over: one sub-policy walks for {low} to {high} control steps, another takes over; it succeeds if the "
        f"ant neither falls nor turns over in the {HANDOVER_STEPS} steps that follow and is moved on at "
        f"{HANDOVER_SPEED} m/s or more, over all of them and along the second direction. Orthogonal ones count: eight "
        "of sixteen pairs. One hand-over from walking is easier than one after the other: under random switching for "
        f"{SWITCHING_STEPS} steps, shown beside it, a direction is drawn from all four every {SWITCHED_EVERY} steps, "
        f"and an option that gains less than {IDLE_SPEED} m/s along its direction is idle, wherever else the ant goes.",
        "Claim 13 compares masters that stand on the same sub-policies: seed by seed, that is with their seeds drawn "
        "together (decided before a penalised master was trained; for claim 9 it is shown only). Elsewhere rows are "
        "taken to be independent. They are not quite, where they share sub-policies or, under appropriate bias, "
        "partners: such intervals are rather too wide than too narrow.",
        "Nothing is corrected for the number of comparisons. With 10 seeds an interval of a difference of means covers "
        "the truth 92 to 96 times in 100, of a difference of spreads 90 times, with 3 seeds under 80 times (normal "
        "scores, simulated); of 3 seeds a lone row's interval is their range.",
    )


def _rows_read(results: Results) -> str:
    return (
        "Interquartile means over seeds with 95 % intervals. Control steps: of one run, all its directions counted. "
        "Minutes: of training, mean over seeds, on one core in the sweep (seeds that trained side by side have an "
        "equal share of their time), without the measuring that follows "
        f"({results.study.size.episodes} episodes, drawn from the policy and not its mean, or the hand-over matrix and "
        "random switching). Hand-overs: orthogonal ones that succeed; m/s after: along the new direction, after "
        "failed ones too. Idle, upside down: options that gain less than "
        f"{IDLE_SPEED} m/s along their direction, and ants in the end, switched at random every {SWITCHED_EVERY} "
        "control steps. Way: along the straight line. Within: episodes that come so near to the goal. Turned over: at "
        "any time of an episode. One row with what it stands on: `footwork reproduce --rows ROW`."
    )


def _facts(results: Results) -> dict[str, str]:
    """What captions say of a study's size."""
    study = results.study
    at_k = {k: study.row(f"ablation/maze/k/{k}") for k in (10, 400)}
    updates = {k: planned_steps(row) // steps_per_iteration(row) for k, row in at_k.items()}
    own = [planned_steps(row) * row.runs_per_seed for row in map(study.row, ("walker/symmetric", "walker/plain"))]
    return {
        "pairs": str(max(1, study.size.ants // 4)),
        "own_steps": " to ".join(count_in_words(round(steps, -3)) for steps in own),
        "updates_10": str(updates[10]),
        "updates_400": str(updates[400]),
    }


def _title(results: Results) -> str:
    size = results.study.size
    return "Footwork: the study" + ("" if size.name == "full" else f" ({size.name})")


def _summary(results: Results, judgements: Sequence[Judgement], rows: Sequence[str]) -> list[Block]:
    """Which claims hold, which do not, and what the others lack."""
    groups: dict[str, list[str]] = {}
    for claim in CLAIMS:
        here = [(j, _standing(j)) for j in judgements if j.claim is claim and not j.setting.prefix]
        alike = len({standing for _, standing in here}) == 1
        for j, standing in here[: 1 if alike else None]:
            name = str(claim.number) if alike else f"{claim.number} ({_SETTINGS[j.setting.schedule]})"
            groups.setdefault(standing, []).append(name)
    lines = [f"**{standing}**: {', '.join(groups[standing])}" for standing in _STANDINGS if standing in groups]
    counted = sum(len(results.samples(row)) for row in rows)
    seeds = f"{counted} run{'' if counted == 1 else 's'} of {len(rows)} row{'' if len(rows) == 1 else 's'}"
    length = " Runs of any length count." if results.any_length else ""
    default = find_row("walker/plain")
    where = f"{default.engine}, {default.task.robot.name} ant"
    text = f"{len(CLAIMS)} claims, judged from {seeds} ({where} if not said otherwise).{length}"
    for prefix in dict.fromkeys(j.setting.prefix for j in judgements if j.setting.prefix):
        standing_of = {
            s: [str(j.claim.number) for j in judgements if j.setting.prefix == prefix and _standing(j) == s]
            for s in _STANDINGS
        }
        said = "; ".join(f"{s.lower()}: {', '.join(dict.fromkeys(n))}" for s, n in standing_of.items() if n)
        lines.append(f"{prefix.strip('/')}: {said}")
    return [Text(text), Bullets(tuple(lines))]


_STANDINGS = ("Holds", "Does not hold", "Undecided with all seeds", "Undecided, too few seeds", "Runs missing")
_SETTINGS = {"paper": "the paper's reward", "hrl": "our reward"}


def _standing(j: Judgement) -> str:
    """The verdict, or what keeps it from being one."""
    if j.verdict != "undecided":
        return j.verdict.capitalize()
    fewest = min(min(f.seeds) for f in j.findings if f.contrast.decides)
    return _STANDINGS[4] if fewest == 0 else _STANDINGS[3] if fewest < j.claim.min_seeds else _STANDINGS[2]


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
    header = (
        "",
        "claim",
        "the paper's reward and schedule",
        "our reward, our masters' schedule",
        "other ants and engines",
    )
    return TableBlock(header, tuple(rows))


def _brief(judgements: Sequence[Judgement], named: bool = False) -> str:
    lines = []
    for j in judgements:
        deciding = [f for f in j.findings if f.contrast.decides and f.effect is not None]
        place = f"{j.where.removesuffix(f', {SCHEDULES[j.setting.schedule]}')}: " if named else ""
        so_far = "" if j.verdict == j.so_far else f" (so far: {j.so_far})"
        nothing = not any(any(f.seeds) for f in j.findings)
        missing = "" if deciding else ": no runs yet" if nothing else ": runs of one side only"
        lines.append(f"{place}**{j.verdict}**{so_far}{missing}")
        for f in ([f for f in deciding if f.so_far == j.so_far] or deciding)[:1]:
            lines.append("; ".join(filter(None, (_said(f), no_room(f)))))
        lines += [f"and {len(deciding) - 1} more"] if len(deciding) > 1 else []
    return "\n".join(lines) or "-"


def _claims_table(judgements: Sequence[Judgement]) -> TableBlock:
    rows = []
    for j in judgements:
        said = [_said(f) for f in j.findings if f.contrast.decides]
        said += [f"(shown) {_said(f)}" for f in j.findings if not f.contrast.decides and f.effect is not None]
        rows.append((str(j.claim.number), j.where, f"**{j.verdict}**", "\n".join(said), j.why))
    return TableBlock(("", "where", "verdict", "effect [95 %], P, seeds", "because"), tuple(rows))


def _said(finding: Finding) -> str:
    """A comparison in one line."""
    chance = "" if (shown := show_chance(finding)) is None else f", P {shown}"
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
            show_bound(f.contrast),
            show_effect(f),
            show_chance(f) or "-",
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


def _choices_table(results: Results) -> TableBlock:
    return TableBlock(("what", "here"), tuple((choice.what, choice.here) for choice in choices(results.study)))


def _left_out(results: Results, judgements: Sequence[Judgement], drawn: Sequence[Drawn]) -> list[Block]:
    missing = list(dict.fromkeys(row for d in drawn for row in d.without))
    planned: dict[str, int] = {}
    read = {row: j.claim.min_seeds for j in judgements for f in j.findings if f.contrast.decides for row in f.rows}
    for job in plan(results.study):
        planned[job.row] = planned.get(job.row, 0) + 1
    for row, asked in read.items():  # rows of other engines stand in no plan
        planned.setdefault(row, asked)
    missing += [row for row in planned if row not in missing and not results.samples(row)]
    few = {row: len(results.samples(row)) for row in planned if 0 < len(results.samples(row)) < planned[row]}
    blocks: list[Block] = []
    if missing:
        blocks.append(Text(f"Rows of the study that have no finished run: {in_braces(dict.fromkeys(missing))}."))
    if few:
        by_count: dict[str, list[str]] = {}
        for row, have in few.items():
            by_count.setdefault(f"{have} of {planned[row]}", []).append(row)
        said = "; ".join(f"{count}: {in_braces(group)}" for count, group in by_count.items())
        blocks.append(Text(f"Rows with fewer seeds than the study plans or a claim asks for: {said}."))
    problems = [line for line in results.said() if line not in results.unfinished]  # those are rows with fewer
    if problems:
        here = f"{results.study.runs}{os.sep}"
        there = f" --runs {results.study.runs}"  # where the report was made says nothing to who reads it elsewhere
        lines = tuple((problem.replace(here, "").replace(there, ""),) for problem in problems)
        blocks.append(TableBlock(("file or run",), lines))
    return blocks or [Text("Nothing.")]


def _made(results: Results, rows: Sequence[str], command: str) -> list[Block]:
    found: dict[tuple[str, str], int] = {}
    by_count: dict[int, list[str]] = {}
    steps, seconds = 0, 0.0
    engines = {library for name in ENGINES for library in libraries_of(name)}
    for row in rows:
        samples = results.samples(row)
        by_count.setdefault(max((sample.seed + 1 for sample in samples), default=0), []).append(row)
        for sample in samples:
            steps += sample.control_steps
            theirs = set(libraries_of(sample.experiment.engine))
            for name, version in sample.run.versions().items():
                if name == "commit" or name in engines - theirs:  # told below; was there, and had no part in it
                    continue
                found[name, str(version)] = found.get((name, str(version)), 0) + 1
        seconds += sum(results.training_seconds(row))
    versions = tuple((name, version, str(count)) for (name, version), count in sorted(found.items()))
    spent = f"{steps / 1e6:,.1f} M control steps and {seconds / 3600:.1f} hours of one core in training alone"
    machine = read_machine(results.study.runs) or "not recorded"
    here = f"footwork {footwork.__version__}, Python {platform.python_version()}"
    quick = "" if results.study.size.short is None else " --quick"
    made = [
        f"footwork train {row} --seeds {' '.join(map(str, seeds))}{_length(results, row)}  # side by side"
        for row in rows
        for seeds in _trained_together(results, row)
    ]
    made += [
        f"footwork reproduce{quick} --rows {in_braces(group)} --seeds {n}"
        for n, group in sorted(by_count.items(), reverse=True)
    ]
    again = "footwork report --runs results --to .  # in this folder: the same report from the files beside it"
    return [
        Text("The runs that are in it (seeds 0, 1, ... of each row):"),
        Code("\n".join(made)),
        Text("The report:"),
        Code(f"{command}\n{again}"),
        Text(
            f"Machine on which the study was begun: {machine}; {spent}. Report written by {here}, "
            f"source {source_digest()}. Where something has two versions here, not all runs are of one make."
        ),
        TableBlock(("version of", "is", "runs"), versions),
        Text("Which runs were made at which commit:"),
        _commits_table(results, rows),
    ]


def _commits_table(results: Results, rows: Sequence[str]) -> TableBlock:
    """The commit of each run, a line per choice of seeds; those with most runs first."""
    made: dict[str, dict[str, list[int]]] = {}
    for row in rows:
        for sample in results.samples(row):
            commit = str(sample.run.versions().get("commit", "not recorded"))
            made.setdefault(commit, {}).setdefault(row, []).append(sample.seed)
    lines = []
    for commit, theirs in made.items():
        groups: dict[str, list[str]] = {}
        for row, seeds in theirs.items():
            whole = len(seeds) == len(results.samples(row))
            groups.setdefault("all" if whole else ", ".join(map(str, sorted(seeds))), []).append(row)
        total = sum(map(len, theirs.values()))
        lines += [
            ((-total, commit), (commit, seeds, str(sum(len(theirs[row]) for row in group)), in_braces(group)))
            for seeds, group in sorted(groups.items(), key=lambda item: (item[0] != "all", item[0]))
        ]
    table = tuple(line for _, line in sorted(lines, key=lambda item: item[0]))
    return TableBlock(("commit", "seeds", "runs", "rows"), table)


def _trained_together(results: Results, row: str) -> list[list[int]]:
    """The seeds of each run of a row that trained several."""
    runs = {sample.run.path: sample.run.config()["seeds"] for sample in results.samples(row)}
    return [seeds for seeds in runs.values() if len(seeds) > 1]


def _length(results: Results, row: str) -> str:
    """What a command for a run of a study in small says besides."""
    study = results.study
    return "" if study.size.short is None else f" --total-steps {study.row(row).total_steps} --runs {study.runs.name}"


__all__ = ["report_blocks", "write_report"]
