"""Make ten scans of a made-up object, each in a frame of its own, for ``idam merge`` to put together.

The object is a lumpy ellipsoid. Each scan sees what faces it from one of ten directions, at points of its own, with
noise of 0.2 % of the object's size, and is turned and moved at random.

    python examples/merge_scans.py scans
    idam merge scans -o out

The first line writes ``scans/view0.ply`` to ``view9.ply`` and, beside the folder, ``scans-truth.json`` with their true
poses, the same each time.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from idam import rigid
from idam.io import make_folder, write_json, write_point_cloud
from idam.rigid import Array

VIEWS = 10
POINTS = 30_000
NOISE = 0.002


def surface(lumps: np.random.Generator, random: np.random.Generator) -> Array:
    """Random points (N, 3) on a sphere with lumps and dents, stretched."""
    axes = lumps.normal(size=(25, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    heights, widths = lumps.uniform(-0.15, 0.4, 25), lumps.uniform(6, 60, 25)
    direction = random.normal(size=(POINTS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = 0.6 + (heights * np.exp(widths * (direction @ axes.T - 1))).sum(1)
    return np.asarray(direction * radius[:, None] * [1.0, 0.8, 0.65])


def views() -> tuple[list[Array], Array]:
    """The scans, and their poses (10, 4, 4): each scan's coordinates to the object's."""
    random = np.random.default_rng(1)
    scans, poses = [], []
    for view in range(VIEWS):
        angle = 2 * np.pi * view / VIEWS
        towards = np.array([np.cos(angle), np.sin(angle), 0.7 * np.cos(2 * angle)])
        points = surface(np.random.default_rng(0), random)
        facing = points @ towards > 0.1 * np.linalg.norm(towards)
        seen = points[facing] + random.normal(scale=NOISE, size=(int(facing.sum()), 3))
        pose = rigid.exp(random.normal(scale=[1.5] * 3 + [0.5] * 3))
        scans.append(rigid.apply(rigid.inverse(pose), seen))
        poses.append(pose)
    return scans, np.stack(poses)


def main() -> None:
    """Write the scans and their true poses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = make_folder(parser.parse_args().folder)
    scans, poses = views()
    for view, scan in enumerate(scans):
        write_point_cloud(folder / f"view{view}.ply", scan)
    truth = {f"view{view}.ply": pose.tolist() for view, pose in enumerate(poses)}
    write_json(folder.with_name(f"{folder.name}-truth.json"), truth)


if __name__ == "__main__":
    main()
