"""The benchmark of the matching: its clock, floors, records, marks, table and peers, mostly on fakes."""
# ruff: noqa: E402  (the command's modules lie beside it, not in a package)

import importlib.util
import json
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import oracle
import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[1] / 'benchmarks'
sys.path.insert(0, str(BENCHMARKS))

import baselines
import ceilings
import data
import floors
import marks
import matching
import peer_process
import records
import report
import stages
import subjects
import timing
from records import Record
from run import Peer, Run
from timing import Timing

from stavpr_ros.alignment import SequenceDistances, SequenceSettings, match_sequence
from stavpr_ros.recognition.matcher import PRECISIONS

CEILINGS = floors.Ceilings(100.0, {'float32': 1000.0, 'bfloat16': 4000.0}, 80.0)
FULL = replace(CEILINGS, operations_per_s=CEILINGS.operations_per_s | {'float16': 4000.0})
RECORD = Record('lm_dtw', 20_000, 0, 'float32', 'cpu', 0.002, 0.0001, 9, 0.001, extra={'data': 'random'})


@pytest.fixture
def clock(monkeypatch):
    """A clock that only jobs move on."""

    class Clock:
        now = 0.0

        def job(self, name, seconds, log):
            def run():
                log.append(name)
                self.now += seconds
                return seconds

            return run

    clock = Clock()
    monkeypatch.setattr(timing.time, 'perf_counter', lambda: clock.now)
    return clock


# ------------------------------------------------ timing


def test_median_and_spread_are_quartiles():
    assert Timing.of([5.0, 1.0, 2.0, 4.0, 3.0]) == Timing(3.0, 2.0, 5)
    assert Timing.of([1.0, 1.0, 1.0, 9.0]).median_s == 1.0


def test_jobs_run_in_turn_after_warming_up(clock):
    log = []
    jobs = {'a': clock.job('a', 0.02, log), 'b': clock.job('b', 0.03, log)}
    found = timing.measure(jobs, 0.5)
    assert log[:4] == ['a', 'a', 'b', 'b']
    assert log[4:] == ['a', 'b'] * 10  # 0.5 s of rounds of 0.05 s
    assert found['a'] == Timing(0.02, 0.0, 10)
    assert found['b'].median_s == 0.03


def test_a_short_job_runs_once_more_before_it_counts(clock):
    log = []
    found = timing.measure({'a': clock.job('a', 0.001, log), 'b': clock.job('b', 0.02, log)}, 0.001)
    assert log[4:7] == ['a', 'a', 'b']
    assert found['a'].runs == found['b'].runs == timing.FEWEST


def test_slow_jobs_warm_up_once_and_run_three_times(clock):
    log = []
    assert timing.measure({'a': clock.job('a', 1.5, log)}, 0.5)['a'].runs == 3
    assert len(log) == 4


@pytest.mark.parametrize(('round_s', 'rounds'), [(0.2, 7), (0.01, 50), (1e-7, 101), (1.01, 3), (0.0, 101)])
def test_rounds(round_s, rounds):
    assert timing.rounds_for(round_s, 0.5) == rounds


def test_a_timed_call_waits_for_the_device_before_and_after(clock):
    log = []
    call, wait = clock.job('call', 1.0, log), clock.job('wait', 0.25, log)
    assert timing.timed(call, wait)() == 1.25  # what was queued before the call does not count
    assert log == ['wait', 'call', 'wait']


# ------------------------------------------------ floors


@pytest.mark.parametrize(('xi', 'pairs'), [(1, 7), (3, 29), (7, 49)])
def test_pairs_in_the_band(xi, pairs):
    assert floors.Sizes(10, xi=xi).pairs == pairs


def test_the_larger_of_bytes_and_operations_counts_for_each_part():
    parts = [floors.Part(200, 1000), floors.Part(50, 3000), floors.Part(0, 4000, 'bfloat16')]
    assert floors.floor_seconds(parts, CEILINGS) == 2.0 + 3.0 + 1.0


