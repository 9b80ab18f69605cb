# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of weights: paths, cache, downloads from a local server, hashes, damaged files."""

import hashlib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import io
import os
from pathlib import Path
import pickle
import threading

from checkpoints import Call, Global, Hostile, OldPickle
import numpy as np
import pytest
from stavpr_lab.features import PublishedSettings, weights
from stavpr_lab.features.paper_networks import PublishedNetwork
from stavpr_lab.features.weights import download, PublishedFile, read_checkpoint
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features.model_files import find_model, read_model
import torch
from torch import nn


class Tiny(PublishedNetwork):
    """One convolution and unused layers; the tests set its address."""

    @staticmethod
    def whole_network():
        return nn.Sequential(nn.Conv2d(3, 2, 8, stride=8), nn.ReLU(), nn.BatchNorm2d(2))

    @staticmethod
    def up_to_layer(network):
        return network[:2]


def dump(content: object) -> bytes:
    stream = io.BytesIO()
    torch.save(content, stream)
    return stream.getvalue()


@pytest.fixture(scope='module')
def content():
    """Return a file of weights for Tiny in the current format of torch."""
    torch.manual_seed(0)
    return dump(Tiny.whole_network().state_dict())


@pytest.fixture
def cache(model_folders):
    return model_folders[1]


class Server:
    """Serves one response under every address, and counts the requests."""

    def __init__(self) -> None:
        self.status, self.body, self.requests = 200, b'', 0
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                outer.requests += 1
                self.send_response(outer.status)
                self.send_header('Content-Length', str(len(outer.body)))
                self.end_headers()
                self.wfile.write(outer.body)

            def log_message(self, *_):
                pass

        self.http = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
        self.address = f'http://127.0.0.1:{self.http.server_port}/weights/tiny.pth'


@pytest.fixture
def server(content, environ):
    environ['no_proxy'] = '*'
    server = Server()
    server.body = content
    thread = threading.Thread(target=server.http.serve_forever, kwargs={'poll_interval': 0.01})
    thread.start()
    Tiny.published = PublishedFile(server.address)
    yield server
    server.http.shutdown()
    thread.join()
    server.http.server_close()


def fetch(server, cache, content) -> str:
    """Download the file; return its hash."""
    digest = hashlib.sha256(content).hexdigest()
    download(server.address, cache / 'tiny.pth', digest)
    return digest


def test_network_without_its_file_downloads_nothing(server, cache):
    with pytest.raises(
        UnavailableError, match=rf'{cache}/tiny\.pth: `stavpr weights`.*{server.address}'
    ):
        Tiny(PublishedSettings())
    with pytest.raises(UnavailableError, match="'download' cannot be read"):
        Tiny(PublishedSettings(model='download'))
    assert server.requests == 0
    assert not cache.exists()


def test_download_is_complete_and_checked(server, cache, content):
    digest = fetch(server, cache, content)
    assert sorted(path.name for path in cache.iterdir()) == ['tiny.pth', 'tiny.pth.sha256']
    assert (cache / 'tiny.pth.sha256').read_text() == f'{digest}  tiny.pth\n'
    for model in ('cached', str(cache / 'tiny.pth')):
        assert Tiny(PublishedSettings(model=model)).settings.sha256 == digest
    assert server.requests == 1


@pytest.mark.parametrize(
    ('changes', 'message'),
    [({'status': 404}, 'HTTP Error 404'), ({'body': b'cut'}, 'invalid hash value')],
)
def test_download_that_fails_leaves_no_file(server, cache, content, changes, message):
    vars(server).update(changes)
    with pytest.raises(UnavailableError, match=message):
        fetch(server, cache, content)
    assert list(cache.iterdir()) == []


def test_published_hash_is_checked_in_full(server, cache, content):
    digest = hashlib.sha256(content).hexdigest()
    other = digest[:16] + '0' * 48
    Tiny.published = PublishedFile(server.address, sha256=other)
    fetch(server, cache, content)
    with pytest.raises(UnavailableError, match='it is damaged or another file; delete it'):
        Tiny(PublishedSettings())
    (cache / 'mine.pth').write_bytes(content)
    Tiny(PublishedSettings(model=str(cache / 'mine.pth')))  # another name than the published one


def test_command_weights_needs_a_full_hash(cache, capsys, monkeypatch):
    from stavpr_lab.commands.weights import main

    fetched = []
    monkeypatch.setattr(weights, 'download', lambda *arguments: fetched.append(arguments))
    assert main(['vgg16', '--sha256', 'abc']) == 2
    assert main(['densenet161_places365']) == 2
    assert 'publish no hash' in capsys.readouterr().err
    assert main(['vgg16']) == main(['densenet161_places365', '--sha256', '0' * 64]) == 0
    assert [(path.parent, sha256[:8]) for _, path, sha256 in fetched] == [
        (cache, '397923af'),
        (cache, '0' * 8),
    ]


