"""The executables as a user runs them: exit codes, messages, files."""

import json
import math
import signal
import subprocess
import time

import cv2
import numpy as np
import pytest
from conftest import route_images
from processes import TIMEOUT, Process, executable
from test_trajectory import write_odometry

from stavpr_msgs.msg import AlignedPlaces, LoopClosure, PlaceMatch
from stavpr_ros.commands import build_map as build_map_command
from stavpr_ros.commands import record as record_command
from stavpr_ros.commands.demo import TOPIC, make_room
from stavpr_ros.commands.loop_demo import read_result
from stavpr_ros.commands.record import loop_closure_record, match_record
from stavpr_ros.demonstration.loop_plots import choose_closures
from stavpr_ros.errors import SourceError
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.records import evaluate_records
from stavpr_ros.mapping import load_map
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord


def run(name, *arguments):
    command = [executable(name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)


def write_images(folder, images):
    folder.mkdir()
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f'{i}.png'), image[:, :, ::-1])
    return folder


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    return write_images(tmp_path_factory.mktemp('drive') / 'images', route_images(24))


@pytest.mark.parametrize('name', ['node', 'build_map', 'replay', 'record', 'demo', 'evaluate', 'experiments'])
def test_help(name):
    result = run(name, '--help')
    assert result.returncode == 0
    assert 'usage:' in result.stdout
    assert 'exit codes' in result.stdout


def test_build_map(drive, tmp_path):
    poses = tmp_path / 'poses.csv'
    poses.write_text('# x, y, z\n' + ''.join(f'{i}, 0, 0\n' for i in range(24)))
    output = tmp_path / 'map.stavpr'
    options = ['--every', 2, '--poses', poses, '--projection', 32, '--strips', 5]
    result = run('build_map', '--input', drive, '--output', output, *options)
    assert result.returncode == 0, result.stderr
    assert '12 places, 5 strips of 32 dimensions' in result.stdout
    place_map = load_map(output)
    assert place_map.ids[3] == '6.png'
    assert place_map.poses[3].tolist() == [6, 0, 0, 0, 0, 0, 1]


def test_build_map_of_keyframes(drive, tmp_path):
    """Every second image, two meters on; the rule of three meters leaves every fourth."""
    poses = tmp_path / 'poses.csv'
    poses.write_text(''.join(f'{i}, 0, 0\n' for i in range(24)))
    output = tmp_path / 'map.stavpr'
    options = ['--poses', poses, '--every', 2, '--keyframe-distance', 3, '--keyframe-change', 0.01]
    result = run('build_map', '--input', drive, '--output', output, *options, '--thumbnail-width', 64)
    assert result.returncode == 0, result.stderr
    assert '6 of 12 images became places, 6 of them with a pose' in result.stdout
    place_map = load_map(output)
    assert place_map.ids == tuple(f'{i}.png' for i in range(0, 24, 4))
    assert place_map.poses[:, 0].tolist() == list(range(0, 24, 4))
    assert place_map.thumbnail(0).shape == (48, 64, 3)
    result = run('build_map', '--input', drive, '--output', output, '--keyframe-change', 1.9)
    assert result.returncode == 0, result.stderr
    assert '1 of 24 images became places\n' in result.stdout


