# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation: examples and tutorials run, names exist, numbers equal the results."""

import contextlib
import json
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys
import textwrap

from evaluation_commands import write_images
from fixtures import route_images
from language import remarks
import numpy as np
from processes import environment
import pytest
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_ros.commands import stavpr
from stavpr_ros.parameters import PARAMETERS
from stavpr_ros.units import SECOND
from videos import write_video
import yaml

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / 'benchmarks' / 'results'
PAGES = [
    *(ROOT / name for name in ('README.md', 'CONTRIBUTING.md', 'benchmarks/README.md')),
    *sorted((ROOT / 'docs').rglob('[!_]*.md')),
    *sorted(RESULTS.glob('*.md')),
]
NAMES = {row.name for row in PARAMETERS}


@pytest.fixture(scope='module')
def workspace(tmp_path_factory) -> Path:
    """Write a folder with the images and ground truth that the examples name."""
    folder = tmp_path_factory.mktemp('workspace')
    for name, seed in (('monday', 0), ('tuesday', 0), ('another_town', 7)):
        write_images(folder / name, route_images(40, seed))
    for name, copy in (('summer', 'monday'), ('winter', 'tuesday'), ('loop', 'monday')):
        (folder / name).symlink_to(folder / copy)
    (folder / 'pairs.csv').write_text(''.join(f'{i},{i}\n' for i in range(40)))
    return folder


def code_blocks(page: Path, language: str = '') -> list[str]:
    blocks = re.findall(r'^```(\w*)\n(.*?)^```$', page.read_text(), re.M | re.S)
    return [code for result, code in blocks if result == language]


def documented_commands() -> list[list[str]]:
    """Every command of the pages but the node."""
    result, names = [], {*stavpr.COMMANDS, *stavpr.PACKAGES}
    for page in PAGES:
        for block in code_blocks(page):
            for line in block.replace('\\\n', ' ').splitlines():
                words = shlex.split(line.split('  #')[0].removeprefix('$ '), comments=False)
                words = [word.removeprefix('$bin/') for word in words if word != '&']
                if words[:2] == ['ros2', 'run'] and words[2][:7] == 'stavpr_':
                    words = words[3:]
                if words and words[0] in names - {'node'}:
                    result.append(words)
    return result


@pytest.fixture
def run(workspace, monkeypatch, capsys):
    """Run something in the folder of the examples, in this process; return what it prints."""
    monkeypatch.chdir(workspace)
    monkeypatch.setattr('stavpr_ros.signals.signal.signal', lambda *_: None)

    def capture(work, *arguments):
        with contextlib.suppress(SystemExit):  # of --help
            work(*arguments)
        return capsys.readouterr().out

    return capture


def test_readme_python_example_runs(run):
    (example,) = code_blocks(ROOT / 'README.md', 'python')
    lines = run(exec, example, {'__name__': '__main__'}).splitlines()
    assert len(lines) == 40
    assert lines[0].startswith('WARMING_UP -1 -1 nan')
    assert [line.split()[0] for line in lines[30:]] == ['MATCH'] * 10
    assert lines[-1].split()[1] == '39'


@pytest.mark.parametrize('page', ['stavpr', 'mapping', 'sources'])
def test_examples_of_the_api_pages_run(run, page):
    text = (ROOT / f'docs/api/{page}.rst').read_text()
    (example,) = re.findall(r'code-block:: python\n\n((?:   .*\n|\n)+)', text)
    lines = run(exec, textwrap.dedent(example), {}).splitlines()
    assert lines
    assert all('039.png' in line for line in lines[-1:]) is (page != 'mapping')


def test_example_of_a_kind_of_features_installs_and_makes_a_map(workspace, tmp_path):
    page = ROOT / 'docs/features.md'
    module = next(code for code in code_blocks(page, 'python') if 'KIND =' in code)
    (tmp_path / 'pyproject.toml').write_text(*code_blocks(page, 'toml'))
    (tmp_path / 'gray32.py').write_text(module)
    (command,) = re.findall(r'^stavpr .* gray32 .*$', page.read_text(), re.M)
    install = '-m pip install --quiet --no-build-isolation --no-deps --no-index --target'
    path = os.pathsep.join([str(tmp_path / 'site'), *filter(None, [os.environ.get('PYTHONPATH')])])
    for words, folder in (
        ([sys.executable, *install.split(), 'site', '.'], tmp_path),
        (command.split(), workspace),
    ):
        subprocess.run(
            words,
            cwd=folder,
            env=environment() | {'PYTHONPATH': path},
            timeout=SECONDS,
            check=True,
        )
    assert (workspace / 'gray.stavpr').stat().st_size > 0


