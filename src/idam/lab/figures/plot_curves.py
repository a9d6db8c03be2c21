"""Drawing curves: error by iteration, calibration of the validity, time by size. Imports Matplotlib."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator, StrMethodFormatter
from torch import Tensor

from idam.lab.figures.curves import Calibration
from idam.lab.figures.timings import Timings, growth
from idam.report.palette import BLUE, GREY, ORANGE, PALETTE
from idam.report.style import COLUMN, PAGE

__all__ = ["draw_calibration", "draw_iterations", "draw_timings"]

MARKERS = "osD^vPX*"
"""One more than there are colours, so that lines of one colour differ in their markers."""


def draw_iterations(errors: Tensor) -> Figure:
    """Mean, median and quartiles of rotation errors (n, T + 1) in degrees, from before the first iteration on."""
    figure = Figure((COLUMN, 2.4), layout="constrained")
    axes = figure.subplots()
    iteration = range(errors.shape[1])
    low, median, high = (errors.quantile(share, 0).numpy() for share in (0.25, 0.5, 0.75))
    axes.fill_between(iteration, low, high, color=BLUE, alpha=0.2, linewidth=0, label="quartiles")
    axes.plot(iteration, errors.mean(0).numpy(), color=ORANGE, marker="s", markersize=3, label="mean")
    axes.plot(iteration, median, color=BLUE, marker="o", markersize=3, label="median")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axes.set_xlabel("iterations done")
    axes.set_ylabel("rotation error in degrees")
    axes.set_title(f"{len(errors)} test pairs with noise")
    axes.legend(loc="upper right")
    return figure


def draw_calibration(calibration: Calibration) -> Figure:
    """Share of right matches by predicted validity, and below it how many matches there are of each."""
    figure = Figure((COLUMN, 3.6), layout="constrained")
    curve, histogram = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    some = calibration.count > 0
    predicted, observed = calibration.predicted[some].numpy(), calibration.observed[some].numpy()
    curve.plot([0, 1], [0, 1], color=GREY, linestyle="--", label="perfectly calibrated")
    curve.plot(predicted, observed, color=BLUE, marker="o", markersize=4, label="last iteration")
    curve.set_ylabel("share of matches that are right")
    curve.set_title(f"expected calibration error {calibration.error:.3f}")
    curve.legend(loc="upper left")
    bins = len(calibration.count)
    share = (100 * calibration.count / calibration.count.sum()).tolist()
    histogram.bar([n / bins for n in range(bins)], share, width=1 / bins, align="edge", color=BLUE, edgecolor="white")
    histogram.set_xlabel("predicted validity v")
    histogram.set_ylabel("% of matches")
    histogram.set_xlim(-0.02, 1.02)
    return figure


def draw_timings(timings: Timings) -> Figure:
    """Milliseconds by points, with quartiles, and how fast they grow; the legend is in the order of the lines."""
    figure = Figure((PAGE, max(2.6, 0.2 + 0.18 * len(timings.milliseconds))), layout="constrained")
    axes = figure.subplots()
    for n, (method, times) in enumerate(timings.milliseconds.items()):
        colour, marker = PALETTE[n % len(PALETTE)], MARKERS[n % len(MARKERS)]
        style = ("-", "--", ":")[n // len(PALETTE) % 3]
        sizes, milliseconds = list(times), list(times.values())
        exponent = growth(times)
        label = method if exponent is None else f"{method}, n^{exponent:.1f}"
        axes.plot(sizes, milliseconds, style, color=colour, marker=marker, markersize=4, label=label)
        for points, spread in timings.quartiles.get(method, {}).items():
            axes.plot([points, points], spread, color=colour, linewidth=2.5, alpha=0.4, solid_capstyle="butt")
    axes.set_xscale("log")
    axes.set_yscale("log")
    every = sorted({points for times in timings.milliseconds.values() for points in times})
    axes.set_xticks(every, [str(points) for points in every])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_xlabel("points of each cloud")
    axes.set_ylabel("median time in ms")
    axes.set_title(f"{timings.threads} thread{'' if timings.threads == 1 else 's'}")
    figure.legend(loc="outside right upper", handlelength=2.8)
    return figure
