"""Features of a cloud's points that no rigid motion changes, in NumPy."""
