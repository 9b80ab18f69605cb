# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The monitor: its history, its web server, and the node that it shows."""

from http.client import HTTPConnection
from importlib.resources import files
from itertools import cycle
import json
import math
import re
import shutil
import signal
import subprocess
import threading
import time

import cv2
from lifecycle_msgs.srv import GetState
from processes import Process, TIMEOUT
import pytest
import rclpy
from robot import LENGTH
from sensor_msgs.msg import Image
from stavpr_lab.commands import monitor
from stavpr_lab.monitor.node import History, Monitor
from stavpr_lab.monitor.server import MonitorServer
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.errors import StavprError, UnavailableError
from stavpr_ros.palette import BLUE, INK, ORANGE, VERMILION

CHROMIUM = shutil.which('chromium')


@pytest.fixture
def history():
    return History(sample_seconds=0)


def test_history_since_a_version_returns_what_has_changed(history):
    history.set('state', 'active')
    history.add({'place': 1})
    version, changes = history.since(0, TIMEOUT)
    assert changes == {'state': 'active', 'samples': [{'place': 1}]}
    history.set('state', 'active')  # no change
    history.add({'place': 2})
    version, changes = history.since(version, TIMEOUT)
    assert changes == {'samples': [{'place': 2}]}
    assert history.since(version, 0) == (version, {'samples': []})


def test_history_has_no_number_that_json_lacks(history):
    history.set('pose', [1.0, math.nan])
    history.add({'probability': math.inf})
    changes = history.since(0, TIMEOUT)[1]
    assert changes == {'pose': [1.0, None], 'samples': [{'probability': None}]}


def test_history_keeps_a_match_just_after_a_dropped_image():
    history = History(sample_seconds=100)
    for status in ('dropped', 'skipped', 'match', 'no match', 'dropped'):
        history.add({'status': status})
    samples = history.since(0, 0)[1]['samples']
    assert [sample['status'] for sample in samples] == ['dropped', 'match']


# the server


@pytest.fixture
def browser(history):
    """Return a function that sends a request, with the commands that the server has run."""
    commands = []

    def command(name, value):
        commands.append((name, value))
        if name == 'stop':
            raise StavprError('not now')
        return f'{name} {value}'

    server = MonitorServer('127.0.0.1', 0, history, command)
    server.start()

    def request(method, path, body=None, **headers):
        connection = HTTPConnection('127.0.0.1', server.server_port, timeout=TIMEOUT)
        names = {name.replace('_', '-'): value for name, value in headers.items()}
        connection.request(method, path, body, names)
        response = connection.getresponse()
        content = response.read() if path != '/events' else response.readline()
        connection.close()
        return response.status, content

    request.commands, request.server = commands, server
    yield request
    server.stop()


@pytest.mark.parametrize('port', ['80000', '-1', 'web'])
def test_monitor_on_a_port_that_is_none_is_a_wrong_usage(port, capsys):
    with pytest.raises(SystemExit, match='2'):
        monitor.main([f'--port={port}'])
    assert 'expected a port, 0 to 65535' in capsys.readouterr().err


def test_server_serves_the_page_the_events_and_the_image(browser, history):
    status, page = browser('GET', '/')
    assert status == 200
    assert b'<canvas id="matrix"' in page
    colors = dict(re.findall(r'--(\w+): (#\w{6});', page.decode().partition('@media')[0]))
    palette = {'ok': BLUE, 'warn': ORANGE, 'error': VERMILION, 'ink': INK}
    assert palette.items() <= colors.items()
    # nothing from the network
    assert not re.findall(rb'(?:src|href)="(?!data:)|https?://|@import|url\(', page)
    assert browser('GET', '/image.jpg')[0] == 404
    history.set('state', 'active')
    history.show(b'jpeg')
    status, line = browser('GET', '/events')
    events = json.loads(line.removeprefix(b'data: '))
    assert events.pop('now') == pytest.approx(time.monotonic(), abs=TIMEOUT)
    assert events.pop('image') == pytest.approx(time.monotonic(), abs=TIMEOUT)
    assert (status, events) == (200, {'state': 'active', 'samples': []})
    assert browser('GET', '/image.jpg?2') == (200, b'jpeg')
    assert browser('GET', '/../setup.py')[0] == 404


EVENTS = """<script>
class EventSource {
  constructor() {
    setTimeout(() => { this.onopen(); this.onmessage({ data: JSON.stringify(NEWS) }); });
  }
}
</script>"""


