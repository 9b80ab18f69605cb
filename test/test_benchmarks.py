# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks: timing, lower bounds, targets, report, peers, memory, accuracy."""
# ruff: noqa: E402  (the modules of the benchmarks lie beside their commands, not in a package)

from dataclasses import replace
import importlib.util
import json
from pathlib import Path
import sys

import numpy as np
import oracle
import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[1] / 'benchmarks'
sys.path.insert(0, str(BENCHMARKS))

import accuracy
import baselines
import compare
import data
import lower_bounds as bounds
import matching
import memory
import peaks
import peer_process
import report
import results
from results import PeerTime, Row
from run import Peer, Run
import stages
from stavpr_ros.alignment import match_sequence, SequenceDistances
from stavpr_ros.alignment.settings import VelocitySettings
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


def test_timing_of_several_runs_is_median_and_quartile_range():
    assert Timing.of([5.0, 1.0, 2.0, 4.0, 3.0]) == Timing(3.0, 2.0, 5)
    assert Timing.of([1.0, 1.0, 1.0, 9.0]).median_s == 1.0


def test_measure_two_jobs_runs_them_in_turn_after_warm_up(clock):
    found = timing.measure({'a': clock.job('a', 0.02), 'b': clock.job('b', 0.03)}, 0.5)
    assert clock.log[:4] == ['a', 'a', 'b', 'b']
    assert clock.log[4:] == ['a', 'b'] * 10  # 0.5 s of rounds of 0.05 s
    assert found['a'] == Timing(0.02, 0.0, 10)
    assert found['b'].median_s == 0.03


def test_measure_short_job_repeats_it_uncounted_before_each_run(clock):
    found = timing.measure({'a': clock.job('a', 0.001), 'b': clock.job('b', 0.02)}, 0.001)
    assert clock.log[4:7] == ['a', 'a', 'b']
    assert found['a'].runs == found['b'].runs == timing.FEWEST


def test_measure_slow_job_warms_up_once_and_runs_three_times(clock):
    assert timing.measure({'a': clock.job('a', 1.5)}, 0.5)['a'].runs == 3
    assert len(clock.log) == 4


@pytest.mark.parametrize(
    ('round_s', 'rounds'), [(0.2, 7), (0.01, 50), (1e-7, 101), (1.01, 3), (0.0, 101)]
)
def test_rounds_for_a_duration_fills_the_time_within_limits(round_s, rounds):
    assert timing.rounds_for(round_s, 0.5) == rounds


def test_timed_call_waits_for_the_device_before_and_after(clock):
    job = timing.timed(clock.job('call', 1.0), clock.job('wait', 0.25))
    assert job() == 1.25  # work queued before the call does not count
    assert clock.log == ['wait', 'call', 'wait']


def test_best_seconds_returns_the_shortest_run_after_warm_up(clock):
    seconds = iter([9.0, 3.0, 2.0, 4.0, 5.0, 6.0])

    def call():
        clock.now += next(seconds)

    assert timing.best_seconds(call, 'cpu', 10.0) == 2.0  # 3 + 2 + 4 + 5 fill 10 s
    assert next(seconds) == 6.0


# ------------------------------------------------ lower bounds and peaks


def test_bound_of_several_works_adds_the_longer_of_bytes_and_operations():
    works = [
        bounds.Work(200, 1000), bounds.Work(50, 3000), bounds.Work(0, 4000, 'bfloat16')
    ]  # fmt: skip
    assert bounds.bound_seconds(works, PEAKS) == 2.0 + 3.0 + 1.0


def test_product_reads_the_map_once_and_multiplies_all_pairs():
    sizes = bounds.Sizes(10, d=5, W=3)
    assert bounds.product(sizes, 'float32', 4) == bounds.Work(4 * 3 * 10 * 5, 2 * 4 * 9 * 10 * 5)
    assert bounds.product(sizes, 'float16').bytes == 2 * 3 * 10 * 5


