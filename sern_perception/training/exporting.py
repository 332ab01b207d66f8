"""A trained network as an ONNX file that `sern_perception.segmenter` runs."""

import tempfile
import warnings
from pathlib import Path
from typing import Final

import onnx
import torch

from sern_perception.classes import CLASSES
from sern_perception.projection import CHANNELS, VLP16
from sern_perception.segmenter import CLASSES_KEY, INPUT
from sern_perception.training.network import SegmentationNet

OPSET: Final = 17


def export(net: SegmentationNet, out: Path) -> None:
    """Rows and columns are open: one network takes images of any scanner."""
    net.eval()
    axes = {2: "rows", 3: "columns"}
    example = torch.zeros(1, CHANNELS, VLP16.rows, VLP16.columns)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns of itself
        made = Path(folder) / "net.onnx"
        torch.onnx.export(
            net, (example,), str(made), input_names=[INPUT], output_names=["scores"],
            dynamic_axes={INPUT: axes, "scores": axes}, opset_version=OPSET, dynamo=False,
        )  # fmt: skip
        model = onnx.load(str(made))
    onnx.helper.set_model_props(model, {CLASSES_KEY: ",".join(CLASSES)})
    onnx.checker.check_model(model)
    out.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, str(out))
