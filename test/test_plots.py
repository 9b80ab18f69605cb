"""Pictures of results: written, of a sensible size, not blank, and none of them afraid of empty input."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from stavpr_ros.errors import InputError
from stavpr_ros.evaluation.plots import (
    MatchPair,
    demo_sheet,
    distance_matrix,
    distance_over_time,
    match_overview,
    precision_recall,
    warping_path,
)
from stavpr_ros.pipeline.overlay import NO_MATCH, RIGHT, match_image

QUERIES, PLACES, THRESHOLD = 40, 30, 0.5


@pytest.fixture(scope='module')
def results():
    """Make up a drive: matches along the diagonal, a stretch that the map lacks, one wrong match."""
    dice = np.random.default_rng(0)
    truth = np.minimum(np.arange(QUERIES) * 3 // 4, PLACES - 1)
    truth[20:26] = -1
    distances = 0.6 + 0.3 * dice.random((QUERIES, PLACES))
    known = np.flatnonzero(truth >= 0)
    distances[known, truth[known]] = 0.2
    matched = truth.copy()
    matched[5], matched[30] = 25, -1
    best = distances.min(axis=1)
    best[0] = np.nan
    outcomes = ['unseen' if t < 0 else 'no match' if m < 0 else 'right' if m == t else 'wrong'
                for m, t in zip(matched, truth, strict=True)]  # fmt: skip
    return distances, matched, truth, best, outcomes


def image(shade, shape=(48, 64)):
    return np.full((*shape, 3), shade, np.uint8)


def pairs():
    return [
        MatchPair(image(90), image(120), 'image 1', 'right'),
        MatchPair(image(90), image(200, (30, 50)), 'image 2', 'wrong'),
        MatchPair(image(90), None, 'image 3', 'no match'),
        MatchPair(image(90), None, 'image 4', 'unseen'),
    ]


def check(path, returned, least=(200, 400), spread=5.0):
    assert returned == path
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.shape[0] >= least[0]
    assert picture.shape[1] >= least[1]
    assert max(picture.shape) < 4000
    assert picture.std() > spread
    return picture


def has_color(picture, red, green, blue):
    return bool((np.abs(picture.astype(int) - (blue, green, red)).max(axis=2) < 12).sum() > 20)


def test_the_overview_frames_each_pair_in_the_color_of_its_outcome(tmp_path):
    picture = check(tmp_path / 'a.png', match_overview(tmp_path / 'a.png', pairs()))
    for color in ((0x2E, 0x8B, 0x57), (0xC8, 0x40, 0x2F), (0xD9, 0x9A, 0x1C), (0x8A, 0x8F, 0x98)):
        assert has_color(picture, *color)


def test_an_overview_of_nothing_says_so(tmp_path):
    check(tmp_path / 'a.png', match_overview(tmp_path / 'a.png', []), spread=1.0)


def test_an_unknown_outcome_is_refused():
    with pytest.raises(InputError, match="outcome is 'good'"):
        MatchPair(image(1), None, '', 'good')


def test_the_matrix_shows_right_and_wrong_matches_and_the_truth(tmp_path, results):
    distances, matched, truth, *_ = results
    picture = check(tmp_path / 'a.png', distance_matrix(tmp_path / 'a.png', distances, matched, truth, 2))
    for color in ((0x35, 0xD0, 0x7F), (0xFF, 0x54, 0x40), (0xF0, 0xC4, 0x19)):
        assert has_color(picture, *color)


@pytest.mark.parametrize('fill', [0.5, np.nan, np.inf])
def test_the_matrix_without_any_match_or_finite_distance_or_truth(tmp_path, fill):
    none = np.full(8, -1)
    check(tmp_path / 'a.png', distance_matrix(tmp_path / 'a.png', np.full((8, 6), fill), none, none))


def test_arrays_that_do_not_belong_together_are_refused(tmp_path, results):
    distances, matched, truth, best, outcomes = results
    with pytest.raises(InputError, match=r'matched \(39,\)'):
        distance_matrix(tmp_path / 'a.png', distances, matched[1:], truth)
    with pytest.raises(InputError, match=r'shape \(0, 4\)'):
        distance_matrix(tmp_path / 'a.png', np.zeros((0, 4)), matched[:0], truth[:0])
    with pytest.raises(InputError, match='39 outcomes'):
        distance_over_time(tmp_path / 'a.png', best, THRESHOLD, outcomes[1:], truth < 0)
    with pytest.raises(InputError, match='neither 0'):
        warping_path(tmp_path / 'a.png', np.zeros((0, 4)), np.zeros((0, 2)))


def test_the_distance_over_time_shows_threshold_and_outcomes(tmp_path, results):
    *_, truth, best, outcomes = results
    picture = check(
        tmp_path / 'a.png', distance_over_time(tmp_path / 'a.png', best, THRESHOLD, outcomes, truth < 0)
    )
    assert has_color(picture, 0x3B, 0x6E, 0xA5)
    assert has_color(picture, 0x2E, 0x8B, 0x57)


def test_the_distance_over_time_without_answers_threshold_or_queries(tmp_path):
    for count in (0, 5):
        path = tmp_path / f'{count}.png'
        nothing = np.full(count, np.nan)
        returned = distance_over_time(path, nothing, np.nan, ['no match'] * count, np.zeros(count, bool))
        check(path, returned)


def test_precision_and_recall_with_and_without_curves(tmp_path):
    recall = np.linspace(0, 1, 20)
    curves = {'a': (recall, 1 - recall**4), 'b': (recall, 1 - recall**2)}
    check(tmp_path / 'a.png', precision_recall(tmp_path / 'a.png', curves, (0.5, 0.9)))
    check(tmp_path / 'b.png', precision_recall(tmp_path / 'b.png', {}), spread=1.0)


def test_the_warping_path_and_an_empty_one(tmp_path):
    window = np.random.default_rng(1).random((20, 40))
    diagonal = np.stack([np.arange(20), np.arange(20)], axis=1)
    with_path = check(tmp_path / 'a.png', warping_path(tmp_path / 'a.png', window, diagonal, 100))
    without = check(tmp_path / 'b.png', warping_path(tmp_path / 'b.png', window, np.zeros((0, 2), int)))
    assert has_color(with_path, 0x35, 0xD0, 0x7F)
    assert not has_color(without, 0x35, 0xD0, 0x7F)


def test_the_sheet_holds_everything_and_survives_nothing(tmp_path, results):
    distances, matched, truth, best, outcomes = results
    path = tmp_path / 'a.png'
    returned = demo_sheet(
        path, pairs(), distances, matched, truth, best, THRESHOLD, outcomes, 2, 'Title', 'F1 0.9'
    )
    picture = check(path, returned, least=(1000, 1500))
    assert has_color(picture, 0x3B, 0x6E, 0xA5)
    none = np.full(QUERIES, -1)
    path = tmp_path / 'b.png'
    check(path, demo_sheet(path, [], distances, none, none, best * np.nan, 0.1, ['unseen'] * QUERIES))


@pytest.mark.parametrize(('accepted', 'color'), [(True, RIGHT), (False, NO_MATCH)])
def test_the_overlay_puts_query_and_place_side_by_side(accepted, color):
    sheet = match_image(image(50), image(180, (100, 200)), 'match: place 3', accepted)
    assert sheet.dtype == np.uint8
    assert np.all(sheet[:48, :64] == 50)
    assert np.all(sheet[:48, -64:] == 180)
    assert tuple(sheet[-1, 0]) == color
    assert sheet[48:].std() > 5  # something is written


def test_the_overlay_without_a_place_and_with_a_long_text():
    shape = match_image(image(50), image(9), '', True).shape
    assert match_image(image(50), None, 'x' * 500, False).shape == shape


def test_the_overlay_leaves_its_images_alone():
    query = image(50)
    match_image(query, query, 'text', True)
    assert np.all(query == 50)


def test_the_overlay_refuses_what_is_no_rgb_image():
    with pytest.raises(InputError, match=r'query has shape \(4, 4\)'):
        match_image(np.zeros((4, 4), np.uint8), None, '', True)
    with pytest.raises(InputError, match='place has shape'):
        match_image(image(1), np.zeros((4, 4, 3), np.float32), '', True)


def test_importing_loads_matplotlib_only_when_a_picture_is_drawn():
    code = (
        'import sys; import stavpr_ros.evaluation.plots, stavpr_ros.pipeline.overlay; '
        'sys.exit("matplotlib" in sys.modules)'
    )
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0
