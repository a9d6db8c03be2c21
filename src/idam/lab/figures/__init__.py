"""The paper's figures (appendix B), drawn from the shipped weights."""

from idam.lab.figures.draw import draw_figures

__all__ = ["draw_figures"]
