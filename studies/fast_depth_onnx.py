"""Convert FastDepth from TensorFlow Lite to ONNX, and compare both on images.

``python studies/fast_depth_onnx.py fast_depth_224.tflite fast_depth.onnx photo.jpg …`` needs ``pip
install tflite ai-edge-litert onnx onnxruntime opencv-python-headless``, best in a virtual
environment of its own. The ONNX file takes RGB images ``(B, 3, 224, 224)`` from 0 to 1 and returns
z-depth in meters ``(B, 1, 224, 224)``.

The weights become floats. Every activation keeps the range of its 8 bits, ``0 … 255 · step``, which
contains the ReLU. The only difference is that activations are not rounded to 8 bits in between.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

_SIDE = 224
_LEVELS = 255
"""Number of steps of an 8-bit activation."""


class _Graph:
    """The nodes of an ONNX graph with the computation of a TensorFlow Lite file.

    Args:
        content: Content of the file.
        rounded: True to round activations to 8 bits, as the interpreter does.
    """

    def __init__(self, content: bytes, *, rounded: bool = False) -> None:
        import tflite  # type: ignore[import-not-found]

        self._lite, self._model = tflite, tflite.Model.GetRootAsModel(content, 0)
        self._graph, self._rounded = self._model.Subgraphs(0), rounded
        self._nodes: list[Any] = []
        self._weights: list[Any] = []
        self._padding: dict[int, NDArray[Any]] = {}
        self._names = {self._graph.Inputs(0): "image"}

    def model(self) -> onnx.ModelProto:
        """Return the ONNX model."""
        for number in range(self._graph.OperatorsLength()):
            self._add(self._graph.Operators(number))
        shapes: Any = {"image": ["batch", 3, _SIDE, _SIDE], "depth": ["batch", 1, _SIDE, _SIDE]}
        image, depth = (
            helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)
            for name, shape in shapes.items()
        )
        self._node("Identity", [self._names[self._graph.Outputs(0)]], "depth")
        graph = helper.make_graph(self._nodes, "fast_depth", [image], [depth], self._weights)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)

    def _add(self, operator: Any) -> None:
        code = self._model.OperatorCodes(operator.OpcodeIndex()).BuiltinCode()
        kinds = self._lite.BuiltinOperator
        inputs, output = operator.InputsAsNumpy(), operator.Outputs(0)
        source = self._names[inputs[0]]
        if code == kinds.QUANTIZE:
            self._names[output] = source
        elif code == kinds.PAD:  # zero-padding, which becomes that of the next convolution
            self._names[output], self._padding[output] = source, self._numbers(inputs[1])[1:3].T
        elif code in (kinds.CONV_2D, kinds.DEPTHWISE_CONV_2D):
            weights = self._numbers(inputs[1])  # (out, h, w, in), of depthwise (1, h, w, channels)
            is_depthwise = code == kinds.DEPTHWISE_CONV_2D
            weights = weights.transpose((3, 0, 1, 2) if is_depthwise else (0, 3, 1, 2))
            named = [f"{output}.weight", f"{output}.bias"]
            for name, values in zip(named, (weights, self._numbers(inputs[2])), strict=True):
                self._weights.append(numpy_helper.from_array(values.astype(np.float32), name))
            edges = self._padding.get(inputs[0], np.zeros((2, 2), int))
            before, after = (
                self._graph.Tensors(int(index)).ShapeAsNumpy()[1] for index in (inputs[0], output)
            )
            self._bounded(
                self._node(
                    "Conv",
                    [source, *named],
                    pads=edges.ravel().tolist(),
                    strides=[-(-(before - weights.shape[2] + 1) // after)] * 2,
                    group=len(weights) if is_depthwise else 1,
                ),
                output,
            )
        elif code == kinds.ADD:
            self._bounded(self._node("Add", [source, self._names[inputs[1]]]), output)
        elif code == kinds.RESIZE_NEAREST_NEIGHBOR:  # to twice the size
            scales = np.array([1, 1, 2, 2], np.float32)
            self._weights.append(numpy_helper.from_array(scales, f"{output}.scales"))
            how = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
            self._names[output] = self._node(
                "Resize", [source, "", f"{output}.scales"], mode="nearest", **how
            )
        else:
            raise NotImplementedError(f"operator {code} of TensorFlow Lite")

    def _node(self, kind: str, inputs: list[str], output: str = "", **settings: Any) -> str:
        output = output or f"{kind}.{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [output], **settings))
        return output

    def _bounded(self, source: str, tensor: int) -> None:
        """Limit an activation to its 8 bits."""
        step, zero = self._step(tensor)
        assert zero == [-128], "activations begin at 0"
        limits = {"least": 0.0, "most": _LEVELS * step[0], "step": step[0]}
        for name, value in list(limits.items())[: 3 if self._rounded else 2]:
            array = np.array(value, np.float32)
            self._weights.append(numpy_helper.from_array(array, f"{tensor}.{name}"))
        if self._rounded:
            source = self._node("Round", [self._node("Div", [source, f"{tensor}.step"])])
            source = self._node("Mul", [source, f"{tensor}.step"])
        self._names[tensor] = self._node("Clip", [source, f"{tensor}.least", f"{tensor}.most"])

    def _step(self, tensor: int) -> tuple[Any, list[int]]:
        quantization = self._graph.Tensors(int(tensor)).Quantization()
        return quantization.ScaleAsNumpy(), np.ravel(quantization.ZeroPointAsNumpy()).tolist()

    def _numbers(self, tensor: int) -> NDArray[Any]:
        """Return weights as floats, or whole numbers without a step."""
        described = self._graph.Tensors(int(tensor))
        kinds = self._lite.TensorType
        kind = {kinds.INT8: np.int8, kinds.INT32: np.int32}[described.Type()]
        content = self._model.Buffers(described.Buffer()).DataAsNumpy()
        values = np.frombuffer(content.tobytes(), kind).reshape(described.ShapeAsNumpy())
        quantization = described.Quantization()
        if quantization is None or not quantization.ScaleLength():
            return values
        shape = [1] * values.ndim
        shape[quantization.QuantizedDimension()] = -1  # one step, or one for each channel
        return values * quantization.ScaleAsNumpy().astype(np.float64).reshape(shape)


def interpreted(file: Path, images: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the depth of images ``(B, 224, 224, 3)`` in steps, from the interpreter."""
    from ai_edge_litert.interpreter import Interpreter  # type: ignore[import-not-found]

    interpreter = Interpreter(str(file))
    interpreter.allocate_tensors()
    source, target = interpreter.get_input_details()[0], interpreter.get_output_details()[0]
    depths = []
    for image in images:
        interpreter.set_tensor(source["index"], image[None])
        interpreter.invoke()
        depths.append(interpreter.get_tensor(target["index"])[0, :, :, 0].astype(np.float64))
    return np.stack(depths)


