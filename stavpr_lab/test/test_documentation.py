# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation: its examples run, its names exist, its numbers are those of the results."""

import contextlib
import json
from pathlib import Path
import re
import shlex

from evaluation_commands import write_images
from fixtures import route_images
import pytest
from stavpr_ros.commands import stavpr
from stavpr_ros.parameters import PARAMETERS
from stavpr_slam.ros.bridges.bridge import EdgeBridge

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').glob('*.md'))]
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
    return [code for found, code in blocks if found == language]


def documented_commands() -> list[list[str]]:
    """Every command of the pages but the node."""
    found, names = [], {*stavpr.COMMANDS, *stavpr.PACKAGES}
    for page in PAGES:
        for block in code_blocks(page):
            for line in block.replace('\\\n', ' ').splitlines():
                words = shlex.split(line.split('  #')[0].removeprefix('$ '), comments=False)
                words = [word.removeprefix('$bin/') for word in words if word != '&']
                if words[:2] == ['ros2', 'run'] and words[2][:7] == 'stavpr_':
                    words = words[3:]
                if words and words[0] in names - {'node'}:
                    found.append(words)
    return found


@pytest.fixture
def run(workspace, monkeypatch, capsys):
    """Run something in the folder of the examples, in this process; return what it prints."""
    monkeypatch.chdir(workspace)
    monkeypatch.setattr('stavpr_ros.signals.signal.signal', lambda *_: None)

    def printed(work, *arguments):
        with contextlib.suppress(SystemExit):  # of --help
            work(*arguments)
        return capsys.readouterr().out

    return printed


def test_readme_python_example_runs(run):
    (example,) = code_blocks(ROOT / 'README.md', 'python')
    lines = run(exec, example, {'__name__': '__main__'}).splitlines()
    assert len(lines) == 40
    assert lines[0].startswith('0 WARMING_UP -1 nan')
    assert [line.split()[1] for line in lines[30:]] == ['MATCH'] * 10


def test_build_map_and_evaluate_examples_run(run, workspace):
    examples = [
        'build_map --input monday/ --output monday.stavpr',
        'evaluate --map summer/ --query winter/ --warp vary --crop-map 0.3 --crop-query 0.1 '
        '--json result.json',
        'evaluate --map monday/ --query tuesday/ --truth pairs.csv --unknown another_town/ '
        '--json unknown.json',
    ]
    documented = documented_commands()
    for words in map(str.split, examples):
        assert any(words[: len(given)] == given for given in documented), f'undocumented: {words}'
        run(stavpr.main, words)
    assert json.loads((workspace / 'result.json').read_text())['settings']['mode'] == 'robust'
    assert json.loads((workspace / 'unknown.json').read_text())['unknown_images'] == 40
    assert (workspace / 'monday.stavpr').stat().st_size > 0


def test_documented_options_exist(run):
    commands = documented_commands()
    assert len(commands) > 8
    helps = {name: run(stavpr.main, [name, '--help']) for name in {words[0] for words in commands}}
    for name, *words in commands:
        for word in words:
            if word.startswith('--') and word != '--ros-args':
                assert re.search(rf'{re.escape(word)}\b', helps[name]), f'{name} has no {word}'


def test_documented_parameters_exist():
    text = '\n'.join(page.read_text() for page in PAGES)
    given = set(re.findall(r'(?:-p (?=\w+:=)|param set /stavpr )(\w+)', text))
    assert given
    assert given <= NAMES | EdgeBridge.ROBOTS.keys()
    table = (ROOT / 'README.md').read_text().partition('| parameter |')[2].partition('\n\n')[0]
    assert set(re.findall(r'^\| `(\w+)`', table, re.M)) <= NAMES


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_between_pages_resolve(page):
    for target in re.findall(r'\]\((?!https?://)([^)#\s]+)', page.read_text()):
        assert (page.parent / target).exists(), f'{page.name} links to {target}'


def test_readme_results_are_those_of_accuracy_table():
    results = ROOT / 'benchmarks/results/accuracy-198bcca.json'
    table = json.loads(results.read_text())['results']

    def f1(key: str) -> float:
        return float(table[key]['sequence']['f1'])

    speeds = ('2x', '1.5x', '0.7x', '0.5x', 'vary', 'stop')
    for mode in ('paper', 'robust'):
        (row,) = re.findall(
            rf'^\| `{mode}` (\| [.\d| ]+)$', (ROOT / 'README.md').read_text(), re.M
        )
        numbers = [float(cell) for cell in re.findall(r'[\d.]+', row)]
        expected = [
            f1(f'gardens_point/g/{mode}/same'),
            min(f1(f'gardens_point/g/{mode}/{speed}') for speed in speeds),
            f1(f'nordland/g/{mode}/same'),
            f1(f'corridor/g/{mode}/same'),
        ]
        assert numbers == pytest.approx(expected, abs=0.0006)
