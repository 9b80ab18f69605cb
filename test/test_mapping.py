"""The map file: round trip, atomicity, and every way in which a file can be bad."""

import json
import os
import pickle
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stavpr_ros.errors import FeatureMismatchError, InputError, MapFileError
from stavpr_ros.features import Describer
from stavpr_ros.mapping import PlaceMap, build_map, load_map, save_map


def assert_same(a: PlaceMap, b: PlaceMap) -> None:
    assert a.settings == b.settings
    np.testing.assert_array_equal(a.features.strips.numpy(), b.features.strips.numpy())
    np.testing.assert_array_equal(a.features.weights.numpy(), b.features.weights.numpy())
    np.testing.assert_array_equal(a.stamps, b.stamps)
    assert a.ids == b.ids
    assert a.thumbnails == b.thumbnails
    assert (a.poses is None) == (b.poses is None)
    if a.poses is not None:
        np.testing.assert_array_equal(a.poses, b.poses)


@pytest.fixture
def saved(small_map, tmp_path):
    path = tmp_path / 'route.stavpr'
    save_map(small_map, path)
    return path


def test_round_trip(small_map, saved, route):
    loaded = load_map(saved)
    assert_same(small_map, loaded)
    assert loaded.projection.identity == small_map.projection.identity
    assert loaded.thumbnail(3).shape == (96, 128, 3)
    query = loaded.describer().describe([route[5]])
    np.testing.assert_allclose(query.strips[:, 0], small_map.features.strips[:, 5], atol=1e-6)


def test_map_without_extras(route, tmp_path):
    from stavpr_ros.sources.frame import Frame

    plain = build_map([Frame(route[0], 0, '')], Describer(), thumbnails=False, progress=False)
    save_map(plain, tmp_path / 'plain.stavpr')
    loaded = load_map(tmp_path / 'plain.stavpr')
    assert_same(plain, loaded)
    assert loaded.thumbnail(0) is None
    assert not loaded.has_stamps
    assert not loaded.has_ids


def test_projected_otherwise_is_refused(small_map, route):
    from stavpr_ros.recognition import Recogniser, RecognitionSettings

    recogniser = Recogniser(small_map, RecognitionSettings(threshold=1.0))
    for other in (Describer(projection=64, seed=1), Describer(), Describer(projection=64, strips=6)):
        with pytest.raises(FeatureMismatchError) as caught:
            recogniser.add(other.describe(route[:1]))
        assert small_map.settings.to_json() in str(caught.value)
        assert other.settings.to_json() in str(caught.value)
    assert recogniser.window_fill == 0


def test_empty_source_is_refused():
    with pytest.raises(InputError, match='no images'):
        build_map([], Describer(), progress=False)


def test_failed_save_leaves_the_old_file(small_map, saved, monkeypatch):
    before = saved.read_bytes()

    def full_disk(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full_disk)
    with pytest.raises(MapFileError, match='untouched'):
        save_map(small_map, saved)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def test_save_into_missing_folder(small_map, tmp_path):
    with pytest.raises(MapFileError, match='cannot be written'):
        save_map(small_map, tmp_path / 'missing' / 'map.stavpr')


def test_missing_file(tmp_path):
    with pytest.raises(MapFileError, match='does not exist'):
        load_map(tmp_path / 'nothing.stavpr')
    with pytest.raises(MapFileError):
        load_map(tmp_path)


@pytest.mark.parametrize('content', [b'', b'hello', b'PK\x03\x04' + bytes(100), os.urandom(1000)])
def test_foreign_file(tmp_path, content):
    path = tmp_path / 'foreign'
    path.write_bytes(content)
    with pytest.raises(MapFileError):
        load_map(path)


def test_foreign_zip(tmp_path):
    path = tmp_path / 'foreign.zip'
    with zipfile.ZipFile(path, 'w') as archive:
        archive.writestr('hello.txt', 'hello')
    with pytest.raises(MapFileError, match='no map of this program'):
        load_map(path)


def rewritten(saved, change, members=None):
    """Write the saved map again with a changed manifest and other members."""
    with zipfile.ZipFile(saved) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    manifest = json.loads(content['manifest.json'])
    change(manifest)
    content['manifest.json'] = json.dumps(manifest).encode()
    content.update(members or {})
    with zipfile.ZipFile(saved, 'w') as archive:
        for name, value in content.items():
            archive.writestr(name, value)


def test_newer_version(saved):
    rewritten(saved, lambda manifest: manifest.update(version=99))
    with pytest.raises(MapFileError, match='version 99'):
        load_map(saved)


def test_unknown_kind_of_features(saved):
    def change(manifest):
        manifest['settings'] = manifest['settings'].replace('"gradient"', '"teleport"')

    rewritten(saved, change)
    with pytest.raises(MapFileError, match='teleport'):
        load_map(saved)


def test_pickle_is_never_executed(saved, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / 'exploded'),))

    import hashlib
    import io

    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.array([Bomb()], object), allow_pickle=True)
    digest = hashlib.sha256(buffer.getvalue()).hexdigest()
    rewritten(saved, lambda m: m['members'].update(stamps=digest), {'stamps.npy': buffer.getvalue()})
    with pytest.raises(MapFileError, match='damaged'):
        load_map(saved)
    saved.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(MapFileError):
        load_map(saved)
    assert not (tmp_path / 'exploded').exists()


def test_compressed_members_are_refused(saved):
    with zipfile.ZipFile(saved) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(saved, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, value in content.items():
            archive.writestr(name, value)
    with pytest.raises(MapFileError, match='compressed'):
        load_map(saved)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_is_noticed(saved, small_map, data):
    """Any byte changed, any tail cut off: the same map or a clear error, nothing else."""
    whole = saved.read_bytes()
    damaged = saved.parent / 'damaged'
    if data.draw(st.booleans(), label='truncate'):
        damaged.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    else:
        # half of the positions among the headers, where a damage is hardest to tell
        near_end = data.draw(st.booleans())
        low = max(0, len(whole) - 1500) if near_end else 0
        position = data.draw(st.integers(low, len(whole) - 1))
        flipped = bytearray(whole)
        flipped[position] ^= data.draw(st.integers(1, 255))
        damaged.write_bytes(flipped)
    try:
        loaded = load_map(damaged)
    except MapFileError as error:
        assert str(damaged) in str(error)  # noqa: PT017
    else:
        assert_same(small_map, loaded)
