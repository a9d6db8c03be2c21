"""The paper's figures: what they show, in numbers, and that they are drawn to be read, and written."""

import json
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from idam.errors import InputError, MissingDependencyError
from idam.lab.data.modelnet40 import Shapes
from idam.lab.data.pairs import Pairs, make_pairs
from idam.lab.evaluation import experiments
from idam.lab.figures import draw, draw_figures
from idam.lab.figures.categories import category_names, one_of_each, spread, up_axis
from idam.lab.figures.curves import calibrate, iteration_errors, observe, right_matches
from idam.lab.figures.scenes import Kept, Matches, Overlay, first_matches, kept_points, lay, read_scans
from idam.lab.figures.timings import Timings, growth, read_timings
from idam.network.config import Config
from idam.network.geometry import apply_transform, nearest, rotation_angle, weighted_procrustes
from idam.network.model import IDAM, Output

matplotlib = pytest.importorskip("matplotlib", reason="figures need Matplotlib: pip install 'idam[figures]'")

from matplotlib.colors import to_hex  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.text import Text  # noqa: E402

from idam.lab.figures.plot_curves import draw_calibration, draw_iterations, draw_timings  # noqa: E402
from idam.lab.figures.plot_scenes import draw_key_points, draw_matches, draw_overlays  # noqa: E402
from idam.report.palette import GREEN, VERMILLION  # noqa: E402
from idam.report.panels import project  # noqa: E402
from idam.report.style import look, save  # noqa: E402


@pytest.fixture
def network(seasoned) -> IDAM:
    """Of random weights; what it answers is wrong, but all of its parts fit together."""
    return seasoned(IDAM(Config(iterations=4, keep=0.5, keep_matches=0.7)), torch.float32)


@pytest.fixture
def pairs(randn, generator) -> Pairs:
    return make_pairs(randn(3, 90, 3, dtype=torch.float32), generator)


@pytest.fixture
def output(network, pairs) -> Output:
    with torch.no_grad():
        return network(pairs.source, pairs.target)


# which shapes


def test_indices_are_spread_from_first_to_last():
    assert spread(40, 6) == [0, 8, 16, 23, 31, 39]
    assert spread(12, 4) == [0, 4, 7, 11]
    assert spread(3, 6) == [0, 1, 2]


def test_the_first_shape_of_each_category_is_shown():
    assert one_of_each(torch.tensor([7, 3, 3, 9, 7, 1, 5]), 3) == [5, 6, 3]


@pytest.mark.parametrize("up", [0, 1, 2])
def test_up_is_where_bottles_point(up, randn):
    points = randn(4, 50, 3)
    points[2:, :, up] *= 2
    points[:2, :, up] /= 9  # of other categories
    assert up_axis(Shapes(points, torch.tensor([0, 1, 5, 5]))) == up


def test_without_bottles_up_is_as_in_the_public_archive(randn):
    assert up_axis(Shapes(randn(2, 50, 3), torch.tensor([0, 1]))) == 1


def test_category_names_are_read_where_they_are(tmp_path):
    assert category_names(tmp_path) == {}
    (tmp_path / "shape_names.txt").write_text("airplane\nnight_stand\n")
    assert category_names(tmp_path) == {0: "airplane", 1: "night stand"}
    (tmp_path / "modelnet40_ply_hdf5_2048").mkdir()
    (tmp_path / "modelnet40_ply_hdf5_2048" / "shape_names.txt").write_text("cone\n")
    assert category_names(tmp_path) == {0: "cone"}


# scans


@pytest.fixture
def scans(tmp_path: Path, randn) -> list[Path]:
    """A large and a small cloud far from the origin, and thrice as long."""
    paths = [tmp_path / "left.npy", tmp_path / "right.npy"]
    np.save(paths[0], 300.0 + 0.3 * randn(2000, 3).numpy())
    np.save(paths[1], -200.0 + 0.1 * randn(300, 3).numpy())
    return paths


