# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of a fleet: their stores, recognition in neighborhoods, and stores that fail."""

from dataclasses import replace
import threading
import time

from diagnostic_msgs.msg import DiagnosticStatus
from map_examples import example_map
import numpy as np
from pipelines import message, MIN_PROBABILITY, SECOND, settings_of
from processes import TIMEOUT
import pytest
from robot import image_message
from stavpr_fleet import CityMap, FleetRecognizer, open_city_map, upload
from stavpr_fleet.neighborhoods import Votes
from stavpr_fleet.qdrant_store import EdgePoints
from stavpr_fleet.recognizer import CityLayout
from stavpr_fleet.store import map_vectors, MapIndex, place_vectors
from stavpr_msgs.msg import PlaceMatch
from stavpr_msgs.srv import LoadMap
from stavpr_ros.alignment import SpatialSettings
from stavpr_ros.commands import map as map_command
from stavpr_ros.errors import FleetError, InputError, OutputTakenError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import descriptor_map, open_map, save_map, select_places, Session
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.localizer import EARLY
from stavpr_ros.method.match import Path, WindowMatch, WindowSequences
from stavpr_ros.pipeline import Pipeline, read_map
from stavpr_ros.prepare.centering import unit_norm

for package in ('faiss', 'qdrant_client', 'qdrant_edge'):
    pytest.importorskip(package, reason='the extra fleet is not installed')
from qdrant_server import QdrantServer  # noqa: E402

CITY, SETTINGS = 6000, RecognizerSettings(mode='robust')
STORES = ('memory', 'faiss', 'qdrant', 'server')
FIRST, DRIVEN = 2500, 60
SOURCE = FeatureSettings('descriptors', settings_class('descriptors')(), 3)


def walk(n, seed=0, d=24):
    """Unit-norm features of places that resemble their neighbors, (3, n, d)."""
    noise = np.random.default_rng(seed).standard_normal((3, n + 2, d), np.float32)
    strips = noise[:, 2:] + 0.7 * noise[:, 1:-1] + 0.4 * noise[:, :-2]
    strips = unit_norm(strips)
    return LocalFeatures(strips, np.full((3, n), 3**-0.5, np.float32), SOURCE)


def seen_again(features, noise=0.6, seed=1):
    """Return the places of features on another day."""
    drawn = np.random.default_rng(seed).standard_normal(features.strips.shape, np.float32)
    strips = features.strips + np.float32(noise / np.sqrt(features.dimension)) * drawn
    return replace(features, strips=unit_norm(strips))


