# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pipeline without ROS: operations and changes between them, live settings, invalid images."""

from dataclasses import replace
import itertools

import cv2
from fixtures import route_images
import numpy as np
from pipelines import (
    at,
    EXCLUDED,
    LENGTH,
    localizing,
    mark_saved,
    message,
    MIN_PROBABILITY,
    process,
    record,
    SECOND,
    settings_of,
    stamps_of,
    statuses,
)
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import ImageError, InputError, SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import save_map, Session, thumbnail_of
from stavpr_ros.mapping.keyframes import KeyframeSettings
from stavpr_ros.method import PlaceRecognizer, Status
from stavpr_ros.method.loop_closer import LoopCloser
from stavpr_ros.method.verification import GeometricEvidence, GeometricSettings, PlaceVerifier
from stavpr_ros.pipeline import OPERATIONS, Pipeline, read_map

pytestmark = pytest.mark.usefixtures('one_thread')


def same_recognition(match, core):
    """Every field that the recognizer fills."""
    assert (match.status, match.reason) == (core.status, core.reason)
    np.testing.assert_equal(match.limits, core.limits)
    assert repr(match.path) == repr(core.path)
    np.testing.assert_array_equal(match.path.pairs, core.path.pairs)


@pytest.mark.parametrize(('mode', 'threshold'), [('paper', 0.2), ('robust', None)])
def test_localization_returns_the_matches_of_the_recognizer(
    map_file, small_map, route, mode, threshold
):
    pipeline = localizing(map_file, mode=mode, threshold=threshold)
    images = route[20:32] + route_images(4, seed=9)
    core = PlaceRecognizer(small_map, pipeline.settings)
    matches = process(pipeline, images)
    for i, result in enumerate(matches):
        features = pipeline.operation.extractor.extract([images[i]])
        same_recognition(result.match, core.update(features))
        assert result.match.window_stamps == tuple(
            (j + 1) * SECOND for j in range(max(0, i - 4), i + 1)
        )
        assert (result.image_index, result.match.first_image, result.match.inliers) == (-1, -1, -1)
        assert set(result.stages) == {'decoding', 'extraction', 'matching', 'verification'}
    assert statuses(matches).count(Status.MATCH) >= 8
    operation = pipeline.operation
    state = operation.map_state, operation.window_fill, operation.missing
    assert state == ('loaded', LENGTH, '')


def test_missing_map_or_threshold_is_the_reason(map_file, route):
    pipeline = Pipeline(settings_of(mode='paper'))
    operation = pipeline.operation
    state = operation.map_state, operation.places, operation.window_fill
    assert state == ('none', None, 0)
    assert 'map_path' in pipeline.operation.missing
    (result,) = process(pipeline, route[:1])
    assert (result.match.reason, result.cause) == (pipeline.operation.missing, 'not ready')
    assert result.match.status is Status.NOT_READY
    pipeline.change(loaded=read_map(map_file, pipeline.settings))
    assert (pipeline.operation.map_state, len(pipeline.places)) == ('loaded', 60)
    assert 'threshold' in pipeline.operation.missing
    assert process(pipeline, route[:1])[0].match.reason == pipeline.operation.missing
    pipeline.change(replace(pipeline.settings, threshold=0.2))
    assert statuses(process(pipeline, route[:LENGTH]))[-1] is Status.MATCH
    pipeline.change(replace(pipeline.settings, threshold=None))
    assert statuses(process(pipeline, route[:1])) == [Status.NOT_READY]
    # images are missing from the window
    pipeline.change(replace(pipeline.settings, threshold=0.2))
    assert statuses(process(pipeline, route[:1])) == [Status.WARMING_UP]


def test_paper_takes_the_threshold_of_the_map_unless_it_is_set(small_map, route, tmp_path):
    save_map(replace(small_map, threshold=0.2), tmp_path / 'route.stavpr')
    pipeline = localizing(str(tmp_path / 'route.stavpr'), mode='paper')
    assert (pipeline.operation.threshold, pipeline.operation.missing) == (0.2, '')
    result = process(pipeline, route[20:30])[-1]
    assert (result.match.status, result.match.threshold) == (Status.MATCH, 0.2)
    for threshold in (0.3, None):
        pipeline.change(replace(pipeline.settings, threshold=threshold))
        (result,) = process(pipeline, route[30:31])
        assert (result.match.status, result.match.threshold) == (Status.MATCH, threshold or 0.2)
    assert localizing(str(tmp_path / 'route.stavpr')).operation.threshold == 1 - MIN_PROBABILITY


