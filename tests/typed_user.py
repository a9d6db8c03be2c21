"""A user's script that calls every public function: checked by ``mypy --strict`` (and pyright), not run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

import idam

if TYPE_CHECKING:
    from typing_extensions import assert_type

    Matrix = NDArray[np.float64]
    points: Matrix = np.zeros((100, 3))

    # register
    result = idam.register("source.ply", Path("target.ply"))
    assert_type(result, idam.RegistrationResult)
    assert_type(result.transformation, NDArray[np.float64])
    assert_type(result.information, NDArray[np.float64])
    assert_type(result.confidence, float)
    assert_type(result.converged, bool)
    assert_type(result.reason, str)
    assert_type(result.fitness, float)
    assert_type(result.seconds, float)
    for other in result.hypotheses:
        assert_type(other.score, float)
    assert_type(result.matches.weight, NDArray[np.float64])
    result.save("result.json")
    assert_type(result.apply(points), NDArray[np.float64])
    refinement: Literal["gicp", "plane"] = "plane"
    idam.register(points, points.tolist(), refine=refinement, init=np.eye(4), max_angle=45, voxel_size=0.1, seed=1)
    idam.register(points.astype(np.float32), points, refine=None, init=[[1, 0, 0, 0]] * 4, model=Path("w.safetensors"))
    idam.register(points, points, refine="icp")  # type: ignore[arg-type]
    idam.register(points, points, model=3)  # type: ignore[arg-type]
    idam.register(points, points, voxel="0.1")  # type: ignore[call-arg]

    # prepare
    cloud = idam.prepare(points, model="default")
    assert_type(cloud, idam.Prepared)
    cloud.save(Path("cloud.idam"))
    assert_type(idam.Prepared.load("cloud.idam"), idam.Prepared)
    idam.register(cloud, cloud)

    # merge
    merged = idam.merge(["a.ply", Path("b.ply"), points, cloud], jobs=2, poses={"a.ply": np.eye(4)}, keep=Path("kept"))
    assert_type(merged, idam.MergeResult)
    for pose in merged.poses:
        assert_type(pose, NDArray[np.float64] | None)
    for link in merged.links:
        assert_type(link, idam.Link)
    assert_type(merged.components, list[list[int]])
    assert_type(merged.merged().points, NDArray[np.float64])
    assert_type(merged.complete, bool)

    # many pairs
    rows = idam.register_pairs([("a.ply", "b.ply")], jobs=2, max_angle=30.0)
    assert_type(rows, Iterator[dict[str, Any]])

    # models
    assert_type(idam.list_models(), list[str])
    model = idam.load_model("gnn-unseen-shapes", device="cpu")
    assert_type(idam.__version__, str)
    try:
        idam.register("a.las", "b.las")
    except idam.MissingDependencyError as missing:
        assert_type(missing, idam.MissingDependencyError)
    except idam.InputError as error:
        assert_type(error, idam.InputError)
