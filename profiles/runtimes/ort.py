"""ONNX Runtime on the CPU."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime

from ...model.errors import Rts2Error


class Session:
    """An ONNX file that is ready to run on inputs of its own, for timing."""

    def __init__(self, path: Path, threads: int) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        # Threads that spin on after a run would take the cores from the session timed beside it.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        options.log_severity_level = 4  # what is wrong is raised, and told once
        try:
            self._session = onnxruntime.InferenceSession(
                path, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime's errors share no other base
            raise Rts2Error(f"{path} is no ONNX file that ONNX Runtime reads: {error}") from error
        for given in self._session.get_inputs():
            fixed = all(isinstance(side, int) for side in given.shape)
            if given.type != "tensor(float)" or not fixed:
                raise Rts2Error(
                    f"{path}: inputs must be float32 of fixed shapes; {given.name} is {given.type} "
                    f"{given.shape}"
                )
        noise = np.random.default_rng(0)
        self._inputs = {
            given.name: noise.standard_normal(given.shape, dtype=np.float32)
            for given in self._session.get_inputs()
        }

    def run(self) -> None:
        """One pair through the network."""
        self._session.run(None, self._inputs)


def versions() -> dict[str, str]:
    """The runtime's version, as a profile records it."""
    return {"onnxruntime": onnxruntime.__version__}
