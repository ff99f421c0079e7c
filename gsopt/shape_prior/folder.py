"""A shape prior on disk: numbers and words as JSON, weights as safetensors; nothing in it is code.

The folder is untrusted: names, shapes and types of all tensors are compared with those of the network that the JSON
describes before any memory is taken, and every weight must be finite.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gsopt.data.files import is_regular, read_json
from gsopt.errors import GsoptError, InputError
from gsopt.events import to_json, write_atomic
from gsopt.shape_prior.network import NetworkConfig, ShapeNetwork

FORMAT = "gsopt-shape-prior-1"
CARD_FILE = "gsopt_shape_prior.json"
MAX_SHARD_BYTES = 14_000_000
MAX_SHARDS, MAX_PARAMETERS = 100, 400_000_000
MAX_VOCABULARY, MAX_WORD_LENGTH = 50_000, 80
IMAGE_SIDES = (16, 256)
"""Smallest and largest side of the crops that a prior learned from, px."""


@dataclass(frozen=True)
class ShapePrior:
    """A trained network, the words it knows, and the side of the crops that it takes, px."""

    network: ShapeNetwork
    config: NetworkConfig
    vocabulary: tuple[str, ...]
    image_side: int
    digest: str = ""
    """A hash of the weights in its folder."""


def write_weights(out: Path, prior: ShapePrior) -> None:
    """Writes the weights in half precision; `write_card` completes the folder."""
    for file in out.glob("weights_*.safetensors"):
        file.unlink()
    shards: list[dict[str, Tensor]] = [{}]
    taken = 0
    for name, value in prior.network.state_dict().items():
        half = value.detach().cpu().half().contiguous()
        if taken + 2 * half.numel() > MAX_SHARD_BYTES and shards[-1]:
            shards.append({})
            taken = 0
        shards[-1][name] = half
        taken += 2 * half.numel()
    for index, shard in enumerate(shards):
        write_atomic(out / f"weights_{index:02d}.safetensors", save(shard))


def write_card(out: Path, prior: ShapePrior, measured: Mapping[str, Any]) -> None:
    """Writes the card, last: a folder with a card is complete."""
    described = {
        "format": FORMAT,
        "network": asdict(prior.config),
        "image_side": prior.image_side,
        "vocabulary": list(prior.vocabulary),
        "measured": dict(measured),
    }
    write_atomic(out / CARD_FILE, to_json(described))


def read_prior(folder: Path) -> ShapePrior:
    """Raises InputError for a folder that is missing, broken or none of a shape prior."""
    described = _described(folder)
    try:
        config, vocabulary, side = _checked(described)
        with torch.device("meta"):
            network = ShapeNetwork(config, len(vocabulary) + 1)
        wanted = {name: list(value.shape) for name, value in network.state_dict().items()}
        if sum(value.numel() for value in network.state_dict().values()) > MAX_PARAMETERS:
            raise ValueError(f"it describes more than {MAX_PARAMETERS:,} parameters")
        weights, digest = _weights(folder, wanted)
        network.load_state_dict(weights, assign=True)
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError, GsoptError) as error:
        raise _broken(folder, str(error) or type(error).__name__) from error
    return ShapePrior(network.eval().requires_grad_(False), config, vocabulary, side, digest)


def _described(folder: Path) -> dict[str, Any]:
    if not is_regular(folder / CARD_FILE):
        raise InputError(
            f"{folder} holds no shape prior: {CARD_FILE} is missing. Train one with `gsopt finetune --shape`; gsopt "
            "ships none, because none has beaten the shape library."
        )
    try:
        return read_json(folder / CARD_FILE)
    except InputError as error:
        raise _broken(folder, str(error).splitlines()[0]) from error


def _checked(described: dict[str, Any]) -> tuple[NetworkConfig, tuple[str, ...], int]:
    """Raises ValueError or TypeError."""
    if described.get("format") != FORMAT:
        raise ValueError(f"it is no {FORMAT}")
    sizes = described["network"]
    if not isinstance(sizes, dict) or set(sizes) != {field.name for field in fields(NetworkConfig)}:
        raise ValueError("`network` does not list side, widths and blocks")
    whole = [sizes["side"], sizes["blocks"], described["image_side"], *sizes["widths"]]
    if not all(isinstance(number, int) and not isinstance(number, bool) for number in whole):
        raise ValueError("side, widths, blocks and image_side must be whole numbers")
    words = described["vocabulary"]
    if not isinstance(words, list) or len(words) > MAX_VOCABULARY:
        raise ValueError(f"`vocabulary` must be a list of at most {MAX_VOCABULARY:,} words")
    if not all(isinstance(word, str) and 0 < len(word) <= MAX_WORD_LENGTH for word in words):
        raise ValueError(f"`vocabulary` holds other than words of at most {MAX_WORD_LENGTH} letters")
    if not IMAGE_SIDES[0] <= described["image_side"] <= IMAGE_SIDES[1]:
        raise ValueError(f"image_side must be {IMAGE_SIDES[0]} to {IMAGE_SIDES[1]}, got {described['image_side']}")
    return NetworkConfig(sizes["side"], tuple(sizes["widths"]), sizes["blocks"]), tuple(words), described["image_side"]


def _weights(folder: Path, wanted: Mapping[str, Sequence[int]]) -> tuple[dict[str, Tensor], str]:
    """The weights as float32, and a digest of them. Raises ValueError."""
    files = sorted(folder.glob("weights_*.safetensors"))
    if not 0 < len(files) <= MAX_SHARDS:
        raise ValueError(f"it holds {len(files)} files weights_*.safetensors")
    found: dict[str, Tensor] = {}
    for path in files:
        with safe_open(str(path), framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 (not a dict)
                part = file.get_slice(name)
                if part.get_shape() != wanted.get(name) or part.get_dtype() not in ("F16", "F32"):
                    raise ValueError(f"{path.name} holds {name:.60} as {part.get_dtype()} {part.get_shape()}")
                found[name] = file.get_tensor(name).float().clone()
    if missing := set(wanted) - set(found):
        raise ValueError(f"{len(missing)} tensors are missing, {min(missing)} for one")
    if not all(bool(value.isfinite().all()) for value in found.values()):
        raise ValueError("a weight is not finite")
    digest = hashlib.sha256(b"".join(found[name].numpy().tobytes() for name in sorted(found)))
    return found, digest.hexdigest()[:16]


def _broken(folder: Path, reason: str) -> InputError:
    line = " ".join(reason.split())
    return InputError(
        f"Cannot read the shape prior in {folder}: {line:.200}. Restore the folder, or train it again with "
        "`gsopt finetune --shape`."
    )
