"""What depends on a cloud's points alone: frame, voxel grid, levels of resolution, surfaces."""
