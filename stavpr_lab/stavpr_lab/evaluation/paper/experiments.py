# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's experiments: configurations are columns of a table, data sets with features rows."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from stavpr_lab.evaluation.drive import FrameSource
from stavpr_lab.evaluation.evaluate import evaluate_on_map
from stavpr_lab.evaluation.metrics import evaluate_ranking, Metrics, Ranking
from stavpr_lab.evaluation.paper.datasets import Dataset
from stavpr_lab.evaluation.seqslam import seqslam, SeqSlamSettings
from stavpr_lab.evaluation.ssm_vpr import SsmVpr
from stavpr_lab.features.descriptors import read_descriptors, require_comparable
from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.errors import SettingsError, SourceError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import backbone_class
from stavpr_ros.mapping import build_map, descriptor_map, Map
from stavpr_ros.method import RecognizerSettings
from stavpr_ros.method.settings import ROBUST, RobustOptions
import torch

W = 7
GRP, XI = 512, 3  # the paper's random projection and restricted alignment


@dataclass(frozen=True)
class Configuration:
    """
    Settings of one column of a table.

    :param name: its name in :mod:`stavpr_lab.evaluation.paper.published`.
    :param title: head of its column.
    :param temporal: sequences; False = single images.
    :param strips: W.
    :param projection: dimensions of a random projection, None without.
    :param mode: mode of the recognizer; None = as the command has it.
    :param baseline: run that instead: ``seqslam``, with the length of the sequence settings;
        ``ssm_vpr``, with two layers of the network; ``descriptors``, single images by the arrays
        of this name.
    """

    name: str
    title: str
    spatial: SpatialSettings = field(default_factory=SpatialSettings)
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    temporal: bool = True
    strips: int = W
    projection: int | None = None
    mode: str | RobustOptions | None = None
    baseline: str = ''


NO_ALIGNMENT = SpatialSettings('none')
STA_VPR = Configuration('sta_vpr', 'STA-VPR')
FAST = Configuration('sta_vpr_fast', 'GRP + RA', SpatialSettings(xi=XI), projection=GRP)

PRESETS: dict[str, tuple[Configuration, ...]] = {
    'paper': (
        Configuration('seqslam', 'SeqSLAM', baseline='seqslam'),
        Configuration('netvlad', 'NetVLAD', baseline='descriptors'),
        Configuration('saes', 'SAES', baseline='descriptors'),
        Configuration('no_alignment', 'no alignment', NO_ALIGNMENT, temporal=False),
        Configuration('vgg_fc6', 'VGG fc6', baseline='descriptors'),
        Configuration('ssm_vpr', 'SSM-VPR', baseline='ssm_vpr'),
        STA_VPR,
        FAST,
    ),
    'ablation': (
        Configuration('no_alignment', 'none', NO_ALIGNMENT, temporal=False),
        Configuration('spatial', 'only spatial', temporal=False),
        Configuration('temporal', 'only temporal', NO_ALIGNMENT),
        replace(STA_VPR, title='both'),
    ),
    'strategies': (
        Configuration('sliding_window', 'sliding window', SpatialSettings('sliding_window')),
        Configuration('vanilla', 'vanilla DTW', SpatialSettings('vanilla')),
        Configuration('adaptive', 'adaptive DTW'),
    ),
    'fast': (
        replace(STA_VPR, title='plain'),
        Configuration('grp', 'GRP', projection=GRP),
        Configuration('ra', 'RA', SpatialSettings(xi=XI)),
        FAST,
    ),
    'field': (
        Configuration('no_alignment', 'single image', NO_ALIGNMENT, temporal=False),
        Configuration('spatial', 'aligned image', temporal=False),
        replace(STA_VPR, title='mode paper', mode='paper'),
        Configuration('robust', 'mode robust', mode='robust'),
    ),
    'robust_options': (
        replace(STA_VPR, mode='paper'),
        Configuration('robust', 'robust', mode='robust'),
        *(
            Configuration(
                f'without_{option.name}',
                f'without {option.name}',
                mode=replace(ROBUST, **{option.name: False}),
            )
            for option in fields(RobustOptions)
            if getattr(ROBUST, option.name)
        ),
    ),
}
SWEEPS: dict[str, tuple[float, ...]] = {
    'l': (5, 10, 15, 20, 30, 40),
    'beta': (1.25, 1.5, 2, 2.5, 3),
    'xi': (1, 2, 3, 4, 5, 6, 7),
    'sigma': (0, 0.25, 0.5, 1, 2, 4),
    'W': (4, 5, 7, 10, 14),
}


def sweep_configurations(
    parameter: str, values: Sequence[float] = ()
) -> tuple[Configuration, ...]:
    """
    Return one configuration a value of a parameter, all others at their defaults.

    :param parameter: l, beta, xi, sigma or W.
    :param values: values of the parameter; default: ``SWEEPS``.
    :raises SettingsError: no such parameter, or a value out of its range.
    """
    if parameter not in SWEEPS:
        raise SettingsError(f'parameter {parameter!r} is unknown: take one of {", ".join(SWEEPS)}')
    result = []
    for value in values or SWEEPS[parameter]:
        whole = parameter in ('l', 'xi', 'W')
        if whole and not float(value).is_integer():
            raise SettingsError(f'{parameter} = {value} must be a whole number')
        title = f'{parameter} = {value:g}'
        result.append(_vary(Configuration(f'{parameter}_{value:g}', title), parameter, value))
    return tuple(result)


