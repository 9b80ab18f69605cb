# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of several sessions, folders of maps: borders, same places, sessions that are recorded."""

from dataclasses import replace

from fixtures import route_images
from map_examples import example_map
import map_reader
import numpy as np
from pipelines import at, localizing, message, process, save, SECOND, settings_of
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import InputError, MapFileError, SettingsError
from stavpr_ros.maintenance.same_places import fill_gaps, SURE, with_last_related, with_same_places
from stavpr_ros.mapping import (
    GrowingMap,
    load_map,
    Map,
    merge_maps,
    save_map,
    select_places,
    select_session,
)
from stavpr_ros.mapping.journal_map import journals, recover
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.mapping.place_map import ErrorRisks
from stavpr_ros.mapping.reduction import with_principal_components
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.windows import layout_of
from stavpr_ros.pipeline import Pipeline, read_map

pytestmark = pytest.mark.usefixtures('one_thread')
LENGTH, PLACES = 10, 90


def route(seed):
    return route_strips(seed, PLACES)


@pytest.fixture(scope='module')
def town():
    """Return two drives of a route and one of another."""
    drives = (route(0), 1), (route(0), 2), (route(5), 3)
    return [map_of(features_of(strips, 0.6, seed)) for strips, seed in drives]


def recognizer(place_map, mode='robust'):
    threshold = None if mode == 'robust' else 2.0
    settings = RecognizerSettings(
        threshold, sequence=SequenceSettings(LENGTH), nms_radius=8, mode=mode
    )
    return PlaceRecognizer(place_map, settings)


def recognize(place_map, query, mode='robust'):
    return recognize_all(recognizer(place_map, mode), query)


def test_map_of_one_session_has_no_gaps(town):
    one = merge_maps(town[:1], ['a'])
    assert {layout_of(place_map, 20).columns for place_map in (town[0], one)} == {None}
    query = features_of(route(0), 1.0, 9)[10:50]
    for result, expected in zip(recognize(one, query), recognize(town[0], query), strict=True):
        assert repr(result) == repr(expected)
    here = recognizer(town[0])
    here.update(query[:1])
    assert here.place_probabilities().shape == (PLACES,)


def test_all_sessions_are_compared_and_the_start_names_their_time(town):
    four = merge_maps(town[:1] * 4, 'abcd')
    one = recognizer(replace(four, same_as=np.tile(np.arange(PLACES, dtype=np.int32), 4)))
    query = features_of(route(0), 1.0, 9)
    for i in range(80):  # also where the camera is certainly on the map
        one.update(query[i : i + 1])
        assert np.isfinite(one.newest_row()).all()
    assert one.place_probabilities().sum() > 0.99
    assert one.start_notes == '4 sessions: an image takes up to 4 times the time of one'
    assert recognizer(town[0]).start_notes == ''


def test_mode_paper_finds_the_sequences_of_each_session_alone(town):
    """Exactly: a border is where a map alone ends."""
    merged, query = merge_maps(town, 'abc'), features_of(route(0), 1.0, 9)[60:90]
    together, alone = recognizer(merged, 'paper'), [recognizer(one, 'paper') for one in town]
    for i in range(len(query)):
        match = together.update(query[i : i + 1])
        matches = [one.update(query[i : i + 1]) for one in alone]
        if match.status is Status.WARMING_UP:
            continue
        nearest = min(range(3), key=lambda k: matches[k].distance)
        first = PLACES * nearest
        assert match.distance == matches[nearest].distance
        assert (match.path.first, match.path.last) == (
            matches[nearest].path.first + first, matches[nearest].path.last + first,
        )  # fmt: skip
        np.testing.assert_array_equal(
            match.path.pairs, matches[nearest].path.pairs + np.array([0, first], np.int32)
        )


@pytest.mark.parametrize('mode', ['paper', 'robust'])
def test_drive_over_a_border_is_never_one_sequence(town, mode):
    """A query that shows the end of one session, and at once the start of the next."""
    merged = merge_maps([town[0], town[2]], 'ab')
    jump = np.concatenate([route(0)[:, 40:], route(5)[:, :50]], axis=1)
    for match in recognize(merged, features_of(jump, 0.8, 7), mode):
        if match.path.place >= 0:
            sessions = merged.session_index[match.path.pairs[:, 1]]
            assert len(set(sessions.tolist())) == 1
            assert match.path.first <= match.path.place <= match.path.last
    assert match.accepted
    assert merged.session(match.place).id == 'b'


