# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What each package installs and depends on, its entry points, and the command stavpr."""

import ast
from contextlib import chdir
from functools import partial
from importlib import import_module
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
from xml.etree import ElementTree
import zipfile

from catkin_pkg.changelog import get_changelog_from_path
from interface_packages import INTERFACES
import pytest
import setuptools
import stavpr_ros
from stavpr_ros import plugins
from stavpr_ros.commands import program, stavpr
from stavpr_ros.compilation import CACHE
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.registry import backbone_class, kinds, settings_class
from stavpr_ros.mapping import save_map
from stavpr_ros.mapping.stores import is_address, store_of

ROOT = Path(__file__).resolve().parents[1]
SIBLINGS = ('stavpr_fleet', 'stavpr_slam', 'stavpr_nav', 'stavpr_lab')
PACKAGES = {'stavpr_ros': ROOT} | {name: ROOT / name for name in SIBLINGS}
FOLDERS = [*PACKAGES.values(), ROOT / 'stavpr_msgs']
EXTRAS = ('onnx', 'hdf5', 'heif', 'faiss', 'fleet', 'ray', 'slam', 'torch', 'video')

# Import name: distribution on PyPI, where they differ.
DISTRIBUTIONS = {
    'cv2': 'opencv-python-headless',
    'faiss': 'faiss-cpu',
    'qdrant_client': 'qdrant-client',
    'qdrant_edge': 'qdrant-edge-py',
    'PIL': 'pillow',
    'pillow_heif': 'pillow-heif',
    'sklearn': 'scikit-learn',
    'yaml': 'PyYAML',
}
ROS = re.compile(
    r'\w+_(msgs|srvs|interfaces)|bond|rclpy|launch|launch_ros|ament_index_python|tf2_ros'
)
ROS_PACKAGES = {'tf2_ros': 'tf2_ros_py'}  # of modules of another name

each_package = pytest.mark.parametrize('package', PACKAGES)


def distribution(package: str) -> setuptools.Distribution:
    """Return what setup.py passes to setuptools."""
    import distutils.core  # of setuptools, which is imported above

    with chdir(PACKAGES[package]):
        return distutils.core.run_setup('setup.py', stop_after='init')


def imported_names(folder: Path) -> set[str]:
    """Return the top-level names that the Python files of a folder import, wherever they do."""
    names = set()
    for path in folder.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names.add((node.module or '').partition('.')[0])
    return names - set(sys.stdlib_module_names)


def manifest(path: Path) -> ElementTree.Element:
    return ElementTree.parse(path / 'package.xml').getroot()


def declared_names(package: str, *tags: str) -> set[str]:
    root = manifest(PACKAGES[package])
    return {element.text for tag in tags for element in root.findall(tag)}


def imports_of(package: str) -> set[str]:
    """Return what a package imports besides itself."""
    return imported_names(PACKAGES[package] / package) - {package}


@each_package
def test_every_imported_distribution_is_required(package):
    stated = distribution(package)
    extras = stated.extras_require
    lines = sum((extras.get(extra, []) for extra in EXTRAS), [*stated.install_requires])
    required = {re.match(r'[\w-]+', line).group().lower() for line in lines}
    needed = {name for name in imports_of(package) if not ROS.fullmatch(name)}
    needed -= {'stavpr_slam', 'stavpr_nav'}
    assert needed  # the search works
    assert {DISTRIBUTIONS.get(name, name).lower() for name in needed} - required == set()


@each_package
def test_every_imported_ros_package_is_dependency(package):
    folder = PACKAGES[package]
    run = imports_of(package) | imported_names(folder / 'launch')
    needed = {ROS_PACKAGES.get(name, name) for name in run if ROS.fullmatch(name)}
    assert needed - declared_names(package, 'exec_depend', 'depend') == set()
    tests = {name for name in imported_names(folder / 'test') if ROS.fullmatch(name)}
    tests -= INTERFACES.keys()  # built by the tests
    assert tests - declared_names(package, 'exec_depend', 'depend', 'test_depend') == set()


def test_versions_agree():
    versions = [manifest(folder).findtext('version') for folder in FOLDERS]
    citation = (ROOT / 'CITATION.cff').read_text(encoding='utf-8')
    versions.append(re.search(r'^version: (.+)$', citation, re.MULTILINE).group(1))
    versions += [distribution(package).metadata.version for package in PACKAGES]
    assert set(versions) == {stavpr_ros.__version__}
    for folder in FOLDERS:
        changelog = get_changelog_from_path(folder)
        newest = next(version for version, date, _ in changelog.foreach_version() if date)
        assert newest == stavpr_ros.__version__
        assert changelog.get_content_of_version(newest)


