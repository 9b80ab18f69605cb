# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes teach and repeat over ROS: goals, offsets, velocities, bad input, the end."""

from dataclasses import replace
import math
import signal
import time

from domain import DOMAIN
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
import numpy as np
from policy import names_of
from processes import Process, TIMEOUT
import pytest
import rclpy
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from stavpr_msgs.action import Repeat
from stavpr_msgs.msg import MapInfo, Offset, PlaceMatch
from stavpr_nav.follower import NO_EVIDENCE
from stavpr_nav.ros.repeat_node import RepeatNode
from stavpr_nav.ros.teach_node import TeachNode
from stavpr_nav.taught_run import read_velocities
from stavpr_ros.errors import InputError, OutputError, SettingsError
from stavpr_ros.mapping import load_map, merge_maps, save_map
from stavpr_ros.mapping.merging import select_places
from stavpr_ros.relative_pose.offset import DISTANT
from stavpr_ros.ros.messages import image_message
from std_msgs.msg import Bool, Header
from std_srvs.srv import Trigger

PERIOD = 0.1  # seconds between two images
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
FAST = {'max_acceleration': 100.0, 'max_speed': 2.0}


def overrides(**values):
    return {'parameter_overrides': [Parameter(name, value=v) for name, v in values.items()]}


class Rover:
    """A camera, a recognition node that is right, a dead-man switch, and wheels."""

    def __init__(self, context, images, map_id, kind=Twist):
        self.node = rclpy.create_node('rover', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        publisher, subscribe = self.node.create_publisher, self.node.create_subscription
        self.image = publisher(Image, 'image', qos_profile_sensor_data)
        self.match = publisher(PlaceMatch, 'stavpr/match', 10)
        self.camera = publisher(CameraInfo, 'camera_info', 10)
        self.deadman = publisher(Bool, 'deadman', 10)
        self.commands, self.offsets, self.feedback = [], [], []
        subscribe(kind, 'cmd_vel', self.obey, 10)
        self.obeyed, self.looked = -math.inf, time.monotonic()
        self.clock_publisher = publisher(Clock, 'clock', 10)
        subscribe(Offset, 'repeat/offset', self.offsets.append, 10)
        self.client = ActionClient(self.node, Repeat, 'repeat')
        self.images, self.map_id, self.seam = images, map_id, None
        self.status, self.place, self.pressed, self.damaged = PlaceMatch.MATCH, 3.0, True, False
        self.is_blocked = self.is_paused = False  # by an emergency stop; of the clock
        self.silent, self.every, self.ticks, self.clock = '', 1, 0, None
        self.starter = self.node.create_client(Trigger, 'repeat/start')
        self.node.create_timer(PERIOD, self.look)

    def look(self):
        """Publish what the camera shows, the match, and the switch."""
        self.ticks += 1
        now = time.monotonic()
        elapsed, self.looked = now - self.looked, now
        header = Header(stamp=self.node.get_clock().now().to_msg())
        if self.clock is not None:
            self.clock += round(PERIOD * 1e9) * (not self.is_paused)
            header.stamp = Time(nanoseconds=self.clock).to_msg()
            self.clock_publisher.publish(Clock(clock=header.stamp))
        image = image_message(header, self.images[int(self.place)])
        if self.damaged:
            image.encoding = 'nonsense'
        matched = self.status == PlaceMatch.MATCH
        match = PlaceMatch(header=header, status=self.status, map_id=self.map_id)
        match.newest_index, match.probability = int(self.place) if matched else -1, 0.99
        for name, message in (
            ('deadman', Bool(data=self.pressed)), ('match', match), ('image', image)
        ):  # fmt: skip
            if name != self.silent and (name == 'deadman' or self.ticks % self.every == 0):
                getattr(self, name).publish(message)
        self.camera.publish(CameraInfo(width=128, height=96, k=[64.0, 0, 64, 0, 64, 48, 0, 0, 1]))
        is_obeyed = self.commands and time.monotonic() - self.obeyed < 0.5  # by its watchdog
        if is_obeyed and not self.is_blocked and hasattr(self.commands[-1], 'linear'):
            step = self.commands[-1].linear.x * elapsed
            self.place += step
            last = len(self.images) - 1
            if self.place >= last:
                self.place = last if self.seam is None else self.place - last + self.seam

    def obey(self, command):
        self.commands.append(command)
        self.obeyed = time.monotonic()

    def until(self, done):
        end = time.monotonic() + TIMEOUT
        while not done():
            assert time.monotonic() < end, (self.place, self.commands[-1:], self.feedback[-1:])
            self.executor.spin_once(timeout_sec=0.05)

    def result_of(self, future):
        self.until(future.done)
        return future.result()

    def send(self, **goal):
        """Send a goal; return its handle."""
        self.until(self.client.server_is_ready)
        return self.result_of(self.client.send_goal_async(
            Repeat.Goal(**goal), lambda message: self.feedback.append(message.feedback)
        ))  # fmt: skip

    def begin(self):
        self.send(start_index=3)
        self.until(lambda: self.place > 5)

    def until_reason(self, reason):
        self.until(lambda: self.feedback and self.feedback[-1].reason == reason)

    def drives(self):
        return bool(self.commands) and self.commands[-1].linear.x > 0

    def rests(self):
        return bool(self.commands) and self.commands[-1].linear.x == 0


@pytest.fixture
def rover(request, context, route, map_file):
    rover = Rover(context, route, load_map(map_file).map_id, getattr(request, 'param', Twist))
    yield rover
    rover.executor.shutdown()
    rover.node.destroy_node()


@pytest.fixture
def repeat(context, rover, map_file, request):
    """Make a node that is spun with the rover; it ends with the test."""

    def make(**parameters):
        values = {'map_path': map_file} | FAST | parameters
        node = RepeatNode(context=context, **overrides(**values))
        request.addfinalizer(lambda: node.is_ending or node.destroy_node())
        rover.executor.add_node(node)
        return node

    return make


def test_goal_is_reached_with_feedback_and_velocities_stop(rover, repeat):
    repeat()
    rover.status = PlaceMatch.NO_MATCH
    handle = rover.send(place_index=9)
    rover.until(lambda: len(rover.feedback) > 5)
    assert not rover.commands  # an operator drives until the first match
    rover.status = PlaceMatch.MATCH
    result = rover.result_of(handle.get_result_async()).result
    assert (result.code, result.place_index, result.message) == (Repeat.Result.REACHED, 9, '')
    assert result.distance == pytest.approx(6, abs=1.5)
    assert rover.rests()
    driving = [one for one in rover.feedback if one.speed > 0]
    assert driving
    assert driving[0].distance_to_go <= 6
    assert max(one.probability for one in driving) == pytest.approx(0.99)
    rover.commands.clear()
    images = len(rover.offsets)
    rover.until(lambda: len(rover.offsets) > images + 5)  # without a goal: offsets alone
    assert not rover.commands
    offset = rover.offsets[-1]
    assert (offset.place_index, offset.place_id) == (int(rover.place), f'place {int(rover.place)}')
    assert offset.is_valid
    shift = offset.shift - DISTANT * offset.parallax
    assert offset.heading == pytest.approx(math.atan(shift * 2), abs=1e-6)
    assert abs(offset.heading) < 0.02
    assert abs(offset.lateral) < 2 * offset.lateral_deviation


def test_robot_stands_without_switch_matches_or_images_and_goal_is_canceled(rover, repeat):
    node = repeat(give_up_after=0.0)
    handle = rover.send(start_index=3, place_id='place 50')
    rover.until(rover.drives)
    busy = rover.send()
    assert not busy.accepted  # there is a goal
    for name, value in (
        ('pressed', False),
        ('damaged', True),
        ('map_id', 'other'),
        ('status', PlaceMatch.INVALID_IMAGE),
        *(('silent', source) for source in ('deadman', 'match', 'image')),
    ):
        right = getattr(rover, name)
        rover.until(rover.drives)
        setattr(rover, name, value)
        rover.until(rover.rests)
        setattr(rover, name, right)
    rover.until(rover.drives)
    assert node.counts['invalid images'] > 0
    assert node.counts['matches on another map'] > 0
    (rejected,) = node.set_parameters([Parameter('max_speed', value=9.0)])
    assert not rejected.successful
    place_columns, node._columns = node._columns, None  # any error of one image
    rover.until(rover.rests)
    node._columns = place_columns
    rover.until(rover.drives)
    assert node.counts['failed images'] > 0
    canceled = rover.result_of(handle.cancel_goal_async())
    assert len(canceled.goals_canceling) == 1
    assert rover.result_of(handle.get_result_async()).result.code == Repeat.Result.CANCELED
    assert rover.rests()


@pytest.mark.parametrize('needs_deadman', [True, False])
def test_robot_without_evidence_of_motion_waits_for_a_press_or_start(rover, repeat, needs_deadman):
    """An emergency stop that blocks the wheels looks as a camera does that repeats its image."""
    repeat(give_up_after=0.0, require_deadman=needs_deadman)
    rover.begin()
    rover.is_blocked = True
    rover.until_reason(NO_EVIDENCE)
    rover.is_blocked = False
    for rover.pressed in (True, not needs_deadman):
        rover.commands.clear()
        rover.until(lambda: len(rover.commands) > 20)
        assert not any(command.linear.x for command in rover.commands)
        assert rover.feedback[-1].reason == NO_EVIDENCE
    rover.pressed = True
    if not needs_deadman:
        for success in (True, False):
            answer = rover.result_of(rover.starter.call_async(Trigger.Request()))
            assert answer.success is success
    rover.until(rover.drives)


def test_node_that_is_suspended_goes_on_from_rest(rover, map_file, tmp_path):
    values = {'map_path': map_file, 'give_up_after': 0.0} | FAST
    words = [word for name, value in values.items() for word in ('-p', f'{name}:={value}')]
    process = Process(tmp_path / 'repeat', 'repeat', '--ros-args', *words)
    try:
        rover.begin()
        process.popen.send_signal(signal.SIGSTOP)
        rover.until(lambda: time.monotonic() - rover.obeyed > 1.0)
        place = rover.place  # the base has stopped by itself
        rover.until(lambda: time.monotonic() - rover.obeyed > 2.0)
        assert rover.place == place
        rover.commands.clear()
        process.popen.send_signal(signal.SIGCONT)
        rover.until(rover.drives)
        speeds = [command.linear.x for command in rover.commands]
        assert 0 < speeds[-1] <= 0.3, speeds
    finally:
        process.popen.send_signal(signal.SIGCONT)
        process.end()


def test_paused_clock_stops_the_robot_and_steps_do_not_move_its_place(rover, repeat):
    rover.clock = 10**9
    repeat(give_up_after=0.0, use_sim_time=True)
    rover.begin()
    rover.is_paused = True
    rover.until_reason('the clock does not advance')
    assert rover.rests()
    rover.is_paused = False
    rover.until(rover.drives)
    for seconds in (30, -20):
        place = rover.place
        rover.clock += seconds * 10**9
        rover.until(lambda place=place: rover.place > place + 2)
        assert abs(rover.feedback[-1].place_index - rover.place) <= 2


def test_odometry_that_does_not_come_or_stands_stops_the_robot(rover, repeat):
    repeat(use_odometry=True, give_up_after=0.0)
    odometry = rover.node.create_publisher(Odometry, 'odom', 10)
    rover.send(start_index=3)
    rover.until_reason('no odometry')

    def wheels():
        message = Odometry(header=Header(stamp=rover.node.get_clock().now().to_msg()))
        message.pose.pose.position.x = min(rover.place, 8.0)  # and they stand
        odometry.publish(message)

    rover.node.create_timer(0.05, wheels)
    rover.until_reason(NO_EVIDENCE)


def test_two_laps_of_a_closed_map(rover, repeat, map_file, tmp_path):
    """Its 10 places end where place 2 is; the goal is the second pass of place 5."""
    same_as = np.arange(10, dtype=np.int32)
    same_as[9] = 2
    closed = replace(select_places(load_map(map_file), np.arange(10)), same_as=same_as)
    save_map(closed, tmp_path / 'closed.stavpr')
    repeat(map_path=str(tmp_path / 'closed.stavpr'))
    rover.images, rover.seam = rover.images[:10], 2
    rover.map_id = load_map(tmp_path / 'closed.stavpr').map_id
    handle = rover.send(place_index=5, start_index=3, laps=2)
    assert handle.accepted
    result = rover.result_of(handle.get_result_async()).result
    assert (result.code, result.place_index, result.laps) == (Repeat.Result.REACHED, 5, 1)
    assert result.distance == pytest.approx(9, abs=1.5)
    assert rover.rests()
    assert max(one.laps for one in rover.feedback) == 1


def test_map_of_several_sessions_is_repeated_by_matches_of_any(rover, repeat, map_file, tmp_path):
    """The other session serves recognition: its places are positions of the taught one."""
    first = load_map(map_file)
    n = len(first)
    both = merge_maps([first, first], ['monday', 'tuesday'])
    same_as = np.tile(np.arange(n), 2).astype(np.int32)
    same_as[n + 40 :] = np.arange(n + 40, 2 * n)  # a detour
    save_map(replace(both, same_as=same_as), tmp_path / 'both.stavpr')
    repeat(map_path=str(tmp_path / 'both.stavpr'), give_up_after=2.0)
    rover.images, rover.map_id = rover.images[:n] * 2, load_map(tmp_path / 'both.stavpr').map_id
    rover.place = n + 3.0
    handle = rover.send(place_index=n + 9, start_index=n + 3)
    result = rover.result_of(handle.get_result_async()).result
    assert (result.code, result.place_index) == (Repeat.Result.REACHED, 9)
    assert 3 <= rover.offsets[-1].place_index <= 9
    assert not rover.send(place_index=n + 45).accepted
    rover.place = n + 45.0  # beside the taught run
    result = rover.result_of(rover.send(start_index=3).get_result_async()).result
    assert (result.code, result.distance) == (Repeat.Result.LOST, 0)


def test_intrinsics_are_beside_the_images_unless_remapped(context, map_file):
    for words, topic in (
        (['-r', 'image:=left/image', '-r', 'camera_info:=camera_info'], '/left/camera_info'),
        (['-r', 'image:=left/image', '-r', 'camera_info:=/rear/info'], '/rear/info'),
    ):
        cli = ['--ros-args', *words]
        node = RepeatNode(context=context, **overrides(map_path=map_file), cli_args=cli)
        topics = [name for name, _ in node.get_subscriber_names_and_types_by_node('repeat', '/')]
        node.destroy_node()
        assert topic in topics


def test_node_that_ends_stops_the_robot(rover, repeat):
    node = repeat()
    rover.send(start_index=3)
    rover.until(rover.drives)
    rover.executor.remove_node(node)
    node.destroy_node()
    rover.until(rover.rests)


def test_goals_off_the_route_or_for_another_type_of_velocity_are_rejected(rover, repeat, capfd):
    node, other = repeat(), rclpy.Context()
    for goal in ({'place_index': 60}, {'place_id': 'nowhere'}, {'laps': 2}):
        assert not rover.send(**goal).accepted
    rclpy.init(context=other, domain_id=DOMAIN)
    base = rclpy.create_node('base', context=other)
    base.create_subscription(TwistStamped, 'cmd_vel', print, 10)
    rover.until(lambda: len(node.get_subscriptions_info_by_topic('cmd_vel')) == 2)
    assert not rover.send(start_index=3).accepted
    assert 'msg/Twist: set the parameter stamped to True' in capfd.readouterr().err
    base.destroy_node()
    rclpy.shutdown(context=other)


@pytest.mark.parametrize('rover', [TwistStamped], indirect=True)
def test_lost_robot_gives_up_and_velocities_may_be_stamped(rover, repeat):
    repeat(give_up_after=0.5, stamped=True, base_frame='base')
    rover.status = PlaceMatch.NO_MATCH
    handle = rover.send()
    result = rover.result_of(handle.get_result_async()).result
    assert (result.code, result.place_index) == (Repeat.Result.LOST, -1)
    rover.until(lambda: rover.commands)
    assert rover.commands[-1].header.frame_id == 'base'


@pytest.mark.parametrize('name', ['repeat', 'teach'])
def test_security_policy_allows_what_the_nodes_use(context, repeat, tmp_path, name):
    if name == 'repeat':
        node = repeat()
    else:
        node = TeachNode(context=context, **overrides(run_path=str(tmp_path / 'run.csv')))
    published = node.get_publisher_names_and_types_by_node(name, '/')
    subscribed = node.get_subscriber_names_and_types_by_node(name, '/')
    replied = node.get_service_names_and_types_by_node(name, '/')
    used = {
        right: {topic for topic, _ in names if '/_action/' not in topic}
        for right, names in (('publish', published), ('subscribe', subscribed), ('reply', replied))
    }
    rights = names_of(name)
    assert rights.pop('execute', {'/repeat'}) == {'/repeat'}
    optional = {'/clock', '/image/compressed', '/cmd_vel', '/odom'}
    assert {r: n - optional for r, n in rights.items()} == {
        r: n - optional for r, n in used.items()
    }
    if name == 'teach':
        node.destroy_node()


@pytest.mark.parametrize(
    ('parameters', 'message'),
    [
        ({'gain': 0.0}, 'gain = 0.0 must be a number above 0'),
        ({'give_up_after': -1.0}, 'give_up_after = -1.0'),
        ({'image_transport': 'theora'}, "image_transport = 'theora'"),
        ({'run_path': '/none.csv'}, 'cannot be read as a taught run'),
    ],
)
def test_invalid_parameters_are_rejected(context, map_file, parameters, message):
    with pytest.raises((SettingsError, InputError), match=message):
        RepeatNode(context=context, **overrides(map_path=map_file, **parameters))


@pytest.mark.parametrize('source', ['odom', 'cmd_vel', 'cmd_vel_stamped'])
def test_velocities_are_recorded(context, tmp_path, source):
    path = tmp_path / 'run.csv'
    node = TeachNode(context=context, **overrides(run_path=str(path), source=source))
    sender = rclpy.create_node('wheels', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    kind, topic = {
        'odom': (Odometry, 'odom'),
        'cmd_vel': (Twist, 'cmd_vel'),
        'cmd_vel_stamped': (TwistStamped, 'cmd_vel'),
    }[source]
    message = kind()
    twist = getattr(message, 'twist', message)
    twist = getattr(twist, 'twist', twist)
    twist.linear.x, twist.angular.z = 0.5, -0.25
    publisher = sender.create_publisher(kind, topic, 10)
    infos = sender.create_publisher(MapInfo, 'stavpr/map_info', LATCHED)
    end, stamp = time.monotonic() + TIMEOUT, 0
    while len(path.read_text().splitlines()) < 6 or 'new' not in path.read_text():
        assert time.monotonic() < end
        stamp += 1
        if hasattr(message, 'header'):
            message.header.stamp.sec = 100 + stamp
        publisher.publish(message)
        infos.publish(MapInfo(operation='mapping', sessions=['old', 'new']))
        executor.spin_once(timeout_sec=0.05)
    with pytest.raises(OutputError, match='File exists'):
        TeachNode(context=context, **overrides(run_path=str(path)))
    executor.shutdown()
    node.destroy_node()
    sender.destroy_node()
    velocities, session = read_velocities(path)
    assert session == 'new'
    np.testing.assert_allclose(velocities[:, 1:], [[0.5, -0.25]] * len(velocities))


def test_executables_start_and_end(map_file, tmp_path):
    run = tmp_path / 'run.csv'
    teach = Process(tmp_path / 'teach', 'teach', '--ros-args', '-p', f'run_path:={run}')
    repeat = Process(tmp_path / 'repeat', 'repeat', '--ros-args', '-p', f'map_path:={map_file}')
    try:
        end = time.monotonic() + TIMEOUT
        while 'waiting for a goal' not in repeat.output() or 'recording' not in teach.output():
            assert time.monotonic() < end
            time.sleep(0.1)
        assert (repeat.stop(), teach.stop()) == (0, 0)
    finally:
        repeat.end()
        teach.end()
    assert run.read_text() == 'stamp,speed,turn\n'
