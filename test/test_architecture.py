# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The order of the packages and their folders, cycles, and former names."""

import ast
from graphlib import TopologicalSorter
import importlib
from operator import attrgetter
import os
from pathlib import Path
import re
import subprocess
import sys

from ceilings import CEILINGS, excess, sizes
from evaluation_commands import write_images
import numpy as np
import pytest
from stavpr_ros import method
from stavpr_ros.former import CLASSES, FIELDS
from stavpr_ros.method import localizer, Match, Status
from stavpr_ros.method import Path as MatchPath
from stavpr_ros.pipeline import ImageResult

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'stavpr_ros'
PACKAGES = ('stavpr_msgs', 'stavpr_ros', 'stavpr_fleet', 'stavpr_slam', 'stavpr_nav', 'stavpr_lab')
"""Each may import those before it, except as in BESIDE."""
BESIDE = {'stavpr_fleet', 'stavpr_slam', 'stavpr_nav'}
"""Packages that do not import each other."""
FOLDERS = {name: ROOT / name / name for name in PACKAGES[2:]} | {'stavpr_ros': PACKAGE}
TESTS = {name: ROOT / name / 'test' for name in PACKAGES[2:]} | {'stavpr_ros': ROOT / 'test'}
NEED_SLAM = {'demonstration/slam.py'}
"""Modules of stavpr_lab that need stavpr_slam, imported within functions only."""
ROS = {'rclpy', 'ament_index_python', 'stavpr_msgs', 'rcl_interfaces', 'builtin_interfaces'}
ROS |= {
    f'{name}_msgs'
    for name in ('std', 'sensor', 'geometry', 'nav', 'diagnostic', 'lifecycle', 'visualization')
}
CORE = {
    *('alignment', 'sources', 'features', 'mapping', 'prepare', 'method'),
    *('maintenance', 'relative_pose', 'pipeline'),
}
MAY_IMPORT = {
    'alignment': set(),
    'sources': set(),
    'features': set(),
    'mapping': {'alignment', 'sources', 'features'},
    'prepare': {'alignment', 'features', 'mapping'},
    'method': {'alignment', 'features', 'mapping', 'prepare'},
    'maintenance': {'alignment', 'features', 'mapping', 'prepare', 'method'},
    'stavpr_fleet': {'alignment', 'features', 'mapping', 'prepare', 'method'},
    'relative_pose': {'alignment', 'features', 'mapping', 'method'},
    'pipeline': CORE - {'pipeline'},
    'ros': CORE,
    'commands': {'ros', *CORE},
}
MODULES = {
    '.'.join(path.relative_to(folder.parent).with_suffix('').parts).removesuffix('.__init__'): path
    for folder in FOLDERS.values()
    for path in sorted(folder.rglob('*.py'))
}


MAKERS = {'mapping.builder', 'mapping.map_file', 'maintenance.same_places'}
FACTORIES = {'stavpr_ros.mapping.place_map': {f'stavpr_ros.{name}' for name in MAKERS}}
"""Modules that make and store what a module defines: for its methods, imported on use."""


def imported_modules(path: Path, at_top: bool = False) -> set[str]:
    """Modules that a file imports, at its top or in a function."""
    modules = set()
    tree = ast.parse(path.read_text())
    for node in tree.body if at_top else ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names = {f'{node.module}.{alias.name}' for alias in node.names}
            modules |= (names & MODULES.keys()) or {node.module or ''}
    return modules


@pytest.mark.parametrize('package', FOLDERS)
def test_package_and_its_tests_import_only_those_below_it(package):
    above = {*PACKAGES[PACKAGES.index(package) + 1 :]}
    if package in BESIDE:
        above |= BESIDE - {package}
    for folder in (FOLDERS[package], TESTS[package]):
        files = sorted(folder.rglob('*.py'))
        assert files
        for path in files:
            found = {module.split('.')[0] for module in imported_modules(path)}
            assert not found & above, f'{path} imports {found & above}'


def test_slam_is_optional_for_the_laboratory():
    folder = FOLDERS['stavpr_lab']
    optional = {name for name, path in MODULES.items() if path in {folder / x for x in NEED_SLAM}}
    for path in set(folder.rglob('*.py')) - {MODULES[name] for name in optional}:
        modules = imported_modules(path, at_top=True)
        assert not modules & optional, path
        assert not {module for module in modules if module.startswith('stavpr_slam')}, path