SECTIONS = 'images', 'position', 'distances', 'probability', 'health'


@pytest.mark.skipif(CHROMIUM is None, reason='Chromium is not installed')
@pytest.mark.parametrize('route', [[], [[0, 0], [9, 4]]], ids=['places', 'poses'])
@pytest.mark.parametrize('old', [0, 104])
def test_page_shows_a_result_of_long_ago_as_such(history, tmp_path, old, route):
    numbers = {'place': 40, 'nearest': 40, 'probability': 0.9, 'distance': 0.1, 'threshold': 0.5}
    history.set('map', {'operation': 'localization', 'state': 'fixed', 'places': 90, 'path': ''})
    history.set('route', route)
    history.set('pose', [4, 2, 0, 7.0])
    texts = {'status': 'match', 'reason': '', 'row': 'AP+A'}
    history.set('diagnostics', {'time': 7.0, 'statuses': []})
    history.add({'time': 7.0, 'span': [0, 1]} | texts | numbers)
    news = json.dumps(history.since(0, 0)[1] | {'now': 7.0 + old})
    content = (files('stavpr_lab.monitor') / 'page.html').read_text()
    page = tmp_path / 'page.html'
    page.write_text(content.replace('<script>', f'{EVENTS.replace("NEWS", news)}<script>', 1))
    options = ['--headless=new', '--no-sandbox', '--disable-gpu', '--window-size=900,900']
    options += ['--virtual-time-budget=1500', f'--user-data-dir={tmp_path / "profile"}']
    shot = tmp_path / f'{old}.png'
    outputs = ['--dump-dom'], [f'--screenshot={shot}']
    for _ in range(3):  # on a busy machine, the events may come after the page's budget of time
        shown, _ = (
            subprocess.check_output(
                [CHROMIUM, *options, *output, page.as_uri()], text=True, timeout=100
            )
            for output in outputs
        )
        now = re.search(r'<div id="now"[^>]*>[^<]*', shown)[0]
        if 'no image yet' not in now:
            break
    assert 'place 40' in now
    sections = re.findall(r'<section id="(\w+)"(?: class="(stale)?")?>', shown)
    assert sections == [(name, 'stale' * (old > 0)) for name in SECTIONS]
    ages = re.findall(r'class="age">(\d+)[.\d]* s ago<', shown)
    assert len(ages) == len(SECTIONS)
    assert all(old <= int(age) < old + TIMEOUT for age in ages)
    pixels = cv2.imread(str(shot)).astype(int)[:, 530:]  # position on the map, and the right half
    is_blue = pixels[..., 0] - pixels[..., 2] > 120
    assert bool(is_blue[:350].sum() > 50) is (old == 0)


def test_server_runs_commands_and_returns_their_errors(browser):
    sent = {'Content_Type': 'application/json'}
    body = json.dumps({'name': 'operation', 'value': 'mapping'})
    status, answer = browser('POST', '/command', body, **sent)
    assert (status, json.loads(answer)) == (200, {'success': True, 'message': 'operation mapping'})
    status, answer = browser('POST', '/command', '{"name": "stop"}', **sent)
    assert json.loads(answer) == {'success': False, 'message': 'not now'}
    assert browser.commands == [('operation', 'mapping'), ('stop', '')]


@pytest.mark.parametrize(
    ('body', 'changes', 'status'),
    [
        ('{"name": "stop"}', {'Content_Type': 'text/plain'}, 400),  # a page of another site can
        ('{"name": "stop"}', {'Content_Type': 'application/x-www-form-urlencoded'}, 400),
        ('{"name": "stop"}', {'Host': 'evil.org:80'}, 403),
        ('{"name": "stop"}', {'Origin': 'http://evil.org'}, 403),
        ('[]', {}, 400),
        ('[' * 9000, {}, 400),
        ('no JSON', {}, 400),
        (r'{"name": "operation", "value": "\ud800"}', {}, 400),
        (r'{"name": "\ud800"}', {}, 400),
        ('{}', {'Content_Length': '99999'}, 400),
        ('{}', {'Content_Length': 'x'}, 400),
    ],
)
def test_server_refuses_commands_of_other_sites_and_garbage(browser, body, changes, status):
    headers = {'Content_Type': 'application/json'} | changes
    assert browser('POST', '/command', body, **headers)[0] == status
    assert browser.commands == []


