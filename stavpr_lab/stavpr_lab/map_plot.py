# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``map info --plot``: thumbnails, the route with its poses, and the map compared with itself."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
import numpy as np
from stavpr_lab.style import page, show_distances
from stavpr_ros.mapping import Map, select_places
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.palette import PAPER, QUIET, VERMILION
from stavpr_ros.prepare.centering import evenly

COMPARED = 500  # places of the matrix, at most
THUMBNAILS = 8  # thumbnails


def plot_map(place_map: Map, path: Path) -> None:
    """Draw an opened map to a PNG file; of a long map, evenly spaced places."""
    with page(path, 13, 7.4) as figure:
        halves: Any = figure.subfigures(1, 2, width_ratios=(1, 1.2))
        left, right = halves
        if place_map.has_poses:
            top, bottom = left.subfigures(2, 1, height_ratios=(1, 1.3))
            _draw_thumbnails(top, place_map, 4)
            _draw_route(bottom.subplots(), place_map)
        else:
            _draw_thumbnails(left, place_map, 2)
        if len(place_map.sessions) > 1:
            upper, right = right.subfigures(2, 1, height_ratios=(1, 2.4))
            _draw_sessions(upper.subplots(), place_map)
        _draw_matrix(right, right.subplots(), place_map)


def _runs(place_map: Map) -> list[tuple[str, np.ndarray]]:
    """Return name and places of each session."""
    index = place_map.session_index
    if index is None:
        return [('', np.arange(len(place_map)))]
    return [
        (session.id, np.flatnonzero(index == number))
        for number, session in enumerate(place_map.sessions)
    ]


def _draw_route(axes: Axes, place_map: Map) -> None:
    axes.set_title('route from above')
    assert place_map.poses is not None
    for name, places in _runs(place_map):
        x, y = place_map.poses[places, :2].T
        (line,) = axes.plot(x, y, '.-', ms=3, lw=1, label=name)
        with_pose = np.flatnonzero(np.isfinite(x))
        if not len(with_pose):
            continue
        axes.plot(x[with_pose[0]], y[with_pose[0]], 'o', ms=7, mfc=PAPER, color=line.get_color())
        for place in with_pose[evenly(len(with_pose), 6)[1:]].tolist():
            at = (float(x[place]), float(y[place]))
            axes.annotate(str(places[place]), at, color=QUIET)
    axes.set_aspect('equal', adjustable='datalim')
    axes.set(xlabel='x (m); circle: first place, numbers: places', ylabel='y (m)')
    if place_map.sessions:
        axes.legend(loc='best')


def _draw_sessions(axes: Axes, place_map: Map) -> None:
    """Draw which places of earlier sessions each session shows, and its own ones."""
    axes.set_title('places by session; gray: of an earlier session')
    runs = _runs(place_map)
    for row, (_, places) in enumerate(runs):
        originals = places if place_map.same_as is None else place_map.same_as[places]
        axes.plot(places, np.full(len(places), row), '|', ms=9, color=f'C{row}')
        earlier = originals[originals != places]
        axes.plot(earlier, np.full(len(earlier), row), '|', ms=9, color=QUIET)
    names = [f'{name}, {len(places)} places' for name, places in runs]
    axes.set_yticks(range(len(runs)), names)
    axes.set_xlabel('place (number)')
    axes.invert_yaxis()


def _draw_thumbnails(figure: SubFigure, place_map: Map, columns: int) -> None:
    places = evenly(len(place_map), THUMBNAILS).tolist()
    grid = figure.subplots(THUMBNAILS // columns, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, place in zip(grid.flat, places, strict=False):
        image = place_map.thumbnail(place)
        axes.set_title(f'place {place}', color=QUIET)
        if image is None:
            axes.text(0.5, 0.5, 'no thumbnail', ha='center', va='center', color=QUIET)
        else:
            axes.imshow(image, interpolation='lanczos')


def _draw_matrix(figure: Figure | SubFigure, axes: Axes, place_map: Map) -> None:
    """Draw the distances of places to each other, as mode robust compares images."""
    n, places = len(place_map), evenly(len(place_map), COMPARED)
    part = select_places(place_map, places)
    recognizer = PlaceRecognizer(part, RecognizerSettings())
    distances = recognizer.distances(part.features)
    apart = ~np.eye(len(part), dtype=bool)  # a place itself is 0, which is left out of the scale
    distances = np.where(apart, distances, distances.min(where=apart, initial=np.inf))
    show_distances(figure, axes, distances, extent=(-0.5, n - 0.5, n - 0.5, -0.5))
    for _, session in _runs(place_map)[1:]:
        if len(session):
            axes.axhline(session[0] - 0.5, color=VERMILION, lw=1)
            axes.axvline(session[0] - 0.5, color=VERMILION, lw=1)
    borders = '; lines: borders of sessions' if len(place_map.sessions) > 1 else ''
    axes.set_title(f'distance of places to each other{borders}')
    axes.set(xlabel='place (number)', ylabel='place (number)')
