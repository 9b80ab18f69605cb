# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks, end to end on tiny sizes: matching, comparison, accuracy, protocol, city."""
# ruff: noqa: E402  (the modules of the benchmarks lie beside their commands, not in a package)

from dataclasses import replace
import json
from pathlib import Path
import sys

import cv2
from evaluation_commands import write_images
from fixtures import route_images
import numpy as np
import pytest
from stavpr_ros.prepare.centering import unit_norm

BENCHMARKS = Path(__file__).resolve().parents[2] / 'benchmarks'
sys.path.insert(0, str(BENCHMARKS))

import accuracy
import data
from lower_bounds import Peaks
import matching
import off_map
import off_map_page
import peaks
import protocol
import report
import results
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.mapping import descriptor_map
from stavpr_ros.sources import open_source

PEAKS = Peaks(1e9, 1e10)


# ------------------------------------------------ matching


def test_command_measures_every_stage_of_both_modes(tmp_path, monkeypatch):
    monkeypatch.setattr(peaks, 'measure_peaks', lambda *_: PEAKS)
    monkeypatch.setattr(matching, 'CITY', 200)
    given = '--sizes 50 300 --dimensions 16 --seconds 0.001 --no-memory --commit abc'
    assert matching.main([*given.split(), '--output', str(tmp_path)]) == 0
    (path,) = tmp_path.glob('matching-*.json')
    document = json.loads(path.read_text())
    rows = document['rows']
    robust = {row['stage'] for row in rows if row['mode'] in ('', 'robust')}
    assert robust == {
        *('decoding', 'extraction', '1080p raw to features', '1080p JPEG to features'),
        *report.ROBUST_STAGES, 'distance_matrix', 'frame', 'first_stage',
    }  # fmt: skip
    paper = {row['stage'] for row in rows if row['mode'] == 'paper'}
    assert paper == {'lm_dtw', 'selection', 'path_trace', 'frame'}
    assert document['commit'] == 'abc'
    for row in rows:
        assert row['ratio_to_lower_bound'] == row['median_s'] / row['lower_bound_s']
    text = path.with_suffix('.md').read_text()
    assert text.index('A frame in mode robust') < text.index('## All stages')
    assert cv2.imread(str(path.with_suffix('.png'))).shape[1] > 1000


# ------------------------------------------------ peers on an equal footing


# ------------------------------------------------ comparison, accuracy


@pytest.mark.parametrize(
    ('group', 'name', 'before', 'after', 'worse'),
    [
        ('sequence', 'f1', 0.9, 0.8, True),
        ('sequence', 'f1', 0.8, 0.9, False),
        ('sequence', 'precision', 0.9, 0.8, False),  # at the best F1
        ('at_default', 'precision', 0.9, 0.8, True),
        ('unknown', 'matched', 3, 4, True),
    ],
)
def test_changes_of_value_are_listed_and_classified(group, name, before, after, worse):
    old, new = ({'a': {group: {name: value, 'queries': 5}}} for value in (before, after))
    lines, found = accuracy.changes(old | {'b': {}}, new)
    assert lines == [f'{"WORSE" if worse else "changed"}: a {group}.{name}: {before} -> {after}']
    assert found is worse
    assert accuracy.changes(old, old) == ([], False)
    assert accuracy.changes(old, {'a': {}})[1]  # a value is gone


# ------------------------------------------------ off the map


def test_outcome_counts_right_wrong_and_unseen_matches():
    columns = ([1, 1, 1, 0, 0], [1, 1, 0, 1, 0], [1, 1, 0, 1, 1], [0, 0, 1, 0, 0])
    accepted, *others = (np.array(values, bool) for values in columns)
    outcome = off_map.Outcome(accepted, np.array([0.9, 0.8, 0.6, 0.2, np.nan]), *others)
    found = off_map.Outcome.pooled([outcome, outcome]).numbers()
    assert (found['images'], found['matched'], found['wrong']) == (10, 6, 2)
    assert (found['precision'], found['recall']) == (4 / 6, 4 / 8)
    assert (found['unseen'], found['unseen_matched']) == (2, 2)
    assert (found['sure'], found['unseen_sure']) == (0, 0)  # 0.6
    sure = replace(outcome, probabilities=np.array([1, 0.9, 0.95, 0.2, np.nan])).numbers()
    assert (sure['sure'], sure['unseen_sure']) == (1, 1)
    assert found['recall_at_100_precision'] == 0.5  # above 0.6
    assert found['f1'] == 3 / 4  # three of four right, one wrong
    bins = outcome.calibration()['bins']
    assert [(row['images'], row['right']) for row in bins] == [(1, 1), (1, 0), (1, 1), (1, 1)]


