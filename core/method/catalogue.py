"""The encoders installed on a machine: the packaged ones and those in the user's directory.

An encoder is a file ``<name>.encoder.safetensors`` with its vocabulary, projections, whitening, golden values,
definition and calibration.  It names a network file ``<network>.network.safetensors`` in the same folder or among the
packaged ones.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from core.disk.files import replacing
from core.errors import InvalidIdentifier, InvalidModel, UnknownEncoder
from core.judgement.verdict import Calibration
from core.method import DEFAULT_ENCODER as DEFAULT_ENCODER
from core.method.encoder import Encoder, EncoderDefinition, canary_frame
from core.method.features import FeatureExtractor, projection_arrays
from core.method.projection import Projection
from core.method.vocabulary import Vocabulary
from core.method.whitening import Whitening
from core.names import file_names
from core.networks.backbone import Device
from core.networks.files import open_network
from core.networks.identity import canonical_json
from core.networks.network import NAMES as NETWORK_NAMES

PACKAGED = Path(__file__).parents[1] / "models"
FORMAT = "placerec-encoder/1"
PROJECTION, CELLS, WHITENING = "projection.", "cells.", "whitening."
ENCODER_SUFFIX, NETWORK_SUFFIX = ".encoder.safetensors", ".network.safetensors"


class EncoderSummary(BaseModel):
    """One installed encoder as a user sees it; ``damaged`` says why it cannot be used."""

    name: str
    identity: str
    dimension: int
    local_shape: tuple[int, int] = Field(description="Cells and values of each that the second stage compares.")
    default: bool
    source: Literal["packaged", "installed"]
    network: str
    definition: EncoderDefinition | None
    calibration: Calibration | None
    training: dict[str, Any]
    damaged: str | None = None


class _Header(BaseModel):
    """The metadata of an encoder file."""

    name: str
    identity: str
    network: str
    origin: str
    definition: EncoderDefinition
    calibration: Calibration
    training: dict[str, Any]
    dimension: int
    local_shape: tuple[int, int]


def save_encoder(
    folder: Path,
    encoder: Encoder,
    vocabulary: Vocabulary,
    network: str,
    training: dict[str, Any],
) -> Path:
    """Write ``<name>.encoder.safetensors``, complete or not at all.

    Args:
        network: name of the network file that the encoder uses.
        training: how the vocabulary was made (images, features, seed …), for information.

    Raises:
        InvalidModel: the encoder's name cannot name a file.
    """
    try:
        file_names("an encoder").check(encoder.name)
    except InvalidIdentifier as error:
        raise InvalidModel(str(error)) from error
    header = _Header(
        name=encoder.name,
        identity=encoder.identity,
        network=network,
        origin=vocabulary.origin,
        definition=encoder.definition,
        calibration=encoder.calibration,
        training=training,
        dimension=encoder.dimension,
        local_shape=encoder.local_shape,
    )
    canary = encoder.encode(canary_frame())
    tensors: dict[str, NDArray[Any]] = {
        "centers": vocabulary.centers,
        "golden": canary.descriptor.astype(np.float16),
        "golden_local": canary.local,
    }
    for name, array in projection_arrays(encoder.extractor.projections).items():
        tensors[f"{PROJECTION}{name}"] = array
    for name, array in projection_arrays(encoder.extractor.cells).items():
        tensors[f"{CELLS}{name}"] = array
    if encoder.whitening is not None:
        tensors |= {f"{WHITENING}{name}": array for name, array in encoder.whitening.arrays().items()}
    path = folder / f"{encoder.name}{ENCODER_SUFFIX}"
    _write(path, tensors, header)
    return path


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Replace the default calibration in an encoder file; nothing else changes, and its identity stays.

    Raises:
        InvalidModel: the file cannot be read.
    """
    header = _read_header(path).model_copy(update={"calibration": calibration})
    try:
        with safe_open(path, "np") as file:
            tensors = {name: np.asarray(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error
    _write(path, tensors, header)


def _write(path: Path, tensors: Mapping[str, NDArray[Any]], header: _Header) -> None:
    """The file of an encoder, whole or not at all."""
    with replacing(path) as temporary:
        save_file(
            dict(tensors), temporary, {"format": FORMAT, "header": canonical_json(header.model_dump(mode="json"))}
        )
        temporary.chmod(0o644)


def _read_header(path: Path) -> _Header:
    try:
        with safe_open(path, "np") as file:
            metadata = file.metadata() or {}
        if metadata.get("format") != FORMAT:
            raise InvalidModel(f"{path.name} is not a {FORMAT} file.")
        header = _Header.model_validate(json.loads(metadata["header"]))
    except (OSError, SafetensorError, KeyError, ValueError, ValidationError) as error:
        raise InvalidModel(f"{path.name} is not a readable encoder file: {error}") from error
    if path.name != header.name + ENCODER_SUFFIX:
        raise InvalidModel(f"{path.name} holds the encoder {header.name!r}: a file is named as its encoder.")
    return header


def load_encoder(path: Path, network: Path) -> Encoder:
    """Load an encoder from its file and the file of its network.

    Raises:
        InvalidModel: a file is missing or damaged, or the parts do not have the identity with which the encoder was
            saved.
    """
    header = _read_header(path)
    try:
        with safe_open(path, "np") as file:
            tensors = {name: np.asarray(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118
        centers, canary = tensors["centers"].astype(np.float32), (tensors["golden"], tensors["golden_local"])
    except (OSError, SafetensorError, KeyError) as error:
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error
    vocabulary = Vocabulary(centers, header.origin)
    backbone = open_network(network, header.definition.outputs)
    projections, cells = (_read_projections(path, tensors, prefix) for prefix in (PROJECTION, CELLS))
    extractor = FeatureExtractor(backbone, header.definition, projections, cells)
    whitening = None
    if header.definition.whitening is not None:
        mean, matrix = (tensors.get(f"{WHITENING}{name}", np.zeros(0)) for name in ("mean", "matrix"))
        whitening = Whitening(mean.astype(np.float32), matrix.astype(np.float32))
    encoder = Encoder(header.name, extractor, header.definition, vocabulary, header.calibration, canary, whitening)
    if encoder.identity != header.identity:
        raise InvalidModel(f"{path.name} says it is {header.identity}, its contents are {encoder.identity}.")
    return encoder


def _whose(path: Path) -> dict[str, Any]:
    """Name, source and default of an encoder, by its file."""
    name = path.name.removesuffix(ENCODER_SUFFIX)
    return {
        "name": name,
        "source": "packaged" if path.parent == PACKAGED else "installed",
        "default": name == DEFAULT_ENCODER,
    }


def _read_projections(path: Path, tensors: Mapping[str, NDArray[np.generic]], prefix: str) -> dict[str, Projection]:
    parts = {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
    projections = {}
    for layer in sorted({name.rpartition(".")[0] for name in parts}):
        mean, matrix = parts.get(f"{layer}.mean"), parts.get(f"{layer}.matrix")
        fits = mean is not None and matrix is not None and matrix.ndim == 2 and mean.shape == matrix.shape[:1]
        if mean is None or matrix is None or not fits or not (np.isfinite(mean).all() and np.isfinite(matrix).all()):
            raise InvalidModel(f"{path.name}: its projection of {layer} is not a finite mean and matrix.")
        projections[layer] = Projection(mean.astype(np.float32), matrix.astype(np.float32))
    return projections


class EncoderCatalogue:
    """Finds encoders by name or identity and loads each once; thread-safe.

    Args:
        models_dir: the user's directory, which need not exist; an encoder in it that has the name of a packaged one is
            ignored.
        device: of the forward passes.
    """

    def __init__(
        self,
        models_dir: Path | None = None,
        device: Device = "cpu",
    ) -> None:
        self._device = device
        self._folders = [PACKAGED] + ([models_dir] if models_dir is not None else [])
        self._loaded: dict[Path, Encoder] = {}
        self._lock = threading.Lock()

    def _files(self) -> dict[str, Path]:
        found: dict[str, Path] = {}
        for folder in self._folders:
            for path in sorted(folder.glob(f"*{ENCODER_SUFFIX}")):
                found.setdefault(path.name.removesuffix(ENCODER_SUFFIX), path)
        return found

    def network_file(self, name: str) -> Path:
        """The path of a network's file.

        Raises:
            InvalidModel: no network of that name is installed.
        """
        for folder in self._folders:
            path = folder / f"{name}{NETWORK_SUFFIX}"
            if re.fullmatch(NETWORK_NAMES.pattern, name) and path.is_file():
                return path
        raise InvalidModel(f"no network named {name!r} is installed; its file would be {name}{NETWORK_SUFFIX}.")

    def describe(self) -> list[EncoderSummary]:
        """All installed encoders by name, including damaged ones; no weights are read."""
        return [self._summary(path) for path in self._files().values()]

    def summary(self, name_or_identity: str) -> EncoderSummary:
        """One installed encoder; no weights are read.

        Raises:
            UnknownEncoder: no encoder has this name or identity.
            InvalidModel: its file is damaged.
        """
        path = self._find(name_or_identity)
        return self._of_header(path, _read_header(path))

    def _summary(self, path: Path) -> EncoderSummary:
        try:
            return self._of_header(path, _read_header(path))
        except InvalidModel as error:
            blank: dict[str, Any] = {
                "identity": "",
                "dimension": 0,
                "local_shape": (0, 0),
                "network": "",
                "definition": None,
                "calibration": None,
            }
            return EncoderSummary(**_whose(path), **blank, training={}, damaged=str(error))

    @staticmethod
    def _of_header(path: Path, header: _Header) -> EncoderSummary:
        return EncoderSummary(**_whose(path), **header.model_dump(exclude={"origin", "name"}))

    def resolve(self, name_or_identity: str) -> str:
        """The full identity of an installed encoder.

        Raises:
            UnknownEncoder: no encoder has this name or identity; the text says what to do.
            InvalidModel: its file is damaged.
        """
        return _read_header(self._find(name_or_identity)).identity

    def _find(self, name_or_identity: str) -> Path:
        name, _, digest = name_or_identity.partition("@")
        files = self._files()
        if name not in files:
            raise UnknownEncoder(f"no encoder {name[:80]!r} is installed; there are {', '.join(files) or 'none'}.")
        if not digest or (identity := _read_header(files[name]).identity) == name_or_identity:
            return files[name]
        raise UnknownEncoder(
            f"the encoder {name} installed here is {identity}, not {name_or_identity[:140]}: its model has "
            "changed. Re-encode the map from its stored images, or enrol its traverses again into a new map."
        )

    def get(self, name_or_identity: str) -> Encoder:
        """The encoder, loaded at its first use.

        Raises:
            UnknownEncoder: no encoder has this name or identity.
            InvalidModel: its files are missing or damaged, or this machine lacks the device.
        """
        path = self._find(name_or_identity)
        with self._lock:
            if path not in self._loaded:
                encoder = load_encoder(path, self.network_file(_read_header(path).network))
                encoder.use(self._device)
                self._loaded[path] = encoder
            return self._loaded[path]
