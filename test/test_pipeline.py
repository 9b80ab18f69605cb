"""The pipeline without ROS: what each operation does, and how one becomes another."""

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from conftest import route_images
from pipelines import (
    EXCLUDED,
    LENGTH,
    SECOND,
    answers,
    as_if_saved,
    at,
    localizing,
    one_thread,
    settings_of,
    show,
    stamps_of,
)
from stavpr_ros.pipeline.outcome import place_picture

from stavpr_ros.alignment import SpatialSettings
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import save_map
from stavpr_ros.pipeline import OPERATIONS, Pipeline, Status, place_facts, read_map
from stavpr_ros.recognition import PlaceRecognizer


@pytest.fixture(scope='module', autouse=True)
def _one_thread():
    with one_thread():
        yield


@pytest.mark.parametrize(('mode', 'threshold'), [('paper', 0.2), ('robust', None)])
def test_localization_is_the_recognizer(map_file, small_map, route, mode, threshold):
    pipeline = localizing(map_file, mode=mode, threshold=threshold)
    images = route[20:32] + route_images(4, seed=9)
    core = PlaceRecognizer(small_map, pipeline.settings.recognition(threshold or 1.0))
    outcomes = show(pipeline, images)
    for i, outcome in enumerate(outcomes):
        recognition = core.add(pipeline.extractor.extract([images[i]]))
        assert outcome.status.name.replace('_', ' ').lower() == recognition.status.value
        assert repr(outcome.sequence) == repr(recognition.sequence)
        np.testing.assert_array_equal(outcome.path, recognition.path)
        assert outcome.window_stamps == tuple((j + 1) * SECOND for j in range(max(0, i - 4), i + 1))
        assert (outcome.image_index, outcome.first_image_index, outcome.inliers) == (-1, -1, -1)
        assert outcome.places is pipeline.places
        assert outcome.threshold == (threshold or 1.0)
        assert set(outcome.stages) == {'decoding', 'description', 'matching', 'check'}
    assert answers(outcomes).count(Status.MATCH) >= 8
    assert (pipeline.map_state, pipeline.window_fill, pipeline.missing) == ('loaded', LENGTH, '')


def test_what_is_missing_is_said(map_file, route):
    pipeline = Pipeline(settings_of(mode='paper'))
    assert (pipeline.map_state, pipeline.places, pipeline.window_fill) == ('none', None, 0)
    assert 'map_path' in pipeline.missing
    (outcome,) = show(pipeline, route[:1])
    assert (outcome.status, outcome.reason) == (Status.NOT_READY, pipeline.missing)
    assert outcome.cause == 'not ready'
    pipeline.use(read_map(map_file, pipeline.settings))
    assert (pipeline.map_state, len(pipeline.places)) == ('loaded', 60)
    assert 'threshold' in pipeline.missing
    assert show(pipeline, route[:1])[0].reason == pipeline.missing
    pipeline.change(replace(pipeline.settings, threshold=0.2))
    assert answers(show(pipeline, route[:LENGTH]))[-1] is Status.MATCH
    pipeline.change(replace(pipeline.settings, threshold=None))
    assert answers(show(pipeline, route[:1])) == [Status.NOT_READY]
    assert pipeline.map_state == 'loaded'


def test_mapping_grows_a_map_with_all_that_is_known(route):
    pipeline = Pipeline(settings_of(thumbnail_width=64), 'mapping')
    assert (pipeline.map_state, pipeline.missing, len(pipeline.places)) == ('growing', '', 0)
    outcomes = show(pipeline, route[:4], poses=True) + show(pipeline, route[4:8], first=4)
    assert answers(outcomes) == [Status.MAPPED] * 8
    assert [outcome.image_index for outcome in outcomes] == list(range(8))
    assert all(outcome.recognition is None and outcome.reason == '' for outcome in outcomes)
    grown = pipeline.places_as_map()
    assert stamps_of(grown) == list(range(1, 9))
    np.testing.assert_array_equal(grown.poses[:4], [at(i) for i in range(4)])
    assert np.isnan(grown.poses[4:]).all()
    described = FeatureExtractor().extract(route[:8])
    torch.testing.assert_close(grown.features.strips, described.strips, atol=1e-6, rtol=0)
    picture = grown.thumbnail(3)
    assert picture.shape == (48, 64, 3)
    small = cv2.resize(route[3], (64, 48), interpolation=cv2.INTER_AREA).astype(float)
    assert np.abs(picture - small).mean() < 20 < np.abs(grown.thumbnail(5) - small).mean()