def test_scans_come_centred_at_one_scale_and_of_the_network_s_size(scans):
    [(name, source, target)] = read_scans(scans)
    assert name == "left\nto right"
    assert source.shape == (1024, 3)
    assert target.shape == (300, 3)
    assert source.dtype == target.dtype == torch.float32
    assert max(source.mean(0).abs().max(), target.mean(0).abs().max()) < 0.05
    assert source.norm(dim=-1).quantile(0.97) <= 1.0  # the farthest few may be strays
    assert source.std() / target.std() == pytest.approx(3.0, rel=0.1)


def test_scans_are_thinned_out_the_same_way_every_time(scans):
    [(_, source, target)], [(_, again, _)] = read_scans(scans), read_scans(scans)
    assert torch.equal(source, again)
    assert len(source.unique(dim=0)) == 1024
    assert len(target.unique(dim=0)) == 300


def test_scans_are_paired_as_they_are_named(scans):
    left, right = scans
    assert [name for name, _, _ in read_scans([left, right, right, left])] == ["left\nto right", "right\nto left"]


def test_a_scan_without_its_target_is_refused(scans):
    with pytest.raises(InputError, match="3 scans: they go in pairs"):
        read_scans([*scans, scans[0]])


def test_a_scan_that_cannot_be_registered_is_named(scans):
    np.save(scans[1], np.ones((100, 3)))
    with pytest.raises(InputError, match=r"right\.npy: all points are equal"):
        read_scans(scans)


# what the network did


def test_the_source_is_moved_by_the_network_s_transform(network, pairs, output):
    overlay = lay(network, ("a pair", pairs.source[0], pairs.target[0]), pairs.rotation[0].T)
    expected = pairs.source[0] @ output.rotation[0].T + output.translation[0]
    torch.testing.assert_close(overlay.moved, expected, rtol=0, atol=1e-4)
    assert torch.equal(overlay.source, pairs.source[0])
    assert torch.equal(overlay.target, pairs.target[0])
    assert torch.equal(overlay.upright, pairs.rotation[0].T)


def test_a_sixth_of_768_points_is_128_key_points(randn, generator):
    pair = make_pairs(randn(1, 1024, 3, dtype=torch.float32), generator)
    kept = kept_points(IDAM().eval(), "a shape", pair)
    assert torch.equal(kept.cloud, pair.source[0])
    assert len(kept.key_points.unique(dim=0)) == 128
    assert (kept.key_points[:, None] == kept.cloud).all(-1).any(-1).all()


def test_matches_are_those_of_the_first_iteration(network, pairs):
    pair = pairs[1:2]
    matches = first_matches(network, "a shape", pair)
    with torch.no_grad():
        output = network(pair.source, pair.target)
    step = output.iterations[0]
    assert torch.equal(matches.start, step.source[0])
    assert torch.equal(matches.weighted, step.weight[0] > 0)
    assert 0 < matches.weighted.sum() < len(matches.start)
    for end, j in zip(matches.end, step.correspondence[0], strict=True):
        moved = pair.rotation[0] @ end + pair.translation[0]
        torch.testing.assert_close(moved, output.target.points[0, j], rtol=0, atol=1e-5)


def test_the_target_of_matches_is_turned_back_onto_the_source(network, pairs):
    target = apply_transform(pairs.source, pairs.rotation, pairs.translation)
    matches = first_matches(network, "a shape", Pairs(pairs.source, target, pairs.rotation, pairs.translation)[:1])
    torch.testing.assert_close(matches.target, matches.source, rtol=0, atol=1e-5)


# curves


def test_errors_begin_without_any_iteration_and_end_at_the_whole_output(output, pairs):
    errors = iteration_errors(output, pairs.rotation)
    assert errors.shape == (3, 5)
    torch.testing.assert_close(errors[:, 0], rotation_angle(pairs.rotation.double()), rtol=0, atol=1e-3)
    whole = rotation_angle((output.rotation @ pairs.rotation.mT).double())
    torch.testing.assert_close(errors[:, -1], whole, rtol=0, atol=1e-3)


