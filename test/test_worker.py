# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The worker: newest items kept, oldest dropped, nothing ends the thread."""

from concurrent.futures import ThreadPoolExecutor
import threading
import time
import weakref

import pytest
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.worker import Worker

TIMEOUT = 30


@pytest.fixture
def make(request):
    """Make a worker; it is stopped with the test."""

    def make(process=lambda item: None, capacity=1, ending=None):
        worker = Worker(process, capacity, ending or threading.Event())
        request.addfinalizer(worker.stop)
        return worker

    return make


class Busy:
    """Processes an item when it may go on."""

    def __init__(self):
        self.begun, self.go_on, self.seen = threading.Event(), threading.Event(), []

    def __call__(self, item=None):
        self.begun.set()
        assert self.go_on.wait(TIMEOUT)
        self.seen.append(item)


def test_worker_busy_drops_oldest_items(make):
    busy = Busy()
    worker = make(busy, capacity=2)
    assert worker.put(0) is None
    assert busy.begun.wait(TIMEOUT)
    assert [worker.put(item) for item in (1, 2, 3, 4)] == [None, None, 1, 2]
    assert worker.waiting == 2
    busy.go_on.set()
    while len(busy.seen) < 3:
        worker.run(lambda: None)
    assert busy.seen == [0, 3, 4]


def test_run_returns_and_raises_on_the_thread(make):
    worker = make()
    assert worker.run(threading.current_thread).name == 'recognition'
    with pytest.raises(ZeroDivisionError):
        worker.run(lambda: 1 / 0)


def test_worker_without_work_keeps_no_result_of_the_last_call(make):
    result = weakref.ref(make().run(Busy))
    end = time.monotonic() + TIMEOUT
    while result() is not None:
        assert time.monotonic() < end


@pytest.mark.parametrize('busy', [False, True])
def test_run_on_stopped_worker_raises(busy, make):
    """Called before or after the worker is stopped; the caller does not wait forever."""
    work = Busy()
    worker = make(work, 2)
    with ThreadPoolExecutor(1) as pool:
        if busy:
            worker.put(1)
            assert work.begun.wait(TIMEOUT)
            waiting = worker.call(lambda: 7)
            stopped = pool.submit(worker.stop)
            while not worker.call(lambda: None).cancelled():
                pass  # until stop() has begun
            work.go_on.set()
            assert stopped.result(TIMEOUT)
            assert waiting.cancelled()
        else:
            assert worker.stop()
    with pytest.raises(StavprError, match='no longer configured'):
        worker.run(lambda: 7)


def test_run_raises_when_the_node_ends(make):
    ending, busy = threading.Event(), Busy()
    worker = make(busy, ending=ending)
    worker.put(1)
    assert busy.begun.wait(TIMEOUT)
    ending.set()
    with pytest.raises(StavprError, match='the node ends'):
        worker.run(lambda: 7)
    busy.go_on.set()
