# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Map files: the format, atomic saving, and files that are damaged, foreign or hostile."""

import dataclasses
from functools import partial
import json
import os
from pathlib import Path
import pickle
import random
import re
import socket

from conftest import route_images
from map_examples import example_files, example_map, VERSION2
from map_files import alter, network, parts_of, version2
from map_fuzz import hand_made, mutate, use, use_file
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from stavpr_ros.errors import (
    InputError,
    MapFileError,
    OutputError,
    SettingsError,
)
from stavpr_ros.mapping import (
    load_map,
    Map,
    open_map,
    save_map,
    Session,
    verify_map,
)
from stavpr_ros.mapping.map_file import save_error_risks
from stavpr_ros.mapping.place_map import ErrorRisks
from stavpr_ros.mapping.stored_features import StoredFeatures


@pytest.fixture(scope='module')
def example() -> Map:
    return example_map()


@pytest.fixture
def map_path(example, tmp_path) -> Path:
    save_map(example, tmp_path / 'route.stavpr')
    return tmp_path / 'route.stavpr'


@pytest.fixture(scope='module')
def originals(tmp_path_factory) -> list[bytes]:
    return example_files(tmp_path_factory.mktemp('originals'))


def assert_same(a: Map, b: Map) -> None:
    assert (a.settings, a.ids, a.sessions) == (b.settings, b.ids, b.sessions)
    assert tuple(a.thumbnails) == tuple(b.thumbnails)
    assert np.array_equal(a.features.weights, b.features.weights)
    for name in ('stamps', 'poses', 'session_index'):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize('read', [load_map, open_map])
def test_saved_map_is_read_as_it_was(example, map_path, read):
    result = read(map_path)
    assert_same(result, example)
    assert np.array_equal(result.features.strips, example.features.strips)
    assert result.features.cells == example.features.cells == (4, 2)
    assert (result.session(11).name, result.session(12).id) == ('morning', 'b')
    assert result.thumbnails[1:3] == example.thumbnails[1:3]
    use(result)


def test_map_id_is_that_of_the_content(example, map_path, tmp_path):
    map_id = save_map(example, tmp_path / 'again')
    assert re.fullmatch('[0-9a-f]{16}', map_id)
    assert open_map(map_path).map_id == load_map(tmp_path / 'again').map_id == map_id
    other = dataclasses.replace(example, ids=('other',) * len(example))
    assert save_map(other, tmp_path / 'other') != map_id


def test_error_risks_are_replaced_in_a_file_that_stays_the_same_map(example, map_path, tmp_path):
    """The id names the places; risks of today have no recordings."""
    path, before = tmp_path / 'route', Path(map_path).read_bytes()
    path.write_bytes(before)
    map_id = open_map(path).map_id
    for risks in (
        ErrorRisks('m', 2, (0.5,), (1.0,), ('a', 'b')),
        ErrorRisks('m', 1, (0.6,), (0.0,)),
    ):
        assert save_error_risks(risks, path, True) == map_id
        result = load_map(path)
        assert (result.map_id, result.error_risks) == (map_id, risks)
        assert_same(result, dataclasses.replace(example, error_risks=risks))
    assert save_map(result, tmp_path / 'again') == map_id

    def without_recordings(manifest):
        del manifest['sections']['error_risks']['data']['recordings']

    path.write_bytes(alter(path.read_bytes(), without_recordings))
    assert (load_map(path).map_id, load_map(path).error_risks) == (map_id, risks)
    path.write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
    with pytest.raises(MapFileError, match='do not match their hash'):
        save_error_risks(risks, path, True)


