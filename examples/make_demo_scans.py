"""Make the two scans that ``idam demo`` aligns: one machine part seen by a depth camera from two sides.

The part is our own, put together from trimesh primitives. Both views are rendered through a pinhole camera (the first
hit of every pixel's ray, so the part hides itself) and then spoilt the way a structured-light camera spoils them: the
projector's shadow, lost returns at grazing angles, noise along and across the ray, depth in whole millimetres. Each
scan is in metres in its own camera's frame, so the transform between the two is as large as the turn of the camera.

    python examples/make_demo_scans.py [OUT_DIR]

writes ``source.ply``, ``target.ply`` and ``truth.txt`` (the 4x4 ``T_target_source``), byte for byte the same each time.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import KDTree

Array = npt.NDArray[np.floating[Any]]
Triple = tuple[float, float, float]

BOLTS = ((-0.143, -0.073), (-0.143, 0.073), (0.143, -0.073), (0.03, 0.073))
MOTOR_PROFILE = ((0.0, 0.02), (0.09, 0.02), (0.09, 0.165), (0.045, 0.165), (0.0, 0.115))
DEMO_FOLDER = Path(__file__).resolve().parents[1] / "src" / "idam" / "data" / "demo"


@dataclass(frozen=True)
class DepthCamera:
    """A structured-light depth camera: z forward, x right, y down; lengths in metres, image sizes in pixels.

    The noise along the ray is the model that Nguyen, Izadi and Lovell fitted to the first Kinect ("Modeling Kinect
    Sensor Noise for Improved 3D Reconstruction and Tracking", 2012).
    """

    width: int = 320
    height: int = 240
    focal_length: float = 335.0
    baseline: float = 0.075
    depth_unit: float = 0.001
    lateral_noise: float = 0.4
    grazing_cosine: float = 0.3

    def rays(self) -> Array:
        """Return the ray of every pixel, (height, width, 3), scaled to z = 1."""
        rows, columns = np.mgrid[: self.height, : self.width].astype(np.float64)
        x = (columns - (self.width - 1) / 2) / self.focal_length
        y = (rows - (self.height - 1) / 2) / self.focal_length
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def project(self, points: Array) -> Array:
        """Take points (..., 3) in the camera's frame to pixel coordinates (..., 2): column, row."""
        centre = np.array([self.width - 1, self.height - 1]) / 2
        return np.asarray(points[..., :2] / points[..., 2:] * self.focal_length + centre)

    def axial_noise(self, depth: Array) -> Array:
        """Return the standard deviation of a depth measurement."""
        return 0.0012 + 0.0019 * (depth - 0.4) ** 2


def machine_part() -> Array:
    """Build a bearing block with a gear motor beside it on a base plate: triangles (F, 3, 3) in metres, z up.

    The solids overlap freely: from outside, the first hit sees their union.
    """
    solids = [
        _box((-0.17, 0.17), (-0.10, 0.10), (0.0, 0.022)),
        # the bearing block: pedestal, ring, flange, grease nipple
        _box((-0.135, 0.015), (-0.035, 0.035), (0.022, 0.095)),
        _tube((-0.06, 0.0, 0.15), axis="y", inner=0.048, outer=0.078, length=0.09),
        _tube((-0.06, -0.048, 0.15), axis="y", inner=0.040, outer=0.094, length=0.014),
        _rod((-0.085, 0.015, 0.235), axis="z", radius=0.014, length=0.05),
        _rod((-0.085, 0.015, 0.262), axis="z", radius=0.021, length=0.016, sides=6),
        # its ribs: a tall one towards the motor, a low one behind
        _hull([(x, y, z) for y in (-0.009, 0.009) for x, z in ((0.0, 0.02), (0.095, 0.02), (0.0, 0.125))]),
        _hull([(x, y, z) for x in (-0.1, -0.084) for y, z in ((0.03, 0.02), (0.095, 0.02), (0.03, 0.085))]),
        # the motor: housing with one slanted edge, shaft end, cooling fins
        _hull([(x, y, z) for x in (0.075, 0.165) for y, z in MOTOR_PROFILE]),
        _rod((0.12, 0.0, 0.068), axis="y", radius=0.03, length=0.06),
        _rod((0.12, -0.04, 0.068), axis="y", radius=0.013, length=0.07),
        *(_box((x, x + 0.008), (0.04, 0.088), (0.16, 0.19)) for x in (0.08, 0.103, 0.126, 0.149)),
        # bolted down at three bosses, the fourth is empty
        *(_tube((x, y, 0.026), axis="z", inner=0.010, outer=0.022, length=0.02) for x, y in BOLTS),
        *(_rod((x, y, 0.042), axis="z", radius=0.016, length=0.02, sides=6) for x, y in BOLTS[:3]),
    ]
    return np.concatenate(solids)


def _box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Array:
    """Make an axis-aligned box from its three intervals."""
    return _triangles(trimesh.creation.box(bounds=np.array([x, y, z]).T))


def _rod(centre: Triple, axis: str, radius: float, length: float, sides: int = 48) -> Array:
    """Make a cylinder, or with few sides a prism such as a bolt's head."""
    return _triangles(trimesh.creation.cylinder(radius, length, sections=sides, transform=_pose(centre, axis)))


def _tube(centre: Triple, axis: str, inner: float, outer: float, length: float) -> Array:
    """Make a cylinder with a bore."""
    return _triangles(trimesh.creation.annulus(inner, outer, length, sections=48, transform=_pose(centre, axis)))


def _hull(corners: list[Triple]) -> Array:
    """Make the convex solid over its corners."""
    return _triangles(trimesh.convex.convex_hull(np.array(corners)))


def _triangles(mesh: trimesh.Trimesh) -> Array:
    """Take the corners of a mesh's faces, (F, 3, 3)."""
    return np.asarray(mesh.triangles, dtype=np.float64)


def _pose(centre: Triple, axis: str) -> Array:
    """Return the transform that takes a primitive from the origin to ``centre`` and its z axis to ``axis``."""
    pose = np.eye(4)
    if axis == "y":
        pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    pose[:3, 3] = centre
    return pose


def camera_pose(azimuth: float, elevation: float, roll: float, distance: float) -> Array:
    """Return T_world_camera of a camera that looks at the part's middle from the given side; angles in degrees."""
    a, e, r = np.radians([azimuth, elevation, roll])
    forward = -np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    down = np.cross(forward, right)
    rolled = [np.cos(r) * right + np.sin(r) * down, np.cos(r) * down - np.sin(r) * right, forward]
    pose = np.eye(4)
    pose[:3, :3] = np.stack(rolled, axis=1)
    pose[:3, 3] = np.array([0.0, 0.0, 0.10]) - distance * forward
    return pose


def transform(T: Array, points: Array) -> Array:
    """Move points (..., 3) by a rigid transform (4, 4)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def render(camera: DepthCamera, triangles: Array, rays: Array) -> tuple[Array, Array]:
    """Find each ray's first hit: its depth (height, width), infinite without one, and the cosine of its incidence.

    The camera is at the origin, so ray d passes inside the triangle a, b, c where d·(a×b), d·(b×c) and d·(c×a) have
    one sign, and meets its plane at the depth a·n / d·n. Each triangle only meets the rays of its own bounding box.
    """
    depth = np.full(rays.shape[:2], np.inf)
    cosine = np.zeros(rays.shape[:2])
    limits = np.array([camera.width, camera.height])
    for corners in triangles:
        edges = np.cross(corners, np.roll(corners, -1, axis=0))
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        pixels = camera.project(corners)
        # two pixels of margin, for rays that lateral noise has moved off their pixel's centre
        left, top = np.clip(np.floor(pixels.min(axis=0)) - 2, 0, limits).astype(int)
        right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 3, 0, limits).astype(int)
        window = np.s_[top:bottom, left:right]
        sides = rays[window] @ edges.T
        slope = rays[window] @ normal
        hit = ((sides >= 0).all(axis=-1) | (sides <= 0).all(axis=-1)) & (slope != 0)
        z = np.divide(corners[0] @ normal, slope, out=np.full(slope.shape, np.inf), where=hit)
        nearer = z < depth[window]
        depth[window][nearer] = z[nearer]
        lengths = np.linalg.norm(rays[window], axis=-1) * np.linalg.norm(normal)
        cosine[window][nearer] = (np.abs(slope) / lengths)[nearer]
    return depth, cosine


def lit_by_projector(camera: DepthCamera, triangles: Array, points: Array) -> npt.NDArray[np.bool_]:
    """Say which points (N, 3) are reached by the projector, which is one baseline to the camera's right."""
    offset = np.array([camera.baseline, 0.0, 0.0])
    shadow_map, _ = render(camera, triangles - offset, camera.rays())
    column, row = np.rint(camera.project(points - offset)).astype(int).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    first = shadow_map[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)]
    # the shadow map's pixel may lie on a steep surface a little nearer than the point itself
    return np.asarray(inside & (points[:, 2] < first + 0.01))


