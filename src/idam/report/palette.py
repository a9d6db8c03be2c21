"""The colours of pages and pictures: Okabe and Ito's, which colour-blind people can tell apart."""

from __future__ import annotations

__all__ = ["BLUE", "GREEN", "GREY", "ORANGE", "PALETTE", "SOURCE", "TARGET", "TARGET_ON_DARK", "VERMILLION"]

BLUE, ORANGE, GREEN, VERMILLION, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#999999"
PALETTE = (BLUE, ORANGE, GREEN, VERMILLION, "#CC79A7", "#56B4E9", "#000000")

SOURCE, TARGET = ORANGE, BLUE
"""Of the cloud that moves and the one that stays, on every page and in every picture."""
TARGET_ON_DARK = "#3A9BE0"
"""A lighter blue, which shows on a dark page."""
