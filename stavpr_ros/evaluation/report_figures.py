"""The figures of the report as SVG and PNG text, drawn without matplotlib so that they can be touched."""

import base64
from collections.abc import Sequence

import cv2
import numpy as np

from stavpr_ros.evaluation.metrics import Curve

RIGHT, WRONG, UNKNOWN, SINGLE, SEQUENCE, TRUTH = (
    '#2e8b57', '#c8402f', '#d99a1c', '#8a94a6', '#2358a5', '#f0c419',
)  # fmt: skip
NEAR, FAR = (13, 20, 38), (240, 241, 236)  # RGB at both ends of the scale of distances; as in the script
POINTS = 400  # of a curve; more cannot be seen
LEFT, TOP, WIDE, HIGH = 46, 14, 374, 300  # the area of a figure within its 440 x 360


def data_url(content: bytes, kind: str) -> str:
    """Return a file's content as an address that needs no file."""
    return f'data:image/{kind};base64,{base64.b64encode(content).decode()}'


def matrix_png(values: np.ndarray) -> bytes:
    """
    Return a picture of distances, dark is near.

    :param values: shape (rows, columns), float; NaN where there is nothing.
    """
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, [0.002, 0.995]) if finite.size else (0.0, 1.0)
    share = np.clip((np.nan_to_num(values, nan=high) - low) / max(high - low, 1e-9), 0, 1)[..., None]
    picture = (1 - share) * np.array(NEAR) + share * np.array(FAR)
    picture[~np.isfinite(values)] = 255
    return bytes(cv2.imencode('.png', np.round(picture[:, :, ::-1]).astype(np.uint8))[1].tobytes())


def thinned(curve: Curve) -> Curve:
    """Return a curve with fewer points: its first, its last, and some between."""
    count = len(curve.thresholds)
    keep = np.unique(np.linspace(0, count - 1, min(count, POINTS)).round().astype(int))
    return Curve(curve.thresholds[keep], curve.precision[keep], curve.recall[keep])


def _axes(labels: tuple[str, str], ticks: Sequence[tuple[float, str]], grid: bool) -> str:
    """Draw frame, ticks along x (position 0..1, text) and, with a grid, 0 to 1 along y."""
    bottom, right = TOP + HIGH, LEFT + WIDE
    parts = [f'<path class="axis" d="M{LEFT} {TOP}V{bottom}H{right}"/>']
    for position, text in ticks:
        x = LEFT + position * WIDE
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{text}</text>')
        if grid:
            parts.append(f'<path class="grid" d="M{x:.1f} {TOP}V{bottom}"/>')
    if grid:
        for tick in np.linspace(0, 1, 6):
            y = bottom - tick * HIGH
            parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{right}"/>')
            parts.append(f'<text x="{LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{tick:.1f}</text>')
    parts.append(f'<text x="{LEFT + WIDE / 2}" y="{bottom + 36}" text-anchor="middle">{labels[0]}</text>')
    turn = f'transform="rotate(-90 13 {TOP + HIGH / 2})"'
    parts.append(f'<text x="13" y="{TOP + HIGH / 2}" text-anchor="middle" {turn}>{labels[1]}</text>')
    return ''.join(parts)


def precision_recall_svg(curves: Sequence[tuple[str, str, Curve, tuple[float, float]]]) -> str:
    """
    Draw precision over recall.

    :param curves: name, color, curve, and the point (recall, precision) of the best F1.
    """
    parts = [_axes(('recall', 'precision'), [(t, f'{t:.1f}') for t in np.linspace(0, 1, 6)], True)]
    for name, color, curve, (recall, precision) in curves:
        points = thinned(curve)
        line = ' '.join(
            f'{LEFT + r * WIDE:.1f},{TOP + (1 - p) * HIGH:.1f}'
            for r, p in zip(points.recall, points.precision, strict=True)
        )
        parts.append(
            f'<polyline class="curve" stroke="{color}" points="{line}"><title>{name}</title></polyline>'
        )
        x, y = LEFT + recall * WIDE, TOP + (1 - precision) * HIGH
        parts.append(f'<circle class="best" stroke="{color}" cx="{x:.1f}" cy="{y:.1f}" r="5"/>')
    parts.append('<circle id="pr-dot" r="4.5" visibility="hidden"/>')
    what = 'role="img" aria-label="precision over recall"'
    return f'<svg id="pr" viewBox="0 0 440 360" {what}>{"".join(parts)}</svg>'


