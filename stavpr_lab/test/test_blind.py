# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The meters that a robot drives without evidence of motion, in simulated time."""

import math

import pytest
from stavpr_lab.demonstration import blind
from stavpr_lab.demonstration.blind import is_slow
from stavpr_nav.follower import NO_EVIDENCE

LIMITS = {(0.25, 10.0): 0.6, (0.25, 5.0): 1.0, (0.5, 10.0): 0.9, (0.5, 5.0): 1.3}
REASONS = {'odometry ends: meters after it': 'no odometry', 'the camera ends': 'no new image'}
BRIDGE = 'the bridge: other images, without a match'


@pytest.mark.parametrize('name', [n for n, each in blind.FAILURES.items() if not is_slow(each)])
@pytest.mark.parametrize(('spacing', 'rate'), LIMITS)
def test_robot_stops_within_the_stated_meters_for_good(name, spacing, rate):
    for phase in (0.0, 0.3, 0.6, 0.95):
        meters, reason, later, _ = blind.drive(blind.FAILURES[name], spacing, rate, phase)
        assert meters <= (6.2 if name == BRIDGE else LIMITS[spacing, rate])
        assert meters > 5.8 or name != BRIDGE  # six seconds of the taught run
        assert later < 1e-6
        assert reason == REASONS.get(name, NO_EVIDENCE)


def test_slow_camera_is_driven_with_stop_and_go():
    half, slow = filter(is_slow, blind.FAILURES.values())
    assert 0.05 <= blind.meters_per_image(slow, 0.25, 10.0) <= 0.5
    stopped, reason, _, meters = blind.drive(half, 0.25, 10.0, 0.3)
    assert (stopped, reason) == (math.inf, '')
    assert meters == pytest.approx(blind.AFTER, abs=1.0)
