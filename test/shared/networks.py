# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A second implementation of the paper's networks: their shapes and computations."""

import torch
from torch.nn.functional import avg_pool2d, conv2d, max_pool2d, relu

VGG16 = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
DENSENET161 = (6, 12, 36, 24)


def vgg16_shapes(classes: int = 1000) -> dict[str, tuple[int, ...]]:
    """Return the shapes of configuration D: 3 x 3 convolutions with bias, a pooling per stage."""
    shapes, index, before = {}, 0, 3
    for stage in VGG16:
        for width in stage:
            shapes[f'features.{index}.weight'] = (width, before, 3, 3)
            shapes[f'features.{index}.bias'] = (width,)
            index, before = index + 2, width
        index += 1
    for index, out, into in ((0, 4096, 25088), (3, 4096, 4096), (6, classes, 4096)):
        shapes[f'classifier.{index}.weight'], shapes[f'classifier.{index}.bias'] = (
            (out, into),
            (out,),
        )
    return shapes


def vgg16_pool4(p: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    index = 0
    for stage in VGG16[:4]:
        for _ in stage:
            x = relu(
                conv2d(x, p[f'features.{index}.weight'], p[f'features.{index}.bias'], padding=1)
            )
            index += 2
        x = max_pool2d(x, 2)
        index += 1
    return x


def densenet161_shapes(classes: int = 365) -> dict[str, tuple[int, ...]]:
    """Growth 48, bottleneck 192, 96 channels at first, half of them kept between blocks."""
    shapes: dict[str, tuple[int, ...]] = {}

    def norm(name: str, width: int) -> None:
        for part in ('weight', 'bias', 'running_mean', 'running_var'):
            shapes[f'features.{name}.{part}'] = (width,)

    def conv(name: str, out: int, into: int, side: int) -> None:
        shapes[f'features.{name}.weight'] = (out, into, side, side)

    conv('conv0', 96, 3, 7)
    norm('norm0', 96)
    width = 96
    for b, layers in enumerate(DENSENET161, start=1):
        for i in range(1, layers + 1):
            layer = f'denseblock{b}.denselayer{i}'
            norm(f'{layer}.norm1', width)
            conv(f'{layer}.conv1', 192, width, 1)
            norm(f'{layer}.norm2', 192)
            conv(f'{layer}.conv2', 48, 192, 3)
            width += 48
        if b < 4:
            norm(f'transition{b}.norm', width)
            conv(f'transition{b}.conv', width // 2, width, 1)
            width //= 2
    norm('norm5', width)
    shapes['classifier.weight'], shapes['classifier.bias'] = (classes, width), (classes,)
    return shapes


def densenet161_layer10(p: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """Up to the first ReLU of the tenth layer of block 4; each step as the paper has it."""

    def norm_relu(name: str, x: torch.Tensor) -> torch.Tensor:
        weight, bias, mean, var = (
            p[f'features.{name}.{part}'].view(1, -1, 1, 1)
            for part in ('weight', 'bias', 'running_mean', 'running_var')
        )
        return relu((x - mean) / torch.sqrt(var + 1e-5) * weight + bias)

    def conv(name: str, x: torch.Tensor, stride: int = 1, padding: int = 0) -> torch.Tensor:
        return conv2d(x, p[f'features.{name}.weight'], stride=stride, padding=padding)

    x = max_pool2d(norm_relu('norm0', conv('conv0', x, 2, 3)), 3, 2, 1)
    for b, layers in enumerate(DENSENET161, start=1):
        maps = [x]
        for i in range(1, layers + 1):
            layer = f'denseblock{b}.denselayer{i}'
            if (b, i) == (4, 10):
                break
            narrow = conv(f'{layer}.conv1', norm_relu(f'{layer}.norm1', torch.cat(maps, 1)))
            maps.append(conv(f'{layer}.conv2', norm_relu(f'{layer}.norm2', narrow), padding=1))
        x = torch.cat(maps, 1)
        if b < 4:
            x = avg_pool2d(conv(f'transition{b}.conv', norm_relu(f'transition{b}.norm', x)), 2)
    return norm_relu('denseblock4.denselayer10.norm1', x)
