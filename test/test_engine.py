"""The engine without ROS: what each operation does, and how one becomes another."""

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from conftest import route_images
from engines import (
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

from stavpr_ros.alignment import SpatialSettings
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import Describer
from stavpr_ros.mapping import save_map
from stavpr_ros.operation import OPERATIONS, Answer, Engine, place_facts, read_map
from stavpr_ros.operation.outcome import place_picture
from stavpr_ros.recognition import Recogniser


@pytest.fixture(scope='module', autouse=True)
def _one_thread():
    with one_thread():
        yield


@pytest.mark.parametrize(('mode', 'threshold'), [('paper', 0.2), ('robust', None)])
def test_localization_is_the_recogniser(map_file, small_map, route, mode, threshold):
    engine = localizing(map_file, mode=mode, threshold=threshold)
    images = route[20:32] + route_images(4, seed=9)
    core = Recogniser(small_map, engine.settings.recognition(threshold or 1.0))
    outcomes = show(engine, images)
    for i, outcome in enumerate(outcomes):
        recognition = core.add(engine.describer.describe([images[i]]))
        assert outcome.answer.name.replace('_', ' ').lower() == recognition.verdict.value
        assert repr(outcome.recognition.nearest) == repr(recognition.nearest)
        np.testing.assert_array_equal(outcome.recognition.path, recognition.path)
        assert outcome.window == tuple((j + 1) * SECOND for j in range(max(0, i - 4), i + 1))
        assert (outcome.newest, outcome.first_image, outcome.inliers) == (-1, -1, -1)
        assert outcome.places is engine.places
        assert outcome.threshold == (threshold or 1.0)
        assert set(outcome.stages) == {'decoding', 'description', 'matching', 'check'}
    assert answers(outcomes).count(Answer.MATCH) >= 8
    assert (engine.map_state, engine.window_fill, engine.missing) == ('loaded', LENGTH, '')


def test_what_is_missing_is_said(map_file, route):
    engine = Engine(settings_of(mode='paper'))
    assert (engine.map_state, engine.places, engine.window_fill) == ('none', None, 0)
    assert 'map_path' in engine.missing
    (outcome,) = show(engine, route[:1])
    assert (outcome.answer, outcome.reason) == (Answer.NOT_READY, engine.missing)
    assert outcome.cause == 'not ready'
    engine.use(read_map(map_file, engine.settings))
    assert (engine.map_state, len(engine.places)) == ('loaded', 60)
    assert 'threshold' in engine.missing
    assert show(engine, route[:1])[0].reason == engine.missing
    engine.change(replace(engine.settings, threshold=0.2))
    assert answers(show(engine, route[:LENGTH]))[-1] is Answer.MATCH
    engine.change(replace(engine.settings, threshold=None))
    assert answers(show(engine, route[:1])) == [Answer.NOT_READY]
    assert engine.map_state == 'loaded'


def test_mapping_grows_a_map_with_all_that_is_known(route):
    engine = Engine(settings_of(thumbnail_width=64), 'mapping')
    assert (engine.map_state, engine.missing, len(engine.places)) == ('growing', '', 0)
    outcomes = show(engine, route[:4], poses=True) + show(engine, route[4:8], first=4)
    assert answers(outcomes) == [Answer.MAPPED] * 8
    assert [outcome.newest for outcome in outcomes] == list(range(8))
    assert all(outcome.recognition is None and outcome.reason == '' for outcome in outcomes)
    grown = engine.places_as_map()
    assert stamps_of(grown) == list(range(1, 9))
    np.testing.assert_array_equal(grown.poses[:4], [at(i) for i in range(4)])
    assert np.isnan(grown.poses[4:]).all()
    described = Describer().describe(route[:8])
    torch.testing.assert_close(grown.features.strips, described.strips, atol=1e-6, rtol=0)
    picture = grown.thumbnail(3)
    assert picture.shape == (48, 64, 3)
    small = cv2.resize(route[3], (64, 48), interpolation=cv2.INTER_AREA).astype(float)
    assert np.abs(picture - small).mean() < 20 < np.abs(grown.thumbnail(5) - small).mean()


def test_a_map_that_is_full_is_left_as_it_is(route):
    engine = Engine(settings_of(max_places=100), 'mapping')
    outcomes = show(engine, (route + route)[:103])
    assert answers(outcomes) == [Answer.MAPPED] * 100 + [Answer.NOT_READY] * 3
    assert outcomes[-1].cause == 'map full'
    assert 'max_places = 100' in outcomes[-1].reason
    assert (engine.map_state, stamps_of(engine.places_as_map())) == ('full', list(range(1, 101)))
    engine.set_operation('localization')
    assert len(engine.places) == 100


def test_mapping_continues_a_map(map_file, small_map, route):
    engine = Engine(settings_of(), 'mapping')
    engine.use(read_map(map_file, engine.settings))
    assert len(engine.places) == 60
    (outcome,) = show(engine, route[:1], first=60)
    assert (outcome.answer, outcome.newest) == (Answer.MAPPED, 60)
    grown = engine.places_as_map()
    assert stamps_of(grown) == list(range(1, 62))
    assert grown.ids[:60] == small_map.ids
    torch.testing.assert_close(grown.features.strips[:, :60], small_map.features.strips, atol=0, rtol=0)


@pytest.mark.parametrize('exclude_seconds', [0.0, 30.0])
def test_loop_closure_is_the_loop_closer(route, exclude_seconds):
    engine = Engine(settings_of(exclude_seconds=exclude_seconds), 'loop_closure')
    images = route[:40] * 2
    core = engine.settings.loop_closer(engine.describer, 0.8)
    for i, outcome in enumerate(show(engine, images, poses=True)):
        recognition = core.add(engine.describer.describe([images[i]]), (i + 1) * SECOND)
        assert outcome.recognition.verdict is recognition.verdict
        assert repr(outcome.recognition.nearest) == repr(recognition.nearest)
        np.testing.assert_array_equal(outcome.recognition.path, recognition.path)
        assert (outcome.newest, len(outcome.window)) == (i, min(i + 1, LENGTH))
        assert outcome.first_image == max(0, i - LENGTH + 1)
        if recognition.nearest is not None:
            assert recognition.path[:, 1].max() <= i - max(EXCLUDED, exclude_seconds)
        if i >= 40 + LENGTH:
            assert (outcome.answer, recognition.newest) == (Answer.MATCH, i - 40)
    assert (engine.map_state, len(engine.places)) == ('growing', 80)


def test_loop_closure_forgets_and_indices_stay(route):
    """At most 100 places: every index of every answer means the image that it meant when it came."""
    engine = Engine(settings_of(max_places=100, candidates=4), 'loop_closure')
    images = route * 4
    closed, firsts = 0, set()
    for i, image in enumerate(images):
        (outcome,) = show(engine, [image], first=i, poses=True)
        first = outcome.places.first
        firsts.add(first)
        assert len(outcome.places) <= 100
        assert (outcome.newest, first + len(outcome.places) - 1) == (i, i)
        told = {outcome.newest, *(candidate.place for candidate in outcome.candidates)}
        if outcome.answer is Answer.MATCH:
            told |= {int(place) for place in outcome.recognition.path[:, 1]}
            assert min(told) >= first
            if i >= 60 + LENGTH:
                assert outcome.recognition.newest == i - 60
                closed += 1
        for place in told:
            facts = place_facts(outcome.places, place)
            assert (facts.stamp, facts.pose[0]) == ((place + 1) * SECOND, place)
    assert closed == 240 - 60 - LENGTH
    assert firsts == set(range(0, 145, 12))  # an eighth of 100 at a time
    for place in (150, 200, 239):
        kept = place_picture(engine.places, place).astype(float)
        assert np.abs(kept - images[place]).mean() < 20 < np.abs(kept - images[place - 5]).mean()
    saved = engine.places_as_map()
    assert stamps_of(saved) == list(range(145, 241))


# ------------------------------------------------ from one to another


@pytest.mark.parametrize('images', [(6, 0, 6), (0, 6, 0), (6, 6, 6)])
def test_every_change_of_operation(route, images):
    """A grown route is the map from then on, an empty one loses nothing: against a list of stamps."""
    for names in itertools.product(OPERATIONS, repeat=3):
        engine = Engine(settings_of(), names[0])
        held, grown, came, full = [], [], 0, 0
        for name, count in zip(names, images, strict=True):
            if name != engine.operation:
                held, grown, full = grown or held, [], 0
                as_if_saved(engine)
                engine.set_operation(name)
            assert engine.operation == name
            outcomes = show(engine, route[came : came + count], first=came)
            new = list(range(came + 1, came + count + 1))
            came += count
            if name == 'mapping':
                held = held + new
                assert set(answers(outcomes)) <= {Answer.MAPPED}
                assert [outcome.newest for outcome in outcomes] == [held.index(stamp) for stamp in new]
            elif name == 'loop_closure':
                grown = grown + new
                assert set(answers(outcomes)) <= {Answer.WARMING_UP, Answer.NO_MATCH}
            elif not held:
                assert set(answers(outcomes)) <= {Answer.NOT_READY}
            else:
                warming = min(count, max(0, LENGTH - 1 - full))
                assert answers(outcomes)[: warming + 1].count(Answer.WARMING_UP) == warming
                full += count
            assert stamps_of(engine.places_as_map()) == (grown or held), names
            shown = held if name != 'loop_closure' else grown
            assert (0 if engine.places is None else len(engine.places)) == len(shown)
            assert engine.map_state == {
                'localization': 'loaded' if held else 'none', 'mapping': 'growing', 'loop_closure': 'growing'
            }[name]  # fmt: skip


def test_no_places_are_lost_unless_they_were_given_up(map_file, route):
    engine = Engine(settings_of(), 'mapping')
    show(engine, route[:7])
    loaded = read_map(map_file, engine.settings)
    for change in ({'operation': 'loop_closure'}, {'loaded': loaded}):
        with pytest.raises(InputError, match='7 places that are not saved'):
            engine.change(**change)
        assert (engine.operation, len(engine.places), engine.path) == ('mapping', 7, '')
    engine.set_operation('localization')
    assert (len(engine.places), engine.unsaved) == (7, 7)
    engine.use(loaded)  # given up
    assert (len(engine.places), engine.path, engine.unsaved) == (60, map_file, 0)
    engine.set_operation('loop_closure')
    show(engine, route[:3])
    with pytest.raises(InputError, match='route so far would be lost'):
        engine.use(loaded)
    assert len(engine.places) == 3
    engine.set_operation('localization')
    assert (len(engine.places), engine.path, engine.unsaved) == (3, '', 3)  # no file holds this map
    with pytest.raises(InputError, match='3 places that are not saved'):
        engine.set_operation('loop_closure')
    engine.change(operation='localization', loaded=loaded)
    assert engine.path == map_file


def test_a_grown_map_recognises(route):
    engine = Engine(settings_of(), 'mapping')
    show(engine, route[:40])
    engine.set_operation('localization')
    outcomes = show(engine, route[10:20])
    assert answers(outcomes) == [Answer.WARMING_UP] * 4 + [Answer.MATCH] * 6
    assert [outcome.recognition.newest for outcome in outcomes[4:]] == list(range(14, 20))
    engine.set_operation('mapping')
    assert show(engine, route[40:41], first=40)[0].newest == 40


def test_an_operation_that_does_not_do_changes_nothing(map_file, route):
    engine = localizing(map_file, max_places=50)  # fewer than the map has: it cannot be continued
    show(engine, route[:LENGTH])
    places = engine.places
    for name, error, words in (
        ('teleport', SettingsError, 'localization, mapping, loop_closure'),
        ('mapping', InputError, 'a map of 60 places does not fit'),
    ):
        with pytest.raises(error, match=words):
            engine.set_operation(name)
        assert (engine.operation, engine.places, engine.window_fill) == ('localization', places, LENGTH)
    assert show(engine, route[5:6], first=5)[0].recognition.newest == 5
    engine.set_operation('localization')  # it is that already: the window stays
    assert show(engine, route[6:7], first=6)[0].recognition.newest == 6


@pytest.mark.parametrize('operation', OPERATIONS)
def test_a_map_that_does_not_fit_changes_nothing(operation, small_map, map_file, route, tmp_path):
    """Three strips, and xi = 5 (localization, loop closure); more places than max_places (mapping)."""
    engine = Engine(settings_of(spatial=SpatialSettings(xi=5), max_places=100), operation)
    engine.use(read_map(map_file, engine.settings))
    few = Engine(settings_of(max_places=120), 'mapping')
    few.use(read_map(map_file, few.settings))
    show(few, route[:50])
    path = str(tmp_path / 'bad.stavpr')
    if operation == 'mapping':
        few.save(path, overwrite=False)
    else:
        three = Describer(strips=3)
        narrow = replace(small_map, features=three.describe(route), projection=None)
        save_map(narrow, path)
    show(engine, route[:LENGTH])
    engine.save(str(tmp_path / 'saved.stavpr'), overwrite=False)
    before = (engine.places, len(engine.places), engine.describer, engine.window_fill, engine.path)
    loaded = read_map(path, engine.settings)
    with pytest.raises((InputError, SettingsError)):
        engine.use(loaded)
    assert (engine.places, len(engine.places), engine.describer, engine.window_fill, engine.path) == before
    outcome = show(engine, route[5:6], first=5)[0]
    expected = {'localization': Answer.MATCH, 'mapping': Answer.MAPPED, 'loop_closure': Answer.NO_MATCH}
    assert outcome.answer is expected[operation]


def test_a_map_in_loop_closure_gives_the_kind_of_features(map_file, route):
    engine = Engine(settings_of(), 'loop_closure')
    engine.use(read_map(map_file, engine.settings))
    assert (len(engine.places), engine.path) == (0, '')  # the map's file is not the route's
    assert engine.describer.settings.projection is not None
    engine.set_operation('localization')
    assert (len(engine.places), engine.path) == (60, map_file)
    engine.set_operation('loop_closure')
    show(engine, route[:8])
    assert engine.places.features.strips.shape == (7, 8, 64)
    assert stamps_of(engine.places_as_map()) == list(range(1, 9))
    assert not engine.filing.owns(map_file)


def test_a_grown_map_is_not_lost_to_another(map_file, route, tmp_path):
    engine = Engine(settings_of(), 'mapping')
    show(engine, route[:4])
    loaded = read_map(map_file, engine.settings)
    with pytest.raises(InputError, match='4 places that are not saved'):
        engine.use(loaded)
    assert len(engine.places) == 4
    engine.save(str(tmp_path / 'grown.stavpr'), overwrite=False)
    engine.use(loaded)
    assert (len(engine.places), engine.path) == (60, map_file)
    show(engine, route[4:5])
    engine.set_operation('localization')
    assert (engine.unsaved, len(engine.places)) == (1, 61)
    engine.use(loaded)  # given up
    assert (engine.unsaved, len(engine.places)) == (0, 60)
