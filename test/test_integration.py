# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes of the program in docs/integration.md, from outside."""

from functools import partial
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys

from processes import environment, TIMEOUT
import pytest
from robot import image_message, RELIABLE, SECOND
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceMatch

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'integration.md'
CAMERAS = 'front', 'rear'


@pytest.fixture
def program(map_file, tmp_path):
    """Run the documented program in a folder with a map for each camera."""
    (source,) = re.findall(r'^```python\n(.*?)^```', PAGE.read_text(), re.M | re.S)
    (tmp_path / 'program.py').write_text(source)
    for camera in CAMERAS:
        shutil.copy(map_file, tmp_path / f'{camera}.stavpr')
    with (tmp_path / 'log').open('w') as log:
        command, output = [sys.executable, 'program.py'], {'stdout': log, 'stderr': log}
        process = subprocess.Popen(command, cwd=tmp_path, env=environment(), **output)
    yield process
    process.kill()
    process.wait()
    text = (tmp_path / 'log').read_text()
    print(text)
    assert 'Traceback' not in text


def have(matches, header):
    return all(received[-1].header == header for received in matches)


def test_documented_program_recognizes_with_two_cameras_and_ends(robot, program, route):
    """Images of both at the same time; each is matched on the map of its camera."""
    matches = {c: robot.listen(PlaceMatch, f'/{c}/stavpr/match', RELIABLE) for c in CAMERAS}
    publishers = {c: robot.node.create_publisher(Image, f'/{c}/image', RELIABLE) for c in CAMERAS}

    def discovered():  # an empty image or its match may be lost before
        for camera in CAMERAS:
            if not matches[camera]:
                publishers[camera].publish(Image())
        return all(matches.values())

    robot.until(discovered, 'both nodes')
    for number, image in enumerate(route, 1):
        message = image_message(image, robot.stamp + number * SECOND)
        for publisher in publishers.values():
            publisher.publish(message)
        robot.until(partial(have, matches.values(), message.header), f'matches of image {number}')
    for camera in CAMERAS:
        last = [match for match in matches[camera] if match.status == PlaceMatch.MATCH][-1]
        assert abs(last.newest_index - 59) <= 1, camera
    program.send_signal(signal.SIGINT)
    assert program.wait(TIMEOUT) == 0
