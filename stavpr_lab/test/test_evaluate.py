# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command evaluate on traverses and descriptors: numbers, exports, the page of its report."""

import csv
from dataclasses import replace
from glob import glob
import json
import os
import re
import shutil
import subprocess

import cv2
from evaluation_commands import read_json, write_images
from fixtures import route_images
import numpy as np
import pytest
from scores import best_f1
from stavpr_lab.commands import build_descriptor_map, demo, evaluate
from stavpr_lab.demonstration import live
from stavpr_lab.evaluation.evaluate import recognize_all
from stavpr_lab.evaluation.metrics import image_matches
from stavpr_lab.features.descriptors import read_descriptors
from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, load_map, Map, merge_maps, save_map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.sources import open_source

PLACES = 60
KINDS = ('sequence', 'sequence_without_ends', 'single', 'single_without_ends')


@pytest.fixture(scope='module')
def folders(tmp_path_factory):
    """Write images: a map, a darker query with noise, one shifted, one of other places."""
    folder, rng = tmp_path_factory.mktemp('folders'), np.random.default_rng(1)
    first = route_images(PLACES)
    second = [np.clip(0.6 * image + rng.normal(0, 12, image.shape), 0, 255) for image in first]
    second = [image.astype(np.uint8) for image in second]
    write_images(folder / 'map', first)
    write_images(folder / 'query', second)
    write_images(folder / 'shifted', [np.roll(image, 26, axis=1) for image in second])
    write_images(folder / 'elsewhere', route_images(40, seed=5))
    return folder


@pytest.fixture
def run(runner):
    return runner(evaluate)


@pytest.fixture
def numbers(run, tmp_path):
    """Run the command with options and return its JSON."""

    def call(*arguments):
        path = tmp_path / 'out.json'
        code, _, errors = run(*arguments, '--json', path, '--force')
        assert code == 0, errors
        return read_json(path.read_text())

    return call


def pair(folders):
    options = ['--truth', 'identity', '--features', 'gradient']
    return ['--map', folders / 'map', '--query', folders / 'query', *options]


def page_data(page):
    return read_json(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))


def test_evaluate_compares_odometry_with_the_map_poses(folders, numbers, tmp_path):
    """The map turns left at place 30; the query does, too, or turns right."""
    paths = {}
    for name, side in (('left', 1), ('right', -1)):
        steps = np.array([[1, 0]] * 30 + [[0, side]] * (PLACES - 30))
        paths[name] = tmp_path / f'{name}.csv'
        np.savetxt(
            paths[name], np.column_stack([np.cumsum(steps, 0), np.zeros(PLACES)]), '%g', ','
        )
    options = [*pair(folders), '--map-poses', paths['left']]
    plain = numbers(*pair(folders))['decision']
    same = numbers(*options, '--odometry', paths['left'])
    assert same['decision'] == plain
    assert same['settings']['odometry'] == str(paths['left'])
    other = numbers(*options, '--odometry', paths['right'])['decision']
    assert other['matched'] < plain['matched'] - 15


def test_truth_of_one_session_counts_matches_of_every_session(folders, numbers, tmp_path):
    extractor = FeatureExtractor('gradient')
    maps = [build_map(open_source(folders / name), extractor) for name in ('map', 'shifted')]
    same = np.tile(np.arange(PLACES, dtype=np.int32), 2)
    save_map(replace(merge_maps(maps, 'ab'), same_as=same), tmp_path / 'both.stavpr')
    (tmp_path / 'pairs.csv').write_text(''.join(f'{i},{i}\n' for i in range(0, PLACES, 5)))
    options = '--query', folders / 'shifted', '--truth', tmp_path / 'pairs.csv', '--tolerance', 2
    decision = numbers('--map', tmp_path / 'both.stavpr', *options)['decision']
    assert (decision['matched_with_truth'], decision['wrongly_matched']) == (12, 0)


def test_commands_divide_two_laps_into_sessions(run, runner, tmp_path, monkeypatch):
    """Of images and descriptors; the same image of both drives is of one position."""
    images = write_images(tmp_path / 'laps', 2 * route_images(95))
    vectors, saved = tmp_path / 'laps.npy', tmp_path / 'laps.stavpr'
    np.save(vectors, np.tile(np.random.default_rng(0).normal(size=(95, 24)), (2, 1)))
    source = ['--descriptors-source', 'netvlad']
    for path, options in ((images, ['--features', 'gradient']), (vectors, source)):
        pair = '--map', path, '--query', path, '--truth', 'identity', *options
        code, _, errors = run(*pair, '--json', tmp_path / 'a.json', '--force')
        assert (code, '2 laps became a session each' in errors) == (0, True), errors
        decision = json.loads((tmp_path / 'a.json').read_text())['decision']
        assert decision['matched'] > 150 > decision['wrongly_matched'] == 0
    assert runner(build_descriptor_map)('--input', vectors, '--output', saved, *source)[0] == 0
    monkeypatch.setattr(live, 'run_live', None)  # it comes after the map
    with pytest.raises(TypeError):
        runner(demo)('--map', images, '--query', images, '--output', tmp_path / 'demo')
    maps = load_map(saved), load_map(tmp_path / 'demo' / 'map.stavpr'), Map.from_images(images)
    assert [len(place_map.sessions) for place_map in maps] == [2, 2, 2]


