# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks: timing, lower bounds, targets, report, peers, memory, accuracy."""
# ruff: noqa: E402  (the modules of the benchmarks lie beside their commands, not in a package)

from dataclasses import replace
import json
from pathlib import Path
import sys

import cv2
import numpy as np
import oracle
import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[2] / 'benchmarks'
sys.path.insert(0, str(BENCHMARKS))

import accuracy
import city
import compare
import data
import graphs
import lower_bounds as bounds
import matching
import memory
import off_map
import off_map_page
import peaks
import report
import results
from results import PeerTime, Row
from run import Peer, Run
import stages
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.alignment import match_sequence, SequenceDistances
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition.match import Match, Status
import targets
import timing
from timing import Timing

PEAKS = bounds.Peaks(100.0, {'float32': 1000.0, 'bfloat16': 4000.0, 'float16': 4000.0})
ROW = Row(
    'lm_dtw', 'paper', 20_000, 0, 'float32', 0.002, 0.0001, 9, 0.001, extra={'cells': 16_000_000}
)


class Clock:
    """A clock that only jobs advance, and the log of the jobs."""

    def __init__(self):
        self.now, self.log = 0.0, []

    def job(self, name, seconds):
        def run():
            self.log.append(name)
            self.now += seconds
            return seconds

        return run


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(timing.time, 'perf_counter', lambda: clock.now)
    return clock


# ------------------------------------------------ timing


def test_measure_two_jobs_runs_them_in_turn_after_warm_up(clock):
    found = timing.measure({'a': clock.job('a', 0.02), 'b': clock.job('b', 0.03)}, 0.5)
    assert clock.log[:4] == ['a', 'a', 'b', 'b']
    assert clock.log[4:] == ['a', 'b'] * 10  # 0.5 s of rounds of 0.05 s
    assert found['a'] == Timing(0.02, 0.0, 10)
    assert found['b'].median_s == 0.03


@pytest.mark.parametrize(('round_s', 'rounds'), [(0.01, 50), (0.0, 101), (1.01, 3)])
def test_rounds_for_duration_fills_time_within_limits(round_s, rounds):
    assert timing.rounds_for(round_s, 0.5) == rounds


# ------------------------------------------------ lower bounds and peaks


def test_bound_of_several_works_adds_longer_of_bytes_and_operations():
    works = [
        bounds.Work(200, 1000), bounds.Work(50, 3000), bounds.Work(0, 4000, 'bfloat16')
    ]  # fmt: skip
    assert bounds.bound_seconds(works, PEAKS) == 2.0 + 3.0 + 1.0


def test_operations_of_alignments_are_those_of_their_cells():
    def count(rows, columns, inner):
        cells = [(i, j) for i in range(rows) for j in range(columns) if i + j]
        return sum(inner if i and j else 2 for i, j in cells)

    sizes = bounds.Sizes(10, W=3, l=4, k=6)
    assert bounds.spatial_alignment(sizes, 5).operations == 5 * 10 * (count(3, 3, 9) + 1)
    assert bounds.lm_dtw(sizes) == bounds.Work(4 * 4 * 10, 10 * (count(4, 6, 8) + 2 * 6))


def test_peaks_are_raised_by_faster_stage():
    quick = PEAKS.raised(bounds.Work(2**28, 100, 'bfloat16'), 0.01, 'product')
    assert quick.bytes_per_s == 2**28 / 0.01
    assert quick.operations_per_s['bfloat16'] == 10_000.0
    assert quick.sources == {'read': 'product', 'bfloat16': 'product'}
    assert PEAKS.raised(bounds.Work(2**28 - 1, 100, 'bfloat16'), 0.1, 'from a cache') == PEAKS