@pytest.fixture(scope='module')
def city():
    features = walk(CITY)
    sessions = Session('a', 'one'), Session('b', camera='rear', yaw=3.1)
    index = np.repeat(np.arange(2, dtype=np.int32), CITY // 2)
    return replace(descriptor_map(features), sessions=sessions, session_index=index)


@pytest.fixture(scope='module')
def query(city):
    return seen_again(city.features[FIRST : FIRST + DRIVEN])


@pytest.fixture(scope='module')
def server():
    server = QdrantServer()
    yield server
    server.close()


class MemoryStore:
    """A map in memory, with an exact search."""

    def __init__(self, place_map):
        self.place_map, self.index = place_map, MapIndex.of(place_map)
        self.vectors = map_vectors(place_map, self.index)

    def nearest(self, vectors, count):
        return np.argsort(-(vectors @ self.vectors.T), axis=1, kind='stable')[:, :count]

    def fetch(self, places):
        same_as = self.place_map.same_as
        return select_places(self.place_map, places), places if same_as is None else same_as[
            places
        ]


def city_in(place_map, store, tmp_path, server):
    """Upload a map to a store and open it there."""
    if store == 'memory':
        return CityMap.of(MemoryStore(place_map))
    address = f'{store}:{tmp_path / store}'
    if store == 'server':
        address = server.address(tmp_path.name.replace('/', '_'))
    upload(place_map, address)
    return open_city_map(address)


def drive(recognizer, query):
    return [recognizer.update(query[i : i + 1], i + 1) for i in range(len(query))]


@pytest.mark.parametrize('store', STORES)
def test_fetch_returns_places_of_every_store(store, tmp_path, server):
    place_map = replace(example_map(), same_as=np.arange(24, dtype=np.int32))
    place_map.same_as[20] = 5
    if store == 'faiss':
        save_map(place_map, tmp_path / 'same')
        place_map = open_map(tmp_path / 'same')
    city = city_in(place_map, store, tmp_path, server)
    places = np.array([2, 3, 4, 20])
    fetched, same_as = city.store.fetch(places)
    np.testing.assert_allclose(
        fetched.features.strips, place_map.features.strips[:, places], atol=1e-3, rtol=0
    )
    np.testing.assert_allclose(
        fetched.features.weights, place_map.features.weights[:, places], rtol=1e-5, atol=1e-5
    )
    assert same_as.tolist() == [2, 3, 4, 5]
    assert fetched.ids == ('place 2', 'place 3', 'place 4', 'place 20')
    np.testing.assert_array_equal(fetched.poses, place_map.poses[places])
    np.testing.assert_array_equal(fetched.stamps, place_map.stamps[places])
    city.remember(places, fetched)
    assert str(city.place(20)) == str(place_map.place(20))
    assert city.settings == place_map.settings
    assert city.sessions == place_map.sessions
    np.testing.assert_array_equal(city.session_index, place_map.session_index)
    index = MapIndex.of(place_map)
    vectors = place_vectors(index.centering().places(place_map.features[places]).strips)
    nearest = city.store.nearest(vectors, 30)
    assert nearest.shape[0] == 4
    assert nearest[:, 0].tolist() == places.tolist()
    assert set(nearest.ravel().tolist()) <= set(range(-1, 24))


def test_votes_follow_the_speed():
    votes = Votes(20, (0.5, 1.0, 2.0))
    for image in range(10):
        wrong = [5000 - 300 * image, 77 * image + 3000]
        votes.add(image, np.array([*wrong, 1000 + 2 * image, -1]))
    assert abs(votes.best(1)[0] - 1018) <= 8
    assert Votes(5, (1.0,)).best(3).tolist() == []


def test_matches_in_a_single_neighborhood_number_places_of_the_city():
    layout = CityLayout(np.arange(928, 1024), np.zeros(1, np.int64), np.arange(96), 20)
    pairs = np.array([[0, 20], [1, 21]], np.int32)
    match = WindowMatch(Path(pairs, 20), WindowSequences)
    result = layout.in_places(match).path
    assert (result.place, result.pairs[:, 1].tolist()) == (948, [948, 949])
    assert layout.session_of(948) == (928, 1024)


@pytest.mark.parametrize('store', ['memory', 'faiss'])
def test_recognizer_in_neighborhoods_matches_as_exact_one(store, city, query, tmp_path):
    exact = drive(PlaceRecognizer(city, SETTINGS), query)
    recognizer = FleetRecognizer(city_in(city, store, tmp_path, None), SETTINGS, timeout=60)
    result = drive(recognizer, query)
    early = [m.probability > EARLY for m in result[:19] if m.accepted]
    assert all(early)
    accepted = [i for i, match in enumerate(exact) if match.accepted]
    assert len(accepted) > 30
    for i in accepted[5:]:
        assert result[i].accepted
        assert abs(result[i].path.place - exact[i].path.place) <= 1
        assert abs(result[i].probability - exact[i].probability) < 0.01
        np.testing.assert_allclose(result[i].path.pairs[:, 1], exact[i].path.pairs[:, 1], atol=2)
    newest, row = result[-1].path.place, recognizer.newest_row()
    np.testing.assert_array_equal(recognizer.window_columns(np.arange(CITY))[-1], row)
    assert row.shape == (CITY,)
    assert np.isfinite(row).sum() < CITY
    assert int(np.argmin(row)) in range(FIRST + DRIVEN - 3, FIRST + DRIVEN + 2)
    assert recognizer.ranked(3)[0].place == newest
    recognizer.reset()
    assert recognizer.window_fill == 0


@pytest.mark.parametrize('kind', ['gradient', 'efficientnet_lite1'])
def test_probabilities_are_those_of_the_same_map_on_a_robot(kind):
    """Of a map whose chunks are all loaded at once; in other light, with a detour."""
    features = replace(walk(96), settings=replace(SOURCE, kind=kind))
    place_map = replace(descriptor_map(features), stamps=np.arange(1, 97) ** 2 * SECOND)
    query = seen_again(features, 3.0)
    query.strips[:, 60:70] = walk(10, seed=9).strips
    one = FleetRecognizer(CityMap.of(MemoryStore(place_map)), SETTINGS, timeout=60)
    pairs = zip(drive(one, query), drive(PlaceRecognizer(place_map, SETTINGS), query), strict=True)
    probabilities = [(result.probability, expected.probability) for result, expected in pairs]
    np.testing.assert_allclose(*np.transpose(probabilities), atol=1e-3)


def test_recognizer_after_a_reset_answers_as_a_new_one(city, query):
    """Also one whose store fails, by the chunks of before."""
    stores = Faulty(city), Faulty(city)
    one, new = (FleetRecognizer(CityMap.of(store), SETTINGS, timeout=60) for store in stores)
    drive(one, query)
    one.reset()
    for result, expected in zip(drive(one, query), drive(new, query), strict=True):
        values = [vars(match) | {'path': vars(match.path)} for match in (result, expected)]
        np.testing.assert_equal(*values)
    stores[0].cut = True
    one.reset()
    assert drive(one, query)[-1].accepted


def test_recognizer_off_the_map_matches_nothing(city):
    recognizer = FleetRecognizer(CityMap.of(MemoryStore(city)), SETTINGS, timeout=60)
    assert not any(match.accepted for match in drive(recognizer, walk(40, seed=9)))


class Faulty(MemoryStore):
    """A store that can be cut off, or made slow."""

    cut = False

    def __init__(self, place_map):
        super().__init__(place_map)
        self.open = threading.Event()
        self.open.set()

    def nearest(self, vectors, count):
        self.open.wait()
        if self.cut:
            raise FleetError('cut off')
        return super().nearest(vectors, count)


def test_recognizer_cut_off_goes_on_in_last_neighborhood_and_recovers(city, query):
    store = Faulty(city)
    recognizer = FleetRecognizer(CityMap.of(store), SETTINGS, timeout=60)
    drive(recognizer, query[:40])
    store.cut = True
    cut = drive(recognizer, query[40:50])
    assert 'cut off' in recognizer.problem
    assert [match.accepted for match in cut] == [True] * 10
    assert cut[-1].path.last == pytest.approx(FIRST + 49, abs=2)
    store.cut = False
    drive(recognizer, query[50:])
    end = time.monotonic() + TIMEOUT
    while recognizer.problem:  # the next lookup arrives after one of the next images
        assert time.monotonic() < end, recognizer.problem
        drive(recognizer, query[59:])


def test_recognizer_cut_off_from_the_start_publishes_why(city, query):
    store = Faulty(city)
    store.cut = True
    matches = drive(FleetRecognizer(CityMap.of(store), SETTINGS, timeout=60), query[:21])
    assert {match.status for match in matches} == {Status.WARMING_UP, Status.NO_MATCH}
    assert 'cut off' in matches[-1].reason


def test_recognizer_does_not_wait_for_a_slow_store(city, query):
    store = Faulty(city)
    recognizer = FleetRecognizer(CityMap.of(store), SETTINGS, timeout=60)
    drive(recognizer, query[:30])
    store.open.clear()
    recognizer._timeout = 0
    assert all(match.accepted for match in drive(recognizer, query[30:45]))
    store.open.set()


def test_recognizer_rejects_mode_paper_and_vertical(city):
    made = CityMap.of(MemoryStore(city))
    with pytest.raises(SettingsError, match='mode paper'):
        FleetRecognizer(made, RecognizerSettings(mode='paper'))
    spatial = SpatialSettings(vertical=True)
    with pytest.raises(SettingsError, match='vertical True'):
        FleetRecognizer(made, replace(SETTINGS, spatial=spatial))


def test_open_of_missing_or_interrupted_upload_names_remedy(tmp_path, server):
    with pytest.raises(FleetError, match='upload'):
        open_city_map(f'qdrant:{tmp_path}')
    save_map(example_map(), tmp_path / 'a')
    with pytest.raises(FleetError, match='map upload'):
        open_city_map(f'faiss:{tmp_path / "a"}')
    with pytest.raises(FleetError, match='none'):
        open_city_map(server.address('none'))
    with pytest.raises(SettingsError, match='HOST:PORT/COLLECTION'):
        open_city_map('qdrant://host:1')


def test_open_over_http_sends_no_key(environ):
    environ['QDRANT_API_KEY'] = 'secret'
    with pytest.raises(SettingsError, match='would be sent without encryption'):
        open_city_map('qdrant://robots.example:6333/city')


def test_upload_replaces_only_with_force(tmp_path, server):
    place_map = example_map()
    for address in (f'qdrant:{tmp_path / "q"}', f'faiss:{tmp_path / "f"}', server.address('f')):
        upload(place_map, address)
        with pytest.raises(OutputTakenError):
            upload(place_map, address)
        upload(place_map, address, force=True)
    (tmp_path / 'mine').mkdir()
    (tmp_path / 'mine' / 'photo.jpg').touch()
    with pytest.raises(OutputTakenError, match='another folder'):
        upload(place_map, f'qdrant:{tmp_path / "mine"}', force=True)
    assert (tmp_path / 'mine' / 'photo.jpg').exists()


@pytest.mark.parametrize(
    'change', [{'strips': 'AAAA'}, {'pose': [1]}, {'weights': []}, {'stamp': 'x'}, {'id': 'a\0b'}]
)
def test_fetch_of_damaged_payload_is_error(change, tmp_path, monkeypatch):
    city = city_in(example_map(), 'qdrant', tmp_path, None)
    whole = EdgePoints.payloads
    monkeypatch.setattr(
        EdgePoints, 'payloads', lambda *of: {i: row | change for i, row in whole(*of).items()}
    )
    with pytest.raises(FleetError, match=r'damaged|finite'):
        city.store.fetch(np.arange(3))


def test_map_upload_command_and_pipeline_localize(route, small_map, tmp_path, capsys, server):
    file, address = tmp_path / 'route.stavpr', server.address('route')
    save_map(small_map, file)
    assert map_command.main(['upload', str(file), address]) == 0
    assert '60 places' in capsys.readouterr().out
    assert map_command.main(['upload', str(file), 'elsewhere']) == 2
    assert 'faiss:' in capsys.readouterr().err
    pipeline = Pipeline(settings_of())
    pipeline.change(loaded=read_map(address, pipeline.settings))
    matches = [
        pipeline.operation.process(message(image), (i + 1) * SECOND)
        for i, image in enumerate(route)
    ]
    assert [result.match.probability > MIN_PROBABILITY for result in matches[20:]] == [True] * 40
    assert abs(matches[-1].match.newest - 59) <= 1
    assert pipeline.places.place(40).identifier == 'place 40'
    assert pipeline.problem == ''
    with pytest.raises(InputError, match='stays where it is'):
        pipeline.snapshot()
    with pytest.raises(SettingsError, match='mapping'):
        pipeline.change(operation='mapping')
    for name, value in (('precision', 'int8'), ('direction', 'both')):
        with pytest.raises(SettingsError, match=f'{name} {value}'):
            pipeline.change(settings_of(**{name: value}), loaded=read_map(address, settings_of()))


def test_node_whose_server_is_cut_off_goes_on_and_reports_it(robot, start, route, small_map):
    server = QdrantServer()
    upload(small_map, server.address('route'))
    start(map_path=server.address('route'))
    assert robot.until_map(state='loaded').places == 60
    for image in route[10:30]:
        last = robot.show(image_message(image), SECOND)
    assert last.status == PlaceMatch.MATCH
    assert abs(last.newest_index - 29) <= 1
    assert last.place_id == f'place {last.place_index}'
    server.close()
    for image in route[30:45]:
        last = robot.show(image_message(image), SECOND)
    assert last.status == PlaceMatch.MATCH
    assert abs(last.newest_index - 44) <= 1

    def is_reported():
        status = robot.diagnostics['map']
        return status.level == DiagnosticStatus.WARN and 'Qdrant server' in status.message

    robot.until(is_reported, 'the finding on the map')


def test_load_map_service_rejects_addresses(robot, start, server):
    start()
    robot.until_map(state='loaded')
    before = len(server.requests)
    for name in (server.address('route'), 'faiss:route.stavpr'):
        assert 'does not exist' in robot.refuses(LoadMap, 'load_map', path=name)
    assert len(server.requests) == before
