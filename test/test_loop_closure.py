# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure: a route that grows and is evicted, means of its places, and a reset."""

from dataclasses import fields, replace
from functools import partial
import math

import numpy as np
from places import features_of, recognize_all, route_strips
import pytest
from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.alignment.lm_dtw import best_match, match_sequence
from stavpr_ros.errors import FeatureMismatchError, InputError, SettingsError
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.loop_closer import (
    AROUND,
    BAND,
    CONFIRMED,
    LONGEST_GAP,
    LoopCloser,
    MIN_PLACES,
    PathConfirmation,
)
from stavpr_ros.method.match import Limits, Match, Path, WindowColumns
from stavpr_ros.method.model import CLOSE, DELAY, MEAN_IMAGES, MEAN_PRIOR, NEAREST
from stavpr_ros.method.place_means import PlaceMeans
from stavpr_ros.method.settings import PAPER, ROBUST, RobustOptions
from stavpr_ros.prepare import route_features
from stavpr_ros.prepare.centering import z_normalized
from stavpr_ros.prepare.matcher import CpuMatcher
from stavpr_ros.prepare.route_features import ROOM

pytestmark = pytest.mark.usefixtures('one_thread')
SHORT = SequenceSettings(length=5, beta=2.0)
SECOND = 10**9
LM_DTW = RobustOptions(mean_centering=False, whitening=False, place_filter=False)


def laps_of(count, places, noise=0.4, seed=0):
    """Return features of so many places, passed lap after lap, with noise."""
    rng = np.random.default_rng(seed)
    known = rng.standard_normal((7, places, 16))
    strips = known[:, np.arange(count) % places] + noise * rng.standard_normal((7, count, 16))
    strips += rng.standard_normal((7, 1, 16))  # what all images share
    strips[2, 3::17] = 0  # zero features
    return features_of(strips)


@pytest.fixture(scope='module')
def laps():
    """Five laps of 60 places, more than there is room for at first."""
    assert ROOM < 300
    return laps_of(300, 60)


def settings_of(mode, **changes):
    return RecognizerSettings(
        None if mode.place_filter else 0.5,
        sequence=SHORT,
        nms_radius=5,
        mode=mode,
        **changes,
    )


def drive(closer, features, stamps=None):
    stamps = [0] * len(features) if stamps is None else stamps
    return [closer.update(features[i : i + 1], stamps[i]) for i in range(len(features))]


def same(one, other):
    assert (one.status, one.reason) == (other.status, other.reason)
    assert repr(one.path) == repr(other.path)  # to the last bit, and NaN like NaN
    np.testing.assert_array_equal(one.path.pairs, other.path.pairs)


class PlainCloser:
    """
    Evicts nothing: every image stays, and places before ``first`` are banned wherever they occur.

    Its rows have an entry for every image of the route; features are not centered.
    """

    def __init__(self, settings, exclude, features):
        self.settings, self.exclude, self.all, self.rows = settings, exclude, features, []

    def add(self, image, first, last):
        """Return the sequence of an image that may be matched with places first..last-1."""
        row = np.full(len(self.all), np.inf, np.float32)
        if last - first >= MIN_PLACES:
            strips, weights = self.all.strips[:, image], self.all.weights[:, image]
            matcher = CpuMatcher(self.all[:last], self.settings.applied_spatial)
            row[first:last] = matcher.distances(strips, weights)[first:]
            if self.settings.applied_options.query_znorm:
                row[first:last] = z_normalized(row[first:last], AROUND)
        self.rows = [*self.rows, row][-self.settings.sequence.length :]
        if len(self.rows) < self.settings.sequence.length:
            return None
        window = np.stack(self.rows)
        window[:, :first] = np.inf
        result = match_sequence(window, self.settings.sequence)
        return best_match(result, self.settings.nms_radius)