def test_mapping_records_places(route):
    pipeline = Pipeline(settings_of(thumbnail_width=64), 'mapping')
    operation = pipeline.operation
    assert (operation.map_state, operation.missing, len(pipeline.places)) == ('growing', '', 0)
    matches = process(pipeline, route[:4], poses=True) + process(pipeline, route[4:8], first=4)
    assert statuses(matches) == [Status.MAPPED] * 8
    places = pipeline.places.snapshot()
    assert stamps_of(places) == list(range(1, 9))
    np.testing.assert_array_equal(places.poses[:4], [at(i) for i in range(4)])
    assert np.isnan(places.poses[4:]).all()
    features = FeatureExtractor('gradient').extract(route[:8])
    np.testing.assert_allclose(places.features.strips, features.strips, atol=1e-6, rtol=0)
    thumbnail = places.thumbnail(3)
    assert thumbnail.shape == (48, 64, 3)
    small = cv2.resize(route[3], (64, 48), interpolation=cv2.INTER_AREA).astype(float)
    assert np.abs(thumbnail - small).mean() < 20 < np.abs(places.thumbnail(5) - small).mean()


def test_mapping_stops_at_max_places(route):
    pipeline = Pipeline(settings_of(max_places=100), 'mapping')
    matches = process(pipeline, (route + route)[:103])
    assert statuses(matches) == [Status.MAPPED] * 100 + [Status.NOT_READY] * 3
    assert matches[-1].cause == 'map full'
    assert pipeline.operation.map_state == 'full'
    assert stamps_of(pipeline.places) == list(range(1, 101))


@pytest.mark.parametrize('exclude_seconds', [0.0, 30.0])
def test_loop_closure_returns_the_matches_of_the_loop_closer(route, exclude_seconds):
    pipeline = Pipeline(settings_of(exclude_seconds=exclude_seconds), 'loop_closure')
    images = route[:40] * 2
    core = LoopCloser(
        pipeline.settings,
        EXCLUDED,
        pipeline.operation.extractor.settings,
        limit=20000,
        exclude_seconds=exclude_seconds,
    )
    for i, result in enumerate(process(pipeline, images, poses=True)):
        features = pipeline.operation.extractor.extract([images[i]])
        same_recognition(result.match, core.update(features, (i + 1) * SECOND, at(i)))
        assert (result.image_index, len(result.match.window_stamps)) == (i, min(i + 1, LENGTH))
        assert result.match.first_image == max(0, i - LENGTH + 1)
        if result.match.path.place >= 0:
            assert result.match.path.pairs[:, 1].max() <= i - max(EXCLUDED, exclude_seconds)
        if i >= 40 + 3 * LENGTH:
            assert (result.match.status, result.match.newest) == (Status.MATCH, i - 40)
    assert (pipeline.operation.map_state, len(pipeline.places)) == ('growing', 80)


def test_loop_closure_evicts_places_and_indices_stay(route):
    """At most 100 places: every index of every match refers to the image of that number."""
    pipeline = Pipeline(settings_of(max_places=100, candidates=4), 'loop_closure')
    images = route * 4
    closed, firsts = 0, set()
    for i, image in enumerate(images):
        (result,) = process(pipeline, [image], first=i, poses=True)
        places = pipeline.places
        firsts.add(places.first)
        assert len(places) <= 100
        assert (result.image_index, places.first + len(places) - 1) == (i, i)
        indices = {result.image_index, *(candidate.place for candidate in result.candidates)}
        if result.match.status is Status.MATCH:
            indices |= {int(place) for place in result.match.path.pairs[:, 1]}
            assert min(indices) >= places.first
            if i >= 60 + LENGTH:
                assert result.match.newest == i - 60
                closed += 1
        for index in indices:
            place = places.place(index)
            assert (place.stamp, place.pose[0]) == ((index + 1) * SECOND, index)
    assert closed >= 240 - 60 - 3 * LENGTH
    assert firsts == set(range(0, 145, 12))  # an eighth of 100 at a time
    assert stamps_of(pipeline.places) == list(range(145, 241))


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_matched_pair_has_the_distances_of_the_window(operation, route):
    """Bit for bit, of late matches as well."""
    pipeline = record(route, operation)
    matches, rows, earlier = [], [], 0
    for i, image in enumerate(route[:30]):
        (result,) = process(pipeline, [image], first=i, poses=True)
        row = pipeline.operation.recognizer.newest_row()
        rows.append(np.pad(row, (0, 60 - len(row)), constant_values=np.inf))
        if len(rows) < LENGTH:
            continue
        matches_now = (result.match, *result.match.late)
        pairs = {one: pipeline.operation.matched_pair(one) for one in matches_now}
        for one, pair in pairs.items():
            if pair is None:
                continue
            end = i + 1
            if operation == 'loop_closure':
                assert pair.query_pose[0] == (one.first_image + one.position) % 30
                end = one.first_image + LENGTH - 30
            if end < LENGTH:  # its window began before the rows
                continue
            earlier += end <= i
            columns = np.array(rows)[end - LENGTH : end, pair.first :][:, : len(pair.poses)]
            np.testing.assert_array_equal(pair.distances, columns)
            matches.append(pair.query_pose[0] - pair.pose(pair.place)[0])
    assert matches.count(0) > 20
    assert not earlier or operation == 'loop_closure'
    assert len(set(np.abs(matches))) < 4


