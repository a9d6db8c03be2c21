"""Many scans: which pairs to register, a robust pose graph over them, joint refinement, one cloud."""
