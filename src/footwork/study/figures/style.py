"""How figures look: colours that keep apart for the colour-blind, line styles that keep apart in print."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from footwork.checkpoint import write_atomically
from footwork.study.results import Results, seeds_in_words

DPI = 160
WIDTH = 7.2  # inches, of a page
_RC: dict[Any, Any] = {
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "svg.fonttype": "none",
    "svg.hashsalt": "footwork",  # the same figure is the same file
    "figure.constrained_layout.use": True,
}


class Look(NamedTuple):
    """Of a row, wherever it is drawn: a colour (Okabe and Ito's, and darker ones) and a mark of its own."""

    colour: str
    mark: str


LOOKS: dict[str, Look] = {
    "plain": Look("#000000", "o"),
    "random-start": Look("#E69F00", "s"),
    "random-repeated": Look("#56B4E9", "^"),
    "appropriate-bias": Look("#0072B2", "D"),
    "interleaved": Look("#009E73", "v"),
    "symmetric": Look("#CC79A7", "P"),
    "symmetric-interleaved": Look("#D55E00", "X"),
    "free": Look("#7A7A7A", "<"),
    "penalised": Look("#332288", ">"),
    "guided-free": Look("#A6761D", "*"),
    "guided-penalised": Look("#882255", "p"),
}
_OTHER = Look("#444444", ".")


def look_of(row: str) -> Look:
    """How a row is drawn, by the last part of its address."""
    return LOOKS.get(row.rpartition("/")[2], _OTHER)


def label_of(row: str) -> str:
    """What a row is called in a legend."""
    last = row.rpartition("/")[2]
    return f"flat, {last}" if "/flat/" in row else last


def seeds_of(results: Results, rows: Iterable[str]) -> str:
    """How many seeds stand behind the rows of a panel that have any: ``10 seeds``, ``2 to 10 seeds``."""
    counts = sorted({count for row in rows if (count := len(results.samples(row)))})
    return seeds_in_words(" to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))) if counts else ""


def log_axis(ax: Any, words: Callable[[float], str], decades: float) -> None:
    """A logarithmic x axis as long as what is drawn, at most so many powers of ten; ticks read as numbers."""
    ax.set_xscale("log")
    ax.minorticks_off()
    high, first = ax.dataLim.x1, ax.dataLim.minposx
    if not np.isfinite(first) or high <= 0:
        return
    low = max(first, high / 10**decades)
    ticks: list[float] = []
    for steps in ((1, 3), (1, 1.5, 2, 3, 5, 7)):  # a short axis gets finer ones
        ticks = [m * 10.0**e for e in range(-4, 9) for m in steps if low <= m * 10.0**e <= 1.001 * high]
        if len(ticks) > 1:
            break
    ax.set_xticks(ticks, [words(tick) for tick in ticks])
    ax.set_xlim(low, 1.05 * high)


def count_in_words(steps: float) -> str:
    """``300``, ``30 k``, ``3 M``."""
    return f"{steps / 1e6:g} M" if steps >= 1e6 else f"{steps / 1e3:g} k" if steps >= 1e3 else f"{steps:g}"


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the style of the study."""
    with plt.rc_context(_RC):
        yield


def panels(
    rows: int, columns: int, height: float, share_y: bool = False, layout: str = "constrained"
) -> tuple[Any, Any]:
    """A figure as wide as a page, and its axes [rows, columns]; ``height`` of one row in inches."""
    size = (WIDTH, height * rows)
    return plt.subplots(rows, columns, figsize=size, squeeze=False, sharey=share_y, layout=layout)


def save(figure: Any, path: Path, note: str = "") -> list[Path]:
    """Write PNG and SVG beside each other; a note (of a small study) stands on the figure itself."""
    if note:
        figure.text(1.0, 1.015, note, ha="right", va="bottom", fontsize=8, color="#B00020", weight="bold")
    _freeze_layout(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    png, svg = path.with_suffix(".png"), path.with_suffix(".svg")
    for file, style in ((png, {"dpi": DPI, "metadata": {"Software": None}}), (svg, {"metadata": {"Date": None}})):
        content = io.BytesIO()
        figure.savefig(content, format=file.suffix[1:], bbox_inches="tight", **style)
        write_atomically(file, content.getvalue())
    plt.close(figure)
    return [png, svg]


def _freeze_layout(figure: Any) -> None:
    """Lay the figure out once and round where its axes are.

    The layout's solver leaves last digits that differ from one process to the next, and an SVG's names follow them.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for ax in figure.axes:
        ax.set_position([round(number, 6) for number in ax.get_position(original=True).bounds])


def legend_below(figure: Any, axes: Sequence[Any], columns: int = 3) -> None:
    """One legend for several axes, each label once."""
    handles: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)


def empty(ax: Any, what: str) -> None:
    """Say on the axes themselves that there is nothing to draw yet."""
    ax.set_xticks([])
    ax.text(0.5, 0.5, what, transform=ax.transAxes, ha="center", va="center", color="#888888", wrap=True)


def interval_marks(ax: Any, x: Sequence[float], effects: Sequence[Any], look: Look, label: str) -> None:
    """Points with their intervals as bars."""
    middle = np.array([e.estimate for e in effects])
    below, above = middle - [e.low for e in effects], np.array([e.high for e in effects]) - middle
    ax.errorbar(
        x,
        middle,
        yerr=np.maximum([below, above], 0.0),
        color=look.colour,
        marker=look.mark,
        ms=4.5,
        lw=1.3,
        capsize=2,
        label=label,
    )
