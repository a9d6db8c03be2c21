"""The learned methods that the paper compares with, written from their papers: PointNetLK, DCP-v2 and PRNet."""
