# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A folder of maps as one map, and a session that is recorded on a map; without ROS."""

from dataclasses import replace

from fixtures import route_images
import numpy as np
from pipelines import at, localizing, message, process, save, SECOND, settings_of
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import MapFileError, SettingsError
from stavpr_ros.maintenance.same_places import SURE, with_last_related, with_same_places
from stavpr_ros.mapping import load_map, PlaceMap, save_map
from stavpr_ros.mapping.journal_map import journals, recover
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.method import Status
from stavpr_ros.pipeline import Pipeline, read_map

pytestmark = pytest.mark.usefixtures('one_thread')
UPSTAIRS = route_images(40, seed=3)
LENGTH = 10
SURE_SETTINGS = {'sequence': SequenceSettings(LENGTH), 'min_probability': 0.5}


@pytest.fixture(scope='module')
def floors(small_map, tmp_path_factory):
    folder = tmp_path_factory.mktemp('floors')
    save_map(replace(small_map, thumbnails=()), folder / 'floor-0.stavpr')
    n = len(UPSTAIRS)
    features, stamps = small_map.extractor().extract(UPSTAIRS), (1 + np.arange(n)) * SECOND
    poses = np.array([at(i) for i in range(n)])
    upstairs = PlaceMap(features, small_map.projection, stamps, ('',) * n, poses)
    save_map(upstairs, folder / 'floor-1.stavpr')
    return folder


def test_matches_on_a_folder_of_maps_name_the_map(floors, route):
    pipeline = localizing(str(floors))
    assert [each.id for each in pipeline.places.sessions] == ['floor-0', 'floor-1']
    for images, name in ((route[10:25], 'floor-0'), (UPSTAIRS[5:20], 'floor-1')):
        results = process(pipeline, images)  # from floor to floor without a reset: an elevator
        result = results[-1]
        assert pipeline.places.place(result.match.place).session == name
        probabilities = result.session_probabilities
        assert len(probabilities) == 2
        assert probabilities[int(name[-1])] > 0.8
        assert sum(probabilities) < 1.001


def test_one_map_has_no_session_probabilities(map_file, route):
    assert process(localizing(map_file), route[:8])[-1].session_probabilities == ()


def test_folder_of_maps_is_not_extended_and_saved_to_another_file(floors, tmp_path):
    pipeline = localizing(str(floors))
    places = pipeline.places
    with pytest.raises(SettingsError, match='does not extend the folder'):
        pipeline.change(operation='mapping')
    assert (pipeline.operation.name, pipeline.places) == ('localization', places)
    assert save(pipeline, tmp_path / 'house.stavpr') == len(places)
    pipeline.change(operation='mapping')  # it has a file now


def test_folder_of_maps_with_different_features_names_both(tmp_path, small_map):
    save_map(small_map, tmp_path / 'a.stavpr')
    settings = replace(small_map.settings, value_range=(0, 4095))
    features = replace(small_map.features, settings=settings)
    save_map(replace(small_map, features=features), tmp_path / 'b.stavpr')
    with pytest.raises(MapFileError, match=r'b\.stavpr has other settings .*a\.stavpr'):
        read_map(str(tmp_path), settings_of())


def extending(map_file, target, **changes):
    def open_journal(base, template):
        return JournalWriter.create(target, base, template, print)

    pipeline = Pipeline(settings_of(**changes), 'mapping', open_journal)
    pipeline.change(loaded=read_map(map_file, pipeline.settings))
    return pipeline


@pytest.fixture
def recorded(map_file, route, tmp_path):
    """Record a session that begins in the middle of the map; return pipeline, results, target."""
    target = tmp_path / 'route.stavpr'
    pipeline = extending(map_file, target, **SURE_SETTINGS)
    results = process(pipeline, [*route[20:40], *UPSTAIRS[:20]], first=100, poses=True)
    yield pipeline, results, target
    pipeline.close_journals(delete_route=True)


def test_session_on_a_map_is_recorded_and_matched(recorded, map_file, route):
    pipeline, results, _ = recorded
    images = [*route[20:40], *UPSTAIRS[:20]]
    localized = process(localizing(map_file, **SURE_SETTINGS), images, first=100)
    n = len(pipeline.operation.reference)
    assert [each.image_index for each in results] == list(range(n, n + 40))
    assert {each.match.status for each in results} == {Status.MATCH, Status.MAPPED}
    for result, other in zip(results, localized, strict=True):
        assert result.match.accepted == other.match.accepted
        assert (result.match.place, result.match.newest) == (other.match.place, other.match.newest)
        assert result.match.reason == ''
    assert results[-1].match.status is Status.MAPPED
    assert pipeline.operation.relocalize(2).candidates
    pair = pipeline.operation.matched_pair(results[15].match)
    assert (pair.source, pair.place) == (pipeline.operation.reference, results[15].match.place)


def test_session_on_a_map_is_related_to_its_places(recorded, map_file, tmp_path):
    pipeline, results, _ = recorded
    save(pipeline, tmp_path / 'both.stavpr')
    both = load_map(tmp_path / 'both.stavpr')
    n = len(pipeline.operation.reference)
    assert [each.id for each in both.sessions] == ['route', 'recorded-1']
    assert both.session_index.tolist() == [0] * n + [1] * 40
    assert both.same_as[:n].tolist() == list(range(n))
    merged = with_same_places(replace(both, same_as=None))
    certain = [
        each
        for each in results
        if each.match.probability > SURE and len(each.match.path.pairs) == LENGTH
    ]
    assert certain
    for result in certain:
        middle = result.image_index - LENGTH + 1 + result.match.position
        assert both.same_as[middle] == result.match.place
    differ = np.flatnonzero(both.same_as != merged.same_as)
    assert len(differ) <= 6  # the command has windows of 20 images
    assert both.same_as[n + 25 :].tolist() == list(range(n + 25, n + 40))


def test_killed_session_on_a_map_becomes_a_session_of_the_map(recorded, route):
    pipeline, _, target = recorded
    pipeline.close_journals(delete_route=False)
    path = recover(journals(target)[0], relate=with_last_related).path
    both = load_map(path)
    assert [each.id for each in both.sessions] == ['route', 'recorded-1']
    assert both.session_index.tolist() == [0] * (len(both) - 40) + [1] * 40
    assert (both.same_as[-40:-25] < len(both) - 40).all()


def test_session_that_was_saved_goes_on_after_a_kill(recorded, route):
    pipeline, _, target = recorded
    save(pipeline, target)
    process(pipeline, UPSTAIRS[20:23], first=140)
    pipeline.close_journals(delete_route=False)
    both = load_map(recover(journals(target)[0]).path)
    assert [each.id for each in both.sessions] == ['route', 'recorded-1']
    assert both.session_index[-43:].tolist() == [1] * 43


def test_session_on_a_map_is_recorded_without_a_threshold_of_mode_paper(map_file, tmp_path, route):
    pipeline = extending(map_file, tmp_path / 'a.stavpr', mode='paper', threshold=None)
    assert {each.match.status for each in process(pipeline, route[:LENGTH])} == {Status.MAPPED}
    pipeline.close_journals(delete_route=True)


def test_full_map_records_no_further_place(map_file, tmp_path, route):
    pipeline = extending(map_file, tmp_path / 'a.stavpr', max_places=62)
    results = process(pipeline, route[:4], first=100)
    assert [each.match.status for each in results[2:]] == [Status.NOT_READY] * 2
    assert pipeline.operation.map_state == 'full'
    assert pipeline.operation.process(message(route[4]), SECOND).match.status is Status.NOT_READY
    pipeline.close_journals(delete_route=True)
