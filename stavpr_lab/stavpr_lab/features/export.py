# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Any network to one ONNX file with the outputs ``global`` (n, D) and ``map`` (n, C, H, W).

A network in Python or TorchScript is a program of somebody else. It runs here, once, to be
recorded; nodes and maps only ever see the ONNX file, which is data. Requires the extra ``onnx``.
"""

from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
import importlib.util
import io
from pathlib import Path
import tempfile
from typing import Any
import warnings

import numpy as np
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.outputs import as_maps, one_of
from stavpr_ros.features.weights import last_line, open_model
import torch
from torch import nn

GLOBAL, MAP = 'global', 'map'
BATCH = 'stavpr_batch'  # property of a file: '1' = the images of a batch influence each other
TOLERANCE = 1e-3  # largest difference from the original, over the largest value
LARGEST = 2**31  # bytes of an ONNX file: limit of its format
OPSET = 17
CHECKED = 3  # random images that the file is verified on


@dataclass(frozen=True)
class Outputs:
    """
    What of a network becomes the outputs of the file.

    :param vector: number or key of the network's output (n, D); '' = no output ``global``.
    :param module: path of the module whose output is the map; '' = the network's own output.
    :param map: number or key of the output that is the map, or tokens; '' = no output ``map``.
    :param prefix_tokens: leading tokens that are no patches.
    """

    vector: str = '0'
    module: str = ''
    map: str = ''
    prefix_tokens: int = 1

    def __post_init__(self) -> None:
        if not self.vector and not self.map:
            raise SettingsError('neither a vector nor a map is chosen: name one of the outputs')


@dataclass(frozen=True)
class Exported:
    """
    An ONNX file that was verified against the original.

    :param content: the file.
    :param shapes: of each output for one image.
    :param difference: largest one from the original, over the largest value.
    :param batch: whether several images may be computed at once.
    """

    content: bytes
    shapes: dict[str, tuple[int, ...]]
    difference: float
    batch: bool


def load_hub(repository: str, commit: str, entry: str, arguments: Mapping[str, Any]) -> nn.Module:
    """
    Run an entry of a repository's ``hubconf.py``, which may do anything this user may.

    :param repository: ``OWNER/NAME`` on GitHub, or a folder.
    :param commit: 40 hexadecimal digits; '' for a folder.
    :raises UnavailableError: it cannot be had, or fails.
    """
    local = Path(repository).is_dir()
    if not local and (len(commit) != 40 or set(commit) - set('0123456789abcdef')):
        raise SettingsError(
            f'commit {commit!r} of {repository}: expected 40 digits 0-9 a-f; a branch or a tag '
            'would be another program tomorrow'
        )
    try:
        network = torch.hub.load(
            repository if local else f'{repository}:{commit}',
            entry,
            source='local' if local else 'github',
            trust_repo=True,
            **({} if local else {'skip_validation': True}),
            **arguments,
        )
    except Exception as error:  # any program may raise any error
        raise UnavailableError(
            f'entry {entry} of {repository} {commit} fails: {type(error).__name__}: '
            f'{last_line(error)}'
        ) from error
    if not isinstance(network, nn.Module):
        raise UnavailableError(
            f'entry {entry} of {repository} returns a {type(network).__name__}: expected a '
            'torch.nn.Module'
        )
    return network.module if isinstance(network, nn.DataParallel) else network


def load_torchscript(path: Path) -> nn.Module:
    """
    Load a TorchScript file, a program that may read and write files.

    :raises UnavailableError: it is none.
    """
    with open_model(path) as file:
        try:
            return torch.jit.load(file, map_location='cpu')
        except Exception as error:  # damaged files raise errors of any type
            raise UnavailableError(
                f'{path} is no usable TorchScript file: {last_line(error)}'
            ) from error


class Chosen(nn.Module):
    """The chosen outputs of a network, in the order vector, map."""

    def __init__(self, network: nn.Module, outputs: Outputs, image: torch.Tensor) -> None:
        super().__init__()
        self.network, self._outputs = network.eval().float(), outputs
        self._kept: list[Any] = []
        if outputs.module and isinstance(network, torch.jit.ScriptModule):
            raise SettingsError(
                f'module {outputs.module!r} of a TorchScript file cannot be an output: use '
                'features torchscript, which can, or export the network in Python'
            )
        if outputs.map and outputs.module:
            try:
                module = network.get_submodule(outputs.module)
            except AttributeError as error:
                names = [name for name, _ in network.named_modules() if name]
                raise SettingsError(
                    f'the network has no module {outputs.module!r}: its modules are '
                    f'{", ".join(names[:60])}'
                ) from error
            module.register_forward_hook(lambda *call: self._kept.append(call[-1]))
        self._side = 0
        self._side = self._tokens_side(image)

    def _tokens_side(self, image: torch.Tensor) -> int:
        """Check the outputs for one image; return the side of a map of tokens, 0 without."""
        vector, maps_or_tokens = self._both(image)
        name = f'output {self._outputs.vector or self._outputs.map!r}'
        if self._outputs.vector and (not isinstance(vector, torch.Tensor) or vector.ndim != 2):
            found = getattr(vector, 'shape', type(vector).__name__)
            raise SettingsError(f'{name} of the network is {found}: expected a vector (n, D)')
        if not self._outputs.map:
            return 0
        name = f'module {self._outputs.module!r}' if self._outputs.module else name
        maps = as_maps(maps_or_tokens, 1, self._outputs.prefix_tokens, name)
        if maps.ndim != 4:
            raise SettingsError(f'{name} returns vectors {tuple(maps.shape)}: expected a map')
        return maps.shape[2] if maps_or_tokens.ndim == 3 else 0

    def _both(self, images: torch.Tensor) -> tuple[Any, Any]:
        chosen = self._outputs
        self._kept.clear()
        returned = self.network(images)
        vector = one_of(returned, chosen.vector, 'the network') if chosen.vector else None
        if not chosen.map:
            return vector, None
        if chosen.module:
            if not self._kept:
                raise SettingsError(f'module {chosen.module!r} is not called by the network')
            returned = self._kept[-1]
        return vector, one_of(returned, chosen.map, chosen.module or 'the network')

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the chosen outputs of images (n, 3, size, size)."""
        vector, maps = self._both(images)
        if self._side:
            maps = maps[:, self._outputs.prefix_tokens :].transpose(1, 2)
            maps = maps.unflatten(2, (self._side, self._side))
        return tuple(value for value in (vector, maps) if value is not None)


