"""All figures into one folder: what each shows, in what order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from idam.io import make_folder
from idam.lab.data.modelnet40 import Shapes, experiment_shapes
from idam.lab.data.pairs import experiment_noise, fixed_pairs
from idam.lab.evaluation.experiments import TEST_SEED
from idam.lab.figures.categories import category_names, one_of_each, spread, up_axis
from idam.lab.figures.curves import calibrate, observe
from idam.lab.figures.scenes import Scan, first_matches, kept_points, lay, read_scans
from idam.lab.figures.timings import Timings, read_timings
from idam.network.model import IDAM
from idam.network.pretrained import load_model
from idam.report.view import check_matplotlib

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_figures"]

EXACT = "gnn-unseen-shapes"
"""The model of the figures without noise: key points and correspondences."""
PAPERS_KEEP = 1 / 6
REGISTERED, DESCRIBED, MATCHED = 6, 12, 4
"""Shapes shown: registered, with their key points, and, of these, with their correspondences."""
OBSERVED = 50
"""Pairs behind the curves."""
SCANS_UP = 1
"""The axis that points up in scans, as in Stanford's."""

Tell = Callable[[str], None]
Drawn = Iterator[tuple[str, "Figure"]]


def draw_figures(
    output: Path,
    data: Path,
    *,
    scans: Sequence[Path] = (),
    speed: Path | None = None,
    model: str = "gnn-gaussian-noise",
    progress: Tell | None = None,
) -> list[Path]:
    """Draw the figures, each as PNG and as SVG: always the same ones for the same input.

    ``registrations``, ``iterations``, ``validity``, ``keypoints`` and ``correspondences``; ``scans`` where scans are
    named, and ``speed`` where times are.

    Args:
        output: folder to write to, made if missing.
        data: folder of ModelNet40.
        scans: files of clouds to register without fine-tuning: source, target, source, target and so on.
        speed: JSON file that ``benchmarks/speed.py --json`` wrote.
        model: name or file of the weights for all that is noisy: registrations, scans, iterations, validity.
        progress: called with the name of each figure, before the work for it.

    Returns:
        The files written.

    Raises:
        InputError: there is no such model, the data or a file cannot be read, or the folder cannot be written.
        MissingDependencyError: Matplotlib or h5py is not installed.
    """
    check_matplotlib("figures")
    from idam.report.style import look, save

    # whatever is wrong with the input shows before the work
    clouds = read_scans(scans)
    timings = None if speed is None else read_timings(speed)
    network = load_model(model)
    shapes = experiment_shapes("unseen-shapes", data, "test")  # those of the experiment with noise, too
    make_folder(output)
    tell = progress or (lambda _: None)
    written: list[Path] = []
    with look():
        figures = chain(
            _with_noise(data, shapes, network, load_model(model), tell),
            _without_noise(data, shapes, load_model(EXACT), tell),
            _from_files(clouds, timings, network, tell),
        )
        for name, figure in figures:
            written += save(figure, output / name)
    return written


def _with_noise(data: Path, shapes: Shapes, network: IDAM, observed: IDAM, tell: Tell) -> Drawn:
    from idam.lab.figures.plot_curves import draw_calibration, draw_iterations
    from idam.lab.figures.plot_scenes import draw_overlays

    tell("registrations")
    pairs = fixed_pairs(shapes.points, TEST_SEED, experiment_noise("gaussian-noise"))
    chosen, up = _choose(shapes, REGISTERED, data), up_axis(shapes)
    overlays = [lay(network, (name, pairs.source[n], pairs.target[n]), pairs.rotation[n].T) for n, name in chosen]
    yield "registrations", draw_overlays(overlays, up)
    tell("iterations")
    # with a second try, the iterations would not be those that the transform came from
    observed.config = replace(observed.config, keep_again=())
    seen = observe(observed, pairs[:OBSERVED])
    yield "iterations", draw_iterations(seen.errors)
    tell("validity")
    yield "validity", draw_calibration(calibrate(seen.validity, seen.right))


def _without_noise(data: Path, shapes: Shapes, network: IDAM, tell: Tell) -> Drawn:
    from idam.lab.figures.plot_scenes import draw_key_points, draw_matches

    tell("keypoints")
    network.config = replace(network.config, keep=PAPERS_KEEP, keep_again=())
    pairs = fixed_pairs(shapes.points, TEST_SEED)
    chosen, up = _choose(shapes, DESCRIBED, data), up_axis(shapes)
    yield "keypoints", draw_key_points([kept_points(network, name, pairs[n : n + 1]) for n, name in chosen], up)
    tell("correspondences")
    chosen = [chosen[n] for n in spread(len(chosen), MATCHED)]
    yield "correspondences", draw_matches([first_matches(network, name, pairs[n : n + 1]) for n, name in chosen], up)


def _from_files(scans: Sequence[Scan], timings: Timings | None, network: IDAM, tell: Tell) -> Drawn:
    from idam.lab.figures.plot_curves import draw_timings
    from idam.lab.figures.plot_scenes import draw_overlays

    if scans:
        tell("scans")
        yield "scans", draw_overlays([lay(network, scan) for scan in scans], SCANS_UP)
    if timings is not None:
        tell("speed")
        yield "speed", draw_timings(timings)


def _choose(shapes: Shapes, count: int, data: Path) -> list[tuple[int, str]]:
    """Index and name of shapes of so many categories."""
    names = category_names(data)
    labels = shapes.labels.tolist()
    return [(n, names.get(labels[n], f"category {labels[n]}")) for n in one_of_each(shapes.labels, count)]