def _vary(plain: Configuration, parameter: str, value: float) -> Configuration:
    if parameter == 'W':
        return replace(plain, strips=int(value))
    if parameter == 'l':
        return replace(plain, sequence=SequenceSettings(length=int(value)))
    if parameter == 'beta':
        return replace(plain, sequence=SequenceSettings(beta=value))
    spatial = SpatialSettings(xi=int(value)) if parameter == 'xi' else SpatialSettings(sigma=value)
    return replace(plain, spatial=spatial)


@dataclass(frozen=True)
class BaselineInputs:
    """
    Inputs of the baselines besides the images.

    :param arrays: descriptor files of map and query, by the name of the column.
    :param ssm_layers: two layers of the network of the features, for SSM-VPR.
    """

    arrays: dict[str, tuple[str, str]] = field(default_factory=dict)
    ssm_layers: tuple[str, str] | None = None


class DatasetExperiment:
    """
    Evaluates configurations on one data set; features are kept, since several columns share them.

    :param dataset: images and ground truth.
    :param kind, backbone: features, see :class:`stavpr_ros.features.FeatureExtractor`.
    :param mode: mode of the recognizer, ``paper`` or ``robust``.
    :param inputs: inputs of the baselines.
    """

    def __init__(
        self,
        dataset: Dataset,
        kind: str,
        backbone: Any,
        mode: str = 'paper',
        device: str = 'cpu',
        inputs: BaselineInputs | None = None,
    ) -> None:
        self._inputs = inputs or BaselineInputs()
        self._dataset, self._kind, self._backbone = dataset, kind, backbone
        self._mode, self._device = mode, device
        self._features: dict[tuple[int, int | None], tuple[Map, Map]] = {}

    def evaluate(self, configuration: Configuration) -> Metrics | None:
        """Return the metrics of one configuration; None without the inputs of its baseline."""
        if configuration.baseline == 'seqslam':
            return self._evaluate_seqslam(configuration)
        if configuration.baseline == 'ssm_vpr':
            return self._evaluate_ssm_vpr()
        if configuration.baseline == 'descriptors':
            return self._evaluate_descriptors(configuration.name)
        reference, query = self._maps(configuration)
        settings = RecognizerSettings(
            spatial=configuration.spatial,
            sequence=configuration.sequence,
            mode=configuration.mode or self._mode,
        )
        evaluation = evaluate_on_map(
            reference, query.features, self._dataset.ground_truth, settings
        )
        return evaluation.sequence if configuration.temporal else evaluation.single

    def _evaluate_descriptors(self, name: str) -> Metrics | None:
        """Match single images by the cosine distance of descriptors from files."""
        if name not in self._inputs.arrays:
            return None
        reference, query = (read_descriptors(path) for path in self._inputs.arrays[name])
        require_comparable(query, reference.settings, reference.dimension)
        counts = len(reference), len(query)
        expected = len(self._dataset.map), len(self._dataset.query)
        if counts != expected:
            raise SourceError(
                f'descriptors {" and ".join(self._inputs.arrays[name])} are of {counts} images: '
                f'expected {expected}'
            )
        settings = RecognizerSettings(mode='paper', spatial=NO_ALIGNMENT)
        truth = self._dataset.ground_truth
        return evaluate_on_map(descriptor_map(reference), query, truth, settings).single

    def _evaluate_ssm_vpr(self) -> Metrics | None:
        if self._inputs.ssm_layers is None:
            return None
        networks = [
            backbone_class(self._kind)(replace(self._backbone, layer=layer), self._device)
            for layer in self._inputs.ssm_layers
        ]

        def maps(source: FrameSource) -> list[torch.Tensor]:
            images = [frame.image for frame in source]
            return [
                torch.from_numpy(
                    np.concatenate([network.feature_maps([image]) for image in images])
                )
                for network in networks
            ]

        coarse, fine = maps(self._dataset.map)
        ssm = SsmVpr(coarse, fine)
        pairs = zip(*maps(self._dataset.query), strict=True)
        rankings = [ssm.recognize(first, second) for first, second in pairs]
        places = np.array([ranked[0] for ranked, _ in rankings])
        scores = np.array([1 - ranked[0] for _, ranked in rankings])  # lower is better
        return evaluate_ranking(Ranking(places[:, None], scores), self._dataset.ground_truth)

    def _evaluate_seqslam(self, configuration: Configuration) -> Metrics:
        settings = SeqSlamSettings(length=configuration.sequence.length)
        sources = (self._dataset.map, self._dataset.query)
        first, second = ((frame.image for frame in source) for source in sources)
        places, scores = seqslam(first, second, settings)
        return evaluate_ranking(Ranking(places[:, None], scores), self._dataset.ground_truth)

    def _maps(self, configuration: Configuration) -> tuple[Map, Map]:
        """Return the features of map and query."""
        key = (configuration.strips, configuration.projection)
        if key not in self._features:
            kind = self._kind, self._backbone
            extractor = FeatureExtractor(*kind, *key, device=self._device)
            self._features[key] = tuple(  # type: ignore[assignment]
                build_map(source, extractor, thumbnails=False, progress=False)
                for source in (self._dataset.map, self._dataset.query)
            )
        return self._features[key]