@pytest.mark.parametrize(
    ('options', 'limit', 'exclude', 'sequence'),
    [(PAPER, 64, 12, SHORT), (LM_DTW, 41, 12, SHORT), (LM_DTW, 48, 2, SequenceSettings())],
    ids=['paper', 'z-normalized', 'z-normalized, default sequence'],
)
def test_loop_closer_with_limit_equals_plain_loop_with_bans(
    laps, options, limit, exclude, sequence
):
    """Exactly: evicted places are as banned ones."""
    settings = replace(settings_of(options), sequence=sequence)
    closer = LoopCloser(settings, exclude, laps.settings, limit=limit)
    plain = PlainCloser(settings, exclude, laps)
    answered = 0
    for i in range(len(laps)):
        answer = closer.update(laps[i : i + 1])
        assert closer.first + len(closer) == i + 1
        expected = plain.add(i, closer.first, max(closer.first, i + 1 - exclude))
        if expected is None:
            assert answer.path.place < 0
            continue
        answered += 1
        result = answer.path
        assert (result.first, result.last, result.place) == (
            expected.first,
            expected.last,
            expected.middle,
        )
        assert result.second_best == expected.second_best_index
        np.testing.assert_array_equal(
            [result.distance, result.second_best_distance],
            [expected.distance, expected.second_best_distance],
        )
        assert answer.path.pairs[:, 1].min() == result.first >= closer.first
        assert answer.path.pairs[-1].tolist() == [sequence.length - 1, result.last]
        assert result.last < i + 1 - exclude
    assert answered > 270
    assert closer.first > 0


def test_late_matches_close_what_was_not_certain_at_first():
    """
    A second lap in bad light, where evidence grows slowly.

    Some waited for the others of their path, and some are of oldest images. No image has two.
    """
    length, lap, exclude = 20, 80, 20
    strips = laps_of(2 * lap, lap).strips
    rng = np.random.default_rng(1)
    strips[:, lap:] += 0.5 * rng.standard_normal(strips[:, lap:].shape).astype(np.float32)
    features = features_of(strips)
    settings = RecognizerSettings(sequence=SequenceSettings(length), nms_radius=5, mode='robust')
    closer = LoopCloser(settings, exclude, features.settings)
    middle, closed, late, oldest = (length - 1) // 2, [], {}, 0
    for i in range(len(features)):
        match = closer.update(features[i : i + 1])
        assert (match.last_image, match.is_late, match.position) == (i, False, match.position)
        if match.accepted:
            closed.append(i - (length - 1) + middle)
        assert match.accepted or not match.late
        for result in match.late:
            assert (result.status, result.is_late) == (Status.MATCH, True)
            assert result.position == (0 if result.is_oldest else middle)
            assert abs(int(result.path.pairs[result.position, 1]) - result.place) <= CLOSE
            late[result.first_image + result.position] = result.place
            oldest += result.is_oldest
            closed.append(result.first_image + result.position)
    assert len(closed) == len(set(closed))
    assert len(late) > oldest >= 5
    assert all(abs(query - lap - place) <= CLOSE for query, place in late.items())
    closer.reset()
    again = drive(closer, features[: length - 1])  # no window is full
    assert not any(match.late for match in again)


def test_mode_paper_and_localization_have_no_late_matches(laps, small_map):
    paper = LoopCloser(RecognizerSettings(10.0, sequence=SHORT, mode='paper'), 12, laps.settings)
    assert not any(match.late for match in drive(paper, laps[:150]))
    localizer = PlaceRecognizer(small_map, RecognizerSettings(mode='robust'))
    assert {match.late for match in drive(localizer, small_map.features)} == {()}


SURE, DOUBTFUL, NONE = (CONFIRMED + 1) / 2, 0.6, 0.4  # probabilities
PLACE = 8