def test_a_map_that_is_full_is_left_as_it_is(route):
    pipeline = Pipeline(settings_of(max_places=100), 'mapping')
    outcomes = show(pipeline, (route + route)[:103])
    assert answers(outcomes) == [Status.MAPPED] * 100 + [Status.NOT_READY] * 3
    assert outcomes[-1].cause == 'map full'
    assert 'max_places = 100' in outcomes[-1].reason
    assert (pipeline.map_state, stamps_of(pipeline.places_as_map())) == ('full', list(range(1, 101)))
    pipeline.set_operation('localization')
    assert len(pipeline.places) == 100


def test_mapping_continues_a_map(map_file, small_map, route):
    pipeline = Pipeline(settings_of(), 'mapping')
    pipeline.use(read_map(map_file, pipeline.settings))
    assert len(pipeline.places) == 60
    (outcome,) = show(pipeline, route[:1], first=60)
    assert (outcome.status, outcome.image_index) == (Status.MAPPED, 60)
    grown = pipeline.places_as_map()
    assert stamps_of(grown) == list(range(1, 62))
    assert grown.ids[:60] == small_map.ids
    torch.testing.assert_close(grown.features.strips[:, :60], small_map.features.strips, atol=0, rtol=0)


@pytest.mark.parametrize('exclude_seconds', [0.0, 30.0])
def test_loop_closure_is_the_loop_closer(route, exclude_seconds):
    pipeline = Pipeline(settings_of(exclude_seconds=exclude_seconds), 'loop_closure')
    images = route[:40] * 2
    core = pipeline.settings.loop_closer(pipeline.extractor, 0.8)
    for i, outcome in enumerate(show(pipeline, images, poses=True)):
        recognition = core.add(pipeline.extractor.extract([images[i]]), (i + 1) * SECOND)
        assert outcome.recognition.status is recognition.status
        assert repr(outcome.sequence) == repr(recognition.sequence)
        np.testing.assert_array_equal(outcome.path, recognition.path)
        assert (outcome.image_index, len(outcome.window_stamps)) == (i, min(i + 1, LENGTH))
        assert outcome.first_image_index == max(0, i - LENGTH + 1)
        if recognition.sequence is not None:
            assert recognition.path[:, 1].max() <= i - max(EXCLUDED, exclude_seconds)
        if i >= 40 + LENGTH:
            assert (outcome.status, recognition.newest_index) == (Status.MATCH, i - 40)
    assert (pipeline.map_state, len(pipeline.places)) == ('growing', 80)


def test_loop_closure_forgets_and_indices_stay(route):
    """At most 100 places: every index of every answer means the image that it meant when it came."""
    pipeline = Pipeline(settings_of(max_places=100, candidates=4), 'loop_closure')
    images = route * 4
    closed, firsts = 0, set()
    for i, image in enumerate(images):
        (outcome,) = show(pipeline, [image], first=i, poses=True)
        first = outcome.places.first
        firsts.add(first)
        assert len(outcome.places) <= 100
        assert (outcome.image_index, first + len(outcome.places) - 1) == (i, i)
        told = {outcome.image_index, *(candidate.place for candidate in outcome.candidates)}
        if outcome.status is Status.MATCH:
            told |= {int(place) for place in outcome.path[:, 1]}
            assert min(told) >= first
            if i >= 60 + LENGTH:
                assert outcome.newest_index == i - 60
                closed += 1
        for place in told:
            facts = place_facts(outcome.places, place)
            assert (facts.stamp, facts.pose[0]) == ((place + 1) * SECOND, place)
    assert closed == 240 - 60 - LENGTH
    assert firsts == set(range(0, 145, 12))  # an eighth of 100 at a time
    for place in (150, 200, 239):
        kept = place_picture(pipeline.places, place).astype(float)
        assert np.abs(kept - images[place]).mean() < 20 < np.abs(kept - images[place - 5]).mean()
    saved = pipeline.places_as_map()
    assert stamps_of(saved) == list(range(145, 241))


