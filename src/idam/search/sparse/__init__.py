"""What is asked besides of sparse clouds, which share a surface and no points."""
