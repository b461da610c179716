"""Figures, each drawn from files alone; the only package that imports matplotlib."""

from footwork.study.figures.parity import curves_figure, parity_figure
from footwork.study.figures.paths import learning_curve, paths_figure
from footwork.study.figures.speed import bench_figure
from footwork.study.figures.style import count_in_words
from footwork.study.figures.table import FIGURES, Drawn, Figure, draw_figures, find_figures

__all__ = [
    "FIGURES",
    "Drawn",
    "Figure",
    "bench_figure",
    "count_in_words",
    "curves_figure",
    "draw_figures",
    "find_figures",
    "learning_curve",
    "parity_figure",
    "paths_figure",
]
