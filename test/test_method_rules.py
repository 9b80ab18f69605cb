# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each rule and number of the method has a drive that is worse without it."""

from collections.abc import Callable
from dataclasses import replace
import sys
from typing import NamedTuple

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.alignment import SpatialSettings
from stavpr_ros.method import evidence, localizer, motion, path, window
from stavpr_ros.method.model import MODEL
from stavpr_ros.method.motion import ImageChange
from stavpr_ros.method.settings import RecognizerSettings, ROBUST
from stavpr_ros.method.window import FilterWindow
from stavpr_ros.prepare import centering

pytestmark = pytest.mark.usefixtures('one_thread')
PLACES, LENGTH = 200, 20
PLAIN = replace(ROBUST, whitening=False)
KNOWN, OTHER = route_strips(0, PLACES), route_strips(7, PLACES)  # the map's road, and another one
FINE, FINE_OTHER = route_strips(0, 150, 224), route_strips(7, 150, 224)  # with cells
FAST, STAGE, LATE = KNOWN[:, ::4], KNOWN[:, 40:140], np.hstack([OTHER, KNOWN[:, 60:100]])
IMAGES = np.arange(PLACES)[None, :, None]
LIGHT = np.random.default_rng(3).standard_normal((7, 1, KNOWN.shape[2]))  # shared by all images
ALIKE = np.where(abs(IMAGES - 99.5) < 30, (KNOWN[:, 80:81] + KNOWN) / 2, KNOWN)
SWAYING = np.random.default_rng(4).choice([1, 2, 3], 80, p=[0.1, 0.8, 0.1]).cumsum()
STOP_AND_GO = 20 + np.tile(np.repeat([0, 3], 8), 4).cumsum()


def put(module, **values):
    """Return a switch that gives constants of a module other values."""
    return lambda patch: [patch.setattr(module, name, values[name]) for name in values]


def model(**values):
    """Return a switch to another model of the filter."""
    defaults, other = FilterWindow.__init__.__kwdefaults__, replace(MODEL, **values)
    return lambda patch: patch.setitem(defaults, 'model', other)


def in_kernel(module, name, **values):
    """Return a switch that gives constants of a kernel other values."""

    def switch(patch):
        put(module, **values)(patch)
        user = window if hasattr(window, name) else module
        patch.setattr(user, name, getattr(module, name).py_func)

    return switch


def without_half(patch):
    """Let the probability of a camera at rest be of the whole window alone."""
    show, half = FilterWindow._assess, (LENGTH + 1) // 2

    def show_half(self, l, position=None):
        result = show(self, l, position)
        return result._replace(probability=1.0) if (l, position) == (half, None) else result

    patch.setattr(FilterWindow, '_assess', show_half)


def alike(share, first=0, end=PLACES):
    """Return images of the other road with a share of places of the map's."""
    return (share * KNOWN + (1 - share) * OTHER)[:, first:end]


def stretch(period, count, share=0.0):
    """Return images: so many of a period show the map's road, others a share of it."""
    return np.where(IMAGES % period < count, KNOWN, alike(share))[:, 40:120]


def crawling(strips, images):
    """Return so many images from place to place, each between the two."""
    at = np.arange((strips.shape[1] - 1) * images) / images
    place, part = at.astype(int), (at % 1)[:, None]
    return (1 - part) * strips[:, place] + part * strips[:, place + 1]


LOOK_ALIKE = np.hstack([OTHER[:, :100], alike(0.3, 60, 90)])
DENSE = crawling(KNOWN[:, 40:60], 10)


def recognizer(known=KNOWN, **settings):
    places = features_of(known) if isinstance(known, np.ndarray) else known
    settings = RecognizerSettings(**{'mode': PLAIN} | settings)
    return localizer.PlaceRecognizer(map_of(places), settings)


def drive(strips, noise, **arguments):
    return recognize_all(recognizer(**arguments), features_of(strips, noise, 1))


