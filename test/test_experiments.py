"""The paper's experiments: what they are, the published numbers, and the command that runs them."""

import json

import cv2
import numpy as np
import pytest
from conftest import route_images

from stavpr_ros.commands import experiments
from stavpr_ros.errors import SettingsError
from stavpr_ros.evaluation.evaluate import evaluate_on_map
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.paper.datasets import Dataset
from stavpr_ros.evaluation.paper.experiments import PRESETS, Bench, sweep_configurations
from stavpr_ros.evaluation.paper.published import published_f1
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map
from stavpr_ros.recognition import RecognizerSettings
from stavpr_ros.sources.folder import FolderSource

pytest.importorskip('sklearn', reason='the extra evaluation is not installed')


def write_images(folder, images):
    folder.mkdir(parents=True)
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f'{i:03}.png'), image[:, :, ::-1])
    return folder


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command within this process: exit code, output, errors."""
    monkeypatch.setattr(experiments, 'obey_signals', lambda: None)

    def call(*arguments):
        try:
            code = experiments.main([str(argument) for argument in arguments])
        except SystemExit as error:  # argparse
            code = error.code
        return code, *capsys.readouterr()

    return call


def test_the_experiments_are_the_paper_s():
    paper = {column.name: column for column in PRESETS['paper']}
    assert paper['sta_vpr_fast'].projection == 512
    assert paper['sta_vpr_fast'].spatial.xi == 3
    assert not paper['no_alignment'].temporal
    assert paper['no_alignment'].spatial.strategy == 'none'
    ablation = [(column.spatial.strategy, column.temporal) for column in PRESETS['ablation']]
    assert ablation == [('none', False), ('adaptive', False), ('none', True), ('adaptive', True)]
    assert [column.spatial.strategy for column in PRESETS['strategies']] == [
        'sliding_window', 'vanilla', 'adaptive',
    ]  # fmt: skip


def test_sweeps():
    assert [column.sequence.length for column in sweep_configurations('l', [5, 10])] == [5, 10]
    assert sweep_configurations('beta')[0].sequence.beta == 1.25
    assert [column.spatial.xi for column in sweep_configurations('xi', [2])] == [2]
    assert [column.spatial.sigma for column in sweep_configurations('sigma', [0.5])] == [0.5]
    assert [column.strips for column in sweep_configurations('W', [5])] == [5]
    with pytest.raises(SettingsError, match='whole number'):
        sweep_configurations('W', [5.5])
    with pytest.raises(SettingsError, match='unknown'):
        sweep_configurations('gamma')


def test_published_numbers():
    assert published_f1('synth_nordland', 'DenseNet161', 'vanilla') == 0.322
    assert published_f1('gardens_point_night', 'VGG16', 'sta_vpr_fast') == 0.953
    assert published_f1('berlin_a100', 'DenseNet161', 'no_alignment') == 0.714
    assert published_f1('nordland', 'VGG16', 'vanilla') is None
    assert published_f1('elsewhere', 'VGG16', 'sta_vpr') is None


def test_a_table(tmp_path, run):
    images = route_images(24)
    write_images(tmp_path / 'nordland' / 'summer', images)
    write_images(tmp_path / 'nordland' / 'winter', images)
    out = tmp_path / 'out.json'
    backbones = ['--backbone', 'fine=--gradient-cell 16', '--backbone', 'coarse=--gradient-cell 32']
    options = ['--data', tmp_path, '--datasets', 'nordland', '--json', out]
    code, text, errors = run('ablation', *options, *backbones)
    assert code == 0, errors
    lines = [line.split() for line in text.splitlines()]
    assert ['nordland', 'fine', '1.000', '1.000', '1.000', '1.000'] in lines
    assert ['nordland', 'coarse', '1.000', '1.000', '1.000', '1.000'] in lines
    assert ['published,', 'DenseNet161', '0.919', '-', '-', '0.977'] in lines
    written = json.loads(out.read_text())
    assert written[0]['results']['sta_vpr']['f1'] == 1
    code, text, _ = run('sweep', *options[:4], '--values', 20, 40)
    assert code == 0
    assert text.splitlines()[-1].split() == ['nordland', 'gradient', '1.000', '-']  # 24 images, no 40


def test_a_column_is_one_evaluation(tmp_path):
    """Whatever a configuration says reaches the recognizer; views that look aside tell the columns apart."""
    images = route_images(40)
    drives = [
        FolderSource(write_images(tmp_path / name, [np.roll(image, shift, axis=1) for image in images]))
        for name, shift in (('map', 0), ('query', 60))
    ]
    truth = GroundTruth.identity(40, 40, 1)
    bench = Bench(Dataset(*drives, truth, 1), 'gradient', None)
    place_map, query = (build_map(drive, FeatureExtractor(), progress=False) for drive in drives)
    plain = evaluate_on_map(place_map, query.features, truth, RecognizerSettings(1.0))
    columns = {column.name: column for preset in PRESETS.values() for column in preset}
    found = {name: bench.judge(column).to_json() for name, column in columns.items()}
    assert found['sta_vpr'] == plain.sequence.to_json()
    assert found['spatial'] == plain.single.to_json()
    for other in ('no_alignment', 'temporal', 'sta_vpr_fast', 'grp', 'ra', 'vanilla', 'robust', 'seqslam'):
        assert found[other]['threshold'] != found['sta_vpr']['threshold'], other
    assert found['spatial']['threshold'] != found['sta_vpr']['threshold']
    assert found['no_alignment']['threshold'] != found['temporal']['threshold']
    assert found['without_velocity_search']['threshold'] != found['robust']['threshold']


@pytest.mark.parametrize(
    ('options', 'code', 'word'),
    [
        (['paper'], 2, '--data'),
        (['paper', '--datasets', 'nordland'], 2, 'NAME=FOLDER'),
        (['paper', '--data', '/missing'], 1, '/missing'),
        (['paper', '--values', '3', '--data', 'x'], 2, 'sweep'),
        (['paper', '--parameter', 'W', '--data', 'x'], 2, 'sweep'),
        (['paper', '--backbone', "a='", '--data', 'x'], 2, 'No closing quotation'),
        (['paper', '--backbone', 'a=', '--features', 'gradient', '--data', 'x'], 2, 'beside --backbone'),
        (['paper', '--backbone', 'a=', '--gradient-cell', '8', '--data', 'x'], 2, 'beside --backbone'),
        (['paper', '--backbone', 'a=--strips 5', '--data', 'x'], 2, 'the experiment decides'),
        (['paper', '--seed', '5', '--data', 'x'], 2, 'the experiment decides'),
        (['paper', '--data', 'x', '--json', '/missing/x.json'], 1, 'make it first'),
        (['paper', '--data', 'x', '--json', '/tmp'], 1, 'name a file in it'),
        (['nothing'], 2, 'invalid choice'),
    ],
)
def test_wrong_experiments(run, options, code, word):
    found, _, errors = run(*options)
    assert found == code
    assert word in errors
