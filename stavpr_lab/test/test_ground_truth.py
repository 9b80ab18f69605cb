# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth by hand and of every kind of file; drives over parts of a map."""

import pickle
import zipfile

import cv2
import numpy as np
import pytest
from scores import truth_matrix
from stavpr_lab.evaluation.drive import crop, DriveChanges, INTERVAL
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.errors import InputError, SettingsError, SourceError

# three queries in five places: 0 -> 1, 2; 1 -> nothing; 2 -> 4
PAIRS = [(0, 1), (0, 2), (2, 4)]
MATRIX = np.array([[0, 1, 1, 0, 0], [0, 0, 0, 0, 0], [0, 0, 0, 0, 1]])
KINDS = ('csv', 'npy', 'npz', 'png', 'pkl')
FILES = ['a.jpg', 'b.jpg', 'c.jpg'], [f'x/{i}.png' for i in range(5)]


def by_hand(pairs=PAIRS, N=3, n=5, tolerance=0):
    queries, places = np.array(pairs).reshape(-1, 2).T
    return GroundTruth.from_pairs(queries, places, N, n, tolerance)


def pose(x=0.0, y=0.0, z=0.0, yaw=0.0):
    return [x, y, z, 0, 0, np.sin(np.radians(yaw) / 2), np.cos(np.radians(yaw) / 2)]


def test_accepts_by_hand():
    truth = by_hand()
    assert truth.accepts(np.array([1, 0, 4])).tolist() == [True, False, True]
    assert truth.accepts(np.array([[1, 2, 3], [1, 2, 4], [-1, 3, 4]])).tolist() == [
        [True, True, False],
        [False, False, False],
        [False, False, True],
    ]
    assert by_hand([(0, 1)]).accepts(np.array([1, 4, 4])).tolist() == [True, False, False]
    assert [truth.accepted(query).tolist() for query in range(3)] == [[1, 2], [], [4]]
    assert truth.has_match.tolist() == [True, False, True]
    assert truth.middles.tolist() == [1, -1, 4]
    assert truth.pairs.tolist() == [[0, 1], [0, 2], [2, 4]]
    np.testing.assert_array_equal(truth_matrix(truth), MATRIX.astype(bool))


def test_accepts_minus_one_is_false_after_an_accepted_last_place():
    """Query 1 with -1 has the key of query 0 with the last place, which is accepted."""
    truth = by_hand([(0, 4), (1, 0)], 2, 5)
    assert truth.accepts(np.array([4, -1])).tolist() == [True, False]


@pytest.mark.parametrize('outside', [5, -2])
def test_accepts_of_places_outside_the_map_raises(outside):
    with pytest.raises(InputError, match='places'):
        by_hand().accepts(np.array([0, 1, outside]))


def test_identity_accepts_the_same_index_within_the_tolerance():
    truth = GroundTruth.identity(4, 4, 1)
    expected = np.abs(np.subtract.outer(np.arange(4), np.arange(4))) <= 1
    np.testing.assert_array_equal(truth_matrix(truth), expected)
    assert truth.middles.tolist() == [0, 1, 2, 2]
    assert truth.has_match.all()
    with pytest.raises(InputError, match='5 query images and 4 places'):
        GroundTruth.identity(5, 4)


def test_widened_stays_within_query_and_map():
    truth = by_hand().widened(1)
    assert truth.pairs.tolist() == [[0, 0], [0, 1], [0, 2], [0, 3], [2, 3], [2, 4]]
    assert by_hand(tolerance=1).pairs.tolist() == truth.pairs.tolist()
    for wrong in (-1, 0.5):
        with pytest.raises(InputError, match='tolerance'):
            by_hand().widened(wrong)