def test_alike_sessions_share_their_probability_once_related(town):
    """Twins take half of each other's probability: no place of either has more than a half."""
    twins = merge_maps([town[0], town[0]], 'ab')
    query = features_of(route(0), 1.0, 9)
    alone = [match.accepted for match in recognize(town[0], query)]
    assert not any(match.accepted for match in recognize(twins, query))
    related = with_same_places(twins)
    assert related.same_as[PLACES:].tolist() == list(range(PLACES))
    matches = recognize(related, query)
    assert [match.accepted for match in matches[LENGTH:]] == alone[LENGTH:]
    assert sum(alone) > 70
    for match in matches[LENGTH + 10 :]:
        second = match.path.second_best
        assert second < 0 or abs(second % PLACES - match.path.place % PLACES) > 8


def test_path_is_compared_in_all_sessions_of_its_places():
    """A sparse session shows slowly changing places better than the dense one before it."""
    noise, places = route_strips(0, 380), np.arange(300)
    strips = sum(noise[:, first : first + 300] for first in range(80)) / 80**0.5
    both = merge_maps([map_of(features_of(strips[:, ::k], 3.0, k)) for k in (1, 4)], 'ab')
    both = replace(both, same_as=np.append(places, places[::4]).astype(np.int32))
    query = features_of(strips[:, 1::4], 3.0, 3)
    matches = recognize_all(PlaceRecognizer(both, RecognizerSettings()), query)
    # 0.84 without the score in the other session, 0.78 with other places as near by column
    assert np.mean([match.accepted for match in matches[20:]]) > 0.9


