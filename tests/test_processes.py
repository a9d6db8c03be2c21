"""The package in other processes: what an import and a registration load, and where it runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import idam
from motions import move, rigid
from solids import bracket

HEAVY = {"torch", "scipy", "trimesh", "matplotlib", "h5py", "pandas", "laspy", "open3d"}
TRUTH = rigid([1.0, -1.5, 0.8], [1.0, 2.0, 3.0])
SOURCE = bracket(300, seed=1)
TARGET = move(TRUTH, bracket(350, seed=2))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clouds as files, and what registering them comes to."""
    folder = tmp_path_factory.mktemp("processes")
    np.save(folder / "source.npy", SOURCE)
    np.save(folder / "target.npy", TARGET)
    np.save(folder / "expected.npy", idam.register(SOURCE, TARGET).transformation)
    return folder


def run(code: str, folder: Path | None = None) -> str:
    """What a fresh interpreter prints; it must not hang."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


# --- what is loaded ------------------------------------------------------------------------------------------------


def loaded_by(code: str, folder: Path | None = None) -> set[str]:
    """All modules that a fresh interpreter has imported after running the code."""
    printed = run(code + "\nimport sys\nprint('loaded:', *sys.modules)", folder)
    return set(printed.rpartition("loaded:")[2].split())


def heavy(modules: set[str]) -> set[str]:
    return {name for name in modules if name in HEAVY or name.startswith(("idam.lab", "idam.network"))}


def test_import_is_light() -> None:
    modules = loaded_by("import idam; idam.InputError; dir(idam)")
    assert heavy(modules) == set()
    assert not {"numpy", "small_gicp"} & modules


def test_register_brings_no_torch_scipy_trimesh_nor_laboratory(folder: Path) -> None:
    code = "import idam\nresult = idam.register('source.npy', 'target.npy')\nrepr(result), result.correspondence_set"
    modules = loaded_by(code + "\nresult.save('T.json')", folder)
    assert {"idam.registration", "numpy", "small_gicp"} <= modules
    assert heavy(modules) == set()


def test_names_of_the_core_bring_nothing_heavy() -> None:
    names = "idam.register, idam.prepare, idam.Prepared, idam.RegistrationResult, idam.list_models()"
    assert heavy(loaded_by(f"import idam\n{names}")) == set()


@pytest.mark.parametrize("arguments", ["'--help'", "'register', '--help'"])
def test_help_is_light(arguments: str) -> None:
    code = f"import sys, idam.cli; sys.argv = ['idam', {arguments}]\ntry: idam.cli.main()\nexcept SystemExit: pass"
    modules = loaded_by(code)
    assert heavy(modules) == set()
    assert not {"numpy", "small_gicp"} & modules


# --- where it runs -------------------------------------------------------------------------------------------------

PRELUDE = """
import numpy as np
import idam

def registered(_=None):
    return idam.register("source.npy", "target.npy").transformation

def check(*found):
    expected = np.load("expected.npy")
    for each in found:
        np.testing.assert_array_equal(each, expected)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot fork")
def test_a_child_forked_after_a_registration_registers(folder: Path) -> None:
    code = """
import os, warnings
warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which a fork does not take along
check(registered())
children = []
for _ in range(2):
    child = os.fork()
    if child == 0:
        try:
            check(registered())
        except BaseException:
            os._exit(1)
        os._exit(0)
    children.append(child)
assert [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children] == [0, 0]
check(registered())
"""
    run(PRELUDE + code, folder)


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_a_pool_of_processes_after_a_registration(folder: Path, method: str) -> None:
    if method != "spawn" and sys.platform == "win32":
        pytest.skip("Windows can only spawn")
    (folder / "pool.py").write_text(
        PRELUDE
        + f"""
if __name__ == "__main__":
    import multiprocessing
    import warnings
    from concurrent.futures import ProcessPoolExecutor
    warnings.simplefilter("ignore", DeprecationWarning)
    check(registered())
    with ProcessPoolExecutor(2, multiprocessing.get_context({method!r})) as pool:
        check(*pool.map(registered, range(2), timeout=80))
"""
    )
    done = subprocess.run([sys.executable, "pool.py"], cwd=folder, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr


def test_threads_and_asyncio(folder: Path) -> None:
    code = """
import asyncio
from concurrent.futures import ThreadPoolExecutor
with ThreadPoolExecutor(4) as pool:
    check(*pool.map(registered, range(4)))
async def main():
    check(*await asyncio.gather(*(asyncio.to_thread(registered) for _ in range(2))))
    check(registered())
asyncio.run(main())
"""
    run(PRELUDE + code, folder)


def test_one_prepared_cloud_in_many_threads(folder: Path) -> None:
    code = """
from concurrent.futures import ThreadPoolExecutor
target = idam.prepare("target.npy")
with ThreadPoolExecutor(4) as pool:
    check(*pool.map(lambda _: idam.register("source.npy", target).transformation, range(4)))
"""
    run(PRELUDE + code, folder)


def test_prepared_clouds_go_to_other_processes(folder: Path) -> None:
    code = """
import pickle
clouds = [idam.prepare(f"{role}.npy") for role in ("source", "target")]
check(idam.register(*pickle.loads(pickle.dumps(clouds))).transformation)
"""
    run(PRELUDE + code, folder)