def test_pairs_are_widened_along_the_route_in_every_session():
    """Places 3 to 5, of the second session, are at the positions of 0 to 2."""
    truth = GroundTruth.from_pairs(np.array([0, 1]), np.array([2, 5]), 2, 6)
    route = truth.widened(1, np.array([0, 1, 2, 0, 1, 2]))
    assert route.pairs.tolist() == [[image, place] for image in (0, 1) for place in (1, 2, 4, 5)]
    assert route.middles.tolist() == [1, 1]


def test_loop_closures_of_either_triangle_are_the_same():
    lower = np.zeros((5, 5), bool)
    lower[3, 0] = lower[4, 1] = lower[4, 3] = True
    expected = [[3, 0], [4, 1], [4, 3]]
    for matrix in (lower, lower.T, lower | lower.T | np.eye(5, dtype=bool)):
        truth = GroundTruth.from_pairs(*np.nonzero(matrix), 5, 5)
        assert truth.loop_closures().pairs.tolist() == expected
        assert truth.loop_closures(exclude=1).pairs.tolist() == expected[:2]
        assert truth.loop_closures(exclude=3).pairs.tolist() == []
    with pytest.raises(InputError, match='one traverse'):
        by_hand().loop_closures()


def test_from_pairs_outside_the_range_raises():
    for pair in [(3, 0), (-1, 0), (0, 5), (0, -2)]:
        with pytest.raises(InputError, match=rf'query {pair[0]} with place {pair[1]}'):
            by_hand([*PAIRS, pair])
    with pytest.raises(InputError, match='at least one'):
        by_hand([], 0, 5)


@pytest.mark.parametrize(
    'text',
    [
        '0,1\n0,2\n2,4\n',
        'query,place\n0,1\n0,2\n2,4\n1,-1\n',
        'accepted_reference;query\n1;0\n2;0\n4;2\n',
        '# by hand\n\n2 4\n0 1\n0 2\n0 2',
        '\ufeff"Live"\t"Reference"\tmeters\n0\t1\t0.3\n0\t2.0\t1\n2\t4\t0\n',
        '\ufeff"0","1"\n"0","2"\n"2","4"\n',
        'image;query;place;\r\na.jpg;0;1;\r\n  \r\n;;;\r\na.jpg;0;2;\r\nb.jpg;2;4;\r\n',
        '% query place\n0\t1\n0\t2\n2\t4\n',
    ],
)
def test_from_file_reads_text(tmp_path, text):
    path = tmp_path / 'truth.csv'
    path.write_text(text, encoding='utf-8')
    np.testing.assert_array_equal(GroundTruth.from_file(path, 3, 5).pairs, PAIRS)
    np.testing.assert_array_equal(
        GroundTruth.from_file(path, 3, 5, 1).pairs, by_hand(tolerance=1).pairs
    )


def test_from_file_with_a_list_of_pairs_is_unknown_for_other_queries(tmp_path):
    """A place of -1, a matrix and an image are statements on all that they are about."""
    path = tmp_path / 'truth.csv'
    path.write_text('query,place\n0,1\n2,-1\n')
    truth = GroundTruth.from_file(path, 4, 5, 1)
    assert truth.is_stated.tolist() == [True, False, True, False]
    assert truth.has_match.tolist() == [True, False, False, False]
    assert truth.select(np.array([3, 2])).is_stated.tolist() == [False, True]
    assert truth.on_places(np.array([4])).is_stated.tolist() == truth.is_stated.tolist()
    np.save(tmp_path / 'matrix.npy', MATRIX)
    assert GroundTruth.from_file(tmp_path / 'matrix.npy', 3, 5).is_stated.all()


def test_from_file_reads_a_place_a_line(tmp_path):
    path = tmp_path / 'truth.txt'
    path.write_text('Reference\n1\n-1\n4\n')
    assert GroundTruth.from_file(path, 3, 5).pairs.tolist() == [[0, 1], [2, 4]]
    for N in (2, 4):
        with pytest.raises(InputError, match=f'a place for 3 queries, but there are {N}'):
            GroundTruth.from_file(path, N, 5)


