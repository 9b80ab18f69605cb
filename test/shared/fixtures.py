# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: the folder of real data, synthetic images and maps."""

from collections import OrderedDict
from contextlib import chdir, contextmanager
from functools import cache
import os
from pathlib import Path
import re
import resource
import sys
from types import SimpleNamespace
from unittest.mock import patch

from domain import DOMAIN
from hypothesis import settings
import numpy as np
import pytest
from stavpr_ros.devices import why_no_cuda
from stavpr_ros.threads import wait_passively

wait_passively()  # torch and numba are not imported yet
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
# of the processes that tests start: the domain, and the modules of this folder
os.environ['ROS_DOMAIN_ID'] = str(DOMAIN)
os.environ['PYTHONPATH'] = os.pathsep.join(
    [str(Path(__file__).parent), *filter(None, [os.environ.get('PYTHONPATH')])]
)
# No deadline: a shared machine may be slow. Examples are random everywhere but in CI, where a
# failure must be reproducible.
settings.register_profile('stavpr', deadline=None, derandomize='CI' in os.environ)
settings.load_profile('stavpr')


ROS_FIXTURES = {'robot', 'context', 'kernels'}
NEEDS_ROS = re.compile(
    r'^ *(import|from) (rclpy|\w+_msgs|robot|processes|subprocess|multiprocessing|launch\w*|'
    r'stavpr_\w+\.(ros|commands)|stavpr_nav|stavpr_lab\.(monitor|demonstration))\b|'
    r'sys\.executable',
    re.MULTILINE,
)


@cache
def needs_ros_or_processes(path: Path) -> bool:
    """Whether a file of tests imports ROS, or what starts a process."""
    return NEEDS_ROS.search(path.read_text()) is not None


def pytest_collection_modifyitems(config, items):
    """
    Mark the tests of ``make check``; run one of several ROS participants again where it fails.

    The latter is ``colcon test --retest-until-pass 1``: discovery and clocks of a busy machine,
    not arithmetic, and nothing else. ``ARGS='--force-reruns 0'`` shows what it covers.
    """
    for item in items:
        if not (needs_ros_or_processes(item.path) or ROS_FIXTURES & {*item.fixturenames}):
            item.add_marker('quick')
    if not config.pluginmanager.hasplugin('rerunfailures'):
        return
    for item in items:
        values = vars(item.module).values()
        starts = any(getattr(value, '__module__', '') == 'processes' for value in values)
        if starts or {'robot', 'context'} & set(item.fixturenames):
            item.add_marker(pytest.mark.flaky(reruns=1))


@pytest.fixture(scope='session')
def data_folder() -> Path:
    """Return the folder of real images and bags: STAVPR_DATA, or the one beside the checkout."""
    default = Path(__file__).resolve().parents[3] / 'shared' / 'data'
    folder = Path(os.environ.get('STAVPR_DATA', default))
    if not folder.is_dir():
        pytest.skip('no data folder')
    return folder


@pytest.fixture(scope='session', autouse=True)
def user_data(tmp_path_factory):
    """Keep the user's own folder of maps out of the tests, also of their processes."""
    os.environ['XDG_DATA_HOME'] = str(tmp_path_factory.mktemp('data'))