def test_a_product_reads_the_map_once_and_multiplies_the_pairs_of_the_band():
    sizes = floors.Sizes(10, d=5, W=3, xi=1)
    assert floors.product(sizes, 'float32', 4) == floors.Part(4 * 3 * 10 * 5, 2 * 4 * 3 * 10 * 5, 'float32')
    assert floors.product(sizes, 'bfloat16') == floors.Part(2 * 3 * 10 * 5, 2 * 3 * 10 * 5, 'bfloat16')
    assert floors.product(sizes, 'float32', whole=True).operations == 2 * 9 * 10 * 5


@pytest.mark.parametrize('xi', [1, 2, 3])
def test_operations_of_the_recursions_are_those_of_their_cells(xi):
    sizes = floors.Sizes(10, W=3, l=4, k=6, xi=xi)

    def count(rows, columns, band, inner):
        cells = [(i, j) for i in range(rows) for j in range(columns) if abs(i - j) < band and i + j]
        return sum(inner if i and j else 2 for i, j in cells)

    assert floors.alignment(sizes, 5).operations == 5 * 10 * (count(3, 3, xi, 9) + 1)
    assert floors.sequence(sizes) == floors.Part(4 * 4 * 10, 10 * (count(4, 6, 99, 8) + 2 * 6))
    assert sizes.cells == 10 * 4 * 6


def test_a_frame_is_the_sum_of_its_stages():
    sizes = floors.Sizes(1000, xi=3)
    frame = floors.floor_seconds(floors.STAGES['online_frame'](sizes, 'bfloat16'), CEILINGS)
    stages = [floors.STAGES[name](sizes, 'bfloat16') for name in ('image_distances', 'lm_dtw', 'select')]
    assert frame == pytest.approx(sum(floors.floor_seconds(parts, CEILINGS) for parts in stages))
    assert frame < floors.floor_seconds(floors.STAGES['online_frame'](sizes, 'float32'), CEILINGS)


def test_the_best_of_two_measurements_of_the_ceilings():
    other = floors.Ceilings(90.0, {'float32': 1200.0, 'bfloat16': 10.0}, None)
    assert CEILINGS.best(other) == floors.Ceilings(100.0, {'float32': 1200.0, 'bfloat16': 4000.0}, None)
    assert CEILINGS.best(replace(other, read_one_core_bytes_per_s=81.0)).read_one_core_bytes_per_s == 81.0


def test_a_stage_that_shows_more_raises_the_ceilings():
    quick = CEILINGS.raised(floors.Part(2**28, 100, 'bfloat16'), 0.01, 'product')
    assert quick == replace(
        CEILINGS,
        read_bytes_per_s=2**28 / 0.01,
        operations_per_s={'float32': 1000.0, 'bfloat16': 10_000.0},
        sources={'read': 'product', 'bfloat16': 'product'},
    )
    assert CEILINGS.raised(floors.Part(2**28 - 1, 100, 'bfloat16'), 0.1, 'from a cache') == CEILINGS
    assert CEILINGS.raised(floors.Part(2**28, 1000), 2**28 / 99, 'slow') == CEILINGS


def test_no_precision_is_slower_than_float32():
    slow = replace(CEILINGS, operations_per_s={'float32': 1000.0, 'bfloat16': 4000.0, 'float16': 1.0})
    assert slow.widened().operations_per_s == {'float32': 1000.0, 'bfloat16': 4000.0, 'float16': 1000.0}
    assert slow.widened().sources == {'float16': 'float32'}
    raised = CEILINGS.raised(floors.Part(0, 5000), 1.0, 'product')
    assert raised.operations_per_s == {'float32': 5000.0, 'bfloat16': 5000.0}


def test_ceilings_are_the_best_run(clock):
    seconds = iter([9.0, 3.0, 2.0, 4.0, 5.0, 6.0])

    def call():
        clock.now += next(seconds)

    assert ceilings.best_seconds(call, 'cpu', 10.0) == 2.0  # the first one warms up; 3 + 2 + 4 + 5 fill 10 s
    assert next(seconds) == 6.0


@pytest.mark.parametrize('threads', [1, 2])
def test_the_reader_reads_everything(threads):
    x = np.arange(1024, dtype=np.float32)
    assert ceilings._reader(threads)(x) == x.sum()


