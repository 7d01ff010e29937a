"""PyTorch as a runtime: the network that is deployed, in the precision that was asked for."""

import shutil
from typing import Any

import pytest
import torch

from rts2.model.errors import Rts2Error
from rts2.model.export import Deployed
from rts2.profiles.runtimes import Sized, eager


def outputs(session: eager.Session) -> Any:
    return session._forward()


def test_eager_runs_the_deployed_network_at_its_padded_size(sized: Sized) -> None:
    session = eager.eager_cpu(sized, "fp32", 1)
    session.run()
    disparity, semantic = outputs(session)
    assert disparity.shape == semantic.shape == (1, 64, 96)
    with torch.inference_mode():
        expected = Deployed(sized.network).eval()(*session._pair)
    assert torch.equal(disparity, expected[0])
    assert torch.equal(semantic, expected[1])


def test_a_network_stops_at_the_stage_that_was_asked_for(sized: Sized) -> None:
    early = Sized(sized.network, sized.resolution, stages=1)
    session = eager.eager_cpu(early, "fp32", 1)
    with torch.inference_mode():
        expected = Deployed(sized.network, 1).eval()(*session._pair)
    assert torch.equal(outputs(session)[0], expected[0])


def test_half_precision_stores_convolutions_in_half_and_leaves_the_network_alone(
    sized: Sized,
) -> None:
    """The path of a GPU, walked on the CPU: bf16 keeps 8 bits, so pixels agree within some."""
    half, full = (eager.Session(sized, "cpu", precision, 1) for precision in ("bf16", "fp32"))
    kinds = {
        module.weight.dtype
        for module in half._network.modules()
        if isinstance(module, (torch.nn.Conv2d, torch.nn.Conv3d))
    }
    assert kinds == {torch.bfloat16}
    assert all(weight.dtype == torch.float32 for weight in sized.network.parameters())
    difference = (outputs(half)[0] - outputs(full)[0]).abs().max()
    assert 0 < difference < 0.5


def test_every_session_runs_on_its_own_threads(sized: Sized) -> None:
    """PyTorch has one number for the process, which the session beside may have set."""
    before = torch.get_num_threads()
    try:
        one, two = (eager.eager_cpu(sized, "fp32", threads) for threads in (1, 2))
        for session, threads in ((one, 1), (two, 2), (one, 1)):
            session.run()
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_pytorch_has_no_times_of_nodes(sized: Sized) -> None:
    with pytest.raises(Rts2Error, match="onnxruntime and openvino have"):
        eager.eager_cpu(sized, "fp32", 1).node_times_ms(3)


def test_what_cannot_be_compiled_is_one_error(
    sized: Sized, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(network: Any, dynamic: bool) -> Any:
        def run(*pair: Any) -> None:
            raise RuntimeError("no kernel")

        return run

    monkeypatch.setattr(torch, "compile", refuse)
    with pytest.raises(Rts2Error, match="cannot compile the network: no kernel"):
        eager.compiled_cpu(sized, "fp32", 1)


def test_a_compiled_network_is_what_runs(sized: Sized, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = []

    def compiled(network: Any, dynamic: bool) -> Any:
        assert not dynamic
        return lambda *pair: ran.append(network(*pair))

    monkeypatch.setattr(torch, "compile", compiled)
    eager.compiled_cpu(sized, "fp32", 1).run()
    assert len(ran) == 2


def test_without_a_compiler_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(shutil, "which", {"clang++": "/usr/bin/clang++"}.get)
    assert eager.missing_compiler() is None
    monkeypatch.setenv("CXX", "icpx")
    assert "CXX names icpx, which is none; install g++" in str(eager.missing_compiler())
    monkeypatch.delenv("CXX")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert "there is no g++; install g++" in str(eager.missing_compiler())


@pytest.mark.parametrize(
    ("gpu", "built", "said"),
    [(True, "12.8", None), (False, None, "without CUDA"), (False, "12.8", "no GPU")],
)
def test_without_a_gpu_the_error_says_why(
    monkeypatch: pytest.MonkeyPatch, gpu: bool, built: str | None, said: str | None
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(torch.version, "cuda", built)
    found = eager.missing_gpu()
    assert (found is None) if said is None else (said in str(found))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU with CUDA")
@pytest.mark.parametrize("precision", ["fp32", "fp16"])
def test_a_cuda_graph_gives_what_eager_gives(sized: Sized, precision: Any) -> None:
    plain = eager.eager_cuda(sized, precision, 1)
    captured = eager.Captured(sized, eager.CUDA, precision, 1)
    captured.run()
    expected = outputs(plain)[0]
    assert torch.allclose(captured._outputs[0], expected, atol=1e-3 if precision == "fp32" else 0.5)
