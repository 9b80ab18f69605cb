# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Descriptors that other programs computed: files, maps and evaluations of them."""

from checkpoints import Hostile
import numpy as np
import pytest
from scipy.io import savemat
from stavpr_lab.features import descriptors
from stavpr_lab.features.descriptors import is_descriptors, read_descriptors, require_comparable
from stavpr_ros.errors import FeatureMismatchError, SourceError

D = 24


@pytest.fixture(scope='module')
def vectors():
    """Return a curve of 40 vectors, not of unit norm; the sixth is zero."""
    curve = np.cumsum(np.random.default_rng(0).standard_normal((40, D)), axis=0)
    curve[5] = 0
    return curve.astype(np.float32)


def unit(array):
    return array / np.maximum(np.linalg.norm(array, axis=-1, keepdims=True), 1e-12)


def save(folder, kind, array):
    """Write an array as one kind of file; return the path to give."""
    path = folder / f'a.{kind.split(":")[0]}'
    match kind:
        case 'npy':
            np.save(path, array)
        case 'npz:b':
            np.savez(path, a=np.zeros(3), b=array)
        case 'csv':
            np.savetxt(path, array, delimiter=',')
        case 'mat':
            savemat(path, {'features': array.astype(np.float64), 'names': np.array(['a'], object)})
    return f'{path}{kind[3:]}'


@pytest.mark.parametrize('kind', ['npy', 'npz:b', 'csv', 'mat'])
def test_read_descriptors_of_each_kind_of_file(tmp_path, vectors, kind):
    path = save(tmp_path, kind, vectors)
    assert is_descriptors(path)
    features = read_descriptors(path, 'netvlad')
    assert features.strips.dtype == np.float32
    assert features.strips.shape == (1, 40, D)
    np.testing.assert_allclose(features.strips[0], unit(vectors), atol=1e-6)
    assert features.weights[0].tolist() == [float(i != 5) for i in range(40)]
    assert features.settings.backbone.source == 'netvlad'


@pytest.mark.parametrize('kind', ['npy', 'npz:b', 'mat'])
def test_read_descriptors_of_strips_keeps_their_order(tmp_path, kind):
    """Strip j of image i is row [i, j]; weights are norms over the norm of the image."""
    array = np.random.default_rng(1).standard_normal((6, 3, 5)).astype(np.float32)
    features = read_descriptors(save(tmp_path, kind, array))
    assert features.strips.shape == (3, 6, 5)
    np.testing.assert_allclose(features.strips[2, 4], unit(array[4, 2]), atol=1e-6)
    share = np.linalg.norm(array[4, 2]) / np.linalg.norm(array[4])
    assert float(features.weights[2, 4]) == pytest.approx(share, abs=1e-6)


def write(path, content):
    """Write an array, arrays by their names, or a text."""
    if isinstance(content, str):
        path.write_text(content)
    elif isinstance(content, dict):
        savemat(path, content) if path.suffix == '.mat' else np.savez(path, **content)
    elif content is not None:
        np.save(path, content)


SOUND, NO_NUMBER = (
    np.ones((40, 2)),
    np.where(np.arange(40)[:, None] == 7, np.nan, np.ones((40, 2))),
)
HARMFUL = np.array([Hostile('trap')], object)  # nothing of it is executed
CELLS = {'c': np.array([SOUND], object)}
BOTH = {'a': SOUND, 'b': SOUND}