def test_ceilings_of_this_machine_are_plausible():
    found = ceilings.measure_ceilings('cpu', 0.0, side=128, megabytes=8)
    assert 1e8 < found.read_one_core_bytes_per_s <= found.read_bytes_per_s < 1e13
    assert set(found.operations_per_s) == set(floors.ITEM_BYTES)
    assert all(1e7 < peak < 1e15 for peak in found.operations_per_s.values())


# ------------------------------------------------ records


def test_the_file_is_a_list_of_records_with_the_agreed_fields(tmp_path):
    made = [RECORD, replace(RECORD, peer='prange', peer_median_s=0.016, peer_spread_s=0.001)]
    made.append(Record('online_frame', 5, 512, 'float32', 'cpu', skipped='no memory'))
    about = {'machine': {'cpu': 'A CPU', 'cores': 2}, 'versions': {}, 'commit': 'abc', 'date': 'today'}
    path = tmp_path / 'new' / 'results.json'
    records.save(records.with_machine(made, about), path)
    plain, compared, skipped = json.loads(path.read_text())
    agreed = ('name', 'n', 'dim', 'dtype', 'device', 'median_s', 'spread_s', 'floor_s', 'ratio_to_floor')
    for fields in (plain, compared, skipped):
        assert set(agreed) <= set(fields)
        assert fields['machine']['cores'] == 2
        assert fields['commit'] == 'abc'
    assert plain['ratio_to_floor'] == 2.0
    assert not {'peer', 'speedup', 'skipped'} & set(plain)
    assert (compared['peer'], compared['peer_median_s'], compared['speedup']) == ('prange', 0.016, 8.0)
    assert (skipped['skipped'], skipped['median_s'], skipped['ratio_to_floor']) == ('no memory', None, None)
    assert records.load(path) == records.with_machine(made, about)


def test_records_refuse_what_would_be_lost_or_is_missing(tmp_path):
    with pytest.raises(ValueError, match=r"\['n'\] of lm_dtw are fields of every record"):
        replace(RECORD, extra={'n': 3}).to_json()
    with pytest.raises(ValueError, match=r"'x' lacks n, dim"):
        Record.from_json({'name': 'x', 'dtype': 'float32', 'device': 'cpu'})
    with pytest.raises(ValueError, match='not JSON compliant'):
        records.save([replace(RECORD, median_s=float('nan'))], tmp_path / 'results.json')


def test_every_record_knows_machine_versions_commit_and_date():
    about = records.machine('cpu')
    assert about['machine']['cores'] >= 1
    assert about['versions']['torch'] and about['versions']['stavpr_ros']  # noqa: PT018
    assert about['commit']
    assert about['date'][:2] == '20'
    assert records.machine('cpu', 'abc')['commit'] == 'abc'


def test_file_names_of_machines():
    assert records.slug({'cpu': 'AMD EPYC', 'cores': 2}) == 'amd-epyc-2-cores'
    assert records.slug({'cpu': 'x', 'cores': 2, 'gpu': 'NVIDIA H200'}) == 'nvidia-h200'


# ------------------------------------------------ one run


def test_a_stage_gives_a_record_and_one_for_each_peer(clock):
    log = []
    run = Run('cpu', 0.1)
    peers = [Peer('other', clock.job('other', 0.2, log), {'peer_note': 'as it is'})]
    sizes = floors.Sizes(10, d=0)
    run.measure(
        'lm_dtw', sizes, 'float32', clock.job('ours', 0.1, log), peers, rate=lambda s: 1 / s, data='random'
    )
    run.skip('online_frame', 10, 512, 'float32', 'too large')
    made = run.finished(CEILINGS)
    ceiling_names = [record.name for record in made[:-3]]
    assert 'ceiling_read_bandwidth' in ceiling_names
    assert 'ceiling_matrix_peak_bfloat16' in ceiling_names
    own, compared, skipped = made[-3:]
    assert (own.median_s, own.peer, own.runs) == (pytest.approx(0.1), None, 7)
    assert own.extra == {'rate': pytest.approx(10), 'data': 'random'}
    assert own.floor_s == floors.floor_seconds([floors.sequence(sizes)], CEILINGS)
    assert compared.speedup == pytest.approx(2.0)
    assert compared.extra['peer_note'] == 'as it is'
    assert (skipped.skipped, skipped.floor_s) == ('too large', None)


# ------------------------------------------------ marks and table