def test_build_map_with_the_odometry_of_the_bag(tmp_path):
    """Ten images, one a second from 100 s on; odometry from 102 s on, a meter a second."""
    images = [ImageRecord.of_image(image, (100 + i) * 10**9) for i, image in enumerate(route_images(10))]
    bag = write_odometry(tmp_path / 'bag', [(102 + i) * 10**9 for i in range(8)], images=images)
    output = tmp_path / 'map.stavpr'
    result = run('build_map', '--input', bag, '--output', output, '--odometry', '/odom')
    assert result.returncode == 0, result.stderr
    assert '10 of 10 images became places, 8 of them with a pose' in result.stdout
    assert load_map(output).pose(1) is None
    assert load_map(output).pose(5)[0] == 3
    options = ['--odometry', '/odom', '--keyframe-distance', '1.5', '--keyframe-interval', '2.5']
    result = run('build_map', '--input', bag, '--output', output, *options)
    assert result.returncode == 0, result.stderr
    assert '3 of 10 images became places, 3 of them' in result.stdout
    assert load_map(output).ids == ('/image#2', '/image#5', '/image#8')
    result = run('build_map', '--input', bag, '--output', tmp_path / 'x', '--odometry', '/other')
    assert result.returncode == 1
    assert 'topics of that type are /odom' in result.stderr


def test_build_map_with_odometry_of_another_clock(tmp_path):
    images = [ImageRecord.of_image(image, (100 + i) * 10**9) for i, image in enumerate(route_images(3))]
    bag = write_odometry(tmp_path / 'bag', [10**9, 2 * 10**9], images=images)
    result = run('build_map', '--input', bag, '--output', tmp_path / 'map', '--odometry', '/odom')
    assert result.returncode == 1
    assert 'from one clock' in result.stderr
    assert not (tmp_path / 'map').exists()


@pytest.mark.parametrize(
    ('options', 'code', 'word'),
    [
        (['--every', '0'], 2, '--every'),
        (['--onnx-layer', 'fire'], 2, '--features onnx'),
        (['--features', 'onnx'], 2, '--onnx-model'),
        (['--strips', '99'], 1, 'Wf = 14'),
        (['--gradient-cell', '7'], 0, ''),
        (['--gradient-cell', '9'], 2, 'multiple'),
        (['--poses', '/missing.csv'], 1, '/missing.csv'),
        (['--keyframe-distance', '1'], 2, 'need --odometry or --poses'),
        (['--keyframe-angle', '1'], 2, 'need --odometry or --poses'),
        (['--keyframe-interval', '1'], 2, 'have no times'),
        (['--keyframe-change', '-1'], 2, 'change = -1'),
        (['--odometry', '/odom'], 2, 'is no bag'),
        (['--odometry', '/odom', '--poses', 'x.csv'], 2, 'give one'),
        (['--no-thumbnails', '--thumbnail-width', '9'], 2, 'give one'),
        (['--thumbnail-width', '0'], 2, 'width 0'),
    ],
)
def test_build_map_says_what_is_wrong(drive, tmp_path, options, code, word):
    result = run('build_map', '--input', drive, '--output', tmp_path / 'map.stavpr', *options)
    assert result.returncode == code
    assert word in result.stderr
    assert 'Traceback' not in result.stderr
    assert (tmp_path / 'map.stavpr').exists() is (code == 0)


def test_build_map_looks_at_its_output_first(drive, tmp_path):
    for output, words in ((tmp_path, 'name a file in it'), (tmp_path / 'missing' / 'map', 'make it first')):
        result = run('build_map', '--input', drive, '--output', output)
        assert result.returncode == 1
        assert words in result.stderr


def interrupt(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ('where', 'words'),
    [('mapping.save_map', 'nothing was written'), ('evaluation.threshold.suggest_threshold', 'is written')],
)
def test_build_map_interrupted(drive, tmp_path, monkeypatch, capsys, where, words):
    monkeypatch.setattr(build_map_command, 'obey_signals', lambda: None)
    monkeypatch.setattr(f'stavpr_ros.{where}', interrupt)
    assert build_map_command.main(['--input', str(drive), '--output', str(tmp_path / 'map')]) == 130
    assert words in capsys.readouterr().err
    assert (tmp_path / 'map').exists() is (words == 'is written')


