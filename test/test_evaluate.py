"""The command `evaluate`, on drives made up here and on real ones."""

import csv
import json
import os
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from conftest import route_images

from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.commands import evaluate
from stavpr_ros.evaluation.evaluate import recognize_all
from stavpr_ros.evaluation.metrics import best_f1, image_matches
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, save_map
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
from stavpr_ros.sources import open_source

pytest.importorskip('sklearn', reason='the extra evaluation is not installed')

PLACES = 60


def strictly(text):
    """Read JSON as browsers do: without NaN and Infinity."""
    return json.loads(text, parse_constant=pytest.fail)


def write_images(folder, images):
    folder.mkdir(parents=True)
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f'{i:03}.png'), image[:, :, ::-1])
    return folder


def seen_again(images, seed=1):
    """The same views, darker and with noise."""
    rng = np.random.default_rng(seed)
    return [
        np.clip(image * 0.6 + rng.normal(0, 12, image.shape), 0, 255).astype(np.uint8) for image in images
    ]


@pytest.fixture(scope='module')
def drives(tmp_path_factory):
    """Folders: a map, a second drive, one that looks to the side a little, and one somewhere else."""
    folder = tmp_path_factory.mktemp('drives')
    first = route_images(PLACES)
    write_images(folder / 'map', first)
    write_images(folder / 'query', seen_again(first))
    write_images(folder / 'aside', [np.roll(image, 26, axis=1) for image in seen_again(first)])
    write_images(folder / 'elsewhere', route_images(40, seed=5))
    return folder


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command within this process: exit code, output, errors."""
    monkeypatch.setattr(evaluate, 'obey_signals', lambda: None)

    def call(*arguments):
        try:
            code = evaluate.main([str(argument) for argument in arguments])
        except SystemExit as error:  # argparse
            code = error.code
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def judged(run, tmp_path):
    """Run `evaluate` with some options and read its JSON."""

    def call(*arguments):
        path = tmp_path / 'out.json'
        code, _, errors = run(*arguments, '--json', path)
        assert code == 0, errors
        return strictly(path.read_text())

    return call


def pair(drives):
    return ['--map', drives / 'map', '--query', drives / 'query']


def test_a_plain_run(drives, judged):
    found = judged(*pair(drives), '--features', 'gradient', '--mode', 'paper', '--tolerance', 1)
    for kind in ('sequence', 'sequence_without_ends', 'single', 'single_without_ends'):
        numbers = found[kind]
        assert numbers['f1'] > 0.9
        assert 0 < numbers['threshold'] < 1
        assert numbers['average_precision'] > 0.9
        assert 0.9 < numbers['recall_at_1'] <= numbers['recall_at_5'] <= numbers['recall_at_20'] <= 1
        assert 0 <= numbers['recall_at_100_precision'] <= 1
    assert found['sequence']['queries'] == PLACES
    assert found['sequence_without_ends']['queries'] == PLACES - 19
    assert found['settings']['mode'] == 'paper'
    assert found['settings']['tolerance'] == 1
    assert found['settings']['vertical'] is False
    assert 'gradient' in found['settings']['features']
    assert found['times']['total_s'] > 0
    assert 'false_alarm_rate' not in found


@pytest.mark.parametrize(
    ('options', 'spatial'),
    [
        (['--xi', 1], SpatialSettings(xi=1)),
        (['--spatial', 'none'], SpatialSettings('none')),
        (['--sigma', 0], SpatialSettings(sigma=0)),
    ],
)
def test_the_numbers_are_those_of_the_recognizer(drives, judged, options, spatial):
    """Against the plain way: every image through the recognizer, windows to their middles, best F1."""
    options = [*options, '--length', 8, '--beta', 1.5, '--warp', '2x', '--tolerance', 2]
    found = judged('--map', drives / 'map', '--query', drives / 'aside', *options)
    extractor = FeatureExtractor()
    place_map = build_map(open_source(drives / 'map'), extractor, progress=False)
    query = build_map(open_source(drives / 'aside'), extractor, progress=False).features[::2]
    settings = RecognizerSettings(1.0, spatial=spatial, sequence=SequenceSettings(8, 1.5))
    recognizer = PlaceRecognizer(place_map, settings)
    answers = image_matches(recognize_all(recognizer, query), 8)
    right = np.abs(answers.places - np.arange(0, PLACES, 2)) <= 2
    best = best_f1(answers.distances, right)
    assert found['sequence']['f1'] == best.f1
    assert found['sequence']['threshold'] == pytest.approx(best.threshold, abs=1e-6)
    assert found['sequence']['recall_at_1'] == np.mean(right)
    distances = recognizer.distances(query)
    single = best_f1(distances.min(axis=1), np.abs(distances.argmin(axis=1) - np.arange(0, PLACES, 2)) <= 2)
    assert found['single']['f1'] == single.f1
    assert found['single']['threshold'] == pytest.approx(single.threshold, abs=1e-6)
    ends = slice(3, PLACES // 2 - 4)
    assert found['sequence_without_ends']['f1'] == best_f1(answers.distances[ends], right[ends]).f1


def test_it_is_deterministic(drives, judged):
    options = [*pair(drives), '--mode', 'robust', '--projection', 64]
    first, second = judged(*options), judged(*options)
    assert first.pop('times').keys() == second.pop('times').keys()
    assert first == second
    own = first['default_threshold']  # mode robust has one
    assert 0 <= own['f1'] <= first['sequence']['f1']
    assert own['threshold'] > 0


@pytest.mark.parametrize('mode', ['paper', 'robust'])
def test_the_report(drives, run, tmp_path, mode):
    folder = tmp_path / 'report'
    options = ['--output', folder, '--window', 30, '--unknown', drives / 'elsewhere', '--mode', mode]
    code, text, errors = run(*pair(drives), *options)
    assert code == 0, errors
    assert 'false alarm rate' in text
    names = {file.name for file in folder.iterdir()}
    assert {'results.json', 'answers.csv', 'curves.csv', 'window_30.png', 'precision_recall.png'} <= names
    for name in names:
        if name.endswith('.png'):
            assert cv2.imread(str(folder / name)).std() > 5, f'{name} is empty'
    with (folder / 'answers.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row['image']) for row in rows] == list(range(PLACES))
    right = [int(row['sequence_right']) for row in rows]
    assert right == [int(abs(int(row['sequence_place']) - i) <= 3) for i, row in enumerate(rows)]

    page = (folder / 'report.html').read_text(encoding='utf-8')
    assert not re.search('@@[A-Z_]+@@', page)
    # nothing is fetched from anywhere
    assert {address[:5] for address in re.findall(r'(?:src|href)=["\']([^"\']*)', page)} == {'data:'}
    assert 'http' not in page
    data = strictly(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))
    assert [view['image'] for view in data['views']] == list(range(9, PLACES - 10))
    view = data['views'][21]
    assert view['answer'] == int(rows[30]['sequence_place'])
    assert data['queries']['30'].startswith('data:image/jpeg')
    assert view['path'][0][1] >= view['first']
    results = json.loads((folder / 'results.json').read_text())
    assert f'{results["sequence"]["f1"]:.4f}' in page


def test_answers_no_nearer_than_chance(drives, run, tmp_path):
    """In mode robust they have no distance; the page can be read all the same."""
    pairs = tmp_path / 'pairs.csv'
    pairs.write_text('0,0\n')
    options = ['--map', drives / 'map', '--query', drives / 'elsewhere', '--truth', pairs, '--mode', 'robust']
    code, _, errors = run(*options, '--output', tmp_path)
    assert code == 0, errors
    page = (tmp_path / 'report.html').read_text(encoding='utf-8')
    data = strictly(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))
    assert any(view['score'] is None and not view['accepted'] for view in data['views'])
    assert 'no nearer than chance' in page


def test_a_title_is_text(tmp_path, run):
    images = route_images(24)
    first = write_images(tmp_path / '<b>map', images)
    query = write_images(tmp_path / 'a&b@@DATA@@', images)
    # names need not be text at all
    (query / '000.png').rename(query / os.fsdecode(b'000\xe9.png'))
    query = query.rename(tmp_path / os.fsdecode(b'a&b@@DATA@@\xe9'))
    code, _, errors = run('--map', first, '--query', query, '--output', tmp_path / 'out')
    assert code == 0, errors
    page = (tmp_path / 'out' / 'report.html').read_text(encoding='utf-8')
    assert '&lt;b&gt;map' in page
    assert '<b>map' not in page
    assert 'a&amp;b@@DATA@@' in page
    assert page.count('"cells":') == 5  # windows of 20 in 24 images


def test_false_alarms(drives, judged):
    """Seen twice: the known drive as if it were unknown is accepted as often as it was; another is not."""
    same = judged(*pair(drives), '--unknown', drives / 'query')
    for kind in ('sequence', 'single'):
        numbers = same[kind]
        accepted = numbers['true_positives'] + numbers['false_positives']
        assert numbers['false_alarm_rate'] == accepted / PLACES
    assert same['false_alarm_rate'] == same['sequence']['false_alarm_rate'] > 0.9
    other = judged(*pair(drives), '--unknown', drives / 'elsewhere')
    assert other['unknown_images'] == 40
    assert other['false_alarm_rate'] < 0.2
    assert other['sequence']['f1'] == same['sequence']['f1']


def test_saved_maps_are_drives_too(drives, tmp_path, judged, run):
    extractor = FeatureExtractor(projection=32)
    for name in ('map', 'query'):
        place_map = build_map(open_source(drives / name), extractor, progress=False)
        save_map(place_map, tmp_path / f'{name}.stavpr')
    saved, options = tmp_path / 'map.stavpr', ['--tolerance', 0]
    folders = judged(*pair(drives), '--projection', 32, *options)
    mixed = judged('--map', saved, '--query', drives / 'query', *options)
    both = judged('--map', saved, '--query', tmp_path / 'query.stavpr', *options)
    assert folders['sequence'] == mixed['sequence'] == both['sequence']
    for wrong, word in (
        (['--features', 'onnx'], 'was made with gradient'),
        (['--strips', 5], 'was made with 7'),
        (['--projection', 9], '--projection'),
        (['--seed', 0], '--seed'),
        (['--gradient-cell', 32], '--gradient-cell'),
        (['--densenet161_places365-size', 224], '--densenet161_places365-size'),
        (['--crop-map', 0.3], '--crop-map'),
    ):
        code, _, errors = run('--map', saved, '--query', drives / 'query', *wrong)
        assert code == 2
        assert word in errors


@pytest.mark.parametrize(('kind', 'images'), [('2x', 30), ('0.5x', 120), ('stop', 90)])
def test_other_speeds(drives, judged, kind, images):
    """The truth goes with the images: single images are as right as before."""
    plain = judged(*pair(drives), '--tolerance', 0)['single']['recall_at_1']
    found = judged(*pair(drives), '--warp', kind, '--tolerance', 0)
    assert found['images'] == found['single']['queries'] == images
    assert found['places'] == PLACES
    assert plain == found['single']['recall_at_1'] == 1


def test_cropping(drives, judged, tmp_path):
    """Cropped by the command, or before: the same."""
    images = [cv2.imread(str(file))[:, :, ::-1] for file in sorted((drives / 'map').iterdir())]
    width = images[0].shape[1]
    cut = write_images(tmp_path / 'cut', [image[:, : width - round(0.3 * width)] for image in images])
    images = [cv2.imread(str(file))[:, :, ::-1] for file in sorted((drives / 'query').iterdir())]
    seen = write_images(tmp_path / 'seen', [image[:, round(0.1 * width) :] for image in images])
    found = judged(*pair(drives), '--crop-map', 0.3, '--crop-query', 0.1)
    assert found['sequence'] == judged('--map', cut, '--query', seen)['sequence']
    assert found['sequence']['threshold'] != judged(*pair(drives))['sequence']['threshold']


def test_truth_from_a_file_has_its_own_tolerance(drives, judged, tmp_path):
    pairs = tmp_path / 'pairs.csv'
    pairs.write_text('query,place\n' + ''.join(f'{i},{i + 2}\n' for i in range(PLACES - 2)))
    options = [*pair(drives), '--truth', pairs]
    assert judged(*options)['single']['recall_at_1'] == 0  # all are two off
    assert judged(*options)['single']['queries_with_match'] == PLACES - 2
    assert judged(*options, '--tolerance', 2)['single']['recall_at_1'] == 1


def test_truth_from_poses(drives, judged, run, tmp_path):
    poses = {name: tmp_path / f'{name}.csv' for name in ('query', 'map')}
    poses['map'].write_text(''.join(f'{i},0,0\n' for i in range(PLACES)))
    poses['query'].write_text(''.join(f'{i + 2.2},0,0\n' for i in range(PLACES)))
    options = [*pair(drives), '--truth', 'poses', '--query-poses', poses['query']]
    found = judged(*options, '--map-poses', poses['map'], '--meters', 2.3)
    assert found['single']['recall_at_1'] == pytest.approx(1)
    near = judged(*options, '--map-poses', poses['map'], '--meters', 1)
    assert near['single']['recall_at_1'] == 0
    code, _, errors = run(*options)
    assert (code, '--map-poses' in errors) == (2, True)


def test_loop_closure(tmp_path, judged):
    """Once around and once more: the second round is known, the first is not."""
    once = route_images(40)
    drive = write_images(tmp_path / 'drive', [*once, *once])
    truth = np.zeros((80, 80), np.uint8)
    truth[np.arange(40, 80), np.arange(40)] = 255
    cv2.imwrite(str(tmp_path / 'truth.png'), truth)
    options = ['--query', drive, '--truth', tmp_path / 'truth.png']
    found = judged(*options, '--tolerance', 1, '--loop-closure', 25)
    assert found['sequence']['queries_with_match'] == 40
    assert found['single']['recall_at_1'] == 1
    assert found['sequence']['f1'] > 0.7
    # the map and the truth end at the same image; the first few places are too few to match with
    assert judged(*options, '--loop-closure', 40)['single']['recall_at_1'] > 0.8
    beyond = judged(*options, '--loop-closure', 41)['single']
    assert (beyond['queries_with_match'], beyond['recall_at_1'], beyond['f1']) == (0, None, 0)


def test_a_known_data_set(tmp_path, judged, run):
    images = route_images(24)
    write_images(tmp_path / 'nordland' / 'summer', images)
    write_images(tmp_path / 'nordland' / 'winter', images)
    found = judged('--dataset', f'nordland={tmp_path}')
    assert found['settings']['tolerance'] == 3
    assert found['sequence']['f1'] == 1
    source, saved = open_source(tmp_path / 'nordland' / 'winter'), tmp_path / 'unknown.stavpr'
    save_map(build_map(source, FeatureExtractor(projection=32), progress=False), saved)
    options = ['--dataset', f'nordland={tmp_path}', '--projection', 32, '--unknown', saved]
    assert judged(*options)['unknown_images'] == 24
    code, _, errors = run(*options, '--seed', 1)
    assert (code, 'those of the first drive' in errors) == (1, True)
    code, _, errors = run('--dataset', 'nordland')
    assert (code, 'NAME=FOLDER' in errors) == (2, True)


@pytest.mark.parametrize(
    ('options', 'code', 'word'),
    [
        ([], 2, '--query is needed'),
        (['--query', 'x'], 2, '--loop-closure'),
        (['--map', '/missing', '--query', '/missing'], 1, '/missing'),
        (['--query', 'x', '--loop-closure', '9'], 2, '--truth'),
        (['--query', 'x', '--loop-closure', '0', '--truth', 'y'], 2, 'at least 1'),
        (['--query', 'x', '--loop-closure', '9', '--truth', 'y', '--warp', '2x'], 2, '--warp'),
        (['--query', 'x', '--loop-closure', '9', '--truth', 'y', '--backend', 'auto'], 2, '--backend'),
        (['--query', 'x', '--loop-closure', '9', '--truth', 'y', '--precision', 'float16'], 2, '--precision'),
        (['--query', 'x', '--loop-closure', '9', '--truth', 'y', '--crop-map', '0.3'], 2, '--crop-map'),
        (['--query', 'x', '--loop-closure', '9', '--truth', 'poses', '--map-poses', 'y'], 2, '--map-poses'),
        (['--map', 'x', '--query', 'y', '--tolerance', '-1'], 2, '--tolerance'),
        (['--map', 'x', '--query', 'y', '--map-poses', 'z'], 2, '--truth poses'),
        (['--map', 'x', '--query', 'y', '--json', '/missing/x.json'], 1, 'does not exist'),
        (['--map', 'x', '--query', 'y', '--json', '/tmp'], 1, 'name a file in it'),
        (['--map', 'x', '--query', 'y', '--output', __file__], 1, 'takes a folder'),
        (['--dataset', 'ua=x', '--map', 'y'], 2, 'leave'),
    ],
)
def test_wrong_usage(run, options, code, word):
    found, _, errors = run(*options)
    assert found == code
    assert word in errors


def test_drives_that_do_not_fit(drives, run, tmp_path):
    code, _, errors = run('--map', drives / 'map', '--query', drives / 'elsewhere')
    assert (code, '40 query images and 60 places' in errors) == (1, True)
    code, _, errors = run(*pair(drives), '--strips', 0)
    assert (code, 'W = 0' in errors) == (2, True)
    code, _, errors = run(*pair(drives), '--length', 61)
    assert (code, 'at least l = 61' in errors) == (1, True)
    folder = tmp_path / 'none'
    code, _, errors = run(*pair(drives), '--window', 3, '--output', folder)
    assert (code, '9 .. 49' in errors, folder.exists()) == (2, True, False)
    pickled = tmp_path / 'truth.npy'
    np.save(pickled, np.array([[1], [1, 2]], object), allow_pickle=True)
    code, _, errors = run(*pair(drives), '--truth', pickled)
    assert (code, 'pickle' in errors) == (1, True)


def test_without_scikit_learn(drives, run, monkeypatch):
    monkeypatch.setitem(sys.modules, 'sklearn.metrics', None)
    code, _, errors = run(*pair(drives))
    assert (code, 'pip install scikit-learn' in errors) == (1, True)


def test_help():
    command = [sys.executable, '-m', 'stavpr_ros.commands.evaluate', '--help']
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert result.returncode == 0
    assert 'exit codes' in result.stdout


# Real drives; what is asserted is what was measured, a little below


def test_gardens_point(data_folder, judged):
    folder = data_folder / 'gardens_point'
    options = ['--map', folder / 'day_left', '--query', folder / 'day_right', '--tolerance', 2]
    paper, robust = judged(*options, '--mode', 'paper'), judged(*options, '--mode', 'robust')
    assert paper['sequence']['f1'] == pytest.approx(0.754, abs=0.02)
    assert robust['sequence']['f1'] > 0.95
    assert robust['sequence']['recall_at_5'] >= robust['sequence']['recall_at_1'] > 0.95


def test_corridor(data_folder, judged):
    folder = data_folder / 'corridor'
    options = ['--truth', folder / 'ground_truth.csv', '--mode', 'robust']
    found = judged('--map', folder / 'ref', '--query', folder / 'query', *options)
    assert found['sequence']['queries_with_match'] == 111
    assert found['sequence']['f1'] > 0.9


def test_hallway_loop(data_folder, judged):
    folder = data_folder / 'rtabmap_hallway_loop'
    options = ['--truth', folder / 'samples_GT.bmp', '--loop-closure', 20, '--length', 10, '--mode', 'robust']
    found = judged('--query', folder / 'samples', *options)
    assert found['sequence']['recall_at_1'] > 0.8