def test_operations_of_the_alignments_are_those_of_their_cells():
    def count(rows, columns, inner):
        cells = [(i, j) for i in range(rows) for j in range(columns) if i + j]
        return sum(inner if i and j else 2 for i, j in cells)

    sizes = bounds.Sizes(10, W=3, l=4, k=6)
    assert bounds.spatial_alignment(sizes, 5).operations == 5 * 10 * (count(3, 3, 9) + 1)
    assert bounds.lm_dtw(sizes) == bounds.Work(4 * 4 * 10, 10 * (count(4, 6, 8) + 2 * 6))


def test_operations_of_the_velocity_search_are_those_of_its_predecessors():
    # one velocity of 1: row 1 (the middle) and rows 2, 3 after it, two further predecessors each
    settings = VelocitySettings(speeds=(1.0,))
    rows = (1 + 2 * 3) + 2 * (1 + 2 * 4)
    work = bounds.velocity_search(bounds.Sizes(10, l=4), settings)
    assert work == bounds.Work(4 * 10 * (4 + 2), 10 * (2 * 4 + rows + 5))
    still = bounds.velocity_search(bounds.Sizes(10, l=4), VelocitySettings(speeds=(0.0,)))
    assert still.operations == 10 * (2 * 4 + (1 + 3) + 2 * (1 + 4) + 5)  # one further predecessor


@pytest.mark.parametrize('mode', stages.MODES)
def test_bound_of_a_frame_is_the_sum_of_its_stages(mode):
    sizes = bounds.Sizes(1000)
    works = stages.frame_works(sizes, mode, 'float16')
    common = [
        bounds.product(sizes, 'float16'), bounds.spatial_alignment(sizes),
        bounds.window_push(sizes), bounds.selection(sizes),
    ]  # fmt: skip
    own = {
        'paper': [bounds.lm_dtw(sizes)],
        'robust': [
            bounds.mean_centering(sizes), bounds.query_znorm(sizes), bounds.reference_znorm(sizes),
            bounds.velocity_search(sizes, stages.VELOCITY),
        ],
    }  # fmt: skip
    assert sorted(map(repr, works)) == sorted(map(repr, common + own[mode]))


def test_peaks_are_raised_by_a_faster_stage():
    quick = PEAKS.raised(bounds.Work(2**28, 100, 'bfloat16'), 0.01, 'product')
    assert quick.bytes_per_s == 2**28 / 0.01
    assert quick.operations_per_s['bfloat16'] == 10_000.0
    assert quick.sources == {'read': 'product', 'bfloat16': 'product'}
    assert PEAKS.raised(bounds.Work(2**28 - 1, 100, 'bfloat16'), 0.1, 'from a cache') == PEAKS


def test_peaks_of_a_slower_half_precision_are_those_of_float32():
    slow = replace(PEAKS, operations_per_s={'float32': 1000.0, 'float16': 1.0}).widened()
    assert slow.operations_per_s == {'float32': 1000.0, 'float16': 1000.0}
    assert slow.sources == {'float16': 'float32'}


def test_peaks_of_this_machine_are_plausible():
    found = peaks.measure_peaks('cpu', 0.0, side=128, megabytes=8)
    assert 1e7 < found.bytes_per_s < 1e13
    assert set(found.operations_per_s) == set(bounds.ITEM_BYTES)
    assert all(1e6 < rate < 1e15 for rate in found.operations_per_s.values())


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


@pytest.mark.parametrize('faster', ['queries @ map.T', 'map @ queries.T'])
def test_bare_product_takes_the_faster_orientation(faster, clock, monkeypatch):
    rows, places = torch.randn(3, 4), torch.randn(2, 5, 4)
    multiply, made = torch.mm, []

    def mm(left, right, out):
        form = 'queries @ map.T' if len(left) == 3 else 'map @ queries.T'
        clock.now += 0.02 if form == faster else 0.03
        made.append(out)
        return multiply(left, right, out=out)

    monkeypatch.setattr(torch, 'mm', mm)
    call, form = stages.bare_product(rows, places, timing.nothing)
    call()
    expected = rows @ places.reshape(10, 4).T
    assert form == faster
    wanted = expected if faster == 'queries @ map.T' else expected.T
    np.testing.assert_allclose(made[-1], wanted, rtol=1e-4)


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