@pytest.mark.parametrize(
    ('name', 'content', 'words'),
    [
        ('a.npy', HARMFUL, 'cannot be read'),
        ('a.npz', {'a': HARMFUL}, 'numbers are none'),
        ('a.npz:a', {'a': HARMFUL}, 'numbers are none'),
        ('a.npy', np.zeros(5), r'float64 \(5,\): expected real numbers'),
        ('a.npy', np.zeros((5, 0)), r'\(5, 0\)'),
        ('a.npy', np.zeros((5, 2), complex), 'complex128'),
        ('a.npy', np.zeros((1, 1025, 1)), 'W = 1025'),
        ('a.npy', np.zeros((5, 64), np.uint8), r'uint8 \(5, 64\): .* --descriptors-bits true'),
        ('a.npy', NO_NUMBER, 'row 7 has NaN'),
        ('a.csv', '', 'is empty'),
        ('a.csv', 'a,b,c\n', 'names, but no line of numbers'),
        ('a.csv', '1,2\n,3\n', "could not convert string ''"),
        ('a.csv', '1,2,3\n4,5,6,7\n', 'number of columns changed'),
        ('a.csv', '7,.3,.4\n8,.2,.1\n9,.1,.6\n', 'first column is stamps or numbers of images'),
        ('a.npz', 'text', 'not a zip file'),
        ('a.npy', 'text', 'of another format'),
        ('a.mat', 'MATLAB', 'cannot be read'),
        ('a.txt', 'text', 'expected a file'),
        ('missing.npy', None, 'missing.npy cannot be read'),
        ('a.npy:x', SOUND, 'leave :x out'),
        ('two.npz', BOTH, r'which array\? .* a, b: give .*:NAME'),
        ('two.npz:c', BOTH, r'c\? .* a, b'),
        ('cell.mat', CELLS, 'arrays of numbers are none'),
    ],
)
def test_read_descriptors_of_other_files_is_rejected(working_folder, name, content, words):
    write(working_folder / name.partition(':')[0], content)
    with pytest.raises(SourceError, match=words):
        read_descriptors(f'{working_folder}/{name}')
    assert not (working_folder / 'trap').exists()


@pytest.mark.parametrize(
    'text',
    [
        '1,2,3\n4,5,6\n',
        '# by another program\nx,y,z\n1,2,3\n\n4,5,6\n',
        '0,1,2\n1,2,3\n4,5,6\n',  # columns as pandas numbers them
        ',0,1,2\n0,1,2,3\n1,4,5,6\n',  # rows as well
        'file,x,y,z\na.jpg,1,2,3\nb.jpg,4,5,6\n',
        'a.jpg 1 2 3\nb.jpg 4 5 6\n',
        '"x" "y" "z"\n"1" 1 2 3\n"2" 4 5 6\n',  # of R
        '"1";"2";"3"\r\n"4";"5";"6"\r\n',
        '\ufeffx;y;z;\n1;2;3;\n4;5;6;\n',
        'x;y;z\n1,0;2,0;3,0\n4,0;5,0;6,0\n',  # of German programs
        '1\t2\t3\t\n4\t5\t6\t\n',
    ],
)
def test_read_tables_of_many_programs(tmp_path, text):
    (tmp_path / 'a.CSV').write_text(text)
    strips = read_descriptors(str(tmp_path / 'a.CSV')).strips[0]
    np.testing.assert_allclose(strips, unit(np.array([[1, 2, 3], [4, 5, 6]])), atol=1e-6)


@pytest.mark.parametrize(
    'array', ['<f2', '>f4', 'f8', 'i1', 'u8', 'fortran', 'huge', 'tiny', 'huge32', 'tiny32']
)
def test_read_descriptors_of_any_type_and_size(tmp_path, vectors, array, set_constants):
    """Squares of float32 overflow from 1e19 on: rows are scaled before."""
    set_constants(descriptors, AT_ONCE=16, MAPPED=0)
    whole = np.round(vectors * 8)  # -128 fits into i1
    whole -= whole.min() + (128 if array == 'i1' else 0)
    scale = {'huge': 1e200, 'tiny': 1e-200, 'huge32': 1e30, 'tiny32': 1e-30}.get(array, 1)
    dtype = {'fortran': 'f4', 'huge32': 'f4', 'tiny32': 'f4'}.get(array, array)
    dtype = 'f8' if dtype in ('huge', 'tiny') else dtype
    stored = (whole.astype('f8') * scale).astype(dtype, order='F' if array == 'fortran' else 'C')
    np.save(tmp_path / 'a.npy', stored)
    features = read_descriptors(str(tmp_path / 'a.npy'))
    np.testing.assert_allclose(features.strips[0], unit(whole.astype('f8')), atol=1e-6)


