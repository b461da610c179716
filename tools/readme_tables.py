"""Put the report's claims and its table side by side into the README, line by line.

python tools/readme_tables.py
"""

from pathlib import Path

ROOT = Path(__file__).parents[1]


def _has_runs(claim: str) -> bool:
    return any(" seed" in cell for cell in claim.split("|")[3:])


def _is_of_the_default_ant(line: str) -> bool:
    return "/" not in line.split("|")[1]  # others stand under their address: light/plain


COPIED = {  # heading of the README: heading of the report, and which lines of the table there
    "## One real result": ("## Side by side", _is_of_the_default_ant),
    "## The study so far": ("## Claims", _has_runs),
}


def with_tables(readme: str, report: str) -> str:
    """The README with the report's tables: of the first table under each heading the lines that belong here."""
    lines = readme.splitlines(keepends=True)
    for mine, (theirs, belongs) in COPIED.items():
        start, end = _table(lines, mine)
        head, body = _split(report.splitlines(keepends=True), theirs)
        lines[start:end] = head + [line for line in body if belongs(line)]
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