@pytest.mark.parametrize('folder', list(MAY_IMPORT))
def test_folder_imports_only_those_below_it(folder):
    files = sorted(FOLDERS.get(folder, PACKAGE / folder).rglob('*.py'))
    assert files
    for path in files:
        factories = (names for name, names in FACTORIES.items() if MODULES[name] == path)
        for module in imported_modules(path).difference(*factories):
            parts = module.split('.')
            if parts[0] == 'stavpr_ros' and len(parts) > 1 and parts[1] in MAY_IMPORT:
                assert parts[1] in MAY_IMPORT[folder] | {folder}, f'{path} imports {module}'
            if folder not in ('ros', 'commands'):
                assert parts[0] not in ROS, f'{path} imports {module}'


def test_folders_are_those_of_plan():
    folders = {path.name for path in PACKAGE.iterdir() if (path / '__init__.py').exists()}
    assert folders == MAY_IMPORT.keys() - FOLDERS.keys()


def test_package_and_parameters_import_lightly():
    code = 'import sys, stavpr_ros.parameters; print(*sys.modules)'
    loaded = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    ).stdout
    assert not {'torch', 'numba', 'numpy', 'cv2', 'rclpy', 'rosbags'} & set(loaded.split())


@pytest.mark.usefixtures('kernels')
def test_mapping_and_localization_with_gradient_load_no_torch(tmp_path):
    """
    Nor what reads other inputs; a folder of images to a map, and the map to a match.

    Where torch is not installed and a driver of CUDA is, as on a Jetson; the memory stays
    small, once the kernels are compiled.
    """
    noise = np.random.default_rng(0).integers(0, 256, (40, 48, 64, 3), np.uint8)
    folder = str(write_images(tmp_path / 'images', noise))
    code = f"""
import ctypes, sys
library = ctypes.CDLL
ctypes.CDLL = lambda name, *rest: library(None if name == 'libcuda.so.1' else name, *rest)
sys.modules['torch'] = None  # it cannot be imported
from stavpr_ros import images, Localizer, Map
from stavpr_ros.commands.build_map import main
from stavpr_ros.devices import choose_backend, choose_device, why_no_cuda
from stavpr_ros.pipeline import Pipeline
output = ['--output', {str(tmp_path / 'map')!r}, '--features', 'gradient']
assert main(['--input', {folder!r}, *output]) == 0
localizer = Localizer(Map.load({str(tmp_path / 'map')!r}))
for image in images({folder!r}):
    match = localizer(image)
assert choose_backend('auto') == choose_device('auto') == 'cpu'
assert 'torch cannot be imported' in why_no_cuda()
loaded = [*sys.modules.keys() - {{'torch'}}]
import stavpr_ros.ros.node, stavpr_ros.commands.replay, stavpr_ros.commands.record
unused = {{'pandas', 'onnxruntime', 'av', 'h5py', 'faiss', 'ray', 'gtsam', 'matplotlib'}}
assert not unused & sys.modules.keys()
status = open('/proc/self/status').read()
peak = int(status.partition('VmHWM:')[2].split()[0])
assert peak < 300_000, f'{{peak}} kB'
print('\\n', match.status.name, *loaded)
"""
    command = [sys.executable, '-c', code]  # elsewhere: of the installed package, as the kernels
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    status, *loaded = done.stdout.splitlines()[-1].split()
    assert status in ('MATCH', 'NO_MATCH')
    assert not {'torch', 'rosbags', 'rclpy', 'onnx', 'matplotlib', 'sklearn'} & set(loaded)


def test_modules_import_each_other_without_cycles():
    """Also by imports within functions; a name that __init__ re-exports counts as its module's."""
    arrows = {
        module: imported_modules(path) & MODULES.keys() - {module}
        for module, path in MODULES.items()
    }
    for module, factories in FACTORIES.items():
        assert not factories & imported_modules(MODULES[module], at_top=True)
        arrows[module] -= factories
    TopologicalSorter(arrows).prepare()  # raises CycleError