@pytest.mark.parametrize(
    'array',
    [MATRIX.astype(bool), MATRIX * 255.0, np.array(PAIRS), np.array([*PAIRS, (1, -1)], float)],
)
def test_from_file_reads_arrays(tmp_path, array):
    np.save(tmp_path / 'truth.npy', array)
    np.savez(tmp_path / 'one.npz', anything=array)
    np.savez_compressed(tmp_path / 'several.npz', truth=array, other=np.zeros(2))
    cv2.imwrite(str(tmp_path / 'truth.png'), MATRIX.astype(np.uint8))
    cv2.imwrite(str(tmp_path / 'truth.bmp'), (MATRIX * 255).astype(np.uint8))
    for name in ('truth.npy', 'one.npz', 'several.npz', 'truth.png', 'truth.bmp'):
        np.testing.assert_array_equal(GroundTruth.from_file(tmp_path / name, 3, 5).pairs, PAIRS)


OBJECTS = np.empty((1, 2), object)
OBJECTS[0] = [0, [1, 2]]  # as the ground truth of VPR-Bench: a number and a list
CLAIM = cv2.imencode('.png', np.uint8(MATRIX))[1].tobytes()[:33] + b'\x7f\xff\xff\xffIDAT'  # 2 GB


def write(path, content):
    """Write a text, bytes, or an array."""
    if isinstance(content, str):
        path.write_text(content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    elif path.suffix == '.png':
        cv2.imwrite(str(path), content)
    else:
        np.save(path, content) if path.suffix == '.npy' else np.savez(path, truth=content)


@pytest.mark.parametrize(
    ('kinds', 'content', 'message'),
    [
        (
            'csv',
            'query,place\n0,1\n0,one\n',
            "line 3: could not convert string 'one'.*two columns",
        ),
        (
            'csv',
            '0,1\n\n0,1e19\n',
            r'line 3: column 2 has no whole number, 1e\+19: expected two columns',
        ),
        ('csv', '0,1.5\n', r'line 1: column 2 has no whole number, 1\.5'),
        ('csv', '1700000000,1700000009\n', 'column 1 has stamps instead of the numbers of images'),
        ('csv', '0,1,2\n', '3 columns, without a header of these names: expected two columns'),
        ('csv', 'query,place\n', 'no line of numbers'),
        ('csv', '0,-1\n', 'accepts no pair'),
        ('csv', '0,5\n', r'truth\.csv: ground truth pairs query 0 with place 5.*counted from 1'),
        ('csv', 'query,place\nb.jpg,2.png\nz.jpg,0.png\n', "'z.jpg' is the name of no image"),
        ('csv', 'query,place\nb.jpg\na.jpg,0\n', 'different numbers of columns'),
        ('csv', 'b.jpg,2\na.jpg\n', 'different numbers of columns'),
        ('csv', 'b.jpg,\na.jpg,2\n', "'' is the name of no image"),
        ('csv', 'b.jpg,nan\n', "'nan' is the name of no image"),
        ('csv', 'place\n2.png\n', 'a place for 1 queries, but there are 3'),
        ('npy npz', MATRIX.T, r'shape \(5, 3\): expected \(3, 5\).*transposed'),
        ('npy npz', np.zeros((3, 5), bool), 'accepts no pair'),
        ('npy npz', np.random.default_rng(0).random((3, 5)), 'matrix of distances'),
        ('npy npz', np.array(['a']), 'expected finite numbers'),
        ('npy npz', np.array([[0, np.nan]]), 'expected finite numbers'),
        ('npy npz', np.array([[0.5, 1]]), r'shape \(1, 2\)'),
        ('npy npz', OBJECTS, r'contains Python objects.*runs whatever'),
        ('npy', pickle.dumps(MATRIX), r'truth\.npy contains Python objects.*runs whatever'),
        ('png', np.uint8(MATRIX.T) * 255, '5 high and 3 wide: expected 3 rows'),
        ('png', np.uint8(MATRIX) * 128, '3 gray pixels'),
        ('png', b'', 'damaged'),
        ('png', CLAIM, 'damaged'),
        *((kind, b'PK\x03\x04\xff damaged', rf'truth\.{kind}') for kind in KINDS),
        *((kind, None, rf'truth\.{kind}') for kind in KINDS),
    ],
)
def test_from_file_of_invalid_content_raises(tmp_path, kinds, content, message):
    names = FILES if isinstance(content, str) and 'g' in content else ((), ())
    for kind in kinds.split():
        path = tmp_path / f'truth.{kind}'
        if content is not None:
            write(path, content)
        with pytest.raises((InputError, SourceError), match=message):
            GroundTruth.from_file(path, 3, 5, names=names)


def test_from_file_of_an_archive_without_arrays_raises(tmp_path):
    with zipfile.ZipFile(tmp_path / 'text.npz', 'w') as archive:
        archive.writestr('truth', 'no array')
    with pytest.raises(SourceError, match=r'text\.npz has truth: expected one array'):
        GroundTruth.from_file(tmp_path / 'text.npz', 3, 5)


def test_from_poses_by_hand():
    places = np.array([pose(0), pose(3, 4), pose(0, yaw=90), pose(0, yaw=-30)])
    queries = np.array([pose(0), pose(0, yaw=180), pose(3, 4, 0.5)])
    expected = {
        (0.5, None): [[0, 0], [0, 2], [0, 3], [1, 0], [1, 2], [1, 3], [2, 1]],
        (0.4, 90): [[0, 0], [0, 2], [0, 3], [1, 2]],
        (0.5, 29): [[0, 0], [2, 1]],
    }
    scaled = queries * np.array([1, 1, 1, -2, -2, -2, -2])  # the same rotations
    for limits, pairs in expected.items():
        for poses in (queries, scaled):
            assert GroundTruth.from_poses(poses, places, *limits).pairs.tolist() == pairs


def test_from_poses_never_accepts_places_with_unknown_pose():
    unknown = [np.nan] * 7
    places, queries = np.array([pose(0), unknown, pose(5)]), np.array([pose(0), pose(5), pose(9)])
    for degrees in (None, 90):
        truth = GroundTruth.from_poses(queries, places, 1, degrees)
        assert truth.pairs.tolist() == [[0, 0], [1, 2]]
        assert truth.n == 3
    with pytest.raises(InputError, match=r'2 of 3 query images have no pose \(0, 2\)'):
        GroundTruth.from_poses(np.array([unknown, pose(5), unknown]), places, 1)


@pytest.mark.parametrize('text', [
    'query,place\nb.jpg,2.png\na.jpg,0.png\n',
    'place;query\n2;b\n0;a\n',
    'b.jpg,2\na.jpg,0\nc.jpg,-1\n',
])  # fmt: skip
def test_from_text_of_names_is_of_the_images_that_it_names(tmp_path, text):
    (tmp_path / 'truth.csv').write_text(text)
    truth = GroundTruth.from_file(tmp_path / 'truth.csv', 3, 5, names=FILES)
    assert truth.pairs.tolist() == [[0, 0], [1, 2]]
    assert truth.is_stated.tolist() == [True, True, '-1' in text]


@pytest.mark.parametrize(('truth', 'doubt'), [
    (GroundTruth.identity(20, 20, 10), '78% of the 20 places'),
    (GroundTruth.identity(20, 20, 3), ''),
    (by_hand([(0, i) for i in range(5)]), '100% of the 5 places'),
    (by_hand([(0, -1), (1, -1), (2, -1)]), 'no place for any of 3 images'),
    (GroundTruth.from_poses(*[[pose(i) for i in range(9)]] * 2, 100), '100% of the 9 places'),
])  # fmt: skip
def test_truth_that_cannot_be_wrong_or_right_is_named(truth, doubt):
    assert truth.doubt().startswith(doubt)
    assert bool(truth.doubt()) == bool(doubt)


# Drives by hand: which images are shown, which places are kept, and their ground truth

# four images in six places: 0 -> 1; 1 -> 2, 3; 2 -> nothing; 3 -> 0, 5
DRIVEN = [(0, 1), (1, 2), (1, 3), (3, 0), (3, 5)]


def four_in_six(pairs=DRIVEN, N=4, n=6):
    return GroundTruth.from_pairs(*np.array(pairs).T, N, n)


@pytest.mark.parametrize(
    ('changes', 'images'),
    [
        ({}, [0, 1, 2, 3, 4, 5, 6]),
        ({'speed': 3}, [0, 3, 6]),
        ({'speed': 1.5}, [0, 1, 3, 4, 6]),
        ({'speed': 0.5}, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6]),
        ({'speed': 4.5}, [0, 4]),
        ({'stops': ((2, 3), (6, 1))}, [0, 1, 2, 2, 2, 2, 3, 4, 5, 6, 6]),
        ({'reverse': True}, [6, 5, 4, 3, 2, 1, 0]),
        ({'reverse': True, 'stops': ((5, 2),), 'speed': 3}, [6, 6, 6, 3, 0]),  # 6 is next to 5
    ],
)
def test_images_of_seven_by_hand(changes, images):
    assert DriveChanges(**changes).images(7).tolist() == images


