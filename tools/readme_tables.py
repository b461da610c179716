"""Put the report's verdicts and its table side by side into the README, line by line.

python tools/readme_tables.py
"""

import re
from pathlib import Path

from footwork.study.experiments import KINDS

ROOT = Path(__file__).parents[1]


def _verdicts_alone(claim: str) -> str | None:
    """A claim and what became of it, without the comparisons; None for one that has no runs."""
    cells = claim.split("|")
    if not any(" seed" in cell for cell in cells[3:]):
        return None
    # An engine or ant is named before its verdict, a comparison stands in a line of its own after it.
    words = re.sub(r" \([^()]*; shown too:[^()]*\)", "", cells[2].replace("<br>", " "))  # what a comparison is about
    shown = [re.sub(r"<br>(?![^<]*\*\*)[^<]*", "", cell).rstrip() + " " for cell in cells[3:-1]]
    return "|".join([*cells[:2], words, *shown, cells[-1]])


def _main_kind(line: str) -> str | None:
    """The line of a kind of sub-policies or of flat policies; None for ablations and other ants."""
    name = line.split("|")[1].strip()
    return line if name in KINDS or name.startswith("flat policy") else None


COPIED = {  # heading of the README: heading of the report, and what the README says of each line of its table
    "## One real result": ("## Side by side", _main_kind),
    "## The study so far": ("## Claims", _verdicts_alone),
}


def with_tables(readme: str, report: str) -> str:
    """The README with the report's tables: of the first table under each heading the lines that belong here."""
    lines = readme.splitlines(keepends=True)
    for mine, (theirs, line_of) in COPIED.items():
        start, end = _table(lines, mine)
        head, body = _split(report.splitlines(keepends=True), theirs)
        lines[start:end] = head + [line for line in map(line_of, body) if line is not None]
    return "".join(lines)


def _split(lines: list[str], heading: str) -> tuple[list[str], list[str]]:
    start, end = _table(lines, heading)
    return lines[start : start + 2], lines[start + 2 : end]


def _table(lines: list[str], heading: str) -> tuple[int, int]:
    """Where the first table under a heading begins, and where it ends."""
    start = next(i for i in range(lines.index(f"{heading}\n"), len(lines)) if lines[i].startswith("| "))
    return start, next(i for i in range(start, len(lines) + 1) if i == len(lines) or not lines[i].startswith("|"))


if __name__ == "__main__":
    path = ROOT / "README.md"
    report = (ROOT / "report" / "REPORT.md").read_text(encoding="utf-8")
    path.write_text(with_tables(path.read_text(encoding="utf-8"), report), encoding="utf-8")