def route_images(count: int, seed: int = 0, size: tuple[int, int] = (96, 128)) -> list[np.ndarray]:
    """Return views of one long random texture, each a step further along it, RGB uint8."""
    rng = np.random.default_rng(seed)
    step, (height, width) = 24, size
    coarse = rng.integers(0, 256, (height // 8, (count * step + width) // 8 + 1, 3), np.uint8)
    texture = np.kron(coarse, np.ones((8, 8, 1), np.uint8))
    return [np.ascontiguousarray(texture[:, i * step : i * step + width]) for i in range(count)]


@pytest.fixture(scope='session')
def route() -> list[np.ndarray]:
    """Sixty views of a synthetic route."""
    return route_images(60)


@pytest.fixture(scope='session')
def small_map(route):
    """Return a map of the synthetic route, with all optional parts of a map."""
    from places import poses_at
    from stavpr_ros.features import FeatureExtractor
    from stavpr_ros.mapping import build_map
    from stavpr_ros.sources.frame import Frame

    frames = [Frame(image, (i + 1) * 10**9, f'place {i}') for i, image in enumerate(route)]
    extractor = FeatureExtractor('gradient', projection=64)
    return build_map(frames, extractor, poses_at(range(len(route))), progress=False)


@pytest.fixture(scope='module')
def one_thread():
    """Limit the threads: waiting ones spin, 100 ms an image on a busy machine."""
    from stavpr_ros.threads import limit_threads

    limit_threads(1)
    yield
    limit_threads(0)


@pytest.fixture(params=['cpu', 'cuda'][: 1 + (not why_no_cuda())])
def device(request):
    """Return each device of torch here: the CPU, and CUDA where there is one."""
    import torch

    return torch.device(request.param)


@pytest.fixture
def environ():
    """Return the environment of this process, which is as before after the test."""
    with patch.dict(os.environ):
        yield os.environ


@pytest.fixture
def working_folder(tmp_path):
    """Change into the folder of the test, and return it."""
    with chdir(tmp_path):
        yield tmp_path


@pytest.fixture
def hide_module(monkeypatch):
    """Return a function that lets a module be not installed."""
    return lambda name: monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def set_constants(monkeypatch):
    """Return a function that gives constants of a module other values for the test."""

    def set_constants(module, **values):
        for name, value in values.items():
            monkeypatch.setattr(module, name, value)

    return set_constants


@pytest.fixture
def model_folders(tmp_path, environ):
    """Set the folders of models and of downloads, and return both."""
    environ['STAVPR_MODELS'] = str(tmp_path / 'models')
    environ['XDG_CACHE_HOME'] = str(tmp_path / 'cache')
    return tmp_path / 'models', tmp_path / 'cache' / 'stavpr_ros'


@contextmanager
def disk_of(size: int):
    """Let no file of this process be larger, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def runner(monkeypatch, capsys):
    """Make functions that run a command in this process: exit code, output, errors."""
    monkeypatch.setattr('stavpr_ros.commands.program.obey_signals', lambda: None)

    def make(command):
        def run(*arguments):
            try:
                code = command.main([str(argument) for argument in arguments])
            except SystemExit as error:  # argparse
                code = error.code
            return code, *capsys.readouterr()

        def fails(code, words, *arguments):
            status, _, errors = run(*arguments)
            assert (status, words in errors) == (code, True), errors

        run.fails = fails  # expects an exit code, and words in the errors
        return run

    return make


@pytest.fixture
def context():
    """Yield an initialized ROS context."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    yield context
    rclpy.try_shutdown(context=context)


@pytest.fixture
def default_context():
    """Yield the default ROS context, initialized."""
    import rclpy

    rclpy.init(domain_id=DOMAIN)
    yield rclpy.get_default_context()
    rclpy.try_shutdown()


@pytest.fixture
def image_input(context, request):
    """Return the input of a node, by its transport: images are ``passed`` on or ``rejected``."""
    from stavpr_ros.pipeline.statistics import Statistics
    from stavpr_ros.ros.input import ImageInput
    from stavpr_ros.ros.rclpy_workarounds import ManagedNode

    node, transport = ManagedNode('n', context=context), getattr(request, 'param', 'raw')
    settings = SimpleNamespace(image_transport=transport, max_rate=0.0, max_stamp_gap=2.0)
    passed, rejected, statistics = [], [], Statistics()
    calls = (
        (lambda message, _: passed.append(message)),
        lambda message, _: rejected.append(message),
    )
    images = ImageInput(node, settings, statistics, *calls, print)
    images.passed, images.rejected, images.statistics = passed, rejected, statistics
    yield images
    images.close()
    node.destroy_node()


@pytest.fixture
def make_node(context, request):
    """Make a node that is not configured; it is destroyed with the test."""
    from robot import PARAMETERS, parameters_of
    from stavpr_ros.ros.node import PlaceRecognitionNode

    def make(**parameters):
        overrides = parameters_of(PARAMETERS | {'autostart': False} | parameters)
        node = PlaceRecognitionNode(context=context, parameter_overrides=overrides)
        request.addfinalizer(node.destroy_node)
        return node

    return make


@pytest.fixture(scope='session')
def kernels():
    """Compile the kernels: on a busy machine, this takes longer than tests wait for a node."""
    from stavpr_ros.commands.warm import main

    assert main([]) == 0


@pytest.fixture(scope='module')
def robot(kernels):
    """Yield a robot with a camera: a ROS node beside the tested one."""
    from robot import Robot

    robot = Robot()
    yield robot
    robot.close()


@pytest.fixture(scope='module')
def map_file(small_map, tmp_path_factory) -> str:
    """Save that map in a file."""
    from stavpr_ros.mapping import save_map

    path = tmp_path_factory.mktemp('map') / 'route.stavpr'
    save_map(small_map, path)
    return str(path)


@pytest.fixture
def start(robot, map_file, tmp_path_factory, request):
    """Start a node in this process that localizes on the map; it ends with the test."""
    from robot import NodeThread

    def start(*arguments, wait=True, **parameters):
        robot.forget()
        files = {'map_path': map_file, 'maps_folder': str(tmp_path_factory.getbasetemp())}
        thread = NodeThread(robot.context, arguments, files | parameters)
        request.addfinalizer(thread.end)
        if wait:
            robot.wait_for_node()
        return thread.node

    yield start
    robot.wait_for_nobody()


@pytest.fixture(scope='module')
def node_of_file(robot, map_file, tmp_path_factory):
    """Start the node that the tests of a file share; see ``running``."""
    from robot import NodeThread

    robot.forget()
    files = {'map_path': map_file, 'maps_folder': str(tmp_path_factory.getbasetemp())}
    thread = NodeThread(robot.context, [], files)
    robot.wait_for_node()
    yield thread.node
    thread.end()
    robot.wait_for_nobody()


@pytest.fixture
def running(robot, node_of_file):
    """Return that node; its window is empty, and parameters are as at its start, also after."""
    from stavpr_ros.parameters import PARAMETERS
    from std_srvs.srv import Trigger

    def values():
        return {row.name: node_of_file.get_parameter(row.name).value for row in PARAMETERS}

    robot.stamp += 10**10
    robot.does(Trigger, 'reset')
    before = values()
    yield node_of_file
    after = values()
    robot.set(**{name: value for name, value in before.items() if value != after[name]})


@pytest.fixture
def squeezenet_settings(data_folder):
    """Return the settings of the data folder's network, layer fire6/concat, 13 x 13 x 384."""
    pytest.importorskip('onnxruntime', reason='the extra onnx is not installed')
    from stavpr_ros.features.registry import settings_class

    return settings_class('onnx')(
        model=str(data_folder / 'squeezenet1_1_imagenet' / 'squeezenet_fp16.onnx'),
        layer='fire6/concat_1',
        channels='bgr',
        scale=1.0,
        mean=(104, 117, 123),
        std=(1, 1, 1),
    )


@pytest.fixture(scope='session')
def densenet_parameters():
    """Random parameters of DenseNet161, equal to the bit on every machine."""
    from checkpoints import random_parameters
    import networks

    return random_parameters(networks.densenet161_shapes())


@pytest.fixture(scope='session')
def densenet_file(densenet_parameters, tmp_path_factory) -> Path:
    """Their checkpoint as published: of Python 2, old names, a prefix, tensors of a GPU."""
    from checkpoints import places365_file

    path = tmp_path_factory.mktemp('weights') / 'densenet161_places365.pth.tar'
    path.write_bytes(places365_file(densenet_parameters))
    return path


@pytest.fixture(scope='session')
def vgg_parameters():
    """Random parameters of VGG16, equal to the bit on every machine."""
    from checkpoints import random_parameters
    import networks

    return random_parameters(networks.vgg16_shapes())


@pytest.fixture(scope='session')
def vgg_file(vgg_parameters, tmp_path_factory) -> Path:
    """Their checkpoint, of Python 2 as the published one."""
    from checkpoints import OldPickle

    path = tmp_path_factory.mktemp('weights') / 'vgg16.pth'
    path.write_bytes(OldPickle().file(OrderedDict(vgg_parameters)))
    return path