@pytest.mark.parametrize(
    ('seconds', 'text'),
    [(2.5, '2.5 s'), (0.0123, '12.3 ms'), (0.0005, '500 µs'), (3e-7, '0.3 µs'), (None, '-')],
)
def test_seconds_text_has_three_digits_and_a_unit(seconds, text):
    assert results.seconds_text(seconds) == text


@pytest.mark.parametrize('value', [(57_740.6, '57,741'), (1.254, '1.25'), (0.01234, '0.0123')])
def test_number_text_has_no_exponent_above_one(value):
    assert results.number_text(value[0]) == value[1]


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


def test_targets_name_measured_sizes_and_known_values():
    for target in targets.TARGETS:
        assert target.value in targets.VALUES
        assert target.n in matching.SIZES or target.device == 'cuda'
        assert target.d in (0, *matching.DIMENSIONS)


def test_report_counts_losses_and_sums_the_stages_of_a_frame():
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
    assert '| 9 ms | 10 ms | 1 ms | 5 ms | 2 |' in text  # seven stages of 1 ms, one of 2 ms
    assert '## Beside peers (1 of 1 lost)' in text
    assert '| 1 MB | 3 MB | 3 | <= 1.1 | **not reached** |' in text
    assert (
        'paper | 20,000 | - | float32 | times librosa | 0.5 | >= 100 | **not reached** |' in text
    )
    assert '| x | 1 | - | why |' in text


# ------------------------------------------------ peers

RUNNER = """
import json, sys
import numpy as np
print(json.dumps({'librosa': '9', 'tslearn': '9'}), flush=True)
for line in sys.stdin:
    request = json.loads(line)
    window, k = np.load(request['window']), request['columns']
    ends = [float(window[:, s : s + k].sum()) for s in request['starts']]
    print(json.dumps({'seconds': len(ends) / 8, 'ends': ends}), flush=True)
"""


def test_peers_run_returns_the_requested_starts():
    window = np.arange(20, dtype=np.float32).reshape(2, 10)
    with peer_process.Peers([sys.executable, '-c', RUNNER]) as peers:
        assert peers.versions['librosa'] == '9'
        reply = peers.run('librosa', peers.put(window), [0, 4], 3)
    assert reply == {'seconds': 0.25, 'ends': [36.0, 60.0]}


def test_peers_that_do_not_start_are_missing():
    with pytest.raises(peer_process.PeersMissingError, match='status 3'):
        peer_process.Peers([sys.executable, '-c', 'raise SystemExit(3)'])


def test_environment_of_the_peers_is_created_once(tmp_path, monkeypatch):
    commands = []

    class Done:
        returncode, stderr, stdout = 0, '', ''

    def fake(command, **_):
        commands.append(command)
        (tmp_path / 'bin').mkdir(exist_ok=True)
        (tmp_path / 'bin' / 'python3').touch()
        return Done

    monkeypatch.setattr(peer_process.subprocess, 'run', fake)
    for _ in range(2):
        assert peer_process.make_environment(tmp_path) == tmp_path / 'bin' / 'python3'
    assert ['venv' in c for c in commands] == [True, False]
    (tmp_path / 'requirements.sha256').write_text('of other requirements')
    Done.returncode, Done.stderr = 1, 'one\nno such package'
    with pytest.raises(peer_process.PeersMissingError, match='no such package'):
        peer_process.make_environment(tmp_path)
    assert len(commands) == 3  # nothing is installed where no environment could be created


