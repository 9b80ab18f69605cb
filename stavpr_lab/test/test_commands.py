# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executables: exit codes, messages, files; as processes only where that adds something."""

import json
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

from bags import SECOND, write_odometry
import cv2
from evaluation_commands import write_images
from fixtures import route_images
import numpy as np
from processes import executable, Process, TIMEOUT
import pytest
from stavpr_lab.commands import demo
from stavpr_ros.commands import build_map, node, record, replay, stavpr
from stavpr_ros.commands import map as map_command
from stavpr_ros.mapping import load_map
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord
from videos import write_video

HANGS = 5 * TIMEOUT  # seconds after which an executable counts as stuck


def run_process(name, *arguments):
    """Run an executable as ``ros2 run`` does."""
    command = [executable(name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=HANGS, check=False)


@pytest.fixture
def run(monkeypatch, capfd):
    """Run the ``main`` of a command's module in this process, which keeps its signal handlers."""
    monkeypatch.setattr('signal.signal', lambda *_: None)
    monkeypatch.setattr('stavpr_ros.commands.replay.prepare_transport', lambda: None)

    def run_main(command, *arguments):
        try:
            code = command.main([str(argument) for argument in arguments])
        except SystemExit as ended:  # of argparse
            code = ended.code
        out, err = capfd.readouterr()
        assert 'Traceback' not in err
        return SimpleNamespace(code=code, out=out, err=err)

    return run_main


def read_records(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def interrupt(*_, **__):
    raise KeyboardInterrupt


def image_records(count, first=1):
    """Images of the route, one a second from the given second on."""
    images = enumerate(route_images(count), first)
    return [ImageRecord.of_image(image, i * SECOND) for i, image in images]


@pytest.fixture(scope='module')
def traverse(tmp_path_factory):
    return write_images(tmp_path_factory.mktemp('traverse') / 'images', route_images(24))


@pytest.fixture(scope='module')
def poses(tmp_path_factory):
    path = tmp_path_factory.mktemp('poses') / 'poses.csv'
    path.write_text('# x, y, z\n' + ''.join(f'{i}, 0, 0\n' for i in range(24)))
    return path


@pytest.mark.parametrize('name', stavpr.COMMANDS)
def test_command_help_lists_exit_codes(name, run):
    result = run(stavpr, name, '--help')
    assert result.code == 0
    assert 'usage:' in result.out
    assert 'exit codes' in result.out
    assert max(map(len, result.out.splitlines())) < 100


def test_build_map_continues_after_a_bad_image_with_the_option_that_skips_it(
    run, tmp_path, monkeypatch
):
    folder, output = write_images(tmp_path / 'images', route_images(40)), tmp_path / 'map.stavpr'
    (folder / '036.png').unlink()
    (folder / '036\x1b[2J\n.png').write_bytes(b'no image')
    result = run(build_map, '--input', folder, '--output', output)
    assert (result.code, r'036\x1b[2J\n.png' in result.err) == (1, True)
    assert 'the same command with --skip-bad-images continues' in result.err
    journal = tmp_path / 'map.stavpr.journal'
    assert journal.stat().st_size > 32 * 7 * 224 * 4
    monkeypatch.setattr('stavpr_ros.mapping.builder.JournalWriter.create', None)  # no new one
    result = run(build_map, '--input', folder, '--output', output, '--skip-bad-images')
    assert (result.code, load_map(output).ids[36:]) == (0, ('037.png', '038.png', '039.png'))
    assert 'left out: images that are damaged: 1' in result.err
    assert not journal.exists()


def test_demo_removes_the_files_of_an_earlier_one_and_no_others(run, tmp_path):
    (tmp_path / 'laps').mkdir()
    for name, text in (('mine.png', ''), ('loop.png', ''), ('.demo', 'laps\nloop.png\n../x')):
        (tmp_path / name).write_text(text)
    (tmp_path.parent / 'x').touch()
    result = run(demo, '--map', '/missing', '--query', '/missing', '--output', tmp_path)
    assert (result.code, '/missing' in result.err) == (1, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ['.demo', 'mine.png']
    assert (tmp_path.parent / 'x').exists()
    paths = ['--map', tmp_path / 'a', '--query', '/missing']
    result = run(demo, *paths, '--output', tmp_path)
    assert (result.code, 'give another --output' in result.err) == (2, True)


def test_build_map_with_options_writes_map(run, traverse, poses, tmp_path):
    output = tmp_path / 'map.stavpr'
    options = ['--every', 2, '--poses', poses, '--projection', 32, '--strips', 5]
    options += ['--features', 'gradient', '--gradient-cell', 7]
    result = run(build_map, '--input', traverse, '--output', output, *options)
    assert result.code == 0, result.err
    assert '12 places, 5 strips of 32 dimensions' in result.out
    assert 'paper' not in result.out + result.err
    place_map = load_map(output)
    assert place_map.ids[3] == '006.png'
    assert place_map.poses[3].tolist() == [6, 0, 0, 0, 0, 0, 1]


def test_build_map_with_keyframe_options_selects_images(run, traverse, poses, tmp_path):
    """Every second image, two meters on; a minimum distance of three leaves every fourth."""
    output = tmp_path / 'map.stavpr'
    paths = ['--input', traverse, '--output', output, '--force']
    options = ['--keyframe-distance', 3, '--keyframe-change', 0.01, '--thumbnail-width', 64]
    result = run(build_map, *paths, '--poses', poses, '--every', 2, *options)
    assert result.code == 0, result.err
    assert '6 of 12 images became places, 6 of them with a pose' in result.out
    place_map = load_map(output)
    assert place_map.ids == tuple(f'{i:03}.png' for i in range(0, 24, 4))
    assert place_map.poses[:, 0].tolist() == list(range(0, 24, 4))
    assert place_map.thumbnail(0).shape == (48, 64, 3)
    assert '1 of 24 images became places\n' in run(build_map, *paths, '--keyframe-change', 1.9).out


def test_build_map_with_odometry_sets_poses(run, tmp_path):
    """Ten images, one a second from 100 s on; odometry from 102 s on, a meter a second."""
    stamps = [(102 + i) * SECOND for i in range(8)]
    bag = write_odometry(tmp_path / 'bag', stamps, images=image_records(10, 100))
    output = tmp_path / 'map.stavpr'
    paths = ['--input', bag, '--output', output, '--force']
    result = run(build_map, *paths, '--odometry', '/odom')
    assert result.code == 0, result.err
    assert '10 of 10 images became places, 8 of them with a pose' in result.out
    assert load_map(output).pose(1) is None
    assert load_map(output).pose(5)[0] == 3
    options = ['--keyframe-distance', '1.5', '--keyframe-interval', '2.5']
    result = run(build_map, *paths, '--odometry', '/odom', *options)
    assert '3 of 10 images became places, 3 of them' in result.out
    assert load_map(output).ids == ('/image#2', '/image#5', '/image#8')
    result = run(build_map, *paths, '--odometry', '/other')
    assert result.code == 1
    assert 'expected one of /odom' in result.err


@pytest.mark.parametrize('where', ['mapping.save_map', 'maintenance.threshold.suggest_threshold'])
def test_build_map_interrupted_reports_state(run, traverse, tmp_path, monkeypatch, where):
    monkeypatch.setattr(f'stavpr_ros.{where}', interrupt)
    result = run(build_map, '--input', traverse, '--output', tmp_path / 'map')
    assert result.code == 130
    assert 'nothing was written' in result.err
    assert not (tmp_path / 'map').exists()


def test_build_map_of_video_takes_images_at_the_rate(run, tmp_path):
    images = route_images(24)
    write_video(tmp_path / 'phone.avi', images, rate=8)
    arguments = ['--input', tmp_path / 'phone.avi', '--fps', '4', '--keyframe-interval', '0.6']
    result = run(build_map, *arguments, '--output', tmp_path / 'map.stavpr')
    assert '4 of 12 images became places' in result.out
    stamps = load_map(tmp_path / 'map.stavpr').stamps
    np.testing.assert_allclose(stamps / SECOND, [1, 1.75, 2.5, 3.25], atol=0.002)
    result = run(map_command, 'info', tmp_path / 'map.stavpr')
    assert 'stamps     1.0 s to 3.2 s\n' in result.out


BUILD = '--input {images} --output {output}'
WRONG = [
    (build_map, '--inptu x --output y', 2, 'did you mean --input?'),
    (stavpr, 'bild_map', 2, 'did you mean build_map?'),
    (stavpr, 'map ifno x', 2, 'did you mean info?'),
    (stavpr, 'map info x --plto y', 2, 'did you mean --plot?'),
    (build_map, f'{BUILD} --every 0', 2, '--every'),
    (build_map, f'{BUILD} --features gradient --onnx-layer fire', 2, '--features onnx'),
    (build_map, f'{BUILD} --features gradient --strips 99', 1, 'Wf = 14'),
    (build_map, f'{BUILD} --features gradient --gradient-cell 9', 2, 'multiple'),
    (build_map, f'{BUILD} --poses /missing.csv', 1, '/missing.csv'),
    (build_map, f'{BUILD} --keyframe-distance 1', 2, 'need --odometry or --poses'),
    (build_map, f'{BUILD} --keyframe-interval 1', 2, 'have no stamps'),
    (build_map, f'{BUILD} --odometry /odom', 2, 'is no bag'),
    (build_map, f'{BUILD} --fps 5', 2, 'no input is a video'),
    (build_map, f'{BUILD} --odometry /odom --poses x.csv', 2, 'give one'),
    (build_map, f'{BUILD} --no-thumbnails --thumbnail-width 9', 2, 'give one'),
    (node, '--ros-args -p max_error:=2.0', 1, 'max_error'),
    (node, '--ros-args -p threshold:=low', 1, 'threshold'),
    (node, '--ros-args --params-file /missing.yaml', 1, '--ros-args'),
    (record, '--output {output} --ros-args -r', 2, '--ros-args'),
    (replay, 'no/such.bag', 1, 'no/such.bag does not exist'),
    (replay, '', 2, 'BAG'),
    (replay, '. --rate 0', 2, '0: expected a number above 0'),
    (replay, '. --rate 2 --lossless', 2, 'not allowed with'),
    (replay, '{bag} --ros-args -r image:=im%age', 2, 'im%age'),
    (replay, '{bag} --ros-args -r', 2, 'remap'),
    (replay, '{bag} --topic /other', 1, 'expected one of /camera'),
    (demo, '--output {output} --threshold 0.8', 2, 'give --min-probability'),
    (demo, '--output {output} --min-probability 1', 2, '--min-probability'),
    (demo, '--output {output} --map x --query y --truth file.csv', 2, 'expected identity'),
    (demo, '--output {output} --map x --query y --geometric-check sift', 2, 'go with --loop'),
    (demo, '--output {output} --loop --map x --query y', 2, 'leave --map'),
    (demo, '--output {output} --loop synthetic --truth file.csv', 2, 'has its own'),
    (demo, '--output {output} --loop --mode paper', 2, '--threshold'),
    (demo, '--output {output} --slam world --map a', 2, '--slam has its own drive'),
    (demo, '--output {output} --slam world --false-closures 1.5', 2, '--false-closures 1.5'),
]


@pytest.mark.parametrize(('command', 'line', 'code', 'words'), WRONG)
def test_command_with_wrong_arguments_names_them_and_writes_nothing(
    run, traverse, tmp_path, command, line, code, words
):
    write_bag(tmp_path / 'bag', '/camera', image_records(1))
    places = {'images': traverse, 'bag': tmp_path / 'bag', 'output': tmp_path / 'output'}
    result = run(command, *line.format(**places).split())
    assert (result.code, words in result.err) == (code, True), result.err
    assert 'did you mean' not in words or len(result.err.splitlines()) < 5
    assert not (tmp_path / 'output').exists()


@pytest.mark.parametrize(
    ('options', 'name'),
    [([], 'first_traverse'), ([], 'second_traverse'), (['--loop', 'synthetic'], 'loop')],
)
def test_demo_with_foreign_folder_keeps_it(run, tmp_path, options, name):
    photo = tmp_path / name / 'holidays.jpg'
    photo.parent.mkdir()
    photo.touch()
    result = run(demo, *options, '--output', tmp_path)
    assert result.code == 1
    assert f'{name} exists and is no bag of an earlier demo' in result.err
    assert photo.exists()


def test_demo_on_bag_and_folder_reports_matches(run, traverse, tmp_path):
    """Over ROS, with a damaged image in the query that is reported and skipped."""
    write_bag(tmp_path / 'bag', '/front', image_records(24))
    dim = [(image * 0.6).astype(np.uint8) for image in route_images(24)]
    query = write_images(tmp_path / 'query', dim)
    (query / '24.png').write_bytes(b'no image')
    output = tmp_path / 'output'
    options = ['--query', query, '--topic', '/front', '--output', output]
    result = run(demo, '--map', traverse, *options)
    assert result.code == 2
    assert 'no recording is a bag' in result.err
    result = run_process('demo', '--map', tmp_path / 'bag', *options)
    assert result.returncode == 0, result.stdout + result.stderr
    assert '24.png' in result.stdout
    assert '24 of 24 images matched' in result.stdout
    records = read_records(output / 'matches.jsonl')
    statuses = [match['status'] for match in records]
    first = statuses.index('MATCH')
    assert statuses == ['WARMING_UP'] * first + ['MATCH'] * (24 - first)
    assert 1 <= first <= 19
    assert records[-1]['newest_index'] == 23
    assert cv2.imread(str(output / 'demo.png')).std() > 5
    assert 'Traceback' not in (output / 'node.log').read_text()


def test_demo_of_loop_closure_reports_closures(run, tmp_path):
    """A route of 36 images, the last one twice, and the same once more in other light."""
    images = route_images(36)
    dim = [(image * 0.6).astype(np.uint8) for image in images]
    traverse = write_images(tmp_path / 'traverse', [*images, images[-1], *dim])
    truth = tmp_path / 'truth.csv'
    truth.write_text('query,place\n' + ''.join(f'{37 + i},{i}\n' for i in range(36)))
    output = tmp_path / 'output'
    options = ['--truth', truth, '--exclude-places', 30, '--sequence-length', 8]
    options += ['--geometric-check', 'none', '--tolerance', 0, '--output', output]
    result = run_process('demo', '--loop', traverse, *options)
    assert result.returncode == 0, result.stdout + result.stderr
    records = read_records(output / 'matches.jsonl')
    assert [i for i, match in enumerate(records) if match['status'] == 'SKIPPED'] == [36]
    closures = read_records(output / 'loop_closures.jsonl')
    on_time = [closure for closure in closures if not closure['is_late']]
    assert len(on_time) == sum(match['status'] == 'MATCH' for match in records) > 20
    last = on_time[-1]
    assert (last['query_index'], last['place_index']) == (67, 31)  # the fourth of 64 to 71
    assert {pair['query_index'] - pair['place_index'] for pair in last['pairs']} == {36}
    assert last['query_pose'] is None
    assert last['probability'] > 0.9
    correct = sum(c['query_index'] - c['place_index'] == 36 for c in closures)
    assert correct >= 22  # the first of the second lap are not probable yet
    assert f'{correct} of {len(closures)} loop closures are correct' in result.stdout
    assert cv2.imread(str(output / 'loop.png')).std() > 5
    (traverse / '80.png').write_bytes(b'no image')
    result = run(demo, '--loop', traverse, *options)
    assert result.code == 1
    assert 'images were skipped' in result.err


def test_demo_terminated_ends_its_processes(traverse, tmp_path):
    output = tmp_path / 'output'
    arguments = ['--map', traverse, '--query', traverse, '--output', output]
    process = Process(tmp_path / 'demo.log', 'demo', *map(str, arguments))
    end = time.monotonic() + TIMEOUT
    while not (output / 'record.log').exists():
        assert time.monotonic() < end
        assert process.popen.poll() is None, process.output()
        time.sleep(0.01)
    assert process.stop(signal.SIGTERM) == 130
    listed = subprocess.run(['ps', '-ewwo', 'args'], capture_output=True, text=True, check=True)
    assert str(output) not in listed.stdout


def test_stavpr_without_ros_names_the_shell_that_has_it(monkeypatch, capsys):
    monkeypatch.setattr(stavpr, 'ROS_MODULES', ('not_installed',))
    assert stavpr.main(['node']) == 2
    assert 'without a ROS installation, run `make shell`' in capsys.readouterr().err


def test_demonstration_imports_no_package_of_the_extra_evaluation():
    code = (
        'import sys; sys.modules.update(dict.fromkeys(("sklearn", "jinja2")))\n'
        'import stavpr_lab.commands.demo, stavpr_lab.demonstration.plots\n'
        'import stavpr_lab.demonstration.loops, stavpr_lab.demonstration.recordings'
    )
    subprocess.run([sys.executable, '-c', code], check=True)