MARK = marks.Mark('fast', 'cpu', 'lm_dtw', 20_000, marks._speedup, 8, False, 'prange', 0)


@pytest.mark.parametrize(('seconds', 'reached'), [(0.016, True), (0.0159, False)])
def test_a_mark_is_reached_at_its_bound(seconds, reached):
    record = replace(RECORD, peer='prange', peer_median_s=seconds)
    (judged,) = marks.with_marks([record], [MARK])
    (mark,) = judged.marks
    assert mark == {'mark': 'fast', 'value': record.speedup, 'wanted': '>= 8', 'reached': reached}
    below = replace(MARK, at_most=True, value=marks._of_peer, wanted=0.125)
    assert below.judge(record)['reached'] is reached


@pytest.mark.parametrize(
    'change', [{'n': 2}, {'device': 'cuda'}, {'peer': 'librosa'}, {'dim': 512}, {'name': 'select'}]
)
def test_a_mark_is_decided_by_its_own_records_only(change):
    record = replace(RECORD, peer='prange', peer_median_s=1.0)
    assert MARK.decided_by(record)
    assert not MARK.decided_by(replace(record, **change))
    assert not MARK.decided_by(replace(record, peer_median_s=None))
    assert not replace(MARK, where={'data': ('walk',)}).decided_by(record)
    assert marks.undecided([replace(record, **change)], 'cpu', [MARK]) == ['fast']
    assert marks.undecided([record], 'cpu', [MARK]) == []
    assert marks.undecided([], 'cuda', [MARK]) == []


def test_the_marks_are_those_of_the_project():
    assert len({mark.text for mark in marks.MARKS}) == len(marks.MARKS)
    assert {text[:3] for text in (mark.text for mark in marks.MARKS)} == {
        '(a)',
        '(b)',
        '(c)',
        '(d)',
        '(e)',
        'GPU',
    }
    for mark in marks.MARKS:
        assert mark.name in floors.STAGES
        assert mark.n in matching.SIZES
        assert mark.dim in (0, *matching.DIMENSIONS)


@pytest.mark.parametrize(
    ('seconds', 'text'),
    [(2.5, '2.50 s'), (0.0123, '12.3 ms'), (0.0005, '500 µs'), (3e-7, '0.30 µs'), (None, '-')],
)
def test_durations_as_text(seconds, text):
    assert report.seconds_text(seconds) == text


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        (13.4e9, '1.34e+10'),
        (12_345.6, '12,346'),
        (45.67, '45.7'),
        (1.254, '1.25'),
        (0.0123, '0.0123'),
        (0, '0.00'),
    ],
)
def test_numbers_as_text(value, text):
    assert report.number_text(value) == text


def test_the_table_prints_losses_like_wins():
    about = {'machine': {'cpu': 'A CPU', 'cores': 2}, 'versions': {'torch': '2'}, 'commit': 'abc'}
    win = replace(RECORD, peer='prange', peer_median_s=0.020)
    loss = replace(RECORD, peer='librosa', peer_median_s=0.001, extra={'peer_note': 'one core'})
    part = Record('image_distances', 20_000, 512, 'float32', 'cpu', 0.02, 0.0, 7, 0.01, 'torch', 0.01, 0.0)
    part = replace(part, extra={'xi': 3, 'peer_part': True})
    made = [RECORD, win, loss, part, Record('online_frame', 9, 512, 'float32', 'cpu', skipped='no memory')]
    text = report.markdown(records.with_machine(marks.with_marks(made), about))
    lines = text.splitlines()
    assert 'Commit abc' in text
    assert '| 20,000 | float32 | random | 2.00 ms | 100 µs | 9 | 1.00 ms | 2.00 |' in lines
    assert 'Against others (1 of 2 lost):' in lines
    (lost,) = [line for line in lines if line.endswith('| loss |')]
    assert 'librosa' in lost
    assert '0.50' in lost
    assert '* librosa: one core' in lines
    assert 'Beside a part of the work:' in lines
    assert '| online_frame | 9 | 512 | float32 | no memory |' in text.replace('|  |', '|')
    assert (
        '| (a) LM-DTW, 20,000 starts: times the plain prange | float32, data = random '
        '| 10.0 | >= 8 | reached |' in lines
    )
    assert '| (a) LM-DTW, 20,000 starts: times librosa | float32 | 0.50 | >= 100 | **not reached** |' in lines
    assert '| (a) LM-DTW, 100,000 starts: times librosa |  | - |  | not measured |' in lines