def scan(camera: DepthCamera, part: Array, T_world_camera: Array, rng: np.random.Generator) -> Array:
    """Take one noisy view of the part's triangles: points (N, 3) in the camera's frame."""
    triangles = transform(np.linalg.inv(T_world_camera), part)
    rays = camera.rays()
    blurred = rays.copy()
    blurred[..., :2] += rng.normal(scale=camera.lateral_noise / camera.focal_length, size=blurred[..., :2].shape)
    depth, cosine = render(camera, triangles, blurred)
    returned = np.isfinite(depth) & (cosine > camera.grazing_cosine * rng.random(depth.shape))
    depth, blurred, rays = depth[returned], blurred[returned], rays[returned]
    lit = lit_by_projector(camera, triangles, blurred * depth[:, None])
    depth, rays = depth[lit], rays[lit]
    measured = depth + camera.axial_noise(depth) * rng.normal(size=depth.shape)
    # everything after the rounding is exact arithmetic, so the files do not hang on a processor's last bit
    return np.asarray(np.rint(measured / camera.depth_unit)[:, None] * camera.depth_unit * rays)


def spacing(points: Array) -> float:
    """Measure the median distance of a point to its nearest neighbour."""
    return float(np.median(KDTree(points).query(points, k=2)[0][:, 1]))


