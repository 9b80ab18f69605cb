# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features of TorchScript files: outputs and inner modules, traced and scripted, errors."""

from dataclasses import replace
import json

import numpy as np
import pytest
from stavpr_ros.errors import FeatureMismatchError, SettingsError, UnavailableError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import backbone_class, settings_class
from stavpr_ros.parameters import BY_NAME
from stavpr_ros.pipeline import PipelineSettings
import torch
from torch import nn

pytestmark = pytest.mark.filterwarnings('ignore:.torch.jit:DeprecationWarning')


class Block(nn.Module):
    """Two convolutions that share a ReLU; ``unused`` is never called."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, 4, 3, padding=1)
        self.second = nn.Conv2d(4, 5, 3, stride=2, padding=1)
        self.relu, self.unused = nn.ReLU(), nn.ReLU()

    def forward(self, x, shift):
        return self.relu(self.second(self.relu(self.first(x)))) + shift


class Net(nn.Module):
    """A block in a block, then layers for one size of images only."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.ModuleDict({'block': Block(), 'last': nn.Conv2d(5, 6, 1)})
        self.head = nn.Linear(6 * 8 * 8, 10)

    def forward(self, x):
        x = self.body['last'](self.body['block'](x, x.mean()))
        return self.head(x.flatten(1))


class Branch(nn.Module):
    """Calls its layer only in a branch."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Conv2d(3, 4, 1)

    def forward(self, x):
        if x.shape[0] > 0:
            x = self.layer(x)
        return x


class Spoiled(nn.Module):
    """Overwrites the input of its layer after the layer."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Identity()

    def forward(self, x):
        y = x + 1
        return self.layer(y) + y.mul_(0)


@pytest.fixture(scope='module')
def net():
    torch.manual_seed(0)
    return Net().eval()


@pytest.fixture(scope='module', params=['traced', 'scripted'])
def file(request, net, tmp_path_factory):
    path = tmp_path_factory.mktemp('script') / f'{request.param}.pt'
    script = (
        torch.jit.trace(net, torch.rand(1, 3, 16, 16))
        if request.param == 'traced'
        else torch.jit.script(net)
    )
    torch.jit.save(script, path)
    return path


def settings(path, **changes):
    options = {
        'allow': True,
        'size': 16,
        'scale': 1.0,
        'mean': (0, 0, 0),
        'std': (1, 1, 1),
    } | changes
    return settings_class('torchscript')(model=str(path), **options)


def images(count: int, size: int = 16) -> list[np.ndarray]:
    return list(np.random.default_rng(0).integers(0, 256, (count, size, size, 3), np.uint8))


def expected(net, layer: str, batch: torch.Tensor) -> torch.Tensor:
    """Return the output of the module's last call, by a hook on the network in Python."""
    kept = []
    hook = net.get_submodule(layer).register_forward_hook(
        lambda _, __, output: kept.append(output)
    )
    with torch.no_grad():
        net(batch)
    hook.remove()
    return kept[-1]


@pytest.mark.parametrize(
    'layer', ['body.block', 'body.last', 'body.block.second', 'body.block.relu']
)
def test_torchscript_inner_layer_equals_hook(net, file, layer):
    """The block has a second argument, and its ReLU two calls: the last one counts."""
    backbone = backbone_class('torchscript')(settings(file, layer=layer))
    three = images(3)
    batch = torch.from_numpy(np.stack(three)).permute(0, 3, 1, 2).float()
    for _ in range(3):  # torch compiles a program anew in its second run
        torch.testing.assert_close(backbone.feature_maps(three), expected(net, layer, batch))


def test_torchscript_runs_nothing_after_layer(file):
    """At 32 pixels the head does not fit: the layers before it run."""
    backbone = backbone_class('torchscript')(settings(file, layer='body.last', size=32))
    assert backbone.feature_maps(images(2)).shape == (2, 6, 16, 16)
    with pytest.raises(SettingsError, match='rejects 2 images of size 32'):
        backbone_class('torchscript')(settings(file, layer='head', size=32)).feature_maps(
            images(2)
        )


def test_torchscript_layer_keeps_its_input(tmp_path):
    torch.jit.save(torch.jit.script(Spoiled()), tmp_path / 'spoiled.pt')
    backbone = backbone_class('torchscript')(settings(tmp_path / 'spoiled.pt', layer='layer'))
    assert (backbone.feature_maps([np.full((16, 16, 3), 7, np.uint8)]) == 8).all()


def test_torchscript_output_by_hand(net, tmp_path):
    """By hand: sums of four pixels; blue first, mean and std by channel; batch of two."""
    conv = nn.Conv2d(3, 1, 2, stride=2, bias=False)
    nn.init.constant_(conv.weight, 1)
    torch.jit.save(torch.jit.script(conv), tmp_path / 'sum.pt')
    image = np.zeros((16, 16, 3), np.uint8)
    image[:, :, 0] = 100  # red
    backbone = backbone_class('torchscript')(
        settings(tmp_path / 'sum.pt', channels='bgr', mean=(0, 0, 20), std=(1, 1, 2), half=True)
    )
    maps = backbone.feature_maps([image, 2 * image])
    assert (maps.shape, maps.dtype) == ((2, 1, 8, 8), torch.float32)
    assert (maps[0] == 4 * (100 - 20) / 2).all()
    assert (maps[1] == 4 * (200 - 20) / 2).all()


