"""The classical rows through Open3D: ICP, fast global registration, and RANSAC over FPFH matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import MissingDependencyError
from idam.lab.evaluation.methods import Method
from idam.lab.settings import with_settings

__all__ = ["Settings", "fgr", "icp", "ransac"]


@dataclass(frozen=True)
class Settings:
    """What the methods take; the defaults are those published for the paper's rows, where it names them.

    Attributes:
        normal_radius: of the normals that FPFH is built on, at most 30 neighbours.
        feature_radius: of FPFH, at most 100 neighbours.
        icp_distance: ICP's largest distance of a match.
        icp_iterations: ICP's largest number of iterations.
        fgr_distance: fast global registration's largest distance of a match.
        fgr_anneal: whether it shrinks its robust kernel down to that distance, without which the distance says nothing.
        ransac_distance: RANSAC's largest distance of an inlier.
        ransac_iterations: RANSAC's largest number of iterations.
        ransac_edges: how alike the edges of a sample must be in both clouds to be tried, as a share; 0 to try them all.
        icp_after: largest distance of a match of an ICP that follows the method; 0 for none.
    """

    normal_radius: float = 0.1
    feature_radius: float = 0.25
    icp_distance: float = 100.0
    icp_iterations: int = 500
    fgr_distance: float = 0.02
    fgr_anneal: bool = False
    ransac_distance: float = 0.05
    ransac_iterations: int = 100_000
    ransac_edges: float = 0.0
    icp_after: float = 0.0


ICP = ("icp_distance", "icp_iterations")
FPFH = ("normal_radius", "feature_radius", "icp_after", "icp_iterations")
FGR = (*FPFH, "fgr_distance", "fgr_anneal")
RANSAC = (*FPFH, "ransac_distance", "ransac_iterations", "ransac_edges")
"""Settings that each method uses; the others are refused, rather than ignored."""


def icp(model: str | None, settings: Sequence[str]) -> Method:
    """Point-to-point ICP from the identity."""
    return _method(_icp, settings, ICP)


def fgr(model: str | None, settings: Sequence[str]) -> Method:
    """Fast global registration on FPFH matches (Zhou et al., ECCV 2016)."""
    return _method(_fgr, settings, FGR)


def ransac(model: str | None, settings: Sequence[str]) -> Method:
    """RANSAC over mutual FPFH matches."""
    return _method(_ransac, settings, RANSAC)


def open3d() -> Any:
    """Open3D, by name: whether its stubs are installed must not change the verdict on types.

    Raises:
        MissingDependencyError: it is not installed, or lacks a system library.
    """
    try:
        return import_module("open3d")
    except (ImportError, OSError) as error:
        raise MissingDependencyError(
            f"this method needs Open3D, which cannot be imported ({error}): pip install 'idam[benchmark]', and on "
            "Debian apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1"
        ) from None


def _method(register: Callable[..., Any], texts: Sequence[str], used: Sequence[str]) -> Method:
    settings, o3d = with_settings(Settings(), texts, used), open3d()
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)

    def run(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
        o3d.utility.random.seed(0)
        moving, fixed = _cloud(o3d, source), _cloud(o3d, target)
        found = register(o3d, moving, fixed, settings)
        if settings.icp_after:
            found = _icp_from(o3d, moving, fixed, settings.icp_after, settings, found.transformation)
        return np.array(found.transformation, np.float64)

    return run


def _cloud(o3d: Any, points: NDArray[np.float32]) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))


def _icp(o3d: Any, source: Any, target: Any, settings: Settings) -> Any:
    return _icp_from(o3d, source, target, settings.icp_distance, settings, np.eye(4))


def _icp_from(o3d: Any, source: Any, target: Any, distance: float, settings: Settings, start: Any) -> Any:
    registration = o3d.pipelines.registration
    return registration.registration_icp(
        source,
        target,
        distance,
        start,
        registration.TransformationEstimationPointToPoint(),
        registration.ICPConvergenceCriteria(max_iteration=settings.icp_iterations),
    )


def _fgr(o3d: Any, source: Any, target: Any, settings: Settings) -> Any:
    registration = o3d.pipelines.registration
    option = registration.FastGlobalRegistrationOption(
        maximum_correspondence_distance=settings.fgr_distance, decrease_mu=settings.fgr_anneal
    )
    features = _fpfh(o3d, source, settings), _fpfh(o3d, target, settings)
    return registration.registration_fgr_based_on_feature_matching(source, target, *features, option)


def _ransac(o3d: Any, source: Any, target: Any, settings: Settings) -> Any:
    registration = o3d.pipelines.registration
    return registration.registration_ransac_based_on_feature_matching(
        source,
        target,
        _fpfh(o3d, source, settings),
        _fpfh(o3d, target, settings),
        True,
        settings.ransac_distance,
        registration.TransformationEstimationPointToPoint(),
        3,
        [registration.CorrespondenceCheckerBasedOnEdgeLength(settings.ransac_edges)] if settings.ransac_edges else [],
        registration.RANSACConvergenceCriteria(settings.ransac_iterations, 0.999),
    )


def _fpfh(o3d: Any, cloud: Any, settings: Settings) -> Any:
    search = o3d.geometry.KDTreeSearchParamHybrid
    cloud.estimate_normals(search(settings.normal_radius, 30))
    return o3d.pipelines.registration.compute_fpfh_feature(cloud, search(settings.feature_radius, 100))