def test_model_is_found_by_its_hash(tmp_path, cache, content):
    digest = hashlib.sha256(content).hexdigest()
    with pytest.raises(UnavailableError, match=f'{digest} is not in {tmp_path}/models or {cache}'):
        find_model(digest, '')
    for folder in (tmp_path / 'models', cache, tmp_path / 'given'):
        folder.mkdir(parents=True)
    (tmp_path / 'models' / 'other.pth').write_bytes(b'other')
    os.mkfifo(tmp_path / 'models' / 'pipe')
    (cache / 'any.name').write_bytes(content)
    assert find_model(digest, '') == cache / 'any.name'
    (tmp_path / 'models' / 'mine').write_bytes(content)
    assert find_model(digest, '') == tmp_path / 'models' / 'mine'
    assert find_model(digest, '/given/file') == Path('/given/file')  # its hash is checked later
    with pytest.raises(UnavailableError, match='given'):
        find_model(digest, str(tmp_path / 'given'))


@pytest.mark.parametrize('name', ['/dev/zero', 'pipe', '', 'gone'])
def test_model_that_is_no_regular_file_is_rejected(tmp_path, name):
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(UnavailableError, match='cannot be read'):
        read_model(tmp_path / name)


def test_weights_changed_since_download_are_rejected(server, cache, content):
    fetch(server, cache, content)
    (cache / 'tiny.pth').write_bytes(content[:-1] + b'\x01')
    with pytest.raises(UnavailableError, match='it is damaged or another file; delete it'):
        Tiny(PublishedSettings())
    (cache / 'tiny.pth.sha256').write_bytes(b'\xff')
    with pytest.raises(UnavailableError, match='sha256 cannot be read'):
        Tiny(PublishedSettings())


def test_weights_saved_in_training_load_as_float32(server, tmp_path):
    torch.save(dict(Tiny.whole_network().half().named_parameters()), tmp_path / 'a.pth')
    with pytest.raises(UnavailableError, match=r"lacks '2\.running_mean' and 1 more"):
        Tiny(PublishedSettings(model=str(tmp_path / 'a.pth')))
    network = Tiny.whole_network().half()
    torch.save(network.state_dict() | dict(network.named_parameters()), tmp_path / 'b.pth')
    network = Tiny(PublishedSettings(model=str(tmp_path / 'b.pth')))
    maps = network.feature_maps([np.zeros((9, 9, 3), np.uint8)])
    assert maps.shape == (1, 2, 28, 28)
    assert maps.dtype == np.float32


def read(tmp_path, content: bytes) -> dict[str, torch.Tensor]:
    path = tmp_path / 'net.pth'
    path.write_bytes(content)
    with path.open('rb') as file:
        return read_checkpoint(file, 'net.pth')


WEIGHT = torch.arange(6.0).reshape(2, 3)


ENTRIES = {'epoch': 3, 'state_dict': {'module.a.weight': WEIGHT}, 'best': torch.tensor(1.0)}


@pytest.mark.parametrize(
    'content',
    [
        dump({'a.weight': WEIGHT}),
        dump({'a.weight': nn.Parameter(WEIGHT)}),
        dump(ENTRIES),
        OldPickle().file(ENTRIES | {'best': None}),
    ],
    ids=['plain', 'parameters', 'with entries', 'Python 2'],
)
def test_read_checkpoint_of_every_format(tmp_path, content):
    parameters = read(tmp_path, content)
    assert list(parameters) == ['a.weight']
    assert torch.equal(parameters['a.weight'], WEIGHT)


@pytest.mark.filterwarnings('ignore:Detected pickle protocol')
def test_read_checkpoint_executes_nothing(tmp_path):
    mark = tmp_path / 'executed'
    old = OldPickle().file({'state_dict': Call(Global('posix', 'mkdir'), (str(mark),))})
    for hostile in (dump({'a.weight': Hostile(str(mark))}), pickle.dumps(Hostile(str(mark)))):
        with pytest.raises(
            UnavailableError, match=r'net\.pth cannot be read as a file of weights'
        ):
            read(tmp_path, hostile)
    with pytest.raises(UnavailableError, match=r'requires posix\.mkdir, .* not executed'):
        read(tmp_path, old)
    assert not mark.exists()


@pytest.mark.filterwarnings('ignore:Detected pickle protocol')
def test_read_checkpoint_with_damage_fails_or_reads(tmp_path, content):
    """Damage anywhere is an error of ours, or harmless; never one of torch's or Python's."""
    rng = np.random.default_rng(0)
    for file in (content, OldPickle().file({'a.weight': WEIGHT})):
        for _ in range(60):
            damaged = bytearray(file)
            damaged[rng.integers(len(file))] ^= 1 << rng.integers(8)
            try:
                read(tmp_path, bytes(damaged))
            except UnavailableError as error:
                assert 'net.pth' in str(error)  # noqa: PT017