def test_errors_are_those_of_how_far_the_source_has_turned(output, pairs):
    errors = iteration_errors(output, pairs.rotation)
    for n in range(1, 4):  # each iteration finds the key points as all before it moved them
        points, moved = output.source.points.double(), output.iterations[n].source.double()
        turned, _ = weighted_procrustes(points, moved, torch.ones(points.shape[:2], dtype=torch.float64))
        angle = rotation_angle(turned @ pairs.rotation.double().mT)
        torch.testing.assert_close(errors[:, n], angle, rtol=0, atol=1e-3)


def half_right(output: Output, pairs: Pairs) -> Output:
    """Every other match made the best there is."""
    last = output.iterations[-1]
    _, best = nearest(apply_transform(output.source.points, pairs.rotation, pairs.translation), output.target.points)
    correspondence = torch.where(torch.arange(best.shape[1]) % 2 == 0, best, last.correspondence)
    return replace(output, iterations=[*output.iterations[:-1], replace(last, correspondence=correspondence)])


def test_matches_are_right_within_0_05_of_the_truth(output, pairs):
    output = half_right(output, pairs)
    right = right_matches(output, pairs.rotation, pairs.translation)
    assert 0.1 < right.double().mean() < 0.9
    for b in range(len(pairs)):
        for i, j in enumerate(output.iterations[-1].correspondence[b]):
            moved = pairs.rotation[b] @ output.source.points[b, i] + pairs.translation[b]
            assert bool(right[b, i]) == (float((moved - output.target.points[b, j]).norm()) <= 0.05)


def test_pairs_are_observed_one_by_one(network, pairs):
    observed = observe(network, pairs)
    assert observed.errors.shape == (3, 5)
    assert observed.validity.shape == observed.right.shape == (3, 45)
    with torch.no_grad():
        output = network(pairs.source[2:], pairs.target[2:])
    assert torch.equal(observed.errors[2:], iteration_errors(output, pairs.rotation[2:]))
    assert torch.equal(observed.validity[2:], output.iterations[-1].validity)
    assert torch.equal(observed.right[2:], right_matches(output, pairs.rotation[2:], pairs.translation[2:]))


def test_the_calibration_is_that_of_going_through_the_matches(rand):
    validity = rand(4, 60)
    right = rand(4, 60) < validity.square()
    calibration = calibrate(validity, right)
    off = 0.0
    for n in range(10):
        inside = [
            (v, r)
            for v, r in zip(validity.flatten().tolist(), right.flatten().tolist(), strict=True)
            if n / 10 <= v < (n + 1) / 10
        ]
        predicted, observed = np.mean(inside, axis=0)
        assert int(calibration.count[n]) == len(inside)
        assert float(calibration.predicted[n]) == pytest.approx(predicted)
        assert float(calibration.observed[n]) == pytest.approx(observed)
        off += len(inside) * abs(predicted - observed)
    assert calibration.error == pytest.approx(off / 240)
    assert calibration.error > 0.05


def test_a_network_that_is_right_as_often_as_it_says_has_no_calibration_error():
    calibration = calibrate(torch.tensor([0.75] * 4 + [1.0]), torch.tensor([True, True, False, True, True]))
    assert calibration.error == 0.0
    assert calibration.count.tolist() == [0, 0, 0, 0, 0, 0, 0, 4, 0, 1]
    assert calibration.predicted.isnan().tolist() == (calibration.count == 0).tolist()
    assert calibration.observed.isnan().tolist() == (calibration.count == 0).tolist()


# times

TIMES = {"4096": {"slow": 900, "quick": 30.5}, "1024": {"quick": 10, "slow": 500, "other": 2}}


@pytest.fixture
def write(tmp_path: Path) -> Callable[[object], Path]:
    def to_file(record: object) -> Path:
        path = tmp_path / "speed.json"
        path.write_text(record if isinstance(record, str) else json.dumps(record))
        return path

    return to_file


