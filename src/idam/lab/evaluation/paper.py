"""What the paper reports (tables 1 to 3, and its ablation), to stand beside what is measured."""

from __future__ import annotations

__all__ = ["PAPER"]

Figures = tuple[float, float, float, float]
"""RMSE(R) and MAE(R) in degrees, RMSE(t) and MAE(t)."""

PAPER: dict[str, dict[str, Figures]] = {
    "unseen-shapes": {
        "icp": (33.68, 25.05, 0.29, 0.25),
        "fpfh-ransac": (2.33, 1.96, 0.015, 0.013),
        "fgr": (11.24, 2.83, 0.030, 0.008),
        "go-icp": (14.0, 3.17, 0.033, 0.012),
        "pointnetlk": (16.74, 7.55, 0.045, 0.025),
        "dcp": (6.71, 4.45, 0.027, 0.020),
        "prnet": (3.20, 1.45, 0.016, 0.010),
        "fpfh-idam": (2.46, 0.56, 0.016, 0.003),
        "gnn-idam": (2.95, 0.76, 0.021, 0.005),
    },
    "unseen-categories": {
        "icp": (34.89, 25.46, 0.29, 0.25),
        "fpfh-ransac": (2.11, 1.82, 0.015, 0.013),
        "fgr": (9.93, 1.95, 0.038, 0.007),
        "go-icp": (12.53, 2.94, 0.031, 0.010),
        "pointnetlk": (22.94, 9.66, 0.061, 0.033),
        "dcp": (9.77, 6.95, 0.034, 0.025),
        "prnet": (4.99, 2.33, 0.021, 0.015),
        "fpfh-idam": (3.04, 0.61, 0.019, 0.004),
        "gnn-idam": (3.42, 0.93, 0.022, 0.005),
    },
    "gaussian-noise": {
        "icp": (35.07, 25.56, 0.29, 0.25),
        "fpfh-ransac": (5.06, 4.19, 0.021, 0.018),
        "fgr": (27.67, 13.79, 0.070, 0.039),
        "go-icp": (12.26, 2.85, 0.028, 0.029),
        "pointnetlk": (19.94, 9.08, 0.057, 0.032),
        "dcp": (6.88, 4.53, 0.028, 0.021),
        "prnet": (4.32, 2.05, 0.017, 0.012),
        "fpfh-idam": (14.21, 7.52, 0.067, 0.042),
        "gnn-idam": (3.72, 1.85, 0.023, 0.011),
    },
    "ablation": {
        "ablation-bs": (7.77, 5.33, 0.055, 0.047),
        "ablation-sm": (5.08, 3.58, 0.056, 0.042),
        "ablation-ha-sm": (4.31, 2.89, 0.029, 0.019),
        "ablation-full": (3.42, 0.93, 0.022, 0.005),
    },
}