@pytest.mark.parametrize(
    ('events', 'closed'),
    [
        ([SURE, SURE], [1, 0]),
        ([DOUBTFUL, SURE, DOUBTFUL, SURE, DOUBTFUL], [3, 0, 1, 2, 4]),
        ([DOUBTFUL] * 9, []),
        ([DOUBTFUL] * 11, [9, *range(9), 10]),
        (['rest', *[DOUBTFUL] * 30, 'drive', SURE, SURE], [31, *range(16, 31)]),  # 15 have waited
        ([SURE, *[NONE] * (LONGEST_GAP - 1), SURE], [LONGEST_GAP, 0]),
        ([SURE, *[NONE] * LONGEST_GAP, SURE], []),
        ([SURE, SURE, *[NONE] * LONGEST_GAP, DOUBTFUL], [1, 0]),
        ([SURE, *[NONE] * LONGEST_GAP, SURE, SURE], [LONGEST_GAP + 2, LONGEST_GAP + 1]),
        ([SURE, BAND, SURE], [1, 0]),
        ([SURE, BAND + 1, SURE], []),
        ([SURE, NONE, -2 * BAND, SURE], [2, 0]),
        ([SURE, 'reset', SURE], []),
        ([SURE, 'evict', DOUBTFUL, SURE], [2, 1]),
        ([DOUBTFUL, SURE, 'rest', SURE, SURE, 'drive', SURE], [4, 0, 1, 2, 3]),
    ],
)
def test_path_is_closed_after_half_a_window_of_certain_matches_or_two_of_any(events, closed):
    """Those before are late; a number moves the place, and ``evict`` evicts the one before."""
    paths, columns = PathConfirmation(SHORT.length), WindowColumns(0, np.zeros((1, 1)))
    result, images, place, first, at_rest = [], 0, PLACE, 0, False
    for event in events:
        if event == 'reset':
            paths.reset()
        elif event == 'evict':
            place, first = place + 1, place + 1
        elif isinstance(event, str):
            at_rest = event == 'rest'
        elif isinstance(event, int):
            place += event
        else:
            match = Match(
                Status.NO_MATCH if event == NONE else Status.MATCH,
                limits=Limits(0.5, 0.5),
                path=Path(np.array([[0, place]]), place),
                probability=event,
                window_stamps=(0,),
                first_image=images,
            )
            if match.accepted:
                keep = partial(replace, columns=columns)
                match = paths.take(match, [], keep, at_rest, first)
            waits = not match.accepted and event != NONE
            assert match.reason == 'its path is not confirmed yet' * waits
            assert not waits or not match.with_probability(1.0).accepted
            assert all(late.is_late for late in match.late)
            result += [match, *match.late] if match.accepted else []
            images += 1
    assert [match.last_image for match in result] == closed


