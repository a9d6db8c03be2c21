"""Which models answer: by name, by file, a descriptor alone or with a network of the paper."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import idam
from idam.errors import InputError, MissingDependencyError
from idam.models import resolve
from idam.weights import find
from motions import degrees, move, rigid
from solids import bracket

TRUTH = rigid([0.3, -0.4, 0.2], [1.0, 2.0, 3.0])
SOURCE = bracket(400, seed=1)
TARGET = move(TRUTH, bracket(450, seed=2))

has_torch = pytest.mark.skipif(
    not any((Path(folder) / "torch").is_dir() for folder in sys.path), reason="needs torch: pip install 'idam[torch]'"
)


@pytest.mark.parametrize(("model", "name"), [("default", "general"), ("general", "general")])
def test_a_result_names_the_weights_that_answered(model: str, name: str) -> None:
    assert idam.register(SOURCE, TARGET, model=model).model == name
    assert resolve(model).idam is None


def test_a_descriptor_by_its_file_answers_as_by_its_name(tmp_path: Path) -> None:
    copy = tmp_path / "mine.safetensors"
    copy.write_bytes(find("practice-any-rotation").read_bytes())
    by_name = idam.register(SOURCE, TARGET, model="practice-any-rotation")
    for model in (copy, str(copy)):
        by_file = idam.register(SOURCE, TARGET, model=model)
        np.testing.assert_array_equal(by_file.transformation, by_name.transformation)
        assert by_file.evidence == by_name.evidence
        assert by_file.model == "mine"


def test_a_file_that_changed_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    found = []
    for name in ("general", "practice-any-rotation"):
        path.write_bytes(find(name).read_bytes())
        os.utime(path, ns=(0, len(found) * 10**9))  # whatever the clock resolves
        found.append(idam.register(SOURCE, TARGET, model=path).evidence)
        assert found[-1] == idam.register(SOURCE, TARGET, model=name).evidence
    assert found[0] != found[1]


def test_clouds_prepared_for_one_descriptor_serve_another_too() -> None:
    source, target = idam.prepare(SOURCE), idam.prepare(TARGET, model="practice-any-rotation")
    for model in ("general", "practice-any-rotation"):
        one, other = (idam.register(*clouds, model=model) for clouds in ((source, target), (SOURCE, TARGET)))
        np.testing.assert_array_equal(one.transformation, other.transformation)
        assert one.evidence == other.evidence


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("nosuch", r"unknown model 'nosuch': use one of .*general.*gnn-unseen-shapes"),
        ("general+nosuch", "unknown model 'nosuch'"),
        ("nosuch+gnn-unseen-shapes", "unknown model 'nosuch'"),
        ("gnn-practice+gnn-unseen-shapes", "give DESCRIPTOR[+]NETWORK"),
        ("general+practice-any-rotation", "give DESCRIPTOR[+]NETWORK"),
        ("+gnn-practice", "unknown model ''"),
        ("general+", "unknown model ''"),
    ],
)
def test_models_that_there_are_not(model: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        resolve(model)
    assert "\n" not in str(error.value)


def test_a_network_without_torch_names_the_pip_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    for name in [name for name in sys.modules if name.startswith("idam.network")]:
        monkeypatch.delitem(sys.modules, name)
    for call in (lambda: idam.register(SOURCE, TARGET, model="gnn-practice"), lambda: resolve("general+gnn-practice")):
        with pytest.raises(MissingDependencyError, match=re.escape("pip install 'idam[torch]'")):
            call()


@has_torch
def test_a_network_is_named_with_the_descriptor_it_is_asked_with() -> None:
    result = idam.register(SOURCE, TARGET, model="gnn-unseen-shapes")
    assert result.model == "general+gnn-unseen-shapes"
    assert degrees(result.transformation, TRUTH) < 5
    both = idam.register(SOURCE, TARGET, model="practice-any-rotation+gnn-practice")
    assert both.model == "practice-any-rotation+gnn-practice"


@has_torch
def test_a_network_sees_the_caller_s_source_whichever_cloud_is_searched_as_the_source() -> None:
    script = """
import numpy as np
from idam import rigid
from idam.models import resolve
from idam.clouds.prepared import Prepared
from idam.clouds.pyramid import Pyramid
random = np.random.default_rng(0)
clouds = [Prepared.of(random.normal(size=(n, 3)) * [1, 0.6, 0.3], "cloud") for n in (150, 130)]
guess = rigid.exp(np.array([0.5, -0.2, 0.1, 0.0, 0.1, 0.0]))
models = resolve("gnn-unseen-shapes")
there = models.asked(Pyramid(*clouds).small)(guess)
back = models.reversed().asked(Pyramid(*clouds[::-1]).small)(rigid.inverse(guess))
np.testing.assert_allclose(rigid.inverse(back), there, atol=1e-6)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)


@has_torch
def test_unknown_devices_are_refused() -> None:
    for device in ("abacus", "cuda:99"):
        with pytest.raises(InputError, match=device):
            idam.register(SOURCE, TARGET, model="gnn-unseen-shapes", device=device)


def test_a_device_is_refused_where_nothing_runs_on_it() -> None:
    with pytest.raises(InputError, match="device 'cuda' has no effect: general runs on the CPU"):
        idam.register(SOURCE, TARGET, device="cuda")
