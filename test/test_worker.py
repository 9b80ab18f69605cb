"""The worker's slot: newest kept, oldest dropped, nothing ends the thread."""

import threading

import pytest

from stavpr_ros.ros.worker import Worker


def test_oldest_is_dropped_while_busy():
    begun, go_on, seen = threading.Event(), threading.Event(), []

    def process(item):
        begun.set()
        assert go_on.wait(10)
        seen.append(item)

    worker = Worker(process, capacity=2)
    assert worker.put(0) is None
    assert begun.wait(10)
    assert [worker.put(item) for item in (1, 2, 3, 4)] == [None, None, 1, 2]
    go_on.set()
    worker.call(lambda: None).result(10)  # calls go first, so ask until the items are done
    while len(seen) < 3:
        worker.call(lambda: None).result(10)
    worker.stop()
    assert seen == [0, 3, 4]


def test_an_item_that_fails_does_not_end_the_thread():
    seen = []

    def process(item):
        seen.append(1 / item)

    worker = Worker(process, capacity=5)
    for item in (1, 0, 2):
        worker.put(item)
    while len(seen) < 2:
        assert worker.call(lambda: True).result(10)
    worker.stop()
    assert seen == [1, 0.5]


def test_a_call_after_the_end_is_cancelled():
    worker = Worker(lambda item: None, capacity=1)
    worker.stop()
    assert worker.call(lambda: 7).cancelled()


def test_calls_return_and_raise():
    worker = Worker(lambda item: None, capacity=1)
    assert worker.call(lambda: 7).result(10) == 7
    with pytest.raises(ZeroDivisionError):
        worker.call(lambda: 1 / 0).result(10)
    assert worker.call(threading.current_thread).result(10).name == 'recognition'
    worker.stop()