def test_build_map_with_a_bad_image(drive, tmp_path):
    images = write_images(tmp_path / 'images', route_images(3))
    (images / '1.png').write_bytes(b'no picture')
    arguments = ['--input', images, '--output', tmp_path / 'map.stavpr']
    result = run('build_map', *arguments)
    assert result.returncode == 1
    assert '1.png' in result.stderr
    result = run('build_map', *arguments, '--skip-bad-images')
    assert result.returncode == 0
    assert load_map(tmp_path / 'map.stavpr').ids == ('0.png', '2.png')


@pytest.mark.parametrize('name', ['node', 'record', 'replay'])
def test_wrong_ros_arguments(name, drive, tmp_path):
    own = {'node': [], 'record': ['--output', tmp_path / 'x'], 'replay': [drive]}[name]
    for wrong in (['--bogus'], ['--params-file', '/missing.yaml']):
        result = run(name, *own, '--ros-args', *wrong)
        assert result.returncode in (1, 2)
        assert '--ros-args' in result.stderr
        assert 'Traceback' not in result.stderr


def test_record_of_a_topic_that_is_none(tmp_path):
    result = run('record', '--output', tmp_path / 'x', '--topic', 'a b')
    assert result.returncode == 2
    assert 'record: Invalid topic name' in result.stderr
    assert 'Traceback' not in result.stderr