def test_matched_pair_of_the_newest_images_alone_is_of_these(route):
    """After a jump, while images from before it are in the window."""
    pipeline = record(route, 'localization', 60, sequence=SequenceSettings(12))
    pipeline.change(replace(pipeline.settings, min_probability=0.5))
    process(pipeline, route[5:22], first=5, poses=True)
    lengths = []
    for i in range(35, 44):
        (result,) = process(pipeline, route[i : i + 1], first=i, poses=True)
        if (pair := pipeline.operation.matched_pair(result.match)) is not None:
            stamps = np.array(result.match.window_stamps)
            np.testing.assert_array_equal(pair.query_poses[:, 0], stamps // SECOND - 1)
            assert pair.distances.shape == (len(stamps), len(pair.poses))
            assert pair.query_pose[0] == pytest.approx(pair.place, abs=2)
            lengths.append(len(stamps))
    assert min(lengths) < 12 == pipeline.operation.window_fill


def test_matched_pair_has_thumbnails_of_one_session(small_map, route, tmp_path):
    path, sessions = tmp_path / 'map.stavpr', (Session('a'), Session('b'))
    index = np.repeat(np.array([0, 1], np.int32), [3, 57])
    save_map(replace(small_map, sessions=sessions, session_index=index), path)
    pipeline = localizing(str(path))
    result = process(pipeline, route[2 : 2 + LENGTH], poses=True)[-1]
    assert result.match.place == 4
    assert min(pipeline.operation.matched_pair(result.match, 'pnp').thumbnails) == 3


@pytest.mark.parametrize('images', [(6, 0, 6), (6, 6, 6)])
def test_change_of_operation_keeps_the_places(route, images):
    """A recorded route becomes the map, an empty one loses nothing: against a list of stamps."""
    for names in itertools.product(OPERATIONS, repeat=3):
        pipeline = Pipeline(settings_of(), names[0])
        held, new_route, first = [], [], 0
        for name, count in zip(names, images, strict=True):
            if name != pipeline.operation.name:
                held, new_route = new_route or held, []
                mark_saved(pipeline)
                pipeline.change(operation=name)
            matches = process(pipeline, route[first : first + count], first=first)
            new = list(range(first + 1, first + count + 1))
            first += count
            if name == 'mapping':
                held = held + new
                indices = [held.index(stamp) for stamp in new]
                assert [result.image_index for result in matches] == indices
            elif name == 'loop_closure':
                new_route = new_route + new
            elif not held:
                assert set(statuses(matches)) <= {Status.NOT_READY}
            places = new_route if name == 'loop_closure' else held
            assert stamps_of(pipeline.places) == places, names
            if new_route or held:
                assert stamps_of(pipeline.snapshot().places) == (new_route or held)
            state = 'growing' if name != 'localization' else 'loaded' if held else 'none'
            assert (pipeline.operation.name, pipeline.operation.map_state) == (name, state)


def test_change_that_would_lose_unsaved_places_is_rejected(map_file, route):
    pipeline = Pipeline(settings_of(), 'mapping')
    process(pipeline, route[:7])
    loaded = read_map(map_file, pipeline.settings)
    for change in ({'operation': 'loop_closure'}, {'loaded': loaded}):
        with pytest.raises(InputError, match='7 places that are not saved'):
            pipeline.change(**change)
        assert (pipeline.operation.name, len(pipeline.places)) == ('mapping', 7)
        assert pipeline.save_state.path == ''
    pipeline.change(operation='localization')
    assert (len(pipeline.places), pipeline.unsaved) == (7, 7)
    pipeline.change(loaded=loaded)  # discards them
    assert (len(pipeline.places), pipeline.save_state.path, pipeline.unsaved) == (60, map_file, 0)
    pipeline.change(operation='loop_closure')
    process(pipeline, route[:3])
    with pytest.raises(InputError, match='recorded route would be lost'):
        pipeline.change(loaded=loaded)
    assert len(pipeline.places) == 3
    pipeline.change(operation='localization')
    assert (len(pipeline.places), pipeline.save_state.path, pipeline.unsaved) == (3, '', 3)
    with pytest.raises(InputError, match='3 places that are not saved'):
        pipeline.change(operation='loop_closure')
    pipeline.change(operation='localization', loaded=loaded)
    pipeline.change(operation='mapping')
    process(pipeline, route[4:5])
    mark_saved(pipeline)
    pipeline.change(loaded=loaded)
    assert (len(pipeline.places), pipeline.save_state.path) == (60, map_file)


def test_change_of_operation_that_fails_changes_nothing(map_file, route):
    pipeline = localizing(map_file, max_places=50)  # less than the map: it cannot be extended
    process(pipeline, route[:LENGTH])
    places = pipeline.places
    loaded = read_map(map_file, pipeline.settings)
    for name, places_of, error, words in (
        ('teleport', None, SettingsError, 'localization, mapping, loop_closure'),
        ('mapping', None, InputError, 'a map of 60 places does not fit'),
        ('mapping', loaded, InputError, 'a map of 60 places does not fit'),
    ):
        with pytest.raises(error, match=words):
            pipeline.change(replace(pipeline.settings, min_probability=0.9), name, places_of)
        assert (pipeline.operation.name, pipeline.places) == ('localization', places)
        assert pipeline.operation.window_fill == LENGTH
        assert pipeline.operation.threshold == 1 - MIN_PROBABILITY
    assert process(pipeline, route[5:6], first=5)[0].match.newest == 5
    pipeline.change(operation='localization')  # the current one: the window stays
    assert process(pipeline, route[6:7], first=6)[0].match.newest == 6


def test_loop_closure_takes_the_kind_of_features_of_the_map(map_file, route):
    pipeline = Pipeline(settings_of(), 'loop_closure')
    pipeline.change(loaded=read_map(map_file, pipeline.settings))
    # the route has no file
    assert (len(pipeline.places), pipeline.save_state.path) == (0, '')
    assert pipeline.operation.extractor.settings.projection is not None
    pipeline.change(operation='localization')
    assert (len(pipeline.places), pipeline.save_state.path) == (60, map_file)
    pipeline.change(operation='loop_closure')
    process(pipeline, route[:8])
    assert pipeline.places.features.strips.shape == (7, 8, 64)
    assert not pipeline.save_state.own_version(map_file)


CERTAIN = 7  # images after which the place is probable, in loop closure, too
CONFIRMED = 11  # images after which its path is confirmed


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_min_probability_and_candidates_change_with_a_full_window(operation, route):
    pipeline = record(route, operation, candidates=3)
    result = process(pipeline, route[:CONFIRMED])[-1]
    assert (result.match.status, len(result.candidates)) == (Status.MATCH, 3)
    assert result.candidates[0].place == result.match.path.place
    strict = 1 - 1e-9
    pipeline.change(replace(pipeline.settings, min_probability=strict, candidates=0))
    result = process(pipeline, route[11:12], first=11)[0]
    assert (result.match.status, result.candidates) == (Status.NO_MATCH, ())
    assert result.match.threshold == 1 - strict
    pipeline.change(replace(pipeline.settings, min_probability=0.1, candidates=1))
    result = process(pipeline, route[12:13], first=12)[0]
    assert (result.match.newest, result.match.threshold) == (12, 0.9)
    assert len(result.candidates) == 1
    result = pipeline.operation.process(message(route[13]), 14, list_candidates=False)
    assert result.candidates == ()
    pipeline.change(replace(pipeline.settings, min_probability=0.5, max_error=0.01))
    result = process(pipeline, route[13:14], first=13)[0]
    assert result.match.threshold == pytest.approx(0.5)


def test_keyframe_rules_change_and_the_last_keyframe_stays(map_file, route):
    pipeline = localizing(map_file, keyframes=KeyframeSettings(change=0.01))
    matches = process(pipeline, [route[0]] * 3 + route[1:LENGTH], poses=True)
    skipped = [result.cause == 'not a keyframe' for result in matches]
    assert skipped == [False, True, True, *[False] * 4]
    assert matches[-1].match.window_stamps == tuple(stamp * SECOND for stamp in (1, 4, 5, 6, 7))
    pipeline.change(replace(pipeline.settings, keyframes=KeyframeSettings(interval=2.0)))
    matches = process(pipeline, route[5:7], first=7)
    assert statuses(matches) == [Status.SKIPPED, Status.MATCH]
    pipeline.change(replace(pipeline.settings, keyframes=KeyframeSettings(distance=3.0)))
    assert process(pipeline, route[7:8], first=9)[0].cause == 'no odometry'
    # the last keyframe has no pose, so that the next image is one; then it is every third meter
    matches = process(pipeline, route[8:14], first=10, poses=True)
    assert [result.match.status is Status.SKIPPED for result in matches] == [False, True, True] * 2


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_geometric_check_in_mode_paper_accepts_and_rejects(operation, route):
    pipeline = record(route, operation, candidates=2, mode='paper', threshold=1.0)
    assert {result.match.inliers for result in process(pipeline, route[:CERTAIN])} == {-1}
    check = GeometricSettings(min_inliers=100)
    pipeline.change(replace(pipeline.settings, geometric=check))
    # the middle of a window of 5: the images until then came without a check
    process(pipeline, route[7:9], first=7)
    accepted = process(pipeline, route[9:10], first=9)[0].match
    assert (accepted.status, accepted.reason, accepted.place) == (Status.MATCH, '', 7)
    found = PlaceVerifier(check).inliers(thumbnail_of(route[7]), pipeline.places, 7)
    assert accepted.inliers == found >= 100
    pipeline.operation.reset()
    process(pipeline, route[: CERTAIN + 2])  # the same images again
    pipeline.change(replace(pipeline.settings, geometric=replace(check, min_inliers=found + 1)))
    result = process(pipeline, route[9:10], first=9)[0]
    match = result.match
    assert (match.status, match.inliers, match.place) == (Status.NO_MATCH, found, -1)
    assert f'{found} inliers are fewer than {found + 1}' in match.reason
    assert result.candidates[0].place == match.path.place
    pipeline.change(replace(pipeline.settings, geometric=None))
    assert statuses(process(pipeline, route[10:11], first=10)) == [Status.MATCH]


@pytest.mark.parametrize('least', [8, 100_000])
def test_geometric_check_in_mode_robust_weighs_doubtful_matches(map_file, route, least):
    rng = np.random.default_rng(0)
    noisy = [
        cv2.addWeighted(x, 0.75, rng.integers(0, 256, x.shape, np.uint8), 0.25, 0) for x in route
    ]
    plain = process(localizing(map_file, candidates=2), noisy[:LENGTH])[-1]
    limit = plain.match.probability  # just not above itself
    check = GeometricSettings(min_inliers=least)
    pipeline = localizing(map_file, geometric=check, min_probability=limit, candidates=2)
    result = process(pipeline, noisy[:LENGTH])[-1]
    assert 0.1 < plain.match.probability < 0.99
    assert result.match.inliers >= 8
    expected = GeometricEvidence().update_probability(plain.match.probability, least == 8)
    assert result.match.probability == pytest.approx(expected)
    assert result.match.status is (Status.MATCH if least == 8 else Status.NO_MATCH)
    assert bool(result.match.reason) == (least != 8)
    assert result.match.distance == result.candidates[0].distance == 1 - result.match.probability
    assert result.match.path.place == plain.match.path.place == result.candidates[0].place
    assert result.match.path.probability == plain.match.probability  # by the images alone


def test_geometric_check_decides_each_late_match(route, monkeypatch):
    """Where it rejects the match that they come with, too."""
    check = GeometricSettings(min_inliers=8)

    def closing(**changes):
        pipeline = record(route, 'loop_closure', **changes)
        (result,) = (r for r in process(pipeline, route[:12], first=30) if r.match.late)
        return pipeline.places, result

    places, result = closing(geometric=check)
    assert result.match.accepted
    for late in result.match.late:
        query = places.thumbnail(late.first_image + late.position)
        output = PlaceVerifier(check).inliers(query, places, late.place)
        assert late.inliers == output >= 8
    rejected = {result.match.place, result.match.late[0].place}
    monkeypatch.setattr(PlaceVerifier, 'inliers', lambda *given: 8 * (given[3] not in rejected))
    _, other = closing(geometric=check)
    assert not other.match.accepted
    left = [late.place for late in result.match.late if late.place not in rejected]
    assert [late.place for late in other.match.late] == left != []


def test_geometric_check_without_thumbnails_changes_nothing(small_map, route, tmp_path):
    save_map(replace(small_map, thumbnails=()), tmp_path / 'blind.stavpr')
    pipeline = localizing(str(tmp_path / 'blind.stavpr'), geometric=GeometricSettings())
    result = process(pipeline, route[:CERTAIN])[-1]
    assert (result.match.status, result.match.inliers) == (Status.MATCH, -1)


class Failing:
    """A function that raises ``error`` while that is set."""

    def __init__(self, function):
        self.function, self.error = function, None

    def __call__(self, *arguments):
        if self.error is not None:
            raise self.error
        return self.function(*arguments)


@pytest.mark.parametrize('operation', OPERATIONS)
def test_process_of_an_invalid_image_changes_nothing(operation, route, monkeypatch):
    """
    Another pipeline gets the valid images only: both return the same for these.

    Each image fails before it is valid: if it counted as a keyframe, it would then be skipped.
    """
    keyframes = KeyframeSettings(change=0.01)
    pipeline, other = (record(route, operation, keyframes=keyframes) for _ in range(2))
    extract = Failing(pipeline.operation.extractor.extract)
    pipeline.operation.extractor.extract = extract
    thumbnail = Failing(lambda image: b'')
    monkeypatch.setattr('stavpr_ros.pipeline.operations.encode_thumbnail', thumbnail)
    cut_off = message(route[0])
    object.__setattr__(cut_off, 'data', cut_off.data[:100])
    for i, image in enumerate(route[:12] if operation != 'mapping' else route[30:42]):
        broken = pipeline.operation.process(cut_off, i)
        assert (broken.match.status, broken.cause) == (Status.INVALID_IMAGE, 'invalid: cut off')
        extract.error = ImageError('not finite', kind='features')
        broken = pipeline.operation.process(message(image), i)
        assert (broken.cause, broken.match.reason) == ('invalid: features', 'not finite')
        extract.error = None
        if operation != 'localization':
            thumbnail.error = InputError('no JPEG')
            assert pipeline.operation.process(message(image), i).cause == 'invalid: InputError'
            thumbnail.error = None
        with pytest.raises(InputError, match='quaternion of norm 0'):
            pipeline.operation.process(message(image), i, np.zeros(7))
        good, expected = (
            process(p, [image], first=50 + i, poses=True)[0] for p in (pipeline, other)
        )
        for name in ('image_index', 'candidates'):
            assert getattr(good, name) == getattr(expected, name)
        assert repr(good.match) == repr(expected.match)
        if operation != 'mapping':
            assert good.match.window_stamps == expected.match.window_stamps
    assert stamps_of(pipeline.places) == stamps_of(other.places)
    assert good.match.status is not Status.WARMING_UP


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_reset_empties_the_window_and_keeps_the_places(operation, route):
    pipeline = record(route, operation, keyframes=KeyframeSettings(change=0.01))
    process(pipeline, route[:LENGTH])
    assert pipeline.operation.window_fill == LENGTH
    places = len(pipeline.places)
    pipeline.operation.reset()
    assert (pipeline.operation.window_fill, len(pipeline.places)) == (0, places)
    # the first equals the last keyframe
    matches = process(pipeline, route[4 : 4 + LENGTH], first=100)
    waiting = statuses(matches).count(Status.WARMING_UP)
    result = Status.NO_MATCH if operation == 'loop_closure' else Status.MATCH  # not confirmed yet
    assert statuses(matches) == [Status.WARMING_UP] * waiting + [result] * (5 - waiting)
    assert waiting == 4 if operation == 'loop_closure' else 1 <= waiting <= 4
    assert matches[-1].match.window_stamps == tuple((101 + i) * SECOND for i in range(LENGTH))
    if operation == 'loop_closure':
        assert matches[-1].match.first_image == places
    assert matches[-1].match.path.pairs[-1].tolist() == [4, 8]