@pytest.fixture(scope='module')
def sources(tmp_path_factory) -> Path:
    """Copy the repository as far as the packages are made of it."""
    root = tmp_path_factory.mktemp('sources') / 'stavpr_ros'
    unwanted = ('.*', '__pycache__', 'build', 'install', 'log', 'docs', 'test', 'benchmarks')
    shutil.copytree(ROOT, root, ignore=shutil.ignore_patterns(*unwanted))
    return root


def run_setup(folder: Path, *arguments: str, prefix: str | None = None, **variables: str) -> str:
    command = [sys.executable, '-W', 'ignore', 'setup.py', '--quiet', *arguments]
    environment = os.environ | ({'AMENT_PREFIX_PATH': prefix} if prefix else {}) | variables
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def colcon_arguments(folder: Path) -> list[str]:
    """Return the arguments that colcon passes to setup.py."""
    build = ['build', '--build-base', str(folder / 'build'), 'install', '--prefix', str(folder)]
    return [*build, '--record', str(folder / 'log'), '--single-version-externally-managed']


def test_build_by_colcon_fills_the_cache_of_kernels(sources, tmp_path):
    assert CACHE is not None
    cache = CACHE.parent  # a filled one; by default, it would be in the installed package
    printed = run_setup(sources, *colcon_arguments(tmp_path), NUMBA_CACHE_DIR=str(cache))
    assert printed.splitlines()[-1] == f'the kernels are in {CACHE}'


def test_wheel_has_every_file_of_the_packages_and_their_entry_points(sources, tmp_path):
    """``pip install .`` gives ``stavpr evaluate``, without an order of builds as colcon has."""
    run_setup(sources, 'bdist_wheel', '--dist-dir', str(tmp_path), prefix='/opt/ros/jazzy')
    (wheel,) = tmp_path.glob('*.whl')
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (file,) = (name for name in names if name.endswith('entry_points.txt'))
        entries = archive.read(file).decode()
    for package, folder in PACKAGES.items():
        files = [path for path in (folder / package).rglob('*') if path.is_file()]
        files = [path for path in files if '__pycache__' not in path.parts]  # kernels as well
        wanted = {str(path.relative_to(folder)) for path in files}
        assert f'{package}/py.typed' in wanted
        assert wanted <= names
    for package in SIBLINGS:
        table = (PACKAGES[package] / 'setup.cfg').read_text(encoding='utf-8')
        for line in re.findall(r'^    ([\w+]+ = .*)$', table, re.MULTILINE):
            assert line in entries


@pytest.fixture
def no_plugins(monkeypatch):
    """Hide the entry points of all packages."""
    monkeypatch.setattr(plugins, 'load', lambda group: {})


def test_stavpr_without_a_package_names_it(no_plugins, capsys):
    assert stavpr.main(['evaluate']) == 2
    assert 'in the package stavpr_lab' in capsys.readouterr().err
    assert stavpr.main([]) == stavpr.main(['evaluat']) == 2
    assert 'choose from build_map' in capsys.readouterr().err


@pytest.mark.parametrize('module', program.OPTIONAL)
def test_a_command_without_an_optional_module_names_its_package(
    hide_module, monkeypatch, capsys, module
):
    """The module is missing while the command is imported, or while it runs, or a part of it."""
    hide_module(module)
    package = program.OPTIONAL[module]
    sentence = f'this needs {package}, which is not installed: pip install {package}'
    assert program.run_program('work', partial(import_module, f'{module}.part')) == 1
    with pytest.raises(UnavailableError, match=re.escape(sentence)):
        program.require_modules('json', module)
    monkeypatch.setattr(stavpr.importlib, 'import_module', lambda _: import_module(module))
    assert stavpr.main(['map', 'info', 'x']) == 1
    assert capsys.readouterr().err == f'work: {sentence}\nstavpr: {sentence}\n'
    with pytest.raises(ModuleNotFoundError):  # of an error of this package
        program.run_program('work', lambda: import_module('stavpr_ros.nothing'))


@pytest.mark.parametrize(('module', 'words'), [
    ('sklearn', 'evaluate --truth identity --json x --map monday.stavpr --query nowhere'),
    ('matplotlib', 'evaluate --output report --map monday.stavpr --query nowhere'),
    ('jinja2', 'evaluate --map monday.stavpr --query nowhere'),
    ('matplotlib', 'map info --plot map.png monday.stavpr'),
])  # fmt: skip
def test_a_report_without_its_packages_is_refused_before_any_work(
    hide_module, monkeypatch, capsys, working_folder, small_map, module, words
):
    save_map(small_map, 'monday.stavpr')
    for name in [n for n in sys.modules if re.match(rf'{module}\b|stavpr_lab.map_p', n)]:
        monkeypatch.delitem(sys.modules, name)
    hide_module(module)
    assert stavpr.main(words.split()) == 1
    assert 'which is not installed: pip install ' in capsys.readouterr().err