def compare(file: Path, images: NDArray[np.uint8]) -> None:
    """Print how far both are apart, in steps of the output."""
    import onnxruntime

    expected = interpreted(file, images)
    step = None
    for rounded in (False, True):
        graph = _Graph(file.read_bytes(), rounded=rounded)
        session = onnxruntime.InferenceSession(graph.model().SerializeToString())
        batch = images.transpose(0, 3, 1, 2).astype(np.float32) / 255
        depth = session.run(None, {"image": batch})[0][:, 0]
        step = step or float(graph._step(148)[0][0])
        error = depth / step - expected
        within = [f"{100 * np.mean(np.abs(error) <= n + 0.5):.2f} % within {n}" for n in range(4)]
        print(
            f"rounded={rounded}: {', '.join(within)}; mean {error.mean():.3f}, "
            f"largest {np.abs(error).max():.1f} steps of {step:.4f} m"
        )


def main() -> None:
    """Write the ONNX file, and compare both if images are given."""
    import cv2

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tflite", type=Path)
    parser.add_argument("onnx", type=Path)
    parser.add_argument("photos", nargs="*", type=Path)
    files = parser.parse_args()
    onnx.save(_Graph(files.tflite.read_bytes()).model(), files.onnx)
    photos: Any = [cv2.imread(str(photo)) for photo in files.photos]
    if photos:  # BGR
        side = (_SIDE, _SIDE)
        resized = [cv2.resize(each, side, interpolation=cv2.INTER_AREA) for each in photos]
        compare(files.tflite, np.stack(resized)[..., ::-1])


if __name__ == "__main__":
    main()
