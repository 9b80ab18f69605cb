# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""F1 as the paper publishes it (section 6 of the method), beside which our numbers are printed."""

DENSENET, VGG = 'DenseNet161', 'VGG16'

# data set (a name of .datasets): SeqSLAM; then for DenseNet161 and VGG16 single images without
# alignment, STA-VPR, and STA-VPR with GRP and restricted alignment
F1 = {
    'nordland': (0.982, (0.919, 0.977, 0.971), (0.987, 0.994, 0.994)),
    'synth_nordland': (0.051, (0.116, 0.904, 0.863), (0.114, 0.985, 0.979)),
    'gardens_point': (0.780, (0.898, 0.972, 0.960), (0.847, 0.979, 0.978)),
    'gardens_point_night': (0.122, (0.834, 0.969, 0.947), (0.738, 0.979, 0.953)),
    'ua': (0.687, (0.955, 0.968, 0.963), (0.979, 0.991, 0.990)),
    'berlin_a100': (0.457, (0.714, 0.873, 0.857), (0.683, 0.857, 0.801)),
}
# systems that the paper compares with, whatever the features: NetVLAD, SAES, VGG fc6, SSM-VPR
SYSTEMS = ('netvlad', 'saes', 'vgg_fc6', 'ssm_vpr')
F1_OF_SYSTEMS = {
    'nordland': (0.587, 0.682, 0.221, 0.952),
    'synth_nordland': (0.457, 0.072, 0.098, 0.864),
    'gardens_point': (0.964, 0.649, 0.916, 0.997),
    'gardens_point_night': (0.758, 0.367, 0.671, 0.950),
    'ua': (0.574, 0.794, 0.492, 0.977),
    'berlin_a100': (0.843, 0.603, 0.527, 0.927),
}
COLUMNS = ('no_alignment', 'sta_vpr', 'sta_vpr_fast')

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

    :param dataset: a name of :mod:`stavpr_lab.evaluation.paper.datasets`.
    :param backbone: ``DenseNet161`` or ``VGG16``.
    :param configuration: a name of :mod:`.experiments`, such as ``sta_vpr``.
    :returns: None where the paper publishes none.
    """
    if dataset not in F1:
        return None
    seqslam, densenet, vgg = F1[dataset]
    columns = dict(zip(COLUMNS, densenet if backbone == DENSENET else vgg, strict=True))
    strategies = STRATEGIES.get(dataset, {}) if backbone == DENSENET else {}
    systems = dict(zip(SYSTEMS, F1_OF_SYSTEMS[dataset], strict=True))
    return (columns | strategies | systems | {'seqslam': seqslam}).get(configuration)