def test_images_at_seven_tenths_of_the_speed_are_exact():
    """floor(0.7 i), also where 0.7 i is a whole number that binary fractions miss."""
    images = DriveChanges(speed=0.7).images(1000)
    assert images.tolist() == [i * 7 // 10 for i in range(1429)]


def test_images_at_varying_speed_are_between_half_and_double():
    """Steps of 2 ** sin(2 pi i / 60): 1, 1.08, 1.16, ...; 2 near i = 15, 1/2 near i = 45."""
    images = DriveChanges(speed='varying').images(2000)
    assert (images[16] - images[13], images[49] - images[41]) == (6, 4)
    steps = 2 ** np.sin(2 * np.pi * np.arange(len(images)) / 60)
    assert images.tolist() == [int(steps[:i].sum()) for i in range(len(images))]
    assert images[-1] <= 1999 < images[-1] + 3


def test_images_are_dropped_with_the_probability_and_by_the_seed():
    images = DriveChanges(drop=0.3, seed=5).images(4000)
    assert images.tolist() == DriveChanges(drop=0.3, seed=5).images(4000).tolist()
    assert images.tolist() != DriveChanges(drop=0.3, seed=6).images(4000).tolist()
    assert (np.diff(images) > 0).all()
    assert 0.67 < len(images) / 4000 < 0.73


def test_stamps_have_gaps_where_images_are_dropped():
    """Not where the drive is slower: each image is an interval after the one before."""
    truth = GroundTruth.identity(40, 40, 0)
    slow = DriveChanges(speed=0.5).apply(truth)
    np.testing.assert_array_equal(slow.stamps, (np.arange(80) + 1) * INTERVAL)
    dropped = DriveChanges(drop=0.3, seed=5).apply(truth)
    np.testing.assert_array_equal(dropped.stamps, (dropped.images + 1) * INTERVAL)


def test_apply_moves_the_ground_truth_with_images_and_places():
    """Reversed, standing at image 1, without places 1 and 2: 0, 3, 4, 5 become 0, 1, 2, 3."""
    changes = DriveChanges(removed=((1, 3),), reverse=True, stops=((1, 1),))
    drive = changes.apply(four_in_six())
    assert drive.images.tolist() == [3, 2, 1, 1, 0]
    assert drive.places.tolist() == [0, 3, 4, 5]
    assert drive.truth.pairs.tolist() == [[0, 0], [0, 3], [2, 1], [3, 1]]
    assert (drive.truth.N, drive.truth.n) == (5, 4)


def test_apply_equals_the_matrix_of_any_ground_truth():
    rng = np.random.default_rng(0)
    for seed in range(20):
        matrix = rng.random((30, 25)) < 0.08
        truth = GroundTruth.from_pairs(*np.nonzero(matrix), 30, 25)
        first, other = sorted(rng.choice(25, 2, replace=False).tolist())
        removed, stops = ((first, other),), ((seed, 4),)
        drive = DriveChanges(removed, drop=0.2, seed=seed, speed=0.6, stops=stops).apply(truth)
        expected = np.delete(matrix[drive.images], np.arange(first, other), axis=1)
        np.testing.assert_array_equal(truth_matrix(drive.truth), expected)


def test_unseen_images_are_more_than_five_places_from_the_map():
    """Places 10..29 and 40..44 of 60 are removed; 25 and 42 are 5 and 3 from a kept one."""
    changes = DriveChanges(removed=((10, 30), (40, 45)))
    for tolerance in (0, 3):
        first, second = changes.apply(GroundTruth.identity(60, 60, tolerance)).unseen()
        assert np.flatnonzero(first).tolist() == list(range(15, 25))
        assert not second.any()
    # with a tolerance of 8, all others have a correct place among 0 .. 9 or from 30 on
    wide = changes.apply(GroundTruth.identity(60, 60, 8)).unseen()[0]
    assert np.flatnonzero(wide).tolist() == [18, 19, 20, 21]


def test_unseen_images_of_adjacent_stretches_count_once():
    truth = GroundTruth.identity(40, 40)
    first, second = DriveChanges(removed=((0, 12), (12, 20))).apply(truth).unseen()
    assert np.flatnonzero(first).tolist() == list(range(12))
    assert np.flatnonzero(second).tolist() == [12, 13, 14]


def test_unseen_images_of_two_places_have_lost_both():
    """Image 0 shows 20 and 50, image 1 20 and 51, image 2 nothing; 50 and 51 are ten apart."""
    truth = four_in_six([(0, 20), (0, 50), (1, 20)], 3, 60)
    both = DriveChanges(removed=((10, 30), (40, 60))).apply(truth).unseen()
    assert [mask.tolist() for mask in both] == [[True, True, False], [False] * 3]
    for others in ({}, {'reverse': True}):
        one = DriveChanges(removed=((10, 30),), **others).apply(truth).unseen()
        assert one[0].tolist() == [False, True, False]


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'drop': 1.0}, 'drop = 1.0: expected a probability'),
        ({'drop': float('nan')}, 'drop = nan'),
        ({'seed': -1}, 'seed = -1'),
        ({'stops': ((2, 0),)}, 'stop 2:0: expected at least one'),
        ({'stops': ((7, 1),)}, 'stop 7:1: the query has the images 0 .. 6'),
        ({'speed': 0.0}, r'speed 0: expected 0\.01 \.\. 100'),
        ({'speed': float('nan')}, 'speed nan'),
        ({'speed': 'fast'}, 'a number or varying'),
        ({'removed': ((2, 2),)}, 'removed places 2:2: expected 0 <= FIRST < LAST <= 7'),
        ({'removed': ((0, 8),)}, 'removed places 0:8'),
        ({'removed': ((0, 3), (2, 4))}, 'removed places 2:4 overlap'),
        ({'removed': ((0, 3), (3, 7))}, 'all 7 places'),
    ],
)
def test_changes_out_of_range_raise(changes, message):
    with pytest.raises(SettingsError, match=message):
        DriveChanges(**changes).apply(GroundTruth.identity(7, 7))


# ---------------------------------------------------------------------------------- cropping


@pytest.mark.parametrize(
    'fractions', [(-0.1, 0), (0, -0.1), (0.5, 0.5), (1, 0), (float('nan'), 0)]
)
def test_cropped_by_invalid_fractions_raises(fractions):
    with pytest.raises(SettingsError, match='fractions >= 0'):
        crop([], *fractions)
