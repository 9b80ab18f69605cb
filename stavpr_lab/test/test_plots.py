# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plots: written, of a sensible size, with the colors of their contents, also for empty input."""

from dataclasses import replace
import json
from pathlib import Path
import re

import cv2
from evaluation_commands import write_images
import numpy as np
from PIL import Image
import pytest
from stavpr_lab.demonstration.animation import write_animation
from stavpr_lab.demonstration.plots import demo_sheet
from stavpr_lab.evaluation.metrics import ImageMatches
from stavpr_lab.evaluation.plots import drive, MatchPair, reduced_matrix
from stavpr_lab.evaluation.records import TraverseEvaluation
from stavpr_ros import palette
from stavpr_ros.mapping import save_map
from stavpr_ros.pipeline.overlay import match_image, NO_MATCH, RIGHT

QUERIES, PLACES, THRESHOLD = 40, 30, 0.5
COLORS = 'BLUE', 'VERMILION', 'SKY', 'ORANGE', 'GRAY', 'YELLOW'
BLUE, RED, SKY, AMBER, GRAY, YELLOW = (palette.rgb(getattr(palette, name)) for name in COLORS)


@pytest.fixture(scope='module')
def results():
    """Return matches along the diagonal, a stretch that is not in the map, one wrong match."""
    truth = np.minimum(np.arange(QUERIES) * 3 // 4, PLACES - 1)
    truth[20:26] = -1
    distances = 0.6 + 0.3 * np.random.default_rng(0).random((QUERIES, PLACES))
    known = np.flatnonzero(truth >= 0)
    distances[known, truth[known]] = 0.2
    matched = truth.copy()
    matched[5], matched[30] = 25, -1
    best = distances.min(axis=1)
    best[0] = np.inf
    matches = ImageMatches(matched, best, matched >= 0, np.full(QUERIES, np.nan))
    result = TraverseEvaluation(matches, matched >= 0, truth, 2, None, np.zeros(0))
    return distances, result


@pytest.fixture
def path(tmp_path):
    return tmp_path / 'plot.png'


def image(shade, shape=(48, 64)):
    return np.full((*shape, 3), shade, np.uint8)


def pairs():
    return [
        MatchPair(image(90), image(120), 'image 1', 'right'),
        MatchPair(image(90), image(200, (30, 50)), 'image 2', 'wrong'),
        MatchPair(image(90), None, 'image 3', 'no match'),
        MatchPair(image(90), None, 'image 4', 'unseen'),
    ]


def colors_of(path, *colors, least=(200, 400), spread=5.0):
    """Check that a plot is of a sensible size and not blank; return which colors it has."""
    plot = cv2.imread(str(path))
    assert plot.shape[0] >= least[0]
    assert plot.shape[1] >= least[1]
    assert max(plot.shape) < 4000
    assert plot.std() > spread
    distances = [np.abs(plot[:, :, ::-1].astype(int) - color).max(axis=2) for color in colors]
    return [bool((distance < 12).sum() > 20) for distance in distances]


def test_reduced_matrix_returns_where_its_axes_are(path):
    values = np.random.default_rng(0).random((20, 30)).astype(np.float32) / 9 + 0.5
    truth = np.eye(20, 30, dtype=bool)
    matches = {'right': np.array([[100, 200]]), 'wrong': np.array([[300, 50]])}
    left, top, width, height = reduced_matrix(path, values, (400, 600), truth, matches)
    assert all(colors_of(path, BLUE, RED, YELLOW))
    plot = cv2.imread(str(path))[:, :, ::-1].astype(int)

    def around(query, place):
        row = round(plot.shape[0] * (top + height * (query + 0.5) / 400))
        column = round(plot.shape[1] * (left + width * (place + 0.5) / 600))
        return plot[row - 2 : row + 3, column - 2 : column + 3]

    assert np.abs(around(100, 200) - BLUE).max(axis=2).min() < 12
    assert np.abs(around(300, 50) - RED).max(axis=2).min() < 12


def test_demo_sheet_shows_matches_and_ground_truth_as_far_as_known(path, results):
    distances, result = results
    demo_sheet(path, pairs(), distances, result, THRESHOLD, 'Title')
    assert all(colors_of(path, BLUE, RED, AMBER, GRAY, YELLOW, least=(1000, 1500)))
    demo_sheet(path, [], distances, replace(result, true_places=None), THRESHOLD, 'Title')
    assert colors_of(path, SKY, BLUE, RED, YELLOW) == [True, False, False, False]


def test_drive_shows_outcomes_true_places_and_unseen_images(path):
    queries = np.arange(40)
    outcomes = np.repeat(['right', 'wrong', 'no match', 'unseen'], 10)
    truth = np.stack([queries, queries], axis=1)[:30]
    drive(path, truth, 50, np.where(outcomes == 'wrong', 45, queries), outcomes, queries >= 30)
    assert all(colors_of(path, BLUE, RED, AMBER, GRAY, YELLOW, palette.rgb(palette.SHADE)))
    drive(path, truth[:0], 50, queries, outcomes, queries < 0)
    assert colors_of(path, YELLOW) == [False]


@pytest.mark.parametrize(('accepted', 'color'), [(True, RIGHT), (False, NO_MATCH)])
def test_match_image_puts_query_and_place_side_by_side(accepted, color):
    query = image(50)
    sheet = match_image(query, image(180, (100, 200)), 'match: place 3', accepted)
    assert sheet.dtype == np.uint8
    assert np.all(sheet[24:48, :64] == 50)  # below the label
    assert np.all(sheet[24:48, -64:] == 180)
    assert tuple(sheet[-1, 0]) == color
    assert sheet[48:].std() > 5  # the text
    assert np.all(query == 50)


def test_animation_has_every_fifth_image_beside_its_place(tmp_path, small_map, route):
    save_map(small_map, tmp_path / 'map.stavpr')
    write_images(tmp_path / 'second_traverse', route[:12])
    missed = {'status': 'NO_MATCH', 'newest_index': -1, 'probability': 0.25}
    result = {'status': 'MATCH', 'newest_index': 10, 'probability': 0.75}
    lines = [json.dumps(missed)] * 10 + [json.dumps(result)] * 2
    (tmp_path / 'matches.jsonl').write_text('\n'.join(lines))
    write_animation(tmp_path, tmp_path / 'demo.webp')
    with Image.open(tmp_path / 'demo.webp') as animation:
        assert animation.n_frames == 3
        bars = []
        for i in range(3):
            animation.seek(i)
            bars.append(np.asarray(animation.convert('RGB'))[-5, 2])
    np.testing.assert_allclose(bars, [NO_MATCH, NO_MATCH, RIGHT], atol=25)
    write_animation(tmp_path, tmp_path / 'subgoal.webp', ahead=3)
    assert (tmp_path / 'subgoal.webp').read_bytes() != (tmp_path / 'demo.webp').read_bytes()


def test_all_pictures_take_colors_and_style_from_the_two_modules_of_the_style():
    root = Path(__file__).resolve().parents[2]
    files = {*root.glob('stavpr_*/**/*.py'), *root.glob('benchmarks/*.py')}
    own = re.compile(r"'#[0-9a-fA-F]{3,6}'|color='[a-z0-9.]+'|pyplot|rcParams|fontsize=[0-9.]+")
    names = {f.name for f in files if 'test' not in f.parts and own.search(f.read_text())}
    assert names == {'palette.py', 'style.py'}
