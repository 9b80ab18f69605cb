# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks, end to end on tiny sizes: matching, outcomes."""
# ruff: noqa: E402  (the modules of the benchmarks lie beside their commands, not in a package)

import ast
from dataclasses import replace
import importlib
import json
from pathlib import Path
import sys

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


def test_benchmarks_import_only_what_the_packages_have():
    """Also of those whose own packages, such as gtsam, are not installed here."""
    missing = []
    for path in sorted(BENCHMARKS.glob('*.py')):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('stavpr_'):
                module = importlib.import_module(node.module)
                for name in (alias.name for alias in node.names):
                    try:
                        hasattr(module, name) or importlib.import_module(f'{node.module}.{name}')
                    except ImportError:
                        missing.append(f'{path.name}: {node.module}.{name}')
    assert not missing