def test_runner_passes_the_columns_of_each_start_to_the_peer(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location(
        'peers_runner', BENCHMARKS / 'peers' / 'runner.py'
    )
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    monkeypatch.setattr(runner, 'aligner', lambda peer: lambda costs: costs[-1, -1])
    np.save(tmp_path / 'w.npy', np.arange(20, dtype=np.float32).reshape(2, 10))
    request = {
        'peer': 'librosa',
        'window': str(tmp_path / 'w.npy'),
        'starts': [1, 7],
        'columns': 3,
    }
    assert runner.run(request)['ends'] == [13.0, 19.0]
    monkeypatch.undo()
    with pytest.raises(ValueError, match="'other' is unknown: expected one of librosa, tslearn"):
        runner.aligner('other')


@pytest.mark.parametrize('n', [1, 7, 30])
def test_prange_gives_the_results_of_the_oracle(n):
    # few values that add up exactly: ties everywhere
    window = np.random.default_rng(n).integers(0, 3, (5, n)).astype(np.float32)
    q, m = oracle.match_sequence(window, 2, np.float32)
    distances, lengths = np.empty(n, np.float32), np.empty(n, np.int32)
    baselines.prange()(window, 10, distances, lengths)
    np.testing.assert_array_equal(distances, q)
    np.testing.assert_array_equal(lengths, m)


class FakePeers:
    """Peers that take half a second for a start and accumulate the oracle's sums of a window."""

    versions = {'librosa': '9', 'tslearn': '8'}  # noqa: RUF012

    def __init__(self, window):
        self._window = window

    def put(self, window):
        return Path('window.npy')

    def run(self, peer, path, starts, k):
        costs = [self._window[:, s : s + k] for s in starts[:3]]
        ends = [oracle.accumulate(c, 1, np.float64).S[-1][-1] for c in costs]
        return {'seconds': 0.5 * len(starts), 'ends': ends}


def test_sequence_peers_scale_samples_and_reject_other_results():
    window = data.make_window(20, 100, 0)
    ours = match_sequence(window, stages.SEQUENCE)
    found = {peer.name: peer for peer in stages.sequence_peers(window, ours, FakePeers(window))}
    assert found['librosa'].note.endswith('61 starts, scaled')  # all starts with 40 columns
    assert found['librosa'].job() == found['tslearn'].job() == pytest.approx(50.0)
    wrong = SequenceDistances(ours.distances, ours.lengths + 1)
    with pytest.raises(AssertionError):
        stages.sequence_peers(window, wrong, None)
    with pytest.raises(AssertionError, match='librosa, start 0'):
        stages.sequence_peers(window, ours, FakePeers(window + 1))


def test_sample_is_spread_over_starts_that_see_all_columns():
    assert baselines.sample(1000, 40, 4) == [0, 320, 640, 960]
    assert baselines.sample(42, 40, 500) == [0, 1, 2]
    assert baselines.sample(5, 40, 3) == [0]


# ------------------------------------------------ data, memory, comparison, accuracy


def test_make_features_draws_unit_norm_from_a_seed(monkeypatch):
    monkeypatch.setattr(data, 'BLOCK_BYTES', 4 * 16 * 5)  # blocks that do not divide the rows
    features, again = (data.make_features(9, 16, 7, 'cpu', 3).strips.numpy() for _ in range(2))
    np.testing.assert_allclose(np.linalg.norm(features, axis=2), 1, rtol=1e-5)
    np.testing.assert_array_equal(features, again)
    assert len(np.unique(features.reshape(63, 16), axis=0)) == 63
    assert not np.array_equal(features, data.make_features(9, 16, 7, 'cpu', 4).strips.numpy())


def test_data_folder_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv('STAVPR_DATA', str(tmp_path))
    assert data.data_folder() == tmp_path
    monkeypatch.setenv('STAVPR_DATA', str(tmp_path / 'none'))
    with pytest.raises(data.NoDataError, match='none: set STAVPR_DATA'):
        data.data_folder()


def test_measure_memory_counts_at_least_the_features():
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


def test_compare_of_this_checkout_with_itself_gives_equal_results(capsys):
    given = '--sizes 40 --dimensions 16 --precisions float32 --rounds 2 --frames 3 --allowed 1e9'
    assert compare.main([str(BENCHMARKS.parent), *given.split()]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ['mode', 'robust', 'paper']
    assert all(line.endswith('equal') for line in lines[1:])


@pytest.mark.parametrize(
    ('name', 'before', 'after', 'worse'),
    [
        ('f1', 0.9, 0.8, True),
        ('f1', 0.8, 0.9, False),
        ('recall_at_1', 0.9, 0.8, True),
        ('threshold', 0.9, 0.8, False),
        ('precision', 0.9, 0.8, False),  # at the best F1
        ('true_positives', 9, 8, False),
    ],
)
def test_changes_of_a_value_are_listed_and_judged(name, before, after, worse):
    old, new = ({'a': {'sequence': {name: value, 'queries': 5}}} for value in (before, after))
    lines, found = accuracy.changes(old | {'b': {}}, new)
    assert lines == [f'{"WORSE" if worse else "changed"}: a sequence.{name}: {before} -> {after}']
    assert found is worse
    assert accuracy.changes(old, old) == ([], False)


def test_changes_at_the_default_threshold_and_of_unknown_images_are_judged():
    old = {'a': {'at_default': {'precision': 0.9}}, 't': {'images': 9, 'matched': 3}}
    new = {'a': {'at_default': {'precision': 0.8}}, 't': {'images': 9, 'matched': 4}}
    lines, worse = accuracy.changes(old, new)
    assert worse
    assert [line.split(':')[0] for line in lines] == ['WORSE', 'WORSE']
    assert not accuracy.changes(new, old)[1]
    assert accuracy.changes({'a': {'f1': 1.0}}, {'a': {}})[1]  # a value that is gone


def test_committed_accuracy_table_has_all_rows_and_its_markdown():
    path = BENCHMARKS / 'results' / 'accuracy-eb40c94.json'
    document = json.loads(path.read_text())
    text = '\n'.join(accuracy.markdown(document, document['results'])).rstrip() + '\n'
    assert path.with_suffix('.md').read_text() == text
    assert document['results']['gardens_point/g/robust/same']['sequence']['f1'] > 0.99


# ------------------------------------------------ the command


def test_parse_quick_keeps_to_small_sizes():
    assert list(matching.parse(['--quick']).sizes) == [2_000, 20_000]
    assert list(matching.parse([]).sizes) == [2_000, 20_000, 100_000]


def test_command_measures_every_stage_of_both_modes(tmp_path, monkeypatch):
    monkeypatch.setattr(peaks, 'measure_peaks', lambda *_: PEAKS)
    given = '--sizes 50 --dimensions 16 --seconds 0.001 --no-peers --no-memory --commit abc'
    assert matching.main([*given.split(), '--output', str(tmp_path)]) == 0
    (path,) = tmp_path.glob('matching-*.json')
    document = json.loads(path.read_text())
    rows = document['rows']
    robust = {row['stage'] for row in rows if row['mode'] in ('', 'robust')}
    assert robust == {*report.ROBUST_STAGES, 'distance_matrix', 'frame'}
    paper = {row['stage'] for row in rows if row['mode'] == 'paper'}
    assert paper == {'lm_dtw', 'selection', 'path_trace', 'frame'}
    assert document['commit'] == 'abc'
    assert all(row['lower_bound_s'] > 0 and row['spread_s'] >= 0 for row in rows)
    assert {'librosa', 'tslearn'} <= {skipped['name'] for skipped in document['skipped']}
    text = path.with_suffix('.md').read_text()
    assert text.index('A frame in mode robust') < text.index('## All stages')


def test_command_on_a_missing_device_is_rejected(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: False)
    assert matching.main(['--device', 'cuda', '--output', str(tmp_path)]) == 2
    assert 'torch sees no CUDA device here' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_command_skips_sizes_beyond_the_memory_with_a_reason(tmp_path, monkeypatch):
    run = Run('cpu')
    options = matching.parse(
        ['--sizes', '50', '--dimensions', '16', '--memory', '1e-6', '--no-peers']
    )
    options.precisions = ('float32',)
    for name in ('robust_stages', 'paper_stages'):
        monkeypatch.setattr(stages, name, lambda *_: None)
    matching.measure_stages(run, options)
    assert run.skipped[0].reason == 'needs 0.0 GB, 0.0 GB may be used'