def test_read_descriptors_of_bits_has_hamming_distances(tmp_path, set_constants):
    """Of vectors and of strips; other arrays are rejected."""
    set_constants(descriptors, AT_ONCE=4)
    bits = np.random.default_rng(2).integers(0, 2, (6, 3, 16))
    for name, array, own in (
        ('vectors', np.packbits(bits.reshape(6, 48), axis=1), bits.reshape(6, 1, 48)),
        ('strips', np.packbits(bits, axis=2), bits),
    ):
        path = str(tmp_path / f'{name}.npy')
        np.save(path, array)
        features = read_descriptors(path, bits=True)
        hamming = (own[:, None] != own[None]).sum(-1).transpose(2, 0, 1)
        cosine = 1 - features.strips @ features.strips.transpose(0, 2, 1)
        np.testing.assert_allclose(cosine, 2 * hamming / own.shape[2], atol=1e-6)
        assert features.settings.backbone.bits
    np.save(path, bits.astype(np.int8))
    with pytest.raises(SourceError, match=r'int8 \(6, 3, 16\): expected uint8 for bits'):
        read_descriptors(path, bits=True)


def test_read_descriptors_takes_the_only_array_that_can_be_meant(tmp_path, vectors):
    np.savez(tmp_path / 'a.npz', names=np.array(['a'] * 40), times=np.arange(40.0), x=vectors)
    savemat(tmp_path / 'a.mat', {'times': np.arange(40.0), 'count': 40, 'x': vectors})
    np.savez(tmp_path / 'b.npz', **{'a.b/c-d': vectors, 'e': vectors})
    for path in ('a.npz', 'a.mat', 'b.npz:a.b/c-d'):
        features = read_descriptors(str(tmp_path / path))
        np.testing.assert_allclose(features.strips[0], unit(vectors), atol=1e-6)


def test_read_descriptors_of_matlab_7_3(tmp_path, vectors, hide_module):
    """HDF5 behind 512 bytes; columns of MATLAB are rows of the file."""
    h5py = pytest.importorskip('h5py', reason='the extra hdf5 is not installed')
    path = tmp_path / 'a.mat'
    strips = np.random.default_rng(1).standard_normal((6, 3, 5))
    with h5py.File(path, 'w', userblock_size=512) as file:
        for name, array, kind in (
            ('x', vectors, b'single'),
            ('strips', strips, b'double'),
            ('label', np.zeros((9, 9), np.uint16), b'char'),
        ):
            file.create_dataset(name, data=array.T).attrs['MATLAB_class'] = np.bytes_(kind)
        file.create_group('s').attrs['MATLAB_class'] = np.bytes_(b'struct')
    with path.open('r+b') as file:
        file.write(b'MATLAB 7.3 MAT-file'.ljust(124) + b'\x00\x02IM')
    features = read_descriptors(f'{path}:x')
    np.testing.assert_allclose(features.strips[0], unit(vectors), atol=1e-6)
    features = read_descriptors(f'{path}:strips')
    np.testing.assert_allclose(features.strips[2, 4], unit(strips[4, 2]), atol=1e-6)
    with pytest.raises(SourceError, match=r'which array\? .* are strips, x: give'):
        read_descriptors(str(path))
    hide_module('h5py')
    with pytest.raises(SourceError, match=r'version 7.3 .* -v7, or pip install h5py'):
        read_descriptors(str(path))


def test_descriptors_of_another_source_or_dimension_are_rejected(tmp_path, vectors):
    np.save(tmp_path / 'a.npy', vectors)
    one = read_descriptors(str(tmp_path / 'a.npy'), 'netvlad')
    other = read_descriptors(str(tmp_path / 'a.npy'), 'megaloc')
    with pytest.raises(FeatureMismatchError, match='megaloc'):
        require_comparable(other, one.settings, D)
    with pytest.raises(SourceError, match='24 dimensions, those of the map have 25'):
        require_comparable(one, one.settings, 25)
