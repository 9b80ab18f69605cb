# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Threads beside those that images wait for."""

import os
import sys

import pytest
from stavpr_ros.threads import call_on_thread, yield_processor


@pytest.mark.skipif(sys.platform != 'linux', reason='threads have no policies of their own')
def test_yielding_thread_waits_for_all_others_and_these_keep_their_policy():
    before = os.sched_getscheduler(0)
    assert before != os.SCHED_IDLE

    def policy() -> int:
        yield_processor()
        return os.sched_getscheduler(0)

    assert call_on_thread(policy, 'yielding').result(10) == os.SCHED_IDLE
    assert os.sched_getscheduler(0) == before