def test_exclude_seconds_leaves_young_places_out(laps):
    """At 2 Hz, 10 Hz and 0.5 Hz, some stamps unknown; places of exactly that age are old."""
    rng = np.random.default_rng(1)
    stamps = np.cumsum(np.repeat([5, 1, 20], 100)) * (SECOND // 10) + 1
    stamps[rng.random(300) < 0.1] = 0
    closer = LoopCloser(settings_of(ROBUST), 7, laps.settings, exclude_seconds=9.5)
    old = 0
    for i in range(300):
        closer.update(laps[i : i + 1], int(stamps[i]))
        while old <= i and (
            not stamps[old] or (stamps[i] and stamps[i] - stamps[old] >= 9.5 * SECOND)
        ):
            old += 1
        expected = min(i + 1 - 7, old) if stamps[i] else i + 1 - 7
        assert len(closer.newest_row()) == max(0, expected)


def test_loop_closer_with_standing_clock_matches_nothing(laps):
    """All places stay young; the limit holds."""
    closer = LoopCloser(settings_of(ROBUST), 12, laps.settings, limit=80, exclude_seconds=5.0)
    answers = drive(closer, laps, [SECOND] * 300)
    assert all(answer.path.place < 0 for answer in answers)
    assert answers[-1].status is Status.NO_MATCH
    assert 'old enough' in answers[-1].reason
    assert len(closer) <= 80
    assert len(closer.newest_row()) == 0
    closer.update(laps[:1], 6 * SECOND)
    assert len(closer.newest_row()) == len(closer) - 12


def test_reset_after_clock_jump_keeps_route(laps):
    closer = LoopCloser(settings_of(ROBUST), 12, laps.settings, exclude_seconds=8.0)
    stamps = [10_000 * SECOND + i * SECOND for i in range(150)]
    for i in range(100):
        closer.update(laps[i : i + 1], stamps[i])
    assert closer.ranked(2)
    closer.reset()
    assert closer.window_fill == 0
    assert closer.ranked(2) == []
    assert len(closer) == 100
    for i in range(100, 150):  # the clock jumped back
        answer = closer.update(laps[i : i + 1], stamps[i] - 9_900 * SECOND)
        young = min(i + 1 - 100, 8)
        assert len(closer.newest_row()) == i + 1 - max(12, young)
        if i < 104:
            assert answer.status is Status.WARMING_UP
        else:
            assert answer.accepted == (i > 104)  # the path is confirmed by two
            assert not answer.accepted or (i - answer.newest) % 60 == 0


@pytest.mark.parametrize('mode', [PAPER, ROBUST, RobustOptions(place_filter=False)])
def test_ranked_places_are_numbered_from_start_of_route(laps, mode):
    closer = LoopCloser(settings_of(mode), 12, laps.settings, limit=200)
    assert closer.ranked(5) == []
    for i in range(260):
        nearest = closer.update(laps[i : i + 1]).path
        ranked = closer.ranked(3)
        if nearest.place < 0:
            assert ranked == []
            continue
        assert (ranked[0].place, ranked[0].distance) == (nearest.place, nearest.distance)
        if nearest.distance < 0.99:
            assert closer.candidates(1)[0] == pytest.approx([nearest.place], abs=CLOSE)
        if len(ranked) > 1:
            assert ranked[1].place == nearest.second_best
            assert ranked[1].distance == pytest.approx(nearest.second_best_distance, abs=1e-6)
        if i > 220:
            offsets = [i - 2 - c.place for c in ranked[:2] if c.distance < 0.99]
            near = CLOSE if mode.place_filter else 0
            assert all(min(abs(o - lap) for lap in (60, 120, 180)) <= near for o in offsets)
            assert closer.first > 0


def test_update_with_error_changes_nothing(laps, small_map):
    """Of features of another network, another shape, several images or with NaN."""
    one, other = (LoopCloser(settings_of(ROBUST), 12, laps.settings, limit=70) for _ in range(2))
    image, odd, nan = laps[:1], laps.strips[:2, :1], np.full((7, 1, 16), math.nan)
    wrong = {
        r'the route so far has \d+: it was not made': replace(
            image, strips=image.strips[..., :-1]
        ),
        r'strips: shape .*, expected': replace(image, strips=odd, weights=image.weights[:2]),
        '2 images': laps[:2],
        'not finite': features_of(nan),
        'projection|settings|dimensions': small_map.features[:1],
    }
    for i in range(100):
        for text, features in wrong.items() if i % 10 == 5 else ():
            with pytest.raises((InputError, FeatureMismatchError), match=text):
                other.update(features, 5)
        same(one.update(laps[i : i + 1]), other.update(laps[i : i + 1]))
        assert (one.first, len(one)) == (other.first, len(other))


@pytest.mark.parametrize('exclude', [1, 12])
def test_loop_closer_with_smallest_limit_matches(exclude):
    features = laps_of(120, 9)
    settings = settings_of(RobustOptions(mean_centering=False, whitening=False))
    with pytest.raises(SettingsError, match=r'limit = 0 .* take at least \d+') as refused:
        LoopCloser(settings, exclude, features.settings, limit=0)
    least = int(str(refused.value).split()[-1])
    with pytest.raises(SettingsError, match=f'limit = {least - 1}'):
        LoopCloser(settings, exclude, features.settings, limit=least - 1)
    closer = LoopCloser(settings, exclude, features.settings, limit=least)
    answers = drive(closer, features)
    assert least <= exclude + 2 * SHORT.length + 8
    assert all(answer.path.place >= 0 for answer in answers[60:])


def test_loop_closer_of_invalid_settings_is_rejected(laps):
    robust = settings_of(ROBUST)
    for seconds in (-1.0, math.nan):
        with pytest.raises(SettingsError, match='exclude_seconds'):
            LoopCloser(robust, 12, laps.settings, exclude_seconds=seconds)
    with pytest.raises(SettingsError, match='exclude'):
        LoopCloser(robust, 0, laps.settings)
    with pytest.raises(SettingsError, match='none'):
        LoopCloser(RecognizerSettings(spatial=SpatialSettings('none')), 12, laps.settings)


@pytest.mark.parametrize('limit', [None, 90])
def test_settled_route_in_int8_matches_as_in_float32(laps, set_constants, limit):
    """Rounded once, by the mean and the whitening of the day it settled; an eighth is evicted."""
    set_constants(route_features, SETTLED=150)
    full = LoopCloser(settings_of(ROBUST), 12, laps.settings, limit=limit)
    less = LoopCloser(settings_of(ROBUST), 12, laps.settings, limit=limit, precision='int8')
    matched, settled = 0, min(150, limit or 150)
    for i in range(len(laps)):
        one, other = less.update(laps[i : i + 1]), full.update(laps[i : i + 1])
        assert (less.first, len(less)) == (full.first, len(full))
        if i + 1 < settled:
            same(one, other)
            continue
        assert less._route.strips.values.dtype == np.int8
        assert one.status == other.status
        if other.accepted:
            matched += 1
            assert one.place == pytest.approx(other.place, abs=1)
            assert one.probability == pytest.approx(other.probability, abs=0.05)
    assert matched > 100
    kept = laps[less.first :]
    np.testing.assert_allclose(less.features().strips, kept.strips, atol=0.05, rtol=0)
    np.testing.assert_allclose(less.features().weights, kept.weights, rtol=1e-5, atol=1e-5)


# Means of places over the latest images, and loop closure on a new street in a known light

EXCLUDED = 50


def expected_means(rows, places):
    """Return the means by the definition, (places,), of rows that count, oldest first."""
    weights = (1 - 1 / MEAN_IMAGES) ** np.arange(len(rows))[::-1]
    known = [np.append(row, np.full(places - len(row), row[-1])) for row in rows]
    clipped = np.maximum(np.reshape(known, (len(rows), places)), NEAREST)
    return weights @ clipped / (weights.sum() + MEAN_PRIOR)


def test_means_are_weighted_ones_of_earlier_rows_with_unknown_places_as_the_last():
    rng = np.random.default_rng(0)
    rows = [rng.normal(0, 2, 3 + i).astype(np.float32) for i in range(12)]
    means = PlaceMeans()
    for i, row in enumerate(rows):
        counted = rows[: max(0, i - DELAY)]
        less = means.correct(row, False)
        np.testing.assert_allclose(less, row - expected_means(counted, len(row)), atol=1e-5)


def test_places_that_are_excluded_count_as_mean_0():
    means = PlaceMeans()
    for _ in range(10):
        means.correct(np.array([np.inf, 1.0], np.float32), False)
    less = means.correct(np.array([2.0, 2.0], np.float32), False)
    assert less[0] == 2
    assert less[1] < 2
    assert means.correct(np.array([np.inf, 1.0], np.float32), False)[0] == np.inf


def test_evicted_places_take_their_means_with_them():
    rng = np.random.default_rng(2)
    rows = rng.normal(0, 1, (30, 40)).astype(np.float32)
    whole, evicted = PlaceMeans(), PlaceMeans()
    for row in rows:
        whole.correct(row, False)
        evicted.correct(row, False)
    evicted.evict(7)
    for row in rows:
        kept = evicted.correct(row[7:], False)
        np.testing.assert_array_equal(kept, whole.correct(row, False)[7:])
    evicted.evict(33)
    assert len(evicted.correct(np.empty(0, np.float32), False)) == 0


def drive_along(strips, noise=0.3):
    """Return the matches of a route with images of these strips."""
    features = features_of(strips, noise)
    closer = LoopCloser(RecognizerSettings(mode='robust'), EXCLUDED, features.settings)
    return recognize_all(closer, features)


def with_shared_content(seed, amount):
    """Return strips; from place 200 on, all share content with places 60 to 75."""
    strips = route_strips(seed, 300)
    shared = amount * np.random.default_rng(seed + 50).standard_normal((7, 1, strips.shape[2]))
    strips[:, 60:75] += shared
    strips[:, 200:260] += shared
    return strips


def probable(matches):
    return sum(match.probability > RecognizerSettings.min_probability for match in matches)


@pytest.mark.parametrize('seed', [0, 1])
def test_stretch_that_looks_like_an_earlier_one_throughout_is_seldom_probable(set_constants, seed):
    """No place is passed again, then all are."""
    strips = with_shared_content(seed, 1.6)
    assert probable(drive_along(strips)) <= 10
    twice = drive_along(np.concatenate([strips, strips], axis=1))
    places = [match.path.place for match in twice if match.accepted]
    off = np.array(places) - np.arange(len(places))
    assert len(places) > 265
    assert np.mean(np.abs(off - np.median(off)) <= 4) > 0.95
    assert probable(drive_along(strips, noise=1.0)) <= 3
    set_constants(PlaceMeans, correct=lambda self, z, is_standstill: z)
    assert probable(drive_along(strips, noise=1.0)) > 8


@pytest.mark.parametrize('seed', [0, 3, 4])
def test_stretch_that_looks_alike_for_less_than_a_window_is_not_closed(seed):
    matches = drive_along(with_shared_content(seed, 1.8))
    assert probable(matches) <= 15
    assert not any(match.accepted or match.late for match in matches)


# A loop closer after its reset, as test_golden_streams has the recognizers of maps

N = 120
ROUTE = route_strips(0, N)
DRIVE = features_of(np.concatenate([ROUTE[:, :95], route_strips(9, 30), ROUTE[:, 85:]], 1), 0.5, 7)
DRIVE.strips[:, 70:95] = DRIVE.strips[:, 69:70]  # a stop before the detour
POSES = np.tile([0.0, 0, 0, 0, 0, 0, 1], (2 * N, 1))
POSES[:, 0] = 1.1 * np.arange(2 * N)


def fields_of(recognizer, features, image):
    """Return all fields of the match of the next image as text."""
    match = recognizer.update(features[image : image + 1], (image + 1) * 10**8, POSES[image])
    return repr([np.asarray(getattr(match, f.name), object).tolist() for f in fields(Match)])


def assert_same(one, new, features):
    pairs = [[fields_of(c, features, image) for c in (one, new)] for image in range(len(features))]
    assert [first for first, _ in pairs] == [second for _, second in pairs]
    assert sum('Status.MATCH' in first for first, _ in pairs) > 10


@pytest.mark.parametrize('precision', ['float32', 'int8'])
def test_loop_closer_after_a_reset_answers_as_a_new_one_on_its_route(precision):
    """The route stays; another one has the same without any window, by a reset at each image."""
    options = {'limit': 240, 'precision': precision}
    one, new = (LoopCloser(RecognizerSettings(), 30, DRIVE.settings, **options) for _ in 'ab')
    for image in range(len(DRIVE)):
        fields_of(one, DRIVE, image)
        fields_of(new, DRIVE, image)
        new.reset()
    one.reset()
    assert_same(one, new, features_of(ROUTE, 0.5, 8))
