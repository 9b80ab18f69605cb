# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Former names of packages, classes and results, and an import that loads nothing for them."""

import importlib
from operator import attrgetter
import subprocess
import sys

import numpy as np
import pytest
from stavpr_ros import method
from stavpr_ros.former import CLASSES, FIELDS
from stavpr_ros.method import Match, Path, Status
from stavpr_ros.pipeline import ImageResult


@pytest.mark.parametrize('name', ['stavpr_ros.recognition', 'stavpr_ros.filter'])
def test_former_package_warns_and_has_the_names_of_the_method(name, monkeypatch):
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.warns(DeprecationWarning, match=f'{name} is stavpr_ros.method now'):
        former = importlib.import_module(name)
    assert all(getattr(former, each) is getattr(method, each) for each in method.__all__)


@pytest.mark.parametrize('module', CLASSES)
def test_former_class_warns_and_is_the_present_one(module):
    for name, present in CLASSES[module].items():
        with pytest.warns(DeprecationWarning, match=f'{module}.{name} is {present} now'):
            former = getattr(importlib.import_module(module), name)
        assert former is getattr(importlib.import_module(module), present)
    with pytest.raises(AttributeError, match=f"module '{module}' has no attribute 'typo'"):
        _ = importlib.import_module(module).typo


@pytest.mark.parametrize('kind', FIELDS)
def test_former_field_warns_and_is_the_present_one(kind):
    match = Match(Status.MATCH, path=Path(np.array([[0, 7], [1, 9]]), 7), probability=0.9)
    result = {'Path': match.path, 'Match': match, 'ImageResult': ImageResult(match)}[kind]
    for name, field in FIELDS[kind].items():
        with pytest.warns(DeprecationWarning, match=f'{kind}.{name} is {field} now'):
            former = getattr(result, name)
        assert repr(former) == repr(attrgetter(field)(result))
    with pytest.raises(AttributeError, match=f"{kind} has no attribute 'typo'"):
        _ = result.typo


def test_import_of_the_package_stays_light():
    code = "import stavpr_ros, sys; print({'numpy', 'stavpr_ros.api'} & {*sys.modules})"
    assert subprocess.check_output([sys.executable, '-c', code], text=True) == 'set()\n'