def simulated_drive() -> tuple[np.ndarray, np.ndarray, list]:
    """Return true positions, odometry (n, 7) and loop closures of three laps of a circle."""
    rng, n, lap = np.random.default_rng(0), 180, 60

    def drive(step: np.ndarray, turn: np.ndarray) -> np.ndarray:
        yaw = np.cumsum(turn) - turn[0]
        points = np.cumsum(step * np.exp(1j * yaw))
        poses = np.zeros((n, 7))
        poses[1:, :2] = np.stack([points.real, points.imag], axis=1)[:-1]
        poses[:, 5:] = np.stack([np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
        return poses

    turn = np.full(n, 2 * np.pi / lap)
    odometry = drive(1 + rng.normal(0, 0.03, n), turn + rng.normal(0.002, 0.005, n))
    messages = []
    for i in range(lap + 5, n, 5):
        closure = LoopClosure(has_relative_pose=True)
        edge = closure.relative_pose
        edge.query_stamp.sec, edge.place_stamp.sec = i + 1, i + 1 - lap
        edge.pose.pose.position.x, edge.pose.pose.position.y = rng.normal(0, 0.03, 2)
        edge.pose.covariance = np.diag([0.01] * 3 + [0.001] * 3).ravel()
        edge.is_independent, edge.source = True, RelativePose.PNP
        messages.append(closure)
    return drive(np.ones(n), turn)[:, :3], odometry, messages


def test_example_of_the_slam_page_corrects_a_drive_by_optimize_and_gtsam():
    pytest.importorskip('gtsam')
    (example,) = code_blocks(ROOT / 'docs/slam.md', 'python')
    truth, odometry, messages = simulated_drive()
    stamps = (np.arange(len(odometry)) + 1) * SECOND
    names = {'stamps': stamps, 'odometry': odometry, 'messages': messages}
    exec(example, names)
    by_gtsam = np.array([names['by_gtsam'].atPose3(i).translation() for i in range(len(truth))])
    assert names['decided'].accepted == len(messages)

    def error(points: np.ndarray) -> float:
        return float(np.sqrt(((points - truth) ** 2).sum(axis=1).mean()))

    assert error(odometry[:, :3]) > 1
    assert max(error(names['corrected'][:, :3]), error(by_gtsam)) < 0.25


def test_build_map_and_evaluate_examples_run(run, workspace):
    examples = [
        'build_map --input monday/ --output monday.stavpr',
        'evaluate --map summer/ --query winter/ --truth identity --warp vary --crop-map 0.3 '
        '--crop-query 0.1 --json result.json',
        'evaluate --map monday/ --query tuesday/ --truth pairs.csv --unknown another_town/ '
        '--json unknown.json',
    ]
    documented = documented_commands()
    for words in map(str.split, examples):
        assert any(words[: len(command)] == command for command in documented), (
            f'undocumented: {words}'
        )
        run(stavpr.main, words)
    assert json.loads((workspace / 'result.json').read_text())['settings']['mode'] == 'robust'
    assert json.loads((workspace / 'unknown.json').read_text())['unknown_images'] == 40
    assert (workspace / 'monday.stavpr').stat().st_size > 0


def test_documented_options_exist(run):
    commands = documented_commands()
    assert len(commands) > 8
    helps = {name: run(stavpr.main, [name, '--help']) for name in {words[0] for words in commands}}
    features = run(stavpr.main, ['build_map', '--help-features'])
    for name, *words in commands:
        for word in words:
            if word.startswith('--') and word != '--ros-args':
                text = helps[name] + features
                assert re.search(rf'{re.escape(word)}\b', text), f'{name} has no {word}'


def test_documented_parameters_exist():
    text = '\n'.join(page.read_text() for page in PAGES)
    names = set(re.findall(r'(?:-p (?=\w+:=)|param set /stavpr )(\w+)', text))
    assert names
    assert names <= NAMES
    table = (ROOT / 'README.md').read_text().partition('| parameter |')[2].partition('\n\n')[0]
    assert set(re.findall(r'^\| `(\w+)`', table, re.M)) <= NAMES


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_between_pages_resolve(page):
    for target in re.findall(r'\]\((?!https?://)([^)#\s]+)', page.read_text()):
        assert (page.parent / target).exists(), f'{page.name} links to {target}'


def test_snippets_for_other_nodes_are_complete():
    """Each parameter file parses; a configuration of robot_localization has 15 switches."""
    page = ROOT / 'docs' / 'integration.md'
    files = [yaml.safe_load(block) for block in code_blocks(page, 'yaml')]
    nodes = {name: node['ros__parameters'] for file in files for name, node in file.items()}
    assert [*nodes] == ['amcl', 'ekf_filter_node', 'twist_mux']
    for name, switches in nodes['ekf_filter_node'].items():
        assert not name.endswith('_config') or list(map(type, switches)) == [bool] * 15, name
    inputs = nodes['twist_mux']['topics'] | nodes['twist_mux']['locks']
    assert all({*row} == {'topic', 'timeout', 'priority'} for row in inputs.values())
    assert all(
        isinstance(row['timeout'], float) for row in inputs.values()
    )  # an integer is refused


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page: its headings, as GitHub names them, and `(NAME)=` lines."""
    text = re.sub(r'^```.*?^```', '', page.read_text(), flags=re.M | re.S)
    text = re.sub(r'\[(.*?)\]\(.*?\)', r'\1', text)
    heads = [re.sub(r'[^\w\- ]', '', head.lower()) for head in re.findall('^#+ (.*)', text, re.M)]
    return {head.replace(' ', '-') for head in heads} | {*re.findall(r'^\((.*)\)=$', text, re.M)}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_to_headings_resolve(page):
    for target, anchor in re.findall(r'\]\((?!https?://)([^)#\s]*)#([^)\s]+)\)', page.read_text()):
        path = page.parent / target if target else page
        assert path.suffix != '.md' or anchor in anchors(path), f'{target}#{anchor}'


def marked_tables() -> list:
    """Every table below the name of its rows in tables.json, by page and name."""
    mark = re.compile(r'<!-- tables.json: (.*) -->\n\n((?:\|.*\n)+)')
    return [
        pytest.param(name, text.splitlines(), id=f'{page.stem}-{name}')
        for page in PAGES
        for name, text in mark.findall(page.read_text())
    ]


@pytest.mark.parametrize(('name', 'lines'), marked_tables())
def test_numbers_of_tables_are_those_of_tables_json(name, lines):
    head, _, *rows = ([cell.strip() for cell in line.split('|')[1:-1]] for line in lines)
    measured = json.loads((RESULTS / 'tables.json').read_text())[name]['rows']
    stored = [[number(str(row[column])) for column in head] for row in measured]
    for row in rows:
        assert [number(cell) for cell in row] in stored


def number(cell: str) -> float | str:
    """Value of a cell that is a number, else its text."""
    try:
        return float(cell.replace(',', ''))
    except ValueError:
        return cell


def test_numbers_of_readme_are_those_of_its_commands():
    """Recall by night, images off the map and milliseconds, in the table of questions."""
    table = (ROOT / 'README.md').read_text().partition('| question |')[2].partition('\n\n')[0]
    answers = [line.split('|')[2] for line in table.splitlines()[2:]]
    night, off_map, speed = ([float(x) for x in re.findall(r'\d*\.\d+', a)] for a in answers)
    fit = (RESULTS / 'fit.md').read_text().partition('## Constants')[2]
    rows = [next(re.finditer(rf'^\| {kind} \|(.*)', fit, re.M))[1] for kind in KINDS]
    assert night == [float(row.split('|')[column]) for row in rows for column in (3, 5)]
    drives = json.loads((RESULTS / 'off_map.json').read_text())['results']
    unseen = [[row for name, row in drives.items() if f'detours/{k[0]}/' in name] for k in KINDS]
    shares = [sum(r['unseen_matched'] for r in s) / sum(r['unseen'] for r in s) for s in unseen]
    assert off_map == pytest.approx([100 * share for share in shares], abs=0.05)
    run = json.loads((RESULTS / 'matching-amd-epyc-2-cores-512-bit.json').read_text())
    times = {
        row['precision']: 1e3 * row['median_s']
        for row in run['rows']
        if (row['stage'], row['mode'], row['n'], row['d']) == ('frame', 'robust', 100_000, 224)
    }
    assert speed == pytest.approx([times['float32'], times['int8']], abs=0.051)


@pytest.mark.parametrize(
    'text',
    [
        'Of the newest images, five are compared.',
        '| `decision` | of a robot |',
        'The bound is that\nof every drive.',
        'A place is not a pose but a number.',
        'All rows but the last are printed.',
        'The given is compared.',
        'The map holds n places.',
        'How the two are told apart.',
    ],
)
def test_language_check_names_line_and_remedy(text):
    ((line, words, remedy),) = remarks(f'A line.\n\n{text}\n')
    assert line == 3
    assert words in ' '.join(text.split())
    assert remedy


@pytest.mark.parametrize(
    'text',
    [
        'The node is part of the package, but it needs no GPU.',
        'It shows that the map is old, and all of it is used; most of it, at least.',
        'An emergency stop holds the wheels. A match is not accepted, but published.',
        '```\n# Of the images, those of Monday\n```\nA `map holds it` is code.',
    ],
)
def test_language_check_accepts_plain_prose(text):
    assert not list(remarks(text))


KINDS = 'gradient', 'hybrid'
FOLDER = Path(__file__).resolve().parents[2] / 'docs/tutorials'
TUTORIALS = ('first_map', 'first_robot', 'tune', 'debug')  # in the order of the README
SECONDS = 900
IMAGES = 100  # of each video
OTHER_ROUTES = {
    'floor1.mp4': 'monday.mp4',
    'floor2.mp4': 'tuesday.mp4',
    'row1.mp4': 'monday.mp4',
    'row2.mp4': 'tuesday.mp4',
}


@pytest.fixture
def folder(tmp_path):
    """Return a folder with the files that the tutorials begin with."""
    images = route_images(IMAGES)
    write_video(tmp_path / 'monday.mp4', images, rate=5)
    write_video(tmp_path / 'tuesday.mp4', [image // 4 * 3 for image in images], rate=5)
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize('pages', [TUTORIALS, ('public_data',), ('../uses',)], ids='-'.join)
def test_blocks_of_pages_run_in_order_in_one_folder(pages, folder, request):
    for link, name in OTHER_ROUTES.items():
        (folder / link).symlink_to(folder / name)
    if pages == ('public_data',):
        (folder / 'VPR-Bench/datasets').mkdir(parents=True)
        data = request.getfixturevalue('data_folder') / 'corridor'
        (folder / 'VPR-Bench/datasets/corridor').symlink_to(data)
    text = ''.join((FOLDER / f'{page}.md').read_text() for page in pages)
    blocks = re.findall(r'^```(sh|python)\n(.*?)^```$', text, re.M | re.S)
    shell = '\n'.join(
        code if kind == 'sh' else f'python3 - <<"PY"\n{code}PY' for kind, code in blocks
    )
    done = subprocess.run(
        ['bash', '-e', '-c', shell],
        cwd=folder,
        env=environment(),
        timeout=SECONDS,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    recordings = [*folder.glob('*.jsonl')]
    assert len(recordings) == (2 if pages == TUTORIALS else 0)
    assert {len(file.read_text().splitlines()) for file in recordings} <= {IMAGES}


def test_webcam_page_opens_the_newest_recording(tmp_path):
    text = (FOLDER / 'webcam.md').read_text()
    recording = re.search(r'save_path:=(\S+)', text)[1]
    expression = re.search(r'map_path:=(.*)', text)[1]
    for age, name in ((20, 'route.stavpr'), (10, 'route-2.stavpr')):
        path = tmp_path / name
        path.touch()
        os.utime(path, (1e9 - age, 1e9 - age))
        echo = ['bash', '-c', f'echo {recording} {expression}']
        first, newest = subprocess.check_output(echo, cwd=tmp_path, text=True).split()
        assert (first, newest) == (str(tmp_path / 'route.stavpr'), str(path))