def test_size_above_its_ceiling_is_named():
    assert not list(excess({'lines': 10}, {'lines': 10}))
    (sentence,) = excess({'lines': 10, 'numbers': 3}, {'lines': 7, 'numbers': 3})
    assert sentence.startswith('10 lines, 3 above the ceiling 7')
    assert sizes().keys() == CEILINGS.keys()


# Former names of packages, classes and results, and an import that loads nothing for them


@pytest.mark.parametrize('name', ['stavpr_ros.recognition', 'stavpr_ros.filter'])
def test_former_package_warns_and_has_the_names_of_the_method(name, monkeypatch):
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.warns(DeprecationWarning, match=f'{name} is stavpr_ros.method now'):
        former = importlib.import_module(name)
    assert all(getattr(former, name) is getattr(method, name) for name in method.__all__)


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
    match = Match(Status.MATCH, path=MatchPath(np.array([[0, 7], [1, 9]]), 7), probability=0.9)
    result = {'Path': match.path, 'Match': match, 'ImageResult': ImageResult(match)}[kind]
    for name, field in FIELDS[kind].items():
        with pytest.warns(DeprecationWarning, match=f'{kind}.{name} is {field} now'):
            former = getattr(result, name)
        assert repr(former) == repr(attrgetter(field)(result))
    with pytest.raises(AttributeError, match=f"{kind} has no attribute 'typo'"):
        _ = result.typo


@pytest.mark.parametrize(
    ('code', 'unused'),
    [
        ('import stavpr_ros', {'numpy', 'stavpr_ros.api'}),
        ('from stavpr_ros.commands import node; node._import_numba()', {'scipy', 'coverage'}),
    ],
)
def test_imports_stay_light(code, unused):
    code += f'; import sys; print({unused} & {{*sys.modules}})'
    variables = {name: os.environ[name] for name in os.environ if not name.startswith('COV_')}
    run = [sys.executable, '-c', code]
    assert subprocess.check_output(run, text=True, env=variables) == 'set()\n'


# The diagram of the chain in docs/architecture.md

CHAIN = {'update', 'push', '_z', 'add', 'assess', '_assess', '_compare', '_match', '_decide'}
OBJECTS = 'centering|matcher|motion|change|filter|cells|means|recent|limits|quantities'
IN_CHAIN = re.compile(rf'(?:self\.)?_?((?:{OBJECTS})\.[a-z]\w*)')


def calls_of(name, methods, functions):
    """Yield what a method of the chain calls, in order, with its other methods in their place."""
    calls = [node for node in ast.walk(methods[name]) if isinstance(node, ast.Call)]
    for call in sorted(calls, key=lambda node: (node.end_lineno, node.end_col_offset)):
        text = ast.unparse(call.func)
        if (method := text.rpartition('.')[2]) in CHAIN and not IN_CHAIN.fullmatch(text):
            yield from calls_of(method, methods, functions)
        elif (match := IN_CHAIN.fullmatch(text)) or text in functions:
            yield match[1].removeprefix('_') if match else text


def test_diagram_of_the_chain_has_all_steps_and_calls_of_the_code_in_order():
    methods, functions = {}, set()
    for file in ('window', 'localizer'):  # SequenceRecognizer._match is the step, not the window's
        for node in ast.walk(ast.parse((PACKAGE / f'method/{file}.py').read_text())):
            if isinstance(node, ast.FunctionDef) and node.name in CHAIN:
                methods[node.name] = node
            elif isinstance(node, ast.ImportFrom) and re.search('method|prepare', node.module):
                functions |= {alias.name for alias in node.names if alias.name.islower()}
    text = (ROOT / 'docs' / 'architecture.md').read_text()
    diagram = re.search(r'```\n( strips -> .*?)```', text, re.DOTALL)[1]
    steps = re.findall(r'(\d) (\w+) +(.+?):', diagram, re.DOTALL)
    called = [name for *_, names in steps for name in re.split(r',\s+', names)]
    assert called == list(dict.fromkeys(calls_of('update', methods, functions)))
    documented = re.findall(r'^(\d)\. \*\*(\w+)\*\*', localizer.__doc__.lower(), re.MULTILINE)
    assert [step[:2] for step in steps] == documented
