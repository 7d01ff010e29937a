"""A bundle's network on numpy images; knows nothing of ROS."""

import json
from pathlib import Path

import numpy as np
import onnxruntime


class Network:
    """The graph of a bundle that was written for ONNX Runtime, opened as its configuration says."""

    def __init__(self, bundle):
        folder = Path(bundle)
        known = json.loads((folder / "deployment.json").read_text(encoding="utf-8"))
        if known["runtime"] != "onnxruntime":
            raise ValueError(f"{folder} runs on {known['runtime']}; this node runs onnxruntime")
        execution = known["execution"]
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = execution["intra_op_threads"]
        options.inter_op_num_threads = execution["inter_op_threads"]
        self._session = onnxruntime.InferenceSession(
            str(folder / execution["file"]), options, providers=[execution["provider"]]
        )
        self._input = known["input"]
        self.size = tuple(known["input"]["resolution"])
        """Width and height of the images."""

    def disparity(self, left, right):
        """(H, W, 3) RGB bytes twice → (H, W) float32, in pixels."""
        pair = (self._prepared(image) for image in (left, right))
        given = dict(zip(self._input["names"], pair, strict=True))
        (found,) = self._session.run(["disparity"], given)
        width, height = self.size
        return found[0, :height, :width]

    def _prepared(self, image):
        height, width = image.shape[:2]
        if (width, height) != self.size:
            raise ValueError(
                f"the images are {width}x{height}, and the bundle is for "
                f"{self.size[0]}x{self.size[1]}: rts2-deploy --resolution {width}x{height}"
            )
        mean, std = (np.array(self._input[name], np.float32) for name in ("mean", "std"))
        normal = (image * np.float32(self._input["scale"]) - mean) / std
        tensor = np.zeros(self._input["shape"], np.float32)
        tensor[0, :, :height, :width] = normal.transpose(2, 0, 1)
        return tensor
