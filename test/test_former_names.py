# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Former names of the method, and an import of the package that loads nothing for them."""

import importlib
import subprocess
import sys

import pytest
from stavpr_ros import method


@pytest.mark.parametrize('name', ['stavpr_ros.recognition', 'stavpr_ros.filter'])
def test_former_package_warns_and_has_the_names_of_the_method(name, monkeypatch):
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.warns(DeprecationWarning, match=f'{name} is stavpr_ros.method now'):
        former = importlib.import_module(name)
    assert all(getattr(former, each) is getattr(method, each) for each in method.__all__)


def test_import_of_the_package_stays_light():
    code = "import stavpr_ros, sys; print({'numpy', 'stavpr_ros.method'} & {*sys.modules})"
    assert subprocess.check_output([sys.executable, '-c', code], text=True) == 'set()\n'
