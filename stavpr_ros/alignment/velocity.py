# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A window against every place of the map at several speeds (beyond the paper).

LM-DTW may let one place absorb a whole window. Here a path holds exactly one place for each query
image, so that no run of cheap pairs can dilute its mean, and keeps close to one of a few speeds
(places an image): a step of one place more or less than the speed's costs a penalty.

    S[i, y] = d[i, y] + min(S[i-1, y-r], S[i-1, y-r+1] + p, S[i-1, y-r-1] + p),   never back
    r = round(v i) - round(v (i-1)),   distance = min over the speeds v of S[l, y] / l

Start and end are free; linear in the number of places, l x V cells for each.
"""

from dataclasses import dataclass

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.alignment.settings import VelocitySettings
from stavpr_ros.checks import float_array, no_nan
from stavpr_ros.errors import InputError


@dataclass(frozen=True)
class VelocityMatches:
    """
    The best path to each of n places.

    :param distances: mean cost of an image, penalties included, shape (n,); +inf where there is no
        path.
    :param firsts: place of the window's first image, shape (n,), int32.
    :param middles: place of its middle image, (l - 1) // 2, shape (n,), int32.
    :param speeds: index into the settings' speeds, shape (n,), int32.
    """

    distances: np.ndarray
    firsts: np.ndarray
    middles: np.ndarray
    speeds: np.ndarray


def match_velocities(
    window: np.ndarray,
    settings: VelocitySettings,
    shift: np.ndarray | None = None,
    scale: np.ndarray | None = None,
) -> VelocityMatches:
    """
    Find the best path to every place.

    :param window: image distances, shape (l, n), float32 or float64; row = query image, oldest
        first. +inf bans a pair.
    :param shift, scale: the costs are (window - shift) * scale, shape (n,) each; None for 0 and 1.
    :raises InputError: wrong shape or type, NaN.
    """
    D = no_nan(float_array(window, 'image distances', 2), 'image distances')
    l, n = D.shape
    shift = np.zeros(n, D.dtype) if shift is None else np.asarray(shift, D.dtype)
    scale = np.ones(n, D.dtype) if scale is None else np.asarray(scale, D.dtype)
    if l < 1 or shift.shape != (n,) or scale.shape != (n,):
        raise InputError(
            f'window {D.shape}, shift {shift.shape}, scale {scale.shape}: expected (l, n), (n,), (n,), l >= 1'
        )
    return match_scaled(D, shift, scale, settings)


def match_scaled(
    window: np.ndarray, shift: np.ndarray, scale: np.ndarray, settings: VelocitySettings
) -> VelocityMatches:
    """
    Match a window that is known to be good; nothing is checked or copied (see
    :func:`match_velocities`).

    :param window: shape (l, n or more), C-contiguous.
    :param shift, scale: shape (n,), of the window's type.
    """
    from stavpr_ros.alignment.cpu.velocity import match_at_velocities

    n, dtype = len(shift), window.dtype
    matches = VelocityMatches(np.empty(n, dtype), *(np.zeros(n, np.int32) for _ in range(3)))
    match_at_velocities(
        window,
        shift,
        scale,
        settings.steps(len(window)),
        dtype.type(settings.penalty),
        matches.distances,
        matches.firsts,
        matches.middles,
        matches.speeds,
    )
    return matches


def trace_velocity(
    costs: np.ndarray, end: int, speed: int, settings: VelocitySettings
) -> np.ndarray:
    """
    Return the path to one end at one speed.

    :param costs: shape (l, n), float32 or float64.
    :param end: place of the last image, 0-based.
    :param speed: index into the settings' speeds.
    :returns: shape (l, 2), int32: query index, place.
    """
    from stavpr_ros.alignment.cpu.velocity import trace_at_velocity

    l = len(costs)
    steps = settings.steps(l)[speed]
    low = max(0, end - int(steps.sum()) - (l - 1))
    path = np.empty((l, 2), np.int32)
    reachable = np.ascontiguousarray(costs[:, low : end + 1])
    trace_at_velocity(reachable, steps, costs.dtype.type(settings.penalty), path)
    path[:, 1] += low
    return path


def best_velocity_match(matches: VelocityMatches, nms_radius: int) -> SequenceMatch | None:
    """
    Return the nearest path (the lowest end on a tie) and the second best; None if there is none.

    :param nms_radius: the second best's middle is more than so many places from the nearest one's.
    """
    from stavpr_ros.alignment.cpu.velocity import nearest_end_elsewhere

    if matches.distances.size == 0:
        return None
    end = int(np.argmin(matches.distances))
    if not np.isfinite(matches.distances[end]):
        return None
    middle = int(matches.middles[end])
    second = nearest_end_elsewhere(matches.distances, matches.middles, middle, nms_radius)
    return SequenceMatch(
        first=int(matches.firsts[end]),
        last=end,
        middle=middle,
        distance=float(matches.distances[end]),
        second_best_index=int(matches.middles[second]) if second >= 0 else -1,
        second_best_distance=float(matches.distances[second]) if second >= 0 else float('nan'),
    )