# ------------------------------------------------ others

RUNNER = """
import json, sys
import numpy as np
print(json.dumps({'librosa': '9', 'tslearn': '9'}), flush=True)
for line in sys.stdin:
    asked = json.loads(line)
    window = np.load(asked['window'])
    ends = [float(window[:, s : s + asked['columns']].sum()) for s in asked['starts']]
    print(json.dumps({'seconds': len(ends) / 8, 'ends': ends}), flush=True)
"""


def test_the_peers_answer_for_the_starts_that_are_asked_for():
    window = np.arange(20, dtype=np.float32).reshape(2, 10)
    with peer_process.Peers([sys.executable, '-c', RUNNER]) as peers:
        assert peers.versions['librosa'] == '9'
        answer = peers.run('librosa', peers.put(window), [0, 4], 3)
    assert answer == {'seconds': 0.25, 'ends': [36.0, 60.0]}


def test_peers_that_do_not_start_are_missing():
    with pytest.raises(peer_process.PeersMissingError, match='status 3'):
        peer_process.Peers([sys.executable, '-c', 'raise SystemExit(3)'])


def test_an_environment_is_made_once(tmp_path, monkeypatch):
    commands = []

    class Done:
        returncode, stderr, stdout = 0, '', ''

    def fake(command, **_):
        commands.append(command)
        (tmp_path / 'bin').mkdir(exist_ok=True)
        (tmp_path / 'bin' / 'python3').touch()
        return Done

    monkeypatch.setattr(peer_process.subprocess, 'run', fake)
    assert peer_process.make_environment(tmp_path) == tmp_path / 'bin' / 'python3'
    assert [('venv' in command, 'install' in command) for command in commands] == [
        (True, False),
        (False, True),
    ]
    peer_process.make_environment(tmp_path)
    assert len(commands) == 2
    (tmp_path / 'requirements.sha256').write_text('of other requirements')
    Done.returncode, Done.stderr = 1, 'one\nno such package'
    with pytest.raises(peer_process.PeersMissingError, match='no such package'):
        peer_process.make_environment(tmp_path)
    assert (tmp_path / 'requirements.sha256').read_text() == 'of other requirements'
    assert len(commands) == 3  # nothing is installed where no environment could be made