# ------------------------------------------------ from one to another


@pytest.mark.parametrize('images', [(6, 0, 6), (0, 6, 0), (6, 6, 6)])
def test_every_change_of_operation(route, images):
    """A grown route is the map from then on, an empty one loses nothing: against a list of stamps."""
    for names in itertools.product(OPERATIONS, repeat=3):
        pipeline = Pipeline(settings_of(), names[0])
        held, grown, came, full = [], [], 0, 0
        for name, count in zip(names, images, strict=True):
            if name != pipeline.operation:
                held, grown, full = grown or held, [], 0
                as_if_saved(pipeline)
                pipeline.set_operation(name)
            assert pipeline.operation == name
            outcomes = show(pipeline, route[came : came + count], first=came)
            new = list(range(came + 1, came + count + 1))
            came += count
            if name == 'mapping':
                held = held + new
                assert set(answers(outcomes)) <= {Status.MAPPED}
                assert [outcome.image_index for outcome in outcomes] == [held.index(stamp) for stamp in new]
            elif name == 'loop_closure':
                grown = grown + new
                assert set(answers(outcomes)) <= {Status.WARMING_UP, Status.NO_MATCH}
            elif not held:
                assert set(answers(outcomes)) <= {Status.NOT_READY}
            else:
                warming = min(count, max(0, LENGTH - 1 - full))
                assert answers(outcomes)[: warming + 1].count(Status.WARMING_UP) == warming
                full += count
            assert stamps_of(pipeline.places_as_map()) == (grown or held), names
            shown = held if name != 'loop_closure' else grown
            assert (0 if pipeline.places is None else len(pipeline.places)) == len(shown)
            assert pipeline.map_state == {
                'localization': 'loaded' if held else 'none', 'mapping': 'growing', 'loop_closure': 'growing'
            }[name]  # fmt: skip


def test_no_places_are_lost_unless_they_were_given_up(map_file, route):
    pipeline = Pipeline(settings_of(), 'mapping')
    show(pipeline, route[:7])
    loaded = read_map(map_file, pipeline.settings)
    for change in ({'operation': 'loop_closure'}, {'loaded': loaded}):
        with pytest.raises(InputError, match='7 places that are not saved'):
            pipeline.change(**change)
        assert (pipeline.operation, len(pipeline.places), pipeline.path) == ('mapping', 7, '')
    pipeline.set_operation('localization')
    assert (len(pipeline.places), pipeline.unsaved) == (7, 7)
    pipeline.use(loaded)  # given up
    assert (len(pipeline.places), pipeline.path, pipeline.unsaved) == (60, map_file, 0)
    pipeline.set_operation('loop_closure')
    show(pipeline, route[:3])
    with pytest.raises(InputError, match='route so far would be lost'):
        pipeline.use(loaded)
    assert len(pipeline.places) == 3
    pipeline.set_operation('localization')
    assert (len(pipeline.places), pipeline.path, pipeline.unsaved) == (3, '', 3)  # no file holds this map
    with pytest.raises(InputError, match='3 places that are not saved'):
        pipeline.set_operation('loop_closure')
    pipeline.change(operation='localization', loaded=loaded)
    assert pipeline.path == map_file


def test_a_grown_map_recognizes(route):
    pipeline = Pipeline(settings_of(), 'mapping')
    show(pipeline, route[:40])
    pipeline.set_operation('localization')
    outcomes = show(pipeline, route[10:20])
    assert answers(outcomes) == [Status.WARMING_UP] * 4 + [Status.MATCH] * 6
    assert [outcome.newest_index for outcome in outcomes[4:]] == list(range(14, 20))
    pipeline.set_operation('mapping')
    assert show(pipeline, route[40:41], first=40)[0].image_index == 40


