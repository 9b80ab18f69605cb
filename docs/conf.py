# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sphinx configuration, used by ``make docs`` and by rosdoc2."""

from importlib.util import find_spec
from pathlib import Path
import sys
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ('.', 'stavpr_fleet', 'stavpr_slam', 'stavpr_nav', 'stavpr_lab')
sys.path[:0] = [str(ROOT / folder) for folder in PACKAGES]

project = 'stavpr_ros'
author = 'The stavpr_ros authors'
copyright = '2026, The stavpr_ros authors'  # noqa: A001
release = version = ElementTree.parse(ROOT / 'package.xml').findtext('version')

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.viewcode']
source_suffix = {'.rst': 'restructuredtext', '.md': 'markdown'}
exclude_patterns = ['_build']
myst_heading_anchors = 3
# The pages link to files of the repository as well; on the repository's own site these links work.
suppress_warnings = ['myst.xref_missing']

autodoc_default_options = {'members': True, 'show-inheritance': True, 'member-order': 'bysource'}
autodoc_typehints = 'description'
autodoc_typehints_description_target = 'documented'
autodoc_mock_imports = ['onnx', 'onnxruntime', 'sklearn', 'jinja2']
# Debian has no current furo: rosdoc2 builds with the theme of Sphinx.
html_theme = 'furo' if find_spec('furo') else 'alabaster'
html_title = 'stavpr_ros'
