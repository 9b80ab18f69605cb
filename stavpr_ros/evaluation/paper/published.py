# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers that the paper publishes (section 6 of the method)."""

from dataclasses import dataclass

DENSENET, VGG = 'DenseNet161', 'VGG16'


@dataclass(frozen=True)
class PublishedF1:
    """
    F1 of one data set.

    :param sta_densenet, sta_vgg: STA-VPR; ``fast``: with GRP and restricted alignment.
    :param densenet, vgg: the same features of single images, no alignment.

    The others are the paper's baselines: SeqSLAM with sequences of 20, the rest single images.
    """

    title: str
    seqslam: float
    netvlad: float
    saes: float
    densenet: float
    vgg: float
    vgg_fc6: float
    ssm_vpr: float
    sta_densenet: float
    sta_densenet_fast: float
    sta_vgg: float
    sta_vgg_fast: float


# by the names of stavpr_ros.evaluation.paper.datasets
F1 = {
    'nordland': PublishedF1(
        'Nordland', 0.982, 0.587, 0.682, 0.919, 0.987, 0.221, 0.952, 0.977, 0.971, 0.994, 0.994
    ),
    'synth_nordland': PublishedF1(
        'synth-Nord', 0.051, 0.457, 0.072, 0.116, 0.114, 0.098, 0.864, 0.904, 0.863, 0.985, 0.979
    ),
    'gardens_point': PublishedF1(
        'GP DL&DR', 0.780, 0.964, 0.649, 0.898, 0.847, 0.916, 0.997, 0.972, 0.960, 0.979, 0.978
    ),
    'gardens_point_night': PublishedF1(
        'GP DL&NR', 0.122, 0.758, 0.367, 0.834, 0.738, 0.671, 0.950, 0.969, 0.947, 0.979, 0.953
    ),
    'ua': PublishedF1(
        'UA', 0.687, 0.574, 0.794, 0.955, 0.979, 0.492, 0.977, 0.968, 0.963, 0.991, 0.990
    ),
    'berlin_a100': PublishedF1(
        'Berlin A100', 0.457, 0.843, 0.603, 0.714, 0.683, 0.527, 0.927, 0.873, 0.857, 0.857, 0.801
    ),
}

# DenseNet161 with temporal alignment, by how two images are compared
STRATEGIES = {
    'nordland': {'sliding_window': 0.975, 'vanilla': 0.977, 'adaptive': 0.977},
    'synth_nordland': {'sliding_window': 0.523, 'vanilla': 0.322, 'adaptive': 0.904},
    'gardens_point': {'sliding_window': 0.966, 'vanilla': 0.953, 'adaptive': 0.972},
    'gardens_point_night': {'sliding_window': 0.955, 'vanilla': 0.947, 'adaptive': 0.969},
}


def published_f1(dataset: str, backbone: str, configuration: str) -> float | None:
    """
    Return a published F1.

    :param dataset: a name of :mod:`stavpr_ros.evaluation.paper.datasets`.
    :param backbone: ``DenseNet161`` or ``VGG16``.
    :param configuration: a name of :mod:`.experiments`, such as ``sta_vpr``.
    :returns: None where the paper publishes none.
    """
    row = F1.get(dataset)
    if configuration in ('sliding_window', 'vanilla', 'adaptive'):
        return STRATEGIES.get(dataset, {}).get(configuration) if backbone == DENSENET else None
    if row is None:
        return None
    if configuration == 'seqslam':
        return row.seqslam
    found = {
        (DENSENET, 'no_alignment'): row.densenet,
        (DENSENET, 'sta_vpr'): row.sta_densenet,
        (DENSENET, 'sta_vpr_fast'): row.sta_densenet_fast,
        (VGG, 'no_alignment'): row.vgg,
        (VGG, 'sta_vpr'): row.sta_vgg,
        (VGG, 'sta_vpr_fast'): row.sta_vgg_fast,
    }
    return found.get((backbone, configuration))