def test_reference_slower_than_float32_is_left_out_by_name(monkeypatch):
    rates = {'float32': 9e10, 'bfloat16': 1e9, 'float16': 1e11}
    monkeypatch.setattr(peaks, 'matrix_rate', lambda device, dtype, *_: rates[dtype])
    peaks.slower_than_float32.cache_clear()
    monkeypatch.setattr(stages, 'slower_than_float32', peaks.slower_than_float32)
    assert (
        peaks.slower_than_float32('cpu', 'float16')
        == peaks.slower_than_float32('cpu', 'float32')
        == ''
    )
    run = Run('cpu')
    places, queries = (data.make_features(n, 4, 7, 'cpu', 0) for n in (9, 1))
    found = stages.products(run, places, queries, 'bfloat16')
    peaks.slower_than_float32.cache_clear()
    assert [peer.name for peer in found] == ['torch float32']
    (left_out,) = run.skipped
    assert (left_out.name, left_out.n) == ('torch bfloat16', 0)
    assert '1.0 G operations/s, slower than float32 (90.0)' in left_out.reason


# ------------------------------------------------ rows, targets, report


def test_run_gives_rows_with_bounds_and_peers(clock, capsys):
    run, sizes = Run('cpu', 0.1), bounds.Sizes(10, d=0)
    peer = Peer('other', clock.job('other', 0.2), 'its note')
    run.measure('lm_dtw', (10, 0), clock.job('ours', 0.1), [bounds.lm_dtw(sizes)], [peer])
    big = bounds.Work(2**30, 5e9)
    run.measure('image_distances', (10, 4), clock.job('ours', 0.1), [big])
    run.skip('frame', 10, 512, 'too large')
    (row, distances), found = run.finish(PEAKS)
    assert found.bytes_per_s == pytest.approx(
        2**30 / 0.1
    )  # a stage that showed more than the peak
    assert distances.ratio == pytest.approx(1.0)
    assert row.lower_bound_s == bounds.bound_seconds([bounds.lm_dtw(sizes)], found)
    assert (row.median_s, row.runs) == (pytest.approx(0.1), 7)
    assert row.peers == (
        PeerTime('other', pytest.approx(0.2), pytest.approx(0), pytest.approx(2), 'its note'),
    )
    assert 'left out: frame, n = 10, d = 512: too large' in capsys.readouterr().err


@pytest.mark.parametrize(('ratio', 'reached'), [(8.0, True), (7.99, False)])
def test_target_at_its_bound_is_reached(ratio, reached):
    target = targets.Target(
        'cpu', 'lm_dtw', 'paper', 20_000, 0, 'float32', 'times plain prange', '>=', 8
    )
    row = replace(ROW, peers=(PeerTime('prange', 1.0, 0.0, ratio),))
    assert target.found([replace(row, n=3), row]) == ratio
    assert target.reached(ratio) is reached
    below = replace(target, relation='<=', wanted=8)
    assert below.reached(ratio)
    assert target.found([replace(row, mode='robust')]) is None


def test_report_counts_losses_and_sums_stages_of_frame():
    parts = [Row(s, 'robust', 5, 0, 'float32', 0.001, 0, 7) for s in report.ROBUST_STAGES[2:]]
    parts += [Row('mean_centering', 'robust', 5, 8, 'float32', 0.001, 0.0, 7)]
    parts += [Row('image_distances', '', 5, 8, p, 0.002, 0.0, 7) for p in ('float16', 'float32')]
    whole = Row('frame', 'robust', 5, 8, 'float16', 0.010, 0.001, 7, 0.005)
    loss = PeerTime('librosa', 0.001, 0.0, 0.5, 'one core')
    partial = PeerTime('torch float32', 0.001, 0.0, 0.1, partial=True)
    held = memory.Memory('localization', 'robust', 'float16', 5, 8, 10**6, 3 * 10**6)
    about = results.environment(named_commit='abc')
    rows = [*parts, whole, replace(ROW, peers=(loss, partial))]
    text = '\n'.join(
        report.report(about, rows, [held], PEAKS, [results.Skipped('x', 1, 0, 'why')])
    )
    assert 'Commit abc' in text
    assert '| 7 ms | 10 ms | 1 ms | 5 ms | 2 |' in text  # five stages of 1 ms, one of 2 ms
    assert '## Beside peers (1 of 1 lost)' in text
    assert '| 1 MB | 3 MB | 3 | <= 1.1 | **not reached** |' in text
    assert (
        'paper | 20,000 | - | float32 | times librosa | 0.5 | >= 100 | **not reached** |' in text
    )
    assert '| x | 1 | - | why |' in text


