# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The operations of the pipeline, and the changes between them; without ROS."""

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
    MIN_PROBABILITY,
    process,
    recorded,
    SECOND,
    settings_of,
    stamps_of,
    statuses,
)
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import save_map, Session
from stavpr_ros.method import PlaceRecognizer, Status
from stavpr_ros.method.loop_closer import LoopCloser
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
    pipeline = recorded(route, operation)
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
    pipeline = recorded(route, 'localization', 60, sequence=SequenceSettings(12))
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
    # the map file is not that of the route
    assert (len(pipeline.places), pipeline.save_state.path) == (0, '')
    assert pipeline.operation.extractor.settings.projection is not None
    pipeline.change(operation='localization')
    assert (len(pipeline.places), pipeline.save_state.path) == (60, map_file)
    pipeline.change(operation='loop_closure')
    process(pipeline, route[:8])
    assert pipeline.places.features.strips.shape == (7, 8, 64)
    assert not pipeline.save_state.owned(map_file)
