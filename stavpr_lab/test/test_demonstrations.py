# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Demonstrations: the synthetic street, its days, blind stretches, teach and repeat, processes."""

from dataclasses import replace
import fcntl
import math
import os
import socket
import subprocess

import cv2
from evaluation_commands import write_images
from map_examples import VERSION2
import numpy as np
from PIL import Image
from processes import environment, executable, SECOND, TIMEOUT
import pytest
import rclpy
from stavpr_lab.commands import demo
from stavpr_lab.demonstration import blind, live
from stavpr_lab.demonstration.blind import is_slow
from stavpr_lab.demonstration.days import plot, run, table
from stavpr_lab.demonstration.false_closures import FalseClosures
from stavpr_lab.demonstration.false_places import FalsePlaces, NEAR, RUN
from stavpr_lab.demonstration.graph_client import fetch_graph
from stavpr_lab.demonstration.live import run_live
from stavpr_lab.demonstration.recordings import Recording
from stavpr_lab.demonstration.repeat import (
    animate,
    CONDITIONS,
    repeat,
    STEP,
    teach,
    View,
)
from stavpr_lab.demonstration.repeat import (
    plot as plot_repeat,
)
from stavpr_lab.demonstration.street.days import Days
from stavpr_lab.demonstration.street.laps import drive_laps, RingWorld
from stavpr_lab.demonstration.street.rendering import center_line_ahead, FOCAL
from stavpr_lab.demonstration.street.street import CELL
from stavpr_lab.demonstration.street.traverses import (
    GOOD_LIGHT,
    nearest_places,
    RAINY_DUSK,
    second_traverse,
    Traverse,
    World,
)
from stavpr_msgs.msg import AlignedPlaces, LoopClosure
from stavpr_nav.follower import NO_EVIDENCE
from stavpr_ros.errors import StavprError
from stavpr_ros.relative_pose.expansion import Expansion
from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter
from stavpr_ros.ros.messages import time_message

SIZE = (96, 72)
STILL = replace(GOOD_LIGHT, noise=0.0, shake=0.0)


@pytest.fixture(scope='module')
def world():
    return World(7)


def view(world, along, conditions, size=SIZE):
    """Render one image on the street."""
    return Traverse(world, np.array([along]), np.array([False]), conditions, size=size)[0].image


def test_world_with_same_seed_renders_same_bytes():
    one, same, other = (second_traverse(World(seed), 40, SIZE) for seed in (3, 3, 4))
    assert all(np.array_equal(one[k].image, same[k].image) for k in (0, 17, 39))
    assert not np.array_equal(one[17].image, other[17].image)


def shift_of_patch(before, after, x, y, size=36, reach=14):
    """Find how many pixels a patch has moved sideways."""
    patch = before[y : y + size, x : x + size]
    strip = after[y : y + size, x - reach : x + size + reach]
    return int(cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED).argmax()) - reach


def test_render_with_lateral_step_shows_parallax(world):
    """Houses at the sides are about 20 m away, the vanishing point 60 m and more."""
    near, far = [], []
    for along in np.arange(20.0, 320.0, 20.0):
        before = view(world, along, replace(STILL, lane=0.0), (320, 240))
        after = view(world, along, replace(STILL, lane=0.6), (320, 240))
        near += [shift_of_patch(before, after, x, 60) for x in (24, 260)]
        far.append(shift_of_patch(before, after, 142, 116))
    # the camera steps to the right, the image moves to the left
    assert -9 <= np.median(near) <= -3
    assert abs(np.median(far)) <= 2
    assert abs(np.median(near)) >= 2 * abs(np.median(far))


def test_nearest_places_by_hand(world):
    def traverse(along, detour):
        return Traverse(world, np.array(along), np.array(detour), STILL, size=SIZE)

    first = traverse([0.0, 2.0, 4.0, 6.0], [False] * 4)
    second = traverse([0.9, 1.1, 50.0, 6.9, 3.0], [False, False, True, False, False])
    assert nearest_places(first, second).tolist() == [0, 1, -1, 3, 1]  # the lower one on a tie
    assert np.isnan(second.position[2])


