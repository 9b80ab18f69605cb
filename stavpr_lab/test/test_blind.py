# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The meters that a robot drives without evidence of motion, in simulated time."""

import math

import pytest
from stavpr_lab.demonstration import blind
from stavpr_nav.follower import NO_EVIDENCE

LIMITS = {(0.25, 10.0): 0.6, (0.25, 5.0): 1.0, (0.5, 10.0): 0.9, (0.5, 5.0): 1.3}
REASONS = {'odometry ends: meters after it': 'no odometry', 'the camera ends': 'no new image'}


@pytest.mark.parametrize('name', blind.FAILURES)
@pytest.mark.parametrize(('spacing', 'rate'), LIMITS)
def test_robot_stops_within_the_stated_meters_for_good(name, spacing, rate):
    for phase in (0.0, 0.3, 0.6, 0.95):
        meters, reason, later, _ = blind.drive(blind.FAILURES[name], spacing, rate, phase)
        assert meters <= LIMITS[spacing, rate]
        assert later < 1e-6
        assert reason == REASONS.get(name, NO_EVIDENCE)


def test_bridge_ends_after_six_seconds_of_the_taught_run():
    meters, reason, later, _ = blind.drive(blind.BRIDGE, 0.25, 10.0, 0.3)
    assert meters == pytest.approx(6.0, abs=0.2)
    assert (reason, later) == (NO_EVIDENCE, 0.0)


def test_slow_camera_is_driven_with_stop_and_go():
    failure = blind.SLOW['the camera falls to 1 image/s']
    assert 0.05 <= blind.meters_per_image(failure, 0.25, 10.0) <= 0.5
    half = blind.drive(blind.SLOW['the camera falls to half its rate'], 0.25, 10.0, 0.3)
    assert (half[0], half[1]) == (math.inf, '')
    assert half[3] == pytest.approx(blind.AFTER, abs=1.0)


def test_table_has_a_line_per_failure(monkeypatch):
    monkeypatch.setattr(blind, 'PHASES', 1)
    monkeypatch.setattr(blind, 'AFTER', 3.0)
    lines = blind.table()
    assert len(lines) == 2 + len(blind.FAILURES) + 1 + len(blind.SLOW)
    assert len({line.count('|') for line in lines}) == 1