def test_table_of_synthetic_route_has_every_section(monkeypatch):
    """Sixty places and the same images with noise."""
    places, noise = (data.make_features(60, 24, 7, seed) for seed in (0, 1))
    strips = unit_norm(places.strips + 0.3 * noise.strips)
    maps = [descriptor_map(replace(places, strips=each)) for each in (places.strips, strips)]
    monkeypatch.setattr(off_map, 'LONGEST', 20)
    monkeypatch.setattr(off_map, 'STEP', 20)
    measurement = off_map.Measurement('g')
    measurement.pair(off_map.Pair('route', *maps, GroundTruth.identity(60, 60, 2)))
    measurement.floors({'first': maps[0], 'second': maps[1]})
    rows = measurement.finish()
    same = rows['drives/g/route/same']
    assert (same['images'], same['precision'], same['recall']) == (60, 1, 1)
    detour = rows['detours/g/route']
    assert detour['positions'] == 41  # 0:20 to 40:60
    assert detour['unseen'] == 39 * 10 + 2 * 15  # without those within five places of the map
    start = rows['start/g/route/whole map']
    assert (start['starts'], start['right']) == (1, 1)  # at 20; one at 40 leaves no 30 images
    floors = rows['floors/g/tower']
    assert (floors['pairs'], floors['images']) == (2, 120)
    assert floors['matched'] >= 100  # the same place under another name
    about = results.environment(named_commit='abc') | {'stretches': 'each begins at a place'}
    text = '\n'.join(off_map_page.markdown(about, json.loads(json.dumps(rows, allow_nan=False))))
    matched = f'{detour["unseen_matched"] / 420:.1%} of 420, {detour["unseen_sure"]} declared 0.95'
    assert f'| detours: unseen images matched | {matched} or more |' in text
    for row in ('other floors', 'lowest precision', 'reverse order', 'start', 'calibration'):
        assert f'\n| {row}' in text


# ------------------------------------------------ the protocol


def test_protocol_of_folders_has_all_methods_and_leaves_stops_out(monkeypatch, tmp_path):
    """Thirty images and the same darker, with a stop of four images and a black one."""
    images = route_images(30)
    images[10:14], images[20] = [images[9]] * 4, images[20] * 0
    for name, factor in (('day', 1), ('night', 0.5)):
        write_images(tmp_path / name, [(each * factor).astype(np.uint8) for each in images])
    monkeypatch.setattr(protocol, 'CASES', {'walk': ('day', 'night')})
    monkeypatch.setattr(protocol, 'TRAIN', 'day')
    monkeypatch.setattr(protocol, 'EXCERPT', (('walk', 2, 5), ('walk_clean', 1, 20)))
    monkeypatch.setattr(protocol, 'LABELS', {'g': 'gradient', 'p': 'patches'})
    found = dict(protocol.measure(tmp_path, quick=False))
    assert list(found) == ['walk/g', 'walk_clean/g', 'walk/p', 'walk_clean/p']
    assert [len(rows) for rows in found.values()] == [96, 96, 16, 16]
    stored = json.loads(json.dumps(found, allow_nan=False))
    (line,) = (row for row in protocol.excerpt(stored) if 'gradient | robust' in row)
    assert line.endswith('| 1.000 (1.000-1.000), 1.000 |')
    page = '\n'.join(protocol.markdown(results.environment(named_commit='abc'), stored))
    assert page.count('\n| robust | 20 |') == 2
    assert len(protocol.clean(*(open_source(tmp_path / name) for name in ('day', 'night')))) == 25


# ------------------------------------------------ the city