def share(strips, noise, first=0, **arguments):
    """Return the share of images with a match, from the first on."""
    return np.mean([match.accepted for match in drive(strips, noise, **arguments)[first:]])


def places_off(places, noise, whole_path):
    """Return by how many places matches are wrong, of all images of a path or of the middle."""
    images, errors = slice(None) if whole_path else LENGTH // 2 - 1, []
    for i, match in enumerate(drive(KNOWN[:, places], noise)):
        if match.accepted and len(match.path.pairs) == LENGTH:
            path_off = match.path.pairs[:, 1] - places[i + 1 - LENGTH : i + 1]
            errors.append(np.abs(path_off[images]).mean())
    return np.mean(errors)


def probable_place(query, known=KNOWN, every=1, first=10, reach=2, **settings):
    """Return the mean probability of the place of every such image, from 40 on."""
    one, result = recognizer(known, **settings), []
    for i in range(len(query)):
        one.update(query[i : i + 1])
        result.append(one.place_probabilities()[40 + i - reach : 41 + i + reach].sum())
    return np.mean(result[first::every])


def invert():
    """Return the place's probability where every tenth image is the inverse; strip by strip."""
    strips = KNOWN[:, 40:100].copy()
    strips[:, ::10] *= -1
    query = features_of(strips, 1.0, 1)
    return probable_place(query, every=10, spatial=SpatialSettings('none'))


def tunnel():
    """Return the place's probability behind an unlit stretch of road."""
    query, known = features_of(KNOWN[:, 40:135], 1.0, 1), features_of(KNOWN)
    query.strips[:, 50:80] = known.strips[:, 90:120] = 0
    return probable_place(query, known, first=60, reach=4)


def resting_beyond():
    """Return the share of images at rest with a match, a bit beyond where the roads part."""
    shares = []
    for seed in range(12):
        known, unknown = route_strips(seed, 160), route_strips(90 + seed, 8)
        beyond = np.hstack([known[:, 40:100], 0.15 * known[:, 100:108] + 0.85 * unknown])
        query = features_of(beyond, 0.2, seed)[np.r_[:67, np.full(60, 67)]]
        matches = recognize_all(recognizer(known), query)
        shares.append(np.mean([match.accepted for match in matches[-50:]]))
    return np.mean(shares)


def resting(noise, known=KNOWN):
    """Return the share of images at rest that are matched where they are, at place 70."""
    query = features_of(KNOWN[:, 30:71], noise, 1)[np.r_[:40, np.full(60, 40)]]
    matches = recognize_all(recognizer(known), query)[-40:]
    return np.mean([match.accepted and 68 <= match.place <= 73 for match in matches])


def newest_beyond(noise):
    """Return the share of images beyond the map that the window before is accepted for."""
    matches = drive(np.hstack([KNOWN[:, 40:100], OTHER[:, :30]]), noise)[60:]
    newest = [match.path_probabilities[-1] for match in matches if match.accepted]
    return np.count_nonzero(np.array(newest) > matches[0].limits.probability) / len(matches)


def vary():
    """Return the share of matches where three directions of all images vary most."""
    rng, directions = np.random.default_rng(1), np.random.default_rng(2).normal(size=(7, 3, 24))
    known, strips = KNOWN + 4 * rng.normal(size=(2, 7, PLACES, 3)) @ directions
    return share(strips[:, 40:140], 1.0, LENGTH, known=known, mode=ROBUST)


class Rule(NamedTuple):
    """A rule, and a drive whose number has a bound with it and one without: larger, smaller."""

    name: str
    off: Callable[[pytest.MonkeyPatch], None]
    drive: Callable[[], float]
    with_rule: float
    without: float