def test_evaluate_of_two_folders_writes_numbers_and_settings(folders, numbers):
    result = numbers(*pair(folders), '--mode', 'paper', '--tolerance', 1)
    assert all(result[kind]['average_precision'] > 0.9 for kind in KINDS)
    assert result['sequence']['queries'] == PLACES
    assert result['sequence_without_ends']['queries'] == PLACES - 19
    expected = {'mode': 'paper', 'tolerance': 1, 'strategy': 'adaptive', 'exclude_places': None}
    assert expected.items() <= result['settings'].items()
    assert 'gradient' in result['settings']['features']
    assert result['times']['total_s'] > 0
    assert result['calibration'] is None  # mode paper declares no probabilities
    assert not {'false_alarm_rate', 'default_threshold'} & result.keys()


@pytest.mark.parametrize(
    ('options', 'spatial'),
    [(['--xi', 1], SpatialSettings(xi=1)), (['--strategy', 'none'], SpatialSettings('none'))],
)
def test_evaluate_numbers_are_those_of_the_recognizer(folders, numbers, options, spatial):
    """Every image through the recognizer, windows assigned to their middles, best F1."""
    options = [*options, '--mode', 'paper', '--warp', '2x', '--tolerance', 2]
    options += ['--sequence-length', 8, '--beta', 1.5]
    result = numbers(*pair(folders), '--query', folders / 'shifted', *options)
    extractor = FeatureExtractor('gradient')
    place_map = build_map(open_source(folders / 'map'), extractor, progress=False)
    query = build_map(open_source(folders / 'shifted'), extractor, progress=False).features[::2]
    sequence = SequenceSettings(8, 1.5)
    settings = RecognizerSettings(1.0, spatial=spatial, sequence=sequence, mode='paper')
    recognizer = PlaceRecognizer(place_map, settings)
    matches, true = image_matches(recognize_all(recognizer, query), 8), np.arange(0, PLACES, 2)
    correct = np.abs(matches.places - true) <= 2
    best = best_f1(matches.distances, correct)
    assert result['sequence']['f1'] == best.f1
    assert result['sequence']['threshold'] == pytest.approx(best.threshold, abs=1e-6)
    assert result['sequence']['recall_at_1'] == np.mean(correct)
    distances = recognizer.distances(query)
    single = best_f1(distances.min(axis=1), np.abs(distances.argmin(axis=1) - true) <= 2)
    assert result['single']['f1'] == single.f1
    ends = slice(3, PLACES // 2 - 4)
    inner = best_f1(matches.distances[ends], correct[ends])
    assert result['sequence_without_ends']['f1'] == inner.f1


def test_evaluate_with_unknown_images_counts_false_alarms(folders, numbers):
    """The query as unknown images is accepted as often as the query; other places are not."""
    options = [*pair(folders), '--mode', 'paper', '--unknown']
    same = numbers(*options, folders / 'query')
    for kind in ('sequence', 'single'):
        accepted = same[kind]['true_positives'] + same[kind]['false_positives']
        assert same[kind]['false_alarm_rate'] == accepted / PLACES
    assert same['false_alarm_rate'] == same['sequence']['false_alarm_rate'] > 0.9
    other = numbers(*options, folders / 'elsewhere')
    assert other['unknown_images'] == 40
    assert other['false_alarm_rate'] < 0.2
    assert other['sequence']['f1'] == same['sequence']['f1']


def test_evaluate_with_crop_equals_images_cropped_before(folders, numbers, tmp_path):
    def crop(name, columns):
        images = [cv2.imread(str(file))[:, :, ::-1] for file in sorted((folders / name).iterdir())]
        return write_images(tmp_path / name, [image[:, columns] for image in images])

    first, second = crop('map', slice(128 - 38)), crop('query', slice(13, None))
    result = numbers(*pair(folders), '--crop-map', 0.3, '--crop-query', 0.1)['sequence']
    assert result == numbers(*pair(folders), '--map', first, '--query', second)['sequence']


def test_evaluate_with_saved_maps_equals_folders(folders, tmp_path, numbers, run):
    extractor = FeatureExtractor('gradient', projection=32)
    for name in ('map', 'query'):
        place_map = build_map(open_source(folders / name), extractor, progress=False)
        save_map(place_map, tmp_path / f'{name}.stavpr')
    saved, query, options = tmp_path / 'map.stavpr', folders / 'query', ['--tolerance', 0]
    of_folders = numbers(*pair(folders), '--projection', 32, *options)
    mixed = numbers(*pair(folders), '--map', saved, *options)
    both = numbers(*pair(folders), '--map', saved, '--query', tmp_path / 'query.stavpr', *options)
    assert of_folders['sequence'] == mixed['sequence'] == both['sequence']
    for wrong, word in (
        (['--features', 'onnx'], 'was made with gradient'),
        (['--strips', 5], 'was made with 7'),
        (['--seed', 0], '--seed'),
        (['--gradient-cell', 32], '--gradient-cell'),
        (['--crop-map', 0.3], '--crop-map'),
    ):
        run.fails(2, word, '--map', saved, '--query', query, *wrong)


def test_evaluate_with_a_dataset_finds_map_query_and_tolerance(tmp_path, numbers, run):
    images = route_images(24)
    for name in ('summer', 'winter'):
        write_images(tmp_path / 'nordland' / name, images)
    result = numbers('--dataset', f'nordland={tmp_path}')
    assert (result['settings']['tolerance'], result['sequence']['f1']) == (3, 1)
    source, saved = open_source(tmp_path / 'nordland' / 'winter'), tmp_path / 'unknown.stavpr'
    save_map(build_map(source, FeatureExtractor('gradient', projection=32), progress=False), saved)
    options = ['--dataset', f'nordland={tmp_path}', '--features', 'gradient']
    options += ['--projection', 32, '--unknown', saved]
    assert numbers(*options)['unknown_images'] == 24
    run.fails(1, 'those of the first sequence', *options, '--seed', 1)


def test_evaluate_with_a_ground_truth_file_has_tolerance_zero(folders, numbers, tmp_path):
    pairs = tmp_path / 'pairs.csv'
    pairs.write_text('query,place\n' + ''.join(f'{i},{i + 2}\n' for i in range(PLACES - 2)))
    options = [*pair(folders), '--truth', pairs]
    exact = numbers(*options)['single']
    assert (exact['recall_at_1'], exact['queries_with_match']) == (0, PLACES - 2)
    result = numbers(*options, '--tolerance', 2)
    assert result['single']['recall_at_1'] == 1
    decision = result['decision']  # the last two images are named by no pair: nothing is wrong
    assert (decision['images_with_truth'], decision['wrongly_matched']) == (PLACES - 2, 0)
    assert decision['matched_with_truth'] < decision['matched'] <= decision['images'] == PLACES


def test_evaluate_with_poses_accepts_near_places(folders, numbers, run, tmp_path):
    for name, offset in (('query', 2.2), ('map', 0)):
        lines = [f'{i + offset},0,0\n' for i in range(PLACES)]
        (tmp_path / f'{name}.csv').write_text(''.join(lines))
    options = [*pair(folders), '--truth', 'poses', '--query-poses', tmp_path / 'query.csv']
    both = [*options, '--map-poses', tmp_path / 'map.csv']
    assert numbers(*both, '--meters', 2.3)['single']['recall_at_1'] == 1
    assert numbers(*both, '--meters', 1)['single']['recall_at_1'] == 0
    (tmp_path / 'short.csv').write_text('0,0,0\n')
    for wrong, code, word in (
        (options, 2, 'the map has no poses: give --map-poses'),
        ([*both, '--degrees', 9], 1, 'no orientations'),
        ([*options, '--map-poses', tmp_path / 'short.csv'], 1, '1 poses for 60 images'),
        ([*pair(folders), '--odometry', tmp_path / 'short.csv'], 1, '1 poses for 60 images'),
    ):
        run.fails(code, word, *wrong)


def test_evaluate_with_loop_closure_matches_the_second_lap(tmp_path, numbers):
    lap = route_images(40)
    query = write_images(tmp_path / 'query', [*lap, *lap])
    truth = np.zeros((80, 80), np.uint8)
    truth[np.arange(40, 80), np.arange(40)] = 255
    cv2.imwrite(str(tmp_path / 'truth.png'), truth)
    options = ['--query', query, '--truth', tmp_path / 'truth.png', '--loop-closure']
    options += ['--mode', 'paper']
    result = numbers(*options, '--tolerance', 1, '--exclude-places', 25)
    assert result['sequence']['queries_with_match'] == 40
    assert result['single']['recall_at_1'] == 1
    assert result['sequence']['f1'] > 0.7
    # map and ground truth end at the same image
    assert numbers(*options, '--exclude-places', 40)['single']['recall_at_1'] > 0.8
    beyond = numbers(*options, '--exclude-places', 41)['single']
    assert (beyond['queries_with_match'], beyond['recall_at_1'], beyond['f1']) == (0, None, 0)
    assert numbers(*options)['settings']['exclude_places'] == 50


@pytest.fixture
def report(run, tmp_path):
    """Run the command with options; return its JSON, the rows of its matches, its text."""

    def call(*arguments):
        folder = tmp_path / 'report'
        code, text, errors = run(*arguments, '--output', folder, '--force')
        assert code == 0, errors
        with (folder / 'answers.csv').open() as file:
            rows = list(csv.DictReader(file))
        return read_json((folder / 'results.json').read_text()), rows, text

    return call


@pytest.mark.parametrize('mode', ['robust', 'paper'])
def test_evaluate_with_places_removed_counts_unseen_images(folders, report, tmp_path, mode):
    """Without places 20 .. 39, images 25 .. 34 are more than five places from the map."""
    options = ['--mode', mode, '--remove-from-map', '20:40', '--remove-from-map', '50:53']
    result, rows, text = report(*pair(folders), *options, '--tolerance', 0)
    assert (result['places'], result['images']) == (PLACES - 23, PLACES)
    assert result['sequence']['queries_with_match'] == PLACES - 23
    assert [int(row['true_place']) for row in rows[:60:10]] == [0, 10, -1, -1, 20, -1]
    accepted = [int(row['accepted']) for row in rows]
    matched = sum(accepted[25:35])
    assert result['unseen'] == [
        {'first': 20, 'last': 40, 'images': 10, 'matched': matched},
        {'first': 50, 'last': 53, 'images': 0, 'matched': 0},
    ]
    assert f'20 .. 39: {matched} of 10 unseen images matched' in text
    right = [int(row['sequence_right']) for row in rows]
    wrong = sum(a and not r for a, r in zip(accepted, right, strict=True))
    decision, threshold = result['decision'], result['sequence']['threshold']
    assert (decision['matched'], decision['wrongly_matched']) == (sum(accepted), wrong)
    assert decision['rule'] == ('default' if mode == 'robust' else 'best F1')
    rate, (low, high) = decision['error_rate'], decision['error_rate_interval']
    assert (rate, low <= rate <= high) == (wrong / sum(accepted), True)
    least, most = decision['recall_interval']
    assert least <= decision['recall'] <= most
    assert least < most or decision['recall'] == 1  # no image is missing in any sample
    interval = f'error rate {rate:.3f} ({low:.3f}-{high:.3f}), recall {decision["recall"]:.3f}'
    assert f'{interval} ({least:.3f}-{most:.3f}), with 95 % intervals' in text
    page = (tmp_path / 'report' / 'report.html').read_text(encoding='utf-8')
    assert f'error rate {rate:.3f} ({low:.3f}-{high:.3f})' in page
    limit = 0.5 if mode == 'robust' else threshold
    assert accepted == [int(float(row['sequence_distance']) < limit) for row in rows]


def test_evaluate_combines_drive_options(folders, report):
    """Reversed at double speed with a stop: the removed places are unseen, the others found."""
    options = ['--speed', 2, '--stop', '30:12', '--reverse', '--remove-from-map', '20:40']
    result, rows, _ = report(*pair(folders), *options, '--mode', 'paper', '--tolerance', 0)
    images = [*range(0, 30, 2), *[30] * 13, *range(32, PLACES, 2)][::-1]
    assert [int(row['recorded_image']) for row in rows] == images
    assert rows[0]['identifier'] == '058.png'
    number = {place: i for i, place in enumerate([*range(20), *range(40, PLACES)])}
    assert [int(row['true_place']) for row in rows] == [number.get(i, -1) for i in images]
    assert [stretch['images'] for stretch in result['unseen']] == [13 + len((26, 28, 32, 34))]
    assert result['single']['recall_at_1'] == 1
    assert result['settings']['remove_from_map'] == [[20, 40]]


def test_evaluate_shows_the_calibration_of_declared_probabilities(folders, report, tmp_path):
    result, rows, text = report(*pair(folders))
    calibration = result['calibration']
    declared = sum(row['probability'] != 'nan' for row in rows)
    early = result['decision']['early_matched']
    assert calibration['images'] == declared + early > declared
    assert result['decision']['early_with_truth'] == early
    # a node has the first match with the early ones, and none for the end of the last window
    online, matched = (result['decision'][name] for name in ('online_matched', 'matched'))
    assert early < online < matched == len(rows)
    assert 0 < (first := result['decision']['first_matched']) < early
    assert f'in a node: {online} of {len(rows)} images, the first is image {first}\n' in text
    shown = f'full: {early} of the online matches; 0 of the {early} with ground truth are wrong'
    assert shown in text
    error = calibration['expected_calibration_error']
    assert f'expected calibration error {error:.4f}' in text
    page = (tmp_path / 'report' / 'report.html').read_text(encoding='utf-8')
    assert f'Expected calibration error {error:.4f}' in page
    assert cv2.imread(str(tmp_path / 'report' / 'calibration.png')).std() > 5


def test_report_holds_numbers_matches_plots_and_page(folders, run, tmp_path):
    folder = tmp_path / 'report'
    options = ['--output', folder, '--window', 30, '--unknown', folders / 'elsewhere']
    code, text, errors = run(*pair(folders), *options)
    assert code == 0, errors
    assert 'false alarm rate' in text
    plots = {'precision_recall', 'distances', 'similarity_matrix', 'drive', 'window_30'}
    assert plots <= {file.stem for file in folder.glob('*.png')}
    with (folder / 'answers.csv').open() as file:
        rows = list(csv.DictReader(file))
    right = [int(row['sequence_right']) for row in rows]
    assert right == [int(abs(int(row['sequence_place']) - i) <= 3) for i, row in enumerate(rows)]
    with (folder / 'curves.csv').open() as file:
        assert {row['answers'] for row in csv.DictReader(file)} == set(KINDS)

    page = (folder / 'report.html').read_text(encoding='utf-8')
    assert {address[:5] for address in re.findall(r'(?:src|href)="([^"]*)', page)} == {'data:'}
    assert 'http' not in page  # nothing is loaded from elsewhere
    data = page_data(page)
    assert [view['image'] for view in data['views']] == list(range(9, PLACES - 10))
    view = data['views'][21]
    assert (view['place'], view['right']) == (int(rows[30]['sequence_place']), bool(right[30]))
    assert [0, 18, 24] in view['truth']  # image 21 ± 3, the first of the window
    assert data['queries']['30'].startswith('data:image/jpeg')
    left, top, width, height = data['box']
    assert 0 < left < left + width < 1
    assert 0 < top < top + height < 1
    shown = next(row for row in data['pairs'] if row['right'])
    assert shown['recorded'] == [shown['image'], shown['place']]
    assert data['places'][str(shown['place'])].startswith('data:image/jpeg')
    results = read_json((folder / 'results.json').read_text())
    assert f'<td>{results["sequence"]["f1"]:.4f}</td>' in page
    assert results['default_threshold']['f1'] <= results['sequence']['f1']


def test_report_of_names_with_markup_escapes_them(tmp_path, run):
    images = route_images(24)
    first = write_images(tmp_path / '<b>map', images)
    query = write_images(tmp_path / 'a&b{{ 7 * 6 }}', images)
    # file names may be no valid text
    (query / '000.png').rename(query / os.fsdecode(b'000\xe9.png'))
    query = query.rename(tmp_path / os.fsdecode(b'a&b{{ 7 * 6 }}\xe9'))
    code, _, errors = run('--map', first, '--query', query, '--output', tmp_path / 'out')
    assert code == 0, errors
    page = (tmp_path / 'out' / 'report.html').read_text(encoding='utf-8')
    assert '&lt;b&gt;map' in page
    assert '<b>map' not in page
    assert 'a&amp;b{{ 7 * 6 }}' in page
    assert len(page_data(page)['views']) == 5  # windows of 20 in 24 images


LOOP, PAIR = '--query x --loop-closure --truth y', '--map x --query y'


@pytest.mark.parametrize(
    ('options', 'code', 'word'),
    [
        ('', 2, '--query is required'),
        ('--dataset nordland', 2, 'NAME=FOLDER'),
        ('--dataset a=b --odometry x.csv', 2, 'give --map and --query'),
        ('--dataset ua=x --map y', 2, 'leave'),
        ('--map /missing --query /missing', 1, '/missing'),
        (f'{PAIR} --mode paper', 2, 'need --truth'),
        (f'{PAIR} --tolerance 3', 2, 'need --truth identity'),
        (f'{PAIR} --tolerence 3', 2, 'did you mean --tolerance?'),
        (f'{LOOP} --warp 2x', 2, '--speed needs a --map'),
        ('--query x --loop-closure --truth poses --map-poses y', 2, '--map-poses'),
        (f'{PAIR} --remove-from-map 3-4', 2, "'3-4': expected two whole"),
        (f'{PAIR} --exclude-places 9', 2, 'goes with --loop-closure'),
        (f'{PAIR} --map-poses z', 2, '--truth poses'),
        (f'{PAIR} c --window 3', 2, '--window goes with one --query'),
        (f'{PAIR} --json /missing/x.json', 1, 'does not exist'),
        (f'{PAIR} --output {__file__}', 1, 'takes a folder'),
    ],
)
def test_evaluate_with_invalid_options_fails_before_the_work(run, options, code, word):
    run.fails(code, word, *options.split())


def test_evaluate_of_inputs_that_do_not_fit_fails(folders, run, tmp_path):
    folder = tmp_path / 'none'
    for options, code, word in (
        (['--query', folders / 'elsewhere'], 1, '40 query images and 60 places'),
        (['--remove-from-map', '50:61'], 2, 'FIRST < LAST <= 60'),
        (['--speed', 'fast'], 2, "drive 'fast' is unknown"),
        (['--speed', 4], 1, 'at least l = 20'),
        (['--window', 3, '--output', folder], 2, '9 .. 49'),
    ):
        run.fails(code, word, *pair(folders), *options)
    assert not folder.exists()


def test_evaluate_without_truth_reports_matches_of_unequal_traverses(folders, run, tmp_path):
    paths = ['--map', folders / 'map', '--query', folders / 'elsewhere']
    code, output, errors = run(*paths, '--output', tmp_path / 'report')
    assert code == 0, errors
    assert output.splitlines()[0] == 'elsewhere on the map map, no ground truth'
    assert 'matched, default: ' in output
    result = read_json((tmp_path / 'report' / 'results.json').read_text())
    counts = {'matched', 'early_matched', 'online_matched', 'first_matched'}
    assert result['decision'].keys() == {'rule', 'images', *counts}
    assert not {*KINDS, 'calibration', 'unseen', 'recommended_threshold'} & result.keys()
    with (tmp_path / 'report' / 'answers.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 40
    assert {rows[0][name] for name in ('true_place', 'sequence_right', 'in_map')} == {''}
    assert sum(int(row['accepted']) for row in rows) == result['decision']['matched']
    page = (tmp_path / 'report' / 'report.html').read_text()
    assert 'no ground truth</h1>' in page
    assert not re.search('the ground truth</h2>|All numbers|Yellow is', page)
    assert 'verdict other">Not recognized: ' in page
    assert 'This looks like another route.\n  Compare the images' in output
    views = page_data(page)['views']
    assert {view['right'] for view in views} == {None}
    assert all(0 <= view['amount'] <= 1 for view in views)


def test_evaluate_of_loop_closures_in_the_hallway_gives_the_measured_recall(data_folder, numbers):
    folder = data_folder / 'rtabmap_hallway_loop'
    options = ['--loop-closure', '--exclude-places', 20, '--sequence-length', 10]
    options += ['--query', folder / 'samples', '--truth', folder / 'samples_GT.bmp']
    result = numbers(*options)
    assert result['sequence']['recall_at_1'] > 0.8
    assert result['default_threshold']['threshold'] == 0.5  # 1 - min_probability
    assert result['decision']['precision'] == result['default_threshold']['precision'] == 1
    late = numbers(*options, '--late-closures')
    assert late['decision']['precision'] == 1
    assert late['decision']['recall'] > result['decision']['recall']


def test_reports_and_numbers_are_replaced_only_by_force(run, folders, tmp_path):
    """Refused before the work begins; files of other kinds are never replaced."""
    out, folder = tmp_path / 'out.json', tmp_path / 'report'
    folder.mkdir()
    (folder / 'report.html').write_text('<!doctype html>\n')
    out.write_text('{}')
    for option, path in (('--json', out), ('--output', folder)):
        run.fails(1, 'exists already', *pair(folders), option, path)
    out.write_text('my notes')
    run.fails(1, 'is no JSON file: it is never replaced', *pair(folders), '--json', out, '--force')


CHROMIUM = shutil.which('chromium')
CLICKS = """<script>
document.querySelectorAll('.pair').forEach((card, i) => {
  for (let n = 0; n < i % 3; n++) card.click();
});
const marked = document.getElementById('marks').textContent;
document.title = Math.max(0, document.documentElement.scrollWidth - innerWidth) + ' ' + marked;
</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason='Chromium is not installed')
def test_report_fits_a_phone_and_marks_pairs_by_clicks(tmp_path):
    images = route_images(40)
    write_images(tmp_path / 'map', images)
    write_images(tmp_path / 'query', [image // 2 for image in images])
    options = [f'--{name}={tmp_path / name}' for name in ('map', 'query')]
    assert evaluate.main([*options, '--output', str(tmp_path)]) == 0
    page = tmp_path / 'clicked.html'
    page.write_text((tmp_path / 'report.html').read_text() + CLICKS)
    for width in (1400, 390):
        shot, size = tmp_path / f'{width}.png', f'--window-size={width},2400'
        browser = [CHROMIUM, '--headless=new', '--no-sandbox', '--disable-gpu', size]
        run = [*browser, f'--screenshot={shot}', page.as_uri()]
        subprocess.run(run, check=True, capture_output=True, timeout=100)
        assert cv2.imread(str(shot)).std() > 10
        print(f'screenshot: {shot}')
    text = subprocess.check_output([*browser, '--dump-dom', page.as_uri()], text=True, timeout=100)
    assert '<title>0 16 of 24 pairs are marked</title>' in text  # 0 pixels are cut off


# Inputs and exports of evaluate: descriptors, several queries, options of maps, other formats


@pytest.fixture(scope='module')
def vectors():
    """Return a curve of 40 vectors, not of unit norm; the sixth is zero."""
    curve = np.cumsum(np.random.default_rng(0).standard_normal((40, 24)), axis=0)
    curve[5] = 0
    return curve.astype(np.float32)


@pytest.fixture
def arrays(tmp_path, vectors):
    """Write descriptors of a map and a query, with noise; return the options."""
    np.save(tmp_path / 'map.npy', vectors)
    noise = np.random.default_rng(3).normal(0, 0.5, vectors.shape)
    np.savez(tmp_path / 'query.npz', query=vectors + noise)
    paths = ['--map', tmp_path / 'map.npy', '--query', f'{tmp_path}/query.npz:query']
    return [*paths, '--sequence-length', 5, '--truth', 'identity']


def test_evaluate_of_descriptors_and_of_exported_ones_are_equal(run, arrays, tmp_path):
    first, second, exported = (tmp_path / name for name in ('1.json', '2.json', 'arrays'))
    assert run(*arrays, '--json', first, '--export', exported)[0] == 0
    again = ['--map', exported / 'map.npy', '--query', exported / 'query.npy', *arrays[4:]]
    assert run(*again, '--json', second)[0] == 0
    numbers = [json.loads(path.read_text()) for path in (first, second)]
    assert numbers[0]['sequence']['f1'] == pytest.approx(numbers[1]['sequence']['f1'])
    assert numbers[0]['single']['recall_at_1'] > 0.9
    run.fails(1, 'exists already', *arrays, '--json', tmp_path / '3.json', '--export', exported)


def test_evaluate_names_a_result_that_cannot_be_wrong(run, arrays, tmp_path):
    twice = [*arrays[:3], arrays[1], *arrays[4:]]
    texts = 'accepts 100% of the 40 places', 'map and query are the same images'
    for options, shown in (([*arrays, '--tolerance', 40], 0), (twice, 1), (arrays, None)):
        code, _, errors = run(*options, '--json', tmp_path / 'a.json', '--force')
        assert (code, [text in errors for text in texts]) == (0, [shown == 0, shown == 1])


def test_evaluate_names_the_time_of_several_sessions(run, small_map, route, tmp_path):
    save_map(merge_maps([small_map, small_map], 'ab'), tmp_path / 'both.stavpr')
    both = ['--map', tmp_path / 'both.stavpr', '--query', write_images(tmp_path / 'query', route)]
    code, shown, _ = run(*both, '--json', tmp_path / 'a.json')
    assert (code, '2 sessions: an image takes up to 2 times the time of one' in shown) == (0, True)


def test_evaluate_exports_strips_of_images(run, route, tmp_path):
    folder = write_images(tmp_path / 'images', route[:24])
    both = ['--map', folder, '--query', folder, '--sequence-length', 5]
    both += ['--features', 'gradient']
    assert run(*both, '--json', tmp_path / 'a.json', '--export', tmp_path)[0] == 0
    array = np.load(tmp_path / 'map.npy')
    features = FeatureExtractor('gradient').extract(route[:24])
    assert array.shape == (24, 7, 224)
    again = read_descriptors(str(tmp_path / 'map.npy'))
    np.testing.assert_allclose(again.strips, features.strips, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(again.weights, features.weights, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ('options', 'word'),
    [
        (['--strips', 7], '--strips'),
        (['--projection', 8], '--projection'),
        (['--features', 'onnx'], '--features'),
        (['--gradient-cell', 32], '--gradient-cell'),
        (['--crop-map', 0.2], 'saved map or an array'),
    ],
)
def test_evaluate_of_descriptors_rejects_options_of_images(run, arrays, options, word):
    run.fails(2, word, *arrays, *options)


def test_map_of_descriptors_takes_descriptors_only(run, arrays, route, tmp_path, runner):
    build = runner(build_descriptor_map)
    saved = tmp_path / 'route.stavpr'
    source = ['--descriptors-source', 'netvlad']
    poses = tmp_path / 'poses.csv'
    poses.write_text(''.join(f'{i},0,0\n' for i in range(40)))
    code, output, _ = build('--input', arrays[1], '--output', saved, *source, '--poses', poses)
    assert (code, '1 strips of 24 dimensions' in output) == (0, True)
    place_map = load_map(saved)
    assert place_map.pose(39)[0] == 39
    with pytest.raises(UnavailableError, match='not from images'):
        place_map.extractor()
    query = ['--query', *arrays[3:], '--json', tmp_path / 'a.json', '--force']
    assert run('--map', saved, *query)[0] == 0
    run.fails(1, 'megaloc', '--map', saved, *query, '--descriptors-source', 'megaloc')
    images = write_images(tmp_path / 'images', route[:24])
    run.fails(1, 'not from images', '--map', saved, '--query', images)


def test_map_of_bits_takes_bits_without_the_option(run, arrays, vectors, tmp_path, runner):
    """The map has the setting; a query of numbers is rejected."""
    path, saved = tmp_path / 'bits.npy', tmp_path / 'bits.stavpr'
    np.save(path, np.packbits(vectors > 0, axis=1))
    build = runner(build_descriptor_map)
    build.fails(1, 'with --descriptors-bits true', '--input', path, '--output', saved)
    code, output, _ = build('--input', path, '--output', saved, '--descriptors-bits', 'true')
    assert (code, '1 strips of 24 dimensions' in output) == (0, True)
    options = ['--map', saved, *arrays[4:], '--json', tmp_path / 'a.json', '--force', '--query']
    assert run(*options, path)[0] == 0
    run.fails(1, 'expected uint8 for bits', *options, arrays[3])


@pytest.mark.long
def test_evaluate_of_several_queries_equals_each(run, arrays, vectors, tmp_path):
    np.save(tmp_path / 'other.npy', vectors[::-1])
    options, query = ['--map', arrays[1], *arrays[4:]], arrays[3]
    several = ['--query', query, tmp_path / 'other.npy', '--output', tmp_path / 'out']
    assert run(*options, *several, '--processes', 2)[0] == 0
    assert run(*options, '--query', query, '--json', tmp_path / 'a.json')[0] == 0
    both = (tmp_path / 'a.json', *(tmp_path / 'out').glob('query*.json'))
    one, other = (json.loads(file.read_text()) for file in both)
    for name in ('sequence', 'single', 'decision', 'calibration', 'map_id'):
        assert one[name] == other[name]
    assert (tmp_path / 'out' / 'other' / 'report.html').is_file()


N = 24


@pytest.fixture
def export(runner, tmp_path, route):
    """Run evaluate on the same images as map and query with an export; return the outcome."""
    for name in ('map', 'query'):
        write_images(tmp_path / name, route[:N])
    command = runner(evaluate)
    folders = ['--map', tmp_path / 'map', '--query', tmp_path / 'query', '--sequence-length', 5]

    def export(name, *options):
        form = ['--export', tmp_path / 'out', '--export-format', name]
        return command(*folders, *form, '--json', tmp_path / 'numbers.json', *options)

    return export


def test_export_vpr_methods_evaluation_has_positions_in_the_names(export, tmp_path):
    options = ['--truth', 'identity', '--tolerance', 2, '--features', 'gradient']
    assert export('vpr_methods_evaluation', *options)[0] == 0
    out, positions, rows = tmp_path / 'out', [], []
    for side in ('database', 'queries'):
        paths = (out / f'{side}_images_paths.txt').read_text().splitlines()
        assert sorted(paths) == sorted(os.path.basename(p) for p in glob(f'{out}/{side}/*'))
        assert all((out / side / path).is_file() for path in paths)
        positions.append(np.array([path.split('@')[1:3] for path in paths]).astype(float))
        rows.append(np.load(out / f'{side}_descriptors.npy'))
    assert rows[0].dtype == np.float32
    assert rows[0].shape == (N, 7 * 224)
    np.testing.assert_allclose(np.linalg.norm(rows[0], axis=1), 1, rtol=1e-5)
    assert (rows[1] @ rows[0].T).argmax(axis=1).tolist() == list(range(N))
    distances = np.linalg.norm(positions[1][:, None] - positions[0], axis=2)
    index = np.arange(N)
    np.testing.assert_array_equal(distances <= 25, abs(index[:, None] - index) <= 2)


def test_export_vpr_methods_evaluation_takes_positions_from_poses(export, tmp_path):
    poses = tmp_path / 'poses.csv'
    poses.write_text(''.join(f'{i},{-i},7\n' for i in range(N)))
    options = ['--truth', 'poses', '--query-poses', poses, '--map-poses', poses, '--reverse']
    assert export('vpr_methods_evaluation', *options)[0] == 0
    paths = (tmp_path / 'out/queries_images_paths.txt').read_text().splitlines()
    assert [path.split('@')[1:3] for path in paths] == [
        [f'{i:.2f}', f'{-i:.2f}'] for i in reversed(range(N))
    ]
    shown = os.readlink(tmp_path / 'out/queries' / paths[0])
    assert shown == str(max((tmp_path / 'query').iterdir()))


def test_export_vpr_tutorial_gives_its_metrics_our_numbers(export, tmp_path):
    assert export('vpr_tutorial', '--truth', 'identity', '--tolerance', 1)[0] == 0
    S, truth = np.load(tmp_path / 'out/S.npy'), np.load(tmp_path / 'out/GT.npz')
    assert S.shape == truth['GThard'].shape == truth['GTsoft'].shape == (N, N)
    recall = truth['GTsoft'][S.argmax(axis=0), np.arange(N)].mean()
    single = read_json((tmp_path / 'numbers.json').read_text())['single']
    assert recall == pytest.approx(single['recall_at_1'])


def test_export_hloc_names_images_below_one_folder(export, tmp_path):
    assert export('hloc')[0] == 0
    pairs = [line.split() for line in (tmp_path / 'out/pairs.txt').read_text().splitlines()]
    assert all((tmp_path / name).is_file() for arrays in pairs for name in arrays)
    best = {}
    for query, place in pairs:
        best.setdefault(query, place)
    assert [place.removeprefix('map/') for place in best.values()] == [
        query.removeprefix('query/') for query in best
    ]
    (tmp_path / 'a place').symlink_to(tmp_path / 'map')
    code, _, errors = export('hloc', '--map', tmp_path / 'a place', '--force')
    assert (code, 'has a space' in errors) == (1, True)
    np.save(tmp_path / 'v.npy', np.eye(N))
    arrays = ['--map', tmp_path / 'v.npy', '--query', tmp_path / 'v.npy', '--force']
    code, _, errors = export('hloc', *arrays)
    assert (code, 'give --map and --query as folders' in errors) == (1, True)