def test_the_runner_times_the_alignments_alone(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location('peers_runner', BENCHMARKS / 'peers' / 'runner.py')
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    seen = []

    def align(costs):
        seen.append(costs.copy())
        return costs[-1, -1]

    monkeypatch.setattr(runner, 'aligner', lambda peer: align)
    window = np.arange(20, dtype=np.float32).reshape(2, 10)
    np.save(tmp_path / 'w.npy', window)
    asked = {'peer': 'librosa', 'window': str(tmp_path / 'w.npy'), 'starts': [1, 7], 'columns': 3}
    answer = runner.run(asked)
    assert answer['ends'] == [13.0, 19.0]
    assert answer['seconds'] >= 0
    np.testing.assert_array_equal(seen[0], window[:, 1:4])
    monkeypatch.undo()
    with pytest.raises(ValueError, match="'other' is unknown: take one of librosa, tslearn"):
        runner.aligner('other')


@pytest.mark.parametrize('kind', ['random', 'walk'])
@pytest.mark.parametrize('n', [1, 7, 30])
def test_the_plain_prange_gives_the_oracles_answers(kind, n):
    window = data.make_window(kind, 5, n, seed=1)
    if kind == 'random':  # few values that add up exactly: ties everywhere
        window = np.random.default_rng(n).integers(0, 3, (5, n)).astype(np.float32)
    q, m = oracle.match_sequence(window, 2, np.float32)
    distances, lengths = np.empty(n, np.float32), np.empty(n, np.int32)
    baselines.prange()(window, 10, distances, lengths)
    np.testing.assert_array_equal(distances, q)
    np.testing.assert_array_equal(lengths, m)


def test_peers_that_do_a_sample_are_scaled_to_all_starts(monkeypatch):
    window = data.make_window('random', 20, 100, 0)

    class Fake:
        versions = {'librosa': '9', 'tslearn': '8'}  # noqa: RUF012

        def put(self, window):
            return Path('window.npy')

        def run(self, peer, path, starts, k):
            costs = [oracle.accumulate(window[:, s : s + k], 1, np.float64).S[-1][-1] for s in starts[:3]]
            return {'seconds': 0.5 * len(starts), 'ends': costs}

    plan = stages.Plan(('float32',), 7, SequenceSettings(), 1e9, 0)
    ours = match_sequence(window, plan.sequence)
    found = {peer.name: peer for peer in stages.sequence_peers(plan, window, ours, Fake())}
    assert found['librosa'].extra['peer_sample'] == 61  # all starts with 40 columns
    assert found['tslearn'].extra['peer_sample'] == stages.TSLEARN_STARTS
    assert found['librosa'].job() == found['tslearn'].job() == pytest.approx(50.0)  # half a second a start
    monkeypatch.setattr(stages, 'timed', lambda call: lambda: 3.0)
    loops, count = stages._oracle_job(window, plan, ours)
    assert loops() == pytest.approx(3.0 * 100 / count)
    wrong = SequenceDistances(ours.distances, ours.lengths + 1)
    with pytest.raises(AssertionError):
        stages.sequence_peers(plan, window, wrong, Fake())
    with pytest.raises(AssertionError, match='librosa, start 0'):
        stages._process_job(Fake(), 'librosa', window + 1, [0], 40)


def test_a_stage_may_raise_a_ceiling(clock):
    run = Run('cpu', 0.1)
    sizes = floors.Sizes(1000, d=16)
    run.measure('distance_matrix', sizes, 'float32', clock.job('ours', 0.1, []), dim=16)
    run.measure('lm_dtw', sizes, 'float32', clock.job('ours', 1e-9, []), dim=0)
    made = {record.name: record for record in run.finished(replace(CEILINGS, read_bytes_per_s=1e12))}
    peak = made['ceiling_matrix_peak_float32'].extra
    operations = sum(part.operations for part in floors.STAGES['distance_matrix'](sizes, 'float32'))
    assert operations > 2 * 20 * 49 * 1000 * 16  # the alignment's are among them
    assert peak['operations_per_s'] == pytest.approx(operations / 0.1)
    assert peak['source'] == 'distance_matrix, n = 1,000'
    assert made['distance_matrix'].ratio_to_floor == pytest.approx(1.0)


def test_samples_are_spread_over_starts_with_whole_windows():
    assert baselines.sample(1000, 40, 4) == [0, 320, 640, 960]
    assert baselines.sample(42, 40, 500) == [0, 1, 2]
    assert baselines.sample(5, 40, 3) == [0]


def test_made_up_features_have_unit_norm_and_a_seed(monkeypatch):
    monkeypatch.setattr(data, 'BLOCK_BYTES', 4 * 16 * 5)  # pieces that do not divide the rows
    features, again = (data.make_features(9, 16, 7, 'cpu', 3).strips.numpy() for _ in range(2))
    assert features.shape == (7, 9, 16)
    np.testing.assert_allclose(np.linalg.norm(features, axis=2), 1, rtol=1e-5)
    np.testing.assert_array_equal(features, again)
    rows = features.reshape(63, 16)
    assert all(abs(float(a @ b)) < 0.99 for a, b in pairwise(rows))
    assert not np.array_equal(features, data.make_features(9, 16, 7, 'cpu', 4).strips.numpy())


def test_made_up_windows_are_distances():
    for kind in ('random', 'walk'):
        window = data.make_window(kind, 20, 300, 0)
        assert (window.shape, window.dtype) == ((20, 300), np.float32)
        assert 0 < window.min() <= window.max() <= 1
        np.testing.assert_array_equal(window, data.make_window(kind, 20, 300, 0))
    slow = np.abs(np.diff(data.make_window('walk', 20, 300, 0))[:, :100]).max()
    assert slow < 0.05
    with pytest.raises(ValueError, match='take random or walk'):
        data.make_window('other', 20, 300, 0)


# ------------------------------------------------ the command


@pytest.mark.parametrize('slow', ['wide', 'tall'])
def test_the_bare_product_is_that_of_the_faster_orientation(slow, monkeypatch):
    rows, references = torch.randn(3, 4), torch.randn(2, 5, 4)
    expected = rows @ references.reshape(10, 4).T
    original = torch.mm
    made = []

    def mm(left, right, out):
        if (len(left) == 3) == (slow == 'wide'):
            time.sleep(0.005)
        made.append(out)
        return original(left, right, out=out)

    monkeypatch.setattr(torch, 'mm', mm)
    call, form = subjects.bare_product(rows, references, timing.nothing)
    call()
    if slow == 'wide':
        assert form == 'torch.mm, map @ queries.T'
        np.testing.assert_allclose(made[-1], expected.T, rtol=1e-5)
    else:
        assert form == 'torch.mm, queries @ map.T'
        np.testing.assert_allclose(made[-1], expected, rtol=1e-5)


def test_quick_keeps_to_small_sizes():
    quick = matching.parse(['--quick'])
    assert list(quick.sizes) == [1_000, 2_000, 20_000]
    assert matching.cases_of(quick)[2:] == [(20_000, 512), (1_000, 10_416), (2_000, 10_416)]
    assert matching.cases_of(matching.parse([]))[4:] == [
        (1_000_000, 512),
        *((n, 10_416) for n in quick.sizes),
    ]
    assert list(matching.parse([]).sizes) == [1_000, 2_000, 20_000, 100_000, 1_000_000]
    assert matching.parse(['--memory', '3']).memory == 3e9
    assert matching.parse(['--device', 'cuda']).memory > 1e12


def test_the_whole_command(tmp_path, monkeypatch):
    announced = []

    class Announced(Run):
        def __init__(self, device, seconds, steps):
            super().__init__(device, seconds)
            announced.append(steps)

        def measure(self, *arguments, **named):
            announced.append('measured')
            return super().measure(*arguments, **named)

    monkeypatch.setattr(ceilings, 'measure_ceilings', lambda *_: FULL)
    monkeypatch.setattr('run.Run', Announced)
    given = [
        '--sizes',
        '50',
        '--dimensions',
        '16',
        '--seconds',
        '0.001',
        '--no-peers',
        '--commit',
        'abc',
    ]
    assert matching.main([*given, '--output', str(tmp_path)]) == 0
    (path,) = tmp_path.glob('matching-*.json')
    made = records.load(path)
    assert announced[0] == announced.count('measured')
    assert {record.name for record in made if record.median_s} == set(floors.STAGES)
    assert all(record.extra['commit'] == 'abc' for record in made)
    assert all(record.floor_s and record.spread_s is not None for record in made if record.median_s)
    assert {record.peer for record in made if record.name == 'lm_dtw'} >= {
        None,
        'prange',
        'oracle',
        'librosa',
    }
    assert {record.skipped for record in made if record.peer == 'librosa'} == {'left out: --no-peers'}
    errors = {
        dtype: max(record.extra.get('largest_error', 0) for record in made if record.dtype == dtype)
        for dtype in PRECISIONS
    }
    assert 0 < errors['float32'] < 1e-5 < errors[PRECISIONS[1]] < 1e-2
    assert path.with_suffix('.md').read_text() == report.markdown(made)


@pytest.mark.skipif(torch.cuda.is_available(), reason='there is a CUDA device')
def test_a_device_that_is_not_there_is_refused_in_words(tmp_path, capsys):
    assert matching.main(['--device', 'cuda', '--output', str(tmp_path)]) == 2
    assert 'torch sees no CUDA device here' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_what_does_not_fit_is_skipped_with_a_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(ceilings, 'measure_ceilings', lambda *_: FULL)
    given = ['--sizes', '50', '--dimensions', '16', '--seconds', '0.001', '--no-peers', '--memory', '1e-6']
    matching.main([*given, '--output', str(tmp_path)])
    (path,) = tmp_path.glob('*.json')
    (reason,) = {record.skipped for record in records.load(path) if record.name == 'online_frame'}
    assert reason == 'needs 0.0 GB, 0.0 GB may be used'
    assert '| online_frame |' in path.with_suffix('.md').read_text()