RULES = [
    Rule('start', model(start=0.0), lambda: share(KNOWN[:, 40:60], 4.0), 0.72, 0.68),
    Rule('enter', model(enter=0.0), lambda: share(np.hstack([OTHER, LATE]), 4, 400), 0.15, 0),
    Rule('leave', model(leave=1e-12), lambda: share(
        KNOWN[:, np.r_[20:60, 120:140]], 2.0, 41), 0.98, 0.96),
    Rule('change', model(change=0.0), lambda: share(
        KNOWN[:, np.r_[20:40, 40:80:3, 80:100, 100:140:3]], 9.0, LENGTH), 0.8, 0.7),
    Rule('spread', model(spread=0.0), lambda: places_off(SWAYING, 5.0, True), 0.1, 0.25),
    Rule('most', model(most=1e9), invert, 0.2, 0.05),
    Rule('high speeds', model(speeds=MODEL.speeds[:-2]), lambda: share(FAST, 3), 0.5, 0.1),
    Rule('low speeds', model(speeds=MODEL.speeds[3:]), lambda: share(
        crawling(alike(0.3, 60, 85), 2), 0.05), 0.8, 0.1),
    Rule('weight', model(weight=0.05), lambda: share(STAGE, 6.0), 0.88, 0.82),
    Rule('weight, at most', model(weight=1.0),
         lambda: share(alike(0.1, 60, 160), 0.2), 0, 0.05),
    Rule('level', model(level=-5.0), lambda: share(STAGE, 8.0), 0.5, 0.3),
    Rule('alpha by change', put(ImageChange, weight=lambda *_: 1.0), lambda: share(
        crawling(np.where(abs(IMAGES - 105) < 4, alike(0.8), OTHER)[:, 90:120], 5), 0), 0, 0.25),
    Rule('MAX_CHANGE', put(motion, MAX_CHANGE=1e9), lambda: share(
        KNOWN[:, :60], 3.0, known=crawling(KNOWN[:, :60], 4)), 0.7, 0.5),
    Rule('MIN_CHANGE', put(motion, MIN_CHANGE=0.0), lambda: share(
        np.hstack([KNOWN[:, 20:80], crawling(KNOWN[:, 120:132], 3)]), 0.0, 60), 0.7, 0.6),
    Rule('STANDSTILL', put(motion, STANDSTILL=0.0), lambda: resting(6.0), 1, 0.8),
    Rule('dark stretch', put(motion, DARK_PROBABILITY=2.0), tunnel, 0.55, 0.45),
    Rule('LOOK_AHEAD', put(motion, LOOK_AHEAD=1), tunnel, 0.55, 0.45),
    Rule('STRETCH', put(motion, STRETCH=1), lambda: resting(
        3.0, KNOWN[:, np.r_[:76, 75:PLACES]]), 1, 0),
    Rule('distinct', put(ImageChange, distinct=lambda change, at: change._from_before[at] > -1),
         lambda: share(STAGE, 8.5, known=KNOWN[:, np.r_[:70, np.full(1500, 70), 70:PLACES]]),
         0.3, 0.15),
    Rule('line', in_kernel(path, 'centered_place', LINE=0), lambda: places_off(
        np.rint(np.arange(20, 140, 1.5)).astype(int), 3.0, False), 0.1, 0.25),
    Rule('ON_LINE', in_kernel(path, 'centered_place', ON_LINE=1e9),
         lambda: places_off(STOP_AND_GO, 3.0, False), 0.15, 1.5),
    Rule('MAX_STEP', in_kernel(path, 'follow', MAX_STEP=1), lambda: share(FAST, 3), 0.5, 0.1),
    Rule('half at rest', without_half, resting_beyond, 0.1, 0.5),
    Rule('share of the image', put(window, close_sums=lambda *x: np.ones(len(x[-1]))),
         lambda: newest_beyond(6.0), 0.2, 0.33),
    Rule('ON_MAP', put(window, ON_MAP=0.0),
         lambda: share(KNOWN[:, np.r_[:60, 100:115]], 2.0, 60), 0.85, 0.6),
    Rule('EARLY', put(localizer, EARLY=0.5), lambda: share(alike(0.3, 60, 75), 0.2), 0.65, 0.85),
    Rule('CERTAIN', put(evidence, CERTAIN=9.0), lambda: share(LOOK_ALIKE, 0.2), 0, 0.005),
    Rule('BELIEF', put(evidence, BELIEF=0.0), lambda: share(KNOWN[:, 40:60], 5.0), 0.45, 0.1),
    Rule('UNEVEN_WEIGHT', put(evidence, UNEVEN_WEIGHT=0),
         lambda: share(stretch(6, 4), 1), 0, 0.8),
    Rule('EVEN', in_kernel(evidence, 'unevenness', EVEN=0.0),
         lambda: share(STAGE, 9.0), 0.18, 0.1),
    Rule('EVEN_SHARE', in_kernel(evidence, 'unevenness', EVEN_SHARE=0.0),
         lambda: share(stretch(9, 6, 0.2), 0.5), 0.8, 0.05),
    Rule('EXCESS', put(evidence, EXCESS=-0.5), lambda: share(STAGE, 3.0), 0.93, 0.1),
    Rule('OFFSET', in_kernel(motion, '_excess', OFFSET=1e-9), lambda: share(
        DENSE[:, 20:120], 0.1, known=DENSE), 0.38, 0.2),
    Rule('EXCESS_WEIGHT', put(evidence, EXCESS_WEIGHT=0.0), lambda: share(
        0.3 * np.repeat(KNOWN[:, 60:66], 10, axis=1) + 0.7 * OTHER[:, :60], 0.2), 0.25, 0.75),
    Rule('LEAD', put(evidence, LEAD=0.0), lambda: share(STAGE, 3.0), 0.9, 0),
    Rule('APART', put(window, APART=0), lambda: share(STAGE, 3.0), 0.9, 0),
    Rule('STRAIGHT', put(window, STRAIGHT=(1.0,)), lambda: share(KNOWN[:, ::3], 5.0), 0.8, 0.5),
    Rule('STRAIGHT, at most', put(window, STRAIGHT=window.STRAIGHT[:-1]),
         lambda: share(KNOWN[:, ::5], 3.0), 0.8, 0.1),
    Rule('CELLS', put(evidence, CELLS=0.0), lambda: share(
        FINE[:, 20:120], 11.0, LENGTH, known=FINE), 0.6, 0.1),
    Rule('CREEP', put(evidence, CREEP=0.0), lambda: share(np.hstack([ALIKE[:, 20:75], (
        0.7 * KNOWN[:, 80:81] + 0.3 * OTHER[:, :60])]), 1.0, 65, known=ALIKE), 0.05, 0.15),
    Rule('RECENT', put(evidence, RECENT=0.0), lambda: share(LOOK_ALIKE, 0.2), 0.05, 0.15),
    Rule('LAST', put(evidence, LAST=1000), lambda: share(
        np.hstack([OTHER, KNOWN[:, 20:140]]), 3.0, PLACES), 0.7, 0.3),
    Rule('running mean', put(centering, PRIOR=1e9),
         lambda: share(STAGE + 10 * LIGHT, 3.0, LENGTH), 0.95, 0.5),
    Rule('centered means', put(sys.modules[__name__], PLAIN=replace(PLAIN, mean_centering=False)),
         lambda: share(STAGE - 3 * LIGHT, 3.0, LENGTH, known=KNOWN + 3 * LIGHT), 0.95, 0),
    Rule('whitening', put(centering, STRENGTH=0.0), vary, 0.5, 0.1),
]  # fmt: skip


@pytest.mark.parametrize('rule', RULES, ids=[rule.name for rule in RULES])
def test_each_rule_has_a_drive_that_is_worse_without_it(rule, monkeypatch):
    sign = 1 if rule.with_rule > rule.without else -1
    if rule.name != 'CREEP':  # white noise, which shows what the other rules do, is creep as well
        put(evidence, CREEP=0.0)(monkeypatch)
    assert sign * rule.drive() >= sign * rule.with_rule
    rule.off(monkeypatch)
    assert sign * rule.drive() <= sign * rule.without