@pytest.mark.parametrize('host', ['localhost:8080', '127.0.0.1', '[::1]:80', '192.168.1.7:8080'])
def test_server_accepts_addresses_of_this_machine(browser, host):
    assert browser('GET', '/', Host=host)[0] == 200


def test_server_on_a_port_in_use_is_rejected(browser, history):
    port = browser.server.server_port
    with pytest.raises(UnavailableError, match=f'127.0.0.1:{port} cannot be used: .*--port'):
        MonitorServer('127.0.0.1', port, history, None)


# the node


def test_monitor_shows_and_controls_the_node(robot, start, route, history):
    start()
    monitor = Monitor(robot.node, '/stavpr', history)

    def view():
        return history.since(0, TIMEOUT)[1]

    def command(name, value=''):
        results = []
        thread = threading.Thread(target=lambda: results.append(monitor.command(name, value)))
        thread.start()
        robot.until(lambda: not thread.is_alive(), name)
        return results[0]

    with history.viewer():
        robot.until(lambda: view().get('state') == 'active', 'the state')
        robot.until(lambda: 'route' in view(), 'the route')
        robot.drive(route[: LENGTH + 3])
        shown_images = cycle(route)

        def complete():
            robot.show(next(shown_images))
            return history.image and 'pose' in view() and view()['samples'][-1]['row']

        robot.until(complete, 'an image, a pose and distances')
    parts = view()
    assert parts['map']['places'] == len(parts['route']) == 60
    match = next(sample for sample in parts['samples'] if sample['status'] == 'match')
    assert match['probability'] > 0.05
    statuses = parts['diagnostics']['statuses']
    assert {status['name'].split()[-1] for status in statuses} >= {'input', 'map'}
    assert history.image[:2] == b'\xff\xd8'
    robot.until(lambda: monitor._images is None, 'no subscription without a page')
    assert command('reset') == 'the window is empty'
    assert command('stop') == 'deactivate: done'
    robot.until(lambda: view()['state'] == 'inactive', 'the state')
    assert command('start') == 'activate: done'
    assert command('operation', 'mapping') == 'operation mapping'
    robot.until(lambda: view()['map']['operation'] == 'mapping', 'the operation')
    with pytest.raises(StavprError, match='expected start, stop, reset or operation'):
        monitor.command('explode', '')


def test_monitor_without_a_node_refuses_commands(context, history):
    node = rclpy.create_node('lonely', context=context)
    monitor = Monitor(node, 'nobody', history)
    with pytest.raises(StavprError, match='/nobody is not running'):
        monitor.command('stop', '')
    assert history.since(0, TIMEOUT)[1]['state'] == 'not found'
    node.destroy_node()


def test_monitor_does_not_know_the_state_of_a_node_that_does_not_answer(
    context, history, monkeypatch
):
    node = rclpy.create_node('lonely', context=context)
    node.create_service(GetState, 'silent/get_state', None)  # nobody spins it
    monitor = Monitor(node, 'silent', history)
    monkeypatch.setattr('stavpr_lab.monitor.node.STALE_SECONDS', -1)
    assert monitor._get_state.wait_for_service(TIMEOUT)
    monitor._poll()
    assert history.since(0, 0)[1]['state'] == 'not found'
    monitor._poll()
    assert history.since(0, 0)[1]['state'] == 'no answer'
    node.destroy_node()


def test_monitor_survives_messages_of_other_nodes(context, history):
    node = rclpy.create_node('lonely', context=context)
    Monitor(node, 'nobody', history)
    receive = {s.topic_name: s.callback for s in node.subscriptions}
    receive['/nobody/match'](PlaceMatch(status=200, probability=math.nan))
    for data in (b'', b'12345'):
        receive['/nobody/distances'](Image(data=data))
    assert history.since(0, TIMEOUT)[1]['samples'][0]['status'] == 'unknown'
    node.destroy_node()


def test_monitor_executable_serves_the_page_until_a_signal(tmp_path):
    process = Process(tmp_path / 'monitor.log', 'monitor', '--port', '0')
    try:
        address = re.compile(r'monitor of /stavpr: open http://127.0.0.1:(\d+)/')
        end = threading.Event()
        while not (result := address.search(process.output())):
            assert process.popen.poll() is None
            end.wait(0.05)
        connection = HTTPConnection('127.0.0.1', int(result[1]), timeout=TIMEOUT)
        connection.request('GET', '/events')
        assert b'not found' in connection.getresponse().readline()
        assert process.stop(signal.SIGINT) == 0  # with a page open
    finally:
        process.end()
