"""The rivals that others wrote: each lays a cloud on its turned copy, and says what it lacks."""

import sys
from importlib.util import find_spec

import numpy as np
import pytest

from idam.errors import InputError, MissingDependencyError
from idam.lab.evaluation.methods import METHODS, build_method, classical
from idam.network.geometry import euler_xyz_to_rotation

OPEN3D = [name for name, (place, _) in METHODS.items() if place.startswith("classical")]


def available(package: str) -> bool:
    if find_spec(package) is None:
        return False
    try:
        __import__(package)
    except (ImportError, OSError):
        return False
    return True


needs_open3d = pytest.mark.skipif(not available("open3d"), reason="Open3D, or a library it needs, is not installed")
needs_kiss = pytest.mark.skipif(not available("kiss_matcher"), reason="KISS-Matcher is not installed")


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A step of three faces, and its copy 20 degrees away."""
    import torch

    rng = np.random.default_rng(0)
    faces = [
        np.insert(rng.uniform(-0.5, 0.5, (300, 2)), axis, value, axis=1) for axis, value in enumerate((0.4, -0.3, 0.1))
    ]
    source = np.concatenate(faces).astype(np.float32)
    truth = np.eye(4)
    truth[:3, :3] = euler_xyz_to_rotation(torch.tensor([0.2, 0.1, 0.3], dtype=torch.float64)).numpy()
    truth[:3, 3] = [0.02, -0.03, 0.01]
    return source, (source @ truth[:3, :3].T + truth[:3, 3]).astype(np.float32), truth


@needs_open3d
@pytest.mark.parametrize("name", OPEN3D)
def test_open3d_s_methods_find_the_way_to_a_copy(name, pair):
    source, target, truth = pair
    method = build_method(name)
    found = method(source, target)
    assert found.shape == (4, 4)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, truth, atol=0.02)
    np.testing.assert_allclose(method(source, target), found, atol=1e-5)  # RANSAC's threads race for the last bits


@needs_kiss
def test_kiss_matcher_finds_the_way_to_a_copy(pair):
    source, target, truth = pair
    np.testing.assert_allclose(build_method("kiss-matcher")(source, target), truth, atol=0.05)


@needs_open3d
def test_settings_change_what_a_method_does(pair):
    source, target, truth = pair
    still = build_method("icp", None, ["icp_iterations=1", "icp_distance=0.05"])(source, target)
    assert np.abs(still - truth).max() > 0.05


@pytest.mark.parametrize("setting", ["radius=1", "icp_distance", "icp_distance=far", "icp_iterations=1.5"])
def test_an_unknown_setting_is_refused_with_the_known_ones(setting, monkeypatch):
    monkeypatch.setattr(classical, "open3d", lambda: None)
    with pytest.raises(InputError, match=r"icp_(distance|iterations)"):
        build_method("icp", None, [setting])


@pytest.mark.parametrize(("name", "setting"), [("icp", "fgr_distance=1"), ("fgr", "ransac_distance=1")])
def test_settings_of_other_methods_are_refused(name, setting, monkeypatch):
    monkeypatch.setattr(classical, "open3d", lambda: None)
    with pytest.raises(InputError, match=f"unknown setting '{setting}'"):
        build_method(name, None, [setting])


MISSING = {"icp": "open3d", "fgr": "open3d", "fpfh-ransac": "open3d", "kiss-matcher": "kiss_matcher"}


@pytest.mark.parametrize(("name", "package"), MISSING.items())
def test_a_missing_package_is_named_with_the_command_that_brings_it(name, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[benchmark\]'"):
        build_method(name)


def test_go_icp_is_named_with_the_command_that_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "py_simple_go_icp_interface.main", None)
    with pytest.raises(MissingDependencyError, match=r"g\+\+.*pip install 'idam\[benchmark\]'"):
        build_method("go-icp")
