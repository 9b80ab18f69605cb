# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's experiments: configurations, published numbers, and the command."""

from evaluation_commands import read_json, write_images
from fixtures import route_images
import numpy as np
import pytest
from stavpr_lab.commands import experiments
from stavpr_lab.evaluation.evaluate import evaluate_on_map
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.paper.datasets import Dataset
from stavpr_lab.evaluation.paper.experiments import (
    BaselineInputs,
    DatasetExperiment,
    PRESETS,
)
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map
from stavpr_ros.method import RecognizerSettings
from stavpr_ros.sources.folder import FolderSource


@pytest.fixture
def run(runner):
    return runner(experiments)


@pytest.fixture
def nordland(tmp_path):
    """Return the options of a data set of 24 images, equal by day and night."""
    for name in ('summer', 'winter'):
        write_images(tmp_path / 'nordland' / name, route_images(24))
    return ['--data', tmp_path, '--features', 'gradient', '--datasets', 'nordland']


def test_experiments_field_prints_recall_at_the_tolerance_of_each_data_set(
    nordland, tmp_path, run
):
    code, text, errors = run('field', *nordland[:4], '--gradient-cell', 32)
    assert code == 0, errors
    lines = text.splitlines()
    assert lines[0] == 'field: recall_at_1'
    assert lines[3].split('  ')[0] == 'nordland_winter, identity +-10'
    assert lines[3].split()[-4:] == ['1.000'] * 4
    assert any(line.startswith('nordland_winter_1, identity +-1 ') for line in lines)


def test_experiments_print_our_numbers_beside_the_published(nordland, tmp_path, run):
    out = tmp_path / 'out.json'
    code, text, errors = run('ablation', *nordland, '--json', out, '--gradient-cell', 32)
    assert code == 0, errors
    lines = [line.split() for line in text.splitlines()]
    assert lines[0][:3] == ['ablation,', 'mode', 'paper:']
    assert ['nordland', 'gradient', '1.000', '1.000', '1.000', '1.000'] in lines
    assert ['published,', 'DenseNet161', '0.919', '-', '-', '0.977'] in lines
    assert read_json(out.read_text())[0]['results']['sta_vpr']['f1'] == 1
    text = run('sweep', *nordland, '--values', 20, 40)[1]
    row, blank = text.splitlines()[-2:]
    assert row.split() == ['nordland', 'gradient', '1.000', '-']
    assert blank == '- nordland, l = 40: its 24 images are fewer than a window has'


def test_paper_table_has_all_systems_of_the_paper(nordland, tmp_path, run):
    """The nine columns of the paper: two of its backbones are rows; descriptors fill others."""
    arrays = tmp_path / 'arrays' / 'nordland'
    arrays.mkdir(parents=True)
    vectors = np.random.default_rng(0).standard_normal((24, 9))
    np.save(arrays / 'map.npy', vectors)
    np.savetxt(arrays / 'query.csv', np.roll(vectors, 12, axis=0), delimiter=',')
    options = [*nordland, '--gradient-cell', 32, '--descriptors', f'saes={tmp_path / "arrays"}']
    code, text, errors = run('paper', *options)
    assert code == 0, errors
    lines = [line.split() for line in text.splitlines()]
    ours = next(line for line in lines if line[:2] == ['nordland', 'gradient'])
    assert ours[3:8] == ['-', '0.000', '1.000', '-', '-']  # all of SAES is wrong
    densenet = ['.982', '.587', '.682', '.919', '.221', '.952', '.977', '.971']
    assert ['published,', 'DenseNet161', *(f'0{number}' for number in densenet)] in lines
    assert '- nordland, NetVLAD: give --descriptors netvlad=FOLDER' in text
    assert '- nordland, SSM-VPR: give --features onnx' in text
    assert 'SAES:' not in text
    np.save(arrays / 'map.npy', vectors[:20])
    run.fails(1, 'of (20, 24) images: expected (24, 24)', 'paper', *options)


def test_ssm_vpr_is_a_column_of_the_paper(tmp_path, squeezenet_settings):
    images = route_images(6, size=(120, 160))
    source = FolderSource(write_images(tmp_path / 'images', images))
    truth = GroundTruth.identity(6, 6, 0)
    inputs = BaselineInputs(ssm_layers=('fire9/concat_1', 'fire6/concat_1'))
    column = next(row for row in PRESETS['paper'] if row.name == 'ssm_vpr')
    dataset = Dataset(source, source, truth, 0)
    experiment = DatasetExperiment(dataset, 'onnx', squeezenet_settings, inputs=inputs)
    metrics = experiment.evaluate(column)
    assert metrics.to_json()['f1'] == 1
    assert DatasetExperiment(dataset, 'onnx', squeezenet_settings).evaluate(column) is None


def test_every_configuration_reaches_the_recognizer(tmp_path):
    """Queries that are shifted to the side have different numbers in every configuration."""
    images = route_images(40)
    shifted = {'map': images, 'query': [np.roll(image, 60, axis=1) for image in images]}
    sources = [FolderSource(write_images(tmp_path / name, v)) for name, v in shifted.items()]
    truth = GroundTruth.identity(40, 40, 1)
    experiment = DatasetExperiment(Dataset(*sources, truth, 1), 'gradient', None)
    extractor = FeatureExtractor('gradient')
    place_map, query = (build_map(source, extractor, progress=False) for source in sources)
    settings = RecognizerSettings(1.0, mode='paper')
    plain = evaluate_on_map(place_map, query.features, truth, settings)
    columns = {column.name: column for preset in PRESETS.values() for column in preset}
    metrics = {name: experiment.evaluate(column) for name, column in columns.items()}
    numbers = {name: result.to_json() for name, result in metrics.items() if result is not None}
    assert numbers['sta_vpr'] == plain.sequence.to_json()
    assert numbers['spatial'] == plain.single.to_json()
    different = ('no_alignment', 'temporal', 'sta_vpr_fast', 'grp', 'ra', 'vanilla', 'robust')
    pairs = [('sta_vpr', other) for other in (*different, 'seqslam', 'spatial')]
    pairs += [('no_alignment', 'temporal'), ('without_place_filter', 'robust')]
    for one, other in pairs:
        assert numbers[one]['threshold'] != numbers[other]['threshold'], (one, other)


@pytest.mark.parametrize(
    ('options', 'code', 'word'),
    [
        ('paper', 2, '--data'),
        ('paper --data /missing', 1, '/missing'),
        ('paper --values 3 --data x', 2, 'sweep'),
        ('paper --seed 5 --data x', 2, 'the experiment sets'),
        ('paper --descriptors x=y --data x', 2, 'netvlad or saes or vgg_fc6'),
        ('fast --ssm-layers x y --data x', 2, 'experiment paper'),
        ('paper --data x --json /missing/x.json', 1, 'make it first'),
    ],
)
def test_experiments_with_invalid_options_fail_before_the_work(run, options, code, word):
    run.fails(code, word, *options.split())