def test_float16_storage_halves_the_features_and_rounds_them(example, map_path, tmp_path):
    save_map(example, tmp_path / 'half', 'float16')
    half = open_map(tmp_path / 'half')
    assert half.features.storage == 'float16'
    rounded = example.features.strips.astype(np.float16).astype(np.float32)
    assert np.array_equal(half.features.strips, rounded)
    assert np.array_equal(half.features[[5, 2, 3]].strips, rounded[:, [5, 2, 3]])
    saved_bytes = map_path.stat().st_size - (tmp_path / 'half').stat().st_size
    assert abs(saved_bytes - rounded.nbytes // 2) < 64
    use(half)
    save_map(half, tmp_path / 'again')  # keeps the storage
    assert (tmp_path / 'again').read_bytes() == (tmp_path / 'half').read_bytes()
    with pytest.raises(SettingsError, match='float8'):
        save_map(example, tmp_path / 'none', 'float8')


def test_saved_map_is_a_safetensors_file_and_one_made_by_that_library_loads(
    example, map_path, tmp_path
):
    tensors = load_file(map_path)
    np.testing.assert_array_equal(tensors['strips'], example.features.strips)
    content = map_path.read_bytes()
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], 'little')])
    save_file(tensors, tmp_path / 'theirs', header['__metadata__'])
    assert_same(load_map(tmp_path / 'theirs'), example)


RISKS = ErrorRisks('robust', 3, (0.2, 0.9), (1.5, 0.0))


@pytest.mark.parametrize(
    ('name', 'value', 'data'),
    [('threshold', 0.25, 0.25), ('error_risks', RISKS, json.loads(json.dumps(vars(RISKS))))],
)
def test_optional_value_is_a_section_that_older_readers_ignore(
    example, tmp_path, name, value, data
):
    path, half = tmp_path / 'route.stavpr', tmp_path / 'half'
    save_map(dataclasses.replace(example, **{name: value}), path)
    manifest, _ = parts_of(path.read_bytes())
    assert manifest['sections'] == {name: {'version': 1, 'required': False, 'data': data}}
    save_map(open_map(path), half, 'float16')  # as map compact
    assert getattr(load_map(half), name) == value


def test_reader_written_from_the_documentation_finds_the_same(example, map_path):
    from map_reader import read

    manifest, arrays = read(map_path)
    np.testing.assert_array_equal(arrays['strips'], example.features.strips)
    np.testing.assert_array_equal(arrays['stamps'], example.stamps)
    assert manifest['settings']['backbone'] == {
        'size': 32, 'cell': 8, 'orientations': 4, 'resize': 'area', 'signed': True,
        'logarithm': False,
    }  # fmt: skip
    assert arrays['ids'] == list(example.ids)
    assert arrays['thumbnails'] == list(example.thumbnails)
    assert read(VERSION2 / 'float16.stavpr')[1]['poses'].shape == (24, 7)


@pytest.mark.parametrize('name', ['float32', 'float16'])
def test_kept_file_of_version2_loads(name, example):
    """These files were written from ``example_map`` before the setting ``logarithm``."""
    kept = load_map(VERSION2 / f'{name}.stavpr')
    assert (kept.ids, kept.sessions, len(kept)) == (example.ids, example.sessions, 24)
    np.testing.assert_allclose(kept.features.strips, example.features.strips, rtol=0, atol=1e-3)
    use(kept)


@pytest.mark.parametrize('kind', ['gradient', 'onnx'])
def test_features_extracted_now_are_those_of_a_kept_map(kind):
    """
    Maps of ``route_images(8)``, of the settings that features had in the first commits.

    ``tiny.onnx`` is one convolution and a ReLU.
    """
    if kind == 'onnx':
        pytest.importorskip('onnxruntime', reason='the extra onnx is not installed')
    kept = load_map(VERSION2 / f'{kind}.stavpr')
    query = kept.extractor(model=str(VERSION2 / 'tiny.onnx')).extract(route_images(8))
    np.testing.assert_allclose(query.strips, kept.features.strips, rtol=0, atol=1e-5)
    np.testing.assert_allclose(query.weights, kept.features.weights, rtol=0, atol=1e-5)


def test_map_without_optional_parts_has_three_parts(example, tmp_path):
    plain = Map(example.features, None, example.stamps, ('',) * 24)
    save_map(plain, tmp_path / 'plain')
    assert sorted(load_file(tmp_path / 'plain')) == ['stamps', 'strips', 'weights']
    loaded = load_map(tmp_path / 'plain')
    assert loaded.poses is loaded.session(0) is loaded.thumbnail(0) is None
    assert (set(loaded.ids), loaded.sessions) == ({''}, ())


