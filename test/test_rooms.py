# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The example at the head of each room of the method runs."""

import doctest

import pytest
from stavpr_ros import method, prepare


@pytest.mark.parametrize('room', [method, prepare], ids=lambda room: room.__name__)
def test_example_at_the_head_of_a_room_runs(room):
    result = doctest.testmod(room)
    assert result.attempted > 5
    assert result.failed == 0