# ------------------------------------------------ peers


def accumulate(costs):
    return np.array(oracle.accumulate(costs, 1, np.float64).S)


def test_librosa_peer_scales_sample_and_rejects_other_sums(clock):
    def dtw(C, backtrack):
        clock.now += 0.5
        return accumulate(C)

    window = data.make_window(5, 600, 0)
    peer = stages.librosa_peer(window, dtw)
    assert peer.note.endswith('500 starts, scaled')  # of 600
    assert peer.job() == pytest.approx(0.5 * 600)
    with pytest.raises(AssertionError, match='start 0'):
        stages.librosa_peer(window, lambda C, backtrack: accumulate(C + 1))


def test_sequence_peers_with_other_results_are_rejected():
    window = data.make_window(20, 100, 0)
    ours = match_sequence(window, stages.SEQUENCE)
    assert stages.sequence_peers(Run('cpu'), window, ours)[0].name == 'prange'
    wrong = SequenceDistances(ours.distances, ours.lengths + 1)
    with pytest.raises(AssertionError):
        stages.sequence_peers(Run('cpu'), window, wrong)


# ------------------------------------------------ data, memory, comparison, accuracy


@pytest.mark.long
def test_measure_memory_counts_at_least_features():
    found = memory.measure_memory('localization', 'robust', 'float32', 2_000, 512)
    assert found.feature_bytes == 2_000 * 512 * 7 * 4
    assert 0.9 < found.ratio < 10


def test_compare_takes_ratios_pair_by_pair_and_compares_results():
    class Fake:
        def __init__(self, seconds, result):
            self.seconds, self.result, self.requests = iter(seconds), result, []

        def run(self, **request):
            self.requests.append(request)
            if 'n' in request:
                return {}
            return {'seconds': [9.0] + [next(self.seconds)] * 3, 'results': self.result}

    this, other = Fake([1.0, 2.0, 3.0], [1]), Fake([2.0, 2.0, 2.0], [1])
    found = compare.compare(this, other, {'n': 5}, rounds=3, frames=3)
    assert found['ratio'] == 1.0
    assert found['ratio_quartiles'] == [0.75, 1.25]
    assert (found['this_s'], found['other_s'], found['equal_results']) == (2.0, 2.0, True)
    assert this.requests == [{'n': 5}, *[{'frames': 4}] * 3]
    differs = compare.compare(Fake([1.0] * 2, [1]), Fake([1.0] * 2, [2]), {'n': 5}, 2, 3)
    assert not differs['equal_results']


