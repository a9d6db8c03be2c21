"""Learned global registration of partially overlapping 3D point clouds (IDAM, ECCV 2020)."""

__version__ = "0.1.0"
