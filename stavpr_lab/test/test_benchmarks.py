# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks: matching end to end on tiny sizes, outcomes, pages, options."""
# ruff: noqa: E402  (the modules of the benchmarks lie beside their commands, not in a package)

from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache
from io import StringIO
import json
from pathlib import Path
import re
import sys
from unittest.mock import patch

import cv2
import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / 'benchmarks'
sys.path.insert(0, str(BENCHMARKS))

import accuracy
from lower_bounds import Peaks
import matching
import off_map
import off_map_page
import peaks
import report

PEAKS = Peaks(1e9, 1e10)
PROGRAMS = [path.stem for path in BENCHMARKS.glob('*.py') if '__main__' in path.read_text()]
ROOT = BENCHMARKS.parent
PAGES = sorted(
    path for pages in ('*.md', 'docs/**/*.md', 'benchmarks/**/*.md') for path in ROOT.glob(pages)
)
RECIPE = re.compile(r'^([\w-]+):.*\n((?:\t.*\n)+)', re.MULTILINE)
TARGETS = {
    target: re.findall(r'benchmarks/(\w+)\.py', recipe)
    for target, recipe in RECIPE.findall((ROOT / 'Makefile').read_text())
}
OPTION = re.compile(r'(?<![\w-])--[a-z][a-z-]*')
OWN = re.compile(r'^--|^ARGS|^make |\.py')  # not code of other commands


@pytest.mark.slow
def test_command_measures_every_stage_of_both_modes(tmp_path, monkeypatch, set_constants):
    monkeypatch.setattr(peaks, 'measure_peaks', lambda *_: PEAKS)
    set_constants(matching, CITY=200)
    options = '--sizes 50 300 --dimensions 224 --seconds 0.001 --no-memory --commit abc'
    assert matching.main([*options.split(), '--output', str(tmp_path)]) == 0
    (path,) = tmp_path.glob('matching-*.json')
    document = json.loads(path.read_text())
    rows = document['rows']
    robust = {row['stage'] for row in rows if row['mode'] in ('', 'robust')}
    assert robust == {
        *('decoding', 'extraction', '1080p raw to features', '1080p JPEG to features'),
        *report.ROBUST_STAGES, 'distance_matrix', 'frame',
    }  # fmt: skip
    paper = {row['stage'] for row in rows if row['mode'] == 'paper'}
    assert paper == {'window_push', 'lm_dtw', 'selection', 'path_trace', 'frame'}
    assert document['commit'] == 'abc'
    for row in rows:
        assert row['ratio_to_lower_bound'] == row['median_s'] / row['lower_bound_s']
    text = path.with_suffix('.md').read_text()
    assert text.index('A frame in mode robust') < text.index('## All stages')
    assert cv2.imread(str(path.with_suffix('.png'))).shape[1] > 1000


def test_outcome_counts_right_wrong_and_unseen_matches():
    columns = ([1, 1, 1, 0, 0], [1, 1, 0, 1, 0], [1, 1, 0, 1, 1], [0, 0, 1, 0, 0])
    accepted, *others = (np.array(values, bool) for values in columns)
    others.append(np.zeros(5, bool))  # no early ones
    outcome = off_map.Outcome(accepted, np.array([0.9, 0.8, 0.6, 0.2, np.nan]), *others)
    result = off_map.Outcome.pool([outcome, outcome]).numbers()
    assert (result['images'], result['matched'], result['wrong']) == (10, 6, 2)
    assert (result['precision'], result['recall']) == (4 / 6, 4 / 8)
    assert (result['unseen'], result['unseen_matched']) == (2, 2)
    assert (result['sure'], result['unseen_sure']) == (0, 0)  # 0.6
    sure = replace(outcome, probabilities=np.array([1, 0.9, 0.95, 0.2, np.nan])).numbers()
    assert (sure['sure'], sure['unseen_sure']) == (1, 1)
    assert result['rates']['0.05'] == (3 / 4, 3 / 4)  # 0.2 is above the table's limit
    lower = replace(outcome, probabilities=np.array([0.99, 0.8, 0.6, 0.4, np.nan])).numbers()
    assert lower['rates'] == {'0.05': (3 / 4, 3 / 4), '0.01': (2 / 3, 2 / 4)}
    assert result['recall_at_100_precision'] == 0.5  # above 0.6
    assert result['f1'] == 3 / 4  # three of four right, one wrong
    bins = outcome.calibration()['bins']
    assert [(row['images'], row['right']) for row in bins] == [(1, 1), (1, 0), (1, 1), (1, 1)]


@pytest.mark.parametrize('page', [accuracy, off_map_page])
def test_pages_of_results_are_written_from_their_rows(page):
    path = BENCHMARKS / 'results' / f'{page.__name__.removesuffix("_page")}.json'
    document = json.loads(path.read_text())
    lines = page.markdown(document, document['results'])
    assert lines[2].startswith('Written by `make ')
    assert '\n'.join(lines).rstrip() + '\n' == path.with_suffix('.md').read_text()


def test_public_graph_one_closure_at_a_time_ends_like_all_at_once():
    """By the errors that its file states, here far above the default ones."""
    graph_files = pytest.importorskip('graph_files', reason='needs gtsam', exc_type=ImportError)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(1.6), -np.sin(1.6)], [np.sin(1.6), np.cos(1.6)]]
    turn[0, 3] = 5.0
    edges = [(i, i + 1, turn, np.eye(6) * 10) for i in range(40)]
    edges += [(i, i + 4, np.eye(4), np.eye(6) * 1e4) for i in range(30)]
    expected = graph_files.ours(edges)
    result, accepted, times = graph_files.one_at_a_time(edges)
    assert accepted.tolist() == expected[1].tolist() == [True] * 30
    np.testing.assert_allclose(result, expected[0], atol=1e-3)
    assert len(times) == 30


@cache
def usage_of(name: str) -> str:
    """Return the usage that a program prints, which runs in this process."""
    module, output = pytest.importorskip(name, exc_type=ModuleNotFoundError), StringIO()
    arguments = patch.object(sys, 'argv', [name, '--help'])
    with arguments, redirect_stdout(output), pytest.raises(SystemExit, match=r'^0$'):
        module.main()
    return output.getvalue().partition('\n\n')[0]


@pytest.mark.parametrize('name', PROGRAMS)
def test_program_prints_its_help(name):
    assert usage_of(name).startswith(f'usage: {name} [-h]')


@pytest.mark.parametrize('page', [ROOT / 'Makefile', *PAGES], ids=lambda page: page.name)
def test_page_names_programs_and_options_that_there_are(page):
    """Each option of a line is one of its programs, or of programs that its targets run."""
    for line in page.read_text().splitlines():
        assert {*re.findall(r'benchmarks/(\w+)\.py', line)} <= {*PROGRAMS}, line
        names = {*re.findall(r'(?<![\w/])(?:benchmarks/)?(\w+)\.py', line)} & {*PROGRAMS}
        names.update(*(TARGETS.get(target, ()) for target in re.findall(r'make ([\w-]+)', line)))
        spans = [span for span in line.split('`')[1::2] or [line] if OWN.search(span)]
        if names and (options := {*OPTION.findall(' '.join(spans))}):
            assert options <= {*OPTION.findall(' '.join(map(usage_of, names)))}, line