def test_torchscript_errors_name_file_and_layer(file, tmp_path):
    with pytest.raises(UnavailableError, match='cannot be read'):
        FeatureExtractor('torchscript', settings(tmp_path / 'missing.pt'))
    (tmp_path / 'broken.pt').write_bytes(file.read_bytes()[:-200])
    with pytest.raises(UnavailableError, match='no usable TorchScript file'):
        FeatureExtractor('torchscript', settings(tmp_path / 'broken.pt'))
    with pytest.raises(
        SettingsError, match=r"no layer 'body\.fire'.*body, body\.block, body\.block\.first"
    ):
        FeatureExtractor('torchscript', settings(file, layer='body.fire'))
    with pytest.raises(
        SettingsError, match=r"the layer 'body\.block\.unused', but calls it .* not at all"
    ):
        FeatureExtractor('torchscript', settings(file, layer='body.block.unused'))
    with pytest.raises(SettingsError, match=r'one vector of 10 numbers .* W = 1 .* not 7'):
        FeatureExtractor('torchscript', settings(file), strips=7)
    with pytest.raises(SettingsError, match='must be'):
        settings(file, channels='hsv')
    with pytest.raises(SettingsError, match='sha256'):
        settings(file, sha256='12')


def test_torchscript_layer_that_cannot_be_cut_off_is_rejected(tmp_path, net):
    torch.jit.save(torch.jit.script(Branch()), tmp_path / 'branch.pt')
    with pytest.raises(SettingsError, match='in a branch or loop'):
        FeatureExtractor('torchscript', settings(tmp_path / 'branch.pt', layer='layer'))
    maps = backbone_class('torchscript')(settings(tmp_path / 'branch.pt')).feature_maps(images(2))
    assert maps.shape == (2, 4, 16, 16)
    torch.jit.save(torch.jit.freeze(torch.jit.script(net)), tmp_path / 'frozen.pt')
    with pytest.raises(SettingsError, match='its layers are none'):
        FeatureExtractor('torchscript', settings(tmp_path / 'frozen.pt', layer='head'))


def test_torchscript_file_may_move_but_not_change(file, tmp_path):
    made = FeatureExtractor('torchscript', settings(file, layer='body.last')).settings
    moved = tmp_path / 'moved.pt'
    moved.write_bytes(file.read_bytes())
    assert FeatureExtractor.from_settings(made, None, model=str(moved)).settings == made
    torch.jit.save(torch.jit.script(Net()), moved)
    with pytest.raises(FeatureMismatchError, match='give the file that the map was built with'):
        FeatureExtractor.from_settings(made, None, model=str(moved))
    with pytest.raises(FeatureMismatchError, match='sha256'):
        FeatureExtractor('torchscript', settings(file, sha256='0' * 64))


@pytest.mark.skipif(not torch.cuda.is_available(), reason='no CUDA device')
def test_torchscript_in_half_precision_on_gpu_is_close(file, net):
    backbone = backbone_class('torchscript')(
        settings(file, layer='body.last', half=True, scale=1 / 255), 'cuda'
    )
    batch = torch.from_numpy(np.stack(images(2))).permute(0, 3, 1, 2).float() / 255
    maps = backbone.feature_maps(images(2))
    assert maps.dtype == torch.float16
    torch.testing.assert_close(
        maps.float().cpu(), expected(net, 'body.last', batch), rtol=1e-2, atol=1e-2
    )


def test_torchscript_runs_with_permission_only(file):
    """Neither a map nor settings give it, and without it the file is not even opened."""
    with pytest.raises(SettingsError, match='set parameter allow_torchscript'):
        FeatureExtractor('torchscript', settings('/nowhere', allow=False))
    text = json.dumps({'model': str(file), 'allow': True, 'size': 16})
    made = PipelineSettings(features='torchscript', feature_settings=text)
    with pytest.raises(SettingsError, match='set parameter allow_torchscript'):
        made.extractor()
    allowed = replace(made, allow_torchscript=True)
    assert allowed.extractor().settings.backbone.sha256
    assert BY_NAME['allow_torchscript'].when == 'start'


def test_torchscript_of_another_hash_is_not_run(file, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.jit, 'load', lambda *_, **__: pytest.fail('it was run'))
    with pytest.raises(FeatureMismatchError, match='sha256'):
        FeatureExtractor('torchscript', settings(file, sha256='0' * 64))
    (tmp_path / 'copy.pt').write_bytes(file.read_bytes())
    (tmp_path / 'copy.pt.sha256').write_text('0' * 64)
    with pytest.raises(UnavailableError, match='it is damaged or another file'):
        FeatureExtractor('torchscript', settings(tmp_path / 'copy.pt'))
