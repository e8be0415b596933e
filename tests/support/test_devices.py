import pytest
import torch

from nmpm._support.machine import computes_bfloat16, find_device
from nmpm.errors import ConfigError


@pytest.fixture
def two_gpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)


@pytest.mark.usefixtures("two_gpus")
def test_auto_prefers_a_gpu():
    assert find_device("auto") == torch.device("cuda")
    assert find_device("cuda:1") == torch.device("cuda", 1)
    with pytest.raises(ConfigError, match="has no device 'cuda:2'; it has cuda:0 … 1"):
        find_device("cuda:2")
    with pytest.raises(ConfigError, match="has no device 'cpu:3'; it has cuda"):
        find_device("cpu:3")


@pytest.mark.parametrize(
    ("onednn", "avx2", "avx512_bf16", "expected"),
    [(True, True, True, True), (True, True, False, False), (False, True, True, False), (True, False, False, True)],
    ids=["avx512_bf16", "avx512", "avx2", "arm"],
)
def test_bfloat16_is_computed_where_torch_has_instructions_for_it(monkeypatch, onednn, avx2, avx512_bf16, expected):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: True)
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: onednn)
    monkeypatch.setattr(torch.cpu, "_is_avx2_supported", lambda: avx2)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: avx512_bf16)
    assert computes_bfloat16(torch.device("cpu")) is expected
    assert computes_bfloat16(torch.device("cuda"))
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    assert not computes_bfloat16(torch.device("cpu"))
