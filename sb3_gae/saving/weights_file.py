"""
Files of weights and settings that hold nothing to execute.

The layout is that of `safetensors <https://github.com/huggingface/safetensors>`_: the length of a header, the header in JSON,
and numbers. Settings are JSON in the header's metadata, beside a checksum of all the rest. Saved models of SB3 can be read,
too: of their JSON what is plain, and of their tensors what torch reads with ``weights_only=True``.
"""

import hashlib
import io
import json
import math
import struct
import zipfile
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch as th

_FORMAT = "sb3_gae weights 1"
_DTYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "U8": "|u1", "BOOL": "|b1"}
_NAMES = {np.dtype(code): name for name, code in _DTYPES.items()}

# Of an archive, uncompressed over compressed: SB3 does not compress at all
_LARGEST_RATIO = 100


class WeightsFile(NamedTuple):
    """
    :param tensors: of a policy, by name
    :param settings: plain values, by name; to be checked before use
    """

    tensors: dict[str, th.Tensor]
    settings: dict[str, Any]


def weights_content(tensors: Mapping[str, th.Tensor], settings: Mapping[str, Any]) -> bytes:
    """
    :param tensors: by name
    :param settings: that JSON can write
    :return: what to write into a file
    :raises ValueError: if a tensor is of a type that the format does not know
    """
    table, parts, offset = {}, [], 0
    for name, tensor in tensors.items():
        array = np.asarray(tensor.detach().cpu(), order="C")
        if array.dtype not in _NAMES:
            raise ValueError(f"Tensors must be of {', '.join(map(str, _NAMES))}, but {name!r} is of {array.dtype}.")
        table[name] = {"dtype": _NAMES[array.dtype], "shape": [*array.shape], "data_offsets": [offset, offset + array.nbytes]}
        parts.append(array.tobytes())
        offset += array.nbytes
    data, written = b"".join(parts), json.dumps(settings, allow_nan=False)
    metadata = {"format": _FORMAT, "settings": written, "sha256": _digest(table, written, data)}
    header = json.dumps({"__metadata__": metadata, **table}).encode()
    # Numbers begin at a multiple of their size
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + data


def read_weights(content: bytes) -> WeightsFile:
    """
    :param content: of a file, which may be from anybody
    :return: what is in it
    :raises ValueError: if it is damaged, or is something else; nothing in it is ever executed
    """
    try:
        return _read_archive(content) if content[:2] == b"PK" else _read_tensors(content)
    except ValueError:
        raise
    # Whatever a parser makes of a hostile file
    except Exception as error:
        raise ValueError(f"The file is damaged, or holds no weights: {type(error).__name__}: {error}") from error


def _read_tensors(content: bytes) -> WeightsFile:
    if len(content) < 8 or (length := struct.unpack("<Q", content[:8])[0]) > len(content) - 8:
        raise ValueError("The file is damaged, or holds no weights: its header is longer than the file.")
    table = json.loads(content[8 : 8 + length].decode())
    data = memoryview(content)[8 + length :]
    metadata = table.pop("__metadata__", None) if isinstance(table, dict) else None
    if not isinstance(metadata, dict) or metadata.get("format") != _FORMAT:
        raise ValueError("The file holds no weights of TRPOGAE: `save_weights` writes such files.")
    if metadata.get("sha256") != _digest(table, metadata["settings"], data):
        raise ValueError("The file is damaged: its checksum is wrong.")
    settings = json.loads(metadata["settings"])
    if not isinstance(settings, dict):
        raise ValueError("The file is damaged: its settings are no dictionary.")
    return WeightsFile({name: _tensor(name, entry, data) for name, entry in table.items()}, settings)


def _tensor(name: str, entry: dict[str, Any], data: memoryview) -> th.Tensor:
    (begin, end), shape, code = entry["data_offsets"], entry["shape"], _DTYPES.get(entry["dtype"])
    whole = all(type(number) is int and number >= 0 for number in (begin, end, *shape))
    if code is None or not whole or not begin <= end <= len(data):
        raise ValueError(f"The file is damaged: there is no tensor {name!r} where its header says.")
    if math.prod(shape) * np.dtype(code).itemsize != end - begin:
        raise ValueError(f"The file is damaged: the shape of {name!r} does not fit its length.")
    return th.from_numpy(np.frombuffer(data[begin:end], dtype=code).reshape(shape).copy())


def _digest(table: Any, settings: str, data: bytes | memoryview) -> str:
    digest = hashlib.sha256(json.dumps([table, settings], sort_keys=True).encode())
    digest.update(data)
    return digest.hexdigest()


def _read_archive(content: bytes) -> WeightsFile:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.infolist():
            if member.file_size > _LARGEST_RATIO * max(member.compress_size, 1024):
                raise ValueError(f"{member.filename!r} in the archive is compressed suspiciously well.")
        if (damaged := archive.testzip()) is not None:
            raise ValueError(f"The file is damaged: the checksum of {damaged!r} is wrong.")
        saved, weights = json.loads(archive.read("data")), archive.read("policy.pth")
    tensors = th.load(io.BytesIO(weights), map_location="cpu", weights_only=True)
    if not isinstance(saved, dict) or not isinstance(tensors, dict):
        raise ValueError("The file is damaged: it holds no dictionary of settings, or none of tensors.")
    if not all(isinstance(name, str) and isinstance(tensor, th.Tensor) for name, tensor in tensors.items()):
        raise ValueError("The file is damaged: the parameters of its policy are no tensors.")
    return WeightsFile(dict(tensors), {name: _plain_part(value) for name, value in saved.items()})


def _plain_part(value: Any) -> Any:
    """SB3 writes beside a pickled dictionary what of it is plain, and of the rest a description."""
    if isinstance(value, dict) and ":serialized:" in value:
        return {name: part for name, part in value.items() if name not in (":type:", ":serialized:")}
    return value
