"""Inputs on which free-running fuzz (``make fuzz``) once failed, each as small as it got."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from idam.errors import InputError
from idam.io import read_point_cloud

FOUND = sorted((Path(__file__).parent / "found").iterdir())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_inputs_that_once_failed(path: Path) -> None:
    try:
        points = read_point_cloud(path).points
    except InputError as error:
        assert f"{error}".isprintable()
        assert not isinstance(error.__cause__, NameError | AttributeError | AssertionError)
    else:
        assert len(points) and np.isfinite(points).all()