def test_short_gaps_of_related_places_are_filled_by_their_neighbors():
    none, places = np.full(30, -1), np.arange(30)
    matched = np.concatenate([places[:3], none[:4], [10, 11], none[:25], [40], none[:2], [90]])
    one = np.zeros(100, int)
    filled = fill_gaps(matched, one)
    np.testing.assert_array_equal(filled[:9], [0, 1, 2, 4, 5, 7, 8, 10, 11])
    np.testing.assert_array_equal(filled[9:], matched[9:])  # a long gap, and one of a jump
    backward = np.array([5, -1, 4])
    np.testing.assert_array_equal(fill_gaps(backward, one), backward)
    border = np.array([8, -1, 11])  # from the end of a session to the start of the next
    np.testing.assert_array_equal(fill_gaps(border, one), [8, 10, 11])
    np.testing.assert_array_equal(fill_gaps(border, np.arange(100) // 10), border)


def test_second_best_is_the_most_probable_place_elsewhere_however_faint(town):
    """Not the first place, where all others cost 1 to the last digit."""
    matches = recognize(with_same_places(merge_maps(town, 'abc')), features_of(route(0), 0.3, 9))
    accepted = [match.path for match in matches if match.accepted]
    assert sum(one.second_best == 0 for one in accepted) < len(accepted) / 2
    assert all(one.second_best != one.place for one in accepted)


@pytest.mark.parametrize('mode', ['paper', 'robust'])
def test_same_place_in_another_session_is_no_candidate_beside(town, mode):
    related = with_same_places(merge_maps(town, 'abc'))
    assert (related.same_as[PLACES : 2 * PLACES] < PLACES).all()
    assert np.abs(related.same_as[PLACES : 2 * PLACES] - np.arange(PLACES)).max() <= 2
    assert related.same_as[2 * PLACES :].tolist() == list(range(2 * PLACES, 3 * PLACES))
    one, query = recognizer(related, mode), features_of(route(0), 1.0, 9)[20:70]
    for i in range(len(query)):
        match = one.update(query[i : i + 1])
    places = [candidate.place for candidate in one.ranked(4)]
    assert (places[0], *places[1:2]) == (match.path.place, match.path.second_best)
    positions = related.same_as[places]
    assert np.abs(positions[1:] - positions[0]).min() > 8
    # in another session, a neighbor by number is no neighbor
    assert one.newest_row().shape == (len(related),)
    rows = one.window_columns(np.arange(len(related)))
    assert rows.shape == (LENGTH, len(related))
    assert np.isfinite(rows).all()
    np.testing.assert_array_equal(rows[-1], one.newest_row())


def test_related_places_are_saved(tmp_path):
    same_as = np.arange(24, dtype=np.int32)
    same_as[14:20] = np.arange(6)
    save_map(replace(example_map(), same_as=same_as), tmp_path / 'map')
    np.testing.assert_array_equal(load_map(tmp_path / 'map').same_as, same_as)
    manifest, arrays = map_reader.read(tmp_path / 'map')
    assert manifest['sections'] == {'same_places': {'version': 1, 'required': False, 'data': None}}
    np.testing.assert_array_equal(arrays['same_places/same_as'], same_as)


def test_related_places_stay_related(town):
    related = with_same_places(merge_maps(town[:2], ['day', 'night']))
    night = select_session(related, 'night')
    assert night.same_as.tolist() == list(range(PLACES))
    some = select_places(related, np.arange(0, 2 * PLACES, 2))
    both_left = related.same_as[PLACES::2] % 2 == 0
    assert (some.same_as[45:] < 45).tolist() == both_left.tolist()
    again = merge_maps([town[2], related], ['first', ''])
    np.testing.assert_array_equal(again.same_as[PLACES:], related.same_as + PLACES)
    growing = GrowingMap.from_map(related, 1000)
    growing.add(town[0].features[:1])
    assert growing.snapshot().same_as.tolist() == [*related.same_as.tolist(), 2 * PLACES]


@pytest.mark.parametrize(
    ('same_as', 'message'),
    [
        (np.zeros(3, np.int32), r'expected \(90\) int32'),
        (np.full(PLACES, PLACES, np.int32), 'itself or an earlier one'),
        (np.maximum(np.arange(PLACES, dtype=np.int32) - 1, 0), 'same as another one'),
    ],
)
def test_map_with_impossible_relations_is_rejected(town, same_as, message):
    with pytest.raises(InputError, match=message):
        replace(town[0], same_as=same_as)


def test_calibration_stays_with_its_route_only(town):
    """Drives on these places made it: others, or a session without the rest, have none."""
    risks = ErrorRisks('robust', 1, (0.5,), (0.0,))
    one = replace(town[0], error_risks=risks)
    assert merge_maps([one, one], ['a', 'b']).error_risks is None
    merged = replace(merge_maps([one, one], ['a', 'b']), error_risks=risks)
    assert select_session(merged, 'a').error_risks is None
    assert select_places(one, np.arange(9)).error_risks == risks
    assert GrowingMap.from_map(one, PLACES).snapshot().error_risks is None
    assert with_principal_components(one, 4).error_risks is None


@pytest.mark.parametrize('seed', range(2))
def test_refuted_path_is_not_sought_in_a_session_without_its_states(town, seed):
    """A route and the way back along it: each place is one position, which is passed one way."""
    back = map_of(town[0].features[::-1])
    same_as = np.r_[:PLACES, PLACES - 1 : -1 : -1].astype(np.int32)
    both = replace(merge_maps([town[0], back], 'ab'), same_as=same_as)
    strips, other = route(0)[:, ::-1].copy(), np.random.default_rng(seed).random(PLACES) < 0.4
    strips[:, other] = route(5)[:, other]
    matches = recognize(both, features_of(strips, 0.8, seed))
    assert sum(match.path.place >= 0 for match in matches) > PLACES // 2


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
    upstairs = Map(features, small_map.projection, stamps, ('',) * n, poses)
    save_map(upstairs, folder / 'floor-1.stavpr')
    return folder


def test_matches_on_a_folder_of_maps_name_the_map(floors, route):
    pipeline = localizing(str(floors))
    assert [session.id for session in pipeline.places.sessions] == ['floor-0', 'floor-1']
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


def extend(map_file, target, **changes):
    def open_journal(base, template):
        return JournalWriter.create(target, base, template, print)

    pipeline = Pipeline(settings_of(**changes), 'mapping', open_journal)
    pipeline.change(loaded=read_map(map_file, pipeline.settings))
    return pipeline


@pytest.fixture
def recording(map_file, route, tmp_path):
    """Record a session that begins in the middle of the map; return pipeline, results, target."""
    target = tmp_path / 'route.stavpr'
    pipeline = extend(map_file, target, **SURE_SETTINGS)
    results = process(pipeline, [*route[20:40], *UPSTAIRS[:20]], first=100, poses=True)
    yield pipeline, results, target
    pipeline.close_journals(delete_route=True)


def test_session_on_a_map_is_recorded_and_matched(recording, map_file, route):
    pipeline, results, _ = recording
    images = [*route[20:40], *UPSTAIRS[:20]]
    localized = process(localizing(map_file, **SURE_SETTINGS), images, first=100)
    n = len(pipeline.operation.reference)
    assert [result.image_index for result in results] == list(range(n, n + 40))
    assert {result.match.status for result in results} == {Status.MATCH, Status.MAPPED}
    for result, other in zip(results, localized, strict=True):
        assert result.match.accepted == other.match.accepted
        assert (result.match.place, result.match.newest) == (other.match.place, other.match.newest)
        assert result.match.reason == ''
    assert results[-1].match.status is Status.MAPPED
    assert pipeline.operation.relocalize(2).candidates
    pair = pipeline.operation.matched_pair(results[15].match)
    assert (pair.source, pair.place) == (pipeline.operation.reference, results[15].match.place)


def test_session_on_a_map_is_related_to_its_places(recording, map_file, tmp_path):
    pipeline, results, _ = recording
    save(pipeline, tmp_path / 'both.stavpr')
    both = load_map(tmp_path / 'both.stavpr')
    n = len(pipeline.operation.reference)
    assert [session.id for session in both.sessions] == ['route', 'recorded-1']
    assert both.session_index.tolist() == [0] * n + [1] * 40
    assert both.same_as[:n].tolist() == list(range(n))
    merged = with_same_places(replace(both, same_as=None))
    certain = [
        result
        for result in results
        if result.match.probability > SURE and len(result.match.path.pairs) == LENGTH
    ]
    assert certain
    for result in certain:
        middle = result.image_index - LENGTH + 1 + result.match.position
        assert both.same_as[middle] == result.match.place
    differ = np.flatnonzero(both.same_as != merged.same_as)
    assert len(differ) <= 6  # the command has windows of 20 images
    assert both.same_as[n + 25 :].tolist() == list(range(n + 25, n + 40))


@pytest.mark.parametrize('was_saved', [False, True])
def test_killed_session_on_a_map_becomes_or_stays_a_session_of_the_map(recording, was_saved):
    pipeline, _, target = recording
    if was_saved:
        save(pipeline, target)
        process(pipeline, UPSTAIRS[20:23], first=140)
    count = 43 if was_saved else 40
    pipeline.close_journals(delete_route=False)
    both = load_map(recover(journals(target)[0], relate=with_last_related).path)
    assert [session.id for session in both.sessions] == ['route', 'recorded-1']
    assert both.session_index.tolist() == [0] * (len(both) - count) + [1] * count
    assert (both.same_as[-count : 15 - count] < len(both) - count).all()


def test_session_on_a_map_is_recorded_without_a_threshold_of_mode_paper(map_file, tmp_path, route):
    pipeline = extend(map_file, tmp_path / 'a.stavpr', mode='paper', threshold=None)
    assert {result.match.status for result in process(pipeline, route[:LENGTH])} == {Status.MAPPED}
    pipeline.close_journals(delete_route=True)


def test_full_map_records_no_further_place(map_file, tmp_path, route):
    pipeline = extend(map_file, tmp_path / 'a.stavpr', max_places=62)
    results = process(pipeline, route[:4], first=100)
    assert [result.match.status for result in results[2:]] == [Status.NOT_READY] * 2
    assert pipeline.operation.map_state == 'full'
    assert pipeline.operation.process(message(route[4]), SECOND).match.status is Status.NOT_READY
    pipeline.close_journals(delete_route=True)
