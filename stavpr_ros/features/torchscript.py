"""
Features of any convolutional network in a TorchScript file, its own output or that of an inner layer.

A TorchScript file is a program that torch interprets. It holds no Python, but a malicious one may reach
files through torch's operators: take such files only from where you would take a program.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.batch import BatchMaker
from stavpr_ros.features.onnx import OnnxSettings
from stavpr_ros.features.paper_networks import check_hash
from stavpr_ros.features.registry import setting
from stavpr_ros.features.weights import open_weights, promised_hash


@dataclass(frozen=True)
class TorchScriptSettings(OnnxSettings):
    """Settings of the TorchScript features: those of the ONNX features, the layer and precision optional."""

    model: str = setting(help='the TorchScript file', identity=False)
    layer: str = setting(
        '', help="module whose output to use, such as features.23, a map (n, C, H, W); empty = the file's own"
    )
    half: bool = setting(
        False, help='float16 on a GPU: faster, hardly other features; no change on a CPU', identity=False
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_hash(self.sha256)


class TorchScript:
    """Feature maps of a network in a TorchScript file, float32 (float16 with ``half`` on a GPU)."""

    Settings = TorchScriptSettings

    def __init__(self, settings: TorchScriptSettings, device: str = 'cpu') -> None:
        self._device = torch.device(device)
        path = Path(settings.model)
        file, digest = open_weights(path, promised_hash(path), settings.sha256)
        with file:
            try:
                network = torch.jit.load(file, map_location=self._device).eval()
            except Exception as error:  # what damaged files raise is not bounded
                raise UnavailableError(f'{path} is no usable TorchScript file: {_brief(error)}') from error
        self.settings = replace(settings, sha256=digest)
        dtype = torch.float16 if settings.half and self._device.type == 'cuda' else torch.float32
        network = network.to(dtype)
        self._maps = up_to_module(network, settings.layer, settings.model) if settings.layer else network
        self._batch = BatchMaker(
            settings.size,
            settings.resize,
            self._device,
            dtype,
            settings.scale,
            settings.mean,
            settings.std,
            settings.channels == 'bgr',
        )

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """
        Describe a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size; resized without keeping the aspect.
        :returns: shape (n, C, H, Wf), float32, or float16 with ``half`` on a GPU.
        :raises SettingsError: the network does not take such a batch, or the layer is no map with four axes.
        """
        settings = self.settings
        try:
            with torch.inference_mode():
                maps = self._maps(self._batch(images))
        except Exception as error:  # operators raise types of their own
            raise SettingsError(
                f'{settings.model} does not take {len(images)} images of size {settings.size}: '
                f'{_brief(error)}'
            ) from error
        if not isinstance(maps, torch.Tensor) or maps.ndim != 4 or len(maps) != len(images):
            came = tuple(maps.shape) if isinstance(maps, torch.Tensor) else f'type {type(maps).__name__}'
            raise SettingsError(
                f'layer {settings.layer!r} of {settings.model} gives {came} for {len(images)} images: '
                'expected a map (n, C, H, W); name a layer before the pooling'
            )
        return maps


def _brief(error: Exception) -> str:
    """Return the last line of an error of torch: those before it are a trace of the program."""
    return str(error).strip().split('\n')[-1] or type(error).__name__


def up_to_module(network: torch.jit.ScriptModule, layer: str, name: str) -> Callable[[torch.Tensor], Any]:
    """
    Return a function of the images that gives what an inner module gives, and computes nothing after it.

    :param layer: path of the module, such as ``features.23``; called several times, its last call counts.
    :param name: of the file, for errors.
    :raises SettingsError: there is no such module, or its call is not in the open.
    """
    modules = [path for path, _ in network.named_modules() if path]
    if layer not in modules:
        shown = ', '.join(modules[:60]) + (', ...' if len(modules) > 60 else '') if modules else 'none'
        raise SettingsError(f'{name} has no layer {layer!r}: its layers are {shown}')
    cuts: list[tuple[_Cut, Any]] = []  # and the module whose program is cut
    module, method = network._c, 'forward'
    rest = layer.split('.')
    while rest:
        cut = _before_call(module._get_method(method).graph.copy(), rest)
        if cut is None:
            raise SettingsError(
                f'{name} has the layer {layer!r}, but calls it in a branch or loop, or not at all: '
                'make the file with torch.jit.trace, or of the part up to this layer'
            )
        cuts.append((cut, module))
        for part in cut.path:
            module = module.getattr(part)
        method, rest = cut.method, rest[len(cut.path) :]
    inner = module._get_method(method)

    def run(images: torch.Tensor) -> Any:
        values: tuple[Any, ...] = (images,)
        for cut, owner in cuts:
            given = cut.program(owner, *values)
            values = given if cut.arguments > 1 else (given,)
        return inner(*values)

    return run


class _Cut(NamedTuple):
    """A module's program, cut off before it calls another module."""

    program: Callable[..., Any]  # gives the arguments of that call, a tuple if there are several
    arguments: int  # their number
    path: list[str]  # of the called module
    method: str  # that is called: forward, or in a traced file forward1 and so on for further calls


def _before_call(graph: Any, path: list[str]) -> _Cut | None:
    """Cut a program off before its last call of the first module on a path; None without such a call."""
    nodes = list(graph.nodes())
    for i in reversed(range(len(nodes))):
        if nodes[i].kind() != 'prim::CallMethod' or not re.fullmatch(r'forward\d*', nodes[i].s('name')):
            continue
        callee, *arguments = nodes[i].inputs()
        names, method = _names_of(callee), nodes[i].s('name')
        if not names or path[: len(names)] != names:
            continue
        for _ in list(graph.outputs()):
            graph.eraseOutput(0)
        for value in arguments:
            graph.registerOutput(value)
        for node in reversed(nodes[i:]):
            node.destroy()
        if len(arguments) > 1:
            graph.makeMultiOutputIntoTuple()
        return _Cut(torch._C._create_function_from_graph('cut', graph), len(arguments), names, method)
    return None


def _names_of(value: Any) -> list[str]:
    """Return the attributes that lead from the module itself to one inside it."""
    names: list[str] = []
    while value.node().kind() == 'prim::GetAttr':
        names.insert(0, value.node().s('name'))
        value = next(value.node().inputs())
    return names
