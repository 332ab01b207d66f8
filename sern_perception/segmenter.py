"""The classes of a cloud by a trained network, on one core. Needs the extra `seg`."""

from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import ConfigError
from sern_perception.classes import CLASSES
from sern_perception.projection import CHANNELS, RangeImage

WEIGHTS: Final = Path(__file__).with_name("weights") / "segmentation.onnx"
"""The network that comes with SERN: trained on scans of the stand-in."""
INPUT: Final = "cloud"
CLASSES_KEY: Final = "sern_classes"
"""Metadata of the model: its classes, in the order of its output, with commas between them."""


class Segmented(NamedTuple):
    """`classes`: (rows, columns), 0 where nothing is. `sure`: how likely each is, by the network, 0 to 1."""

    classes: NDArray[np.uint8]
    sure: NDArray[np.float32]


def load_onnxruntime() -> ModuleType:
    """The package. ConfigError, one line, where the extra `seg` is not installed."""
    try:
        import onnxruntime
    except ImportError as error:
        raise ConfigError(
            f"segmentation needs the package onnxruntime, which cannot be imported ({error}): install sern[seg]"
        ) from None
    return onnxruntime  # type: ignore[no-any-return]


class Segmenter:
    """ConfigError, one line: the extra is missing, or the file is no model, or one of other inputs or classes."""

    def __init__(self, path: Path = WEIGHTS, *, threads: int = 1) -> None:
        runtime = load_onnxruntime()
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = 4
        if not path.is_file():
            raise ConfigError(f"{path}: no such file", key="model")
        try:
            self._session: Any = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  (its exceptions have no common class)
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ConfigError(f"{path.name} is no model that onnxruntime can run: {reason}", key="model") from None
        self._check(path)

    def _check(self, path: Path) -> None:
        inputs = self._session.get_inputs()
        shape = list(inputs[0].shape) if len(inputs) == 1 else []
        if len(inputs) != 1 or inputs[0].name != INPUT or len(shape) != 4 or shape[1] != CHANNELS:
            found = ", ".join(f"{each.name} {list(each.shape)}" for each in inputs)
            raise ConfigError(
                f"{path.name} takes {found}: a model of clouds takes {INPUT} [1, {CHANNELS}, rows, columns]"
            )
        said = self._session.get_modelmeta().custom_metadata_map.get(CLASSES_KEY, "")
        if said != ",".join(CLASSES):
            raise ConfigError(f"{path.name} has the classes {said or 'of nobody'}: those here are {','.join(CLASSES)}")

    def segment(self, image: RangeImage) -> Segmented:
        """The class of each pixel."""
        (scores,) = self._session.run(None, {INPUT: image.channels[None]})
        shifted = np.exp(scores[0] - scores[0].max(axis=0, keepdims=True))
        sure = shifted.max(axis=0) / shifted.sum(axis=0)
        there = image.seen
        classes = np.where(there, scores[0].argmax(axis=0), 0).astype(np.uint8)
        return Segmented(classes, np.where(there, sure, 0.0).astype(np.float32))