def test_an_operation_that_does_not_do_changes_nothing(map_file, route):
    pipeline = localizing(map_file, max_places=50)  # fewer than the map has: it cannot be continued
    show(pipeline, route[:LENGTH])
    places = pipeline.places
    for name, error, words in (
        ('teleport', SettingsError, 'localization, mapping, loop_closure'),
        ('mapping', InputError, 'a map of 60 places does not fit'),
    ):
        with pytest.raises(error, match=words):
            pipeline.set_operation(name)
        assert (pipeline.operation, pipeline.places, pipeline.window_fill) == ('localization', places, LENGTH)
    assert show(pipeline, route[5:6], first=5)[0].newest_index == 5
    pipeline.set_operation('localization')  # it is that already: the window stays
    assert show(pipeline, route[6:7], first=6)[0].newest_index == 6


@pytest.mark.parametrize('operation', OPERATIONS)
def test_a_map_that_does_not_fit_changes_nothing(operation, small_map, map_file, route, tmp_path):
    """Three strips, and xi = 5 (localization, loop closure); more places than max_places (mapping)."""
    pipeline = Pipeline(settings_of(spatial=SpatialSettings(xi=5), max_places=100), operation)
    pipeline.use(read_map(map_file, pipeline.settings))
    few = Pipeline(settings_of(max_places=120), 'mapping')
    few.use(read_map(map_file, few.settings))
    show(few, route[:50])
    path = str(tmp_path / 'bad.stavpr')
    if operation == 'mapping':
        few.save(path, overwrite=False)
    else:
        three = FeatureExtractor(strips=3)
        narrow = replace(small_map, features=three.extract(route), projection=None)
        save_map(narrow, path)
    show(pipeline, route[:LENGTH])
    pipeline.save(str(tmp_path / 'saved.stavpr'), overwrite=False)
    before = (pipeline.places, len(pipeline.places), pipeline.extractor, pipeline.window_fill, pipeline.path)
    loaded = read_map(path, pipeline.settings)
    with pytest.raises((InputError, SettingsError)):
        pipeline.use(loaded)
    assert (pipeline.places, len(pipeline.places), pipeline.extractor, pipeline.window_fill, pipeline.path) == before
    outcome = show(pipeline, route[5:6], first=5)[0]
    expected = {'localization': Status.MATCH, 'mapping': Status.MAPPED, 'loop_closure': Status.NO_MATCH}
    assert outcome.status is expected[operation]


def test_a_map_in_loop_closure_gives_the_kind_of_features(map_file, route):
    pipeline = Pipeline(settings_of(), 'loop_closure')
    pipeline.use(read_map(map_file, pipeline.settings))
    assert (len(pipeline.places), pipeline.path) == (0, '')  # the map's file is not the route's
    assert pipeline.extractor.settings.projection is not None
    pipeline.set_operation('localization')
    assert (len(pipeline.places), pipeline.path) == (60, map_file)
    pipeline.set_operation('loop_closure')
    show(pipeline, route[:8])
    assert pipeline.places.features.strips.shape == (7, 8, 64)
    assert stamps_of(pipeline.places_as_map()) == list(range(1, 9))
    assert not pipeline.save_state.owns(map_file)


def test_a_grown_map_is_not_lost_to_another(map_file, route, tmp_path):
    pipeline = Pipeline(settings_of(), 'mapping')
    show(pipeline, route[:4])
    loaded = read_map(map_file, pipeline.settings)
    with pytest.raises(InputError, match='4 places that are not saved'):
        pipeline.use(loaded)
    assert len(pipeline.places) == 4
    pipeline.save(str(tmp_path / 'grown.stavpr'), overwrite=False)
    pipeline.use(loaded)
    assert (len(pipeline.places), pipeline.path) == (60, map_file)
    show(pipeline, route[4:5])
    pipeline.set_operation('localization')
    assert (pipeline.unsaved, len(pipeline.places)) == (1, 61)
    pipeline.use(loaded)  # given up
    assert (pipeline.unsaved, len(pipeline.places)) == (0, 60)