def export_network(network: nn.Module, outputs: Outputs, size: int) -> Exported:
    """
    Record a network as an ONNX file, and verify it on random images.

    The reference are the original's outputs for single images. If the file equals them for a batch
    as well, batches are permitted; else the file states that it takes one image at a time.

    :param size: side of the images, pixels.
    :raises SettingsError: the network has no such outputs.
    :raises UnavailableError: it cannot be recorded, or the file computes something else.
    """
    weights = sum(value.nbytes for value in network.state_dict().values())
    if weights >= LARGEST:
        raise UnavailableError(
            f'the network has {weights / 1e9:.1f} GB of weights, more than an ONNX file holds '
            '(2 GiB): compute its descriptors with its own program, and give those'
        )
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(CHECKED, 3, size, size, generator=generator)
    with torch.inference_mode():
        chosen = Chosen(network, outputs, images[:1])
    with torch.no_grad():
        singles = [chosen(image[None]) for image in images]
        references = [torch.cat(parts).numpy() for parts in zip(*singles, strict=True)]
    names = [name for name, kept in ((GLOBAL, outputs.vector), (MAP, outputs.map)) if kept]
    if not all(np.isfinite(reference).all() for reference in references):
        raise UnavailableError('the network returns NaN or infinite numbers for random images')
    reasons = []
    for batch, step in ((2, CHECKED), (1, 1)):  # recorded with two images; else with one
        try:
            content = _recorded(chosen, images[:batch], names, alone=step == 1)
            difference = _difference(content, names, images.numpy(), references, step)
        except Exception as error:  # of the network, the recorder and the runtime
            reasons.append(last_line(error))
            continue
        if difference <= TOLERANCE:
            shapes = {n: (1, *r.shape[1:]) for n, r in zip(names, references, strict=True)}
            return Exported(content, shapes, difference, step > 1)
        reasons.append(f'its outputs differ by {difference:.2g}')
    raise UnavailableError(
        f'the network cannot be exported. Recorded with two images: {reasons[0]}. With one: '
        f'{reasons[1]}'
    )