def test_record_interrupted_before_it_began(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(record_command, 'obey_signals', lambda: None)
    monkeypatch.setattr('stavpr_ros.ros.process.own_arguments', interrupt)
    assert record_command.main(['--output', str(tmp_path / 'x')]) == 130
    assert capsys.readouterr().err == 'record: interrupted\n'


@pytest.mark.parametrize(
    ('options', 'word'),
    [
        (['--map', 'x'], 'go together'),
        (['--truth', 'identity'], '--truth'),
        (['--threshold', '-1'], '--threshold'),
        (['--tolerance', '-4'], '--tolerance'),
        (['--map', 'x', '--query', 'y', '--truth', 'file.csv'], 'expected identity'),
        (['--loop', '--map', 'x', '--query', 'y'], 'leave --map'),
        (['--loop', '--truth', 'file.csv'], 'knows its own'),
        (['--loop', 'x', '--truth', 'identity'], 'takes a file'),
        (['--loop', '--exclude', '0'], '--exclude'),
        (['--loop', '--sequence-length', '1'], '--sequence-length'),
        (['--loop', '--mode', 'paper'], '--threshold'),
        (['--loop', '.', '--check', 'surf'], 'surf'),
        (['--map', 'x', '--query', 'y', '--check', 'sift'], 'go with --loop'),
        (['--exclude', '50'], 'go with --loop'),
    ],
)
def test_demo_usage(options, word):
    result = run('demo', *options)
    assert result.returncode == 2
    assert word in result.stderr


@pytest.mark.parametrize(
    ('options', 'name'), [([], 'first_drive'), ([], 'second_drive'), (['--loop'], 'loop')]
)
def test_demo_leaves_alone_what_it_has_not_written(tmp_path, options, name):
    picture = tmp_path / name / 'holidays.jpg'
    picture.parent.mkdir()
    picture.touch()
    result = run('demo', *options, '--output', tmp_path)
    assert result.returncode == 1
    assert f'{name} is there already and no bag of an earlier demo' in result.stderr
    assert picture.exists()


def test_demo_makes_room_for_its_bag(tmp_path):
    bag = tmp_path / 'loop'
    make_room(bag)
    write_bag(bag, TOPIC, [ImageRecord.of_image(image, 10**9) for image in route_images(1)])
    make_room(bag)
    assert not bag.exists()
    bag.touch()
    with pytest.raises(SourceError, match='cannot be replaced'):
        make_room(bag)


def test_demo_on_a_bag_and_a_folder(drive, tmp_path):
    """The whole way, with a bad image in the query that is said and skipped."""
    images = [ImageRecord.of_image(image, (i + 1) * 10**9) for i, image in enumerate(route_images(24))]
    write_bag(tmp_path / 'bag', '/front', images)
    dim = [(image * 0.6).astype(np.uint8) for image in route_images(24)]
    query = write_images(tmp_path / 'query', dim)
    (query / '24.png').write_bytes(b'no picture')
    output = tmp_path / 'output'
    options = ['--query', query, '--topic', '/front', '--threshold', 0.3, '--output', output]
    result = run('demo', '--map', drive, *options)
    assert result.returncode == 2
    assert 'neither drive is a bag' in result.stderr
    result = run('demo', '--map', tmp_path / 'bag', *options)
    assert result.returncode == 0, result.stdout + result.stderr
    assert '24.png' in result.stdout
    assert '24 of 24 images matched' in result.stdout
    records = [json.loads(line) for line in (output / 'matches.jsonl').read_text().splitlines()]
    assert [record['status'] for record in records] == ['WARMING_UP'] * 19 + ['MATCH'] * 5
    assert records[-1]['newest_index'] == 23
    for name in ('demo.png', 'matches.png', 'distance_matrix.png', 'distance_over_time.png'):
        assert cv2.imread(str(output / name)).std() > 5
    assert 'Traceback' not in (output / 'node.log').read_text()


def test_demo_of_loop_closure(tmp_path):
    """A route of 36 images, the last one twice, and the same once more in other light."""
    images = route_images(36)
    dim = [(image * 0.6).astype(np.uint8) for image in images]
    drive = write_images(tmp_path / 'drive', [*images, images[-1], *dim])
    truth = tmp_path / 'truth.csv'
    truth.write_text('query,place\n' + ''.join(f'{37 + i},{i}\n' for i in range(36)))
    output = tmp_path / 'output'
    options = ['--truth', truth, '--exclude', 30, '--sequence-length', 8, '--check', 'none', '--tolerance', 0]
    result = run('demo', '--loop', drive, *options, '--output', output)
    assert result.returncode == 0, result.stdout + result.stderr
    records = [json.loads(line) for line in (output / 'matches.jsonl').read_text().splitlines()]
    assert [i for i, record in enumerate(records) if record['status'] == 'SKIPPED'] == [36]
    closures = [json.loads(line) for line in (output / 'loop_closures.jsonl').read_text().splitlines()]
    assert len(closures) == sum(record['status'] == 'MATCH' for record in records) > 20
    last = closures[-1]
    assert (last['query_index'], last['place_index']) == (67, 31)  # the fourth of the places 64 to 71
    assert [pair[0] - pair[2] for pair in last['pairs']] == [36] * len(last['pairs'])
    assert last['query_pose'] is None
    wrong = [c for c in closures if c['query_index'] - c['place_index'] != 36]
    right = len(closures) - len(wrong)
    assert right >= 28
    assert f'{right} of {len(closures)} loop closures are right' in result.stdout
    assert cv2.imread(str(output / 'loop.png')).std() > 5
    (drive / '80.png').write_bytes(b'no picture')
    result = run('demo', '--loop', drive, *options, '--output', output)
    assert result.returncode == 1
    assert 'images were skipped' in result.stderr


def test_the_numbers_of_loop_closures():
    """Windows of one; of six images, image 1 is no place: place 3 is image 4, place 4 image 5."""
    statuses = ['WARMING_UP', 'SKIPPED', 'NO_MATCH', 'NO_MATCH', 'MATCH', 'MATCH']
    truth = GroundTruth.from_pairs([4, 5], [0, 3], 6, 6)
    closures = [
        {'query_index': 3, 'place_index': 0, 'distance': 0.5, 'pairs': [[3, 9, 0, 9], [2, 9, 0, 9]]},
        {'query_index': 4, 'place_index': 0, 'distance': 0.6, 'pairs': [[4, 9, 0, 9]]},
    ]
    result = read_result([{'status': status} for status in statuses], closures, truth, 2)
    assert result.closures.tolist() == [[4, 0], [5, 0]]
    assert result.right.tolist() == [True, False]
    assert result.pairs.tolist() == [[3, 0], [4, 0], [5, 0]]
    first, second, third = result.lines()
    assert first == '2 loop closures in 6 images (1 were too like the one before)'
    assert second == '1 of 2 loop closures are right, precision 0.500'
    assert third.startswith('1 of 2 images')
    assert third.endswith('recall 0.500')
    nothing = read_result([{'status': status} for status in statuses], [], None, 2)
    assert nothing.lines() == ['0 loop closures in 6 images (1 were too like the one before)']


def test_closures_worth_seeing():
    right = np.arange(20) % 5 > 0  # wrong: 0 5 10 15
    chosen = choose_closures(20, right)
    assert [i for i in chosen if not right[i]] == [0, 15]
    assert len(chosen) == 8
    assert {1, 19} <= set(chosen)
    assert choose_closures(3, np.zeros(3, bool)) == [0, 1, 2]
    assert choose_closures(0, None) == []


def test_loop_closures_as_json():
    message = LoopClosure(query_index=9, distance=math.nan, inliers=-1)
    message.header.stamp.sec = 3
    message.place_stamp.nanosec = 7
    message.pairs = [AlignedPlaces(query_index=8, place_index=1)]
    message.pairs[0].query_stamp.sec = 2
    record = loop_closure_record(message)
    assert json.loads(json.dumps(record)) == record
    assert (record['stamp'], record['query_index'], record['place_stamp']) == (3 * 10**9, 9, 7)
    assert record['pairs'] == [[8, 2 * 10**9, 1, 0]]
    assert (record['distance'], record['query_pose']) == (None, None)
    message.has_poses = True
    message.place_pose.position.y = 2.0
    assert loop_closure_record(message)['place_pose'] == [0, 2, 0, 0, 0, 0, 1]


@pytest.mark.parametrize(
    'name',
    ['WARMING_UP', 'NO_MATCH', 'MATCH', 'INVALID_IMAGE', 'NOT_READY', 'DROPPED', 'SKIPPED', 'MAPPED'],
)
def test_every_verdict_has_its_name(name):
    record = match_record(PlaceMatch(status=getattr(PlaceMatch, name), inliers=12))
    assert (record['status'], record['inliers']) == (name, 12)


def test_demo_that_is_ended_leaves_nobody_behind(drive, tmp_path):
    output = tmp_path / 'output'
    arguments = ['--map', str(drive), '--query', str(drive), '--threshold', '0.3', '--output', str(output)]
    demo = Process(tmp_path / 'demo.log', 'demo', *arguments)
    end = time.monotonic() + TIMEOUT
    while not (output / 'record.log').exists():
        assert time.monotonic() < end
        assert demo.popen.poll() is None, demo.output()
        time.sleep(0.01)
    assert demo.stop(signal.SIGTERM) == 130
    running = subprocess.run(['ps', '-eo', 'args'], capture_output=True, text=True, check=True).stdout
    assert str(output) not in running


def record(status, place=-1):
    path = [[0, place - 1], [1, place], [2, place + 1]] if place >= 0 else []
    return {'status': status, 'sequence_middle': place, 'distance': 0.1, 'path': path, 'received': 0}


def test_an_invalid_image_does_not_shift_the_judgment():
    """Windows of 3; image 3 is in none, so the window that ends with image 4 holds images 1, 2 and 4."""
    records = [record('WARMING_UP'), record('WARMING_UP'), record('MATCH', 1), record('INVALID_IMAGE')]
    records += [record('MATCH', 2), record('MATCH', 4)]
    result = evaluate_records(records, 3, 0.5, np.array([0, 1, 2, 3, 4, 5]), 0)
    assert result.matches.places.tolist() == [0, 1, 2, -1, 4, 5]
    assert result.counts.true_positives == 5
    assert result.counts.false_negatives == 1
