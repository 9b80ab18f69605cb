"""What is measured: the matchers, the recognizer and the sequence kernels, ready to be called."""

from collections.abc import Callable
from itertools import cycle
from typing import Any

import numpy as np
import torch
from timing import timed

from stavpr_ros.alignment import SequenceDistances, SequenceSettings, SpatialSettings, image_distances
from stavpr_ros.features import LocalFeatures
from stavpr_ros.recognition.matcher import Matcher, make_matcher

NEIGHBORHOOD = 20
CHECKED = 200  # places whose image distances are held against float64
Call = Callable[[], Any]


def bare_product(
    rows: torch.Tensor, references: torch.Tensor, synchronize: Callable[[], None]
) -> tuple[Call, str]:
    """
    Return torch's product of queries with the map at its best, and in words which form that is.

    The orientation of a skinny product decides its speed, differently on every machine and in every
    precision: both are tried. The result's memory is at hand.

    :param rows: shape (queries, d); :param references: shape (W, n, d), of the same type and device.
    """
    table = references.reshape(-1, references.shape[2])
    out = torch.empty(len(rows) * len(table), dtype=rows.dtype, device=rows.device)
    wide, tall = out.view(len(rows), len(table)), out.view(len(table), len(rows))
    forms: dict[str, Call] = {
        'queries @ map.T': lambda: torch.mm(rows, table.T, out=wide),
        'map @ queries.T': lambda: torch.mm(table, rows.T, out=tall),
    }
    taken = {}
    for form, call in forms.items():
        job = timed(call, synchronize)
        job()
        taken[form] = min(job() for _ in range(3))
    best = min(forms, key=taken.__getitem__)
    return forms[best], f'torch.mm, {best}'


def filled(matcher: Matcher, queries: LocalFeatures, length: int) -> Matcher:
    """Return the matcher with a full window."""
    for i in range(length):
        frame = i % len(queries)
        matcher.push(matcher.distances(queries.strips[:, frame], queries.weights[:, frame]))
    return matcher


def matcher_frames(matcher: Matcher, queries: LocalFeatures, length: int) -> Call:
    """Return a call that takes in the next frame and answers: distances, push, match."""
    filled(matcher, queries, length)
    frames = cycle(range(len(queries)))

    def call() -> Any:
        frame = next(frames)
        matcher.push(matcher.distances(queries.strips[:, frame], queries.weights[:, frame]))
        return matcher.match(NEIGHBORHOOD)

    return call


def online_frames(
    features: LocalFeatures,
    queries: LocalFeatures,
    spatial: SpatialSettings,
    sequence: SequenceSettings,
    precision: str,
    device: str,
) -> tuple[Call, str]:
    """Return a call for a whole online frame with a full window, and in words what it calls."""
    try:
        from stavpr_ros.mapping import PlaceMap
        from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
    except ImportError as error:  # maps need more packages than the matching
        matcher = make_matcher(features, spatial, sequence, device, precision)
        call = matcher_frames(matcher, queries, sequence.length)
        return call, f'distances, push, match; no PlaceRecognizer here ({error})'
    n = len(features)
    places = PlaceMap(features, None, np.zeros(n, np.int64), ('',) * n)
    settings = RecognizerSettings(1.0, spatial, sequence, NEIGHBORHOOD)
    recognizer = PlaceRecognizer(places, settings, device, precision)
    frames = [queries[i : i + 1] for i in range(len(queries))]
    for i in range(sequence.length):
        recognizer.add(frames[i % len(frames)])
    following = cycle(frames)
    return lambda: recognizer.add(next(following)), 'PlaceRecognizer.add'


def sequence_kernel(window: np.ndarray, k: int) -> Callable[[], SequenceDistances]:
    """Return a call of the CPU's LM-DTW on a window, shape (l, n), that lies ready for the kernel."""
    from stavpr_ros.alignment.lm_dtw import match_padded, padded_width

    l, n = window.shape
    padded = np.full((l, padded_width(n, k)), np.inf, np.float32)
    padded[:, :n] = window
    return lambda: match_padded(padded, n, k)


def selection(matches: SequenceDistances) -> Call:
    """Return a call that selects the nearest sequence and the second best."""
    from stavpr_ros.alignment import best_match

    return lambda: best_match(matches, NEIGHBORHOOD)


def largest_error(
    found: torch.Tensor, features: LocalFeatures, query: torch.Tensor, spatial: SpatialSettings
) -> float:
    """
    Return the largest error of image distances, against products and alignment in float64.

    :param found: shape (n,); the first places are looked at.
    :param query: strips of the image, shape (W, d).
    """
    references = features.strips[:, :CHECKED].cpu().double()
    d = 1 - torch.einsum('id,jnd->ijn', query.cpu().double(), references)
    exact = image_distances(d.contiguous().numpy(), spatial)
    return float(np.abs(found[:CHECKED].cpu().numpy() - exact).max())
