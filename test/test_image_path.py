# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of the package that one image runs through in the node, traced on all its threads."""

from functools import partial
from pathlib import Path
import threading

from fixtures import route_images
from pipelines import localizing
import pytest
from robot import LENGTH
from stavpr_msgs.msg import LoopClosure, PlaceMatch
import stavpr_ros
from std_srvs.srv import Trigger

INSTALLED = Path(stavpr_ros.__file__).parent
MOST, MOST_ON_A_MATCH = 31, 41  # files, without compiled code and diagnostics


class Trace:
    """Notes the files of functions that threads call while it is on; set it before they start."""

    def __init__(self):
        self.is_on, self.files = False, set()

    def __call__(self, frame, event, _):
        if not self.is_on or event != 'call':
            return
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(INSTALLED):
            self.files.add(path.relative_to(INSTALLED).as_posix())

    def of(self, function):
        """Return the files that a call runs through, on other threads as well."""
        self.files, self.is_on = set(), True
        try:
            function()
        finally:
            self.is_on = False
        return self.files


@pytest.fixture
def trace(map_file):
    localizing(map_file)  # compiles the kernels: under a profiler it takes minutes
    trace = Trace()
    threading.setprofile(trace)
    yield trace
    threading.setprofile(None)


def test_image_runs_through_few_files(trace, robot, start, route):
    """In mode robust with gradient features, on the same map with and without a match."""
    closures = robot.listen(LoopClosure, '/stavpr/loop_closure')
    start(diagnostics_period=60.0, min_probability=0.5)
    robot.until_logged('is verified')
    for i, image in enumerate(route[20:30]):  # modules are imported at first use
        robot.show_at(20 + i, image)
    statuses = []

    def show(number, image):
        match = robot.show_at(number, image)
        statuses.append(match.status)
        if match.status == PlaceMatch.MATCH:
            stamp = match.header.stamp
            robot.until(lambda: stamp in [c.header.stamp for c in closures], 'the closure')

    def of_each(first, images):
        """Return the files of each of three images: other threads may run beside one of them."""
        traced = (trace.of(partial(show, first + i, image)) for i, image in enumerate(images))
        return set.intersection(*traced)

    on_a_match = of_each(30, route[30:33])
    robot.call(Trigger, 'reset')
    elsewhere = route_images(3 * LENGTH, seed=9)
    robot.drive(elsewhere[:-3])
    always = of_each(33, elsewhere[-3:])
    assert statuses == [PlaceMatch.MATCH] * 3 + [PlaceMatch.NO_MATCH] * 3
    assert {'ros/runtime.py', 'pipeline/pipeline.py', 'recognition/recognizer.py'} <= always
    assert 'relative_pose/odometry.py' in on_a_match - always
    assert len(always) <= MOST, ' '.join(sorted(always))
    assert len(on_a_match) <= MOST_ON_A_MATCH, ' '.join(sorted(on_a_match))
