"""Measuring methods on pairs: metrics, the methods, and the experiments."""