def test_vectors_of_an_older_map_are_ignored(map_path, example, tmp_path, caplog):
    def older(manifest):
        network(vector='global')(manifest)
        manifest['sections']['vectors'] = {'version': 1, 'required': False, 'data': None}

    old, new = tmp_path / 'old', tmp_path / 'new'
    vectors = np.zeros((24, 5), np.float32)
    old.write_bytes(alter(map_path.read_bytes(), older, vectors__vectors=vectors))
    save_map(open_map(old), new)
    assert np.array_equal(load_map(old).features.strips, example.features.strips)
    assert load_map(new).settings == load_map(old).settings
    assert 'vectors' not in parts_of(new.read_bytes())[0]['sections']
    assert caplog.messages == [f'the vectors of whole images in {old} are ignored']


@pytest.mark.parametrize('required', [False, True])
def test_unknown_section_is_ignored_unless_it_is_required(map_path, example, required):
    sections = {'codes': {'version': 3, 'required': required, 'data': {'bits': 4}}}
    words = np.arange(9, dtype=np.uint8)
    content = map_path.read_bytes()
    map_path.write_bytes(alter(content, lambda m: m.update(sections=sections), codes__words=words))
    if required:
        with pytest.raises(MapFileError, match='requires section codes, version 3'):
            load_map(map_path)
    else:
        assert_same(load_map(map_path), example)


def test_what_could_not_be_read_again_is_not_saved(example, tmp_path):
    for change, text in (
        ({'thumbnails': (b'no image',) * 24}, 'thumbnail of place 0'),
        ({'ids': ('\udcff',) * 24}, 'identifier of place 0'),
        ({'stamps': np.full(24, 2**62)}, 'stamp is out of range'),
        ({'poses': np.ones((24, 7)) * 9}, 'quaternion of place 0'),
        ({'session_index': np.full(24, 2, np.int32)}, 'session index'),
        ({'session_index': None}, 'session index'),
        ({'sessions': (Session('a'), Session('a'))}, 'different ones'),
    ):
        with pytest.raises(InputError, match=text):
            save_map(dataclasses.replace(example, **change), tmp_path / 'map')
    assert list(tmp_path.iterdir()) == []


def test_names_of_images_that_are_no_text_are_replaced(tmp_path):
    from stavpr_ros.features import FeatureExtractor
    from stavpr_ros.mapping import build_map
    from stavpr_ros.sources.frame import Frame

    frame = Frame(np.zeros((64, 64, 3), np.uint8), 0, os.fsdecode(b'a\xff\x00.png'))
    place_map = build_map([frame], FeatureExtractor('gradient'), progress=False)
    save_map(place_map, tmp_path / 'map')
    assert load_map(tmp_path / 'map').ids == ('a??.png',)


def test_load_map_takes_regular_files_only(tmp_path, map_path):
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'zero').symlink_to('/dev/zero')
    (tmp_path / 'loop').symlink_to(tmp_path / 'loop')
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / 'socket'))
        for name, kind in (
            ('pipe', 'a pipe'), ('zero', 'a device'), ('socket', 'a socket'), ('.', 'a folder'),
            ('loop', 'a link into nothing'), ('x' * 5000, 'too long'), ('a\0b', 'null'),
        ):  # fmt: skip
            with pytest.raises(MapFileError, match=rf'{kind}.*name a map file'):
                load_map(tmp_path / name)
    (tmp_path / 'link').symlink_to(map_path)
    assert len(load_map(tmp_path / 'link')) == 24
    with pytest.raises(OutputError, match='does not exist'):
        save_map(load_map(map_path), tmp_path / 'missing' / 'map.stavpr')
    with pytest.raises(MapFileError, match='does not exist'):
        load_map(tmp_path / 'missing')


def test_sparse_file_is_rejected_before_memory_is_taken(map_path):
    os.truncate(map_path, 2**33)
    with pytest.raises(MapFileError, match='has a hole at byte'):
        load_map(map_path)