@pytest.mark.long
def test_compare_of_this_checkout_with_itself_gives_equal_results(capsys):
    given = '--sizes 40 --dimensions 16 --precisions float32 --rounds 2 --frames 3 --allowed 1e9'
    assert compare.main([str(BENCHMARKS.parent), *given.split()]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ['mode', 'robust', 'paper']
    assert all(line.endswith('equal') for line in lines[1:])


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


def test_committed_accuracy_table_has_all_rows_and_its_markdown():
    path = BENCHMARKS / 'results' / 'accuracy-eb40c94.json'
    document = json.loads(path.read_text())
    text = '\n'.join(accuracy.markdown(document, document['results'])).rstrip() + '\n'
    assert path.with_suffix('.md').read_text() == text
    assert document['results']['gardens_point/g/robust/same']['sequence']['f1'] > 0.99


# ------------------------------------------------ off the map


def outcome_of(accepted, probabilities, correct, has_match, unseen):
    columns = [np.array(values, bool) for values in (accepted, correct, has_match, unseen)]
    return off_map.Outcome(columns[0], np.array(probabilities, float), *columns[1:])


OUTCOME = outcome_of(
    [1, 1, 1, 0, 0], [0.9, 0.8, 0.6, 0.2, np.nan], [1, 1, 0, 1, 0], [1, 1, 0, 1, 1],
    [0, 0, 1, 0, 0],
)  # fmt: skip


def test_outcome_counts_right_wrong_and_unseen_matches():
    found = off_map.Outcome.pooled([OUTCOME, OUTCOME]).numbers()
    assert (found['images'], found['matched'], found['wrong']) == (10, 6, 2)
    assert (found['precision'], found['recall']) == (4 / 6, 4 / 8)
    assert (found['unseen'], found['unseen_matched']) == (2, 2)
    assert found['recall_at_100_precision'] == 0.5  # above 0.6
    assert found['f1'] == 3 / 4  # three of four right, one wrong
    calibration = OUTCOME.calibration()
    assert [(row['images'], row['right']) for row in calibration['bins']] == [
        (1, 1.0), (1, 0.0), (1, 1.0), (1, 1.0)
    ]  # fmt: skip


@pytest.fixture
def route():
    """Sixty places and the same images with noise."""
    places = data.make_features(60, 24, 7, 'cpu', 0)
    noise = data.make_features(60, 24, 7, 'cpu', 1)
    seen = places.strips + 0.3 * noise.strips
    query = replace(places, strips=seen / seen.norm(dim=2, keepdim=True))
    stamps, ids = np.zeros(60, np.int64), ('',) * 60
    maps = [PlaceMap(features, None, stamps, ids) for features in (places, query)]
    return off_map.Pair('route', *maps, GroundTruth.identity(60, 60, 2))


def test_table_of_synthetic_route_has_every_section(route, monkeypatch):
    monkeypatch.setattr(off_map, 'REMOVED', (20, 40))  # more than half of the map: no row
    monkeypatch.setattr(off_map, 'STEP', 20)
    measurement = off_map.Measurement('g')
    measurement.pair(route)
    measurement.floors({'first': route.places, 'second': route.query})
    rows = measurement.finish()
    same = rows['drives/g/route/same']
    assert (same['images'], same['precision'], same['recall']) == (60, 1, 1)
    detour = rows['detours/g/route/20']
    assert detour['positions'] == 3  # 0:20, 20:40, 40:60
    assert detour['unseen'] == 15 + 10 + 15  # those within five places of the map are left out
    assert 'detours/g/route/40' not in rows
    start = rows['start/g/route/whole map']
    assert (start['starts'], start['right']) == (1, 1)  # at 20; one at 40 leaves no 30 images
    assert start['longest'] == off_map.SETTINGS.sequence.length
    floors = rows['floors/g/tower']
    assert (floors['pairs'], floors['images']) == (2, 120)
    assert floors['matched'] >= 100  # the same place under another name
    assert rows['floors/g/tower, standstill']['images'] == 120
    about = results.environment(named_commit='abc')
    text = '\n'.join(off_map_page.markdown(about, json.loads(json.dumps(rows, allow_nan=False))))
    for title in ('Detours', 'Floors', 'Drives', 'The route in reverse', 'Start', 'Calibration'):
        assert f'## {title}' in text
    assert (
        f'| detours: unseen images matched | {detour["unseen_matched"] / 40:.1%} of 40 |' in text
    )


def test_first_right_match_counts_images_since_start():
    truth = GroundTruth.identity(6, 6)

    def match(status, place):
        return Match(status, '', 1.0, SequenceMatch(place, place, place, 0.5, -1, np.nan))

    matches = [Match(Status.WARMING_UP, '', 1.0)] * 3
    matches += [match(Status.MATCH, 5), match(Status.NO_MATCH, 2), match(Status.MATCH, 3)]
    assert off_map.first_right(matches, truth, 4) == 6  # windows of 4: image 3 is the middle
    assert off_map.first_right(matches[:5], truth, 4) is None


# ------------------------------------------------ the command


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
    assert all(row['lower_bound_s'] > 0 and row['spread_s'] >= 0 for row in rows)
    text = path.with_suffix('.md').read_text()
    assert text.index('A frame in mode robust') < text.index('## All stages')


def test_process_of_matches_is_measured_beside_process_without():
    run = Run('cpu', 0.001)
    stages.process_stages(run, 2 * stages.DRIVEN, 'int8', 0)
    (row, _), = run.rows
    assert (row.stage, [peer.name for peer in row.peers]) == ('process', ['without matches'])


def test_command_on_missing_device_is_rejected(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: False)
    assert matching.main(['--device', 'cuda', '--output', str(tmp_path)]) == 2
    assert 'torch sees no CUDA device here' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_usearch_peer_finds_the_nearest_image_or_is_left_out(monkeypatch):
    places, query = (data.make_features(n, 16, 7, 'cpu', 0) for n in (50, 1))
    run = Run('cpu')
    peers = stages.usearch_peer(run, places, query)
    assert len(peers) == 1 or run.skipped[0].name == 'usearch'
    monkeypatch.setitem(sys.modules, 'usearch.index', None)
    assert stages.usearch_peer(run, places, query) == []
    assert 'requirements/bench.txt' in run.skipped[-1].reason


# ------------------------------------------------ the city


def test_city_results_are_merged_and_written_between_the_marks(tmp_path):
    def result(case, places, precision):
        drive = {'precision': precision, 'recall': 0.5, 'processor_ms': 12.0}
        found = {'exact': drive, 'first_stage': drive, 'statuses_changed': 1, 'places_moved': 0}
        return found | {'case': case, 'places': places, 'threads': 2, 'load': 0.1}

    path, page = tmp_path / 'city.json', tmp_path / 'page.md'
    assert city.merged(path, []) == []
    city.merged(path, [result('corridor', 1000, 0.1), result('gardens_point', 1000, 0.2)])
    found = city.merged(path, [result('corridor', 1000, 0.75)])
    assert len(found) == 2
    page.write_text(f'before {city.BEGIN} old {city.END} after')
    city.write_page(found, page)
    city.write_page(found, page)
    text = page.read_text()
    assert text.startswith('before')
    assert text.endswith('after')
    assert 'old' not in text
    assert text.index('gardens_point') < text.index('corridor')
    assert text.count('| corridor | 1,000 | 0.750 / 0.500 |') == 1


def test_city_page_has_its_marks():
    text = city.PAGE.read_text(encoding='utf-8')
    assert text.count(city.BEGIN) == text.count(city.END) == 1


def similar_places():
    """Return places of which each resembles the one before, and all their mean."""
    strips = data.make_features(60, 16, 7, 'cpu', 0).strips + 0.3
    strips[:, 1:] += strips[:, :-1].clone()
    weights = torch.full((7, 60), 7**-0.5)
    unit = strips / strips.norm(dim=2, keepdim=True)
    return LocalFeatures(unit, weights, FeatureSettings('synthetic', None))


def test_simulated_places_have_mean_and_neighbors_of_real_ones():
    real = similar_places()
    strips = torch.cat(list(city.simulated(real, 5000, seed=0)), dim=1)
    assert strips.shape == (7, 5000, real.dimension)
    torch.testing.assert_close(strips.norm(dim=2), torch.ones(7, 5000))
    mean, expected = strips.mean(dim=1), real.strips.mean(dim=1)
    assert float(torch.cosine_similarity(mean.flatten(), expected.flatten(), dim=0)) > 0.99
    change = 1 - (strips[:, 1:] * strips[:, :-1]).sum(dim=2).mean()
    of_real = 1 - (real.strips[:, 1:] * real.strips[:, :-1]).sum(dim=2).mean()
    assert 0.5 < float(change / of_real) < 2


def test_city_holds_real_places_at_its_first():
    real = similar_places()
    features, first = city.city(real, 500, seed=0)
    torch.testing.assert_close(
        features[first : first + len(real)].strips, real.strips, atol=1e-3, rtol=0
    )
    assert features.dimension == real.dimension
    assert len(features) == 500


def test_graph_of_committed_results_is_drawn(tmp_path):
    path = results.RESULTS / 'matching-amd-epyc-2-cores-512-bit.json'
    rows = graphs.read(path)
    assert {row.stage for row in rows} >= {'image_distances', 'filter_update', 'frame'}
    graphs.draw(rows, tmp_path / 'graph.png')
    assert cv2.imread(str(tmp_path / 'graph.png')).shape[1] > 1000
