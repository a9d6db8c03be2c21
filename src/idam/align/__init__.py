"""Fine alignment: small_gicp's methods, a symmetric one for sparse clouds, a last stage, and how precise it ends."""

from idam.align.methods import METHODS, align, copies, reaches, refine

__all__ = ["METHODS", "align", "copies", "reaches", "refine"]