@pytest.mark.parametrize('image', [40, 260, 620])
def test_center_line_ahead_of_closed_street_agrees_with_poses(image):
    drive = drive_laps(5)
    lap, number = drive.images[image].tolist()
    traverse = drive.laps[lap]
    street, along = traverse._streets[0], float(traverse.along[number])
    ahead = center_line_ahead(street, along)[:80]
    x, y, yaw = drive.truth[image]
    across, _, turned = traverse.camera(number)
    yaw += turned  # the camera is turned in the street
    forward, right = np.array([np.cos(yaw), np.sin(yaw)]), np.array([np.sin(yaw), -np.cos(yaw)])
    result = [x, y] + ahead[:, :1] * forward + (ahead[:, 1:2] - across) * right
    line = RingWorld(5).center_line
    cells = (int(along / CELL) + 1 + np.arange(80)) % (len(line) - 1)
    assert np.abs(result - line[cells, :2]).max() < 1e-3  # the ends meet to 0.2 mm


DAYS = Days(
    images=200, size=(96, 72), length=300.0, closed=(2, 4, 160.0, 200.0), built=(5, 20, 40)
)


@pytest.fixture(scope='module')
def results():
    return list(run(DAYS, 5))


def test_updated_map_knows_the_detour_and_keeps_four_drives(results):
    first, updated, int8 = np.array([day.recall for day in results]).T
    assert all('added the drive' in ' '.join(day.changes) for day in results)
    for day in (2, 3):  # the second and third day on which the road is closed
        assert updated[day] > first[day] + 0.05
    assert updated[4] >= first[4] - 0.03
    assert (int8 >= updated - 0.02).all()
    assert [day.places[1] / day.places[0] for day in results] == [2, 3, 4, 4, 4]
    assert [day.vanished > 0 for day in results] == [False] * 4 + [True]


def test_results_are_a_table_and_a_plot(results, tmp_path):
    assert len(table(results).splitlines()) == 7
    plot(results, tmp_path / 'days.png')
    with Image.open(tmp_path / 'days.png') as image:
        assert np.asarray(image).std() > 5


def test_days_change_light_shops_and_buildings():
    days = Days(length=100.0, images=20, built=(2, 20.0, 60.0), closed=(1, 1, 30.0, 50.0))
    lots = [days.street(day).lots for day in range(3)]
    assert np.any(lots[0]['red'] != lots[1]['red'])
    moved = lots[1]['height'] != lots[2]['height']
    assert moved.any()
    assert (lots[1]['start'] == lots[2]['start']).all()
    assert ((lots[1]['start'][moved] >= 20) & (lots[1]['start'][moved] < 60)).all()
    assert len({days.conditions(day) for day in range(5)}) == 5
    assert days.drive(1).detour.any()
    assert not days.drive(2).detour.any()
    assert (np.diff(days.drive(2).along) > 0).all()


LIMITS = {(0.25, 10.0): 0.6, (0.25, 5.0): 1.0, (0.5, 10.0): 0.9, (0.5, 5.0): 1.3}
REASONS = {'odometry ends: meters after it': 'no odometry', 'the camera ends': 'no new image'}
BRIDGE = 'the bridge: other images, without a match'


@pytest.mark.parametrize('name', [n for n, f in blind.FAILURES.items() if not is_slow(f)])
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


def offsets(share: float, coherent: bool) -> np.ndarray:
    """Return how far the chosen places of 200 closures are from their own."""
    false = FalsePlaces(share, coherent, 1)
    return np.array([false.place(i, range(2 * i + 1)) - i for i in range(200)])


def test_false_places_at_random_are_a_share_and_far():
    off = offsets(0.3, False)
    assert 0.15 < (off != 0).mean() < 0.45
    assert np.abs(off[off != 0]).min() > NEAR - 1
    assert not offsets(0.0, False).any()


def test_false_places_coherent_are_runs():
    off = offsets(0.5, True)
    assert (off != 0).any()
    changes = np.flatnonzero(np.diff(off != 0)) + 1
    assert not (changes % RUN).any()


def test_false_closure_is_relayed_with_the_stamps_of_its_place(default_context, monkeypatch):
    sent = []
    monkeypatch.setattr(
        rclpy.publisher.Publisher, 'publish', lambda _, message: sent.append(message)
    )
    monkeypatch.setattr(FalsePlaces, 'place', lambda *_: 7)
    node = FalseClosures(1.0, False, 1)
    (subscription,) = node.subscriptions
    message = LoopClosure(query_index=300, place_index=0)
    message.relative_pose.place_stamp = time_message(SECOND)
    message.pairs = [AlignedPlaces(place_index=7, place_stamp=time_message(8 * SECOND))]
    subscription.callback(message)
    node.destroy_node()
    relative = sent[-1].relative_pose
    assert sent[-1].place_index == relative.place_index == 7
    assert sent[-1].place_stamp == relative.place_stamp == time_message(8 * SECOND)


