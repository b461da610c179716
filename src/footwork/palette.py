"""Colours of everything drawn: Okabe and Ito's palette, which keeps apart for the colour-blind and in print."""

from __future__ import annotations

DIRECTION_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")  # right, up, left, down
FLAT_COLOUR = "#7A7A7A"
GOAL_COLOUR = "#D55E00"


def rgb(colour: str) -> tuple[float, float, float]:
    """Red, green and blue in 0..1 of a colour written #RRGGBB."""
    red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
