"""What has grown is written at the end, and no file of another map is replaced."""

import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
from pipelines import settings_of, show

from stavpr_ros.errors import StavprError
from stavpr_ros.mapping import load_map, save_map
from stavpr_ros.pipeline import Pipeline, read_map
from stavpr_ros.ros.runtime import Runtime
from stavpr_ros.ros.saving import write_at_the_end, write_map
from stavpr_ros.ros.worker import Worker


class Log:
    """A logger that remembers."""

    def __init__(self):
        self.said = []

    def __getattr__(self, level):
        return lambda text: self.said.append((level, text))


@pytest.fixture
def mapping(route):
    pipeline = Pipeline(settings_of(), 'mapping')
    show(pipeline, route[:7])
    return pipeline


def at_the_end(pipeline, path):
    log = Log()
    write_at_the_end(pipeline, lambda function: function(), str(path), log)
    return log.said


def test_what_has_grown_is_written_once(mapping, route, tmp_path):
    path = tmp_path / 'route.stavpr'
    assert at_the_end(mapping, path)[-1] == ('info', f'7 places written to {path}')
    assert len(load_map(path)) == 7
    assert at_the_end(mapping, path) == []  # nothing new
    show(mapping, route[7:9], first=7)
    assert at_the_end(mapping, path)[-1] == ('info', f'9 places written to {path}')  # its own file


def test_a_file_of_another_map_stays(mapping, route, tmp_path):
    path = tmp_path / 'route.stavpr'
    for there in (path, tmp_path / 'route-2.stavpr'):
        there.write_bytes(b'yesterday')
    assert at_the_end(mapping, path)[-1][1].endswith('route-3.stavpr')
    show(mapping, route[7:9], first=7)
    assert at_the_end(mapping, path)[-1][1].endswith('route-3.stavpr')  # again: it is this map's
    assert path.read_bytes() == b'yesterday'
    assert len(load_map(tmp_path / 'route-3.stavpr')) == 9


def test_a_copy_elsewhere_does_not_make_the_file_another_maps(small_map, route, tmp_path):
    path = str(tmp_path / 'route.stavpr')
    save_map(small_map, path)
    pipeline = Pipeline(settings_of(), 'mapping')
    pipeline.use(read_map(path, pipeline.settings))
    pipeline.save(str(tmp_path / 'backup.stavpr'), overwrite=False)
    show(pipeline, route[:2])
    assert at_the_end(pipeline, path)[-1] == ('info', f'62 places written to {path}')


def test_what_is_lost_is_said(mapping, route, tmp_path):
    assert at_the_end(mapping, '') == [
        ('warning', '7 places are in no file: neither save_path nor ~/save_map named one')
    ]
    level, text = at_the_end(mapping, tmp_path / 'missing' / 'route.stavpr')[-1]
    assert (level, 'does not exist' in text) == ('error', True)
    mapping.set_operation('localization')  # it is the map now, and still in no file
    assert at_the_end(mapping, '')[0][0] == 'warning'
    path = tmp_path / 'route.stavpr'
    assert at_the_end(mapping, path)[-1] == ('info', f'7 places written to {path}')


def test_a_route_that_closes_loops_is_written_where_a_file_is_named(route, tmp_path):
    pipeline = Pipeline(settings_of(), 'loop_closure')
    show(pipeline, route[:9])
    assert at_the_end(pipeline, '') == []
    at_the_end(pipeline, tmp_path / 'loop.stavpr')
    assert len(load_map(tmp_path / 'loop.stavpr')) == 9
    show(pipeline, route[9:11], first=9)
    pipeline.set_operation('localization')  # now it is the map, and goes to its file all the same
    at_the_end(pipeline, tmp_path / 'loop.stavpr')
    assert len(load_map(tmp_path / 'loop.stavpr')) == 11


def test_a_route_does_not_replace_the_map_that_it_was_begun_with(small_map, route, tmp_path):
    path = tmp_path / 'route.stavpr'
    save_map(small_map, path)
    pipeline = Pipeline(settings_of(), 'loop_closure')
    pipeline.use(read_map(str(path), pipeline.settings))
    show(pipeline, route[:9])
    assert at_the_end(pipeline, path)[-1][1].endswith('route-2.stavpr')
    assert (len(load_map(path)), len(load_map(tmp_path / 'route-2.stavpr'))) == (60, 9)


def test_places_that_come_while_it_is_written_are_unsaved(mapping, route, tmp_path):
    calls = []

    def on_worker(function):
        if calls:
            show(mapping, route[7:10], first=7)
        calls.append(function)
        return function()

    assert write_map(mapping, on_worker, str(tmp_path / 'route.stavpr'), overwrite=False) == 7
    assert (mapping.unsaved, mapping.path) == (3, str(tmp_path / 'route.stavpr'))


@pytest.mark.parametrize('another', [False, True])
def test_another_map_is_not_taken_for_the_one_that_was_written(another, mapping, small_map, tmp_path):
    """While it is written, what grew becomes the map, and another one may be loaded."""
    path, other = (str(tmp_path / name) for name in ('route.stavpr', 'other.stavpr'))
    save_map(small_map, other)

    def on_worker(function):
        result = function()
        mapping.set_operation('localization')
        if another:
            mapping.use(read_map(other, mapping.settings))
        return result

    write_map(mapping, on_worker, path, overwrite=False)
    assert (mapping.unsaved, mapping.path) == (0, other if another else path)
    assert mapping.save_state.owns(other) == another


def test_two_that_write_at_once_write_what_they_say(mapping, route, tmp_path):
    """A service, and a transition on another thread: what came after both is unsaved."""
    path = str(tmp_path / 'route.stavpr')
    snapshots = [mapping.to_save(path, overwrite=True)]
    show(mapping, route[7:9], first=7)
    snapshots.append(mapping.to_save(path, overwrite=True))
    show(mapping, route[9:10], first=9)
    for snapshot in reversed(snapshots):
        mapping.saved(path, snapshot)
    assert mapping.unsaved == 1


@pytest.mark.parametrize('busy', [False, True])
def test_who_asks_a_worker_that_is_stopped_is_told(busy):
    """Before or after it is stopped; it must not wait for ever."""
    begun, go_on = threading.Event(), threading.Event()

    def work(item):
        begun.set()
        go_on.wait(30)

    worker = Worker(work, 2)
    owner = SimpleNamespace(_worker=worker, _node=SimpleNamespace(ending=threading.Event()))
    with ThreadPoolExecutor(2) as pool:
        if busy:
            worker.put(1)
            begun.wait(30)
            asked = pool.submit(Runtime._on_worker, owner, lambda: 7)
            stopped = pool.submit(worker.stop)
            while not worker._stopping:
                pass
            go_on.set()
            stopped.result(30)
        else:
            worker.stop()
            asked = pool.submit(Runtime._on_worker, owner, lambda: 7)
        with pytest.raises(StavprError, match='no longer configured'):
            asked.result(30)
