"""A text of headings, tables and figures, as Markdown and as one HTML page."""

from __future__ import annotations

import base64
import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from footwork.study.experiments import in_braces
from footwork.study.figures import Drawn


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
class Bullets:
    """A list."""

    lines: tuple[str, ...]


@dataclass(frozen=True)
class Code:
    """Commands."""

    text: str


@dataclass(frozen=True)
class TableBlock:
    """A table; lines in cells are separated by newlines."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Picture:
    """A figure with its caption, in which names in braces stand for facts."""

    drawn: Drawn
    facts: Mapping[str, str]


Block = Heading | Text | Bullets | Code | TableBlock | Picture


def markdown(blocks: Sequence[Block], to: Path) -> str:
    """The text as Markdown, its pictures linked as seen from the folder ``to``."""
    return "\n\n".join(_as_markdown(block, to) for block in blocks) + "\n"


def _as_markdown(block: Block, to: Path) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {text}"
        case Text(text):
            return text
        case Bullets(lines):
            return "\n".join(f"* {line}" for line in lines)
        case Code(text):
            return f"```\n{text}\n```"
        case TableBlock(header, rows):
            every = [header, ("---",) * len(header), *rows]
            return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in every)
        case Picture(drawn, facts):
            png, svg = (os.path.relpath(path, to) for path in drawn.files)
            return f"### {_heading(drawn)}\n\n![{drawn.figure.title}]({png})\n\n{_caption(drawn, facts)} [SVG]({svg})"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", "<br>")


def _heading(drawn: Drawn) -> str:
    figure = drawn.figure
    number = figure.name.partition("-")[0].lstrip("0")
    paper = f" (the paper's {figure.paper})" if figure.paper else ""
    where = f", {drawn.prefix.strip('/')}" if drawn.prefix else ""
    return f"{number}. {figure.title}{where}{paper}"


def _caption(drawn: Drawn, facts: Mapping[str, str]) -> str:
    without = f" Without finished runs: {in_braces(drawn.without)}." if drawn.without else ""
    under = f" --under {drawn.prefix.strip('/')}" if drawn.prefix else ""
    return f"{drawn.figure.caption.format(**facts)}{without} Drawn by `footwork figures {drawn.figure.name}{under}`."


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


def page(blocks: Sequence[Block], title: str) -> str:
    """The text as one HTML page that needs nothing else: its pictures are in it."""
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
        case Bullets(lines):
            return "<ul>" + "\n".join(f"<li>{_inline(line)}</li>" for line in lines) + "</ul>"
        case Code(text):
            return f"<pre>{html.escape(text)}</pre>"
        case TableBlock(header, rows):
            every = ["".join(f"<th>{html.escape(cell)}</th>" for cell in header)]
            every += ["".join(f"<td>{_inline(cell)}</td>" for cell in row) for row in rows]
            return "<table>" + "\n".join(f"<tr>{line}</tr>" for line in every) + "</table>"
        case Picture(drawn, facts):
            data = base64.b64encode(drawn.files[0].read_bytes()).decode()
            image = f'<img src="data:image/png;base64,{data}" alt="{html.escape(drawn.figure.title)}">'
            caption = f"<figcaption>{_inline(_caption(drawn, facts))}</figcaption>"
            return f"<figure><h3>{html.escape(_heading(drawn))}</h3>{image}{caption}</figure>"


def _inline(text: str) -> str:
    """Escaped text in which **bold** and `code` mean what they do in Markdown."""
    parts: list[str] = []
    for number, part in enumerate(html.escape(text).split("`")):
        bold = part.split("**")
        parts.append(
            f"<code>{part}</code>" if number % 2 else "".join(_bold(p) if i % 2 else p for i, p in enumerate(bold))
        )
    return "".join(parts)


def _bold(text: str) -> str:
    """Bold; verdicts in their colours."""
    verdict = text.lower()
    mark = f' class="{verdict.replace(" ", "-")}"' if verdict in ("holds", "does not hold", "undecided") else ""
    return f"<b{mark}>{text}</b>"


__all__ = ["Block", "Bullets", "Code", "Heading", "Picture", "TableBlock", "Text", "markdown", "page"]