@pytest.mark.parametrize('part', ['strips', 'thumbnails', 'stamps'])
def test_damage_is_named_by_part_and_offset(example, map_path, part):
    content = bytearray(map_path.read_bytes())
    stored = open_map(map_path).features.file.parts[part]
    content[stored.start + stored.size // 2] ^= 1
    map_path.write_bytes(content)
    last = stored.start + stored.size
    expected = rf'bytes {stored.start} to {last}, of part {part}, do not match'
    if part in ('strips', 'thumbnails'):  # left in the file, and verified later
        opened = open_map(map_path)
        with pytest.raises(MapFileError, match=expected):
            verify_map(opened)
    with pytest.raises(MapFileError, match=expected):
        load_map(map_path)


def setting(name, value):
    return lambda manifest: manifest['settings'].update({name: value})


def backbone(name, value):
    return lambda manifest: manifest['settings']['backbone'].update({name: value})


def section(name, data, **changes):
    """Return a change of a manifest: a section of this program, and what is changed of it."""

    def change(manifest):
        sections = manifest.setdefault('sections', {})
        sections[name] = {'version': 1, 'required': False, 'data': data} | changes

    return change


def statistics(**changes):
    return lambda manifest: manifest['sections']['statistics']['data'].update(changes)


def risks(**changes):
    return section('error_risks', vars(RISKS) | changes)


def cameras(count=2, **changes):
    one = {'name': 'rear', 'yaw': 3.1, 'intrinsics': None}
    return section('cameras', [one | changes] * count)


def jpeg(width: int, height: int) -> bytes:
    size = height.to_bytes(2, 'big') + width.to_bytes(2, 'big')
    return b'\xff\xd8\xff\xc0\x00\x11\x08' + size + b'\x03' + bytes(9) + b'\xff\xd9'


def thumbnail(content: bytes) -> dict[str, np.ndarray]:
    ends = np.full(24, len(content))
    return {'thumbnails': np.frombuffer(content, np.uint8), 'thumbnail_ends': ends}


def poses(*row) -> dict[str, np.ndarray]:
    return {'poses': np.tile(np.array(row, float), (24, 1))}


DIRECTIONS = np.ones((2, 24, 16), np.float32)
HAND_MADE = [  # parts, a change of the manifest, and what the error names; the hashes are correct
    ({'stamps': np.zeros((24, 3), np.int64)}, None, r'stamps is I64 \(24, 3\)'),
    ({'stamps': np.full(24, 2**62)}, None, 'a stamp is out of range'),
    ({'stamps': np.zeros(23, np.int64)}, None, 'expected 24 for n'),
    ({'stamps': None}, None, 'part stamps is missing'),
    ({'weights': np.full((2, 24), 1.5, np.float32)}, None, 'weights is not between 0 and 1'),
    ({'strips': np.full((2, 24, 32), np.nan, np.float32)}, None, 'strip 0, from place 0 on'),
    ({'strips': np.full((2, 24, 32), 1, np.float16)}, None, 'longer than 1'),
    ({'strips': np.zeros((2, 24, 33), np.float32)}, None, 'strips of 33 dimensions'),
    (poses(0, 0, 0, 0, 0, 0, 0), None, 'quaternion of place 0'),
    (poses(np.inf, 0, 0, 0, 0, 0, 1), None, 'pose of place 0'),
    ({'ids': np.full(24, 255, np.uint8), 'id_ends': np.arange(1, 25)}, None, 'utf-8'),
    ({'ids': np.zeros(24, np.uint8), 'id_ends': np.arange(1, 25)}, None, 'identifier of place 0'),
    ({'id_ends': np.array([200, *range(1, 23), 182])}, None, 'id_ends does not increase'),
    (thumbnail(jpeg(20000, 20000)), None, 'thumbnail of place 0 has 400000000 pixels'),
    (thumbnail(b'\x89PNG\r\n\x1a\n' + bytes(40)), None, 'thumbnail of place 0 is no JPEG'),
    ({'session': np.full(24, 2, np.int32)}, None, 'session index is not between 0 and 1'),
    ({'session': None}, None, '2 sessions without a session index'),
    ({'projection': np.eye(32, dtype=np.float32)}, None, 'whether there is a projection'),
    ({'surplus': np.zeros(3)}, None, 'part surplus is unknown'),
    ({'codes__words': np.zeros(3)}, None, 'part codes/words is of no section'),
    ({f's{i}': np.zeros(1, np.uint8) for i in range(100)}, None, 'at most 64 keys'),
    ({}, lambda m: m.update(extra=1), "unknown 'extra'"),
    ({}, lambda m: m.pop('cells') and None, "lacks 'cells'"),
    ({}, lambda m: m.update(cells=[0, 4]), r'cells\[0\] is 0'),
    ({}, lambda m: m.update(cells=[3, 1]), 'cells .3, 1. of strips of 32'),
    ({}, lambda m: m.update(sessions=[{'id': 'a'}]), "lacks '"),
    ({}, lambda m: m['sessions'][0].update(id='\ud800'), 'no JSON|session|hash'),
    ({}, lambda m: m['sessions'][0].update(start=-1), 'start is -1'),
    ({}, lambda m: m.update(projection='gaussian'), 'whether there is a projection'),
    ({}, setting('kind', 'teleport'), 'teleport'),
    ({}, setting('strips', 2.0), r'strips is 2\.0'),
    ({}, setting('feature_version', 2), 'gradient of version 2 are unknown'),
    ({}, setting('projection', 'mine'), 'projection None is another than the features have, mine'),
    ({}, backbone('size', 10**6), 'size = 1000000 must be 1 to'),
    ({}, backbone('signed', 1), 'signed is 1'),
    ({}, network(model='/dev/zero'), "unknown 'model'"),
    ({}, network(sha256=''), 'lack the sha256 of the model'),
    ({}, network(scale=float('inf')), 'no number'),
    ({}, network(std=[0, 0, 0]), 'std not 0'),
    ({}, risks(more=1), "unknown 'more'"),
    ({}, risks(method='a' * 257), 'at most 256 characters'),
    ({}, risks(risks=['0', '0']), r"risks\[0\] is '0'"),
    ({}, risks(probabilities=[0.5] * 2**16), 'a list of 1 to 256'),
    ({}, risks(probabilities=[0.5, 10**400]), 'between 0 and 1|too large'),
    ({}, cameras(more=1), "unknown 'more'"),
    ({}, cameras(name='a' * 65), 'at most 64 characters'),
    ({}, cameras(yaw='left'), "yaw is 'left'"),
    ({}, cameras(yaw=float('nan')), 'yaw is nan|no number|JSON'),
    ({}, cameras(intrinsics={'width': 640}), "lacks '"),
    ({}, cameras(4), 'section cameras has 4 of them: expected 2'),
]
STATISTICS = [  # the same, of a file that has some, and a projection
    ({'projection': np.full((32, 16), np.nan, np.float32)}, None, 'projection is not finite'),
    ({'statistics__mean': None}, None, 'part statistics/mean is missing'),
    ({'statistics__changes': None}, None, 'part statistics/changes is missing'),
    ({'statistics__mean': np.zeros((2, 31), np.float32)}, None, 'expected 16 for d'),
    ({'statistics__mean': np.zeros((2, 16))}, None, 'part statistics/mean is F64'),
    ({'statistics__mean': np.full((2, 16), np.nan, np.float32)}, None, 'mean is not between'),
    ({'statistics__gains': np.full((2, 24), -9.0)}, None, 'gains is not between'),
    ({'statistics__directions': DIRECTIONS * np.inf}, None, 'directions is not'),
    ({'statistics__directions': np.zeros((2, 99, 16), np.float32)}, None, 'for r'),
    ({'statistics__changes': np.zeros((4, 24), np.float32)}, None, 'expected 5 for 5'),
    ({'statistics__changes': np.full((5, 24), -9, np.float32)}, None, 'changes is not between'),
    ({}, section('statistics', None), 'section statistics is'),
    ({}, statistics(features='x'), 'features is'),
    ({}, statistics(method='m' * 999), 'at most 128'),
]


def version(version):
    return lambda content: version2(*parts_of(content), {'version': version})


def without_hashes(content):
    manifest, tensors = parts_of(content)
    manifest['parts']['strips']['sha256'] = []
    return version2(manifest, tensors)


def other(content):
    return lambda _: content


def header(old, new):
    """Return a change of a file: of the text of its header."""

    def change(content):
        length = int.from_bytes(content[:8], 'little')
        text = content[8 : 8 + length].decode().replace(old, new).encode()
        return len(text).to_bytes(8, 'little') + text + content[8 + length :]

    return change


OFFSETS = '"data_offsets":[0,'
FORMS = [  # a change of the bytes, and what the error names
    *((version(text), 'has format version') for text in ('3', '1', '2.0', ' 2', '9' * 400)),
    *((version(value), 'version|no map') for value in (2, None, float('nan'))),
    (without_hashes, 'tensor strips has 0 hashes'),
    (lambda content: content + b'\0', r'tensors end at byte \d+, the file at byte \d+'),
    (lambda content: content[:-1], r'tensors end at byte \d+, the file at byte \d+'),
    (other(b'PK\3\4' + bytes(26)), 'is no map, .*: build one'),
    (other(b''), 'no map'),
    (other(b'hello'), 'no map'),
    (other(b'\x02' + bytes(7) + b'{}'), 'no map'),
    (other(pickle.dumps([1, 2])), 'no map'),
    (other((18).to_bytes(8, 'little') + b'{"__metadata__":{}}'), 'no map'),
    (other((9000).to_bytes(8, 'little') + b'[' * 9000), 'no map'),
    (header('"dtype":"I64"', '"dtype":"F64"'), 'another type or shape'),
    (header('"dtype":"F32"', '"dtype":"Q99"'), 'another type|unknown type'),
    (header('morning', 'evening'), 'do not match their hash'),
    (header(OFFSETS, '"data_offsets":[8,'), 'bytes .* expected'),
    (header(OFFSETS, '"data_offsets":[-8,'), 'data_offsets'),
    (header(OFFSETS, '"data_offsets":[0,0,'), 'data_offsets'),
    (header('"strips":{', '"x":{},"strips":{'), "'x' is in the header, but"),
    (header('"strips":{', '"strips":1,"strips":{'), 'twice'),
    (header('"__metadata__"', '}"__metadata__"'), 'no map'),
    (
        lambda content: (2**62).to_bytes(8, 'little') + content[8:],
        f'a header of {2**62} bytes and has',
    ),
]


def rows_of(number, rows):
    return [(number, partial(alter, change=one, **parts), text) for parts, one, text in rows]


@pytest.mark.parametrize(('number', 'change', 'text'), [
    *rows_of(0, HAND_MADE), *rows_of(1, STATISTICS), *((0, change, text) for change, text in FORMS)
])  # fmt: skip
def test_damaged_or_hand_made_file_is_rejected_by_name(originals, tmp_path, number, change, text):
    (tmp_path / 'map').write_bytes(change(originals[number]))
    with pytest.raises(MapFileError, match=text) as caught:
        load_map(tmp_path / 'map')
    assert re.search('backup|update|build', str(caught.value))


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
@pytest.mark.parametrize('change', [mutate, hand_made])
def test_file_of_any_content_is_rejected_or_works(originals, tmp_path, change):
    """Damage changes nothing of a map that loads; reader_fuzz.py tries more of them."""
    rng, path, refused = random.Random(os.environ.get('CI') and 0), tmp_path / 'map', 0
    for i in range(150):
        path.write_bytes(change(originals[i % 2], rng))
        try:
            use_file(path, thorough=not i % 5)
        except MapFileError as error:  # nothing foreign leaves
            assert str(path) in str(error)  # noqa: PT017
            refused += 1
        else:
            assert change is hand_made or path.read_bytes() == originals[i % 2]
    assert 0 < refused < 150 or change is mutate


def test_stored_features_are_an_array_like_those_in_memory(example, map_path):
    stored, memory = open_map(map_path).features, example.features
    assert isinstance(stored, StoredFeatures)
    for places in (slice(3, 9), slice(None, None, 5), slice(4, 4), np.array([7, 8, 2]), [1]):
        assert np.array_equal(stored[places].strips, memory[places].strips)
        assert np.array_equal(stored[places].weights, memory[places].weights)
    assert np.array_equal(stored.strips, memory.strips)
