# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The learned network in int8 beside float32: cosines of its maps, time of 640x480 on one thread.

``python benchmarks/int8_network.py``; ``--scales`` measures and writes its committed table first:
of each layer without ReLU6, the 256 values with the least mean square error on images of FITTED.
"""

from functools import partial
from itertools import product
import json
from pathlib import Path
import time

import cv2
from data import data_folder
import numpy as np
import onnx
from results import parser_of
from stavpr_ros.features import efficientnet_lite_file as lite
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.efficientnet_lite import EfficientNetLite1, MEAN, STD
from stavpr_ros.features.onnx import Onnx
from stavpr_ros.features.registry import EfficientNetSettings, OnnxSettings, settings_class
from stavpr_ros.sources import open_source
from timing import measure

FITTED = (
    'gardens_point/day_left', 'corridor/ref', 'running_track/lap1', 'nordland_64x32/summer',
    'tower/basement0', 'donkeycar_hall',
)  # fmt: skip
LEFT_OUT = (
    'gardens_point/day_right', 'walk_by_night/right_night', 'office_circuit/day1',
    'running_track/lap2', 'nordland_64x32/winter', 'rtabmap_hallway_loop/samples', 'tower/floor8',
)  # fmt: skip
IMAGES = 30  # of a set
VALUES = 4000  # of a layer and an image


def images_of(name: str) -> list[np.ndarray]:
    """Return images of a set, evenly."""
    frames = list(open_source(data_folder() / name))
    return [frames[i].image for i in np.linspace(0, len(frames) - 1, IMAGES).astype(int)]


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


def write_scales() -> None:
    """Measure the table, write it and the network."""
    images, model = [image for name in FITTED for image in images_of(name)], lite.find_file()
    nodes, table = onnx.load(model).graph.node, {}
    sums = [node.output[0] for node in nodes if node.op_type == 'Add'][:-1]
    for layer in [n.output[0] for n in nodes if n.output[0].endswith('_project_conv')] + sums:
        network = Onnx(
            OnnxSettings(model=str(model), layer=layer, resize='area', scale=1, mean=MEAN, std=STD)
        )
        rng = np.random.default_rng(0)
        maps = (network.feature_maps([image]).ravel() for image in images)
        table[layer] = scale_of(np.concatenate([rng.choice(one, VALUES) for one in maps]))
    text = json.dumps(table).replace('], ', '],\n')
    Path(lite.__file__).with_name(lite.SCALES).write_text(f'{text}\n')
    lite.make_file('int8')


def seconds_of(extractor: FeatureExtractor, image: np.ndarray) -> float:
    """Return the processor time of an image, on one thread."""
    began = time.thread_time()
    extractor.extract([image])
    return time.thread_time() - began


def main() -> None:
    """Write the table, if asked to; print the comparison."""
    parser = parser_of(__doc__)
    parser.add_argument('--scales', action='store_true', help='measure and write these first')
    if parser.parse_args().scales:
        write_scales()
    networks = {name: EfficientNetLite1(EfficientNetSettings(model=name)) for name in lite.FILES}
    for name in LEFT_OUT:
        images = images_of(name)
        maps = [net.feature_maps(images).reshape(IMAGES, -1) for net in networks.values()]
        unit = [rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in maps]
        cosines = np.sum(unit[0] * unit[1], axis=1)
        print(f'{name}: cosine {cosines.min():.3f} at least, median {np.median(cosines):.3f}')
    image = cv2.resize(images[0], (640, 480))
    jobs = {}
    for kind, name in product(('efficientnet_lite1', 'hybrid'), lite.FILES):
        extractor = FeatureExtractor(kind, settings_class(kind)(model=name))
        jobs[f'{kind} {name}'] = partial(seconds_of, extractor, image)
    for name, timing in measure(jobs, seconds=3).items():
        print(f'{name}: {1e3 * timing.median_s:.2f} ms, spread {1e3 * timing.spread_s:.2f}')


if __name__ == '__main__':
    main()