def test_times_are_read_by_method_from_the_slowest_on(write):
    timings = read_timings(write({"threads": 2, "median_ms": TIMES}))
    assert timings == Timings(2, {"slow": {1024: 500, 4096: 900}, "quick": {1024: 10, 4096: 30.5}, "other": {1024: 2}})
    assert list(timings.milliseconds) == ["slow", "quick", "other"]
    assert list(timings.milliseconds["slow"]) == [1024, 4096]


def test_quartiles_are_read_where_there_are_any(write):
    record = {"threads": 2, "median_ms": TIMES, "quartiles_ms": {"1024": {"quick": [9, 12.5]}}}
    assert read_timings(write(record)).quartiles == {"quick": {1024: (9, 12.5)}}


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.5])
def test_growth_is_the_exponent_of_a_power_law(exponent):
    assert growth({points: 3 * points**exponent for points in (512, 1024, 4096)}) == pytest.approx(exponent)
    assert growth({1024: 10.0}) is None


BAD_TIMES = {
    "no JSON": "1024 points: fast",
    "another record": {"rows": []},
    "a list": [1, 2],
    "no threads": {"median_ms": TIMES},
    "no sizes": {"threads": 2, "median_ms": {}},
    "sizes in words": {"threads": 2, "median_ms": {"many": {"quick": 1}}},
    "no methods": {"threads": 2, "median_ms": {"1024": {}}},
    "times in words": {"threads": 2, "median_ms": {"1024": {"quick": "very"}}},
    "no time at all": {"threads": 2, "median_ms": {"1024": {"quick": 0}}},
    "not a number": {"threads": 2, "median_ms": {"1024": {"quick": float("nan")}}},
    "a list of times": {"threads": 2, "median_ms": {"1024": [1, 2]}},
    "one quartile": {"threads": 2, "median_ms": TIMES, "quartiles_ms": {"1024": {"quick": [1]}}},
}


@pytest.mark.parametrize("record", BAD_TIMES.values(), ids=BAD_TIMES)
def test_a_file_that_holds_no_times_is_refused_in_one_line(record, write):
    with pytest.raises(InputError, match=r"speed\.json: .*benchmarks/speed\.py") as caught:
        read_timings(write(record))
    assert "\n" not in str(caught.value)


# drawing


