# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure the scales of the network in int8: the committed table of stavpr_ros/features.

``python benchmarks/int8_scales.py``. Of each layer without ReLU6, the range of 256 values whose
mean square error is the least, on 30 images of each of SETS. Requires the package onnx.
"""

import json
from pathlib import Path

from data import data_folder
import numpy as np
import onnx
from stavpr_ros.features import efficientnet_lite_file as lite
from stavpr_ros.features.efficientnet_lite import MEAN, STD
from stavpr_ros.features.onnx import Onnx
from stavpr_ros.features.registry import OnnxSettings
from stavpr_ros.sources import open_source

SETS = (
    'gardens_point/day_left', 'corridor/ref', 'running_track/lap1', 'nordland_64x32/summer',
    'tower/basement0', 'donkeycar_hall',
)  # fmt: skip
IMAGES = 30
VALUES = 4000  # of a layer and an image


def scale_of(values: np.ndarray) -> tuple[float, int]:
    """Return the scale, of 4 digits, and the zero point."""
    errors = {}
    for share in np.linspace(0.2, 1, 41):
        low, high = share * values.min(), share * values.max()
        scale = float(f'{(high - low) / 255:.4g}')
        zero = int(np.clip(np.rint(-low / scale), 0, 255))
        steps = np.clip(np.rint(values / scale), -zero, 255 - zero)
        errors[scale, zero] = np.square(steps * scale - values).mean()
    return min(errors, key=lambda key: errors[key])


def main() -> None:
    """Write the table."""
    images = []
    for name in SETS:
        frames = [frame.image for frame in open_source(data_folder() / name)]
        images += [frames[i] for i in np.linspace(0, len(frames) - 1, IMAGES).astype(int)]
    model = str(lite.find_file())
    nodes = onnx.load(model).graph.node
    sums = [node.output[0] for node in nodes if node.op_type == 'Add'][:-1]
    layers = [node.output[0] for node in nodes if node.output[0].endswith('_project_conv')] + sums
    table = {}
    common = {'model': model, 'resize': 'area', 'scale': 1.0, 'mean': MEAN, 'std': STD}
    for layer in layers:
        network = Onnx(OnnxSettings(layer=layer, **common))
        rng = np.random.default_rng(0)
        maps = (network.feature_maps([image]).ravel() for image in images)
        table[layer] = scale_of(np.concatenate([rng.choice(one, VALUES) for one in maps]))
    path = Path(lite.__file__).with_name(lite.SCALES)
    path.write_text(json.dumps(table).replace('], ', '],\n') + '\n')


if __name__ == '__main__':
    main()