def test_fetch_graph_without_node_names_what_is_missing():
    with pytest.raises(StavprError, match=r'pose_graph: 3 closures not in 0\.3 s'):
        fetch_graph([], 3, timeout=0.3)


def test_run_live_returns_why_the_node_cannot_start(tmp_path, route):
    images = write_images(tmp_path / 'images', route[:1])
    parameters = {'map_path': VERSION2 / 'onnx.stavpr', 'model_path': tmp_path}
    with pytest.raises(StavprError, match=r'node cannot start: the model with sha256 [0-9a-f]'):
        run_live(parameters, Recording(str(images)), 1, tmp_path)
    assert 'copy the file that the map was built with there' in (tmp_path / 'node.log').read_text()


def test_domain_is_free_and_its_settings_are_its_own(environ, monkeypatch):
    kept = {'ROS_DISTRO': 'jazzy', 'ROS_LOG_DIR': '/log'}
    foreign = {'ROS_DOMAIN_ID': '7', 'ROS_STATIC_PEERS': 'robot', 'RMW_IMPLEMENTATION': 'rmw_none'}
    foreign |= {'FASTRTPS_DEFAULT_PROFILES_FILE': '/none', 'RCUTILS_CONSOLE_OUTPUT_FORMAT': ''}
    environ |= kept | foreign
    monkeypatch.setattr(live.random, 'sample', lambda *_: [41, 41, 42])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('', 7410 + 250 * 41))  # as one that uses domain 41
        environment = live.private_domain()
    own = {'ROS_DOMAIN_ID': '42', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    expected = kept | own | {'PATH': os.environ['PATH']}
    assert {name: environment.get(name) for name in foreign | expected} == (
        dict.fromkeys(foreign) | expected
    )


def test_second_demonstration_in_a_folder_is_refused(tmp_path, capsys):
    with (tmp_path / demo.WRITTEN).open('a') as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        assert demo.main(['--output', str(tmp_path)]) == 2
    assert f'another demo writes to {tmp_path}: give another --output' in capsys.readouterr().err


NO_TORCH = """
import sys

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] == 'torch':
            raise ModuleNotFoundError("No module named 'torch'", name=name)

sys.meta_path.insert(0, NoTorch())
"""


@pytest.mark.parametrize('features', ['gradient', 'hybrid'])
def test_demo_needs_no_torch_in_any_of_its_processes(tmp_path, route, features):
    (tmp_path / 'sitecustomize.py').write_text(NO_TORCH)
    path = os.pathsep.join([str(tmp_path), os.environ.get('PYTHONPATH', '')])
    images = str(write_images(tmp_path / 'images', route))
    options = ['--map', images, '--query', images, '--truth', 'identity', '--output', 'output']
    done = subprocess.run(
        [executable('demo'), *options, '--features', features],
        cwd=tmp_path, env=environment() | {'PYTHONPATH': path}, timeout=3 * TIMEOUT,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    matches = (tmp_path / 'output' / 'matches.jsonl').read_text().splitlines()
    assert len(matches) == len(route)
    assert '"status": "MATCH"' in matches[-20]


# Teach and repeat in the simulator: a short lap, a covered camera, another route

COVERED = 20.0  # seconds


@pytest.fixture(scope='module')
def lesson():
    return teach(RingWorld(7), 0.0, 60.0)


def cover(image, time):
    """Cover the camera after some seconds; noise is left."""
    dark = np.random.default_rng(round(time * 10)).normal(15, 3, image.shape)
    return image if time < COVERED else dark.clip(0, 255).astype(np.uint8)


def test_robot_returns_to_its_path_at_dusk_and_stops_when_covered(lesson, tmp_path):
    images = []

    def change(image, time):
        images.append(image)
        return cover(image, time)

    drive = repeat(lesson, CONDITIONS['dusk'], COVERED + 3, begin=10, change=change)
    assert drive.errors[0] == pytest.approx((1.0, math.radians(10)), abs=0.05)
    driven = np.cumsum(drive.speeds) * STEP
    assert driven[-1] > 25
    assert drive.within(0.5) >= 0.95
    assert drive.within(1.0, after=15.0) == 1.0
    assert drive.presses == 0
    covered = drive.times >= COVERED
    assert drive.speeds[covered][0] > 1
    assert drive.speeds[covered & (drive.times > COVERED + 1)].max() < 0.05
    assert drive.reasons[-1] == 'not localized on the route'
    plot_repeat(lesson, [('dusk', drive)], tmp_path / 'repeat.png')
    assert (tmp_path / 'repeat.png').stat().st_size > 10_000
    animate(lesson, drive, images[:15], tmp_path / 'repeat.webp')
    assert (tmp_path / 'repeat.webp').stat().st_size > 10_000


@pytest.mark.parametrize(('seed', 'seconds', 'meters'), [(11, 4.5, 8), (13, 1, 1.2)])
def test_robot_stops_where_the_camera_shows_another_route(lesson, seed, seconds, meters):
    """Street 11 has the same cars as the taught one, at the same places."""
    world = RingWorld(seed)
    other, line, shown = View(world, CONDITIONS['day']), world.center_line[:-1], []

    def change(image, time):
        if time < 12:
            return image
        shown.append(other.image(line[round(0.5 / CELL) * len(shown)], len(shown)))
        return shown[-1]

    drive = repeat(lesson, CONDITIONS['day'], 12.5 + seconds, begin=10, change=change)
    assert drive.speeds[drive.times < 12][-1] > 2
    assert drive.speeds[drive.times >= 12 + seconds].max() < 0.05
    assert drive.speeds[drive.times >= 12].sum() * STEP < meters


def test_robot_on_another_route_does_not_move(lesson):
    drive = repeat(lesson, CONDITIONS['day'], 4.0, begin=10, world=RingWorld(11))
    assert drive.speeds.max() == 0


def test_view_at_a_pose_of_the_street(lesson):
    view, line = View(lesson.world, CONDITIONS['day']), lesson.world.center_line
    for along in (0.3, 123.4, 599.6):
        cell = int(along / CELL)
        x, y, heading = line[cell]
        ahead, right = along - cell * CELL, 1.3
        pose = np.array([
            x + ahead * math.cos(heading) + right * math.sin(heading),
            y + ahead * math.sin(heading) - right * math.cos(heading),
            heading,
        ])  # fmt: skip
        assert view.on_street(pose) == pytest.approx((along, right), abs=1e-6)


def test_heading_on_the_other_lane_at_dusk_in_rain():
    """The end of the street is not infinitely far: it is shifted as well, by about 1.5 degrees."""
    along, world = np.arange(100, 140, 2.0), World(21)
    lesson, other = (
        Traverse(world, along, np.zeros(len(along), bool), light)
        for light in (GOOD_LIGHT, RAINY_DUSK)
    )
    estimator, errors = OffsetFilter(), []
    for k in range(len(along)):
        columns = [describe_columns(traverse[k].image) for traverse in (other, lesson)]
        offset = estimator.update(*columns)
        truth = lesson.camera(k)[2] - other.camera(k)[2]
        errors.append((offset.heading(FOCAL) - truth, math.atan(offset.shift / FOCAL) - truth))
    rms = np.degrees(np.sqrt(np.mean(np.square(errors), axis=0)))
    assert rms[0] < 1.2
    assert rms[0] < 0.8 * rms[1]


def test_lateral_offset_in_meters_at_dusk(lesson):
    columns = [describe_columns(lesson.place_map.thumbnail(k)) for k in range(70)]
    expansion = Expansion(columns.__getitem__, lesson.run.distances[:70])
    view = View(lesson.world, CONDITIONS['dusk'])
    for left in (1.0, -1.0):
        estimator, results = OffsetFilter(), []
        for k in range(30, 60, 2):
            x, y, heading = lesson.poses[k]
            pose = x - left * math.sin(heading), y + left * math.cos(heading), heading
            offset = estimator.update(describe_columns(view.image(np.array(pose), k)), columns[k])
            results.append(expansion.lateral(offset, k, FOCAL))
        lateral, deviation = np.median(results, axis=0)
        assert lateral == pytest.approx(left, abs=0.4)
        assert 0.1 < deviation < 1.0