def scores_svg(groups: Sequence[tuple[str, str, np.ndarray]], threshold: float) -> str:
    """
    Draw how the distances of right, wrong and unknown answers are spread.

    :param groups: name, color and distances of each group; those that are not finite are left out.
    :param threshold: drawn as a line.
    """
    shown = [(name, color, values[np.isfinite(values)]) for name, color, values in groups]
    everything = np.concatenate([values for _, _, values in shown] or [np.zeros(0)])
    if not everything.size:
        return '<p class="quiet">no answers</p>'
    low, high = float(everything.min()), float(everything.max())
    high = max(high, low + 1e-6)
    edges = np.linspace(low, high, 41)
    counts = [np.histogram(values, edges)[0] for _, _, values in shown]
    tallest = max(int(np.max(sum(counts))), 1)
    ticks = [(t, f'{low + t * (high - low):.3g}') for t in np.linspace(0, 1, 5)]
    parts = [_axes(('distance of the answer', 'answers'), ticks, False)]
    below = np.zeros(40)
    for (name, color, _), heights in zip(shown, counts, strict=True):
        for i in np.flatnonzero(heights):
            x, height = float(LEFT + i * WIDE / 40), heights[i] * HIGH / tallest
            y = TOP + HIGH - below[i] * HIGH / tallest - height
            parts.append(
                f'<rect fill="{color}" x="{x + 0.5:.1f}" y="{y:.1f}" width="{WIDE / 40 - 1:.1f}" '
                f'height="{height:.1f}"><title>{heights[i]} {name}</title></rect>'
            )
        below += heights
    share = (threshold - low) / (high - low)
    if 0 <= share <= 1.001:
        x = LEFT + min(share, 1) * WIDE
        parts.append(f'<path class="threshold" d="M{x:.1f} {TOP}V{TOP + HIGH}"/>')
        anchor, x = ('end', x - 5) if share > 0.6 else ('start', x + 5)
        parts.append(
            f'<text x="{x:.1f}" y="{TOP + 10}" text-anchor="{anchor}">threshold {threshold:.3g}</text>'
        )
    parts.append(f'<text x="{LEFT - 7}" y="{TOP + 4}" text-anchor="end">{tallest}</text>')
    return (
        f'<svg viewBox="0 0 440 360" role="img" aria-label="distances of the answers">{"".join(parts)}</svg>'
    )


def matrix_svg(
    picture: np.ndarray, shape: tuple[int, int], accepted: Sequence[np.ndarray], dots: dict[str, np.ndarray]
) -> str:
    """
    Draw the distances of all images to all places with the true and the answered places.

    :param picture: the reduced distances, as for :func:`matrix_png`.
    :param shape: images, places.
    :param accepted: the true places of each image, sorted, for some of the images an empty array.
    :param dots: image and place of answers, shape (count, 2), by color.
    """
    images, places = shape
    high = 1000 * min(0.7, max(0.35, images / places))
    x_scale, y_scale = 1000 / places, high / images
    band = ''.join(
        f'M{first * x_scale:.1f} {i * y_scale:.1f}h{(last - first + 1) * x_scale:.1f}'
        f'v{y_scale:.1f}h{-(last - first + 1) * x_scale:.1f}z'
        for i, found in enumerate(accepted)
        for first, last in runs(found)
    )
    radius = float(np.clip(0.5 * max(x_scale, y_scale), 2.2, 7))
    circles = ''.join(
        f'<g fill="{color}" stroke="#fff" stroke-width="{0.16 * radius if radius > 3 else 0:.2f}">'
        + ''.join(
            f'<circle cx="{(place + 0.5) * x_scale:.1f}" cy="{(i + 0.5) * y_scale:.1f}" r="{radius:.1f}"/>'
            for i, place in pairs.tolist()
        )
        + '</g>'
        for color, pairs in dots.items()
    )
    return (
        f'<svg id="matrix" viewBox="0 0 1000 {high:.0f}" data-images="{images}" data-places="{places}">'
        f'<image href="{data_url(matrix_png(picture), "png")}" width="1000" height="{high:.0f}" '
        f'preserveAspectRatio="none"/><path d="{band}" fill="{TRUTH}" fill-opacity="0.4"/>{circles}'
        '<path id="cursor" class="cursor" d=""/></svg>'
    )


def runs(places: np.ndarray) -> list[tuple[int, int]]:
    """List the stretches of consecutive places of a sorted array as (first, last)."""
    if not len(places):
        return []
    breaks = np.flatnonzero(np.diff(places) > 1)
    firsts, lasts = places[np.r_[0, breaks + 1]], places[np.r_[breaks, len(places) - 1]]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))