def test_script_of_setuptools_lets_pkg_resources_be_imported():
    """Where Debian provides a requirement under another name: here one that is nowhere."""
    script = (
        "__requires__ = 'no-such-distribution==1'\n"
        'from stavpr_ros.commands.stavpr import main\n'
        "main(['--help'])\n"
        'import pkg_resources\n'
    )
    command = [sys.executable, '-W', 'ignore', '-c', script]
    result = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr


def test_stavpr_without_ros_names_missing_modules(monkeypatch, capsys):
    monkeypatch.setattr(stavpr.importlib.util, 'find_spec', lambda _: None)
    for name in ('node', 'replay', 'record'):
        assert stavpr.main([name]) == 2
        assert re.search(r'rclpy.*setup\.bash', capsys.readouterr().err, re.DOTALL)


@pytest.mark.parametrize('name', ['record', 'replay', 'monitor', 'bridge', 'build_map', 'map'])
def test_command_without_docstrings_and_letters_explains_itself(name):
    """Python -OO removes docstrings; a terminal of LC_ALL=C has ASCII only."""
    code = f'import sys; from stavpr_ros.commands import stavpr; sys.exit(stavpr.main(["{name}", '
    env = os.environ | {'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'}
    for words, expected in (('"--help"', 0), ('"caf\\u00e9", "--none"', 2)):
        command = [sys.executable, '-OO', '-c', f'{code}{words}]))']
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        assert (done.returncode, 'Traceback' in done.stderr) == (expected, False), done.stderr


MODULE = """
from stavpr_ros.commands import Command
from stavpr_ros.features.registry import GradientSettings, Kind
from stavpr_ros.mapping.stores import Store

COMMANDS = {'hello': Command('plugged', 'greet'), 'node': Command('plugged', 'not this one')}
KIND = Kind(GradientSettings, 'stavpr_ros.features.gradient:Gradient')
STORE = Store(open_map=lambda address: address, upload=lambda *_: None)
main = lambda arguments: len(arguments)
"""
ENTRY_POINTS = """
[stavpr.commands]
plugged = plugged:COMMANDS
broken = plugged:MISSING

[stavpr.features]
plain = plugged:KIND

[stavpr.stores]
drawer = plugged:STORE
"""


@pytest.fixture
def plugged(tmp_path, monkeypatch):
    """Install a package with entry points."""
    (tmp_path / 'plugged.py').write_text(MODULE)
    info = tmp_path / 'plugged-1.0.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: plugged\nVersion: 1.0\n')
    (info / 'entry_points.txt').write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(tmp_path)
    plugins.load.cache_clear()
    yield
    plugins.load.cache_clear()


def test_entry_points_of_another_package_are_used_and_replace_none(plugged, capsys, caplog):
    """A command, a store and a kind of features; a broken one is named and skipped."""
    assert stavpr.main(['hello', 'a', 'b']) == 2
    stavpr.main(['--help'])
    assert 'greet' in capsys.readouterr().out
    assert stavpr.all_commands()['node'].module == 'stavpr_ros.commands.node'
    assert plugins.load(plugins.COMMANDS).keys() & {'plugged', 'broken'} == {'plugged'}
    assert 'plug-in broken of plugged (plugged:MISSING): AttributeError' in caplog.text
    assert is_address('drawer:socks')
    assert store_of('drawer:socks').open_map('drawer:socks') == 'drawer:socks'
    assert 'plain' in kinds()
    assert settings_class('plain').__name__ == 'GradientSettings'
    assert backbone_class('plain').__name__ == 'Gradient'


def test_unknown_scheme_lists_known_ones():
    assert not is_address('drawer:socks')
    with pytest.raises(SettingsError, match=r'drawer:socks is no address.*faiss:, qdrant:'):
        store_of('drawer:socks')


@pytest.mark.parametrize('address', ['faiss:FILE', 'qdrant:FOLDER', 'qdrant+https://HOST:1/NAME'])
def test_address_without_stavpr_fleet_names_it(no_plugins, address):
    assert is_address(address)
    with pytest.raises(UnavailableError, match=r"the package stavpr_fleet.*install '\.\[fleet\]'"):
        store_of(address)


def test_kind_of_a_missing_package_names_it(no_plugins):
    with pytest.raises(SettingsError, match='in the package stavpr_lab'):
        settings_class('vgg16')
    with pytest.raises(SettingsError, match=r"'teleport'.*take one of gradient"):
        settings_class('teleport')