def overlap(source: Array, target: Array, T_target_source: Array) -> float:
    """Measure the share of source points that land within 1.5 spacings of a target point under the transform."""
    distances, _ = KDTree(target).query(transform(T_target_source, source))
    return float(np.mean(distances < 1.5 * spacing(target)))


def write_ply(path: Path, points: Array) -> None:
    """Write points (N, 3) as a binary PLY in float32."""
    properties = "".join(f"property float {name}\n" for name in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + points.astype("<f4").tobytes())


def main() -> None:
    """Make the two scans, write them and say what they are like."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out_dir", metavar="OUT_DIR", nargs="?", type=Path, default=DEMO_FOLDER)
    out_dir: Path = parser.parse_args().out_dir
    out_dir.mkdir(parents=True, exist_ok=True)

    camera, part, rng = DepthCamera(), machine_part(), np.random.default_rng(20)
    T_world_source = camera_pose(azimuth=-79.0, elevation=26.0, roll=-4.0, distance=0.80)
    T_world_target = camera_pose(azimuth=-16.0, elevation=38.0, roll=8.0, distance=0.85)
    source = scan(camera, part, T_world_source, rng)
    target = scan(camera, part, T_world_target, rng)
    T_target_source = np.linalg.inv(T_world_target) @ T_world_source

    write_ply(out_dir / "source.ply", source)
    write_ply(out_dir / "target.ply", target)
    np.savetxt(out_dir / "truth.txt", T_target_source, fmt="%.12f")

    angle = np.degrees(np.arccos((np.trace(T_target_source[:3, :3]) - 1) / 2))
    print(f"{len(source)} and {len(target)} points, {1000 * spacing(target):.1f} mm apart, in {out_dir}")
    print(f"overlap {overlap(source, target, T_target_source):.2f}, rotation {angle:.1f} degrees")


if __name__ == "__main__":
    main()
