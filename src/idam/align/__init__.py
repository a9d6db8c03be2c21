"""Fine alignment: small_gicp's methods, and a symmetric one for sparse clouds."""

from idam.align.methods import METHODS, align, reaches, refine

__all__ = ["METHODS", "align", "reaches", "refine"]
