"""The graph of links between scans as a drawing (SVG)."""

from __future__ import annotations

import html

import numpy as np

from idam.many.result import MergeResult
from idam.result import chance
from idam.rigid import Array

__all__ = ["draw_graph", "layout"]

WIDTH, HEIGHT, MARGIN = 640, 460, 26
LABELLED = 40
"""Scans up to which their names are written beside them."""


def draw_graph(result: MergeResult, colors: list[str]) -> str:
    """Scans as dots in their colours; used links the thicker the surer, rejected ones dashed."""
    count = len(result.names)
    used = [(link.source, link.target) for link in result.links if link.used]
    places = layout(count, used) * [WIDTH / 2 - 3 * MARGIN, HEIGHT / 2 - MARGIN] + [WIDTH / 2, HEIGHT / 2]
    lines = []
    for link in sorted(result.links, key=lambda link: (link.used, link.confidence)):
        (x1, y1), (x2, y2) = places[link.source], places[link.target]
        style = "used" if link.used else "rejected"
        title = f"{result.names[link.source]} to {result.names[link.target]}: confidence {chance(link.confidence)}"
        lines.append(
            f'<line class="{style}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" '
            f'style="--sure: {link.confidence:.3f}"><title>{html.escape(title)}</title></line>'
        )
    for scan, (x, y) in enumerate(places):
        name = html.escape(result.names[scan].encode("utf-8", "replace").decode("utf-8"))
        alone = " alone" if result.poses[scan] is None else ""
        lines.append(
            f'<circle class="scan{alone}" cx="{x:.1f}" cy="{y:.1f}" r="{7 if count <= LABELLED else 4}" '
            f'style="--swatch: {colors[scan]}"><title>{name}</title></circle>'
        )
        if count <= LABELLED:
            side = "end" if x < WIDTH / 2 else "start"
            lines.append(
                f'<text x="{x + (-11 if side == "end" else 11):.1f}" y="{y + 4:.1f}" text-anchor="{side}">{name}</text>'
            )
    body = "\n".join(lines)
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="Graph of links">{body}</svg>'


def layout(count: int, links: list[tuple[int, int]]) -> Array:
    """Places (N, 2) in [-1, 1] that keep linked scans near and all scans apart (Fruchterman and Reingold, 1991)."""
    angle = 2 * np.pi * np.arange(count) / max(count, 1)
    places = np.stack([np.cos(angle), np.sin(angle)], 1)
    ends = np.array(links, np.int64).reshape(-1, 2)
    ideal = 1.4 / np.sqrt(max(count, 1))
    for heat in np.linspace(0.15, 0.005, 150):
        apart = places[:, None] - places
        square = (apart**2).sum(-1) + 1e-9
        force = (apart * (ideal**2 / square)[..., None]).sum(1) - 0.3 * places
        along = places[ends[:, 0]] - places[ends[:, 1]]
        pull = along * np.linalg.norm(along, axis=1, keepdims=True) / ideal / 4
        np.add.at(force, ends[:, 0], -pull)
        np.add.at(force, ends[:, 1], pull)
        length = np.linalg.norm(force, axis=1, keepdims=True)
        places = places + force / np.maximum(length, 1e-9) * np.minimum(length, heat)
    places -= (places.max(0) + places.min(0)) / 2
    return np.asarray(places / max(float(np.abs(places).max()), 1e-9))