@pytest.mark.parametrize("up", [0, 1, 2])
def test_a_projection_is_a_rotation_that_keeps_up_upward(up):
    axes = project(torch.eye(3), up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes[up, 0] == pytest.approx(0.0)
    assert axes[up, 1] > 0.9
    assert axes[up, 2] > 0.2  # from above


def lines(figure: Figure, colour: str) -> list[np.ndarray]:
    return [line.get_xydata() for line in figure.axes[0].lines if to_hex(line.get_color()) == colour.lower()]


def test_green_are_exactly_the_matches_with_weight(network, pairs):
    shape = first_matches(network, "a shape", pairs[:1])
    figure = draw_matches([shape], up=1)
    for colour, those in ((GREEN, shape.weighted), (VERMILLION, ~shape.weighted)):
        drawn = lines(figure, colour)
        assert len(drawn) == int(those.sum())
        start, end = (project(points[those], 1)[:, :2] for points in (shape.start, shape.end))
        np.testing.assert_allclose([line[0] for line in drawn], start)
        aside = np.array([line[1] for line in drawn]) - end
        np.testing.assert_allclose(aside, np.broadcast_to(aside[0], aside.shape), atol=1e-6)


@pytest.mark.parametrize(("height", "direction"), [(3.0, (1, 0)), (0.1, (0, -1))], ids=["high", "wide"])
def test_right_matches_run_parallel_beside_a_high_shape_and_below_a_wide_one(height, direction, randn):
    cloud = randn(30, 3) * torch.tensor([1.0, height, 1.0])
    shape = Matches("a shape", cloud, cloud, cloud[:8], cloud[:8], torch.arange(8) < 4)
    figure = draw_matches([shape], up=1)
    drawn = lines(figure, GREEN) + lines(figure, VERMILLION)
    along = np.array([line[1] - line[0] for line in drawn])
    np.testing.assert_allclose(along, np.linalg.norm(along[0]) * np.broadcast_to(direction, (8, 2)), atol=1e-12)
    bottom_left, top_right = (end(project(cloud, 1)[:, :2], axis=0) for end in (np.min, np.max))
    assert np.linalg.norm(along[0]) > np.abs((top_right - bottom_left) @ direction)  # the clouds do not overlap


def overlays(randn, count: int, name: str) -> list[Overlay]:
    return [Overlay(name, *randn(3, 40, 3), torch.eye(3, dtype=torch.float64)) for _ in range(count)]


def test_before_and_after_are_drawn_to_one_scale(randn):
    long = Overlay("a pair", 5 * randn(40, 3), randn(40, 3), randn(40, 3), torch.eye(3, dtype=torch.float64))
    figure = draw_overlays([long, *overlays(randn, 1, "another")], up=1)
    figure.draw_without_rendering()
    inches = np.array([np.abs(np.diag(axes.transData.get_matrix()[:2, :2])) for axes in figure.axes]).reshape(2, 2, 2)
    np.testing.assert_allclose(inches[0], inches[1])
    np.testing.assert_allclose(inches[..., 0], inches[..., 1])


def test_the_target_stands_upright_before_and_after(randn):
    cloud = randn(40, 3)
    turn = torch.linalg.qr(randn(3, 3)).Q
    turned = cloud @ turn.T
    one = draw_overlays([Overlay("a pair", turned, turned, turned, turn.T)], up=1)
    other = draw_overlays([Overlay("a pair", cloud, cloud, cloud, torch.eye(3, dtype=torch.float64))], up=1)
    for axes, expected in zip(one.axes, other.axes, strict=True):
        np.testing.assert_allclose(axes.collections[0].get_offsets(), expected.collections[0].get_offsets(), atol=1e-12)


def kept(randn) -> Kept:
    cloud = randn(40, 3)
    return Kept("range hood", cloud, cloud[:9])


def matches(randn) -> Matches:
    return Matches("range hood", *randn(2, 40, 3), *randn(2, 9, 3), torch.arange(9) < 5)


MANY_TIMES = {f"network gnn-gaussian-noise {n}": {1024: 10.0 + n, 4096: 90.0 + n} for n in range(22)}

FIGURES = {
    "one registration": lambda randn: draw_overlays(overlays(randn, 1, "left\nto right"), 1),
    "six registrations": lambda randn: draw_overlays(overlays(randn, 6, "night stand"), 1),
    "two rows of them": lambda randn: draw_overlays(overlays(randn, 8, "a rather long name\nto another one"), 1),
    "key points": lambda randn: draw_key_points([kept(randn) for _ in range(12)], 1),
    "matches": lambda randn: draw_matches([matches(randn) for _ in range(3)], 1),
    "iterations": lambda randn: draw_iterations(10 ** (1 - randn(50, 21).abs())),
    "a calibration": lambda randn: draw_calibration(calibrate(randn(500).sigmoid(), randn(500) > 0)),
    "many times": lambda _: draw_timings(Timings(2, MANY_TIMES)),
    "times and quartiles": lambda _: draw_timings(
        Timings(2, MANY_TIMES, {"network gnn-gaussian-noise 0": {1024: (9.0, 12.0)}})
    ),
    "a single time": lambda _: draw_timings(Timings(1, {"network": {1024: 10.0}})),
}


@pytest.mark.parametrize("drawn", FIGURES.values(), ids=FIGURES)
def test_text_is_of_8_points_or_more_and_nothing_is_cut_off(drawn, randn):
    with look():
        figure = drawn(randn)
        figure.draw_without_rendering()
        inches = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    assert 0 <= inches.x0 < inches.x1 <= width <= 4.8  # the paper's text
    assert 0 <= inches.y0 < inches.y1 <= height
    texts = [text for text in figure.findobj(Text) if text.get_text()]
    assert texts
    assert min(text.get_fontsize() for text in texts) >= 8


def test_the_look_is_ours_and_the_user_s_comes_back(monkeypatch):
    monkeypatch.setitem(matplotlib.rcParams, "font.size", 20.0)
    monkeypatch.setitem(matplotlib.rcParams, "axes.grid", True)
    with look():
        assert matplotlib.rcParams["font.size"] == 8.0
        assert not matplotlib.rcParams["axes.grid"]
    assert matplotlib.rcParams["font.size"] == 20.0
    assert matplotlib.rcParams["axes.grid"]


# writing


def test_the_same_figure_gives_the_same_bytes(tmp_path, randn):
    errors = 10 ** randn(5, 4)
    with look():
        one = [path.read_bytes() for path in save(draw_iterations(errors), tmp_path / "one")]
        other = [path.read_bytes() for path in save(draw_iterations(errors), tmp_path / "other")]
    assert one == other


def test_a_figure_that_cannot_be_written_says_so(tmp_path, randn):
    with pytest.raises(InputError, match=r"iterations\.png"):
        save(draw_iterations(10 ** randn(5, 4)), tmp_path / "missing" / "iterations")


@pytest.fixture
def shapes(monkeypatch: pytest.MonkeyPatch, randn) -> Shapes:
    """Boxes of three categories, of which a few are shown."""
    points = randn(4, 1024, 3, dtype=torch.float32) * torch.tensor([0.3, 0.5, 0.2])
    shapes = Shapes(points.clamp(-0.5, 0.5), torch.tensor([8, 2, 2, 5]))
    for module in (draw, experiments):
        monkeypatch.setattr(module, "experiment_shapes", lambda *_: shapes)
    for name, count in (("REGISTERED", 2), ("DESCRIBED", 3), ("MATCHED", 2), ("OBSERVED", 2)):
        monkeypatch.setattr(draw, name, count)
    return shapes


def test_all_figures_are_written(shapes, scans, write, tmp_path):
    output, told = tmp_path / "deep" / "figures", []
    written = draw_figures(
        output,
        tmp_path,
        scans=scans,
        speed=write({"threads": 2, "median_ms": TIMES}),
        model="gnn-gaussian-noise",
        progress=told.append,
    )
    assert told == ["registrations", "iterations", "validity", "keypoints", "correspondences", "scans", "speed"]
    assert written == [output / f"{name}.{kind}" for name in told for kind in ("png", "svg")]
    assert sorted(output.iterdir()) == sorted(written)
    for path in written:
        if path.suffix == ".png":
            assert path.read_bytes().startswith(b"\x89PNG")
        else:
            assert ET.parse(path).getroot().tag.endswith("svg")


def test_without_scans_and_times_there_are_no_figures_of_them(network):
    assert list(draw._from_files([], None, network, print)) == []


@pytest.mark.parametrize(
    ("options", "message"),
    {
        "an odd scan": ({"scans": [Path("one.ply")]}, "1 scans: they go in pairs"),
        "a missing scan": ({"scans": [Path("one.ply"), Path("two.ply")]}, r"one\.ply: no such file"),
        "missing times": ({"speed": Path("speed.json")}, r"speed\.json: no such file"),
        "an unknown model": ({"model": "best"}, "unknown model 'best'"),
        "missing data": ({}, "nowhere: no test_files.txt here"),
    }.values(),
)
def test_bad_input_is_refused_before_the_work(options, message, tmp_path):
    pytest.importorskip("h5py")
    with pytest.raises(InputError, match=message):
        draw_figures(tmp_path / "figures", Path("nowhere"), **options)
    assert not (tmp_path / "figures").exists()


def test_a_folder_that_cannot_be_made_is_refused(shapes, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="file: cannot make this folder"):
        draw_figures(tmp_path / "file", tmp_path)


def test_without_matplotlib_the_message_brings_the_command(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[figures\]'"):
        draw_figures(tmp_path / "figures", tmp_path)