def _recorded(chosen: Chosen, images: torch.Tensor, names: list[str], alone: bool) -> bytes:
    onnx = _import_onnx()
    with (
        tempfile.TemporaryDirectory() as folder,
        warnings.catch_warnings(),
        redirect_stdout(io.StringIO()),  # the whole graph, in case of an error
        torch.no_grad(),
    ):
        path = Path(folder) / 'recorded.onnx'
        warnings.simplefilter('ignore')  # of recording sizes as constants: the result is verified
        # the recorder takes a TorchScript file itself only, not within another module
        script = isinstance(chosen.network, torch.jit.ScriptModule)
        torch.onnx.export(
            chosen.network if script else chosen,
            (images,),
            path,
            input_names=['image'],
            output_names=names,
            dynamic_axes=None if alone else {name: {0: 'batch'} for name in ('image', *names)},
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load_model_from_string(path.read_bytes())
    if alone:
        onnx.helper.set_model_props(model, {BATCH: '1'})
    return model.SerializeToString()


def export_onnx(content: bytes, outputs: Outputs, size: int) -> Exported:
    """
    Give outputs of an ONNX file the names ``global`` and ``map``, and verify it.

    :param outputs: names of tensors as vector and map; ``module`` is not used.
    :raises SettingsError: no such tensor, or another shape.
    :raises UnavailableError: the file cannot be run.
    """
    onnx = _import_onnx()
    model = onnx.load_model_from_string(content)
    graph = model.graph
    weights = {tensor.name for tensor in graph.initializer}
    images_in = [value for value in graph.input if value.name not in weights]
    if len(images_in) != 1:
        raise SettingsError(f'there are {len(images_in)} inputs: expected one, the image')
    tensor_type = images_in[0].type.tensor_type
    tensor_type.shape.dim[0].dim_param = 'batch'
    del graph.value_info[:]  # it may fix the batch size
    content = model.SerializeToString()
    tensors = [name for node in graph.node for name in node.output]
    for wanted in filter(None, (outputs.vector, outputs.map)):
        if wanted not in tensors:
            raise SettingsError(
                f'there is no tensor {wanted!r}: they are {", ".join(tensors[:60])}'
            )
    run = _runner(_with_outputs(onnx, content, [t for t in (outputs.vector, outputs.map) if t]))
    images = np.random.default_rng(0).standard_normal((CHECKED, 3, size, size)).astype(np.float32)
    singles = [[torch.from_numpy(a) for a in run(image[None])] for image in images]
    originals = [torch.cat(parts) for parts in zip(*singles, strict=True)]
    names, references = [], []
    for name, tensor, found in zip(
        [n for n, t in ((GLOBAL, outputs.vector), (MAP, outputs.map)) if t],
        [t for t in (outputs.vector, outputs.map) if t],
        originals,
        strict=True,
    ):
        maps = as_maps(found, CHECKED, outputs.prefix_tokens, f'tensor {tensor!r}')
        if maps.ndim != (2 if name == GLOBAL else 4):
            raise SettingsError(f'tensor {tensor!r} is {tuple(found.shape)}: it is no {name}')
        nodes = _renaming(onnx, tensor, name, found, maps, outputs.prefix_tokens)
        for node, constants in nodes:
            graph.node.append(node)
            graph.initializer.extend(constants)
        names.append(name)
        references.append(maps.numpy())
    del graph.output[:]
    graph.output.extend(
        onnx.helper.make_tensor_value_info(
            name, tensor_type.elem_type, ['batch', *reference.shape[1:]]
        )
        for name, reference in zip(names, references, strict=True)
    )
    content = model.SerializeToString()
    reason = ''
    for step in (CHECKED, 1):
        try:
            difference = _difference(content, names, images, references, step)
        except Exception as error:  # a batch size that the file does not take
            reason = f': {last_line(error)}'
            continue
        if difference <= TOLERANCE:
            if step == 1:
                onnx.helper.set_model_props(model, {BATCH: '1'})
            shapes = {n: (1, *r.shape[1:]) for n, r in zip(names, references, strict=True)}
            return Exported(model.SerializeToString(), shapes, difference, step > 1)
    raise UnavailableError(f'the file with the new outputs computes something else{reason}')


def _renaming(
    onnx: Any, tensor: str, name: str, found: torch.Tensor, maps: torch.Tensor, prefix: int
) -> list[tuple[Any, list[Any]]]:
    """Return the nodes from a tensor to an output, and their constants."""
    node = onnx.helper.make_node
    if found.ndim > maps.ndim:
        return [(node('Flatten', [tensor], [name], axis=1), [])]
    if tensor == name and found.ndim == maps.ndim:
        return []
    if found.ndim == maps.ndim:
        return [(node('Identity', [tensor], [name]), [])]

    def constant(part: str, values: list[int]) -> Any:
        return onnx.numpy_helper.from_array(np.array(values, np.int64), f'{name}/{part}')

    slices = [constant('first', [prefix]), constant('end', [2**31]), constant('axis', [1])]
    cut, turned = f'{name}/patches', f'{name}/channels'
    return [
        (node('Slice', [tensor, *(c.name for c in slices)], [cut]), slices),
        (node('Transpose', [cut], [turned], perm=[0, 2, 1]), []),
        (
            node('Reshape', [turned, f'{name}/shape'], [name]),
            [constant('shape', [0, *maps.shape[1:]])],
        ),
    ]


def _with_outputs(onnx: Any, content: bytes, names: list[str]) -> bytes:
    model = onnx.load_model_from_string(content)
    del model.graph.output[:]
    model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    return model.SerializeToString()


def _difference(
    content: bytes,
    names: list[str],
    images: np.ndarray,
    references: list[np.ndarray],
    step: int,
) -> float:
    """Return the largest difference of a file's outputs, ``step`` images at a time."""
    run = _runner(content)
    largest = 0.0
    for first in range(0, len(images), step):
        found = run(images[first : first + step])
        for output, reference in zip(found, references, strict=True):
            expected = reference[first : first + step]
            if output.shape != expected.shape:
                raise UnavailableError(f'shape {output.shape}, expected {expected.shape}')
            scale = max(float(abs(expected).max()), 1e-12)
            largest = max(largest, float(abs(output - expected).max()) / scale)
    return largest


def _runner(content: bytes) -> Callable[[np.ndarray], list[np.ndarray]]:
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=['CPUExecutionProvider'])
    image = session.get_inputs()[0]
    dtype = np.float16 if image.type == 'tensor(float16)' else np.float32

    def run(images: np.ndarray) -> list[np.ndarray]:
        outputs = session.run(None, {image.name: images.astype(dtype)})
        return [output.astype(np.float32) for output in outputs]

    return run


def _import_onnx() -> Any:
    for name in ('onnx', 'onnxruntime'):
        if importlib.util.find_spec(name) is None:
            raise UnavailableError('export_model needs the packages onnx and onnxruntime')
    import onnx

    return onnx
