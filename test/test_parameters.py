"""The table of parameters is the one source: configuration file and README are made from it."""

from pathlib import Path

import pytest
import yaml

from stavpr_ros.ros.parameter_table import configuration_yaml, documentation_markdown
from stavpr_ros.ros.parameters import PARAMETERS

ROOT = Path(__file__).resolve().parents[1]
REMEDY = 'write it anew: python3 -m stavpr_ros.ros.parameters'


def test_configuration_file_is_the_table():
    written = (ROOT / 'config' / 'stavpr.yaml').read_text()
    assert written == configuration_yaml(PARAMETERS), REMEDY
    values = yaml.safe_load(written)['/**']['ros__parameters']
    for row in PARAMETERS:
        assert values[row.name] == row.default
        assert type(values[row.name]) is type(row.default), row.name


def test_readme_documents_the_table():
    assert documentation_markdown(PARAMETERS) in (ROOT / 'README.md').read_text(), REMEDY


@pytest.mark.parametrize('row', PARAMETERS, ids=lambda row: row.name)
def test_rows_are_complete(row):
    assert row.sentence.endswith('.')
    if row.bounds is not None:
        assert row.bounds[0] <= row.default <= row.bounds[1]
    if row.choices:
        assert row.default in row.choices
    assert row.descriptor().read_only is (row.when == 'start')
    assert 'can be set' in row.descriptor().additional_constraints


def test_defaults_are_the_librarys():
    """The node in its default configuration is the recognizer in its default configuration."""
    from stavpr_ros.alignment import SequenceSettings, SpatialSettings
    from stavpr_ros.recognition import RecognizerSettings

    values = {row.name: row.default for row in PARAMETERS}
    assert SpatialSettings(values['strategy'], values['sigma'], values['xi'] or None) == SpatialSettings()
    assert SequenceSettings(values['sequence_length'], values['beta']) == SequenceSettings()
    assert values['nms_radius'] == RecognizerSettings(1.0).nms_radius
